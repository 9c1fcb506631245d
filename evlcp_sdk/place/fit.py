"""The weighted least-squares fit of a pose, and of every error that is shared, to all observations."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.late import Late
from evlcp_sdk.place.observations import Problem

if TYPE_CHECKING:
    from evlcp_sdk.place import _kernels
else:
    _kernels = Late("evlcp_sdk.place._kernels")

__all__ = ["FOCAL_UNIT", "STEPS", "Fit", "data", "fit_pose"]

Floats = NDArray[np.float64]

STEPS = 50
"""Levenberg-Marquardt steps; from a closed-form start, five to ten arrive."""

FOCAL_UNIT = 0.005
"""Share of the focal length in which a fault of it is counted."""


@dataclass(frozen=True, eq=False)
class Fit:
    """One point of the fit.

    Attributes:
        position: m, float64 (3,).
        rotation: Camera axes as columns in ENU, float64 (3, 3).
        local: Each bar's own errors in their sigmas: shift of the image, length, place, turn, float64 (bars,
            9).
        lens: The camera's errors, by the root of their covariance, float64 (7,).
        cost: Twice the cost.
        settled: Whether a fit ended here.
    """

    position: Floats
    rotation: Floats
    local: Floats
    lens: Floats
    cost: float
    settled: bool = False

    @classmethod
    def at(cls, problem: Problem, position: Floats, rotation: Floats) -> "Fit":
        """A place and axes, and no other error; what it costs is not known."""
        here = (np.ascontiguousarray(position), np.ascontiguousarray(rotation))
        return cls(*here, np.zeros((len(problem.transmitters), _kernels.LOCAL)), np.zeros(7), math.nan)


def fit_pose(
    problem: Problem, start: Fit, steps: int = STEPS, *, robust: bool = True, hopeless: float = math.inf
) -> Fit:
    """Levenberg-Marquardt, with Huber's weights if robust.

    Args:
        problem: What is seen and known.
        start: Where to begin; its cost does not matter.
        steps: At most so many.
        robust: Else plain least squares.
        hopeless: A cost above which it counts as settled where steps hardly lower it, nor promise to.

    Returns:
        Where it ends; its cost is NaN where the start has a point behind the camera.
    """
    point = (start.position, start.rotation, start.local, start.lens)
    given = data(problem) if robust else (*data(problem)[:-1], math.inf)
    found: tuple[Any, ...] = _kernels.fitted(*given, problem.free, steps, hopeless, *point)  # type: ignore[call-arg]
    settled, cost, place, turned, local, lens = found
    return Fit(place, turned, local, lens, cost, settled)


def data(problem: Problem) -> tuple[Any, ...]:
    """What all kernels of the fit take first, how robust it is at its end."""
    return (
        problem.points,
        problem.bar,
        problem.bar_sigma,
        problem.lens,
        problem.lens_root,
        FOCAL_UNIT,
        problem.felt,
        problem.heading_rad,
        problem.angles,
        problem.white,
        problem.spec.huber_sigmas,
    )
