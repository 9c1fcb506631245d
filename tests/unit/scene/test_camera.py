"""The camera model against closed forms and numerical inverses."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray
from scipy.optimize import approx_fprime, root

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel, CameraSigma

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


@given(st.floats(-0.25, -0.01), st.floats(0, 0.55))
def test_undistort_of_one_radial_term_is_the_root_of_a_cubic(k1: float, u: float) -> None:
    camera = CameraModel(focal_mm=4.0, k1=k1)
    seen = u + k1 * u**3
    roots = np.roots([k1, 0, 1, -seen])
    real = roots[np.abs(roots.imag) < 1e-9].real
    nearest = real[np.argmin(np.abs(real - seen))]
    pixel = np.array([640 + camera.focal_px * seen, 360.0])
    np.testing.assert_allclose(camera.undistort(pixel), [nearest, 0], atol=1e-8)


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
    np.testing.assert_allclose(BENT.project_slope(point), want, atol=2e-3)
    direction = point[:2] / z
    np.testing.assert_allclose(
        BENT.distort_slope(direction), approx_fprime(direction, BENT.distort, 1e-7), atol=2e-3
    )

    def image(values: NDArray[np.float64]) -> NDArray[np.float64]:
        other = dict(zip(CAMERA_PARAMETERS, values.tolist(), strict=True))
        other["focal_mm"] *= BENT.pitch_um / 1e3
        return dataclasses.replace(BENT, **other).distort(direction)

    here = np.array([BENT.focal_px, *(getattr(BENT, name) for name in CAMERA_PARAMETERS[1:])])
    slope = approx_fprime(here, image, 1e-6)
    np.testing.assert_allclose(BENT.parameter_slope(direction), slope, rtol=1e-4, atol=1e-3)


def test_sigmas_and_correlations_make_the_covariance() -> None:
    rng = np.random.default_rng(4)
    half = rng.normal(size=(7, 7))
    covariance = half @ half.T
    sigma = np.sqrt(np.diag(covariance)) * [1e-2, 1, 1, 1e-2, 1e-2, 1e-4, 1e-4]
    rows = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    found = CameraSigma(*sigma.tolist(), correlation=tuple(tuple(r) for r in rows.tolist()))
    root = found.root(BENT)
    assert not np.triu(root, 1).any()
    sigma[0] *= BENT.focal_px / BENT.focal_mm
    np.testing.assert_allclose(root @ root.T, rows * np.outer(sigma, sigma), rtol=1e-6)
    assert found.known
    assert not CameraSigma().known


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        (((1.0,),), "expected 7 rows of 7"),
        (tuple((1.0,) * 7 for _ in range(6)), "expected 7 rows of 7"),
        (tuple((2.0,) * 7 for _ in range(7)), "expected 1 on the diagonal"),
        (tuple(tuple(1.0 if i <= j else 0.5 for j in range(7)) for i in range(7)), "the same on both sides"),
        (
            tuple(tuple(1.0 if i == j else -0.9 for j in range(7)) for i in range(7)),
            "no direction of negative variance",
        ),
    ],
)
def test_correlations_that_are_none_are_refused(rows: tuple[tuple[float, ...], ...], says: str) -> None:
    with pytest.raises(ConfigError, match=f"camera_sigma.correlation: .*{says}"):
        CameraSigma(focal_mm=1.0, correlation=rows)


def test_undistort_of_many_points_is_that_of_each_to_the_last_bit() -> None:
    points = np.stack(np.meshgrid(np.linspace(-4000, 5000, 40), np.linspace(-3000, 3700, 40)), -1)
    together = BENT.undistort(points)
    assert 0 < np.isnan(together).sum() < together.size
    alone = [BENT.undistort(point) for point in points.reshape(-1, 2)]
    np.testing.assert_array_equal(together.reshape(-1, 2), alone)
