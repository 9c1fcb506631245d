"""Leaning bars, against a pinhole that sees their LEDs, and against the simulator's geometry."""

import math

import numpy as np
import pytest

from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.scene.lean import BarSight, foreshortening, magnification_of, sight_of

CAMERA = CameraModel()
SIGMA_PX = np.full(16, 0.1)


def seen(
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
def test_a_plumb_bar(
    pitch_deg: float, roll_deg: float, east: float, up: float, axis: tuple[float, float, float]
) -> None:
    attitude = Attitude(pitch_deg, roll_deg, 0.0)
    points, depth_m, direction = seen(attitude, east, up, axis)
    sight = sight_of(CAMERA, points, SIGMA_PX, attitude)
    assert not sight.askew
    assert sight.sine == pytest.approx(-direction[2], abs=1e-12)
    # The length in the image says the depth, once it is known how much of it the lean takes.
    spacing_px = np.hypot(*(points[-1] - points[0])) / 15
    length = foreshortening(np.array([sight.sine]), sight)[0]
    assert CAMERA.distance_m(0.06, spacing_px) * length == pytest.approx(depth_m, abs=1e-3)


def test_a_lean_beside_the_middle_counts_at_once() -> None:
    """200 px above the middle 4 degrees make 0.44 % of the distance, below it 0.05 %."""
    lean = np.array([math.sin(math.radians(4))])
    above, middle, below = (
        1 - foreshortening(lean, BarSight(px / CAMERA.focal_px))[0] for px in (-200, 0, 200)
    )
    assert (above, middle, below) == pytest.approx((0.00437, 0.00244, 0.00050), abs=1e-5)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.05, 0.0, -1.0), (-0.02, 0.0, 1.0)])
def test_a_bar_that_stands_otherwise_is_askew(axis: tuple[float, float, float]) -> None:
    attitude = Attitude(4.0, 0.0)
    points, _, _ = seen(attitude, 1.0, 0.5, axis)
    sight = sight_of(CAMERA, points, SIGMA_PX, attitude)
    assert sight.askew
    assert sight.sine is None
    # An attitude that is not sure to that extent does not tell it from a plumb one.
    if abs(axis[0]) < 0.1:
        assert sight_of(CAMERA, points, SIGMA_PX, Attitude(4.0, 0.0, gravity_sigma_deg=1.5)).sine is not None


def test_the_sigma_is_that_of_gravity_and_of_plumb_bars() -> None:
    points, _, _ = seen(Attitude(30.0, 0.0, 0.0), 0.0, 29.0, PLUMB)
    sight = sight_of(CAMERA, points, SIGMA_PX, Attitude(30.0, 0.0, gravity_sigma_deg=0.2))
    assert sight.sine == pytest.approx(0.5)
    assert sight.sigma == pytest.approx(math.radians(math.hypot(0.2, 0.1)) * math.cos(math.radians(30)))


CORNERS = [(-600.0, -320.0), (600.0, -320.0), (-600.0, 320.0), (600.0, 320.0)]


@pytest.mark.parametrize("corner", CORNERS)
@pytest.mark.parametrize("lens", [{"k1": -0.25}, {"k1": 0.3, "k2": -5.0}, {"p1": 0.01, "p2": -0.02}])
@pytest.mark.parametrize("depth_m", [20.0, 45.0])
def test_distances_and_bends_of_a_distorted_bar_are_those_of_a_pinhole(
    corner: tuple[float, float], lens: dict[str, float], depth_m: float
) -> None:
    """An even scale fitted to where boundaries are seen, as rangings do, by NumPy."""
    camera = CameraModel(**lens)
    middle = np.array([*(np.array(corner) / CAMERA.focal_px * depth_m), depth_m])
    place = np.arange(1.0, 16.0) - 8
    down = np.array([0.05, 0.998, 0.0]) / np.hypot(0.05, 0.998)
    boundaries = camera.project(middle + 0.06 * place[:, None] * down)
    clusters = camera.project(middle + 0.06 * (np.arange(16.0) - 7.5)[:, None] * down)
    axis = clusters[-1] - clusters[0]
    shown = (boundaries - clusters.mean(0)) @ axis / np.hypot(*axis)
    spacing_px, _ = np.polyfit(place, shown, 1)
    off_px = shown - np.polyval(np.polyfit(place, shown, 1), place)
    sight = sight_of(camera, clusters, SIGMA_PX)
    naive_m = camera.distance_m(0.06, spacing_px)
    assert abs(naive_m / depth_m - 1) > 4e-4
    assert naive_m * sight.magnification == pytest.approx(depth_m, rel=6e-5)
    bent, _, _ = np.polyfit(place, off_px / (spacing_px * 0.06 / depth_m), 2)
    assert sight.bow == pytest.approx(bent, abs=3e-4 + 0.03 * abs(bent))
    assert magnification_of(camera, clusters) == pytest.approx(sight.magnification, rel=1e-4)


def test_a_part_of_a_bar_has_a_sight_and_a_point_has_none() -> None:
    attitude = Attitude(4.0, 0.0)
    points, _, direction = seen(attitude, 1.0, 3.0, PLUMB)
    points[[0, 1, 2, 9]] = np.nan
    assert sight_of(CAMERA, points, SIGMA_PX, attitude).sine == pytest.approx(-direction[2])
    unknown = sight_of(CAMERA, points, SIGMA_PX)
    # 3 m above and 4 degrees up: below the middle, a metre to the right.
    assert unknown.along == pytest.approx(math.tan(math.radians(4)) - 3 / 50, abs=2e-3)
    assert abs(unknown.across) == pytest.approx(1 / 50, abs=1e-3)
    assert (unknown.sine, unknown.askew) == (None, False)
    points[4:] = np.nan
    assert sight_of(CAMERA, points, SIGMA_PX, attitude) == BarSight()
