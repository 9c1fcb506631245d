"""Statistics of decoded frames, and of positions beside the camera's path."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.sites import LocalAxes
from evlcp_sdk.sim import (
    Simulation,
    Truth,
    resolve_scene,
    sites_of,
    truth_from_table,
    truth_of,
)
from evlcp_sdk.sim.scene import WorldSpec
from evlcp_sdk.sim.world import attitude_log, sites_said
from evlcp_sdk.study.frames import row_of_frame
from evlcp_sdk.study.measure import position_tallies, statistics_of
from evlcp_sdk.study.tally import Statistics, Tally
from evlcp_sdk.values import Frame, Packet, Range, SoftSymbols

CHIPS = 26 + 32 * 2
TRUTH = truth_from_table(
    {
        "scene": {"duration_s": 0.02, "t0_us": 1000},
        "t_s": [0.0, 0.02],
        "distance_m": [[40.002, 39.998]],
        "bar_centre_px": [[[600.0, 600.0], [300.0, 300.0]]],
        "bars": [
            {
                "profile": "wh4x2",
                "frames": 2,
                "packet_chips": CHIPS,
                "ppm": 0.0,
                "start_chip": 26.0,
                "symbols": [[[1, 2], [3, 4]], [[5, 6], [7, 8]]],
                "clusters": 2,
            }
        ],
    }
)


def frame(t_us: float, symbols: list[int], distance_m: float, x_px: float = 601.0) -> Frame:
    soft = SoftSymbols(np.array(symbols), np.zeros((len(symbols), 6), np.float32), 1.0)
    return Frame(
        transmitter=0,
        packet=0,
        frame=0,
        t_us=t_us + 1000,
        soft=soft,
        range=Range(distance_m, 0.1, 3),
        filtered=None,
        x_px=x_px,
        y_px=301.0,
    )


def test_each_frame_is_held_beside_the_sent_one() -> None:
    frames = [
        frame(20, [1, 2], 40.5),
        frame(3200, [3, 5], float("nan")),
        frame(3300, [3, 4], 40.0),
        frame(9050, [5, 6], 39.9, x_px=700.0),
        frame(9050, [5, 7], 39.9),
    ]
    found = statistics_of(map(row_of_frame, frames), TRUTH, events=123, packets=4)
    assert (found.tasks, found.events, found.duration_us, found.unmatched) == (1, 123, 20_000, 2)
    assert (found.rows, found.packets, found.stated) == (5, 4, 4)
    assert found.sigma_m == pytest.approx(0.1)
    (near, at_30), (far, at_40) = found.segments.items()
    assert (near, far) == (30, 40)
    # Frames begin at 0, 3.2, 9 and 12.2 ms; the bar is 40 m away at 10 ms.
    assert (at_40.frames_sent, at_40.frames_found, at_40.bits, at_40.bit_errors) == (3, 3, 36, 2)
    assert (at_40.ranged, at_40.gross) == (2, 0)
    assert (at_30.frames_sent, at_30.frames_found) == (1, 0)
    assert at_40.bias_m == pytest.approx(((40.5 - 40.00184) + (39.9 - 40.00004)) / 2, abs=1e-4)


def test_a_scene_without_bars_has_only_ghosts() -> None:
    found = statistics_of([row_of_frame(frame(20, [1, 2], float("nan")))], replace(TRUTH, bars=()))
    assert found == Statistics(tasks=1, duration_us=20_000, rows=1, unmatched=1)


GATE = {
    "duration_s": 0.12,
    "world": {"latitude_deg": 35.0, "longitude_deg": 137.0, "heading_deg": 70.0, "gravity_sigma_deg": 0.0},
    "motion": {"distance_m": 45.0, "vib_rate_rad_s": 0.0},
    "bars": [{"x_m": -2.0}, {"x_m": 2.0, "y_m": -0.5, "z_m": 4.0}],
}


def seen(truth: Truth) -> list[Packet]:
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
            symbols = SoftSymbols(np.zeros(16, int), np.zeros((16, 6), np.float32), 1.0)
            middle = points.mean(0)
            frames.append(
                Frame(
                    transmitter=number,
                    packet=f // 10,
                    frame=f % 10,
                    t_us=at - 800,
                    soft=symbols,
                    range=Range(float("nan"), float("nan"), 0),
                    filtered=None,
                    x_px=float(middle[0]),
                    y_px=float(middle[1]),
                    points_px=points,
                    points_sigma_px=np.full(16, 0.1),
                    points_t_us=at,
                )
            )
        packets += [
            Packet(number, p, frames[10 * p].t_us - 2600, 100.0, tuple(frames[10 * p : 10 * p + 10]), 10)
            for p in range(3)
        ]
    return sorted(packets, key=lambda packet: packet.t_us)


@pytest.mark.parametrize("attitude", ["none", "gravity", "heading"])
def test_positions_are_held_beside_the_cameras_path(attitude: str) -> None:
    world = {**GATE["world"], "attitude": attitude}  # type: ignore[dict-item]
    simulation = Simulation(resolve_scene(GATE | {"world": world}))
    truth = truth_of(simulation)
    packets = seen(truth)
    # What an IMU says that is as unsure as the scene has it, and happens to be right.
    exact = resolve_scene(GATE | {"world": {**world, "heading_sigma_deg": 0.0}})
    log = attitude_log(exact, 0, simulation.path)
    if log is not None:
        log = replace(log, heading_sigma_deg=np.full(len(log.t_us), WorldSpec().heading_sigma_deg))
    tallies = position_tallies(packets, truth, load_link(), log)
    total = Tally.together(tally for _, tally in tallies)
    assert {begin for begin, _ in tallies} == {40}
    if attitude == "none":
        assert (total.fixes, total.fixes_refused) == (0, len(tallies))
        return
    assert total.fixes >= 2
    assert total.fixes_refused == 0
    # Exact points: what is left is a path straight between its milliseconds, beside a sigma as small.
    assert total.position_rmse_m < 2e-3
    assert total.position_nees < 3
    # A truth 1e-6 degrees further north is 0.111 m off.
    path = truth.camera_path
    moved = replace(truth, camera_path={**path, "latitude_deg": path["latitude_deg"] + 1e-6})
    total = Tally.together(tally for _, tally in position_tallies(packets, moved, load_link(), log))
    assert total.position_rmse_m == pytest.approx(0.111, abs=0.003)
    assert total.position_nees > 20
    assert total.track_rmse_m == pytest.approx(0.111, abs=0.003)
    assert total.fixes_silent == total.fixes


def test_faults_of_what_is_said_are_told_by_positions() -> None:
    scene = resolve_scene(GATE)
    simulation = Simulation(scene)
    truth = truth_of(simulation)
    packets = seen(truth)

    def positions(off_m: Sequence[tuple[float, float, float]] = (), **world: Any) -> Tally:
        bars = [replace(bar, site_off_m=off) for bar, off in zip(scene.bars, off_m, strict=False)]
        assert scene.world is not None
        said = replace(scene, bars=(*bars, *scene.bars[len(bars) :]), world=replace(scene.world, **world))
        log = attitude_log(said, 0, simulation.path)
        tallies = position_tallies(packets, truth, load_link(), log, sites_said(said, 0))
        return Tally.together(tally for _, tally in tallies)

    right, up = positions(), positions([(0.0, 0.0, 0.5)])
    assert right.fixes >= 2
    assert (right.fixes_contradicted, right.fixes_silent, right.fixes_protected) == (0, 0, right.fixes)
    # One of two bars: which one, nothing tells.
    assert (up.fixes, up.fixes_contradicted) == (0, right.fixes)
    # All together are another world: nothing in view contradicts it, and no level covers it.
    moved = positions([(0.0, 0.0, 9.0)] * 2)
    assert moved.fixes == moved.fixes_silent == moved.fixes_uncovered == moved.fixes_beyond == right.fixes
    # Survey errors that are stated are in the covariance.
    assert positions(survey_sigma_m=0.05).position_nees < 14.2
