"""How far off the bar stands that the rest of a fix contradicts: what `$INGBS` says of it."""

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.fit_assessment import Pose
from evlcp_sdk.place.observations import Problem, project_bars
from evlcp_sdk.place.quantiles import chance_below, chi_square
from evlcp_sdk.values import FailedBar

Floats = NDArray[np.float64]

_STEPS = 4
"""Of Gauss and Newton; the image of a bar is nearly linear in where it stands."""

_FREEDOM = 6
"""Of the test of a bar: three of its place, three of its attitude."""


def estimate_fault(problem: Problem, bar: int, pose: Pose, test: float, parts: int) -> FailedBar:
    """Where a bar stands by its image, seen from a pose that does without it.

    Weighted least squares over its points, which share the shift of its image, for its place; its attitude
    and length are taken as its site says.

    Args:
        problem: All that is seen, this bar, too.
        bar: Its place among `problem.transmitters`.
        pose: The pose without it.
        test: Its test value.
        parts: How many parts are tested.
    """
    rows = problem.points[problem.bar == bar]
    shift, even = (
        np.array([[one[0], one[1]], [one[1], one[2]]]) for one in problem.bar_sigma[bar, 3:].reshape(2, 3)
    )
    weight = rows[:, 8, None, None] * even
    shift = (weight @ shift).reshape(-1, 2)
    whole = np.linalg.inv(np.eye(2 * len(rows)) + shift @ shift.T)
    off_m = np.zeros(3)
    for _ in range(_STEPS):
        points, slope = project_bars(rows[:, :3] + off_m, pose.enu_m, pose.rotation, problem.camera)
        by_pose = (weight @ slope).reshape(-1, 6)
        by_place = -by_pose[:, :3]
        missed = (weight @ (rows[:, 6:8] - points)[:, :, None]).ravel()
        follow = np.linalg.solve(by_place.T @ whole @ by_place, by_place.T @ whole)
        off_m = off_m + follow @ missed
    place_m = problem.bar_sigma[bar, 0]
    by_camera = follow @ by_pose
    covariance = follow @ np.linalg.inv(whole) @ follow.T + by_camera @ pose.covariance @ by_camera.T
    covariance = covariance + place_m**2 * np.eye(3)
    limit = chi_square(problem.spec.false_alarm / 2 / parts, _FREEDOM)
    missed_by_test = chance_below(limit, _FREEDOM, test)
    return FailedBar(problem.transmitters[bar], off_m, covariance, missed_by_test)
