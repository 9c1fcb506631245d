"""Blur of the lens, with the wings of the Airy pattern, and the light of a strip on the pixels.

The image of a point is a sum of Gaussians, so that the light of a rectangle on a square pixel is a product of
one-dimensional steps for each of them.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.scene.optics import Blur, airy_blur, edge_profile
from evlcp_sdk.sim.leds import LitStrip
from evlcp_sdk.sim.scene import BarSpec, DropSpec, LensSpec

Floats = NDArray[np.float64]


def blur_of(depth_m: float, lens: LensSpec, camera: CameraModel, more_px: float = 0.0) -> Blur:
    """Return the image of a point: diffraction, defocus, and the blur left in focus.

    With wings, an ideal f/2 lens at 630 nm without other blur spreads 5.1 % of the light beyond 1 px of 4.86
    um, and 2.6 % beyond 2 px. `more_px` is the sigma of additional blur.
    """
    other = math.hypot(_defocus_px(depth_m, lens, camera), lens.blur_px, more_px)
    if not lens.wings:
        return Blur(np.array([math.hypot(blur_sigma_px(depth_m, lens, camera), more_px)]), np.ones(1))
    return airy_blur(lens.wavelength_nm * 1e-3 * lens.f_number / camera.pitch_um, other)


def _defocus_px(depth_m: float, lens: LensSpec, camera: CameraModel) -> float:
    """Return the sigma of defocus, px: that of a uniform disk, a quarter of its diameter."""
    disk_um = camera.focal_mm**2 / lens.f_number * abs(1 / depth_m - 1 / lens.focus_m)
    return disk_um / 4 / camera.pitch_um


def blur_sigma_px(depth_m: float, lens: LensSpec, camera: CameraModel) -> float:
    """Return the sigma of the Gaussian closest to the blur without wings, px.

    Diffraction is 0.42 lambda N. Defocus is a disk of diameter `f^2 / N |1 / depth - 1 / focus|` (thin lens,
    far objects), whose sigma is a quarter of it. To these comes the blur left in focus.

    >>> round(blur_sigma_px(50.0, LensSpec(), CameraModel()), 3)
    0.376
    """
    diffraction_px = 0.42 * (lens.wavelength_nm * 1e-3) * lens.f_number / camera.pitch_um
    return math.hypot(diffraction_px, _defocus_px(depth_m, lens, camera), lens.blur_px)


def led_light_w_m2(bar: BarSpec, strip: LitStrip, lens: LensSpec) -> float:
    """Return the irradiance of a pixel that a strip of LEDs fills, W/m2: E = pi L tau / (4 N^2).

    The radiance L is the LEDs' intensity spread over the strip: 20 mW/sr each, 1 cm apart on a width of 5 mm,
    give 51 W/m2 at f/2.
    """
    if bar.led_w_m2 is not None:
        return bar.led_w_m2
    radiance = strip.leds * bar.led_mw_sr * 1e-3 / (strip.width_m * strip.pitch_m)
    return math.pi * radiance * lens.transmission / (4 * lens.f_number**2)


def undo_drops(drops: Sequence[DropSpec], y_px: ArrayLike, x_px: ArrayLike, t_s: float) -> Floats:
    """Return the column and row that pixels (n,) would see without drops at a time, px, float64 (2, n)."""
    seen = np.array([x_px, y_px], np.float64)
    straight = seen.copy()
    for drop in drops:
        offset = seen.T - (drop.x_px, drop.y_px) - np.multiply(drop.speed_px_s, t_s)
        offset = offset.T / drop.radius_px
        straight -= drop.bend_px * offset * np.exp(0.5 - 0.5 * (offset**2).sum(0))
    return straight


def tabulate_strip(blur: Blur, strip_px: float, scale_px: float, nodes: int) -> Floats:
    """Tabulate the share of a pixel lit by a strip that starts at an edge across it and never ends.

    Samples thin out from the edge and the middle outward, as the light changes ever more slowly: a distance z
    is at `z / (|z| + scale_px)`.

    Args:
        blur: The image of a point.
        strip_px: Width of the strip, px.
        scale_px: Distance that half of the samples are within, px.
        nodes: Number of samples to one side.

    Returns:
        Shares, float64 (nodes + 1, 2 nodes + 1): by the distance from the strip's middle, 0 to infinity, and
        by that along it from its edge, minus to plus infinity.
    """
    u = np.arange(nodes) / nodes
    # The last node is at infinity, for which any number far above the blur will do.
    z = np.append(scale_px * u / (1 - u), 1e6 * scale_px)
    steps = edge_profile(
        np.concatenate([z + strip_px / 2, z - strip_px / 2, -z[:0:-1]]), blur.sigma_px[:, None]
    )
    right, left, before = np.split(steps, [nodes + 1, 2 * nodes + 2], axis=1)
    across = right - left
    along = np.concatenate([before, np.full((len(before), 1), 0.5), 1 - before[:, ::-1]], axis=1)
    return np.asarray((across * blur.share[:, None]).T @ along)
