"""The weighted least-squares fit of a pose, and of every error that is shared, to all observations."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place import _kernels
from evlcp_sdk.place.observations import Problem

__all__ = ["Fit", "Normal", "fit_pose", "moved", "normal_equations"]

Floats = NDArray[np.float64]

_STEPS = 50
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


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations at a point: see `_kernels.normal` for its arrays.

    Attributes:
        cost: Twice the robust cost; NaN where a point is behind the camera.
        bar_cost: Of each bar, least over its own unknowns, float64 (bars,).
        whole: The sum over everything, float64 (14, 14).
        side: Its right-hand side, float64 (14,).
    """

    cost: float
    info: Floats
    right: Floats
    gain: Floats
    step: Floats
    bar_cost: Floats
    rows: Floats
    miss: Floats
    pixel: Floats
    whole: Floats
    side: Floats


def fit_pose(problem: Problem, position: Floats, rotation: Floats) -> Fit | None:
    """Levenberg-Marquardt with Huber's weights; None where it leaves the view or does not settle."""
    bars = len(problem.transmitters)
    here = (np.ascontiguousarray(position), np.ascontiguousarray(rotation))
    still = (np.zeros((bars, _kernels.LOCAL)), np.zeros(7))
    free = problem.free
    found: tuple[Any, ...] = _kernels.fitted(*_data(problem), free, _STEPS, *here, *still)  # type: ignore[call-arg]
    settled, cost, place, turned, local, lens = found
    return Fit(place, turned, local, lens, cost) if settled else None


def normal_equations(problem: Problem, at: Fit) -> Normal:
    """Normal equations at a point."""
    bars, wide, own = len(problem.transmitters), _kernels.GLOBAL, _kernels.LOCAL
    info, right, cost = np.zeros((bars, wide, wide)), np.zeros((bars, wide)), np.zeros(bars)
    gain, step, pixel = np.zeros((bars, own, wide)), np.zeros((bars, own)), np.zeros((bars, wide, wide))
    rows, miss = np.zeros((3, wide)), np.zeros(3)
    point = (at.position, at.rotation, at.local, at.lens)
    found = (info, right, gain, step, cost, rows, miss, pixel)
    total = _kernels.normal(*_data(problem), *point, *found)  # type: ignore[call-arg]
    whole, side = np.zeros((wide, wide)), np.zeros(wide)
    if not np.isnan(total):
        _kernels.summed(info, right, rows, miss, at.lens, problem.free, whole, side)
    return Normal(total, info, right, gain, step, cost, rows, miss, pixel, whole, side)


def moved(problem: Problem, at: Fit, normal: Normal, move: Floats) -> Fit:
    """A point with its unknowns moved by (14,), about the bars; what is a bar's own follows."""
    point = (at.position, at.rotation, at.local, at.lens)
    centre = problem.points[:, :3].mean(0)
    return Fit(*_kernels.stepped(move, normal.gain, normal.step, centre, *point), np.nan)


def _data(problem: Problem) -> tuple[Any, ...]:
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
