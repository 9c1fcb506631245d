"""Laws of whole simulations: invariances, and a receiver that hears them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.io import read_events
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim import (
    BarSpec,
    LampSpec,
    MotionSpec,
    Simulation,
    load_scene,
    simulation,
    truth_of,
)
from evlcp_sdk.values import Events
from tests.models.truths import scene_of_truth
from tests.unit.sim.scenes import every, rows, still_scene

SHARED = Path(__file__).parents[4] / "shared" / "recordings"
SHORT = replace(load_scene("two-bars"), duration_s=0.03, lamps=(LampSpec(x_m=-1.4, y_m=-0.6, z_m=3.0),))


def test_what_is_worked_out_anew_less_often_changes_next_to_no_event(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene("drive-30kmh", {"motion.distance_m": 30.0, "duration_s": 0.04})
    simulated = Simulation(scene)
    block = simulated._prepare_block(simulated._sample_poses(), 0, 0.0, 4000.0)
    # Pixels far beside the strip are most of them and see only every second to eighth pose.
    assert set(block[0].strides.tolist()) == {1, 2, 4, 8}
    coarse = every(scene)
    monkeypatch.setattr(simulation, "_FAR_PX", ())
    monkeypatch.setattr(simulation, "_DEPTH_STEP", 0.0)
    fine = every(scene)
    assert len(coarse) == pytest.approx(len(fine), rel=1e-3)
    # By the distance from the bar, px: within four sigmas of as many events that are drawn apart.
    counts = [np.histogram(abs(one.x - np.median(one.x)), (0, 3, 6, 12, 24))[0] for one in (coarse, fine)]
    assert (abs(counts[0] - counts[1]) < 4 * np.sqrt(counts[1])).all()


def test_the_clock_shifts_all_stamps() -> None:
    a, b = every(SHORT), every(replace(SHORT, t0_us=16_770_000))
    assert (np.diff(a.t_us) >= 0).all()
    assert rows(Events(b.t_us - 16_770_000, b.x, b.y, b.p)) == rows(a)
    assert rows(every(SHORT, seed=1)) != rows(a)


def test_dark_and_passed_bars_give_nothing() -> None:
    dark = still_scene(0.02, bars=(BarSpec(led_w_m2=1e-9),))
    assert len(every(dark)) == 0
    passing = still_scene(
        0.1,
        camera=CameraModel(width=160, height=120, focal_mm=1.0),
        motion=MotionSpec(distance_m=1.2, speed_mps=30.0, yaw_deg=-50.0, vib_rate_rad_s=0.0),
    )
    events = every(passing)
    assert len(events) > 0
    # 74 ms on it is nearer than 50 cm, and behind the camera soon after; it leaves the image before.
    assert events.t_us[-1] < 74_000


def test_the_truth_counts_what_was_rendered() -> None:
    simulation = Simulation(SHORT)
    assert "events" not in truth_of(simulation).table
    events = sum(map(len, simulation.stream()))
    found = truth_of(simulation).table
    assert found["events"] == events
    assert found["signal_events"] + 30_000 > events
    assert len(found["t_s"]) == len(found["distance_m"][1]) == len(found["bar_centre_px"][1][0]) == 30
    if SHARED.exists():
        # What an independent generator writes, ours does, too.
        theirs, ours = json.loads((SHARED / "two-bars-60m-75m.truth.json").read_text()), found | {"bytes": 0}
        assert set(theirs) <= set(ours)
        assert set(theirs["scene"]) == set(ours["scene"])
        assert set(theirs["bars"][0]) | {"link", "pilot_every", "payload"} == set(ours["bars"][0])
        assert theirs["camera"] == ours["camera"]


@pytest.mark.skipif(not SHARED.exists(), reason="the recordings of ../shared are not there")
@pytest.mark.parametrize("name", ["night-50m-30kmh", "tunnel-90m-30kmh"])
def test_statistics_are_near_those_of_the_independent_recording(name: str) -> None:
    theirs = read_events(SHARED / f"{name}.raw")
    result = json.loads((SHARED / f"{name}.truth.json").read_text())
    ours = every(replace(scene_of_truth(result), duration_s=0.05), threads=2)
    rate = [len(e) / (e.t_us[-1] - e.t_us[0]) for e in (ours, theirs)]
    assert rate[0] == pytest.approx(rate[1], rel=0.15)
    assert abs(float(ours.p.mean()) - float(theirs.p.mean())) < 0.05
