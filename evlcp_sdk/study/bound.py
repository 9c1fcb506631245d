"""The least error that a frame's distance and lean can have: Cramer-Rao bounds of the boundaries of clusters.

It belongs to the geometry of the problem and to no algorithm, so it stands here and not beside one: how
sharply a boundary of the bar shows in the image, how noisy its pixels are, and how far boundaries lie apart
bound whatever ranging there is. `frame_bound` reads these quantities from the frames of a recording. This is
of bars, one even column of clusters; `plane_bound` takes any layout.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr
from scipy.stats import theilslopes

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.study.plane_bound import LEAST_GAIN, MOST_OFF, codes_of, plane_frame_bound
from evlcp_sdk.values import FrameView, PresenceMap, Range

__all__ = ["cramer_rao_sigma_m", "frame_bound", "lean_sigma_deg"]

_NONE = Range(float("nan"), float("nan"), 0)

_CORE_SHARE = 0.3
"""Of the rows of the widest column: columns lit in fewer show stray cells beside the bar."""

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
    return float(distance_m * np.sqrt(np.linalg.inv(information)[0, 0]) / spacing)


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
    return float(np.degrees(np.sqrt(np.linalg.inv(information)[4, 4])))


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
    fit = np.array([spacing, shift_px, 0.0, gain, blur_px, 0.0])
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
    (least squares over spacing, position, drift, gain, blur and an offset between positive and negative
    events), and what is left over is the noise. Neither truth nor any algorithm is needed. The noise is taken
    as Gaussian and alike in all pixels, and the pixels of a row weigh alike; an error that several frames
    share is not seen.

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
    spacing_m = _spacing_m(bar)

    def bound(view: FrameView) -> Range:
        place = _place(view.presence)
        if place is None:
            return _NONE
        upright, at_row, seen, width = place
        behind = codebook.edge_chips
        sums, offset = view.sums[behind], (view.offset_px[:, behind - 1] + view.offset_px[:, behind]) / 2
        light = view.presence.pixels.sum(0)
        if not upright:
            # A bar that lies across the image: exchange rows and columns.
            sums, light, offset = sums.transpose(0, 2, 1), light.T, offset[::-1]
        k = np.flatnonzero(seen)
        tilt, left = _line(light)
        spacing, first = theilslopes(at_row[k], k)[:2]
        values, columns = _row_values(sums, tilt, left, width / 2, full_events)
        codes = codes_of(codebook, view.soft.symbols)
        rows, down = _rows(sums.shape[1]), offset[1]
        centre = first + spacing * (len(codes) - 1) / 2 - (sums.shape[1] - 1) / 2
        if spacing < 0:
            # A bar upside down: mirror it.
            values, down, spacing, centre = values[:, ::-1], -down, -spacing, -centre
        start = np.array([spacing, centre, 0.0, 0.5, 0.5, 0.0])
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
            blur_px=float(fit[4]),
            noise=noise * float(np.sqrt(columns)),
            columns=columns,
            gain=float(fit[3]),
            shift_px=float(fit[1]),
        )
        return Range(distance_m, sigma_m, int((seen[1:] & seen[:-1]).sum()))

    return bound


def _row_values(
    sums: NDArray[np.int16], tilt: float, left: float, half_width: float, full_events: float
) -> tuple[Array, float]:
    """Mean of each row's clipped sums in the chips behind edges (edges, rows); columns of a row."""
    row, column = np.ogrid[: sums.shape[1], : sums.shape[2]]
    inside = np.abs(column - (left + tilt * row)) < half_width
    clipped: Array = np.clip(sums.astype(np.float64) / full_events, -1.0, 1.0)
    number = inside.sum(1)
    values: Array = np.where(inside, clipped, 0.0).sum(2) / np.maximum(number, 1)
    return values, float(number.mean())


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
    """Expected values (values, rows), and their slopes by `fit` (6, values, rows).

    `fit` is spacing, centre, drift, gain, blur and offset of the values; boundary b between clusters b - 1
    and b of K lies at spacing * (b - K / 2) from a centre that moves by drift within the frame.
    """
    clusters = len(codes)
    b = np.clip(nearest, 1, clusters - 1)
    apart = b - clusters / 2
    value = np.arange(codes.shape[1])[:, None]
    z = (rows - (offset + fit[1] + fit[2] * when)[:, None] - fit[0] * apart) / fit[4]
    step = codes[b, value] - codes[b - 1, value]
    level = codes[b - 1, value] + step * ndtr(z)
    steep = fit[3] * step * np.exp(-z * z / 2) / np.sqrt(2 * np.pi) / fit[4]
    slopes = [-steep * apart, -steep, -steep * when[:, None], level, -steep * z]
    return fit[3] * level + fit[5], np.stack([*slopes, np.ones_like(level)])


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
    if counts.sum() <= len(start):
        return None

    def residuals(fit: Array) -> Array:
        return (_model(fit, codes, nearest, rows, offset, when)[0] - values)[counts]

    def slopes(fit: Array) -> Array:
        return _model(fit, codes, nearest, rows, offset, when)[1][:, counts].T

    found = least_squares(residuals, start, slopes, method="lm", x_scale=[0.1, 1, 1, 1, 0.3, 1])
    variance = 2 * found.cost / (counts.sum() - len(start))
    spacing, blur = found.x[0], found.x[4]
    seen_well = found.x[3] > LEAST_GAIN and blur > 0 and abs(spacing / start[0] - 1) < MOST_OFF
    if not (found.success and seen_well and variance > 0):
        return None
    return found.x, float(np.sqrt(variance))


def _place(presence: PresenceMap) -> tuple[bool, Array, NDArray[np.bool_], int] | None:
    """How a bar lies: upright or not, the clusters' middles along it, which are seen, its width, px.

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
    across = selected.any(0).sum(0 if upright else 1)
    width = grid * int((across >= _CORE_SHARE * across.max()).sum())
    return upright, middle[0 if upright else 1], seen, width


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
