"""Scenes: what is read, what is refused, where light falls."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.errors import ConfigError, EvlcpError, InputError
from evlcp_sdk.link.resolve import resolve
from evlcp_sdk.sim import (
    BarSpec,
    LampSpec,
    LensSpec,
    Simulation,
    load_scene,
    preset_names,
    resolve_scene,
    truth_of,
)
from evlcp_sdk.sim.light import BarLight, make_lamp_source
from evlcp_sdk.sim.motion import CameraPath, Vibration

LINK = resolve({})
EXAMPLES = Path(__file__).parents[3] / "examples" / "scenes"


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda p: p.stem)
def test_examples_can_be_rendered(path: Path) -> None:
    events = next(Simulation(load_scene(path)).stream())
    assert len(events)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"motion": {"distnce_m": 3.0}}, "motion.distnce_m = 3.0: unknown key; did you mean 'distance_m'?"),
        ({"bars": [{"z_m": -60.0}]}, "bars.0.z_m = -60.0: the bar is behind the camera"),
        ({"lens": {"focus_m": 0.01}}, "lens.focus_m = 0.01: expected beyond the focal length"),
        ({"lens": {"bloom": 0.99}}, "lens.bloom = 0.99: expected less than 1 together with lens.halo = 0.02"),
        ({"camera": {"width": 5000}}, "camera: expected at most 4096"),
        ({"bars": [{}] * 65}, "bars and lamps: expected at most 64"),
        ({"bars": [{"cover_s": [[0.1, 0.2, 3]]}]}, "bars.0.cover_s.0"),
        ({"motion": {"pothole_rad_s": 2}}, "motion.pothole_rad_s = 2.0: expected pothole_s beside it"),
        ({"bars": [{"start_chip": 1e12}]}, "bars.0.start_chip = 1000000000000.0: expected less than"),
        ({"reflections": [{"bar": 1}]}, "reflections.0.bar = 1: expected one of 1 bar, from 0 on"),
        ({"background": {"change_s": [[0, 1], [0, 9]]}}, "background.change_s = [0.0, 0.0]: expected times"),
        ({"wiper": {"edge_s": 0.02}}, "wiper.edge_s = 0.02: expected at most half of lasts_s"),
        ({"wiper": {"every_s": 0.01}}, "wiper.every_s = 0.01: expected at least lasts_s"),
        ({"link": 3}, "link = 3: expected a link.toml, or tables as in one"),
        ({"bars": [{"link": "no.toml"}]}, "bars.0.link: no.toml: cannot be read"),
        ({"bars": [{"link": {"bar": {"rows": 7}}}]}, "bars.0.link: bar.cluster_rows = 6: expected"),
        ({"bars": [{"profile": "wh8"}]}, 'bars.0.profile = "wh8": unknown key; its link says it: bars.link'),
    ],
)
def test_faults_are_reported_with_their_path(table: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as fault:
        resolve_scene(table, source="s.toml")
    (line,) = str(fault.value).splitlines()
    assert line.startswith(f"s.toml: {message}")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("nonsense", "--set nonsense: expected table.key=value"),
        ("mation.x=1", "--set mation.x: unknown table; did you mean 'motion'?"),
        ("bars.7.ppm=1", "--set bars.7.ppm: expected one of 1 bar, from 0 on"),
        ("bars=3 bars.ppm=1", "--set bars.ppm: bars = 3: expected tables [[bars]]"),
        ("motion=3 motion.yaw_deg=1", "--set motion.yaw_deg: motion = 3: expected a table"),
    ],
)
def test_wrong_overrides_are_reported(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        load_scene("night", override.split())


def test_a_bar_sends_what_the_air_interface_says() -> None:
    light = BarLight(BarSpec(ppm=50.0, start_chip=300.4), LINK, LensSpec(), seed=4)
    rate = 1e4 * (1 + 50e-6)
    book_chips = np.concatenate([packet_chips(light.symbols(q), LINK.codebook) for q in range(3)])
    when, levels = light.switches(2000.0, 12_000.0)
    assert len(levels) == len(when) + 1
    at = (300.4 + when * 1e-6 * rate).round(6)
    assert (at == at.round()).all()
    assert (levels[1:] == book_chips[at.astype(int)]).all()
    assert (levels[0] == book_chips[int(300.4 + 2000e-6 * rate)]).all()
    split = np.concatenate([light.switches(2000.0, 7001.3)[0], light.switches(7001.3, 12_000.0)[0]])
    assert (split == when).all()


def test_a_bar_sends_given_symbols_and_chips(tmp_path: Path) -> None:
    symbols = ((tuple(range(16)),) * 10,)
    light = BarLight(BarSpec(symbols=symbols, start_chip=0.0), LINK, LensSpec(), seed=0)
    assert light.list_symbols(0.05) == [[list(range(16))] * 10] * 2
    chips = np.random.default_rng(0).integers(0, 2, (50, 16))
    np.save(tmp_path / "chips.npy", chips)
    bar = BarSpec(chips_file=str(tmp_path / "chips.npy"), start_chip=40.0)
    sent = BarLight(bar, LINK, LensSpec(), seed=0)
    assert (sent.switches(0.0, 3000.0)[1] == np.concatenate([chips[40:], chips[:20]])).all()
    assert sent.list_symbols(1.0) == []
    texts = ["".join(map(str, row)) for row in np.tile(chips, (2, 1)).T]
    assert sent.longest_us == 100 * max(len(run) for text in texts for run in re.findall("0+|1+", text))
    (tmp_path / "text.npy").write_text("chips")
    for link, wrong, message in (
        (LINK, {"symbols": ((tuple(range(16)),),)}, r"bars\.0\.symbols\.0: 1 frames, expected 10"),
        (LINK, {"symbols": (((99,) * 16,) * 10,)}, r"symbol 99 .*expected 0 to 63"),
        (resolve({"bar": {"rows": 48}}), {"chips_file": str(tmp_path / "chips.npy")}, "8 clusters"),
        (
            LINK,
            {"chips_file": "a.npy", "payload": "data"},
            "payload = .data.: expected .symbols. beside chips_file",
        ),
        (
            LINK,
            {"chips_file": "a.npy", "symbols": symbols},
            r"bars\.0\.symbols: expected them, or chips_file",
        ),
        (LINK, {"chips_file": str(tmp_path / "no.npy")}, "cannot be read"),
        (LINK, {"chips_file": str(tmp_path / "text.npy")}, r"not a \.npy file of plain numbers"),
    ):
        with pytest.raises(EvlcpError, match=message):
            BarLight(BarSpec(**wrong), link, LensSpec(), 0, "bars.0")


def test_lamps_keep_their_period_and_duty() -> None:
    square = make_lamp_source(LampSpec(flicker_hz=1000.0, duty=0.3, depth=0.8, phase=0.5))
    when, levels = square.switches(0.0, 10_000.0)
    assert np.diff(when[::2]) == pytest.approx(1000)
    assert sorted({round(float(v), 9) for v in levels.ravel()}) == [0.2, 1.0]
    on = np.diff(np.concatenate([[0], when, [10_000]]))[levels[:, 0] == 1].sum()
    assert on == pytest.approx(3000, rel=0.1)
    sine = make_lamp_source(LampSpec(flicker_hz=100.0, waveform="sine"))
    when, levels = sine.switches(0.0, 10_000.0)
    assert len(when) == 31
    assert levels.max() > 0.99
    assert levels.min() < 0.01


def test_a_path_of_a_file_is_followed(tmp_path: Path) -> None:
    t = np.linspace(0, 0.2, 9)
    lines = ["t_s,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg"]
    lines += [f"{s},{3 * s},0.1,{-40 + 10 * s},{5 * s},{-2 * s},{20 * s}" for s in t]
    (tmp_path / "path.csv").write_text("\n".join(lines))
    (tmp_path / "scene.toml").write_text('[motion]\npath_file = "path.csv"\nvib_rate_rad_s = 0.0\n')
    scene = load_scene(tmp_path / "scene.toml", ["duration_s=0.2"])
    position, attitude = CameraPath(scene.motion, 0.2, 0).sample([1e5])
    assert position[0] == pytest.approx([0.3, 0.1, -39])
    assert np.degrees(attitude[0]) == pytest.approx([0.5, -0.2, 2])
    assert truth_of(scene).table["distance_m"][0][100] == pytest.approx(39, abs=0.05)
    with pytest.raises(ConfigError, match=r"lasts from 0\.0 to 0\.2 s"):
        Simulation(load_scene(tmp_path / "scene.toml", ["duration_s=0.3"]))
    ahead = [line.replace("-", "") for line in lines]
    for wrong, message in (
        (ahead, r"bars\.0: the bar is behind the camera .*depth -40\.00 m"),
        ([lines[0], "0,0,0,x,0,0,0"], "line 2: z_m = 'x': expected a number"),
        ([lines[0], lines[2], lines[1]], "rising t_s"),
    ):
        (tmp_path / "path.csv").write_text("\n".join(wrong))
        with pytest.raises(ConfigError, match=message):
            Simulation(scene)
    (tmp_path / "path.csv").unlink()
    with pytest.raises(InputError, match="cannot be read"):
        Simulation(scene)


def test_the_vibration_has_its_rate_and_its_spectrum() -> None:
    vibration = Vibration.of(0.06, 3)
    t_us = np.arange(0, 30e6, 1000.0)
    rate = np.gradient(vibration.angle_rad(t_us), 1e-3, axis=1)
    assert rate.std(1) == pytest.approx(0.06, rel=0.1)
    assert 0.13 < np.abs(rate).max() < 0.4
    power = np.abs(np.fft.rfft(rate[0])) ** 2
    frequency = np.fft.rfftfreq(len(t_us), 1e-3)

    def share(low: float, high: float) -> float:
        return float(power[(frequency >= low) & (frequency < high)].sum() / power.sum())

    assert share(0.4, 3.2) == pytest.approx(0.45, abs=0.1)
    assert share(5, 20) > 0.35
    assert 0.02 < share(20, 200) < 0.2
    assert (Vibration.of(0.0, 1).angle_rad([0.0, 1.0]) == 0).all()


def test_simulate_writes_a_recording_and_its_truth(tmp_path, evlcp, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    short = ("--set", "duration_s=0.02")
    first = evlcp("simulate", "--preset", "night", "-o", "a.raw", *short, "--json")
    assert first.code == 0, first.err
    summary, found = json.loads(first.out), json.loads(Path("a.truth.json").read_text())
    assert summary["bytes"] == found["bytes"] == Path("a.raw").stat().st_size
    assert found["events"] == summary["events"] > 1000
    # The truth holds the scene, which gives the recording again.
    again = Simulation(resolve_scene(found["simulator"]))
    assert sum(map(len, again.stream())) == found["events"]
    second = evlcp("simulate", "--preset", "night", "--seed", "5", "-o", "b.raw", *short)
    assert second.code == 0
    assert "written: b.raw, b.truth.json" in second.out
    Path("c.toml").write_text(evlcp("simulate", "--preset", "night", "--show").out)
    assert evlcp("simulate", "c.toml", "-o", "c.raw", *short, "--threads", "2").code == 0
    bodies = [Path(f"{name}.raw").read_bytes().split(b"% end\n", 1)[1] for name in "abc"]
    assert bodies[0] == bodies[2] != bodies[1]
    assert set(json.loads(evlcp("simulate", "--presets", "--json").out)) == set(preset_names())
    assert "drive-30kmh" in evlcp("simulate", "--presets").out


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--preset", "nigt", "-o", "a.raw"), 2, "no preset named 'nigt'; did you mean 'night'?"),
        (("--preset", "night", "-o", "a.csv"), 2, "a.csv: a recording is written as NAME.raw"),
        (("none.toml", "-o", "a.raw"), 2, "none.toml: cannot be read"),
        (("--preset", "night", "-o", "a.raw", "--set", "motion.distance_m=-1"), 2, "motion.distance_m = -1"),
        (("-o", "a.raw"), 2, ""),
        (("--preset", "night"), 2, ""),
        (("nigt", "-o", "a.raw"), 2, "nigt: no such file, and no preset of that name; did you mean 'night'?"),
        (("drive-30kmh", "-o", "a.raw"), 2, "drive-30kmh: no such file; for the preset: --preset drive-30km"),
    ],
)
def test_simulate_tells_what_is_wrong(arguments, code, message, tmp_path, evlcp, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = evlcp("simulate", *arguments)
    assert done.code == code
    assert message in " ".join(done.err.replace("│", " ").split())
    assert list(tmp_path.iterdir()) == []
