"""The command line: what it prints, what it writes, how it ends."""

import dataclasses
import json
import tomllib
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from evlcp_sdk.cli._app import add_plugin_commands, make_app
from evlcp_sdk.io import write_events
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.results import nmea
from evlcp_sdk.scene.sites import BarSite, LocalAxes, load_sites, to_toml
from evlcp_sdk.simulated import simulate
from evlcp_sdk.values import Events, Triggers
from tests.conftest import rows_of

Evlcp = Callable[..., Any]
FIGURE_NAMES = ("regions.png", "presence.png", "distance.png")
FILES = {"frames.csv", "packets.jsonl", "summary.json"}


@pytest.fixture
def noise_raw(tmp_path: Path) -> Path:
    """A recording of nothing but noise."""
    rng = np.random.default_rng(3)
    n = 20_000
    columns = (np.sort(rng.integers(0, 100_000, n)), rng.integers(0, 1280, n), rng.integers(0, 720, n))
    path = tmp_path / "noise.raw"
    write_events(path, Events.of(*columns, rng.integers(0, 2, n)), width=1280, height=720)
    return path


def summary_of(folder: Path) -> dict[str, Any]:
    table: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return table


def lines_of(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def words(text: str) -> str:
    """What is said, without the frame that Typer draws and the ends of lines."""
    return " ".join(text.replace("│", " ").split())


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


COMMANDS = ["receive", "live", "serve", "convert", "info", "sweep", "report", "demo", "loop"]
COMMANDS += ["calibrate", "survey", "config", "plugins"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches_by_example(evlcp: Evlcp, command: str) -> None:
    done = evlcp(command, "--help")
    assert done.code == 0
    assert done.out.count(f"evlcp {command}") >= 2 or command == "plugins"
    assert done.out.count("evlcp ") >= 2


def test_every_help_fits_a_screen_and_names_what_it_leaves_out(evlcp, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    listed = words(evlcp("--help").out)
    for text in [*COMMANDS, "board", "tx", "evlcp demo", "3 input that cannot be read"]:
        assert text in listed
    assert evlcp("--version").out.startswith("evlcp-sdk ")
    app = make_app()
    add_plugin_commands(app, Registry.load())
    commands = list(commands_of(typer.main.get_group(app)))
    assert {"receive", "board program", "tx message"} <= {" ".join(names) for names, _ in commands}
    for names, command in commands:
        done = evlcp(*names, "--help")
        lines, shown = done.out.splitlines(), set(done.out.split())
        assert "\x1b" not in done.out
        assert "<bool>" not in done.out, names
        assert len(lines) <= 46, names
        assert max(map(len, lines)) <= 80, names
        hidden = {option for one in command.params if getattr(one, "hidden", False) for option in one.opts}
        assert not hidden & shown, names
        assert not hidden or hidden <= set(evlcp(*names, "--help-all").out.split()), names


def commands_of(group: Any, *names: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """All commands, groups too, with the names that they are called by."""
    for name, command in group.commands.items():
        yield (*names, name), command
        yield from commands_of(command, *names, name) if hasattr(command, "commands") else ()


def test_receive_writes_and_tells(evlcp: Evlcp, demo_raw: Path, tmp_path: Path) -> None:
    done = evlcp("receive", demo_raw, "-o", tmp_path / "out")
    assert done.code == 0
    assert "\x1b" not in done.out
    assert names_in(tmp_path / "out") == FILES
    table = summary_of(tmp_path / "out")
    spent = table["processing"]
    pace = spent["times_real_time"]
    assert pace == pytest.approx(table["recording"]["duration_s"] / spent["processor_s"], abs=1e-3)
    assert spent["events_per_s"] == pytest.approx(764_142 / spent["processor_s"], rel=1e-3)
    for text in ("1 transmitter, ", f" in {spent['processor_s']:.2f} s of one core: ", "x real time"):
        assert text in done.out
    assert table["counts"]["events"] == table["recording"]["counts"]["events"] == 764_142
    assert {"evlcp-sdk", "numpy", "python"} <= set(table["versions"])
    assert table["configuration"]["ranging"]["id"] == "joint-scale"


def test_no_transmitter_is_no_failure(evlcp: Evlcp, noise_raw: Path, tmp_path: Path) -> None:
    done = evlcp("receive", noise_raw, "-o", tmp_path / "out")
    assert (done.code, "noise.raw: no transmitter was found" in done.out) == (0, True)


def test_a_recording_of_which_much_is_dropped_is_degraded(evlcp, noise_raw, tmp_path) -> None:
    data = noise_raw.read_bytes()
    middle = data.index(b"% end\n") + 6 + len(data) // 4 * 2
    path = tmp_path / "torn.raw"
    path.write_bytes(data[:middle] + b"\x00\x90" * (len(data) // 10) + data[middle:])
    done = evlcp("receive", path, "-o", tmp_path / "out")
    assert done.code == 4
    output = summary_of(tmp_path / "out")
    assert output["status"] == "degraded"
    assert output["losses"]["reserved_words"]["count"] == len(data) // 10
    assert done.err.startswith(f"evlcp: {path}: ")
    assert "were dropped" in done.err
    assert f"lost: {len(data) // 10} " in done.out


def test_receive_json_is_one_line_a_recording(evlcp, noise_raw, demo_raw, tmp_path) -> None:
    out = tmp_path / "out"
    done = evlcp("receive", noise_raw, demo_raw, tmp_path / "none.raw", "-o", out, "--json", "--figures")
    assert done.code == 3
    tables = lines_of(done.out)
    assert [t["status"] for t in tables] == ["complete", "complete", "failed"]
    assert tables[1] == summary_of(out / demo_raw.stem)
    assert tables[0]["result"] == "no transmitter was found"
    assert names_in(out / "noise") == FILES | {"regions.png"}
    assert done.err == f"evlcp: {tmp_path}/none.raw: No such file or directory\n"


SITES = [BarSite(1, 35.1, 137.0, 50.0)]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("REC -o OUT --set nonsense", "--set nonsense: expected table.key=value, e.g. modulation.id=wh8"),
        ("REC -o OUT -c missing.toml", "evlcp: missing.toml: cannot be read: No such file or directory"),
        ("REC -o OUT --set camera.width=640", "1280 x 720 pixels, but the link's camera has 640 x 720"),
        ("a/night.raw b/night.npz -o OUT", "two recordings would both be written"),
        ("REC", "give -o OUT, or --json-lines -"),
        ("REC --json-lines - --figures", "figures goes into a folder"),
        ("REC --json --json-lines -", "give one of --json and --json-lines"),
        ("- -o OUT --link auto", "standard input is read once"),
        ("REC -o OUT --sites S --heading-deg 3", "a heading needs gravity"),
        ("REC -o OUT --sites S --attitude a.csv --pitch-deg 3 --roll-deg 0", "not both"),
        ("REC -o OUT --pitch-deg 90 --roll-deg 0", "90.0: expected -89 to 89"),
        ("REC -o OUT --sites S --clock-zero noon", "expected a time such as"),
        ("REC -o OUT --sites S --clock-zero 9999-12-31T23:59:59.9", "expected 1970 to 2199"),
        ("REC -o OUT --gnss none.csv", "needs --sites"),
        ("REC -o REC", "it is read, and would be overwritten"),
    ],
)
def test_usage_and_configuration_end_with_2(evlcp, demo_raw, tmp_path, args, message) -> None:
    (tmp_path / "site.toml").write_text(to_toml(SITES))
    places = {"REC": demo_raw, "OUT": tmp_path / "out", "S": tmp_path / "site.toml"}
    done = evlcp("receive", *(places.get(one, one) for one in args.split()))
    assert done.code == 2
    assert message in words(done.err)
    assert not (tmp_path / "out").exists()
    assert "Traceback" not in done.err


def test_what_goes_by_one_link_refuses_another(evlcp: Evlcp) -> None:
    for command in ("diagnose never-read.raw", "board program", "tx message"):
        done = evlcp(*command.split(), "-c", "a.toml", "-c", "b.toml")
        assert done.code == 2
        assert "--config is given 2 times, expected once: " in words(done.err)


@pytest.mark.parametrize("name", ["...raw", "..raw", "...csv.gz", "..", "/"])
def test_no_recording_is_written_outside(evlcp: Evlcp, demo_raw: Path, tmp_path: Path, name: str) -> None:
    done = evlcp("receive", tmp_path / "in" / name, demo_raw, "-o", tmp_path / "a" / "b")
    assert done.code == 2
    assert "gives no name of a folder in" in words(done.err)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n" + bytes(40), b"no header at all"])
def test_what_cannot_be_read_ends_with_3(evlcp: Evlcp, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.raw"
    path.write_bytes(content)
    for command in (["receive", path, "-o", tmp_path / "out"], ["info", path]):
        done = evlcp(*command)
        assert done.code == 3
        assert done.err.startswith(f"evlcp: {path}: ")
        assert len(done.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_info(evlcp: Evlcp, demo_raw: Path, tmp_path: Path) -> None:
    lines = evlcp("info", demo_raw).out.splitlines()
    for line in ("sensor     1280 x 720", "events     764,142, 43% positive", "anomalies  none"):
        assert line in lines
    table = json.loads(evlcp("info", demo_raw, "--json").out)
    assert table["counts"]["events"] == 764_142
    assert table["duration_s"] == pytest.approx(0.08, abs=1e-4)
    assert table["peak_events_per_s"] >= table["events_per_s"]
    path = tmp_path / "t.raw"
    events = Events.of(np.arange(100) * 10, np.zeros(100), np.zeros(100), np.ones(100))
    write_events(path, events, 1280, 720, triggers=Triggers.of([5, 505], [2, 2], [1, 0]))
    path.write_bytes(path.read_bytes() + b"\x01")
    done = evlcp("info", path)
    assert done.code == 0
    assert "triggers   channel 2 falling: 1\n           channel 2 rising: 1\n" in done.out
    assert "at byte" in done.out.split("anomalies")[1]


def test_config_prints_what_it_loads(evlcp: Evlcp, tmp_path: Path) -> None:
    text = evlcp("config", "--set", "modulation.id=wh8").out
    (tmp_path / "link.toml").write_text(text)
    assert evlcp("config", "-c", tmp_path / "link.toml").out == text
    digest = evlcp("config", "-c", tmp_path / "link.toml", "--digest").out.strip()
    assert digest in text
    table = json.loads(evlcp("config", "--set", "modulation.id=wh8", "--json").out)
    assert table["digest"] == digest
    book = json.loads(evlcp("config", "--set", "modulation.id=wh8", "--codebook", "json").out)
    assert book["digest"] == table["codebook"]["digest"]
    assert "evlcp_pilots[16]" in evlcp("config", "--codebook", "c").out
    assert evlcp("config", "--json", "--digest").code == 2


def test_demo_against_the_truth(evlcp: Evlcp, tmp_path: Path) -> None:
    done = evlcp("demo", "--recording", "-o", tmp_path, "--json")
    assert done.code == 0
    output = json.loads(done.out)["score"]
    truth = Path(__file__).parents[3] / "examples" / "recordings" / "night-50m-30kmh-cut.truth.json"
    assert json.loads(evlcp("score", tmp_path, truth, "--json").out) == output
    (result,) = output["bars"]
    assert result["frames_found"] >= 0.9 * result["frames_sent"]
    assert result["frames_sent"] == 21
    assert output["unmatched"] == 0
    assert result["bit_errors"] <= 1e-3 * result["bits"]
    assert result["rmse_m"] <= 0.12
    assert names_in(tmp_path) == FILES | set(FIGURE_NAMES)
    shown = evlcp("demo", "--recording", "-o", tmp_path).out
    assert "against the truth: " in shown
    assert all(len(line) <= 80 for line in shown.splitlines() if "±" in line)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive towards two bars that send their beacons, with its truth and sites."""
    folder = tmp_path_factory.mktemp("street")
    bar = 'payload = "messages"\ny_m = -3.5\n'
    (folder / "scene.toml").write_text(
        "duration_s = 0.16\nseed = 3\n[world]\nlatitude_deg = 35.1\nlongitude_deg = 137.0\nheight_m = 50.0\n"
        "[motion]\npitch_deg = 4.0\nvib_rate_rad_s = 0.0\n"
        f"[[bars]]\nx_m = -3.0\n{bar}[[bars]]\nx_m = 3.0\nz_m = -5.0\n{bar}"
    )
    written = simulate(folder / "scene.toml").save(folder / "rec.raw")
    (site,) = (path for path in written if path.name == "rec.site.toml")
    site.rename(folder / "site.toml")
    return folder


def test_what_is_found_comes_as_files_and_as_lines(evlcp: Evlcp, street: Path, tmp_path: Path) -> None:
    angles = ("--pitch-deg", "4", "--roll-deg", "0", "--gravity-sigma-deg", "0.01", "--figures")
    given = ("--sites", street / "site.toml", *angles, "--json-lines", "-")
    done = evlcp("receive", street / "rec.raw", "-o", tmp_path, *given)
    assert done.code == 0
    files = {"fixes.csv", "track.csv", "fixes.geojson", "fixes.nmea", "track.png"}
    assert names_in(tmp_path) == FILES | files | set(FIGURE_NAMES)
    fixes, output = rows_of(tmp_path / "fixes.csv"), summary_of(tmp_path)
    placed = [row for row in fixes if not row["refusal"]]
    assert len(placed) == output["positions"]["fixes"] >= 3
    assert sorted(output["positions"]["bars"].values()) == [1, 2]
    truth = json.loads((street / "rec.truth.json").read_text())
    for row in placed:
        at = float(row["t_us"]) * 1e-6
        for key, metres in (("latitude_deg", 111_000), ("longitude_deg", 91_000), ("height_m", 1)):
            off = float(row[key]) - np.interp(at, truth["t_s"], truth["camera_path"][key])
            assert abs(off) * metres < 0.15
    # The lines say what the files say.
    lines = lines_of(done.out)
    kinds = [one.pop("line") for one in lines]
    of_kind = {kind: [one for one, its in zip(lines, kinds, strict=True) if its == kind] for kind in kinds}
    rows = rows_of(tmp_path / "frames.csv")
    for key in ("t_us", "distance_m"):
        assert [one[key] for one in of_kind["frame"]] == [float(row[key]) for row in rows]
    reported = lines_of((tmp_path / "packets.jsonl").read_text())
    assert of_kind["message"] == [one for one in reported if one["kind"] != "packet"] != []
    assert [one["refusal"] for one in of_kind["fix"]] == [row["refusal"] for row in fixes]
    # A packet's frames are told before the next packet's, and the summary last.
    assert kinds[-1] == "summary"
    assert kinds.index("message") < len(kinds) - 1 - kinds[::-1].index("frame")
    assert lines[-1] == output
    # People read what was received, and where the camera was in the end.
    assert [one["said"].startswith("beacon at 35.") for one in output["messages"]] == [True, True]
    last = placed[-1]
    assert output["positions"]["last"]["t_us"] == float(last["t_us"])
    for text in (
        f"{len(placed)} positions",
        output["messages"][0]["said"],
        f"the last one {float(last['latitude_deg']):.7f}, ",
    ):
        assert text in done.err


PLACE = ("latitude_deg", "longitude_deg", "height_m")
TURN = ("heading_deg", "pitch_deg", "roll_deg")


def poses_of(street: Path) -> list[dict[str, float]]:
    """The camera's true poses at three times."""
    path = json.loads((street / "rec.truth.json").read_text())["camera_path"]
    return [
        {"t_us": ms * 1000, **{name: path[name][ms] for name in PLACE + TURN}, "attitude_sigma_deg": 0.01}
        for ms in (50, 80, 110)
    ]


def write_rows(file: Path, rows: Sequence[dict[str, Any]]) -> Path:
    """Write a CSV file with a heading."""
    lines = [",".join(map(str, values)) for values in (rows[0], *(row.values() for row in rows))]
    file.write_text("\n".join(lines) + "\n")
    return file


def test_a_survey_says_what_its_beacons_and_poses_contradict(evlcp, street: Path, tmp_path: Path) -> None:
    rows, poses = poses_of(street), tmp_path / "poses.csv"
    survey = ("survey", street / "rec.raw", "--poses", poses, "-o", tmp_path / "new.toml")
    # Heights of another zero, which the views do not show, but the bars' own beacons do.
    write_rows(poses, [row | {"height_m": row["height_m"] + 5} for row in rows])
    done = evlcp(*survey)
    assert done.out.count("its beacon contradicts that: transmitter") == 2
    assert " says that it is 5 m from the site of its id" in words(done.out)
    # Of a clock that is not the camera's.
    write_rows(poses, [row | {"t_us": row["t_us"] + 10**9} for row in rows])
    done = evlcp(*survey)
    assert done.code == 2
    expected = "poses.csv: t_us from 1000050000 to 1000110000: expected the camera's clock, us"
    assert expected in words(done.err)


def test_a_car_surveys_a_new_bar_on_its_way(evlcp: Evlcp, street: Path, tmp_path: Path) -> None:
    """By one bar of two that is known, and the attitude."""
    path = json.loads((street / "rec.truth.json").read_text())["camera_path"]
    sigmas = {"gravity_sigma_deg": 0.02, "heading_sigma_deg": 0.02}
    imu = [
        {"t_us": ms * 1000, **{name: path[name][ms] for name in TURN}, **sigmas}
        for ms in range(len(path["pitch_deg"]))
    ]
    given = ("--attitude", write_rows(tmp_path / "imu.csv", imu))
    one, new = tmp_path / "one.toml", tmp_path / "new.toml"
    bars = load_sites(street / "site.toml")
    one.write_text(to_toml([dataclasses.replace(bars[0], position_sigma_m=0.01)]))
    nmea = nmea_of(path, (40, 80, 120), tmp_path / "gnss.nmea")
    survey = ("survey", street / "rec.raw", "--sites", one, *given, "-o", new, "--gnss", nmea)
    assert "expected --clock-zero" in words(evlcp(*survey).err)
    done = evlcp(*survey, "--clock-zero", "2026-03-01T12:00:00Z", "--json")
    assert done.code == 0, done.err
    (bar,), (reported,) = load_sites(new), json.loads(done.out)["bars"]
    assert bar.transmitter_id == bars[1].transmitter_id
    error = LocalAxes.of([bars[1]]).to_enu(bar.latitude_deg, bar.longitude_deg, bar.height_m)
    assert error @ np.linalg.solve(reported["covariance_m2"], error) < 20
    assert reported["views"] == 7
    assert 0.01 < bar.position_sigma_m < 0.5
    for given in ((), ("--poses", "x.csv", "--sites", one), ("--poses", "x.csv", "--gnss", "x.csv")):
        assert evlcp("survey", street / "rec.raw", "-o", new, *given).code == 2


def nmea_of(path: dict[str, list[float]], at_ms: Sequence[int], file: Path) -> Path:
    """GGA and GST of a camera's path from noon on, 0.1 m precise."""
    lines = []
    for ms in at_ms:
        clock = nmea.format_clock(ms * 1e3, datetime(2026, 3, 1, 12, tzinfo=UTC))
        place = path["latitude_deg"][ms], path["longitude_deg"][ms], path["height_m"][ms]
        lines += [nmea.gga(clock, place, 9), nmea.gst(clock, 0.0, 0.01 * np.eye(3))]
    file.write_text("".join(lines))
    return file


def test_live_takes_what_receive_takes(evlcp: Evlcp, street: Path, tmp_path: Path) -> None:
    """Attitude, satellites and MCAP: the files of a live run are those of `receive`."""
    reader = pytest.importorskip("mcap.reader", reason="the extra mcap is not installed")
    path = json.loads((street / "rec.truth.json").read_text())["camera_path"]
    nmea, imu = nmea_of(path, (40, 120), tmp_path / "gnss.nmea"), tmp_path / "imu.csv"
    imu.write_text("t_us,pitch_deg,roll_deg,heading_deg\n0,4,0,0\n200000,4,0,0\n")
    given = ("--sites", street / "site.toml", "--attitude", imu, "--gnss", nmea, "--mcap")
    given = (*given, "--clock-zero", "2026-03-01T12:00:00Z", "--json", "-o")
    done = evlcp("receive", street / "rec.raw", *given, tmp_path / "file")
    assert done.code == 0, done.err
    satellites = [row for row in rows_of(tmp_path / "file" / "fixes.csv") if row["source"] == "gnss"]
    assert [float(row["t_us"]) for row in satellites] == [40_000, 120_000]
    for row, ms in zip(satellites, (40, 120), strict=True):
        for key, abs_ in (("latitude_deg", 1e-8), ("longitude_deg", 1e-8), ("height_m", 1e-3)):
            assert float(row[key]) == pytest.approx(path[key][ms], abs=abs_)
        assert float(row["sigma_east_m"]) == pytest.approx(0.1)
    recording = f"replay:{street / 'rec.raw'}?speed=50"
    done = evlcp("live", recording, "--waiting-ms", "100000", *given, tmp_path / "live")
    assert done.code == 0, done.err
    assert json.loads(done.out)["positions"]["fixes"] > 2
    for name in ("frames.csv", "packets.jsonl", "fixes.csv", "track.csv"):
        assert (tmp_path / "live" / name).read_text() == (tmp_path / "file" / name).read_text(), name
    reports = []
    for name in ("file", "live"):
        with (tmp_path / name / "fixes.mcap").open("rb") as file:
            messages = [(c.topic, m.log_time, m.data) for _, c, m in reader.make_reader(file).iter_messages()]
        reports.append(sorted(messages))
    assert {topic for topic, _, _ in reports[0]} >= {"/image", "/regions", "/frames", "/fix", "/scene"}
    assert reports[0] == reports[1]
    assert evlcp("live", recording, "--mcap").code == 2


def test_calibrate_finds_the_focal_length(evlcp: Evlcp, street: Path, tmp_path: Path) -> None:
    rows = poses_of(street)
    poses = write_rows(tmp_path / "poses.csv", rows)
    given = ("calibrate", street / "rec.raw", "--sites", street / "site.toml", "--poses", poses)
    done = evlcp(*given, "--set", "camera.focal_mm=34.7")
    assert done.code == 0, done.err
    table = tomllib.loads(done.out)["camera"]
    output = json.loads(evlcp(*given, "--json").out)
    assert abs(table["focal_mm"] - 35) < 5 * output["sigma"]["focal_mm"]
    assert output["sigma"]["focal_mm"] < 0.05
    assert output["camera"]["focal_mm"] == pytest.approx(table["focal_mm"], abs=1e-4)
    assert output["views"] == 3
    # A table for link.toml.
    link = tmp_path / "link.toml"
    link.write_text(done.out)
    assert evlcp("config", "--digest", "-c", link).code == 0
    assert output["poses"] == 3
    write_rows(poses, [*rows, rows[-1] | {"t_us": 9_110_000}])
    assert "# 1 of 4 poses show no bar\n" in evlcp(*given).out
    write_rows(poses, [{"recording": "other.raw"} | row for row in rows])
    assert "line 2" in evlcp(*given).err
    write_rows(poses, rows)
    other = tmp_path / "site.toml"
    other.write_text((street / "site.toml").read_text().replace("length_m = 0.96", "length_m = 1.5"))
    assert "0.96 m long, its site 1.5 m" in evlcp("calibrate", *given[1:3], other, *given[4:]).err
