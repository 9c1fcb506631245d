"""The image of a point and of an edge by a lens: the Airy pattern's wings, and light on square pixels."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.lazy import LazyModule

if TYPE_CHECKING:
    from scipy import special
else:
    special = LazyModule("scipy.special")

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
"""Largest sigma of a wing, px; the light that an ideal lens spreads further is added to the widest wing."""

REACH_PX = 20.0
"""Distance from a strip up to which its light is computed, px: an ideal f/2 lens at 630 nm spreads 0.17 % of
a line's light further, a tenth of the halo's, whose share is a guess."""


@dataclass(frozen=True, eq=False)
class Blur:
    """The image of a point, without the halo: a sum of round Gaussians.

    Attributes:
        sigma_px: Their sigmas, rising, px, float64 (n,).
        share: Share of the light in each, float64 (n,), of sum 1.
    """

    sigma_px: Floats
    share: Floats

    @property
    def reach_px(self) -> float:
        """Distance from an edge up to which its light is computed, px."""
        core_px = 5 * float(self.sigma_px[0]) + 0.5
        return core_px if len(self.sigma_px) == 1 else max(core_px, REACH_PX)


def airy_blur(unit_px: float, gaussian_px: float) -> Blur:
    """The Airy pattern of a round aperture, blurred by a Gaussian of sigma `gaussian_px`.

    `unit_px` is the wavelength times the f-number, px.
    """
    sigma, share = _airy_gaussians(unit_px)
    return Blur(np.hypot(sigma * unit_px, gaussian_px), share)


@lru_cache(16)
def _airy_gaussians(unit_px: float) -> tuple[Floats, Floats]:
    """Sigmas, in wavelengths times f-number, and shares of the Airy pattern's Gaussians."""
    wings = max(1, 1 + math.floor(math.log2(WIDEST_WING_PX / (FIRST_WING_SIGMA * unit_px))))
    sigma = FIRST_WING_SIGMA * 2.0 ** np.arange(wings)
    share = WING_SHARE / sigma
    # The omitted wings have as much light together as the widest of the others.
    share[-1] *= 2
    all_sigma: Floats = np.append(CORE_SIGMA, sigma)
    all_share = np.asarray(np.append(1 - share.sum(), share), np.float64)
    for table in (all_sigma, all_share):
        table.setflags(write=False)
    return all_sigma, all_share


def _cdf_integral(z: Floats, sigma: Floats | float) -> Floats:
    """Integral of a normal distribution function up to z."""
    density = np.exp(-0.5 * (z / sigma) ** 2) / math.sqrt(2 * math.pi)
    return np.asarray(z * special.ndtr(z / sigma) + sigma * density)


def edge_profile(z: Floats, sigma: Floats | float) -> Floats:
    """Lit share of a pixel at `z` from an edge at 0 that a Gaussian blurs."""
    return _cdf_integral(z + 0.5, sigma) - _cdf_integral(z - 0.5, sigma)
