"""The camera's position from the image points of bars at known places.

One bar needs the camera's attitude; two or more need gravity and give the heading, too; three or more that do
not stand in line give the full attitude. All are one weighted least-squares problem over the image points of
all clusters, with what is known of the attitude as further observations. What the geometry does not determine
is refused, with the reason. Frames and signs: `docs/position.md`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel

__all__ = [
    "REFUSALS",
    "BarView",
    "Pose",
    "Refusal",
    "project_bars",
    "solve_pose",
    "three_point_poses",
]

Floats = NDArray[np.float64]

_STEPS = 50
"""Levenberg-Marquardt steps; from a closed-form start, five to ten arrive."""

_HEADINGS = 72
"""Headings tried at first where none is known: 5 degrees apart, a fraction of the basin of the fit."""

_ODDS = 18.4
"""Square sums that differ by less are not told apart: beyond, one solution is 10 000 times likelier."""

_APART_SIGMAS = 6.0
"""Solutions nearer to each other, in sigmas of the position, are one."""

_INLINE = 0.02
"""Bars whose centres lie within this share of their extent from a line stand in line: beyond, the shape of a
triangle of 10 m at 50 m is seen to better than a pixel of 7000 px."""

_EXACT_RAD = 1e-7
"""Least sigma of an angle, so that exact knowledge stays solvable: 5 um at 50 m."""

_MOST_BEND = 3.0
"""Ratio of the cost two sigmas away to its parabola's, beyond which an ellipse does not describe it."""

_OUTLIER_SHARE = 0.3
"""Share of points that may lie beyond the Huber bound before nothing is believed."""


REFUSALS = {
    "no-site": "no bar in view stands at a known place",
    "site-contradicted": "the bars' own beacons tell other places or lengths than their sites",
    "too-few-clusters": "no bar shows as many clusters as a position needs",
    "heading-unknown": "one bar alone, and the camera's heading is not known",
    "gravity-unknown": "fewer than three bars, or bars in line, and gravity is not known",
    "not-determined": "no start, no end of the fit, or equations that are singular",
    "two-solutions": "two places fit the image alike",
    "end-on": "a lone bar points along the line of sight",
    "misfit": "the image does not fit the sites: another place, bar or attitude than was said",
    "uncertain": "the position is less certain than `position.max_sigma_m`, or along a curve",
}
"""Kinds of refusal, and what they mean."""


@dataclass(frozen=True, eq=False)
class BarView:
    """One bar as one camera sees it at one time.

    Attributes:
        transmitter: Number that the receiver gave it.
        enu_m: Centres of its clusters in the local frame, m, float64 (K, 3).
        points_px: Where they are seen, px, float64 (K, 2); NaN where unseen.
        sigma_px: Their standard deviations, px, float64 (K,).
    """

    transmitter: int
    enu_m: Floats
    points_px: Floats
    sigma_px: Floats


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera's position and attitude.

    Attributes:
        enu_m: Position in the local frame, m, float64 (3,).
        rotation: Camera axes (right, down, forward) as columns in ENU, float64 (3, 3).
        covariance: Of position, m, and of a small turn about east, north and up, radians, float64 (6, 6);
            0 where an angle was taken as exact.
        noise: The part of `covariance` that changes from frame to frame: from the image, not from what was
            said about the attitude.
        misfit: Mean square of the misses in sigmas, over the degrees of freedom.
        transmitters: The bars that count.
    """

    enu_m: Floats
    rotation: Floats
    covariance: Floats
    noise: Floats
    misfit: float
    transmitters: tuple[int, ...]


@dataclass(frozen=True)
class Refusal:
    """Why there is no position.

    Attributes:
        kind: One of `REFUSALS`.
        detail: The same in words, with the figures of this case.
    """

    kind: str
    detail: str


def project_bars(
    enu_m: Floats, position_m: Floats, rotation: Floats, camera: CameraModel
) -> tuple[Floats, Floats]:
    """Image points of a camera's surroundings, and their derivatives.

    Args:
        enu_m: Points, m, float64 (n, 3).
        position_m: The camera's, m, float64 (3,).
        rotation: Its axes as columns in ENU, float64 (3, 3).
        camera: The camera.

    Returns:
        Points, px, float64 (n, 2), NaN behind the camera; derivatives by the position, m, and by a small turn
        of the camera about east, north and up, radians, float64 (n, 2, 6).
    """
    offset = enu_m - position_m
    seen = offset @ rotation
    ahead = np.where(seen[:, 2:] > 0, seen, np.nan)
    slope = camera.project_slope(ahead) @ rotation.T
    turned = np.cross(slope, offset[:, None, :])
    return camera.project(ahead), np.concatenate([-slope, turned], -1)


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
    problem = _Problem.of(views, camera, attitude, spec)
    if isinstance(problem, Refusal):
        return problem
    starts = _starts(problem)
    if not starts:
        return Refusal("not-determined", "no place from which the bars would be seen so")
    fits = [fit for start in starts if (fit := _fit(problem, *start)) is not None]
    if not fits:
        return Refusal("not-determined", "the fit does not settle: the bars do not determine a position")
    best = min(fits, key=lambda fit: fit.cost)
    pose = _judged(problem, best)
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


@dataclass(frozen=True, eq=False)
class _Problem:
    """All points in one array, and which unknowns there are.

    Attributes:
        bar: Number of each point's bar, int64 (n,).
        turns: Which turns of the camera are unknown: all, about the vertical only, or none.
        compass: The heading is known, with or without a sigma.
    """

    camera: CameraModel
    attitude: Attitude | None
    spec: PositionSpec
    enu_m: Floats
    points_px: Floats
    sigma_px: Floats
    bar: NDArray[np.int64]
    centres_m: Floats
    transmitters: tuple[int, ...]
    turns: tuple[int, ...]
    compass: bool

    @classmethod
    def of(
        cls, views: Sequence[BarView], camera: CameraModel, attitude: Attitude | None, spec: PositionSpec
    ) -> "_Problem | Refusal":
        kept, most = [], 0
        for view in views:
            seen = np.isfinite(view.points_px).all(1) & np.isfinite(view.sigma_px) & (view.sigma_px > 0)
            seen &= _whole(view.points_px, camera)
            most = max(most, int(seen.sum()))
            if seen.sum() >= spec.min_points:
                kept.append((view, seen))
        if not kept:
            return Refusal(
                "too-few-clusters", f"{most} whole clusters of a bar seen, {spec.min_points} needed"
            )
        compass = attitude is not None and attitude.heading_deg is not None
        centres = np.array([v.enu_m[s].mean(0) for v, s in kept])
        if not compass and len(kept) == 1:
            return Refusal("heading-unknown", "one bar gives a position only with the camera's heading known")
        if attitude is None:
            extent = np.linalg.svd(centres - centres.mean(0), compute_uv=False)
            if len(kept) < 3 or extent[1] < _INLINE * extent[0]:
                many = "two bars give" if len(kept) == 2 else "bars in line give"
                return Refusal("gravity-unknown", f"{many} a position only with gravity known")
        turns: tuple[int, ...] = (0, 1, 2)
        if attitude is not None and attitude.gravity_sigma_deg == 0:
            turns = () if compass and attitude.heading_sigma_deg == 0 else (2,)
        return cls(
            camera,
            attitude,
            spec,
            np.concatenate([v.enu_m[s] for v, s in kept]),
            np.concatenate([v.points_px[s] for v, s in kept]),
            np.concatenate([v.sigma_px[s] for v, s in kept]),
            np.repeat(np.arange(len(kept)), [int(s.sum()) for _, s in kept]),
            centres,
            tuple(v.transmitter for v, _ in kept),
            turns,
            compass,
        )

    def sights(self) -> Floats:
        """Unit vectors towards the points in the camera's axes, float64 (n, 3); NaN beyond the lens."""
        flat = self.camera.undistort(self.points_px)
        ray = np.concatenate([flat, np.ones((len(flat), 1))], 1)
        return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def _whole(points_px: Floats, camera: CameraModel) -> NDArray[np.bool_]:
    """Which clusters do not touch the image's edge: of one that is cut off, only a part is seen.

    A cluster is as long as the spacing of neighbours; three quarters of it and a pixel of blur must be free.
    """
    gaps = np.linalg.norm(np.diff(points_px, axis=0), axis=1)
    gap = float(np.median(gaps[np.isfinite(gaps)])) if np.isfinite(gaps).any() else 0.0
    margin = 0.75 * gap + 1
    low = points_px - margin >= -0.5
    high = points_px + margin <= np.array([camera.width, camera.height]) - 0.5
    return np.asarray((low & high).all(1))


@dataclass(frozen=True, eq=False)
class _Fit:
    position: Floats
    rotation: Floats
    shared: Floats
    cost: float


def _starts(problem: _Problem) -> list[tuple[Floats, Floats]]:
    """Closed-form (position, rotation) to fit from."""
    sights = problem.sights()
    good = np.isfinite(sights).all(1)
    if good.sum() < 3:
        return []
    sights, enu = sights[good], problem.enu_m[good]
    if problem.attitude is None:
        return _three_point_starts(problem)
    known = problem.attitude.rotation()
    if problem.compass:
        position, cost = _nearest_to_sights(enu, sights @ known.T)
        return [(position, known)] if np.isfinite(cost) else []
    angle = np.arange(_HEADINGS) * (2 * math.pi / _HEADINGS)
    turned = np.zeros((_HEADINGS, 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(angle)
    turned[:, 1, 0], turned[:, 0, 1] = np.sin(angle), -np.sin(angle)
    turned[:, 2, 2] = 1
    rotations = turned @ known
    positions, costs = _nearest_to_sights(enu, sights @ rotations.transpose(0, 2, 1))
    # A start from each valley, so that a second solution is found where there is one.
    low = (costs <= np.roll(costs, 1)) & (costs <= np.roll(costs, -1)) & np.isfinite(costs)
    order = [int(i) for i in np.argsort(costs) if low[i]][:4]
    return [(positions[i], rotations[i]) for i in order]


def _nearest_to_sights(enu_m: Floats, sights: Floats) -> tuple[Floats, Floats]:
    """The point nearest to all lines through `enu_m` along `sights`, and how far it is from them.

    Args:
        enu_m: Points, m, float64 (n, 3).
        sights: Unit vectors, float64 (..., n, 3).

    Returns:
        Points, m, float64 (..., 3), and the sum of 1 - cosine of the angles by which the lines miss them,
        float64 (...,): large where lines lead there from behind, infinite where it is not determined.
    """
    normal = len(enu_m) * np.eye(3) - np.swapaxes(sights, -1, -2) @ sights
    # What the lines leave open, as when all are parallel, is a direction of no curvature.
    determined = np.linalg.eigvalsh(normal)[..., 0] > 1e-12 * len(enu_m)
    normal = np.where(determined[..., None, None], normal, np.eye(3))
    along = (sights * enu_m).sum(-1, keepdims=True)
    position = np.linalg.solve(normal, (enu_m - sights * along).sum(-2)[..., None])[..., 0]
    offset = enu_m - position[..., None, :]
    distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-9)
    cost = (1 - (offset * sights).sum(-1) / distance).sum(-1)
    return position, np.where(determined, cost, np.inf)


def _three_point_starts(problem: _Problem) -> list[tuple[Floats, Floats]]:
    """Grunert's solutions for the three bars that span the largest triangle."""
    sights = problem.sights()
    centres, seen = problem.centres_m, []
    for i in range(len(centres)):
        mean = sights[problem.bar == i].mean(0)
        seen.append(mean / np.linalg.norm(mean))

    def area(three: list[int]) -> float:
        a, b, c = centres[three]
        return float(np.linalg.norm(np.cross(b - a, c - a)))

    three = max((list(c) for c in combinations(range(len(centres)), 3)), key=area)
    return three_point_poses(centres[three], np.array(seen)[three])


def three_point_poses(enu_m: Floats, sights: Floats) -> list[tuple[Floats, Floats]]:
    """Positions and rotations from which three points are seen in three directions (Grunert 1841).

    In the notation of Haralick et al., IJCV 13 (1994), 331. Complex roots, as noise makes of double ones,
    count with their real part.

    Args:
        enu_m: The points, m, float64 (3, 3).
        sights: Unit vectors towards them in the camera's axes, float64 (3, 3).

    Returns:
        Up to four pairs of position, m, float64 (3,), and camera axes as columns in ENU, float64 (3, 3).
    """
    p, j = enu_m, sights
    a2, b2, c2 = (float(((p[m] - p[n]) ** 2).sum()) for m, n in ((1, 2), (0, 2), (0, 1)))
    ca, cb, cg = float(j[1] @ j[2]), float(j[0] @ j[2]), float(j[0] @ j[1])
    q, r, s = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2
    quartic = [
        (q - 1) ** 2 - 4 * s * ca**2,
        4 * (q * (1 - q) * cb - (1 - r) * ca * cg + 2 * s * ca**2 * cb),
        2 * (q**2 - 1 + 2 * q**2 * cb**2 + 2 * (b2 - c2) / b2 * ca**2 - 4 * r * ca * cb * cg
             + 2 * (b2 - a2) / b2 * cg**2),
        4 * (-q * (1 + q) * cb + 2 * a2 / b2 * cg**2 * cb - (1 - r) * ca * cg),
        (1 + q) ** 2 - 4 * a2 / b2 * cg**2,
    ]  # fmt: skip
    found = []
    for v in np.roots(quartic).real:
        bottom = 2 * (cg - v * ca)
        if v <= 0 or abs(bottom) < 1e-15:
            continue
        u = ((-1 + q) * v**2 - 2 * q * cb * v + 1 + q) / bottom
        square = 1 + v * v - 2 * v * cb
        if u <= 0 or square <= 0:
            continue
        first = math.sqrt(b2 / square)
        seen = np.array([first, u * first, v * first])[:, None] * j
        # Kabsch: the rotation that brings the points as seen onto the points as they stand.
        left, _, right = np.linalg.svd((p - p.mean(0)).T @ (seen - seen.mean(0)))
        rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        found.append((p.mean(0) - rotation @ seen.mean(0), rotation))
    return found


def _turn(vector: Floats) -> Floats:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3) + _cross(vector)
    k = _cross(vector / angle)
    return np.asarray(np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * (k @ k))


def _cross(v: Floats) -> Floats:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _observations(
    problem: _Problem, position: Floats, rotation: Floats, shared: Floats
) -> tuple[Floats, Floats, Floats, Floats] | None:
    """Misses and slopes in sigmas: of the image (n, 2), (n, 2, u), and of what is known (m,), (m, u).

    Unknowns: position, the turns, and a shift of each bar's image that its points share. None where a
    point is behind the camera.
    """
    spec, turns = problem.spec, list(problem.turns)
    place, slope = project_bars(problem.enu_m, position, rotation, problem.camera)
    if not np.isfinite(place).all():
        return None
    weight = 1 / problem.sigma_px
    bars = len(problem.transmitters) if spec.shared_sigma_px else 0
    n, unknowns = len(place), 3 + len(turns) + 2 * bars
    image = np.zeros((n, 2, unknowns))
    image[:, :, :3] = slope[:, :, :3]
    image[:, :, 3 : 3 + len(turns)] = slope[:, :, [3 + t for t in turns]]
    known: list[float] = []
    rows: list[Floats] = []
    row: Floats
    if bars:
        at = 3 + len(turns) + 2 * problem.bar
        for axis in (0, 1):
            image[np.arange(n), axis, at + axis] = 1
        place = place + shared[problem.bar]
        for i, value in enumerate(shared.ravel().tolist()):
            row = np.zeros(unknowns)
            row[3 + len(turns) + i] = 1 / spec.shared_sigma_px
            known.append(-value / spec.shared_sigma_px)
            rows.append(row)
    if problem.attitude is not None:
        misses, turned = _attitude_misses(problem.attitude, rotation)
        exact = problem.attitude.gravity_sigma_deg == 0
        for i, (value, by_turn) in enumerate(zip(misses, turned, strict=True)):
            if turns and not (exact and i < 2):
                row = np.zeros(unknowns)
                row[3 : 3 + len(turns)] = by_turn[turns]
                known.append(value)
                rows.append(row)
    miss = (problem.points_px - place) * weight[:, None]
    rows_array = np.array(rows).reshape(-1, unknowns)
    return miss, image * weight[:, None, None], np.array(known), rows_array


def _attitude_misses(attitude: Attitude, rotation: Floats) -> tuple[list[float], list[Floats]]:
    """Gravity to the east and north, then the heading, minus what the rotation says, in sigmas; slopes."""
    gravity_sigma = max(math.radians(attitude.gravity_sigma_deg), _EXACT_RAD)
    # Up as the sensor felt it, turned as the camera is: level if the rotation is right.
    felt = rotation @ attitude.rotation()[2]
    leans = -_cross(felt)
    misses = [-float(felt[i]) / gravity_sigma for i in (0, 1)]
    slopes = [leans[i] / gravity_sigma for i in (0, 1)]
    if attitude.heading_deg is not None:
        sigma = max(math.radians(attitude.heading_sigma_deg), _EXACT_RAD)
        east, north, up = rotation[:, 2]
        level = max(east * east + north * north, 1e-12)
        off = math.radians(attitude.heading_deg) - math.atan2(east, north)
        misses.append(math.remainder(off, 2 * math.pi) / sigma)
        # d(forward) = turn x forward.
        slopes.append(np.array([east * up, north * up, -level]) / level / sigma)
    return misses, slopes


def _fit(problem: _Problem, position: Floats, rotation: Floats) -> _Fit | None:
    """Levenberg-Marquardt with Huber's weights; None where it leaves the view or does not settle."""
    bars = len(problem.transmitters)
    here = _Fit(position, rotation, np.zeros((bars, 2)), np.inf)
    found = _linear(problem, here)
    if found is None:
        return None
    normal, right, cost = found
    here = _Fit(position, rotation, here.shared, cost)
    damping = 1e-4
    for _ in range(_STEPS):
        try:
            move = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), right)
        except np.linalg.LinAlgError:
            return None
        there = _moved(problem, here, np.asarray(move, np.float64))
        found = _linear(problem, there)
        if found is not None and found[2] <= here.cost:
            gain = here.cost - found[2]
            normal, right, cost = found
            here = _Fit(there.position, there.rotation, there.shared, cost)
            damping = max(damping / 10, 1e-12)
            if gain <= 1e-9 * (1 + cost) and float(np.abs(right @ move)) < 1e-6:
                return here
        else:
            damping *= 10
            if damping > 1e12:
                # No step is an improvement any more: rounding decides.
                return here if float(right @ move) < 1e-3 else None
    return None


def _linear(problem: _Problem, at: _Fit) -> tuple[Floats, Floats, float] | None:
    """Normal equations and twice the robust cost; None where a point is behind the camera."""
    seen = _observations(problem, at.position, at.rotation, at.shared)
    if seen is None:
        return None
    miss, image, known, rows = seen
    size = np.linalg.norm(miss, axis=1)
    bound = problem.spec.huber_sigmas
    far = size > bound
    weight = np.where(far, bound / np.maximum(size, 1e-300), 1.0)
    cost = float(np.where(far, bound * (2 * size - bound), size**2).sum() + (known**2).sum())
    flat, flat_miss = image.reshape(-1, image.shape[2]), miss.ravel()
    weighted = flat * np.repeat(weight, 2)[:, None]
    return flat.T @ weighted + rows.T @ rows, weighted.T @ flat_miss + rows.T @ known, cost


def _judged(problem: _Problem, fit: _Fit) -> Pose | Refusal:
    """The pose with its covariance, or why it cannot be trusted."""
    spec = problem.spec
    found = _linear(problem, fit)
    seen = _observations(problem, fit.position, fit.rotation, fit.shared)
    assert found is not None
    assert seen is not None
    normal = found[0]
    miss, _, known, rows = seen
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scale * scale[:, None]
    if np.linalg.cond(scaled) > 1e14:
        return Refusal("not-determined", "the equations are singular")
    full = np.linalg.inv(scaled) * scale * scale[:, None]
    size = np.linalg.norm(miss, axis=1)
    outliers = int((size > spec.huber_sigmas).sum())
    if outliers > _OUTLIER_SHARE * len(size):
        return Refusal("misfit", f"{outliers} of {len(size)} points do not lie where the sites have them")
    freedom = max(2 * len(size) + len(known) - len(normal), 1)
    misfit = float((np.minimum(size, spec.huber_sigmas) ** 2).sum() + (known**2).sum()) / freedom
    if misfit > spec.max_misfit:
        return Refusal("misfit", f"the points miss the sites by {math.sqrt(misfit):.1f} sigmas (rms)")
    if len(problem.transmitters) == 1:
        first, last = problem.enu_m[0] - fit.position, problem.enu_m[-1] - fit.position
        axis, sight = last - first, first + last
        sine = np.linalg.norm(np.cross(axis, sight)) / np.linalg.norm(axis) / np.linalg.norm(sight)
        if sine < math.sin(math.radians(spec.min_view_deg)):
            return Refusal(
                "end-on", f"the bar is seen {math.degrees(math.asin(sine)):.0f} degrees from its axis"
            )
    spread = float(np.sqrt(np.linalg.eigvalsh(full[:3, :3])[-1]))
    if spread > spec.max_sigma_m:
        return Refusal("uncertain", f"by {spread:.1f} m, more than {spec.max_sigma_m:g} m")
    bend = _bend(problem, fit, full)
    if bend > _MOST_BEND:
        return Refusal("uncertain", f"by {spread:.2f} m along a curve: an ellipse would mislead")
    turns = len(problem.turns)
    told = rows[len(known) - _told(problem) :]
    systematic = full @ (told.T @ told) @ full
    where = [0, 1, 2, *(3 + t for t in problem.turns)]
    covariance, noise = np.zeros((6, 6)), np.zeros((6, 6))
    covariance[np.ix_(where, where)] = full[: 3 + turns, : 3 + turns]
    noise[np.ix_(where, where)] = (full - systematic)[: 3 + turns, : 3 + turns]
    return Pose(fit.position, fit.rotation, covariance, noise, misfit, problem.transmitters)


def _bend(problem: _Problem, fit: _Fit, covariance: Floats) -> float:
    """How far the cost is from its parabola two sigmas away along the position's least certain axis.

    The larger of the ratios, or of their inverses, of the true and the expected growth to both sides. Of a
    lone bar, angles and shared shift follow the position: the arc that an uncertain heading leaves is bent by
    less than these allow. Of several bars they stay, as they would hide the circle through the bars.
    """
    values, axes = np.linalg.eigh(covariance[:3, :3])
    move = np.asarray(2 * covariance[:, :3] @ axes[:, -1] / math.sqrt(values[-1]), np.float64)
    worst = 1.0
    for side in (-1.0, 1.0):
        there = _moved(problem, fit, np.asarray(side * move, np.float64))
        found = _linear(problem, there)
        if found is not None and len(problem.transmitters) == 1:
            follow = np.linalg.solve(found[0][3:, 3:], found[1][3:])
            found = _linear(problem, _moved(problem, there, np.concatenate([np.zeros(3), follow])))
        growth = 1e-9 if found is None else max((found[2] - fit.cost) / 4, 1e-9)
        worst = max(worst, growth, 1 / growth)
    return worst


def _moved(problem: _Problem, fit: _Fit, move: Floats) -> _Fit:
    """The fit with its unknowns moved."""
    n = len(problem.turns)
    turns = np.zeros(3)
    turns[list(problem.turns)] = move[3 : 3 + n]
    shared = fit.shared + move[3 + n :].reshape(-1, 2) if len(move) > 3 + n else fit.shared
    return _Fit(fit.position + move[:3], _turn(turns) @ fit.rotation, shared, np.inf)


def _told(problem: _Problem) -> int:
    """How many of the known values speak of the attitude; they stand last."""
    if problem.attitude is None or not problem.turns:
        return 0
    return (0 if problem.attitude.gravity_sigma_deg == 0 else 2) + problem.compass
