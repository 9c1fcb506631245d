"""Distances of leaning bars by a camera that knows its attitude: sigmas that are true."""

import runpy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.sim import read_truth, truth_path
from evlcp_sdk.study.frames import read_frames
from evlcp_sdk.study.score import score_frames
from tests.conftest import ROOT

BENCHMARK = ROOT / "benchmarks" / "lean.py"
PITCHED = ROOT.parent / "shared" / "recordings" / "road" / "pitch-4deg-45m.raw"

Drive = Callable[..., dict[str, np.ndarray]]


@pytest.fixture(scope="module")
def drive() -> Drive:
    made: Drive = runpy.run_path(str(BENCHMARK))["drive"]
    return made


@pytest.mark.parametrize("distance_m", [30, 45, 60, 80])
def test_a_pitched_camera_that_knows_it_has_true_sigmas(drive: Drive, distance_m: int) -> None:
    """Off by a sigma to either side; in the middle of the image, and above it, where a lean counts more."""
    drives = [drive(distance_m, 4.0, row_px, seed, 0.1) for row_px in (0.0, -200.0) for seed in (11, 12)]
    with_it, without = (np.concatenate([d[name] for d in drives]) for name in ("with", "without"))
    assert len(with_it) > 90
    assert 0.5 < np.mean((with_it[:, 1] / with_it[:, 2]) ** 2) < 2
    assert np.mean(with_it[:, 1] ** 2) < 0.25 * np.mean(without[:, 1] ** 2)


@pytest.mark.skipif(not PITCHED.exists(), reason="needs ../shared/recordings, which users do not have")
def test_an_independent_generator_s_pitch_is_corrected(tmp_path: Path) -> None:
    """One angle for all of a drive with vibration: what the bend alone makes of it is twice as far off."""
    found = {}
    for name, attitude in (("with", Attitude(4.0, 0.0, gravity_sigma_deg=0.3)), ("without", None)):
        told = receive_to_folder(PITCHED, tmp_path / name, attitude=attitude)
        assert told["counts"]["frames_askew"] == 0
        (found[name],) = score_frames(read_frames(tmp_path / name), read_truth(truth_path(PITCHED)))["road"][
            "bars"
        ]
    assert found["with"]["rmse_m"] < 0.02 < found["without"]["rmse_m"]
    assert 0.5 < found["with"]["nees"] < 2
    assert 0.5 < found["without"]["nees"] < 2
