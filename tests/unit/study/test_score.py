"""Scores against the independent scorers, against plain loops and by hand; positions beside the path."""

import json
import math
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.link.resolve import load_link, resolve
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.sites import LocalAxes
from evlcp_sdk.sim import (
    BarSpec,
    Scene,
    Simulation,
    Truth,
    load_scene,
    resolve_scene,
    sites_of,
    truth_from_table,
    truth_of,
)
from evlcp_sdk.sim.scene import WorldSpec
from evlcp_sdk.sim.world import attitude_log
from evlcp_sdk.study.frames import FrameRow, read_frames
from evlcp_sdk.study.match import check_link, find_nearest_bar, match_frames
from evlcp_sdk.study.measure import statistics_of, tally_positions
from evlcp_sdk.study.score import score_frames
from evlcp_sdk.study.tally import Tally
from evlcp_sdk.values import Packet
from tests.conftest import ROOT
from tests.unit.place.place_scenes import frame
from tests.unit.study.oracle import COLUMNS, Lengths, faulty_rows, score, text_of

SHARED = ROOT.parent / "shared"
TOOLS = [SHARED / "tools" / f"{name}.py" for name in ("score", "score_road")]
RECORDED = {path.stem: path for path in sorted(SHARED.glob("recordings/**/*.truth.json"))}
Table = dict[str, Any]

# The scorers, not this project's, leave their files to the collector.
needs_tools = pytest.mark.skipif(
    not all(tool.exists() for tool in TOOLS), reason="the scorers of ../shared are not there"
)
leaves_files = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)


def plain(table: Table) -> Table:
    return json.loads(json.dumps(table))


COVERS = {"covered": [4, 5, 12], "pole_s": [[0.08, 0.1], [0.15, 0.1515]]}
COVERS |= {"cover_s": [[0.03, 0.06, 10, 15], [0.05, 0.052, 0, 3], [0.0, 0.3, 9, 9]]}


def scene_truths() -> dict[str, Table]:
    two = truth_of(load_scene("two-bars", ["duration_s=0.2", "motion.distance_m=61.0", "t0_us=16777000"]))
    dark, covered = plain(truth_of(Scene()).table), plain(truth_of(load_scene("two-bars")).table)
    dark["bars"][0]["led_w_m2"] = 1e-9
    covered["bars"][0] |= COVERS
    return {"two": plain(two.table), "dark": dark, "covered": covered}


@needs_tools
@leaves_files
@pytest.mark.parametrize("name", ["two", "dark", "covered", *RECORDED])
def test_the_numbers_are_those_of_both_independent_scorers(name, tmp_path, evlcp) -> None:
    truth = json.loads(RECORDED[name].read_text()) if name in RECORDED else scene_truths()[name]
    bits = {"wh4x2": 6, "wh8": 4, "raw8": 8}
    lengths = Lengths(bits=bits[truth["bars"][0].get("profile", "wh4x2")]) if truth["bars"] else Lengths()
    (tmp_path / "frames.csv").write_text(text_of(faulty_rows(truth, lengths, 5)))
    path = tmp_path / "REC.truth.json"
    path.write_text(json.dumps(truth))
    theirs, road = (runpy.run_path(str(tool))["score"](tmp_path, path) for tool in TOOLS)
    done, reported = evlcp("score", tmp_path, path, "--json"), evlcp("score", tmp_path, path).out
    assert done.err.startswith(f"evlcp: {tmp_path}/summary.json: not there")
    mine = json.loads(done.out)
    # They know nothing of two bars in one place, and one that is cut beside one that was found is no match.
    if "restart" in name:
        return
    assert mine["road"]["unmatched"] <= road["unmatched"]
    assert mine == theirs | {"road": road | {"unmatched": mine["road"]["unmatched"]}}
    assert reported.startswith(f"rows {theirs['rows']}, matching no true frame {theirs['unmatched']}\n")
    assert f"said to be reflections {road['echoes']}\n" in reported
    if name == "covered":
        bar = road["bars"][0]
        assert theirs["bars"][0]["bit_errors"] > bar["bit_errors"] > 0
        assert min(theirs["unmatched"], mine["road"]["unmatched"], road["echoes"], bar["claimed"]) > 0
        assert f"NEES {bar['nees']}" in reported


LINKS = {
    "5 kchip/s": ({"air": {"chip_rate_hz": 5000.0}}, Lengths(rate_hz=5e3)),
    "20 kchip/s": ({"air": {"chip_rate_hz": 2e4}}, Lengths(rate_hz=2e4)),
    "32 clusters": ({"bar": {"rows": 192}}, Lengths(pilot=32)),
    "4 clusters": ({"bar": {"rows": 24}}, Lengths()),
    "wh8": ({"modulation": {"id": "wh8"}}, Lengths(bits=4)),
    "few pilots": ({"air": {"pilot_every": 4, "frames_per_packet": 20}}, Lengths(pilot_every=4)),
    "few long pilots": ({"bar": {"rows": 192}, "air": {"pilot_every": 3}}, Lengths(pilot=32, pilot_every=3)),
}


def truth_with(table: Table, lengths: Lengths, seed: int = 1) -> Table:
    """A truth of two bars by hand, of random symbols, with things that hide them."""
    link = resolve(table)
    rng = np.random.default_rng(seed)
    frames, clusters = link.air.frames_per_packet, link.codebook.clusters
    assert link.packet.packet_chips == lengths.packet(frames)
    first, chips = lengths.frames(frames)[5]
    # A frame of the first bar ends a chip before the recording does, and so was not sent whole.
    duration_s = (4 * lengths.packet(frames) + first + chips - 3.7 + 1) / lengths.rate_hz
    t_s = np.arange(0, duration_s, 1e-3)
    bars = []
    for start_chip, ppm in ((3.7, 40.0), (20.2, -25.0)):
        symbols = rng.integers(0, 2**lengths.bits, (5, frames, clusters)).tolist()
        cover = [[0.3 * duration_s, 0.4 * duration_s, 1, clusters // 2]]
        pole = [[0.7 * duration_s, 0.8 * duration_s]]
        bars.append(
            {"link": link.digest, "symbols": symbols, "start_chip": start_chip, "ppm": ppm, "led_w_m2": None}
            | {"chips_file": None, "covered": [0], "cover_s": cover, "pole_s": pole}
        )
    reported = {"table": plain({section: dict(keys) for section, keys in link.table.items()})}
    reported |= {"codebook": link.codebook.digest, "revisions": dict(link.revisions)}
    rows = np.full_like(t_s, 300.0)
    return {
        "scene": {"t0_us": 777, "duration_s": duration_s},
        "bars": bars,
        "links": {link.digest: reported},
        "t_s": t_s.tolist(),
        "distance_m": np.stack([52 - 20 * t_s, 48 - 20 * t_s]).tolist(),
        "bar_centre_px": np.stack([[600 + 100 * t_s, rows], [700 - 9 * t_s, rows]]).tolist(),
    }


DIGITS = {"rmse_m": 4, "over_half_metre": 4, "bias_m": 4, "worst_m": 3, "nees": 2, "erased": 5, "claimed": 5}


@pytest.mark.parametrize("name", LINKS)
def test_other_links_are_scored_as_plain_loops_score_them(name: str, tmp_path: Path) -> None:
    table, lengths = LINKS[name]
    truth = truth_with(table, lengths)
    rows = faulty_rows(truth, lengths, 7)
    (tmp_path / "frames.csv").write_text(text_of(rows))
    frames, known = read_frames(tmp_path), truth_from_table(truth)
    found = score_frames(frames, known)
    for mine, road in ((found, False), (found["road"], True)):
        theirs = score(rows, truth, lengths, road=road)
        assert (mine["rows"], mine["unmatched"]) == (theirs["rows"], theirs["unmatched"])
        assert len(mine["bars"]) == len(theirs["bars"]) == 2
        for bar, by_hand in zip(mine["bars"], theirs["bars"], strict=True):
            lost, errors = 0 if road else lengths.bits * by_hand["erased"], np.array(by_hand["errors"])
            assert bar["frames_sent"] == len(by_hand["sent"]) > 15
            assert bar["frames_found"] == by_hand["found"] > 10
            assert (bar["bits"], bar["bit_errors"]) == (by_hand["bits"] + lost, by_hand["wrong"] + lost)
            assert bar["bit_errors"] > 0
            assert bar["ranged"] == sum(segment["n"] for segment in bar["segments"].values()) == len(errors)
            figures = {"rmse_m": np.sqrt((errors**2).mean()), "over_half_metre": (abs(errors) >= 0.5).mean()}
            if road:
                figures |= {"bias_m": errors.mean(), "worst_m": abs(errors).max()}
                figures |= {"nees": np.mean(by_hand["nees"])}
                figures |= {"erased": by_hand["erased"] / by_hand["visible"]}
                figures |= {"claimed": by_hand["claimed"] / by_hand["hidden"]}
            wanted = {k: round(float(v), DIGITS[k]) for k, v in figures.items()}
            assert {key: bar[key] for key in figures} == wanted
    # What compare and sweep count is the road score, added up over the bars.
    counted, by_hand = statistics_of(frames, known, packets=4), score(rows, truth, lengths, road=True)
    total = counted.total()
    for name in ("rows", "unmatched", "echoes"):
        assert getattr(counted, name) == by_hand[name]
    for mine, key in ((total.bits, "bits"), (total.bit_errors, "wrong"), (total.erased, "erased")):
        assert mine == sum(bar[key] for bar in by_hand["bars"])
    own = [row for row in rows if not row["echo_of"] and row["distance_m"] and row["distance_sigma_m"]]
    sigmas_m = np.array([float(row["distance_sigma_m"]) for row in own])
    assert (counted.tasks, counted.packets, counted.stated) == (1, 4, len(own))
    assert counted.sigma_m == pytest.approx(np.sqrt((sigmas_m**2).mean()))
    assert counted.duration_us == round(truth["scene"]["duration_s"] * 1e6)
    filtered = np.concatenate([bar["filtered"] for bar in by_hand["bars"]])
    assert total.filtered == len(filtered) > 10
    assert total.filtered_rmse_m == pytest.approx(np.sqrt((filtered**2).mean()))
    # A scene without bars has only ghosts.
    none = statistics_of(frames, replace(known, bars=()))
    assert (none.unmatched, none.segments) == (none.rows - none.echoes, {})


def test_of_two_bars_in_one_place_the_one_that_shows_is_meant() -> None:
    """Also by the plain score, and a frame that the change cuts is none that was not sent."""
    old, new = BarSpec(pole_s=((0.1, 1.0),)), BarSpec(seed=3, pole_s=((0.0, 0.1),))
    truth = truth_of(Scene(bars=(old, new)))
    for t_us, number in ((50_000.0, 0), (150_000.0, 1)):
        x, y = (float(np.interp(t_us, truth.t_us, axis)) for axis in truth.bars[0].centre_px.T)
        assert find_nearest_bar(truth.bars, truth, t_us, x + 3.0, y) == (number, pytest.approx(3.0))
    rows: list[FrameRow] = []
    for bar, until_us in zip(match_frames([], truth, road=False).bars, (1e5, 1e6), strict=True):
        for t_us in bar.start_us[(bar.start_us < until_us) & (bar.start_us >= until_us - 9e5)].tolist():
            x, y = (float(np.interp(t_us, truth.t_us, axis)) for axis in truth.bars[0].centre_px.T)
            rows.append(FrameRow(0, t_us, (0,) * 16, math.nan, math.nan, math.nan, x, y))
    for road, old_ones in ((True, 28), (False, 29)):
        found = match_frames(rows, truth, road=road)
        assert (found.unmatched, *map(len, found.pairs)) == (0, old_ones, len(rows) - 29)


GOOD = ",".join(COLUMNS[:6]) + "\n"
SCENE = json.dumps(truth_of(Scene(duration_s=0.05)).table)


@pytest.mark.parametrize(
    ("frames", "truth", "summary", "code", "message"),
    [
        (None, "{}", None, 3, "frames.csv: cannot be read"),
        ("", "{}", None, 3, "frames.csv: without the columns transmitter, t_us"),
        (f"{GOOD}0,soon,1,,0,0\n", "{}", None, 3, "frames.csv: line 2: t_us = 'soon': expected a number"),
        (f"{GOOD}0,1,1 x,,0,0\n", "{}", None, 3, "frames.csv: line 2: symbols = 'x': expected a whole"),
        (f"{GOOD}0,1,1,-1e308,0,0\n", "{}", None, 3, "distance_m = '-1e308': expected at most"),
        (GOOD, "{}", None, 3, "not a scene's truth: scene: missing"),
        (GOOD, "[]", None, 3, "not a scene's truth: = []: expected a table"),
        (GOOD, "{", None, 3, "not JSON"),
        (GOOD, None, None, 3, "cannot be read"),
        (GOOD, SCENE, "{", 3, "summary.json: not JSON"),
        (GOOD, SCENE, '{"configuration": {}}', 3, "summary.json: files.frames.csv.sha256 = None: expected"),
        (GOOD, SCENE, '{"configuration": {"modulation": {"id": "gone"}}}', 2, "algorithm named 'gone'"),
    ],
)  # fmt: skip
def test_what_cannot_be_scored_is_reported_in_one_line(
    frames, truth, summary, code, message, tmp_path, evlcp
) -> None:
    for name, text in (("frames.csv", frames), ("t.json", truth), ("summary.json", summary)):
        if text is not None:
            (tmp_path / name).write_text(text)
    done = evlcp("score", tmp_path, tmp_path / "t.json")
    assert done.code == code
    assert message in done.err
    assert len(done.err.splitlines()) == 1
    assert summary is None or done.err.startswith(f"evlcp: {tmp_path}/summary.json: ")


def test_a_result_of_another_recording_is_reported(tmp_path: Path, evlcp) -> None:
    truth = scene_truths()["two"]
    (tmp_path / "frames.csv").write_text(text_of(faulty_rows(truth, Lengths(), 5)))
    (tmp_path / "own.json").write_text(json.dumps(truth))
    (tmp_path / "other.json").write_text(SCENE)
    assert "another recording's" not in evlcp("score", tmp_path, tmp_path / "own.json").err
    done = evlcp("score", tmp_path, tmp_path / "other.json")
    assert f"no row of {tmp_path} matches {tmp_path}/other.json: another recording's" in done.err
    assert "None" not in done.out


def test_a_dark_bar_and_one_of_chips_need_no_link(tmp_path: Path) -> None:
    truth = truth_with(*LINKS["5 kchip/s"])
    truth["bars"][0]["led_w_m2"] = 0.0
    truth["bars"][1] |= {"symbols": [], "chips_file": "chips.npy"}
    known = truth_from_table(truth)
    check_link(known, load_link(), "here")
    (tmp_path / "frames.csv").write_text(text_of(faulty_rows(truth_with(*LINKS["5 kchip/s"]), Lengths(5e3))))
    frames = read_frames(tmp_path)
    (bar,) = score_frames(frames, known)["bars"]
    assert (bar["frames_sent"], bar["frames_found"], bar["ber"], bar["rmse_m"]) == (0, 0, None, None)


GATE = {
    "duration_s": 0.12,
    "world": {"latitude_deg": 35.0, "longitude_deg": 137.0, "heading_deg": 70.0, "gravity_sigma_deg": 0.0},
    "motion": {"distance_m": 45.0, "vib_rate_rad_s": 0.0},
    "bars": [{"x_m": -2.0}, {"x_m": 2.0, "y_m": -0.5, "z_m": 4.0}],
}


def exact_packets(truth: Truth) -> list[Packet]:
    """Packets whose frames show the clusters of a scene exactly, of the last bar first."""
    scene = resolve_scene(GATE)
    path, t_us = truth.camera_path, truth.t_us
    packets = []
    for number, i in ((0, 1), (1, 0)):
        frames = []
        for f, at in enumerate(np.arange(2000.0, 110_000.0, 3200.0)):
            keys = ("latitude_deg", "longitude_deg", "height_m", "pitch_deg", "roll_deg", "heading_deg")
            here = [float(np.interp(at, t_us, path[key])) for key in keys]
            turned = Attitude(*here[3:]).rotation()
            clusters = sites_of(scene)[i].cluster_positions_m(16, LocalAxes(*here[:3]))
            points = scene.camera.project(clusters @ turned)
            shown = frame(points, 0.1, at, number, f // 10, f % 10)
            x_px, y_px = points.mean(0).tolist()
            frames.append(replace(shown, t_us=at - 800, x_px=x_px, y_px=y_px))
        parts = [tuple(frames[at : at + 10]) for at in (0, 10, 20)]
        packets += [Packet(number, p, of[0].t_us - 2600, 100.0, of, 10) for p, of in enumerate(parts)]
    return sorted(packets, key=lambda packet: packet.t_us)


@pytest.mark.parametrize("attitude", ["none", "gravity", "heading"])
def test_positions_are_held_beside_the_cameras_path(attitude: str) -> None:
    world = {**GATE["world"], "attitude": attitude}
    simulation = Simulation(resolve_scene(GATE | {"world": world}))
    truth = truth_of(simulation)
    packets = exact_packets(truth)
    # What an IMU says that is as unsure as the scene has it, and happens to be right.
    exact = resolve_scene(GATE | {"world": {**world, "heading_sigma_deg": 0.0}})
    log = attitude_log(exact, 0, simulation.path)
    if log is not None:
        log = replace(log, heading_sigma_deg=np.full(len(log.t_us), WorldSpec().heading_sigma_deg))
    tallies = tally_positions(packets, truth, load_link(), log, truth.sites)
    total = Tally.sum(tally for _, tally in tallies)
    assert {begin for begin, _ in tallies} == {40}
    if attitude == "none":
        assert (total.fixes, total.fixes_refused, total.fixes_contradicted) == (0, len(tallies), 0)
        return
    assert total.fixes >= 2
    assert total.fixes_refused == total.fixes_beyond == 0
    assert total.fixes_protected == (total.fixes if attitude == "heading" else 0)
    # Exact points: what is left is a path straight between its milliseconds, beside a sigma as small.
    assert total.position_rmse_m < 2e-3
    assert total.position_nees < 3
    # A truth 1e-4 degrees further north is 11.1 m off.
    path = truth.camera_path
    moved = replace(truth, camera_path={**path, "latitude_deg": path["latitude_deg"] + 1e-4})
    total = Tally.sum(tally for _, tally in tally_positions(packets, moved, load_link(), log, moved.sites))
    assert total.position_rmse_m == pytest.approx(11.1, abs=0.1)
    assert total.position_nees > 20
    assert total.track_rmse_m == pytest.approx(11.1, abs=0.1)
    assert total.fixes_silent == total.fixes
    assert total.fixes_beyond == total.fixes_protected
