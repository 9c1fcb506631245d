"""The camera's position from the image points of bars at known places.

One bar needs the camera's attitude; two or more need gravity and give the heading, too; three or more that do
not stand in line give the full attitude. All are one weighted least-squares problem over the image points of
all clusters, with what is known of the attitude as further observations. What the geometry does not determine
is refused, with the reason. Frames and signs: `docs/position.md`.
"""

from collections.abc import Sequence

import numpy as np

from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.place.fit import fit_pose
from evlcp_sdk.place.judgement import Pose, judged
from evlcp_sdk.place.observations import BarView, Problem
from evlcp_sdk.place.refusals import Refusal
from evlcp_sdk.place.starts import closed_form_starts
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel

__all__ = ["solve_pose"]

_ODDS = 18.4
"""Square sums that differ by less are not told apart: beyond, one solution is 10 000 times likelier."""

_APART_SIGMAS = 6.0
"""Solutions nearer to each other, in sigmas of the position, are one."""


def solve_pose(
    views: Sequence[BarView],
    camera: CameraModel,
    attitude: Attitude | None = None,
    spec: PositionSpec | None = None,
) -> Pose | Refusal:
    """Fit position and attitude to all image points.

    Huber's loss over the miss of each point in its sigmas; Levenberg-Marquardt from closed-form starts: with
    the heading known, the point nearest to all lines of sight; with gravity known, the best of these over the
    headings; else the three-point solutions (Grunert) of the widest triangle of bars.

    Args:
        views: The bars seen at one time.
        camera: The camera.
        attitude: What is known of its attitude; its heading may be None; None for nothing.
        spec: Bounds and weights; None for the defaults.

    Returns:
        The pose, or why the geometry does not determine one.
    """
    spec = PositionSpec() if spec is None else spec
    problem = Problem.of(views, camera, attitude, spec)
    if isinstance(problem, Refusal):
        return problem
    starts = closed_form_starts(problem)
    if not starts:
        return Refusal("not-determined", "no place from which the bars would be seen so")
    fits = [fit for start in starts if (fit := fit_pose(problem, *start)) is not None]
    if not fits:
        return Refusal("not-determined", "the fit does not settle: the bars do not determine a position")
    best = min(fits, key=lambda fit: fit.cost)
    pose = judged(problem, best)
    if isinstance(pose, Refusal):
        return pose
    for other in fits:
        apart = other.position - best.position
        far = apart @ np.linalg.pinv(pose.covariance[:3, :3]) @ apart > _APART_SIGMAS**2
        if far and other.cost - best.cost < _ODDS:
            return Refusal(
                "two-solutions", f"two positions {np.linalg.norm(apart):.2f} m apart fit the image alike"
            )
    return pose
