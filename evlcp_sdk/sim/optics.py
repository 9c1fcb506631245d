"""What the lens does: the blur with the Airy pattern's wings, and its light on the pixels of a strip.

The image of a point is a sum of Gaussians, so that the light of a rectangle on a square pixel is a product of
one-dimensional steps for each of them.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim.scene import BarSpec, LensSpec

__all__ = ["Blur", "blur_of", "blur_sigma_px", "led_light_w_m2", "step_table", "strip_table", "strip_width_m"]

Floats = NDArray[np.float64]

CORE_SIGMA, FIRST_WING_SIGMA = 0.35, 0.8
"""Sigmas of the innermost two Gaussians of the Airy pattern, wavelengths times f-number. The others are each
twice as wide as the one before. With these two the sum, blurred by 0.36 px at f/2, transmits every spatial
frequency to 1e-4 as a round aperture does."""

WING_SHARE = math.sqrt(2 / math.pi) * (2 / math.pi**2) * math.log(2)
"""Share of the light in a wing, times its sigma in wavelengths times f-number.

Beyond a radius of r lie J0^2 + J1^2 of the light, on the average over a ring 2 / (pi^2 r); and 1 / r is
sqrt(2 / pi) times the integral of exp(-r^2 / (2 s^2)) / s^2 over s, here a sum over octaves of s, which
differs from the integral by 0.2 %."""

WIDEST_WING_PX = 32.0
"""Sigma up to which there are wings, px; what an ideal lens throws further is added to the widest of them."""

REACH_PX = 20.0
"""How far a strip's light is followed, px: further from a line an ideal f/2 lens at 630 nm throws 0.17 %
of the light, a tenth of what the halo has there, whose share is a guess."""


@dataclass(frozen=True, eq=False)
class Blur:
    """The image of a point, without the halo: round Gaussians, one over another.

    Attributes:
        sigma_px: Their sigmas, rising, px, float64 (n,).
        share: Share of the light in each, float64 (n,); 1 together.
    """

    sigma_px: Floats
    share: Floats

    @property
    def reach_px(self) -> float:
        """How far from an edge its light is followed, px."""
        core_px = 5 * float(self.sigma_px[0]) + 0.5
        return core_px if len(self.sigma_px) == 1 else max(core_px, REACH_PX)


def blur_of(depth_m: float, lens: LensSpec, camera: CameraModel, more_px: float = 0.0) -> Blur:
    """How a point is imaged: diffraction with or without its wings, defocus, and what blur is left in focus.

    Args:
        depth_m: Its depth.
        lens: The lens.
        camera: The camera.
        more_px: Sigma of blur that comes from elsewhere, px.

    With wings, 5.1 % of the light of an ideal f/2 lens at 630 nm, whose blur is nothing else, falls beyond
    1 px of 4.86 um, and 2.6 % beyond 2 px.
    """
    other = math.hypot(_defocus_px(depth_m, lens, camera), lens.blur_px, more_px)
    if not lens.wings:
        return Blur(np.array([math.hypot(blur_sigma_px(depth_m, lens, camera), more_px)]), np.ones(1))
    unit_px = _wavelength_um(lens) * lens.f_number / camera.pitch_um
    wings = max(1, 1 + math.floor(math.log2(WIDEST_WING_PX / (FIRST_WING_SIGMA * unit_px))))
    sigma = FIRST_WING_SIGMA * 2.0 ** np.arange(wings)
    share = WING_SHARE / sigma
    # The wings that are left out have as much together as the widest of the others.
    share[-1] *= 2
    sigma = np.append(CORE_SIGMA, sigma)
    share = np.append(1 - share.sum(), share)
    return Blur(np.hypot(sigma * unit_px, other), np.asarray(share, np.float64))


def _wavelength_um(lens: LensSpec) -> float:
    return lens.wavelength_nm * 1e-3


def _defocus_px(depth_m: float, lens: LensSpec, camera: CameraModel) -> float:
    """Sigma of a point out of focus, px: of a uniform disk, a quarter of its diameter."""
    disk_um = camera.focal_mm**2 / lens.f_number * abs(1 / depth_m - 1 / lens.focus_m)
    return disk_um / 4 / camera.pitch_um


def blur_sigma_px(depth_m: float, lens: LensSpec, camera: CameraModel) -> float:
    """Sigma of the Gaussian nearest to the blur without its wings, px: diffraction, defocus, what is left.

    Diffraction: 0.42 lambda N. Defocus: a disk of diameter f^2 / N |1 / depth - 1 / focus| (thin lens, far
    objects), with the sigma of a uniform disk, a quarter of it.

    >>> round(blur_sigma_px(50.0, LensSpec(), CameraModel()), 3)
    0.376
    """
    diffraction_px = 0.42 * _wavelength_um(lens) * lens.f_number / camera.pitch_um
    return math.hypot(diffraction_px, _defocus_px(depth_m, lens, camera), lens.blur_px)


def strip_width_m(bar: BarSpec, layout: BarLayout) -> float:
    """Lit width of a column of clusters: from its first column of LEDs to its last, m."""
    return bar.width_m + (layout.cluster_columns - 1) * layout.led_pitch_m


def led_light_w_m2(bar: BarSpec, layout: BarLayout, lens: LensSpec) -> float:
    """Irradiance of a pixel that a column of clusters fills, W/m2: E = pi L tau / (4 N^2).

    The radiance L is that of the LEDs' intensity spread over the column; 20 mW/sr each, 1 cm apart on 5 mm
    of width, at f/2 give 51 W/m2.
    """
    if bar.led_w_m2 is not None:
        return bar.led_w_m2
    of_row = layout.cluster_columns * bar.led_mw_sr * 1e-3
    radiance = of_row / (strip_width_m(bar, layout) * layout.led_pitch_m)
    return math.pi * radiance * lens.transmission / (4 * lens.f_number**2)


def _integral(z: Floats, sigma: Floats | float) -> Floats:
    """Integral of the normal distribution function with this sigma up to z."""
    density = np.exp(-0.5 * (z / sigma) ** 2) / math.sqrt(2 * math.pi)
    total: Floats = z * ndtr(z / sigma) + sigma * density
    return total


def _step(z: Floats, sigma: Floats | float) -> Floats:
    """Share of a pixel at `z` that is lit beyond an edge at 0, blurred by a Gaussian."""
    return _integral(z + 0.5, sigma) - _integral(z - 0.5, sigma)


def step_table(sigma_px: float, reach_px: float, nodes: int) -> Floats:
    """Share of a pixel lit beyond an edge blurred by a Gaussian, sampled around the edge.

    Args:
        sigma_px: The Gaussian's sigma, px.
        reach_px: How far before and behind the edge to sample, px.
        nodes: How many samples.

    Returns:
        float64 (nodes,): shares at -reach_px to reach_px, from 0 to 1.
    """
    return _step(np.linspace(-reach_px, reach_px, nodes), sigma_px)


def strip_table(blur: Blur, strip_px: float, scale_px: float, nodes: int) -> Floats:
    """Share of a pixel lit by a strip that begins at an edge across it and never ends.

    It is sampled ever more thinly from the edge and the middle outward, as the light changes ever more
    slowly: a distance z stands at z / (|z| + scale_px).

    Args:
        blur: The image of a point.
        strip_px: Width of the strip, px.
        scale_px: Distance within which half of the samples lie, px.
        nodes: How many samples to one side.

    Returns:
        float64 (nodes + 1, 2 nodes + 1): by the distance from the strip's middle, 0 to infinity, and by that
        along it from its edge, minus to plus infinity.
    """
    u = np.arange(nodes) / nodes
    # The last node is at infinity; any number stands for it beside which the blur is small.
    z = np.append(scale_px * u / (1 - u), 1e6 * scale_px)
    sigma = blur.sigma_px[:, None]
    half = strip_px / 2
    across = _step(z + half, sigma) - _step(z - half, sigma)
    before = _step(-z[:0:-1], sigma)
    along = np.concatenate([before, np.full_like(sigma, 0.5), 1 - before[:, ::-1]], axis=1)
    table: Floats = (across * blur.share[:, None]).T @ along
    return table
