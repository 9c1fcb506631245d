"""A bar's image points at a time between its frames, and where it is in the camera's axes by one frame."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.error_model import EXACT, USUAL, ErrorModel
from evlcp_sdk.place.observations import BarView
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.values import Frame

Floats = NDArray[np.float64]

_STEEP = 0.9
"""How much of a flank counts: as events follow the logarithm of light, its foot is steep and its top flat.
Errors of 42 simulated drives, by night and by day, with a lens's wings and without, ask for this much."""

_PIXEL_PX = 1.0
"""Way of the image on which an error within pixels becomes another one."""

_MIDWAY = 0.5**2 * 1.5**2
"""Product of the distances of four even frames from the instant midway, in spacings: errors of a polynomial
through them grow with it. With fewer frames beside it, at an end, an instant counts as midway."""

_MODES = 2
"""Of a bar's shape that a pose hangs on, along it and across: how long it is and how it leans, and a bend."""

_ALIKE = 1.8
"""By how much more than its points about it a line's lean and bend vary: neighbours err alike. Of simulated
drives, by night and by day, with a lens's wings and without, turning."""

_PIXEL_WORTH = 3
"""Of how many squares the error within pixels is worth, beside the 13 that 16 points about a line show."""

_LEAST = 0.1
"""Of errors across a bar in those along it: points without an error show none."""

_FEWEST = 2
"""Degrees of freedom below which points show nothing of their errors."""

_SAME = 1e-6
"""Share of a layout's extent below which its clusters are in a line, or in a plane."""


def unseen_px(flank_px: float) -> float:
    """What the middle of a thin line is off, rms, as it does not show where in a pixel it is, px.

    The mean of a profile that is sampled once a pixel is off by a wave of one period a pixel. Of one that
    falls evenly over w pixels to each side its amplitude is sin(pi w) / (pi w) cos(pi a) / pi, a the width at
    half height (the derivative of the profile's Fourier transform at one period a pixel); over all places and
    widths, a quarter of its square is the mean square.

    Args:
        flank_px: As of `Frame.points_flank_px`; NaN, where it is not known, gives 0.

    >>> [round(unseen_px(width), 3) for width in (0.3, 0.6, 0.9, 1.5)]
    [0.141, 0.093, 0.035, 0.0]
    """
    wide = _STEEP * flank_px
    return float(np.sinc(wide)) / (2 * math.pi) if wide < 1 else 0.0


def _interpolation(t: Floats) -> Floats:
    """Weights of values at times `t` in the value at 0 of the polynomial through them (Lagrange)."""
    away = t[:, None] - t[None]
    share = -t[None] / np.where(away == 0, 1.0, away)
    np.fill_diagonal(share, 1.0)
    return np.asarray(share.prod(1))


def points_at(
    transmitter: int,
    frames: Sequence[Frame],
    t_us: float,
    period_us: float,
    layout_m: Floats,
    spec: ErrorModel,
) -> BarView | None:
    """A bar's image points at a time between its frames.

    The shape is a straight line in time through all frames within half a period, the place is interpolated
    between the frames next to the time. Sigmas along the bar are those that the frames state, or, where its
    length and bend scatter more from frame to frame, as they do where the readout is late, what these show;
    with the error within pixels, as far as the image has not moved over others. Across, they are the larger
    of how much lean and bend scatter and of how far the points are off the bar's layout, as frames that are
    wrong together do not scatter. What a thin bar's frames do not show of where in a pixel it is, is apart,
    as all points share it; so is by how much a moving image is seen early or late.

    Frames are in order of time; those within half of `period_us` before and after count. `layout_m` is where
    the bar's clusters are in it, m, float64 (K, 3).

    Returns:
        The points, of a bar that stands nowhere yet; None where it is not seen before and after.
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
    weight = _interpolation(dt[beside])
    place = weight @ places[beside]
    even_us = float(np.median(np.diff(dt)))
    between = abs(float((dt[beside] / even_us).prod())) / _MIDWAY if len(weight) == 4 else 1.0
    flanks = np.array([f.points_flank_px for f in near])
    flank_px = float(flanks[np.isfinite(flanks)].mean()) if np.isfinite(flanks).any() else math.nan
    shift_px = unseen_px(flank_px) * _left(weight, places[beside])
    shapes = points - places[:, None]
    sigmas = np.array([f.points_sigma_px for f in near])
    sure = common & np.isfinite(sigmas).all(0)
    wider, aside = _scatter(dt, shapes[:, sure], sigmas[:, sure])
    line = _line(dt)
    early_px = spec.early_sigma_us * float(np.linalg.norm(line[1] @ places))
    pixel_px = math.hypot(spec.pixel_sigma_px * _left(line[0], places), early_px)
    # A straight line in time through the frames that show a cluster, three or more: their weights in it now.
    seen = np.isfinite(shapes[:, :, 0])
    count, once, twice = seen.sum(0), dt @ seen, dt**2 @ seen
    spread = np.where(count >= 3, count * twice - once**2, np.nan)
    weights = np.where(seen, (twice - dt[:, None] * once) / spread, 0.0 * spread)
    found = place + np.einsum("nk,nkj->kj", weights, np.where(seen[:, :, None], shapes, 0.0))
    drawn = np.sqrt((weights**2 * np.where(seen, sigmas, 0.0) ** 2).sum(0))
    sigma = np.hypot(wider * drawn, pixel_px)
    usual = math.sqrt(float(np.nanmean(drawn**2))) if np.isfinite(drawn).any() else math.nan
    along, across = math.hypot(wider * usual, pixel_px), 1.0
    if along > 0:
        off_px2, many = _off(found, layout_m)
        shown = math.sqrt((_PIXEL_WORTH * pixel_px**2 + _ALIKE * off_px2) / (_PIXEL_WORTH + many))
        across = max(math.hypot(max(aside * usual, shown), early_px) / along, _LEAST if many else 1.0)
    return BarView(
        transmitter,
        np.empty((0, 3)),
        found,
        sigma,
        pixel_px=pixel_px,
        shift_px=shift_px,
        between=between,
        early_px=early_px,
        across=across,
        stretch=_stretch(near),
    )


def _stretch(frames: Sequence[Frame]) -> float:
    """By how much a bar whose image is bent looks too long, or short: a share (sigma), by the median."""
    found = [one.range.standing_m / one.range.distance_m for one in frames if one.range.standing_m]
    return float(np.median(found)) if 2 * len(found) > len(frames) else 0.0


def _off(points: Floats, layout_m: Floats) -> tuple[float, int]:
    """By how much points (K, 2) are off their layout (K, 3) across it: sum of squares, degrees of freedom.

    Their places across are fitted by a square polynomial of those in the layout, which takes in how it leans
    and turns, perspective, and the lens. Both 0 where that leaves too few to tell.
    """
    seen = np.isfinite(points[:, 0])
    points, at = points[seen], layout_m[seen] - layout_m[seen].mean(0)
    axis = points[-1] - points[0]
    if not (axis.any() and at.any()):
        return 0.0, 0
    at = at / np.abs(at).max()
    squares = (at[:, :, None] * at[:, None]).reshape(len(at), 9)
    terms = np.concatenate([np.ones((len(at), 1)), at, squares], 1)
    modes, size, _ = np.linalg.svd(terms, full_matrices=False)
    modes = modes[:, size > _SAME * size[0]]
    many = len(at) - modes.shape[1]
    if many < _FEWEST:
        return 0.0, 0
    across = points @ np.array([-axis[1], axis[0]]) / np.linalg.norm(axis)
    rest = across - modes @ (modes.T @ across)
    return float(rest @ rest), many


def _line(t: Floats) -> Floats:
    """What gives a straight line's value at 0 and its slope from values at times `t`, float64 (2, n)."""
    return np.asarray(np.linalg.pinv(np.stack([np.ones(len(t)), t], 1)))


def _left(weight: Floats, places: Floats) -> float:
    """Share of an error within pixels that a weighted sum of frames leaves, by where the image was in each.

    It is another one where the image has moved by a pixel.
    """
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    return math.sqrt(min(float(weight @ np.exp(-apart / _PIXEL_PX) @ weight), 1.0))


def _scatter(t: Floats, shapes: Floats, sigma: Floats) -> tuple[float, float]:
    """By how much a bar's shape scatters about a straight line in time, in what its points' sigmas say.

    By its linear and square terms; what errors of neighbouring points have in common is in these, and nearly
    all that a pose hangs on. Along the bar at least 1; across it, which comes second, it may be less, as a
    line is seen better than where it is parted. Of times (n,), points about their mean, px, (n, k, 2), and
    their sigmas (n, k).
    """
    n, count = shapes.shape[:2]
    if n < 3 or count <= _MODES:
        return 1.0, 1.0
    course = np.stack([np.ones(n), t], 1) @ _line(t)
    rest = shapes - np.einsum("nm,mjk->njk", course, shapes)
    mean = shapes.mean(0)
    axis = mean[-1] - mean[0]
    if not axis.any():
        return 1.0, 1.0
    axis = axis / np.linalg.norm(axis)
    along = mean @ axis
    modes, _ = np.linalg.qr(np.stack([np.ones(count), along, along**2], 1))
    modes = modes[:, 1:]
    expected = sigma**2 @ modes**2
    turned = np.stack([rest @ axis, rest @ np.array([-axis[1], axis[0]])])
    seen = (np.einsum("ank,km->anm", turned, modes) ** 2 / expected).sum(1) / (n - 2)
    return math.sqrt(max(float(seen[0].max()), 1.0)), math.sqrt(max(float(seen[1, 0]), float(seen[1].mean())))


@dataclass(frozen=True, eq=False)
class BarPoint:
    """A bar's centre in the camera's axes: x right, y down, z forward.

    Attributes:
        point_m: float64 (3,), m.
        covariance_m2: Of it, float64 (3, 3).
        standing: The part of this that stays over frames, as the point's moves by one sigma of each of the
            camera's parameters, and of how long the bar looks, m, float64 (3, 8).
    """

    point_m: Floats
    covariance_m2: Floats
    standing: Floats


def bar_point(
    frame: Frame, length_m: float, camera: CameraModel, sigma: CameraSigma = EXACT, spec: ErrorModel = USUAL
) -> BarPoint | None:
    """Where the centre of a frame's bar is; None where the frame has no distance.

    The distance is that along the optical axis, with its sigma; the bearing is that of the bar's centre in
    the image. They err together where the camera's focal length does; without a `sigma` the camera is exact.
    """
    depth = frame.range.distance_m
    sight = camera.undistort(np.array([frame.x_px, frame.y_px]))
    if not (math.isfinite(depth) and math.isfinite(frame.range.sigma_m) and np.isfinite(sight).all()):
        return None
    along = np.array([sight[0], sight[1], 1.0])
    grown = spec.shared_share * camera.focal_px * length_m / depth
    shift = math.hypot(
        spec.shaken_sigma_px,
        max(
            math.hypot(spec.shared_sigma_px, unseen_px(frame.points_flank_px)),
            math.hypot(spec.shared_along_px, grown),
        ),
    )
    inverse = depth * np.linalg.inv(camera.distortion_jacobian(sight))
    standing = np.zeros((3, 8))
    if sigma.is_known:
        standing[:2, :7] = -inverse @ camera.parameter_jacobian(sight)
        # A bar of so many pixels is the farther, the longer the lens.
        standing[:, 0] += along * depth / camera.focal_px
        standing[:, :7] = standing[:, :7] @ sigma.covariance_root(camera)
    standing[:, 7] = along * math.hypot(depth * spec.stretch_share, frame.range.standing_m)
    new = np.zeros((3, 3))
    new[:, 0] = along * math.sqrt(max(frame.range.sigma_m**2 - frame.range.standing_m**2, 0.0))
    new[:2, 1:] = inverse * shift
    return BarPoint(along * depth, new @ new.T + standing @ standing.T, standing)
