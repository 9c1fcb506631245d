"""The least error that a frame's distance and lean can have: Cramer-Rao bounds of the boundaries of clusters.

It belongs to the geometry of the problem and to no algorithm, so it stands here and not beside one: how
sharply a boundary of the bar shows in the image, how noisy its pixels are, and how far boundaries lie apart
bound whatever ranging there is. `frame_bound` reads these quantities from the frames of a recording. This is
of bars, one even column of clusters; `plane_bound` takes any layout.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.study.plane_bound import LEAST_GAIN, MOST_OFF, codes_of, plane_frame_bound
from evlcp_sdk.values import FrameView, PresenceMap, Range

__all__ = ["cramer_rao_sigma_m", "frame_bound", "lean_sigma_deg"]

_NONE = Range(float("nan"), float("nan"), 0)

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
"""Of a row's residual; a row that decides a parameter by itself says nothing of the noise."""

_LEAST_BOUNDARIES = 3
"""Boundaries without which spacing, position and drift cannot be separated."""

Array = NDArray[np.float64]


def cramer_rao_sigma_m(
    camera: CameraModel,
    bar: BarLayout,
    codebook: Codebook,
    distance_m: float,
    symbols: ArrayLike,
    *,
    blur_px: float,
    noise: float,
    columns: float = 5.0,
    gain: float = 0.8,
    shift_px: float = 0.0,
) -> float:
    """Smallest standard deviation of one frame's distance, m, with spacing, position, drift and gain unknown.

    A row of pixels at a boundary sees light of both clusters, in shares that follow a normal distribution;
    each pixel's value is that mixture of their codes plus Gaussian noise. The Fisher information is then the
    sum of the slopes' outer products over the noise's variance (Kay, Estimation Theory, chapter 3). Rows
    beyond the middles of the outermost clusters, which have no neighbour, do not count.

    Args:
        camera: For the spacing in the image.
        bar: One column of clusters.
        codebook: Pilots and codewords.
        distance_m: Distance of the bar, m.
        symbols: What the frame says, integers (K,).
        blur_px: Width (sigma) of a boundary in the image, px.
        noise: Standard deviation of one pixel's value, in full values.
        columns: Pixels across the bar.
        gain: Share of a full value that is seen.
        shift_px: Where the bar lies on the pixel grid, px.

    Returns:
        Infinite where no pixel sees a boundary move, as each falls between two of them and is sharp.

    Raises:
        ConfigError: A quantity that must be positive is not, or the bar is another layout.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> link = load_link()
    >>> scene = link.camera, link.bar, link.codebook, 50.0, range(16)
    >>> round(cramer_rao_sigma_m(*scene, blur_px=0.45, noise=0.3), 4)
    0.0145
    """
    slopes, spacing = _frame_slopes(
        camera, bar, codebook, distance_m, symbols, blur_px=blur_px, noise=noise, gain=gain, shift_px=shift_px
    )
    information = columns / noise**2 * (slopes[:4] @ slopes[:4].T)
    return distance_m * _least_error(information, 0) / spacing


def lean_sigma_deg(
    camera: CameraModel,
    bar: BarLayout,
    codebook: Codebook,
    distance_m: float,
    symbols: ArrayLike,
    *,
    blur_px: float,
    noise: float,
    columns: float = 5.0,
    gain: float = 0.8,
    shift_px: float = 0.0,
) -> float:
    """Smallest standard deviation of the lean by one frame, degrees, of a bar that hardly leans.

    A lean of sine s moves the boundary at place b, in spacings from the bar's middle, by b^2 s times
    spacing_px * spacing_m / distance_m pixels: a parabola, which spacing, position, drift and gain, unknown
    beside it, do not make. So the bound grows with the distance squared.

    Args:
        camera: For the spacing in the image.
        bar: One column of clusters.
        codebook: Pilots and codewords.
        distance_m: Distance of the bar, m.
        symbols: What the frame says, integers (K,).
        blur_px: Width (sigma) of a boundary in the image, px.
        noise: Standard deviation of one pixel's value, in full values.
        columns: Pixels across the bar.
        gain: Share of a full value that is seen.
        shift_px: Where the bar lies on the pixel grid, px.

    Raises:
        ConfigError: A quantity that must be positive is not, or the bar is another layout.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> link = load_link()
    >>> scene = link.camera, link.bar, link.codebook, 50.0, range(16)
    >>> round(lean_sigma_deg(*scene, blur_px=0.45, noise=0.3), 2)
    3.52
    """
    slopes, spacing = _frame_slopes(
        camera, bar, codebook, distance_m, symbols, blur_px=blur_px, noise=noise, gain=gain, shift_px=shift_px
    )
    slopes = np.stack([*slopes[:4], slopes[4] * spacing * _spacing_m(bar) / distance_m])
    information = columns / noise**2 * (slopes @ slopes.T)
    return float(np.degrees(_least_error(information, 4)))


def _least_error(information: Array, which: int) -> float:
    """Bound of one unknown, all others unknown, too; infinite where no pixel shows it."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    alike = information * np.outer(scale, scale)
    if not np.linalg.cond(alike) < 1 / np.finfo(np.float64).eps:
        return math.inf
    return float(scale[which] * np.sqrt(np.linalg.inv(alike)[which, which]))


def _frame_slopes(
    camera: CameraModel,
    bar: BarLayout,
    codebook: Codebook,
    distance_m: float,
    symbols: ArrayLike,
    *,
    blur_px: float,
    noise: float,
    gain: float,
    shift_px: float,
) -> tuple[Array, float]:
    """Slopes of a frame's values by spacing, centre, drift, gain and bend, (5, n), and the spacing, px.

    The bend is how far, in px, a boundary moves one spacing from the bar's middle, and b^2 times that at b.
    """
    for name, quantity in (("distance_m", distance_m), ("blur_px", blur_px), ("noise", noise)):
        if not quantity > 0:
            raise ConfigError(f"{name} = {quantity}: expected a positive number")
    spacing = camera.focal_px * _spacing_m(bar) / distance_m
    codes = codes_of(codebook, np.asarray(symbols, np.int64))
    clusters, values = codes.shape
    rows = _rows(2 * int(spacing * clusters / 2 + 4))
    fit = np.array([spacing, shift_px, 0.0, gain, np.log(blur_px), 0.0, 0.0, 0.0])
    offset, when = np.zeros(values), _when(values)
    nearest = _nearest(fit, clusters, rows, offset, when)
    _, slopes = _model(fit, codes, nearest, rows, offset, when)
    bend = slopes[1] * (np.clip(nearest, 1, clusters - 1) - clusters / 2) ** 2
    flat = np.concatenate([slopes[:4], bend[None]])[:, _counts(nearest, np.ones(clusters, np.bool_))]
    return flat, spacing


def frame_bound(
    camera: CameraModel, bar: BarLayout, codebook: Codebook, *, full_events: float = 3.0
) -> Callable[[FrameView], Range]:
    """A function that gives, as sigma, the bound of a frame.

    Blur, gain and noise of the bound are those of the frame: its values are fitted by the boundaries' model
    (least squares over spacing, position, drift, gain, blur, an offset between positive and negative events,
    shifts by a step's sign and by values that are repeated, and a motion of each value), and what is left
    over is the noise. It is that of the rows that say where boundaries lie: each weighs with the square of
    its slope, and with the leverage that the fit has on it. Neither truth nor any algorithm is needed. The
    noise is taken as Gaussian and independent; an error that several frames share is not seen.

    Args:
        camera: For the spacing in the image.
        bar: One even column of three clusters or more; of another layout, the bound is that of
            `plane_bound.plane_frame_bound`.
        codebook: Pilots and codewords.
        full_events: Events of a pixel in a chip that count as a full value; more are clipped, as hot pixels
            send them.

    Returns:
        From what the receiver's stage `view` shows to the fit's distance and the bound, both NaN where the
        frame shows no boundaries.

    Raises:
        ConfigError: The layout is one cluster.
    """
    if not bar.column_pitch_m > 0 or bar.clusters < 3:
        return plane_frame_bound(camera, bar, codebook, full_events=full_events)
    # It takes half a second to load, and campaigns know no frames.
    from scipy.stats import theilslopes

    spacing_m = _spacing_m(bar)

    def bound(view: FrameView) -> Range:
        place = _place(view.presence)
        if place is None:
            return _NONE
        upright, at_row, seen = place
        behind = codebook.edge_chips
        sums, offset = view.sums[behind], (view.offset_px[:, behind - 1] + view.offset_px[:, behind]) / 2
        light = view.presence.pixels.sum(0)
        if not upright:
            # A bar that lies across the image: exchange rows and columns.
            sums, light, offset = sums.transpose(0, 2, 1), light.T, offset[::-1]
        k = np.flatnonzero(seen)
        tilt, left = _line(light)
        spacing, first = theilslopes(at_row[k], k)[:2]
        values, columns = _row_values(sums, light, tilt, left, full_events)
        codes = codes_of(codebook, view.soft.symbols)
        rows, down = _rows(sums.shape[1]), offset[1]
        centre = first + spacing * (len(codes) - 1) / 2 - (sums.shape[1] - 1) / 2
        if spacing < 0:
            # A bar upside down: mirror it.
            values, down, spacing, centre = values[:, ::-1], -down, -spacing, -centre
        start = np.array([spacing, centre, 0.0, 0.5, np.log(_USUAL_PX), 0.0, 0.0, 0.0])
        found = _fit(start, codes, values, seen, rows, down, _when(len(values)))
        if found is None:
            return _NONE
        fit, noise = found
        distance_m = camera.distance_m(spacing_m, float(fit[0]) * float(np.hypot(1.0, tilt)))
        sigma_m = cramer_rao_sigma_m(
            camera,
            bar,
            codebook,
            distance_m,
            view.soft.symbols,
            blur_px=float(np.exp(fit[4])),
            noise=noise * float(np.sqrt(columns)),
            columns=columns,
            gain=float(fit[3]),
            shift_px=float(fit[1]),
        )
        if not math.isfinite(sigma_m):
            return _NONE
        return Range(distance_m, sigma_m, int((seen[1:] & seen[:-1]).sum()))

    return bound


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


def _spacing_m(bar: BarLayout) -> float:
    """Distance of neighbouring clusters, m."""
    if not bar.column_pitch_m > 0:
        raise ConfigError(
            "this Cramer-Rao bound needs one even column of two clusters or more; layout_bound takes any"
        )
    return bar.column_pitch_m


def _rows(height: int) -> Array:
    """Rows from the image's middle, px."""
    return np.arange(height, dtype=np.float64) - (height - 1) / 2


def _when(values: int) -> Array:
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
    seen_well = found.x[3] > LEAST_GAIN and blur < spacing and abs(spacing / start[0] - 1) < MOST_OFF
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


def _place(presence: PresenceMap) -> tuple[bool, Array, NDArray[np.bool_]] | None:
    """How a bar lies: upright or not, the clusters' middles along it, which are seen.

    None where too few clusters are seen.
    """
    selected, grid = presence.selected, presence.grid_px
    seen: NDArray[np.bool_] = np.any(selected.reshape(len(selected), -1), axis=1)
    if int((seen[1:] & seen[:-1]).sum()) < _LEAST_BOUNDARIES:
        return None
    middle = np.zeros((2, len(selected)))
    for k in np.flatnonzero(seen):
        # Medians are robust against stray cells.
        middle[:, k] = np.median(np.nonzero(selected[k]), axis=1) * grid + (grid - 1) / 2
    upright = bool(np.ptp(middle[0][seen]) >= np.ptp(middle[1][seen]))
    return upright, middle[0 if upright else 1], seen


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
