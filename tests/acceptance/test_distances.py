"""Distances of bars that lean, or stand in the corners of a lens that distorts: with sigmas that are true."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import evlcp_sdk as evlcp
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.sim import Simulation, load_scene, read_truth, resolve_scene, truth_of, truth_path
from evlcp_sdk.sim.world import attitude_log
from evlcp_sdk.study.frames import read_frames
from evlcp_sdk.study.score import score_frames
from tests.conftest import ROOT

PITCHED = ROOT.parent / "shared" / "recordings" / "road" / "pitch-4deg-45m.raw"
CORNER = ROOT.parent / "shared" / "recordings" / "road2" / "k1-corner-45m.raw"
LINK = load_link()
SIGMA_DEG = 0.1


def bar_of(recording, out, link, attitude=None) -> dict[str, float]:
    """The score of a recording's bar."""
    receive_to_folder(recording, out, link, attitude=attitude)
    (bar,) = score_frames(read_frames(out), read_truth(truth_path(recording)))["road"]["bars"]
    return bar


def drive(distance_m: float, row_px: float, seed: int) -> list[np.ndarray]:
    """Errors and sigmas, (n, 2), of a camera pitched by 4 degrees: without its attitude, and with it."""
    # Attitude and bar are off to opposite sides: by one sigma of both together.
    off_deg = math.copysign(SIGMA_DEG / math.sqrt(2), seed % 2 - 0.5)
    up = math.radians(4.0) - math.atan(row_px / LINK.camera.focal_px)
    scene = resolve_scene(
        {
            "duration_s": 0.1,
            "motion": {"distance_m": distance_m, "pitch_deg": 4.0},
            "background": {"light_w_m2": 0.3},
            "world": {"latitude_deg": 35.0, "gravity_sigma_deg": 0.0, "attitude": "gravity"},
            "bars": [{"x_m": -0.8, "y_m": -distance_m * math.tan(up), "tilt_deg": off_deg}],
        }
    )
    simulation = Simulation(scene, seed)
    events, truth = [*simulation.stream()], truth_of(simulation)
    true = attitude_log(scene, seed, simulation.path)
    sigma_deg = np.full(len(true.t_us), SIGMA_DEG)
    log = replace(true, pitch_deg=true.pitch_deg - off_deg, gravity_sigma_deg=sigma_deg)
    found = []
    for receiver in (Receiver(LINK), Receiver(LINK, attitude=log)):
        packets = [packet for piece in events for packet in receiver.feed(piece)] + receiver.close()
        frames = [f for p in packets for f in p.frames if math.isfinite(f.range.distance_m)]
        at_us = np.array([frame.points_t_us for frame in frames]) - truth.t0_us
        true_m = np.interp(at_us, truth.t_us, truth.bars[0].distance_m)
        errors_m = np.array([frame.range.distance_m for frame in frames]) - true_m
        found.append(np.stack([errors_m, [frame.range.sigma_m for frame in frames]], 1))
    return found


@pytest.mark.parametrize("distance_m", [30.0, 80.0])
def test_a_pitched_camera_that_knows_it_has_true_sigmas(distance_m: float) -> None:
    """Off by a sigma to either side; in the middle of the image, and above it, where a lean counts more."""
    drives = [drive(distance_m, row_px, seed) for row_px, seed in ((0.0, 11), (-200.0, 11), (-200.0, 12))]
    without, known = (np.concatenate(parts) for parts in zip(*drives, strict=True))
    assert len(known) > 60
    assert 0.5 < np.mean((known[:, 0] / known[:, 1]) ** 2) < 2
    assert np.mean(known[:, 0] ** 2) < 0.25 * np.mean(without[:, 0] ** 2)


@pytest.mark.skipif(not PITCHED.exists(), reason="needs ../shared/recordings, which users do not have")
def test_an_independent_generator_s_pitch_is_corrected(tmp_path: Path) -> None:
    """One angle for all of a drive with vibration: what the bend alone makes of it is twice as far off."""
    found = {}
    for name, attitude in (("with", Attitude(4.0, 0.0, gravity_sigma_deg=0.3)), ("without", None)):
        found[name] = bar_of(PITCHED, tmp_path / name, LINK, attitude)
        assert json.loads((tmp_path / name / "summary.json").read_text())["counts"]["frames_askew"] == 0
    assert found["with"]["rmse_m"] < 0.02 < found["without"]["rmse_m"]
    assert 0.5 < found["with"]["nees"] < 2
    assert 0.5 < found["without"]["nees"] < 2


@pytest.mark.parametrize(("x_m", "y_m"), [(-3.6, -1.6), (3.6, 1.6)])
def test_a_stated_distortion_reaches_distances_in_opposite_corners(tmp_path, x_m, y_m) -> None:
    lens = load_link(overrides=["camera.k1=-0.25"])
    keys = {"duration_s": 0.15, "motion.distance_m": 45.0, "camera.k1": -0.25}
    scene = load_scene("night", keys | {"bars.0.x_m": x_m, "bars.0.y_m": y_m}, link=lens)
    recording = tmp_path / "corner.raw"
    evlcp.simulate(scene, 3).save(recording)
    stated = bar_of(recording, tmp_path / "stated", lens)
    without = bar_of(recording, tmp_path / "without", load_link())
    assert stated["ber"] < 0.005
    assert stated["rmse_m"] < 0.035
    assert stated["nees"] < 2
    assert without["bias_m"] > 2 * abs(stated["bias_m"])


@pytest.mark.skipif(not CORNER.exists(), reason="needs ../shared/recordings, which users do not have")
def test_an_independent_generator_s_corner(tmp_path: Path) -> None:
    bar = bar_of(CORNER, tmp_path / "out", load_link(overrides=["camera.k1=-0.25"]))
    assert bar["frames_found"] == bar["frames_sent"]
    assert bar["bit_errors"] == 0
    assert bar["rmse_m"] < 0.025
    assert bar["nees"] < 2.5
