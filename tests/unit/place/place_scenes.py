"""Bars that a camera sees, and whether errors are as large as their covariances say."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.values import Fix, Frame, Range, SoftSymbols

Floats = NDArray[np.float64]

POINTS_ONLY = ErrorModel(
    vibration_sigma_px=0, shared_sigma_px=0, shared_along_px=0, shared_share=0, stretch_share=0
)
"""Points err, each by itself, and nothing else does."""


def bar(place: Sequence[float] | Floats, axis: Sequence[float] = (0, 0, 1)) -> Floats:
    """Clusters of the default bar that stands at a place, m, float64 (16, 3)."""
    along = (0.5 - (np.arange(16) + 0.5) / 16) * 0.96
    return np.asarray(place, float) + along[:, None] * np.array(axis, float)


def frame(points_px, sigma_px, t_us, transmitter=0, packet=0, number=0) -> Frame:
    """A frame with nothing but points."""
    soft = SoftSymbols(np.zeros(16, np.int64), np.zeros((16, 6), np.float32), 1.0)
    nothing = Range(math.nan, math.nan, 0)
    sigmas = np.full(len(points_px), sigma_px)
    return Frame(transmitter, packet, number, t_us, soft, nothing, None, 0.0, 0.0, points_px, sigmas, t_us)


def fix(t_us: float, enu_m: Floats, noise_m2: Floats, **more: Any) -> Fix:
    """A fix of one bar whose errors are new each time; `more` of it."""
    given = {"enu_m": enu_m, "noise_m2": noise_m2, "covariance_m2": noise_m2, **more}
    return replace(Fix.from_refusal(t_us, (0,), "", ""), **given)


def square(error: Floats, covariance: Floats) -> float:
    """An error's square in its own sigmas."""
    return float(error @ np.linalg.solve(covariance, error))


def by_chance(squares: Sequence[float], freedom: int, level: float, slack: float = 1.0) -> bool:
    """Whether right covariances make the mean of squares so, at a level; `slack` for what is not linear."""
    low, high = stats.chi2.interval(level, freedom * len(squares))
    return bool(low / slack < np.sum(squares) < high * slack)
