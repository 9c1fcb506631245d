"""The least errors that one frame can have: Cramer-Rao bounds.

They belong to the geometry of the problem and to no algorithm, so they stand here and not beside one: how
sharply light shows in the image, how noisy its pixels are, and how far clusters lie apart bound whatever
reads it. Pixels have Gaussian noise of one size (Kay, Estimation Theory, chapter 3). Of a bar, one even
column of clusters, it is the boundaries between clusters that say where they lie.
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
from evlcp_sdk.values import FrameView, PresenceMap, Range

Array = NDArray[np.float64]

_NONE = Range(math.nan, math.nan, 0)

_UNKNOWN = 1e-9
"""Share of a parameter's own information below which what others leave of it is none."""

_LEAST_GAIN = 0.01
"""Share of a full value below which a fit has found no light: one event in some thirty values."""

_MOST_OFF = 0.2
"""How far, as a share, a fit's scale may lie from that of the clusters' middles: not a fit beyond."""

_MOVES_PX = 3.0
"""How far a value's boundaries may lie from a steady motion before data must speak."""

_VEIL = 0.3
"""Share of the brightest column's light that is a veil, or beside the bar."""

_USUAL_PX, _USUALLY = 0.35, 0.5
"""Width of a boundary by lens and pixel, and how far its log may lie from that before data must speak: where
all boundaries lie between two pixels they say nothing of it."""

_NOISE = 0.1
"""Of a row's value, in full values, when that is weighed."""

_LEAST_FREE = 0.1
"""Of a row's residual; a row that decides a parameter by itself shows nothing of the noise."""

_LEAST_BOUNDARIES = 3
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

    Spacing, position, drift and gain are unknown.

    A row of pixels at a boundary sees light of both clusters, in shares that follow a normal distribution;
    each pixel's value is that mixture of their codes plus noise. Rows beyond the middles of the outermost
    clusters, which have no neighbour, do not count.

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
        ConfigError: A quantity that must be positive is not, or the bar is another layout.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> round(bar_bound(load_link(), 50.0, range(16), blur_px=0.45, noise=0.3), 4)
    0.0145
    """
    _check_positive(distance_m=distance_m, blur_px=blur_px, noise=noise)
    spacing_m = link.bar.column_pitch_m
    if not spacing_m > 0:
        raise ConfigError("this Cramer-Rao bound needs one even column of two clusters or more")
    spacing = link.camera.focal_px * spacing_m / distance_m
    codes = _codes(link.codebook, np.asarray(symbols, np.int64))
    clusters, values = codes.shape
    rows = _from_middle(2 * int(spacing * clusters / 2 + 4))
    fit = np.array([spacing, shift_px, 0.0, gain, np.log(blur_px), 0.0, 0.0, 0.0])
    offset, when = np.zeros(values), _times(values)
    nearest = _nearest(fit, clusters, rows, offset, when)
    _, slopes = _model(fit, codes, nearest, rows, offset, when)
    slopes = slopes[:4, _counts(nearest, np.ones(clusters, np.bool_))]
    sigma_px = _sigmas(columns / noise**2 * (slopes @ slopes.T))[0]
    return float(distance_m * sigma_px / spacing)


def _check_positive(**quantities: float) -> None:
    for name, quantity in quantities.items():
        if not quantity > 0:
            raise ConfigError(f"{name} = {quantity}: expected a positive number")


def _sigmas(information: Array) -> Array:
    """Standard deviation of each parameter, the others unknown, too; infinite where nothing shows it."""
    own = np.sqrt(np.maximum(np.diag(information), 0.0))
    known = own > 0
    found = np.full(len(own), np.inf)
    scaled = information[np.ix_(known, known)] / np.outer(own[known], own[known])
    for i, k in enumerate(np.flatnonzero(known)):
        others = np.delete(np.arange(len(scaled)), i)
        row = scaled[i, others]
        left = 1.0 - row @ np.linalg.pinv(scaled[np.ix_(others, others)], rcond=_UNKNOWN) @ row
        if left > _UNKNOWN:
            found[k] = 1 / (own[k] * math.sqrt(left))
    return found


def _codes(codebook: Codebook, symbols: NDArray[np.int64]) -> Array:
    """What each cluster sends in a frame, pilot and info, float64 (K, values)."""
    sent = codebook.codeword_edges[symbols]
    return np.concatenate([codebook.pilot_edges, sent], axis=1).astype(np.float64)


def frame_bound(link: Link, *, full_events: float = 3.0) -> Callable[[FrameView], Range]:
    """A function that gives, as sigma, the bound of a frame.

    Blur, gain and noise of the bound are those of the frame. Its values are fitted by the boundaries' model
    (least squares over spacing, position, drift, gain, blur, an offset between positive and negative events,
    shifts by a step's sign and by values that repeat, and a motion of each value), and what is left over
    is the noise. It is that of the rows that say where boundaries lie: each weighs with the square of its
    slope, and with the leverage that the fit has on it. Neither truth nor any algorithm is needed. The noise
    is taken as Gaussian and independent; an error that several frames share is not seen.

    Args:
        link: For the camera, the bar and its codes.
        full_events: Events of a pixel in a chip that count as a full value; more are clipped, as hot pixels
            send them.

    Returns:
        From what the receiver's stage `view` shows to the fit's distance and the bound, both NaN where the
        frame shows too little.

    Raises:
        ConfigError: The layout is not one even column of three clusters or more.
    """
    if not (link.bar.column_pitch_m > 0 and link.bar.clusters > 2):
        raise ConfigError("the bound of a frame needs one even column of three clusters or more")
    return partial(_bound_of_frame, link, full_events)


def _bound_of_frame(link: Link, full_events: float, view: FrameView) -> Range:
    seen, middles = _middles(view.presence)
    if int((seen[1:] & seen[:-1]).sum()) < _LEAST_BOUNDARIES:
        return _NONE
    wide, high = np.ptp(middles[seen], axis=0)
    upright = bool(high >= wide)
    at_row = middles[:, 1 if upright else 0]
    behind = link.codebook.edge_chips
    sums, offset = view.sums[behind], (view.offset_px[:, behind - 1] + view.offset_px[:, behind]) / 2
    light = view.presence.pixels.sum(0)
    if not upright:
        # A bar that lies across the image: exchange rows and columns.
        sums, light, offset = sums.transpose(0, 2, 1), light.T, offset[::-1]
    k = np.flatnonzero(seen)
    tilt, left = _line(light)
    spacing, first = theilslopes(at_row[k], k)[:2]
    values, columns = _row_values(sums, light, tilt, left, full_events)
    codes = _codes(link.codebook, view.soft.symbols)
    rows, down = _from_middle(sums.shape[1]), offset[1]
    centre = first + spacing * (len(codes) - 1) / 2 - (sums.shape[1] - 1) / 2
    if spacing < 0:
        # A bar upside down: mirror it.
        values, down, spacing, centre = values[:, ::-1], -down, -spacing, -centre
    start = np.array([spacing, centre, 0.0, 0.5, np.log(_USUAL_PX), 0.0, 0.0, 0.0])
    found = _fit(start, codes, values, seen, rows, down, _times(len(values)))
    if found is None:
        return _NONE
    fit, noise = found
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
    pairs = int((seen[1:] & seen[:-1]).sum())
    return Range(distance_m, sigma_m, pairs) if math.isfinite(sigma_m) else _NONE


def _row_values(
    sums: NDArray[np.int16], light: NDArray[np.float32], tilt: float, left: float, full_events: float
) -> tuple[Array, float]:
    """Mean of each row's clipped sums in the chips behind edges (edges, rows); columns of a row.

    Columns weigh by their light beyond the veil that a lens or a halo lays beside the bar.
    """
    row, column = np.ogrid[: sums.shape[1], : sums.shape[2]]
    beside = np.floor(column - (left + tilt * row) + 0.5).astype(np.int64)
    beside -= beside.min()
    many = np.maximum(np.bincount(beside.ravel()), 1)
    lit = np.bincount(beside.ravel(), np.maximum(light, 0).ravel()) / many
    weight = np.maximum(lit - _VEIL * lit.max(), 0.0)[beside]
    clipped: Array = np.clip(sums.astype(np.float64) / full_events, -1.0, 1.0)
    total = np.maximum(weight.sum(1), 1e-12)
    values: Array = (weight * clipped).sum(2) / total
    return values, float(np.median(total**2 / np.maximum((weight**2).sum(1), 1e-12)))


def _from_middle(pixels: int) -> Array:
    """Pixels from the image's middle, px."""
    return np.arange(pixels, dtype=np.float64) - (pixels - 1) / 2


def _times(values: int) -> Array:
    """Times of the values, from the frame's middle, in frames."""
    return np.arange(values, dtype=np.float64) / values - 0.5


def _nearest(fit: Array, clusters: int, rows: Array, offset: Array, when: Array) -> NDArray[np.int64]:
    """The boundary that each row is nearest to in each value, int64 (values, rows); 0 and K are the ends."""
    place = (rows - (offset + fit[1] + fit[2] * when)[:, None]) / fit[0] + clusters / 2
    nearest: NDArray[np.int64] = np.clip(np.floor(place + 0.5), 0, clusters).astype(np.int64)
    return nearest


def _counts(nearest: NDArray[np.int64], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Rows that count: at a boundary between two clusters that are seen, bool (values, rows)."""
    known = np.zeros(len(seen) + 1, np.bool_)
    known[1:-1] = seen[1:] & seen[:-1]
    return known[nearest]


def _model(
    fit: Array, codes: Array, nearest: NDArray[np.int64], rows: Array, offset: Array, when: Array
) -> tuple[Array, Array]:
    """Expected values (values, rows), and their slopes by `fit` (8, values, rows).

    `fit` is spacing, centre, drift, gain, log of the blur, offset of the values, shift by sign and by repeat;
    boundary b between clusters b - 1 and b of K lies at spacing * (b - K / 2) from a centre that moves by
    drift within the frame, shifted to one side where it steps up and to the other where it steps down, and
    into a cluster that repeats its last value.
    """
    clusters = len(codes)
    b = np.clip(nearest, 1, clusters - 1)
    apart = b - clusters / 2
    value = np.arange(codes.shape[1])[:, None]
    step = codes[b, value] - codes[b - 1, value]
    sign = np.sign(step)
    repeats = np.zeros(codes.shape)
    repeats[:, 1:] = codes[:, 1:] == codes[:, :-1]
    again = repeats[b - 1, value] - repeats[b, value]
    shift = fit[6] * sign + fit[7] * again
    width = np.exp(fit[4])
    z = (rows - (offset + fit[1] + fit[2] * when)[:, None] - fit[0] * apart - shift) / width
    level = codes[b - 1, value] + step * ndtr(z)
    steep = fit[3] * step * np.exp(-z * z / 2) / np.sqrt(2 * np.pi) / width
    slopes = [-steep * apart, -steep, -steep * when[:, None], level, -steep * z * width, np.ones_like(level)]
    return fit[3] * level + fit[5], np.stack([*slopes, -steep * sign, -steep * again])


def _fit(
    start: Array,
    codes: Array,
    values: Array,
    seen: NDArray[np.bool_],
    rows: Array,
    offset: Array,
    when: Array,
) -> tuple[Array, float] | None:
    """The model that fits the values best, and the standard deviation of what is left; None without one."""
    # Rows keep their boundary while the fit moves: those that might change it are far from any.
    nearest = _nearest(start, len(codes), rows, offset, when)
    counts = _counts(nearest, seen)
    values_of_row = np.nonzero(counts)[0]
    known = len(start)
    if counts.sum() <= known + len(when):
        return None

    # What is likely beforehand, as further rows.
    usual = np.zeros(known + len(when))
    usual[4] = np.log(_USUAL_PX)
    prior = np.zeros(known + len(when))
    prior[4], prior[known:] = _NOISE / _USUALLY, _NOISE / _MOVES_PX

    def residuals(fit: Array) -> Array:
        fitted = _model(fit[:known], codes, nearest, rows, offset + fit[known:], when)[0]
        return np.concatenate([(fitted - values)[counts], prior * (fit - usual)])

    def slopes(fit: Array) -> Array:
        by = _model(fit[:known], codes, nearest, rows, offset + fit[known:], when)[1][:, counts].T
        own = np.where(values_of_row[:, None] == np.arange(len(when)), by[:, 1:2], 0.0)
        return np.vstack([np.hstack([by, own]), np.diag(prior)])

    scale = np.concatenate([[0.1, 1, 1, 1, 0.3, 1, 0.1, 0.1], np.full(len(when), 0.1)])
    begin = np.concatenate([start, np.zeros(len(when))])
    found = least_squares(residuals, begin, slopes, method="lm", x_scale=scale)
    spacing, blur = found.x[0], np.exp(found.x[4])
    seen_well = found.x[3] > _LEAST_GAIN and blur < spacing and abs(spacing / start[0] - 1) < _MOST_OFF
    if not (found.success and seen_well):
        return None
    many = int(counts.sum())
    by = slopes(found.x)
    # What a fit leaves over is smaller where it follows: by its leverage.
    leverage = (np.linalg.qr(by)[0] ** 2).sum(1)[:many]
    left = found.fun[:many] ** 2 / np.maximum(1 - leverage, _LEAST_FREE)
    weight = by[:many, 0] ** 2
    variance = float((weight * left).sum() / max(float(weight.sum()), 1e-300))
    if not variance > 0:
        return None
    return found.x[:known], float(np.sqrt(variance))


def _middles(presence: PresenceMap) -> tuple[NDArray[np.bool_], Array]:
    """Which clusters are seen, bool (K,), and their middles, column and row, px, float64 (K, 2)."""
    seen: NDArray[np.bool_] = np.any(presence.selected, axis=(1, 2))
    grid = presence.grid_px
    middles = np.zeros((len(seen), 2))
    for k in np.flatnonzero(seen):
        # Medians are robust against stray cells.
        middles[k] = np.median(np.nonzero(presence.selected[k]), axis=1)[::-1] * grid + (grid - 1) / 2
    return seen, middles


def _line(light: NDArray[np.float32]) -> tuple[float, float]:
    """Slope and intercept of the bar's line, column over row, by least squares weighted with the light."""
    weight = np.maximum(light, 0).astype(np.float64)
    row, column = np.indices(weight.shape)
    total = weight.sum()
    if not total:
        return 0.0, (weight.shape[1] - 1) / 2
    middle = (weight * row).sum() / total
    slope = (weight * (row - middle) * column).sum() / (weight * (row - middle) ** 2).sum()
    return float(slope), float((weight * column).sum() / total - slope * middle)
