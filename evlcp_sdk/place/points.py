"""A bar's image points at a time between its frames."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.values import Frame

__all__ = ["points_at"]

Floats = NDArray[np.float64]


def _interpolation(t: Floats) -> Floats:
    """Weights of values at times `t` in the value at 0 of the polynomial through them (Lagrange)."""
    away = t[:, None] - t[None]
    share = -t[None] / np.where(away == 0, 1.0, away)
    np.fill_diagonal(share, 1.0)
    return np.asarray(share.prod(1))


def points_at(
    frames: Sequence[Frame], t_us: float, period_us: float, clusters: int, spec: PositionSpec
) -> tuple[Floats, Floats] | None:
    """A bar's image points at a time between its frames.

    The shape is a straight line in time through all frames within half a period, the place is interpolated
    between the frames next to the time.

    Args:
        frames: With points, in order of time.
        t_us: Camera clock, us.
        period_us: Frames within half of it, before and after, count, us.
        clusters: Clusters of a bar.
        spec: Least number of points, and the error that no averaging removes.

    Returns:
        Points, px, float64 (K, 2), and sigmas (K,); None where the bar is not seen before and after.
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
    found, sigma = np.full((clusters, 2), np.nan), np.full(clusters, np.nan)
    for k in range(clusters):
        seen = np.isfinite(shapes[:, k, 0])
        if seen.sum() < 3:
            continue
        line = np.stack([np.ones(int(seen.sum())), dt[seen]], 1)
        inverse = np.linalg.pinv(line)
        found[k] = place + (inverse @ shapes[seen, k])[0]
        drawn = math.sqrt(float((inverse[0] ** 2 * sigmas[seen, k] ** 2).sum()))
        sigma[k] = math.hypot(drawn, spec.pixel_sigma_px)
    return found, sigma
