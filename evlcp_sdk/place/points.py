"""A bar's image points at a time between its frames."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.values import Frame

__all__ = ["SeenPoints", "points_at"]

Floats = NDArray[np.float64]

_PIXEL_PX = 1.0
"""Way of the image on which an error within pixels becomes another one."""

_MODES = 2
"""Of a bar's shape that a pose hangs on, along it and across: how long it is and how it leans, and a bend."""


class SeenPoints(NamedTuple):
    """A bar's image points.

    Attributes:
        points_px: Column and row of each cluster, px, float64 (K, 2); NaN where it is not seen.
        sigma_px: Their standard deviations, px, float64 (K,).
        pixel_px: The part of these that is within pixels, px.
    """

    points_px: Floats
    sigma_px: Floats
    pixel_px: float


def _interpolation(t: Floats) -> Floats:
    """Weights of values at times `t` in the value at 0 of the polynomial through them (Lagrange)."""
    away = t[:, None] - t[None]
    share = -t[None] / np.where(away == 0, 1.0, away)
    np.fill_diagonal(share, 1.0)
    return np.asarray(share.prod(1))


def points_at(
    frames: Sequence[Frame], t_us: float, period_us: float, clusters: int, spec: PositionSpec
) -> SeenPoints | None:
    """A bar's image points at a time between its frames.

    The shape is a straight line in time through all frames within half a period, the place is interpolated
    between the frames next to the time. Sigmas are those that the frames state, or, where the bar's length,
    lean and bend scatter more from frame to frame, as they do where the readout is late, what these show;
    with the error within pixels, as far as the image has not moved over others.

    Args:
        frames: With points, in order of time.
        t_us: Camera clock, us.
        period_us: Frames within half of it, before and after, count, us.
        clusters: Clusters of a bar.
        spec: Least number of points, and the error within pixels.

    Returns:
        The points; None where the bar is not seen before and after.
    """
    near = [
        f
        for f in frames
        if abs(f.points_t_us - t_us) <= period_us / 2
        and np.isfinite(f.points_px[:, 0]).sum() >= spec.min_points
    ]
    dt = np.array([f.points_t_us - t_us for f in near])
    if len(near) < 3 or dt[0] > 0 or dt[-1] < 0:
        return None
    points = np.array([f.points_px for f in near])
    common = np.isfinite(points[:, :, 0]).all(0)
    if common.sum() < spec.min_points // 2:
        return None
    places = points[:, common].mean(1)
    after = int(np.searchsorted(dt, 0.0))
    beside = slice(max(after - 2, 0), after + 2)
    place = _interpolation(dt[beside]) @ places[beside]
    shapes = points - places[:, None]
    sigmas = np.array([f.points_sigma_px for f in near])
    sure = common & np.isfinite(sigmas).all(0)
    wider = _scatter(dt, shapes[:, sure], sigmas[:, sure])
    pixel_px = spec.pixel_sigma_px * _stays(dt, places)
    found, sigma = np.full((clusters, 2), np.nan), np.full(clusters, np.nan)
    for k in range(clusters):
        seen = np.isfinite(shapes[:, k, 0])
        if seen.sum() < 3:
            continue
        inverse = _line(dt[seen])
        found[k] = place + (inverse @ shapes[seen, k])[0]
        drawn = math.sqrt(float((inverse[0] ** 2 * sigmas[seen, k] ** 2).sum()))
        sigma[k] = math.hypot(wider * drawn, pixel_px)
    return SeenPoints(found, sigma, pixel_px)


def _line(t: Floats) -> Floats:
    """What gives a straight line's value at 0 and its slope from values at times `t`, float64 (2, n)."""
    return np.asarray(np.linalg.pinv(np.stack([np.ones(len(t)), t], 1)))


def _stays(t: Floats, places: Floats) -> float:
    """Share of an error within pixels that a line through frames leaves, by where the image was in each.

    It is another one where the image has moved by a pixel.
    """
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    weight = _line(t)[0]
    return math.sqrt(min(float(weight @ np.exp(-apart / _PIXEL_PX) @ weight), 1.0))


def _scatter(t: Floats, shapes: Floats, sigma: Floats) -> float:
    """By how much a bar's shape scatters more about a straight line in time than its points' sigmas say.

    Along the bar and across, its linear and square terms; what errors of neighbouring points have in common
    is in these, and nearly all that a pose hangs on. At least 1.

    Args:
        t: float64 (n,).
        shapes: Points about their mean, px, float64 (n, k, 2).
        sigma: Theirs, float64 (n, k).
    """
    n, count = shapes.shape[:2]
    if n < 3 or count <= _MODES:
        return 1.0
    course = np.stack([np.ones(n), t], 1) @ _line(t)
    rest = shapes - np.einsum("nm,mjk->njk", course, shapes)
    mean = shapes.mean(0)
    axis = mean[-1] - mean[0]
    if not axis.any():
        return 1.0
    axis = axis / np.linalg.norm(axis)
    along = mean @ axis
    modes, _ = np.linalg.qr(np.stack([np.ones(count), along, along**2], 1))
    modes = modes[:, 1:]
    said = sigma**2 @ modes**2
    turned = np.stack([rest @ axis, rest @ np.array([-axis[1], axis[0]])])
    seen = (np.einsum("ank,km->anm", turned, modes) ** 2 / said).sum(1) / (n - 2)
    return math.sqrt(max(float(seen[:, 0].max()), float(seen.mean(1).max()), 1.0))
