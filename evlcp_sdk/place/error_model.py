"""Errors of image points, an IMU and GNSS, as positioning models them."""

from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.scene.camera import CameraSigma


@dataclass(frozen=True)
class ErrorModel(PositionSpec):
    """The `[position]` settings, and errors of camera and bar that are no settings.

    Those of points were measured on simulated drives, where they make the mean of (error / sigma)^2 one
    (`examples/campaigns/position.toml`).

    Attributes:
        min_points: Clusters of a bar that must be seen for it to count: a line and its curvature need four,
            two more show a wrong one.
        huber_sigmas: Residual of a point, in its sigmas, beyond which it weighs less; .3 % by chance.
        vibration_sigma_px: Unseen shift of the image midway between two frames, common to all bars.
        shared_sigma_px: Error that a bar's points share across it, besides that of a thin image.
        shared_along_px: The same along it, where its ends are half a cluster's light.
        shared_share: What of that grows with the bar: a share of its length.
        timing_sigma_us: Timing error of a moving bar: of all its points together, and of each.
        stretch_share: Persistent error of a bar's apparent length.
        curvature_sigma_px: Persistent apparent curvature of a bar: root of the sum of squares of its points.
            A survey cannot distinguish it from a tilt towards the camera.
        pixel_sigma_px: Error of a point by its place within a pixel, which no averaging over frames removes.
        min_view_deg: Angle between a bar and the line of sight that a lone bar needs; at less its length
            does not show its distance.
        acceleration_m2_s3: Power density of the change of speed: 1 m/s2 that lasts for a second, as of a car.
        slow_s: Time in which errors within pixels change, as the image moves.
        rate_white_deg_rts: Drift of an IMU's angle in a second by noise, degrees; of one of a few euros.
        accelerometer_sigma_m_s2: Bias of an IMU's accelerations, with that by its attitude's error.
        accelerometer_white_m2_s3: Power density of the noise of an IMU's accelerations.
        gnss_s: Time in which most of a GNSS fix's error changes, as the satellites' paths through the air do.
        gnss_white_share: Share of its variance that is new with every fix.
        gate_sigmas: Sigmas from the prediction beyond which a trajectory rejects a fix.
    """

    min_points: int = 6
    huber_sigmas: float = 3.0
    vibration_sigma_px: float = 0.04
    shared_sigma_px: float = 0.02
    shared_along_px: float = 0.04
    shared_share: float = 0.00015
    timing_sigma_us: float = 13.0
    stretch_share: float = 0.0001
    curvature_sigma_px: float = 0.05
    pixel_sigma_px: float = 0.04
    min_view_deg: float = 10.0
    acceleration_m2_s3: float = 1.0
    slow_s: float = 0.3
    rate_white_deg_rts: float = 0.02
    accelerometer_sigma_m_s2: float = 0.05
    accelerometer_white_m2_s3: float = 1e-3
    gnss_s: float = 30.0
    gnss_white_share: float = 0.1
    gate_sigmas: float = 5.0

    @classmethod
    def of(cls, spec: PositionSpec) -> Self:
        """Add the errors to a link's settings.

        >>> ErrorModel.of(PositionSpec(max_sigma_m=1.0)).max_sigma_m
        1.0
        """
        return cls(**asdict(spec))


DEFAULT_ERRORS, EXACT_CAMERA = ErrorModel(), CameraSigma()
"""Defaults: errors as measured, and a camera that is known exactly."""


def symmetric_root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """The symmetric square root of a covariance, which rotates the least from fix to fix, float64 (n, n)."""
    values, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.sqrt(np.maximum(values, 0))) @ axes.T)


@lru_cache(maxsize=4096)
def chi_square(chance: float, freedom: int) -> float:
    """The value that a chi-square of so many degrees of freedom exceeds with this probability.

    >>> round(chi_square(0.0027, 3), 2)
    14.16
    """
    from scipy.special import chdtri

    return float(chdtri(freedom, chance))
