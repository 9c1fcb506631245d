"""The least error that any unbiased ranging can have: the Cramer-Rao bound of the boundaries' model."""

import numpy as np
from numpy.typing import ArrayLike

from evlcp_sdk.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.geometry import BarLayout, CameraModel

__all__ = ["cramer_rao_sigma_m"]


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

    Each pixel's value is the model's (see `JointScaleRanging`) plus Gaussian noise; then the Fisher
    information is the sum of the slopes' outer products over the noise's variance (Kay, chapter 3).

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
        ConfigError: A quantity that must be positive is not.
    """
    for name, quantity in (("distance_m", distance_m), ("blur_px", blur_px), ("noise", noise)):
        if not quantity > 0:
            raise ConfigError(f"{name} = {quantity}: expected a positive number")
    from evlcp_joint import _kernels

    centres = bar.cluster_centres_m()
    spacing = camera.focal_px * float(centres[1, 1] - centres[0, 1]) / distance_m
    said = codebook.codewords[np.asarray(symbols, np.int64)]
    codes = np.concatenate([codebook.pilots, said], axis=1).astype(np.int64)
    values, rows = codes.shape[1], 2 * int(spacing * len(codes) / 2 + 4)
    when = np.arange(values) / values - 0.5
    value, slope = np.empty((values, rows)), np.empty((4, values, rows))
    fit = np.array([spacing, shift_px, 0.0, gain])
    _kernels.model(codes, np.ones(len(codes), bool), np.zeros(values), when, blur_px, fit, value, slope)
    flat = slope.reshape(4, -1)
    information = columns / noise**2 * (flat @ flat.T)
    return float(distance_m * np.sqrt(np.linalg.inv(information)[0, 0]) / spacing)
