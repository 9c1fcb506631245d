"""What a camera sees of bars at known places, and how that moves with it: misses and slopes in sigmas."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.place.refusals import Refusal
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel

__all__ = ["BarView", "Observations", "Problem", "cross_matrix", "observe", "project_bars"]

Floats = NDArray[np.float64]

_INLINE = 0.02
"""Bars whose centres lie within this share of their extent from a line stand in line: beyond, the shape of a
triangle of 10 m at 50 m is seen to better than a pixel of 7000 px."""

_EXACT_RAD = 1e-7
"""Least sigma of an angle, so that exact knowledge stays solvable: 5 um at 50 m."""


@dataclass(frozen=True, eq=False)
class BarView:
    """One bar as one camera sees it at one time.

    Attributes:
        transmitter: Number that the receiver gave it.
        enu_m: Centres of its clusters in the local axes, m, float64 (K, 3).
        points_px: Where they are seen, px, float64 (K, 2); NaN where unseen.
        sigma_px: Their standard deviations, px, float64 (K,).
    """

    transmitter: int
    enu_m: Floats
    points_px: Floats
    sigma_px: Floats


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


@dataclass(frozen=True, eq=False)
class Problem:
    """All points in one array, and which unknowns there are.

    Attributes:
        camera: The camera.
        attitude: What is known of its attitude; None for nothing.
        spec: Bounds and weights.
        enu_m: The clusters that are seen, in the local axes, m, float64 (n, 3).
        points_px: Where they are seen, px, float64 (n, 2).
        sigma_px: Their standard deviations, px, float64 (n,).
        bar: Number of each point's bar, int64 (n,).
        centres_m: Mean of each bar's clusters, m, float64 (bars, 3).
        transmitters: Number of each bar.
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
    ) -> "Problem | Refusal":
        """What the views give, or why that is too little for a position."""
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
class Observations:
    """Misses, and their slopes by the unknowns, in sigmas.

    The unknowns are the position, the turns, and a shift of each bar's image that its points share.

    Attributes:
        miss: Of the image, float64 (n, 2).
        slope: Of where the points are seen, float64 (n, 2, u).
        known_miss: Of what is known beforehand, float64 (m,): the shared shifts, then the attitude.
        known_slope: Of the same, float64 (m, u).
        attitude: Rows of these two that speak of the attitude.
    """

    miss: Floats
    slope: Floats
    known_miss: Floats
    known_slope: Floats
    attitude: slice


def observe(problem: Problem, position: Floats, rotation: Floats, shared: Floats) -> Observations | None:
    """What is observed, against a position (3,), a rotation (3, 3) and shared shifts (bars, 2), px.

    None where a point is behind the camera.
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
    shifts = len(rows)
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
    return Observations(
        miss,
        image * weight[:, None, None],
        np.array(known),
        np.array(rows).reshape(-1, unknowns),
        slice(shifts, None),
    )


def _attitude_misses(attitude: Attitude, rotation: Floats) -> tuple[list[float], list[Floats]]:
    """Gravity to the east and north, then the heading, minus what the rotation says, in sigmas; slopes."""
    gravity_sigma = max(math.radians(attitude.gravity_sigma_deg), _EXACT_RAD)
    # Up as the sensor felt it, turned as the camera is: level if the rotation is right.
    felt = rotation @ attitude.rotation()[2]
    leans = -cross_matrix(felt)
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


def cross_matrix(v: Floats) -> Floats:
    """The matrix, float64 (3, 3), that multiplies as the cross product with a vector (3,) does."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
