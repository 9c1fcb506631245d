"""A bar that leans against the sensor: how much shorter it looks, and how a plumb one must lean."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel

Floats = NDArray[np.float64]

_PLUMB_DEG = 0.1
"""How far bars stand off the vertical (sigma), each way: 1.7 mm in a metre, as by a spirit level."""

_ASKEW = 4.0
"""Sigmas off the vertical in the image, 1 of 16000 by chance, beyond which a bar is not meant to be plumb."""


class BarSight(NamedTuple):
    """Where a bar is seen, and how it leans as far as the camera's attitude says so.

    Attributes:
        along: Tangent of the angle between the optical axis and the sight of the bar's middle, in the bar's
            direction in the image, from its first cluster to its last.
        across: The same at a right angle to it.
        sine: Of the lean that a plumb bar has; positive: its last cluster is nearer than its first. None
            without an attitude.
        sigma: Standard deviation of that sine.
        askew: The attitude is known, but the image shows that the bar does not stand plumb.
        magnification: How long the lens's distortion makes the bar look, in what it would be without.
        bow: What the distortion's change along the bar looks like: the sine of a lean.

    A default one is in the middle of the image, and nothing is known of its lean.
    """

    along: float = 0.0
    across: float = 0.0
    sine: float | None = None
    sigma: float = 0.0
    askew: bool = False
    magnification: float = 1.0
    bow: float = 0.0


def sight_of(
    camera: CameraModel, points_px: Floats, sigma_px: Floats, attitude: Attitude | None = None
) -> BarSight:
    """Where a bar of one column is seen; with an attitude, how it leans if it is plumb, upright or not.

    A plumb bar's direction in the image follows from pitch, roll and place. Where the bar shows another, by
    more than the sigmas explain, the attitude says nothing of its lean.

    Args:
        camera: The camera.
        points_px: Where the clusters' centres are seen, first cluster first, px, float64 (K, 2); NaN where
            unseen. With fewer than two, the sight is the default one.
        sigma_px: Their standard deviations, px, float64 (K,).
        attitude: What is known of the camera's attitude; None for nothing.
    """
    points = points_px.tolist()
    seen = [k for k, (x, y) in enumerate(points) if math.isfinite(x + y)]
    if len(seen) < 2:
        return BarSight()
    first, last = seen[0], seen[-1]
    (u0, v0), (u1, v1) = camera.direction(*points[first]), camera.direction(*points[last])
    length = math.hypot(u1 - u0, v1 - v0)
    if not length > 0:
        return BarSight()
    u, v, x, y = (u0 + u1) / 2, (v0 + v1) / 2, (u1 - u0) / length, (v1 - v0) / length
    along, across = x * u + y * v, x * v - y * u
    lens = (1.0, 0.0) if camera.is_pinhole else _lens_of(camera, np.array([[u0, v0], [u1, v1]]))
    sight = BarSight(along, across, magnification=lens[0], bow=lens[1])
    if attitude is None:
        return sight
    up = attitude.rotation()[2]
    # What a small step downward does to the sight, by the rule of the quotient.
    down_x, down_y = up[2] * u - up[0], up[2] * v - up[1]
    off_rad = math.atan2(down_x * y - down_y * x, down_x * x + down_y * y)
    # A bar may hang with its first cluster at the bottom.
    upside_down = abs(off_rad) > math.pi / 2
    off_rad = math.pi - abs(off_rad) if upside_down else abs(off_rad)
    lean_rad = math.radians(math.hypot(attitude.gravity_sigma_deg, _PLUMB_DEG))
    image_rad = math.hypot(sigma_px[first], sigma_px[last]) / (length * camera.focal_px)
    if off_rad > _ASKEW * math.hypot(lean_rad, image_rad):
        return sight._replace(askew=True)
    sine = float(-up[2] if upside_down else up[2])
    return sight._replace(sine=sine, sigma=lean_rad * math.sqrt(max(1 - sine**2, 0.0)))


def magnification_of(camera: CameraModel, points_px: Floats) -> float:
    """How large the lens's distortion makes a layout of clusters look, in what it would be without.

    Args:
        camera: The camera.
        points_px: Where the clusters' centres are seen, px, float64 (K, 2); NaN where unseen.
    """
    seen = points_px[np.isfinite(points_px).all(1)]
    if camera.is_pinhole or len(seen) < 2:
        return 1.0
    return float(np.sqrt(seen.var(0).sum() / camera.undistort(seen).var(0).sum())) / camera.focal_px


def _lens_of(camera: CameraModel, ends: Floats) -> tuple[float, float]:
    """Magnification and bow of a bar between two directions, float64 (2, 2).

    A distance by the length of a bar that looks m times as long is 1 / m of the true one. Where m grows along
    the bar, clusters lie off an even scale by half of its growth and the square of their place, as those of
    a bar do whose last cluster is nearer.
    """
    step = ends[1] - ends[0]
    length = float(np.hypot(*step))
    first, last = np.linalg.norm(camera.distort_slope(ends) @ (step / length), axis=-1) / camera.focal_px
    seen = float(np.hypot(*np.subtract(*camera.distort(ends)))) / camera.focal_px / length
    return seen, float(last - first) / (2 * length * seen)
