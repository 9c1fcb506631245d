"""The least errors that one frame of any layout can have: Cramer-Rao bounds in two dimensions.

An image is the light of each cluster, its LEDs as squares that the lens blurs; a pixel's value is the mean of
the clusters' codes, weighted with their light and with that of a background that says nothing. What place,
scale, turn and lean do to it, against its noise, bounds whatever algorithm reads it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import FrameView, PresenceMap, Range

__all__ = ["LEAST_GAIN", "MOST_OFF", "LayoutBound", "codes_of", "layout_bound", "plane_frame_bound"]

Floats = NDArray[np.float64]

_NONE = Range(math.nan, math.nan, 0)

_POSE = ("x_px", "y_px", "scale", "turn")
_LENS = ("gain", "dark", "blur", "drift_x", "drift_y")
_LEAN = ("lean", "swing")

_STEP = 1e-4
"""Of the differences that give slopes, px, radians and shares: their errors are its square."""

_SEAM_SIGMAS = 4.0
"""How far around its LEDs an image shows a layout, in blurs; and 2 px beside."""

_UNKNOWN = 1e-9
"""Share of a parameter's own information below which what others leave of it is none."""

LEAST_GAIN = 0.01
"""Share of a full value below which a fit has found no light: one event in some thirty values."""

MOST_OFF = 0.2
"""How far, as a share, a fit's scale may lie from that of the clusters' middles: not a fit beyond."""


@dataclass(frozen=True)
class LayoutBound:
    """Smallest standard deviations of what one frame says; infinite where it says nothing.

    Attributes:
        x_px: Of the layout's place in the image, to the right.
        y_px: The same, downward.
        distance_m: Of its distance.
        turn_deg: Of its turn in the image.
        lean_deg: Of a lean of its top towards the camera or from it, of a layout that hardly leans.
        swing_deg: The same of its left side.
    """

    x_px: float
    y_px: float
    distance_m: float
    turn_deg: float
    lean_deg: float
    swing_deg: float


def layout_bound(
    camera: CameraModel,
    bar: BarLayout,
    codebook: Codebook,
    distance_m: float,
    symbols: ArrayLike,
    *,
    blur_px: float,
    noise: float,
    gain: float = 0.8,
    dark: float = 0.1,
    shift_px: tuple[float, float] = (0.0, 0.0),
    turn_deg: float = 0.0,
) -> LayoutBound:
    """Bounds of one frame of a layout seen from the front.

    Place, scale, turn, gain, background, blur and the drift within the frame are unknown together; for lean
    and swing, these too. Pixels have Gaussian noise of one size (Kay, Estimation Theory, chapter 3).

    Args:
        camera: For the scale in the image.
        bar: The layout.
        codebook: Pilots and codewords.
        distance_m: Its distance, m.
        symbols: What the frame says, integers (K,).
        blur_px: Sigma of a point in the image, px.
        noise: Standard deviation of one pixel's value, in full values.
        gain: Share of a full value that is seen.
        dark: The background's light, as a share of that of a pixel that an LED fills.
        shift_px: Where the layout's centre lies from a pixel's middle, right and down, px.
        turn_deg: Its turn in the image, clockwise.

    Raises:
        ConfigError: A quantity that must be positive is not.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> link = load_link(overrides=["bar.shape=ring"])
    >>> scene = link.camera, link.bar, link.codebook, 50.0, range(12)
    >>> bound = layout_bound(*scene, blur_px=0.45, noise=0.3)
    >>> round(bound.distance_m, 3), round(bound.lean_deg, 1)
    (0.031, 13.6)
    """
    quantities = {"distance_m": distance_m, "blur_px": blur_px, "noise": noise, "gain": gain, "dark": dark}
    for name, quantity in quantities.items():
        if not quantity > 0:
            raise ConfigError(f"{name} = {quantity}: expected a positive number")
    codes = codes_of(codebook, np.asarray(symbols, np.int64))
    image = _Image.around(bar, camera.focal_px / distance_m, blur_px, codes, distance_m)
    fit = {
        "x_px": shift_px[0],
        "y_px": shift_px[1],
        "scale": math.log(camera.focal_px / distance_m),
        "turn": math.radians(turn_deg),
        "gain": gain,
        "dark": math.log(dark),
        "blur": math.log(blur_px),
    }
    slopes = np.stack([image.slope(fit, name) for name in (*_POSE, *_LENS, *_LEAN)])
    information = slopes @ slopes.T / noise**2
    flat = _sigmas(information[: len(_POSE + _LENS), : len(_POSE + _LENS)])
    leaning = _sigmas(information)
    x_px, y_px, scale, turn = flat[:4].tolist()
    lean, swing = np.degrees(leaning[-2:]).tolist()
    return LayoutBound(x_px, y_px, distance_m * scale, math.degrees(turn), lean, swing)


@dataclass(frozen=True, eq=False)
class _Image:
    """What makes the values of a frame of its parameters.

    Attributes:
        leds_m: The LEDs, m, float64 (n, 3).
        first: Of the LEDs in the order of their clusters, where each cluster starts, int64 (K + 1,).
        side_m: Width and height that one lights, m.
        codes: What each cluster sends, float64 (K, values).
        columns: Of the pixels, from the middle of the image, px, float64 (width,).
        rows: The same, float64 (height,).
        distance_m: For the perspective of what stands out or leans.
    """

    leds_m: Floats
    first: NDArray[np.int64]
    side_m: float
    codes: Floats
    columns: Floats
    rows: Floats
    distance_m: float

    @classmethod
    def of(cls, bar: BarLayout, codes: Floats, columns: Floats, rows: Floats, distance_m: float) -> "_Image":
        which = bar.led_clusters()
        order = np.argsort(which, kind="stable")
        first = np.searchsorted(which[order], np.arange(bar.clusters + 1))
        return cls(bar.led_positions_m()[order], first, bar.shape.led_m, codes, columns, rows, distance_m)

    @classmethod
    def around(
        cls, bar: BarLayout, scale: float, blur_px: float, codes: Floats, distance_m: float
    ) -> "_Image":
        seam = _SEAM_SIGMAS * blur_px + 2 + bar.shape.led_m * scale
        half = math.ceil(scale * float(np.abs(bar.led_positions_m()[:, :2]).max()) + seam)
        across = np.arange(-half, half + 1, dtype=np.float64)
        return cls.of(bar, codes, across, across, distance_m)

    def values(self, fit: dict[str, float]) -> Floats:
        """Expected values, float64 (values, pixels)."""
        x, y, z = self.leds_m.T
        # To first order, what leans stands out by so much.
        z = z + y * fit.get("lean", 0.0) + x * fit.get("swing", 0.0)
        scale = math.exp(fit["scale"])
        near = scale / (1 - z / self.distance_m)
        turn, side, blur = fit["turn"], scale * self.side_m, math.exp(fit["blur"])
        c, s = math.cos(turn), math.sin(turn)
        u = fit["x_px"] + near * (c * x - s * y)
        v = fit["y_px"] + near * (s * x + c * y)
        across, down = (
            ndtr((grid - at[:, None] + side / 2) / blur) - ndtr((grid - at[:, None] - side / 2) / blur)
            for grid, at in ((self.columns, u), (self.rows, v))
        )
        light = np.stack(
            [(down[a:b].T @ across[a:b]).ravel() for a, b in zip(self.first, self.first[1:], strict=False)]
        )
        seen: Floats = fit["gain"] * (self.codes.T @ (light / (light.sum(0) + math.exp(fit["dark"]))))
        return seen

    def slope(self, fit: dict[str, float], name: str) -> Floats:
        """How the values change with a parameter, float64 (values * pixels,)."""
        step = _STEP
        if name.startswith("drift"):
            axis = name.replace("drift_", "") + "_px"
            values = len(self.codes[0])
            when = np.arange(values) / values - 0.5
            return (self.slope(fit, axis).reshape(values, -1) * when[:, None]).ravel()
        if name in _LEAN:
            # A lean shows by its perspective, which is weak.
            step *= self.distance_m
        low, high = ({**fit, name: fit.get(name, 0.0) + by} for by in (-step, step))
        return ((self.values(high) - self.values(low)) / (2 * step)).ravel()


def _sigmas(information: Floats) -> Floats:
    """Standard deviation of each parameter, the others unknown, too; infinite where nothing says it."""
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


def codes_of(codebook: Codebook, symbols: NDArray[np.int64]) -> Floats:
    """What each cluster sends in a frame, pilot and info, float64 (K, values)."""
    said = codebook.codeword_edges[symbols]
    return np.concatenate([codebook.pilot_edges, said], axis=1).astype(np.float64)


def plane_frame_bound(
    camera: CameraModel, bar: BarLayout, codebook: Codebook, *, full_events: float = 3.0
) -> Callable[[FrameView], Range]:
    """A function that gives, as sigma, the bound of a frame of any layout of two clusters or more.

    Place, scale, turn, gain, background and blur are those that fit the frame's values best; what is left
    over is the noise.

    Args:
        camera: For the scale in the image.
        bar: The layout.
        codebook: Pilots and codewords.
        full_events: Events of a pixel in a chip that count as a full value.

    Returns:
        From what the receiver's stage `view` shows to the fit's distance and the bound, both NaN where the
        frame shows too little.

    Raises:
        ConfigError: The layout is one cluster.
    """
    if bar.clusters < 2:
        raise ConfigError("the Cramer-Rao bound of a distance needs two clusters or more")
    centres_m = bar.cluster_centres_m() @ np.array([1, 1j])

    def bound(view: FrameView) -> Range:
        start = _start(view.presence, centres_m)
        if start is None:
            return _NONE
        scale, shift, seen = start
        values = np.clip(view.sums[codebook.edge_chips].astype(np.float64) / full_events, -1.0, 1.0)
        height, width = values.shape[1:]
        symbols = np.where(view.soft.symbols < 0, 0, view.soft.symbols)
        columns, rows = (np.arange(n) - (n - 1) / 2 for n in (width, height))
        distance_m = camera.focal_px / abs(scale)
        image = _Image.of(bar, codes_of(codebook, symbols), columns, rows, distance_m)
        middle = shift - complex(width - 1, height - 1) / 2
        names = (*_POSE, "gain", "dark", "blur")
        first = [middle.real, middle.imag, math.log(abs(scale)), float(np.angle(scale))]
        first += [0.6, math.log(0.1), math.log(0.45)]

        def off(fit: Floats) -> Floats:
            return (
                image.values(dict(zip(names, fit.tolist(), strict=True))) - values.reshape(len(values), -1)
            ).ravel()

        found = least_squares(off, first, x_scale=[1, 1, 0.01, 0.01, 0.3, 1, 0.3], max_nfev=30)
        fit = dict(zip(names, found.x.tolist(), strict=True))
        noise = math.sqrt(2 * found.cost / max(found.fun.size - len(first), 1))
        if fit["gain"] < LEAST_GAIN or abs(fit["scale"] - first[2]) > MOST_OFF or not noise > 0:
            return _NONE
        distance_m = camera.focal_px / math.exp(fit["scale"])
        slopes = np.stack([image.slope(fit, name) for name in (*_POSE, *_LENS)])
        sigma = float(_sigmas(slopes @ slopes.T / noise**2)[2])
        return Range(distance_m, distance_m * sigma, seen) if math.isfinite(sigma) else _NONE

    return bound


def _start(presence: PresenceMap, centres_m: NDArray[np.complex128]) -> tuple[complex, complex, int] | None:
    """Scale, px a metre with the turn, place, px, and how many clusters are seen, by the cells' medians."""
    selected, grid = presence.selected, presence.grid_px
    seen = np.flatnonzero(selected.any((1, 2)))
    at = np.array([complex(*np.median(np.nonzero(selected[k]), axis=1)[::-1]) for k in seen], np.complex128)
    at = at * grid + (grid - 1) / 2 * (1 + 1j)
    layout = centres_m[seen]
    spread = layout - layout.mean() if len(seen) else layout
    power = float((np.abs(spread) ** 2).sum())
    if len(seen) < 2 or power <= 0:
        return None
    scale = complex(np.conj(spread) @ at) / power
    return (scale, complex(at.mean() - scale * layout.mean()), len(seen)) if abs(scale) > 0 else None
