"""Cramer-Rao bounds: the least errors that a frame can have.

They depend on the geometry and not on an algorithm: the sharpness of light in the image, the noise of its
pixels, and the spacing of clusters bound every decoder. Pixels have Gaussian noise of one size (Kay,
Estimation Theory, chapter 3). In a bar that is one even column of clusters, the boundaries between clusters
show where these lie.
"""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr
from scipy.stats import theilslopes

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.values import NO_RANGE, FrameView, PresenceMap, Range

Array = NDArray[np.float64]

_MIN_INFORMATION = 1e-9
"""Share of a parameter's own information below which the other parameters leave none."""

_MIN_GAIN = 0.01
"""Gain below which a fit has found no light: one event in some thirty values."""

_MAX_SCALE_ERROR = 0.2
"""Share by which a fit's scale may differ from that of the clusters' middles; beyond, it is no fit."""

_MOTION_SIGMA_PX = 3.0
"""Prior sigma of a value's deviation from steady motion."""

_VEIL_SHARE = 0.3
"""Share of the brightest column's light below which a column is veil or background."""

_BLUR_PX, _LOG_BLUR_SIGMA = 0.35, 0.5
"""Prior width of a boundary by lens and pixel, and sigma of its log: where all boundaries lie between two
pixels, they do not show it."""

_PRIOR_NOISE = 0.1
"""Noise of a row's value, in full values, that priors are weighed against."""

_MIN_FREE_SHARE = 0.1
"""Least share of a row's residual: a row that decides a parameter by itself does not show the noise."""

_MIN_BOUNDARIES = 3
"""Boundaries without which spacing, position and drift cannot be separated."""


def bar_bound(
    link: Link,
    distance_m: float,
    symbols: ArrayLike,
    *,
    blur_px: float,
    noise: float,
    columns: float = 5.0,
    gain: float = 0.8,
    shift_px: float = 0.0,
) -> float:
    """Smallest standard deviation of a bar's distance by one frame, m; infinite where no pixel shows it.

    Spacing, position, drift and gain are unknown. A row of pixels at a boundary sees light of both clusters,
    in shares that follow a normal distribution; each pixel's value is that mixture of their codes plus noise.
    Rows beyond the middles of the outermost clusters do not count.

    Args:
        link: For the camera, the bar and its codes; the bar is one even column of clusters.
        distance_m: Distance of the bar, m.
        symbols: The frame's, integers (K,).
        blur_px: Width (sigma) of a boundary in the image, px.
        noise: Standard deviation of one pixel's value, in full values.
        columns: Pixels across the bar.
        gain: Share of a full value that is seen.
        shift_px: Where the bar lies on the pixel grid, px.

    Raises:
        ConfigError: A quantity that must be positive is not, or the bar has another layout.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> round(bar_bound(load_link(), 50.0, range(16), blur_px=0.45, noise=0.3), 4)
    0.0145
    """
    for name, quantity in (("distance_m", distance_m), ("blur_px", blur_px), ("noise", noise)):
        if not quantity > 0:
            raise ConfigError(f"{name} = {quantity}: expected a positive number")
    spacing_m = link.bar.column_pitch_m
    if not spacing_m > 0:
        raise ConfigError("this Cramer-Rao bound needs one even column of two clusters or more")
    spacing = link.camera.focal_px * spacing_m / distance_m
    codes = _cluster_codes(link.codebook, np.asarray(symbols, np.int64))
    clusters, values = codes.shape
    rows = _pixels_from_middle(2 * int(spacing * clusters / 2 + 4))
    fit = np.array([spacing, shift_px, 0.0, gain, np.log(blur_px), 0.0, 0.0, 0.0])
    offset, when = np.zeros(values), _value_times(values)
    nearest = _nearest_boundaries(fit, clusters, rows, offset, when)
    _, slopes = _boundary_model(fit, codes, nearest, rows, offset, when)
    slopes = slopes[:4, _select_rows(nearest, np.ones(clusters, np.bool_))]
    sigma_px = _first_sigma(columns / noise**2 * (slopes @ slopes.T))
    return float(distance_m * sigma_px / spacing)


def _first_sigma(information: Array) -> float:
    """Standard deviation of the first parameter, with the others unknown; infinite where nothing shows it."""
    own = np.sqrt(np.maximum(np.diag(information), 0.0))
    shown = own > 0
    if not shown[0]:
        return math.inf
    scaled = information[np.ix_(shown, shown)] / np.outer(own[shown], own[shown])
    row = scaled[0, 1:]
    remaining = 1.0 - row @ np.linalg.pinv(scaled[1:, 1:], rcond=_MIN_INFORMATION) @ row
    return 1 / (own[0] * math.sqrt(remaining)) if remaining > _MIN_INFORMATION else math.inf


def _cluster_codes(codebook: Codebook, symbols: NDArray[np.int64]) -> Array:
    """Codes that each cluster sends in a frame, pilot and info, float64 (K, values)."""
    sent = codebook.codeword_edges[symbols]
    return np.concatenate([codebook.pilot_edges, sent], axis=1).astype(np.float64)


def frame_bound(link: Link, *, full_events: float = 3.0) -> Callable[[FrameView], Range]:
    """Make a function that estimates a frame's distance and, as its sigma, the frame's bound.

    Blur, gain and noise of the bound are those of the frame. Its values are fitted by the boundaries' model
    (least squares over spacing, position, drift, gain, blur, an offset between positive and negative events,
    shifts by a step's sign and by repeated values, and a motion of each value), and the residual is the
    noise: that of the rows that locate boundaries, each weighed with the square of its slope and its leverage
    on the fit. Neither truth nor any algorithm is needed. The noise is taken as Gaussian and independent;
    errors that frames share are not seen.

    Args:
        link: For the camera, the bar and its codes.
        full_events: Events of a pixel in a chip that count as a full value; more, as from hot pixels, are
            clipped.

    Returns:
        A function of what the stage `view` shows; distance and sigma are NaN where the frame shows too
        little.

    Raises:
        ConfigError: The layout is not one even column of three clusters or more.
    """
    if not (link.bar.column_pitch_m > 0 and link.bar.clusters > 2):
        raise ConfigError("the bound of a frame needs one even column of three clusters or more")
    return partial(_compute_frame_bound, link, full_events)


def _compute_frame_bound(link: Link, full_events: float, view: FrameView) -> Range:
    seen, middles = _find_middles(view.presence)
    pairs = int((seen[1:] & seen[:-1]).sum())
    if pairs < _MIN_BOUNDARIES:
        return NO_RANGE
    width, height = np.ptp(middles[seen], axis=0)
    is_upright = bool(height >= width)
    positions = middles[:, 1 if is_upright else 0]
    edges = link.codebook.edge_chips
    sums, offset = view.sums[edges], (view.offset_px[:, edges - 1] + view.offset_px[:, edges]) / 2
    light = view.presence.pixels.sum(0)
    if not is_upright:
        # A bar across the image: exchange rows and columns.
        sums, light, offset = sums.transpose(0, 2, 1), light.T, offset[::-1]
    clusters = np.flatnonzero(seen)
    tilt, left = _fit_line(light)
    spacing, first = theilslopes(positions[clusters], clusters)[:2]
    values, columns = _average_rows(sums, light, tilt, left, full_events)
    codes = _cluster_codes(link.codebook, view.soft.symbols)
    rows, row_offset = _pixels_from_middle(sums.shape[1]), offset[1]
    centre = first + spacing * (len(codes) - 1) / 2 - (sums.shape[1] - 1) / 2
    if spacing < 0:
        # A bar upside down: mirror it.
        values, row_offset, spacing, centre = values[:, ::-1], -row_offset, -spacing, -centre
    start = np.array([spacing, centre, 0.0, 0.5, np.log(_BLUR_PX), 0.0, 0.0, 0.0])
    solution = _fit_frame(start, codes, values, seen, rows, row_offset, _value_times(len(values)))
    if solution is None:
        return NO_RANGE
    fit, noise = solution
    distance_m = link.camera.distance_m(link.bar.column_pitch_m, float(fit[0]) * float(np.hypot(1.0, tilt)))
    sigma_m = bar_bound(
        link,
        distance_m,
        view.soft.symbols,
        blur_px=float(np.exp(fit[4])),
        noise=noise * float(np.sqrt(columns)),
        columns=columns,
        gain=float(fit[3]),
        shift_px=float(fit[1]),
    )
    return Range(distance_m, sigma_m, pairs) if math.isfinite(sigma_m) else NO_RANGE


def _average_rows(
    sums: NDArray[np.int16], light: NDArray[np.float32], tilt: float, left: float, full_events: float
) -> tuple[Array, float]:
    """Mean of each row's clipped sums in the chips behind edges (edges, rows); number of columns of a row.

    Columns weigh by their light beyond the veil of a lens or a halo.
    """
    row, column = np.ogrid[: sums.shape[1], : sums.shape[2]]
    columns_off = np.floor(column - (left + tilt * row) + 0.5).astype(np.int64)
    columns_off -= columns_off.min()
    counts = np.maximum(np.bincount(columns_off.ravel()), 1)
    brightness = np.bincount(columns_off.ravel(), np.maximum(light, 0).ravel()) / counts
    weight = np.maximum(brightness - _VEIL_SHARE * brightness.max(), 0.0)[columns_off]
    clipped: Array = np.clip(sums.astype(np.float64) / full_events, -1.0, 1.0)
    total = np.maximum(weight.sum(1), 1e-12)
    values: Array = (weight * clipped).sum(2) / total
    return values, float(np.median(total**2 / np.maximum((weight**2).sum(1), 1e-12)))


def _pixels_from_middle(pixels: int) -> Array:
    return np.arange(pixels, dtype=np.float64) - (pixels - 1) / 2


def _value_times(values: int) -> Array:
    return np.arange(values, dtype=np.float64) / values - 0.5


def _nearest_boundaries(
    fit: Array, clusters: int, rows: Array, offset: Array, when: Array
) -> NDArray[np.int64]:
    """The boundary that each row is nearest to in each value, int64 (values, rows); 0 and K are the ends."""
    place = (rows - (offset + fit[1] + fit[2] * when)[:, None]) / fit[0] + clusters / 2
    return np.asarray(np.clip(np.floor(place + 0.5), 0, clusters), np.int64)


def _select_rows(nearest: NDArray[np.int64], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Select rows at a boundary between two clusters that are seen, bool (values, rows)."""
    usable = np.zeros(len(seen) + 1, np.bool_)
    usable[1:-1] = seen[1:] & seen[:-1]
    return usable[nearest]


def _boundary_model(
    fit: Array, codes: Array, nearest: NDArray[np.int64], rows: Array, offset: Array, when: Array
) -> tuple[Array, Array]:
    """Expected values (values, rows), and their slopes by `fit` (8, values, rows).

    `fit` is spacing, centre, drift, gain, log of the blur, offset of the values, shift by sign and by repeat;
    boundary b between clusters b - 1 and b of K lies at spacing * (b - K / 2) from a centre that moves by
    drift within the frame, shifted by the sign of its step, and into a cluster that repeats its last value.
    """
    clusters = len(codes)
    boundary = np.clip(nearest, 1, clusters - 1)
    index = boundary - clusters / 2
    value = np.arange(codes.shape[1])[:, None]
    step = codes[boundary, value] - codes[boundary - 1, value]
    sign = np.sign(step)
    repeats = np.zeros(codes.shape)
    repeats[:, 1:] = codes[:, 1:] == codes[:, :-1]
    repeat = repeats[boundary - 1, value] - repeats[boundary, value]
    shift = fit[6] * sign + fit[7] * repeat
    width = np.exp(fit[4])
    z = (rows - (offset + fit[1] + fit[2] * when)[:, None] - fit[0] * index - shift) / width
    level = codes[boundary - 1, value] + step * ndtr(z)
    flank = fit[3] * step * np.exp(-z * z / 2) / np.sqrt(2 * np.pi) / width
    slopes = [-flank * index, -flank, -flank * when[:, None], level, -flank * z * width, np.ones_like(level)]
    return fit[3] * level + fit[5], np.stack([*slopes, -flank * sign, -flank * repeat])


def _fit_frame(
    start: Array,
    codes: Array,
    values: Array,
    seen: NDArray[np.bool_],
    rows: Array,
    offset: Array,
    when: Array,
) -> tuple[Array, float] | None:
    """Fit the model to the values; return it and the noise of the residuals, or None without a fit."""
    # Rows keep their boundary during the fit: those that might change it are far from any.
    nearest = _nearest_boundaries(start, len(codes), rows, offset, when)
    used = _select_rows(nearest, seen)
    values_of_row = np.nonzero(used)[0]
    size = len(start)
    if used.sum() <= size + len(when):
        return None

    # Priors, as further rows.
    prior_mean = np.zeros(size + len(when))
    prior_mean[4] = np.log(_BLUR_PX)
    prior_weight = np.zeros(size + len(when))
    prior_weight[4], prior_weight[size:] = _PRIOR_NOISE / _LOG_BLUR_SIGMA, _PRIOR_NOISE / _MOTION_SIGMA_PX

    def residuals(fit: Array) -> Array:
        fitted = _boundary_model(fit[:size], codes, nearest, rows, offset + fit[size:], when)[0]
        return np.concatenate([(fitted - values)[used], prior_weight * (fit - prior_mean)])

    def slopes(fit: Array) -> Array:
        jacobian = _boundary_model(fit[:size], codes, nearest, rows, offset + fit[size:], when)[1][:, used].T
        by_motion = np.where(values_of_row[:, None] == np.arange(len(when)), jacobian[:, 1:2], 0.0)
        return np.vstack([np.hstack([jacobian, by_motion]), np.diag(prior_weight)])

    scale = np.concatenate([[0.1, 1, 1, 1, 0.3, 1, 0.1, 0.1], np.full(len(when), 0.1)])
    start_fit = np.concatenate([start, np.zeros(len(when))])
    solution = least_squares(residuals, start_fit, slopes, method="lm", x_scale=scale)
    spacing, blur = solution.x[0], np.exp(solution.x[4])
    scales = abs(spacing / start[0] - 1) < _MAX_SCALE_ERROR
    if not (solution.success and solution.x[3] > _MIN_GAIN and blur < spacing and scales):
        return None
    count = int(used.sum())
    jacobian = slopes(solution.x)
    # Residuals are smaller by the rows' leverage on the fit.
    leverage = (np.linalg.qr(jacobian)[0] ** 2).sum(1)[:count]
    squares = solution.fun[:count] ** 2 / np.maximum(1 - leverage, _MIN_FREE_SHARE)
    weight = jacobian[:count, 0] ** 2
    variance = float((weight * squares).sum() / max(float(weight.sum()), 1e-300))
    if not variance > 0:
        return None
    return solution.x[:size], float(np.sqrt(variance))


def _find_middles(presence: PresenceMap) -> tuple[NDArray[np.bool_], Array]:
    """Find the clusters that are seen, bool (K,), and their middles, column and row, px, float64 (K, 2)."""
    seen: NDArray[np.bool_] = np.any(presence.selected, axis=(1, 2))
    grid = presence.grid_px
    middles = np.zeros((len(seen), 2))
    for k in np.flatnonzero(seen):
        # Medians are robust against stray cells.
        middles[k] = np.median(np.nonzero(presence.selected[k]), axis=1)[::-1] * grid + (grid - 1) / 2
    return seen, middles


def _fit_line(light: NDArray[np.float32]) -> tuple[float, float]:
    """Fit the bar's line, column over row, weighted with the light: slope and intercept."""
    weight = np.maximum(light, 0).astype(np.float64)
    row, column = np.indices(weight.shape)
    total = weight.sum()
    if not total:
        return 0.0, (weight.shape[1] - 1) / 2
    middle = (weight * row).sum() / total
    slope = (weight * (row - middle) * column).sum() / (weight * (row - middle) ** 2).sum()
    return float(slope), float((weight * column).sum() / total - slope * middle)
