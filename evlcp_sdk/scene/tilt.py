"""A bar that tilts against the sensor: how much shorter it appears, and how a plumb bar must tilt."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel

Floats = NDArray[np.float64]

_PLUMB_DEG = 0.1
"""How far plumb bars are off the vertical in each direction (sigma): 1.7 mm in a metre, a spirit level's."""

_ASKEW_SIGMAS = 4.0
"""Sigmas off the vertical in the image, 1 of 16000 by chance, above which a bar is not meant to be plumb."""


class LineOfSight(NamedTuple):
    """The direction in which a bar is seen, and its tilt if the camera's attitude determines it.

    Attributes:
        along: Tangent of the angle between the optical axis and the direction of the bar's middle, taken
            along the bar in the image, from its first cluster to its last.
        across: The same at a right angle to the bar.
        tilt_sine: Sine of a plumb bar's tilt; positive if its last cluster is nearer than its first. None if
            the attitude is unknown or the bar is askew.
        tilt_sigma: Standard deviation of that sine.
        askew: Whether the attitude is known and the image shows that the bar is not plumb.
        magnification: The bar's apparent length, as a multiple of that without the lens's distortion.
        distortion_tilt: Sine of the tilt that the distortion's change along the bar imitates.

    By default the bar is in the middle of the image and its tilt is unknown.
    """

    along: float = 0.0
    across: float = 0.0
    tilt_sine: float | None = None
    tilt_sigma: float = 0.0
    askew: bool = False
    magnification: float = 1.0
    distortion_tilt: float = 0.0


def line_of_sight(
    camera: CameraModel, points_px: Floats, sigma_px: Floats, attitude: Attitude | None = None
) -> LineOfSight:
    """The line of sight to a bar of one column, with its tilt if the attitude is known and the bar is plumb.

    A plumb bar's direction in the image follows from pitch, roll and position. A bar whose direction differs
    by more than the sigmas explain is askew, and its tilt unknown.

    Args:
        camera: The camera.
        points_px: The clusters' centres in the image, first cluster first, px, float64 (K, 2); NaN where
            unseen. With fewer than two the result is the default.
        sigma_px: Their standard deviations, px, float64 (K,).
        attitude: The camera's attitude; None if unknown.
    """
    points = points_px.tolist()
    seen = [k for k, (x, y) in enumerate(points) if math.isfinite(x + y)]
    if len(seen) < 2:
        return LineOfSight()
    first, last = seen[0], seen[-1]
    (u0, v0), (u1, v1) = camera.direction(*points[first]), camera.direction(*points[last])
    length = math.hypot(u1 - u0, v1 - v0)
    if not length > 0:
        return LineOfSight()
    u, v, x, y = (u0 + u1) / 2, (v0 + v1) / 2, (u1 - u0) / length, (v1 - v0) / length
    along, across = x * u + y * v, x * v - y * u
    lens = (1.0, 0.0) if camera.is_pinhole else _distortion_along(camera, np.array([[u0, v0], [u1, v1]]))
    sight = LineOfSight(along, across, magnification=lens[0], distortion_tilt=lens[1])
    if attitude is None:
        return sight
    up = attitude.rotation()[2]
    # Derivative of the direction by a step downward.
    down_x, down_y = up[2] * u - up[0], up[2] * v - up[1]
    off_rad = math.atan2(down_x * y - down_y * x, down_x * x + down_y * y)
    # A bar may hang with its first cluster at the bottom.
    upside_down = abs(off_rad) > math.pi / 2
    off_rad = math.pi - abs(off_rad) if upside_down else abs(off_rad)
    tilt_rad = math.radians(math.hypot(attitude.gravity_sigma_deg, _PLUMB_DEG))
    image_rad = math.hypot(sigma_px[first], sigma_px[last]) / (length * camera.focal_px)
    if off_rad > _ASKEW_SIGMAS * math.hypot(tilt_rad, image_rad):
        return sight._replace(askew=True)
    sine = float(-up[2] if upside_down else up[2])
    return sight._replace(tilt_sine=sine, tilt_sigma=tilt_rad * math.sqrt(max(1 - sine**2, 0.0)))


def magnification_of(camera: CameraModel, points_px: Floats) -> float:
    """Apparent size of a layout of clusters, as a multiple of that without the lens's distortion.

    `points_px` are the clusters' centres in the image, px, float64 (K, 2); NaN where unseen.
    """
    seen = points_px[np.isfinite(points_px).all(1)]
    if camera.is_pinhole or len(seen) < 2:
        return 1.0
    return float(np.sqrt(seen.var(0).sum() / camera.undistort(seen).var(0).sum())) / camera.focal_px


def _distortion_along(camera: CameraModel, ends: Floats) -> tuple[float, float]:
    """Magnification and apparent tilt of a bar between two directions, float64 (2, 2), by distortion.

    The distance from the length of a bar that appears m times as long is 1 / m of the true one. If m grows
    along the bar, clusters deviate from an even scale by half of its growth times the square of their place,
    like those of a bar whose last cluster is nearer.
    """
    step = ends[1] - ends[0]
    length = float(np.hypot(*step))
    stretch_px = camera.distortion_jacobian(ends) @ (step / length)
    first, last = np.linalg.norm(stretch_px, axis=-1) / camera.focal_px
    seen = float(np.hypot(*np.subtract(*camera.distort(ends)))) / camera.focal_px / length
    return seen, float(last - first) / (2 * length * seen)
