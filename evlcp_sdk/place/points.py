"""A bar's image points interpolated between frames, and its position in the camera's axes by one frame."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.place.error_model import DEFAULT_ERRORS, EXACT_CAMERA, ErrorModel
from evlcp_sdk.place.observations import BarView
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.values import Frame

Floats = NDArray[np.float64]

_FLANK_SHARE = 0.9
"""Share of a flank's width that counts: events follow the logarithm of light, so that its foot is steep and
its top flat. Fitted to 42 simulated drives, by night and by day, with a lens's wings and without."""

_PIXEL_MEMORY_PX = 1.0
"""Distance that the image moves until the error within a pixel is a new one."""

_MIDWAY_PRODUCT = 0.5**2 * 1.5**2
"""Product of the distances of four even frames from the instant midway, in spacings: interpolation errors
grow with it. With fewer frames, at an end, an instant counts as midway."""

_SHAPE_MODES = 2
"""Modes of a bar's shape that a pose depends on, along it and across: length and tilt, and curvature."""

_NEIGHBOUR_FACTOR = 1.8
"""Ratio of the variance of a line's tilt and curvature to that of its points: errors of neighbours are
correlated. From simulated drives, by night and by day, with a lens's wings and without, turning."""

_PIXEL_FREEDOM = 3
"""Degrees of freedom of the stated error within pixels; 16 points about a line have 13."""

_MIN_ACROSS = 0.1
"""Least ratio of errors across a bar to those along it."""

_MIN_FREEDOM = 2
"""Degrees of freedom below which points do not show their errors."""

_RANK_SHARE = 1e-6
"""Share of a layout's extent below which its clusters are in line, or in a plane."""


def sampling_error_px(flank_px: float) -> float:
    """The error of a thin line's middle by its place within a pixel, rms, px.

    The mean of a profile sampled once a pixel is biased by a sine of one period a pixel. For a profile that
    falls evenly over w pixels to each side its amplitude is sin(pi w) / (pi w) cos(pi a) / pi, a the width at
    half height (the derivative of the profile's Fourier transform at one period a pixel); over all places and
    widths, a quarter of its square is the mean square.

    Args:
        flank_px: As `Frame.points_flank_px`; NaN, where it is unknown, gives 0.

    >>> [round(sampling_error_px(width), 3) for width in (0.3, 0.6, 0.9, 1.5)]
    [0.141, 0.093, 0.035, 0.0]
    """
    wide = _FLANK_SHARE * flank_px
    return float(np.sinc(wide)) / (2 * math.pi) if wide < 1 else 0.0


def _lagrange_weights(t: Floats) -> Floats:
    """Weights of values at times `t` in the value at 0 of the polynomial through them."""
    differences = t[:, None] - t[None]
    factors = -t[None] / np.where(differences == 0, 1.0, differences)
    np.fill_diagonal(factors, 1.0)
    return np.asarray(factors.prod(1))


def views_at(
    t_us: float, frames: Mapping[int, Sequence[Frame]], links: Mapping[str, Link], spec: ErrorModel
) -> dict[int, BarView]:
    """The bars that are seen at a time, by transmitter, from the frames of each, still without `enu_m`."""
    views = {}
    for number, kept in frames.items():
        link = links[kept[0].link]
        layout_m = link.bar.cluster_positions_m()
        view = interpolate_points(number, kept, t_us, link.packet.packet_us, layout_m, spec)
        if view is not None:
            views[number] = view
    return views


def interpolate_points(
    transmitter: int,
    frames: Sequence[Frame],
    t_us: float,
    period_us: float,
    layout_m: Floats,
    spec: ErrorModel,
) -> BarView | None:
    """Interpolate a bar's image points at a time between its frames.

    The shape is a straight line in time through all frames within half a period; the place is interpolated
    between the frames next to the time. Sigmas along the bar are those that the frames state, or larger where
    length and curvature scatter more, as with a late readout; the error within pixels is added as far as the
    image has not moved on. Across the bar they are the larger of the scatter of tilt and curvature and of the
    deviation from the layout, as errors that all frames share do not scatter. Errors that all points share
    are separate: the place of a thin bar within a pixel, and the timing of a moving image.

    `frames` are in order of time; `layout_m` has the clusters' places in the bar, float64 (K, 3).

    Returns:
        The view, still without `enu_m`; None where the bar is not seen both before and after.
    """
    nearby = [
        f
        for f in frames
        if abs(f.points_t_us - t_us) <= period_us / 2
        and np.isfinite(f.points_px[:, 0]).sum() >= spec.min_points
    ]
    dt = np.array([f.points_t_us - t_us for f in nearby])
    if len(nearby) < 3 or dt[0] > 0 or dt[-1] < 0:
        return None
    points = np.array([f.points_px for f in nearby])
    common = np.isfinite(points[:, :, 0]).all(0)
    if common.sum() < spec.min_points // 2:
        return None
    places = points[:, common].mean(1)
    after = int(np.searchsorted(dt, 0.0))
    next_to = slice(max(after - 2, 0), after + 2)
    weight = _lagrange_weights(dt[next_to])
    place = weight @ places[next_to]
    spacing_us = float(np.median(np.diff(dt)))
    vibration = abs(float((dt[next_to] / spacing_us).prod())) / _MIDWAY_PRODUCT if len(weight) == 4 else 1.0
    flanks = np.array([f.points_flank_px for f in nearby])
    flank_px = float(flanks[np.isfinite(flanks)].mean()) if np.isfinite(flanks).any() else math.nan
    shift_px = sampling_error_px(flank_px) * _pixel_error_share(weight, places[next_to])
    shapes = points - places[:, None]
    sigmas = np.array([f.points_sigma_px for f in nearby])
    usable = common & np.isfinite(sigmas).all(0)
    scatter_along, scatter_across = _shape_scatter(dt, shapes[:, usable], sigmas[:, usable])
    line = _line_weights(dt)
    timing_px = spec.timing_sigma_us * float(np.linalg.norm(line[1] @ places))
    pixel_px = math.hypot(spec.pixel_sigma_px * _pixel_error_share(line[0], places), timing_px)
    # Weights at `t_us` of a straight line in time through the frames that show a cluster, three or more.
    seen = np.isfinite(shapes[:, :, 0])
    count, sum_t, sum_t2 = seen.sum(0), dt @ seen, dt**2 @ seen
    determinant = np.where(count >= 3, count * sum_t2 - sum_t**2, np.nan)
    weights = np.where(seen, (sum_t2 - dt[:, None] * sum_t) / determinant, 0.0 * determinant)
    points_px = place + np.einsum("nk,nkj->kj", weights, np.where(seen[:, :, None], shapes, 0.0))
    stated = np.sqrt((weights**2 * np.where(seen, sigmas, 0.0) ** 2).sum(0))
    sigma_px = np.hypot(scatter_along * stated, pixel_px)
    stated_rms = math.sqrt(float(np.nanmean(stated**2))) if np.isfinite(stated).any() else math.nan
    along, across = math.hypot(scatter_along * stated_rms, pixel_px), 1.0
    if along > 0:
        misfit_px2, freedom = _misfit_across(points_px, layout_m)
        squares = _PIXEL_FREEDOM * pixel_px**2 + _NEIGHBOUR_FACTOR * misfit_px2
        error_px = max(scatter_across * stated_rms, math.sqrt(squares / (_PIXEL_FREEDOM + freedom)))
        across = max(math.hypot(error_px, timing_px) / along, _MIN_ACROSS if freedom else 1.0)
    stretches = [f.range.standing_m / f.range.distance_m for f in nearby if f.range.standing_m]
    return BarView(
        transmitter,
        np.empty((0, 3)),
        points_px,
        sigma_px,
        pixel_px=pixel_px,
        shift_px=shift_px,
        vibration=vibration,
        timing_px=timing_px,
        across=across,
        stretch=float(np.median(stretches)) if 2 * len(stretches) > len(nearby) else 0.0,
    )


def _misfit_across(points: Floats, layout_m: Floats) -> tuple[float, int]:
    """Sum of squared deviations of points (K, 2) across their layout (K, 3), px2, and its degrees of freedom.

    Their places across are fitted by a quadratic polynomial of the layout's, which covers tilt, rotation,
    perspective and the lens. Both are 0 where that leaves too few points.
    """
    seen = np.isfinite(points[:, 0])
    points, places = points[seen], layout_m[seen] - layout_m[seen].mean(0)
    axis = points[-1] - points[0]
    if not (axis.any() and places.any()):
        return 0.0, 0
    places = places / np.abs(places).max()
    squares = (places[:, :, None] * places[:, None]).reshape(len(places), 9)
    terms = np.concatenate([np.ones((len(places), 1)), places, squares], 1)
    modes, size, _ = np.linalg.svd(terms, full_matrices=False)
    modes = modes[:, size > _RANK_SHARE * size[0]]
    freedom = len(places) - modes.shape[1]
    if freedom < _MIN_FREEDOM:
        return 0.0, 0
    across = points @ np.array([-axis[1], axis[0]]) / np.linalg.norm(axis)
    residual = across - modes @ (modes.T @ across)
    return float(residual @ residual), freedom


def _line_weights(t: Floats) -> Floats:
    """Weights of values at times `t` in a fitted line's value at 0 and its slope, float64 (2, n)."""
    return np.asarray(np.linalg.pinv(np.stack([np.ones(len(t)), t], 1)))


def _pixel_error_share(weight: Floats, places: Floats) -> float:
    """Share of the error within pixels that is left in a weighted sum of frames with the bar at `places`."""
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
    return math.sqrt(min(float(weight @ np.exp(-distance / _PIXEL_MEMORY_PX) @ weight), 1.0))


def _shape_scatter(t: Floats, shapes: Floats, sigma: Floats) -> tuple[float, float]:
    """Scatter of a bar's shape about a straight line in time, along and across the bar, in stated sigmas.

    It is that of the shape's linear and quadratic terms, on which a pose depends and which hold what
    neighbouring points err by together. Along the bar it is at least 1; across, it may be less, as a line is
    seen better than its divisions. `t` are times, (n,), `shapes` points about their mean, px, (n, k, 2), and
    `sigma` their stated sigmas, px, (n, k).
    """
    n, count = shapes.shape[:2]
    if count <= _SHAPE_MODES:
        return 1.0, 1.0
    line = np.stack([np.ones(n), t], 1) @ _line_weights(t)
    residual = shapes - np.einsum("nm,mjk->njk", line, shapes)
    mean = shapes.mean(0)
    axis = mean[-1] - mean[0]
    if not axis.any():
        return 1.0, 1.0
    axis = axis / np.linalg.norm(axis)
    along = mean @ axis
    modes, _ = np.linalg.qr(np.stack([np.ones(count), along, along**2], 1))
    modes = modes[:, 1:]
    expected = sigma**2 @ modes**2
    by_axis = np.stack([residual @ axis, residual @ np.array([-axis[1], axis[0]])])
    along2, across2 = (np.einsum("ank,km->anm", by_axis, modes) ** 2 / expected).sum(1) / (n - 2)
    return math.sqrt(max(float(along2.max()), 1.0)), math.sqrt(max(float(across2[0]), float(across2.mean())))


@dataclass(frozen=True, eq=False)
class BarPoint:
    """A bar's centre in the camera's axes: x right, y down, z forward.

    Attributes:
        point_m: float64 (3,), m.
        covariance_m2: Of it, float64 (3, 3).
        standing: Its part that persists over frames, as shifts of the point by one sigma of each of the
            camera's parameters and of the bar's apparent length, m, float64 (3, 8).
    """

    point_m: Floats
    covariance_m2: Floats
    standing: Floats


def locate_bar(
    frame: Frame,
    length_m: float,
    camera: CameraModel,
    sigma: CameraSigma = EXACT_CAMERA,
    spec: ErrorModel = DEFAULT_ERRORS,
) -> BarPoint | None:
    """Locate the centre of a frame's bar; None where the frame has no distance.

    The distance is along the optical axis; the bearing is that of the bar's centre in the image. Their errors
    are correlated by the focal length's; with the default `sigma` the camera is exact.
    """
    depth = frame.range.distance_m
    direction = camera.undistort(np.array([frame.x_px, frame.y_px]))
    if not (math.isfinite(depth) and math.isfinite(frame.range.sigma_m) and np.isfinite(direction).all()):
        return None
    ray = np.array([direction[0], direction[1], 1.0])
    length_px = camera.focal_px * length_m / depth
    shift_px = math.hypot(
        spec.vibration_sigma_px,
        max(
            math.hypot(spec.shared_sigma_px, sampling_error_px(frame.points_flank_px)),
            math.hypot(spec.shared_along_px, spec.shared_share * length_px),
        ),
    )
    by_image = depth * np.linalg.inv(camera.distortion_jacobian(direction))
    standing = np.zeros((3, 8))
    if sigma.is_known:
        standing[:2, :7] = -by_image @ camera.parameter_jacobian(direction)
        # With a longer lens, the same image is of a bar farther away.
        standing[:, 0] += ray * depth / camera.focal_px
        standing[:, :7] = standing[:, :7] @ sigma.covariance_root(camera)
    standing[:, 7] = ray * math.hypot(depth * spec.stretch_share, frame.range.standing_m)
    noise = np.zeros((3, 3))
    noise[:, 0] = ray * math.sqrt(max(frame.range.sigma_m**2 - frame.range.standing_m**2, 0.0))
    noise[:2, 1:] = by_image * shift_px
    return BarPoint(ray * depth, noise @ noise.T + standing @ standing.T, standing)
