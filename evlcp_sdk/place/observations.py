"""Observations of bars at known places and their errors, as arrays; or why they give no position."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel, CameraSigma

Floats = NDArray[np.float64]

CONTRADICTIONS = frozenset({"site-contradicted", "not-determined", "misfit"})
"""Kinds of rejection where observations contradict what is stated; for the others, too little is known."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One of the poses that fit: position, m, float64 (3,), and camera axes as columns in ENU, (3, 3).

    Attributes:
        covariance_m2: Of the position, if it is the right one, float64 (3, 3); NaN where an ellipse does not
            describe its error.
        likelihood: Of the image from here, relative to the likeliest candidate.
    """

    enu_m: NDArray[np.float64]
    rotation: NDArray[np.float64]
    covariance_m2: NDArray[np.float64]
    likelihood: float


@dataclass(frozen=True)
class Rejection:
    """Why there is no position.

    Attributes:
        kind: One of those in `docs/position.md`.
        detail: The same in words, with the figures of this case.
        candidates: For `two-solutions`, the poses that fit, the likeliest first.
        suspects: For `misfit`, the parts any one of which, left out, would explain it.
    """

    kind: str
    detail: str
    candidates: tuple[Candidate, ...] = ()
    suspects: tuple[str, ...] = ()


_COLLINEAR_SHARE = 0.02
"""Bars whose centres lie within this share of their extent from a line are in line: beyond, the shape of a
triangle of 10 m at 50 m is seen to better than a pixel, with a focal length of 7000 px."""

_MIN_ANGLE_RAD = 1e-7
"""Least sigma of an angle, so that exact knowledge stays solvable: 5 um at 50 m."""

_IDENTITY = np.eye(2)

_LEVI_CIVITA = np.zeros((3, 9))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _LEVI_CIVITA[_i, 3 * _j + _k], _LEVI_CIVITA[_i, 3 * _k + _j] = -1.0, 1.0


@dataclass(frozen=True, eq=False)
class BarView:
    """One bar as one camera sees it at one time.

    Attributes:
        transmitter: Number that the receiver gave it.
        enu_m: Centres of its clusters in the local axes, m, float64 (K, 3).
        points_px: Where they are seen, px, float64 (K, 2); NaN where unseen.
        sigma_px: Their standard deviations along the bar, px, float64 (K,).
        survey_sigmas: Of the bar's place, m, turn about each axis, radians, and length, a share; 0: exact.
        pixel_px: The part of `sigma_px` that persists until the image has moved; None for
            `ErrorModel.pixel_sigma_px`.
        shift_px: Error that all points share across the bar besides `ErrorModel.shared_sigma_px`, px.
        vibration: Unseen movement of the image between frames, in `ErrorModel.vibration_sigma_px`.
        timing_px: Error that all points share in any direction by the timing of a moving image, px.
        across: Ratio of the points' errors across the bar to those along it.
        stretch: Sigma of its apparent length, as a share, where its image is curved.
    """

    transmitter: int
    enu_m: Floats
    points_px: Floats
    sigma_px: Floats
    survey_sigmas: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pixel_px: float | None = None
    shift_px: float = 0.0
    vibration: float = 1.0
    timing_px: float = 0.0
    across: float = 1.0
    stretch: float = 0.0


def project_bars(
    enu_m: Floats, position_m: Floats, rotation: Floats, camera: CameraModel
) -> tuple[Floats, Floats]:
    """Image points of places, and their derivatives.

    Args:
        enu_m: Places, m, float64 (n, 3).
        position_m: The camera's, m, float64 (3,).
        rotation: Its axes as columns in ENU, float64 (3, 3).
        camera: The camera.

    Returns:
        Points, px, float64 (n, 2), NaN behind the camera; derivatives by the position, m, and by a small
        rotation of the camera about east, north and up, radians, float64 (n, 2, 6).
    """
    offset = enu_m - position_m
    in_camera = offset @ rotation
    visible = np.where(in_camera[:, 2:] > 0, in_camera, np.nan)
    slope = camera.projection_jacobian(visible) @ rotation.T
    by_rotation = np.cross(slope, offset[:, None, :])
    return camera.project(visible), np.concatenate([-slope, by_rotation], -1)


def perturb_camera(camera: CameraModel, errors: Floats) -> CameraModel:
    """Add errors to a camera's `CAMERA_PARAMETERS`, the focal length in px, float64 (7,)."""
    focal_px, x_px, y_px, *distortion = errors.tolist()
    names, centre = CAMERA_PARAMETERS[3:], camera.centre_px
    return replace(
        camera,
        focal_mm=max(camera.focal_px + focal_px, 1.0) * camera.pitch_um / 1e3,
        centre_x_px=centre[0] + x_px,
        centre_y_px=centre[1] + y_px,
        **{name: getattr(camera, name) + error for name, error in zip(names, distortion, strict=True)},
    )


def cross_matrices(vectors: Floats) -> Floats:
    """Matrices of vectors v (n, 3), float64 (n, 3, 3): times w they are v x w, and w times them is w x v."""
    return (vectors @ _LEVI_CIVITA).reshape(-1, 3, 3)


class SharedErrors(NamedTuple):
    """Errors that the points of a bar share, and whitening of their own; of several bars, arrays of these.

    Attributes:
        bar_sigmas: Of its place, m, rotation, radians, and true and apparent length, a share, float64 (3,).
        root: A root of the covariance of its image's shift, px, float64 (2, 2).
        whitening: Makes errors of a point, in its sigmas, isotropic and of sigma 1, float64 (2, 2).
    """

    bar_sigmas: Floats
    root: Floats
    whitening: Floats


class KnownAngles(NamedTuple):
    """The known angles of the camera's attitude.

    Attributes:
        rotation: The camera's axes as columns in ENU, facing north if the heading is unknown, float64 (3, 3).
        heading_rad: 0 if it is unknown.
        known: How many of pitch, roll and heading are known: 0, 2 or 3.
        whitening: Whitens the errors of these, float64 (3, 3).
        causes: Their shifts by one sigma of each standing error, whitened, float64 (3, 4).
        free: Whether rotations about east, north and up are unknowns.
    """

    rotation: Floats = np.eye(3)
    heading_rad: float = 0.0
    known: int = 0
    whitening: Floats = np.eye(3)
    causes: Floats = np.zeros((3, 4))
    free: tuple[bool, bool, bool] = (True, True, True)

    @classmethod
    def of(cls, attitude: Attitude | None, vibration_rad: float) -> Self:
        """The known angles of an attitude, with a vibration that rotates the camera by this sigma."""
        if attitude is None:
            return cls()
        has_heading = attitude.heading_deg is not None
        free = (True, True, True)
        sigmas = (attitude.gravity_sigma_deg, attitude.white_sigma_deg, attitude.time_sigma_us)
        if not any((vibration_rad, *sigmas)):
            free = (False, False, not has_heading or attitude.heading_sigma_deg > 0)
        causes, known = attitude.bias_root_rad(), 3 if has_heading else 2
        # Noise is the attitude's own, and vibration, which shifts an image down or sideways: it rotates the
        # camera about its horizontal and its upright axis, which is tilted by the pitch.
        pitch = math.radians(attitude.pitch_deg)
        by_vibration = [[1.0, 0.0], [0.0, math.tan(pitch)], [0.0, 1 / math.cos(pitch)]]
        moves = np.concatenate([causes, vibration_rad * np.array(by_vibration)], 1)
        noise = math.radians(attitude.white_sigma_deg) ** 2 + _MIN_ANGLE_RAD**2
        whitening = np.linalg.inv(np.linalg.cholesky(moves @ moves.T + noise * np.eye(3)))
        if known < 3:
            whitening[2] = (0.0, 0.0, 1.0)
        heading_rad = math.radians(attitude.heading_deg or 0.0)
        return cls(attitude.rotation(), heading_rad, known, whitening, whitening @ causes, free)


@dataclass(frozen=True, eq=False)
class Problem:
    """All points in one array, all sigmas, and which unknowns there are.

    Attributes:
        attitude: Its attitude as far as it is known; None if it is not.
        spec: Bounds and weights.
        points: A row for each cluster seen: its place in the local axes and from its bar's centre, m, its
            image point, px, 1 / sigma, and the share of its variance that persists a while, float64 (n, 10).
        bar: Index of each point's bar, rising, int64 (n,).
        errors: Shared errors of each bar, float64 (bars, 3), (bars, 2, 2), (bars, 2, 2).
        transmitters: Number of each bar's transmitter.
        lens_root: A lower root of the covariance of the camera's `CAMERA_PARAMETERS`, float64 (7, 7).
        vibration_rad: Sigma of the camera's rotation by vibration, common to all bars.
    """

    camera: CameraModel
    attitude: Attitude | None
    spec: ErrorModel
    points: Floats
    bar: NDArray[np.int64]
    errors: SharedErrors
    transmitters: tuple[int, ...]
    lens_root: Floats
    vibration_rad: float

    @cached_property
    def angles(self) -> KnownAngles:
        """The known angles of `attitude`."""
        return KnownAngles.of(self.attitude, self.vibration_rad)

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which of the fit's shared unknowns are free, bool (14,)."""
        free = np.ones(14, np.bool_)
        free[3:6], free[6], free[7:] = self.angles.free, False, self.lens_root.any()
        return free

    @cached_property
    def bar_slices(self) -> list[slice]:
        """Rows of each bar's points."""
        ends = np.cumsum(np.bincount(self.bar, minlength=len(self.transmitters))).tolist()
        return [slice(first, end) for first, end in zip([0, *ends], ends, strict=False)]

    @classmethod
    def of(
        cls,
        views: Sequence[BarView],
        camera: CameraModel,
        attitude: Attitude | None,
        spec: ErrorModel,
        sigma: CameraSigma,
    ) -> "Problem | Rejection":
        """Of views of bars; or why they are too few for a position."""
        vibration = common_vibration(views)
        transmitters: list[int] = []
        points: list[Floats] = []
        errors: list[SharedErrors] = []
        most_clusters = 0
        for view in views:
            usable = find_whole_clusters(view.points_px, view.sigma_px, camera.width, camera.height)
            count = int(usable.sum())
            most_clusters = max(most_clusters, count)
            if count >= spec.min_points:
                pixel_px = spec.pixel_sigma_px if view.pixel_px is None else view.pixel_px
                sigma_px = view.sigma_px[usable, None]
                # From the whole bar's centre, about which errors of its attitude rotate it.
                arm = (view.enu_m - view.enu_m.mean(0))[usable]
                share = np.minimum((pixel_px / sigma_px) ** 2, 1.0)
                transmitters.append(view.transmitter)
                columns = [view.enu_m[usable], arm, view.points_px[usable], 1 / sigma_px, share]
                points.append(np.concatenate(columns, 1))
                errors.append(compute_shared_errors(view, usable, spec, vibration))
        if not transmitters:
            why = f"{most_clusters} whole clusters of a bar seen, {spec.min_points} needed"
            return Rejection("too-few-clusters", why)
        problem = cls(
            camera=camera,
            attitude=attitude,
            spec=spec,
            points=np.concatenate(points),
            bar=np.repeat(np.arange(len(points)), [len(rows) for rows in points]),
            errors=SharedErrors(*map(np.array, zip(*errors, strict=True))),
            transmitters=tuple(transmitters),
            lens_root=sigma.covariance_root(camera),
            vibration_rad=vibration * spec.vibration_sigma_px / camera.focal_px,
        )
        return problem._check_determined()

    @property
    def freedom(self) -> int:
        """Degrees of freedom; every shared error has an observation of its own, that it is about 0."""
        return 2 * len(self.points) + self.angles.known - 6

    def with_attitude(self, attitude: Attitude | None) -> "Problem | Rejection":
        """The same with another attitude, or why that is too little."""
        return replace(self, attitude=attitude)._check_determined()

    def without_bar(self, bar: int) -> "Problem | Rejection":
        """The same without a bar, by its index in `transmitters`, or why the others are too few."""
        kept = self.bar != bar
        others = self.bar[kept]
        remaining = replace(
            self,
            points=self.points[kept],
            bar=others - (others > bar),
            errors=SharedErrors(*(np.delete(one, bar, 0) for one in self.errors)),
            transmitters=self.transmitters[:bar] + self.transmitters[bar + 1 :],
        )
        return remaining._check_determined()

    def _check_determined(self) -> "Problem | Rejection":
        """This problem, or why its attitude is too little for its bars."""
        bars = len(self.transmitters)
        if bars == 1 and self.angles.known < 3:
            why = "one bar gives a position only with the camera's heading known"
            return Rejection("heading-unknown", why)
        if self.attitude is None:
            centres = np.array([self.points[part, :3].mean(0) for part in self.bar_slices])
            along, across = np.linalg.svd(centres - centres.mean(0), compute_uv=False)[:2]
            if bars < 3 or across <= _COLLINEAR_SHARE * along:
                which = "two bars give" if bars == 2 else "bars in line give"
                return Rejection("gravity-unknown", f"{which} a position only with gravity known")
        return self

    @cached_property
    def centre(self) -> Floats:
        """Mean of the points' places, float64 (3,)."""
        return np.asarray(self.points[:, :3].mean(0))

    @cached_property
    def has_survey_errors(self) -> bool:
        """Whether places or attitudes of bars have errors."""
        return bool(self.errors.bar_sigmas[:, :2].any())


def common_vibration(views: Sequence[BarView]) -> float:
    """The part of `BarView.vibration` that all bars have in common."""
    return sum([view.vibration for view in views]) / max(len(views), 1)


def find_whole_clusters(points_px: Floats, sigma_px: Floats, width: int, height: int) -> NDArray[np.bool_]:
    """Find the clusters of a bar that are seen, have a sigma and are not cut off, bool (K,).

    A cluster is as long as the spacing of neighbours; three quarters of that and a pixel of blur must lie
    between its centre and the image's edge.
    """
    seen = np.flatnonzero(np.isfinite(points_px[:, 0]))
    edge = 0.5
    if len(seen) > 1:
        first, last = seen[0], seen[-1]
        edge += 0.75 * math.dist(points_px[first], points_px[last]) / (last - first)
    is_inside = (points_px >= edge) & (points_px <= np.array([width, height]) - 1 - edge)
    return np.asarray(is_inside.all(1) & (sigma_px > 0) & (sigma_px < math.inf))


def compute_shared_errors(
    view: BarView, seen: NDArray[np.bool_], spec: ErrorModel, vibration: float
) -> SharedErrors:
    """Errors that a bar's points share, by its clusters that are seen, bool (K,).

    The errors along a layout that is no line hold in all directions. The bar is as long as the distance of
    its farthest clusters, and a cluster's own length; its image's length follows from the part that is seen.

    Vibration is common to all bars as far as `vibration` says; a bar's own is the difference from that. These
    count as independent, so that two bars differ by as much as theirs do.
    """
    own_vibration_px = math.sqrt(2) * spec.vibration_sigma_px * abs(view.vibration - vibration)
    shift_px = math.hypot(own_vibration_px, view.timing_px)
    count, points = len(seen), view.points_px
    i, j = _find_farthest_pair(view.enu_m, np.flatnonzero(seen))
    first, last = _find_farthest_pair(view.enu_m, np.arange(count))
    share = math.dist(view.enu_m[first], view.enu_m[last]) / math.dist(view.enu_m[i], view.enu_m[j])
    share *= count / (count - 1)
    length_px = math.dist(points[i], points[j])
    along_px = math.hypot(spec.shared_along_px, shift_px, spec.shared_share * length_px * share)
    axis = (points[j] - points[i]) / length_px if length_px > 0 else np.array([1.0, 0.0])
    offset_px = (points[seen] - points[i]) @ np.array([axis[1], -axis[0]])
    # No point of a line is more than half a cluster off the line from end to end.
    is_line = length_px > 0 and bool((np.abs(offset_px) <= 0.5 * length_px * share / count).all())
    across_px = math.hypot(spec.shared_sigma_px, view.shift_px, shift_px) if is_line else along_px
    weight_across = 1 / view.across if is_line else 1 / max(view.across, 1.0)
    weight_along = 1.0 if is_line else weight_across
    (x, y), (place, turn, length) = axis.tolist(), view.survey_sigmas
    projection = np.array([[x * x, x * y], [x * y, y * y]])
    return SharedErrors(
        np.array([place, turn, math.hypot(length, spec.stretch_share, view.stretch)]),
        across_px * _IDENTITY + (along_px - across_px) * projection,
        weight_across * _IDENTITY + (weight_along - weight_across) * projection,
    )


def _find_farthest_pair(places: Floats, rows: NDArray[np.int64]) -> tuple[int, int]:
    """Find two places far apart: the farthest from the farthest from one."""
    one = other = int(rows[0])
    for _ in range(2):
        distance = np.linalg.norm(places[rows] - places[other], axis=1)
        one, other = other, int(rows[distance.argmax()])
    return one, other
