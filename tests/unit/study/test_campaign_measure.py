"""Positions beside the camera's path."""

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
    truth_of,
)
from evlcp_sdk.sim.scene import WorldSpec
from evlcp_sdk.sim.world import attitude_log, sites_said
from evlcp_sdk.study.measure import position_tallies
from evlcp_sdk.study.tally import Tally
from evlcp_sdk.values import Packet
from tests.unit.place.place_scenes import frame

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
            shown = frame(points, 0.1, at, number, f // 10, f % 10)
            x_px, y_px = points.mean(0).tolist()
            frames.append(replace(shown, t_us=at - 800, x_px=x_px, y_px=y_px))
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
