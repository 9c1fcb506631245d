"""What the lens does: blur, halo, light; and where a strip's ends fall in the image."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim.scene import BarSpec, LensSpec

__all__ = ["blur_sigma_px", "led_light_w_m2", "step_table", "strip_width_m"]

Floats = NDArray[np.float64]


def blur_sigma_px(depth_m: float, lens: LensSpec, camera: CameraModel) -> float:
    """Sigma of the Gaussian that stands for diffraction, defocus and what is left, px.

    Diffraction: 0.42 lambda N. Defocus: a disk of diameter f^2 / N |1 / depth - 1 / focus| (thin lens, far
    objects), with the sigma of a uniform disk, a quarter of it.

    >>> round(blur_sigma_px(50.0, LensSpec(), CameraModel()), 3)
    0.376
    """
    diffraction_um = 0.42 * lens.wavelength_nm * 1e-3 * lens.f_number
    disk_um = camera.focal_mm**2 / lens.f_number * abs(1 / depth_m - 1 / lens.focus_m)
    return math.hypot(math.hypot(diffraction_um, disk_um / 4) / camera.pitch_um, lens.blur_px)


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


def _integral(z: Floats, sigma: float) -> Floats:
    """Integral of the normal distribution function with this sigma up to z."""
    density = np.exp(-0.5 * (z / sigma) ** 2) / math.sqrt(2 * math.pi)
    total: Floats = z * ndtr(z / sigma) + sigma * density
    return total


def step_table(sigma_px: float, reach_px: float, nodes: int) -> Floats:
    """Share of a pixel lit beyond an edge blurred by a Gaussian, sampled around the edge.

    Args:
        sigma_px: The Gaussian's sigma, px.
        reach_px: How far before and behind the edge to sample, px.
        nodes: How many samples.

    Returns:
        float64 (nodes,): shares at -reach_px to reach_px, from 0 to 1.
    """
    z = np.linspace(-reach_px, reach_px, nodes)
    return _integral(z + 0.5, sigma_px) - _integral(z - 0.5, sigma_px)
