"""What a drive shows of its own errors: the standing states of a track in their units."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.trajectory import IMU
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel, CameraSigma
from evlcp_sdk.scene.sites import BarSite

Floats = NDArray[np.float64]

_DETERMINED_SHARE = 0.9
"""Share of its stated sigma below which an error counts as determined by the drive."""


@dataclass(frozen=True)
class EstimatedBias:
    """One standing error as a drive shows it.

    Attributes:
        part: `camera`, `attitude`, `imu`, `bar N`.
        what: What of it, with its unit: `focal_mm`, `pitch_deg`, `time_us`, `east_m` ...
        correction: What is to be added to what was stated.
        sigma: Of it.
        stated_sigma: Before the drive.
    """

    part: str
    what: str
    correction: float
    sigma: float
    stated_sigma: float

    @property
    def determined(self) -> bool:
        """Whether the drive says anything of it; else it keeps the sigma that was stated."""
        return self.sigma < _DETERMINED_SHARE * self.stated_sigma


def estimate_biases(
    states: Mapping[str, tuple[Floats, Floats]],
    camera: CameraModel,
    camera_sigma: CameraSigma,
    attitude: Attitude | None,
    sites: Mapping[int, BarSite],
    spec: ErrorModel,
) -> list[EstimatedBias]:
    """Standing states in their units; an error that was stated as none is left out.

    Args:
        states: Of each part, means in its sigmas, (k,), and covariance, (k, k), as `TrajectoryPoint.standing`
            has them.
        camera: The camera as stated.
        camera_sigma: How precisely.
        attitude: One with the sigmas that were stated; None where there is none.
        sites: Where the transmitters stand, by number.
        spec: An IMU's sigmas.
    """
    found: list[EstimatedBias] = []
    for part, (mean, covariance) in states.items():
        if part == "camera":
            root = camera_sigma.root(camera)
            root[0] *= camera.focal_mm / camera.focal_px
            names: tuple[str, ...] = CAMERA_PARAMETERS
        elif part == "attitude" and attitude is not None:
            gravity, heading = attitude.gravity_sigma_deg, attitude.heading_sigma_deg
            # Angles that are measured too large are to be made smaller; one that is early, later.
            root = np.diag([-gravity, -gravity, -heading, attitude.time_sigma_us])
            names = ("pitch_deg", "roll_deg", "heading_deg", "time_us")
        elif part == IMU:
            root = np.diag([-spec.rate_sigma_deg_s, *(len(mean) - 1) * [-spec.push_sigma_m_s2]])
            names = ("rate_deg_s", "push_right_m_s2", "push_forward_m_s2", "push_up_m_s2")[: len(mean)]
        elif part.startswith("bar ") and len(mean) > 1 and (site := sites.get(int(part[4:]))) is not None:
            # After its length come its place and its turn.
            mean, covariance = mean[1:4], covariance[1:4, 1:4]
            root = site.survey[0] * np.eye(3)
            names = ("east_m", "north_m", "up_m")
        else:
            continue
        values, spread = root @ mean, root @ covariance @ root.T
        stated = np.sqrt((root * root).sum(1))
        for i, name in enumerate(names):
            if stated[i] > 0:
                sigma = math.sqrt(max(float(spread[i, i]), 0.0))
                found.append(EstimatedBias(part, name, float(values[i]), sigma, float(stated[i])))
    return found


def focal_share(
    state: tuple[Floats, Floats] | None, camera: CameraModel, camera_sigma: CameraSigma
) -> tuple[float, float]:
    """By what share the focal length is longer than stated, and its sigma; NaN if it was stated exactly."""
    if state is None or not camera_sigma.focal_mm > 0:
        return math.nan, math.nan
    row = camera_sigma.root(camera)[0] / camera.focal_px
    return float(row @ state[0]), math.sqrt(max(float(row @ state[1] @ row), 0.0))
