"""The camera and its lens: where points fall, and back; and bars that lean against the sensor."""

import dataclasses
import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray
from scipy.optimize import approx_fprime, root

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.rx import _kernels
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel, CameraSigma
from evlcp_sdk.scene.tilt import LineOfSight, line_of_sight, magnification_of

BENT = CameraModel(
    focal_mm=4.0, centre_x_px=650.5, centre_y_px=340.25, k1=-0.21, k2=0.06, p1=1.1e-3, p2=-7e-4, k3=-0.004
)


def test_without_distortion_it_is_a_pinhole_with_its_axis_in_the_middle() -> None:
    camera = CameraModel()
    points = np.array([[0.0, 0.0, 50.0], [1.5, -0.5, 30.0]])
    f = 35e3 / 4.86
    want = [[640, 360], [640 + f * 1.5 / 30, 360 - f * 0.5 / 30]]
    np.testing.assert_allclose(camera.project(points), want, rtol=1e-14)
    np.testing.assert_allclose(camera.undistort(camera.project(points)), points[:, :2] / points[:, 2:])
    assert np.isnan(camera.project(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))).all()


def test_the_terms_are_those_of_opencv() -> None:
    # The formulae as OpenCV's documentation of calibrateCamera writes them.
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    k1, k2, p1, p2, k3 = BENT.k1, BENT.k2, BENT.p1, BENT.p2, BENT.k3
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xx = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yy = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    want = [BENT.focal_px * xx + 650.5, BENT.focal_px * yy + 340.25]
    np.testing.assert_allclose(BENT.project(np.array([3.0, -2.0, 10.0])), want, rtol=1e-14)


@given(st.floats(0, 1279), st.floats(0, 719))
def test_undistort_is_the_numerical_inverse(x: float, y: float) -> None:
    pixel = np.array([x, y])
    found = BENT.undistort(pixel)
    start = (pixel - BENT.centre_px) / BENT.focal_px
    solved = root(lambda d: BENT.distort(d) - pixel, start, options={"xtol": 1e-12})
    # What it reaches says more than whether it calls it a success: at a root, rounding hinders its steps.
    np.testing.assert_allclose(BENT.distort(solved.x), pixel, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found, solved.x, atol=1e-9)
    np.testing.assert_allclose(BENT.distort(found), pixel, atol=1e-6)


@pytest.mark.parametrize("camera", [CameraModel(), CameraModel(centre_x_px=611.5, centre_y_px=350.25), BENT])
def test_a_direction_is_that_of_undistort(camera: CameraModel) -> None:
    assert camera.direction(701.3, 88.8) == tuple(camera.undistort(np.array([701.3, 88.8])).tolist())


def test_a_pixel_that_no_direction_reaches_is_not_inverted() -> None:
    # u + k1 u^3 is largest at u = 1 / sqrt(3 |k1|).
    camera = CameraModel(focal_mm=2.0, k1=-1.0)
    largest = 2 / 3 / np.sqrt(3)
    pixels = 640 + camera.focal_px * largest * np.array([0.99, 1.01])
    found = camera.undistort(np.stack([pixels, [360, 360]], -1))
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()


@given(st.floats(-3, 3), st.floats(-2, 2), st.floats(5, 20))
def test_slopes_are_the_numerical_ones(x: float, y: float, z: float) -> None:
    point = np.array([x, y, z])
    want = approx_fprime(point, BENT.project, 1e-6)
    np.testing.assert_allclose(BENT.projection_jacobian(point), want, atol=2e-3)
    direction = point[:2] / z
    np.testing.assert_allclose(
        BENT.distortion_jacobian(direction), approx_fprime(direction, BENT.distort, 1e-7), atol=2e-3
    )

    def image(values: NDArray[np.float64]) -> NDArray[np.float64]:
        other = dict(zip(CAMERA_PARAMETERS, values.tolist(), strict=True))
        other["focal_mm"] *= BENT.pitch_um / 1e3
        return dataclasses.replace(BENT, **other).distort(direction)

    here = np.array([BENT.focal_px, *(getattr(BENT, name) for name in CAMERA_PARAMETERS[1:])])
    slope = approx_fprime(here, image, 1e-6)
    np.testing.assert_allclose(BENT.parameter_jacobian(direction), slope, rtol=1e-4, atol=1e-3)


def test_sigmas_and_correlations_make_the_covariance() -> None:
    rng = np.random.default_rng(4)
    half = rng.normal(size=(7, 7))
    covariance = half @ half.T
    roots = np.sqrt(np.diag(covariance))
    sigma, rows = roots * [1e-2, 1, 1, 1e-2, 1e-2, 1e-4, 1e-4], covariance / np.outer(roots, roots)
    found = CameraSigma(*sigma.tolist(), correlation=tuple(tuple(r) for r in rows.tolist()))
    root = found.covariance_root(BENT)
    assert not np.triu(root, 1).any()
    sigma[0] *= BENT.focal_px / BENT.focal_mm
    np.testing.assert_allclose(root @ root.T, rows * np.outer(sigma, sigma), rtol=1e-6)
    assert found.is_known
    assert not CameraSigma().is_known


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (np.ones((1, 1)), "expected 7 rows of 7"),
        (np.ones((6, 7)), "expected 7 rows of 7"),
        (np.full((7, 7), 2.0), "expected 1 on the diagonal"),
        (np.triu(np.ones((7, 7))), "the same on both sides"),
        (1.9 * np.eye(7) - 0.9, "no direction of"),
    ],
)
def test_correlations_that_are_none_are_refused(rows: NDArray[np.float64], message: str) -> None:
    with pytest.raises(ConfigError, match=f"camera_sigma.correlation: .*{message}"):
        CameraSigma(focal_mm=1.0, correlation=tuple(map(tuple, rows.tolist())))


CAMERA = CameraModel()
SIGMA_PX = np.full(16, 0.1)


def image_of_bar(
    attitude: Attitude, east: float, up: float, axis: tuple[float, float, float], camera: CameraModel = CAMERA
) -> tuple[np.ndarray, float, np.ndarray]:
    """Where 16 clusters of a bar are seen 50 m to the north, its depth, and its direction (camera's axes)."""
    down = np.array(axis) / np.linalg.norm(axis)
    along = 0.06 * (np.arange(16) - 7.5)
    turned = (np.array([east, 50.0, up]) + along[:, None] * down) @ attitude.rotation()
    return camera.project(turned), float(turned.mean(0)[2]), down @ attitude.rotation()


PLUMB = (0.0, 0.0, -1.0)


@pytest.mark.parametrize(("east", "up"), [(0.0, 0.0), (4.0, 2.0), (-4.0, -2.0), (0.0, -2.4)])
@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0.0, 0.0), (4.0, 0.0), (-3.0, 10.0), (2.0, -90.0)])
@pytest.mark.parametrize("axis", [PLUMB, (0.0, 0.0, 1.0)], ids=["upright", "upside-down"])
def test_a_plumb_bar(pitch_deg, roll_deg, east, up, axis) -> None:
    attitude = Attitude(pitch_deg, roll_deg, 0.0)
    points, depth_m, direction = image_of_bar(attitude, east, up, axis)
    sight = line_of_sight(CAMERA, points, SIGMA_PX, attitude)
    assert not sight.askew
    assert sight.tilt_sine == pytest.approx(-direction[2], abs=1e-12)
    # The length in the image says the depth, once it is known how much of it the lean takes.
    spacing_px = np.hypot(*(points[-1] - points[0])) / 15
    length = foreshortening(sight.tilt_sine, sight.along, sight.across)
    assert CAMERA.distance_m(0.06, spacing_px) * length == pytest.approx(depth_m, abs=1e-3)


def foreshortening(sine: float, along: float, across: float) -> float:
    """As the receiver has it: by one sine that is all that is likely."""
    return float(
        _kernels.estimate_foreshortening(np.array([sine]), np.ones(1), math.nan, 1.0, along, across)[0]
    )


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.05, 0.0, -1.0), (-0.02, 0.0, 1.0)])
def test_a_bar_that_stands_otherwise_is_askew(axis: tuple[float, float, float]) -> None:
    attitude = Attitude(4.0, 0.0)
    points, _, _ = image_of_bar(attitude, 1.0, 0.5, axis)
    sight = line_of_sight(CAMERA, points, SIGMA_PX, attitude)
    assert sight.askew
    assert sight.tilt_sine is None
    # An attitude that is not sure to that extent does not tell it from a plumb one.
    if abs(axis[0]) < 0.1:
        unsure = Attitude(4.0, 0.0, gravity_sigma_deg=1.5)
        assert line_of_sight(CAMERA, points, SIGMA_PX, unsure).tilt_sine is not None


def test_the_sigma_is_that_of_gravity_and_of_plumb_bars() -> None:
    points, _, _ = image_of_bar(Attitude(30.0, 0.0, 0.0), 0.0, 29.0, PLUMB)
    sight = line_of_sight(CAMERA, points, SIGMA_PX, Attitude(30.0, 0.0, gravity_sigma_deg=0.2))
    assert sight.tilt_sine == pytest.approx(0.5)
    assert sight.tilt_sigma == pytest.approx(math.radians(math.hypot(0.2, 0.1)) * math.cos(math.radians(30)))


@pytest.mark.parametrize("corner", list(product((-600.0, 600.0), (-320.0, 320.0))))
@pytest.mark.parametrize("lens", [{"k1": -0.25}, {"k1": 0.3, "k2": -5.0}, {"p1": 0.01, "p2": -0.02}])
@pytest.mark.parametrize("depth_m", [20.0, 45.0])
def test_distances_and_curvatures_of_a_distorted_bar_are_those_of_a_pinhole(corner, lens, depth_m) -> None:
    """An even scale fitted to where boundaries are seen, as rangings do, by NumPy."""
    camera = CameraModel(**lens)
    middle = np.array([*corner, CAMERA.focal_px]) / CAMERA.focal_px * depth_m
    place = np.arange(1.0, 16.0) - 8
    down = np.array([0.05, 0.998, 0.0]) / np.hypot(0.05, 0.998)
    boundaries, clusters = (
        camera.project(middle + 0.06 * at[:, None] * down) for at in (place, np.arange(16.0) - 7.5)
    )
    axis = clusters[-1] - clusters[0]
    shown = (boundaries - clusters.mean(0)) @ axis / np.hypot(*axis)
    spacing_px, first_px = np.polyfit(place, shown, 1)
    off_px = shown - spacing_px * place - first_px
    sight = line_of_sight(camera, clusters, SIGMA_PX)
    naive_m = camera.distance_m(0.06, spacing_px)
    assert abs(naive_m / depth_m - 1) > 4e-4
    assert naive_m * sight.magnification == pytest.approx(depth_m, rel=6e-5)
    bent, _, _ = np.polyfit(place, off_px / (spacing_px * 0.06 / depth_m), 2)
    assert sight.distortion_tilt == pytest.approx(bent, abs=3e-4 + 0.03 * abs(bent))
    assert magnification_of(camera, clusters) == pytest.approx(sight.magnification, rel=1e-4)


def test_a_part_of_a_bar_has_a_line_of_sight_and_a_point_has_none() -> None:
    attitude = Attitude(4.0, 0.0)
    points, _, direction = image_of_bar(attitude, 1.0, 3.0, PLUMB)
    points[[0, 1, 2, 9]] = np.nan
    assert line_of_sight(CAMERA, points, SIGMA_PX, attitude).tilt_sine == pytest.approx(-direction[2])
    unknown = line_of_sight(CAMERA, points, SIGMA_PX)
    # 3 m above and 4 degrees up: below the middle, a metre to the right.
    assert unknown.along == pytest.approx(math.tan(math.radians(4)) - 3 / 50, abs=2e-3)
    assert abs(unknown.across) == pytest.approx(1 / 50, abs=1e-3)
    assert (unknown.tilt_sine, unknown.askew) == (None, False)
    points[4:] = np.nan
    assert line_of_sight(CAMERA, points, SIGMA_PX, attitude) == LineOfSight()
