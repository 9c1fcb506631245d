"""The weighted least-squares fit of a pose, and of every error that is shared, to all observations."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place import _kernels
from evlcp_sdk.place.observations import Problem

__all__ = ["FOCAL_FAULT", "STEPS", "Fit", "data", "fit_pose"]

Floats = NDArray[np.float64]

STEPS = 50
"""Levenberg-Marquardt steps; from a closed-form start, five to ten arrive."""

FOCAL_FAULT = 0.005
"""Share by which a focal length may be other than said without anybody's knowledge (sigma): the fault that
protection levels cover."""


@dataclass(frozen=True, eq=False)
class Fit:
    """One point of the fit.

    Attributes:
        position: m, float64 (3,).
        rotation: Camera axes as columns in ENU, float64 (3, 3).
        local: Each bar's own errors in their sigmas: shift of the image, length, place, turn, float64 (bars,
            9).
        lens: The camera's errors, by the root of their covariance, float64 (7,).
        cost: Twice the robust cost.
    """

    position: Floats
    rotation: Floats
    local: Floats
    lens: Floats
    cost: float


def fit_pose(problem: Problem, position: Floats, rotation: Floats, steps: int = STEPS) -> Fit | None:
    """Levenberg-Marquardt with Huber's weights; None where it leaves the view or does not settle."""
    bars = len(problem.transmitters)
    here = (np.ascontiguousarray(position), np.ascontiguousarray(rotation))
    still = (np.zeros((bars, _kernels.LOCAL)), np.zeros(7))
    found: tuple[Any, ...] = _kernels.fitted(*data(problem), problem.free, steps, *here, *still)  # type: ignore[call-arg]
    settled, cost, place, turned, local, lens = found
    return Fit(place, turned, local, lens, cost) if settled else None


def data(problem: Problem) -> tuple[Any, ...]:
    """What all kernels of the fit take first."""
    return (
        problem.points,
        problem.bar,
        problem.bar_sigma,
        problem.lens,
        problem.lens_root,
        FOCAL_FAULT,
        problem.felt,
        problem.heading_rad,
        problem.angles,
        problem.white,
        problem.spec.huber_sigmas,
    )
