"""Two kinds of transmitter in one recording, at 50 m by night: each is read by its link, without an error."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.place.navigator import PositionPlan
from evlcp_sdk.run import film, receive, receive_to_folder
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.sites import LocalAxes, load_sites
from evlcp_sdk.sim.truth import read_truth, truth_path
from evlcp_sdk.simulated import simulate
from evlcp_sdk.study.compare import compare_recording, load_variants
from evlcp_sdk.study.frames import frames_of, read_frames
from evlcp_sdk.study.match import check_link
from evlcp_sdk.study.score import links_of_result, score_frames
from tests.conftest import rows_of

LAMP = """
[bar]
rows = 6
columns = 1
cluster_rows = 6
cluster_columns = 1
[framing]
id = "uart"
parity = "even"
[air]
chip_rate_hz = 10000.0
"""
OTHERS = {"lamp": LAMP, "far": '[modulation]\nid = "wh8"\n'}


def compare_and_film(folder: Path, links: list[Path], score: dict[str, Any]) -> None:
    """The other commands that take several links say the same of them."""
    variants = load_variants(["a:", "b:far.ranging.id=centroid"], links)
    table = compare_recording(str(folder / "two.raw"), variants)
    for measured in table.rows.values():
        total = measured.statistics.total()
        assert total.frames_found == sum(bar["frames_found"] for bar in score["bars"])
        assert (total.bit_errors, measured.statistics.unmatched) == (0, 0)
    assert table.bounds_m == ()
    reported = film(folder / "two.raw", folder / "two.webp", links, for_ms=2.0, longest_px=200)
    assert len(reported["transmitters"]) == 2


@pytest.fixture(scope="module")
def two_links(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Path]]:
    """A recording of a bar and a shorter one of another alphabet, and their links."""
    folder = tmp_path_factory.mktemp("two")
    links = [folder / "bar.toml", folder / "short.toml"]
    links[0].write_text("")
    links[1].write_text('[modulation]\nid = "wh8"\n[bar]\nrows = 60\ncluster_rows = 6\n')
    (folder / "scene.toml").write_text(
        "duration_s = 0.24\n[background]\nlight_w_m2 = 1e-3\n[motion]\ndistance_m = 45.0\npitch_deg = 4.0\n"
        "[world]\nlatitude_deg = 35.1\nlongitude_deg = 137.0\nheight_m = 50.0\nheading_deg = 30.0\n"
        '[[bars]]\nx_m = -3.0\ny_m = -3.5\npayload = "messages"\nlink = "bar.toml"\n'
        '[[bars]]\nx_m = 3.0\ny_m = -4.0\npayload = "messages"\nlink = "short.toml"\n'
    )
    simulate(folder / "scene.toml", 3).save(folder / "two.raw")
    return folder / "two.raw", links


def test_bars_of_two_links_give_one_position(two_links: tuple[Path, list[Path]], tmp_path: Path) -> None:
    """Positions by gravity alone need both."""
    recording, links = two_links
    named = zip(load_sites(recording.with_suffix(".site.toml")), ("bar", "short"), strict=True)
    sites = tuple(replace(site, link=name, transmitter=None) for site, name in named)
    truth = read_truth(truth_path(recording))
    pitch, roll = (float(np.mean(truth.camera_path[name])) for name in ("pitch_deg", "roll_deg"))
    lines: list[str] = []
    known = {"plan": PositionPlan(sites), "attitude": Attitude(pitch, roll, None, 0.3)}
    receive_to_folder(recording, tmp_path, links, **known, lines=lines.append)
    fixes = [row for row in rows_of(tmp_path / "fixes.csv") if not row["refusal"]]
    assert {" ".join(sorted(row["link"].split())) for row in fixes} == {"bar short"}
    assert len(fixes) >= 3
    reported = {line["link"] for line in map(json.loads, lines) if line["line"] == "fix"}
    assert reported == {row["link"] for row in fixes}
    keys = ("latitude_deg", "longitude_deg", "height_m")
    for row in fixes:
        at = [np.interp(float(row["t_us"]) - truth.t0_us, truth.t_us, truth.camera_path[key]) for key in keys]
        off = LocalAxes(*at).to_enu(*(float(row[key]) for key in keys))
        sigmas = [float(row[f"sigma_{name}_m"]) for name in ("east", "north", "up")]
        assert (np.abs(off) < 4 * np.array(sigmas)).all()
        assert np.linalg.norm(off) < 1.5


def test_bars_of_two_links_are_surveyed(two_links, tmp_path, evlcp) -> None:
    """What a survey of two links says, and names that no link has."""
    recording, (bar, short) = two_links
    poses, out = tmp_path / "poses.csv", tmp_path / "new.toml"
    path = read_truth(truth_path(recording)).camera_path
    names = ("latitude_deg", "longitude_deg", "height_m", "heading_deg", "pitch_deg", "roll_deg")
    lines = [",".join(("t_us", *names, "attitude_sigma_deg"))]
    lines += [f"{ms}000," + ",".join(str(path[n][ms]) for n in names) + ",0.01" for ms in (90, 130, 180)]
    poses.write_text("\n".join(lines) + "\n")
    links = ("-c", bar, "-c", short)
    done = evlcp("survey", recording, "--poses", poses, "-o", out, *links, "--json")
    assert done.code == 0, done.err
    true = {site.transmitter_id: site for site in load_sites(recording.with_suffix(".site.toml"))}
    found = load_sites(out)
    assert [(site.link, site.length_m) for site in found] == [("bar", 0.96), ("short", 0.6)]
    for site, bar in zip(found, json.loads(done.out)["bars"], strict=True):
        axes = LocalAxes.of([true[site.transmitter_id]])
        off = axes.to_enu(site.latitude_deg, site.longitude_deg, site.height_m)
        assert off @ np.linalg.solve(bar["covariance_m2"], off) < 20
        assert site.position_sigma_m < 1

    out.write_text(out.read_text().replace('"short"', '"shrot"'))
    line = "link = 'shrot': no link is named so; did you mean 'short'? (links: bar, short)"
    for command in ("receive", "survey"):
        done = evlcp(command, recording, *links, "-o", tmp_path / "more", "--sites", out)
        assert done.code == 2
        assert done.err.strip().endswith(line)


@pytest.mark.parametrize("other", OTHERS)
def test_bar_and_another_kind(other: str, tmp_path: Path) -> None:
    links, recording = [tmp_path / "bar.toml", tmp_path / f"{other}.toml"], tmp_path / "two.raw"
    for path, text in zip(links, ("", OTHERS[other]), strict=True):
        path.write_text(text)
    (tmp_path / "scene.toml").write_text(
        "duration_s = 0.12\n[background]\nlight_w_m2 = 1e-3\n[motion]\ndistance_m = 50.0\n"
        f'[[bars]]\nlink = "bar.toml"\n[[bars]]\nx_m = 1.5\nlink = "{other}.toml"\n'
    )
    simulate(tmp_path / "scene.toml", 1).save(recording)
    lines: list[str] = []
    out, sinks, names = tmp_path / "out", ("report", "parquet", "points"), {"bar", other}
    table = receive_to_folder(recording, out, links, sinks=sinks, lines=lines.append)
    assert table["warnings"] == []
    assert sorted(one["link"] for one in table["transmitters"]) == sorted(names)
    assert set(table["links"]) == names
    assert "configuration" not in table

    truth, by_name = read_truth(truth_path(recording)), links_of_result(out)
    check_link(truth, by_name, "out")
    with pytest.raises(ConfigError, match="bar 1 was sent with another link"):
        check_link(truth, load_link(), "out")
    found = score_frames(read_frames(out), truth, by_name)
    assert found["unmatched"] == 0
    assert [bar["link"] for bar in found["bars"]] == ["bar", other]
    for bar in found["bars"]:
        assert bar["bit_errors"] == 0
        assert bar["frames_found"] == bar["frames_sent"] > 0

    rows = rows_of(out / "frames.csv")
    assert len({(row["transmitter"], row["link"]) for row in rows}) == 2
    packets = (out / "packets.jsonl").read_text().splitlines()
    reported = [line for line in map(json.loads, lines) if line["line"] == "frame"]
    for of in (map(json.loads, packets), reported, rows):
        assert {one["link"] for one in of} == names
    assert f"({other})" in (out / "report.html").read_text()
    parquet = pytest.importorskip("pyarrow.parquet").read_table(out / "frames.parquet")
    assert parquet.column("link").to_pylist() == [row["link"] for row in rows]
    if other == "far":
        compare_and_film(tmp_path, links, found)
    with receive(recording, links) as packets_again:
        assert len(frames_of(packets_again)) == len(rows)
