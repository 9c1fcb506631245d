"""A bar's point in the camera's axes: its place, and its covariance against drawn errors."""

import dataclasses
import math

import numpy as np
import pytest

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.points import bar_point
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel, CameraSigma
from evlcp_sdk.values import Frame, Range, SoftSymbols
from tests.unit.place.place_scenes import POINTS_ONLY, by_chance, square

BENT = CameraModel(focal_mm=8.0, k1=-0.2, k2=0.05, p1=1e-3, p2=-1e-3, centre_x_px=650.0, centre_y_px=350.0)
LENS = CameraSigma(0.04, 2.0, 2.0, 0.01, 0.01, 1e-4, 1e-4)
SPEC = ErrorModel(shaken_sigma_px=0.1, shared_sigma_px=0.17320508, shared_share=0.002, stretch_share=0.004)
SOFT = SoftSymbols(np.zeros(16, np.int64), np.zeros((16, 6), np.float32), 1.0)


def frame(x_px: float, y_px: float, distance_m: float, sigma_m: float) -> Frame:
    return Frame(0, 0, 0, 0.0, SOFT, Range(distance_m, sigma_m, 10), None, x_px, y_px)


def test_the_point_is_the_one_that_is_seen() -> None:
    true = np.array([3.0, -2.0, 40.0])
    x, y = BENT.project(true)
    found = bar_point(frame(x, y, 40.0, 0.1), 0.96, BENT)
    assert found is not None
    np.testing.assert_allclose(found.point_m, true, atol=1e-6)
    # The sigma of the distance is along the line of sight, not along the axis.
    along = true / 40.0
    spec = dataclasses.replace(POINTS_ONLY, stretch_share=0.001)
    exact = bar_point(frame(x, y, 40.0, 0.1), 0.96, BENT, None, spec)
    assert exact is not None
    stretched = 0.1**2 + (40 * 0.001) ** 2
    np.testing.assert_allclose(exact.covariance_m2, stretched * np.outer(along, along), atol=1e-9)


def test_every_error_is_in_its_covariance() -> None:
    rng = np.random.default_rng(3)
    true, squares = np.array([3.0, -2.0, 25.0]), []
    for _ in range(400):
        root = LENS.root(BENT)
        off = root @ rng.normal(size=7)
        values = {
            name: getattr(BENT, name) + v for name, v in zip(CAMERA_PARAMETERS[1:], off[1:], strict=True)
        }
        lens = dataclasses.replace(BENT, focal_mm=BENT.focal_mm * (1 + off[0] / BENT.focal_px), **values)
        shift = math.hypot(0.2, 0.002 * BENT.focal_px * 0.96 / 25)
        x, y = lens.project(true) + rng.normal(0, shift, 2)
        # By its length in the image a bar is the farther, the longer the lens is said to be.
        distance = 25 * BENT.focal_px / lens.focal_px * (1 + 0.004 * rng.normal()) + 0.15 * rng.normal()
        found = bar_point(frame(x, y, distance, 0.15), 0.96, BENT, LENS, SPEC)
        assert found is not None
        squares.append(square(found.point_m - true, found.covariance_m2))
    assert by_chance(squares, 3, 0.999)
    assert np.linalg.eigvalsh(found.covariance_m2 - found.standing @ found.standing.T)[0] > 0


@pytest.mark.parametrize(("distance_m", "sigma_m"), [(math.nan, math.nan), (40.0, math.nan)])
def test_a_frame_without_a_distance_has_none(distance_m: float, sigma_m: float) -> None:
    assert bar_point(frame(640.0, 360.0, distance_m, sigma_m), 0.96, BENT) is None
