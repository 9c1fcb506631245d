"""What a camera sees of bars at known places, with everything that is known of its errors, in arrays;
or why that gives no position.
"""

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
"""Kinds of refusal where what is seen and what is said do not fit together; of others too little is known."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One of the poses that fit: position, m, float64 (3,), and camera axes as columns in ENU, (3, 3).

    Attributes:
        covariance_m2: Of the position, if it is the right one, float64 (3, 3); NaN where an ellipse does not
            describe its error.
        likelihood: How likely the image is from here, against the likeliest.
    """

    enu_m: NDArray[np.float64]
    rotation: NDArray[np.float64]
    covariance_m2: NDArray[np.float64]
    likelihood: float


@dataclass(frozen=True)
class Rejection:
    """Why there is no position.

    Attributes:
        kind: One of those of `docs/position.md`.
        detail: The same in words, with the figures of this case.
        candidates: Of `two-solutions`, the poses that fit, the likeliest first.
        suspects: Of `misfit`, the parts of which one, if it were left out, would explain it.
    """

    kind: str
    detail: str
    candidates: tuple[Candidate, ...] = ()
    suspects: tuple[str, ...] = ()


_INLINE = 0.02
"""Bars whose centres lie within this share of their extent from a line stand in line: beyond, the shape of a
triangle of 10 m at 50 m is seen to better than a pixel of 7000 px."""

EXACT_RAD = 1e-7
"""Least sigma of an angle, so that exact knowledge stays solvable: 5 um at 50 m."""

_BOTH = np.eye(2)
"""Columns and rows alike."""

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
        sigma_px: Their standard deviations, px, float64 (K,).
        survey: Sigmas of the bar's place, m, of a turn of it about each axis, radians, and of its length, as
            a share; 0: exact.
        pixel_px: The part of `sigma_px` that stands until the image has moved; None: `position.
            pixel_sigma_px`.
        shift_px: What all points share across the bar besides `ErrorModel.shared_sigma_px`, px.
        between: How far the image may have moved otherwise than its frames show, in `position.
            shaken_sigma_px`.
        early_px: What all points share in any direction besides, as a moving image is seen early or late, px.
        across: Errors of points across the bar, in those along it, which `sigma_px` are.
        stretch: By how much it looks too long, or short, as its image is bent: a share (sigma).
    """

    transmitter: int
    enu_m: Floats
    points_px: Floats
    sigma_px: Floats
    survey: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pixel_px: float | None = None
    shift_px: float = 0.0
    between: float = 1.0
    early_px: float = 0.0
    across: float = 1.0
    stretch: float = 0.0


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
    slope = camera.projection_jacobian(ahead) @ rotation.T
    turned = np.cross(slope, offset[:, None, :])
    return camera.project(ahead), np.concatenate([-slope, turned], -1)


def camera_off(camera: CameraModel, errors: Floats) -> CameraModel:
    """A camera whose `CAMERA_PARAMETERS` are off by so much, the focal length in px, float64 (7,)."""
    focal_px, x_px, y_px, *bent = errors.tolist()
    names, centre = CAMERA_PARAMETERS[3:], camera.centre_px
    return replace(
        camera,
        focal_mm=max(camera.focal_px + focal_px, 1.0) * camera.pitch_um / 1e3,
        centre_x_px=centre[0] + x_px,
        centre_y_px=centre[1] + y_px,
        **{name: getattr(camera, name) + more for name, more in zip(names, bent, strict=True)},
    )


def skewed(vectors: Floats) -> Floats:
    """Matrices of vectors v (n, 3), float64 (n, 3, 3): times w it is v x w, and w times it is w x v."""
    return (vectors @ _LEVI_CIVITA).reshape(-1, 3, 3)


class SharedErrors(NamedTuple):
    """What the points of a bar share, and how they err; of several bars, arrays of these.

    Attributes:
        survey: Sigmas of the bar's place, m, its turn, radians, and its length, a share, to which is added by
            how much it looks too long, float64 (3,).
        root: A root of the covariance of its image's shift, px, float64 (2, 2).
        even: What makes errors of a point even in all directions and of sigma 1, float64 (2, 2).
    """

    survey: Floats
    root: Floats
    even: Floats


class KnownAngles(NamedTuple):
    """What an attitude says, or nothing.

    Attributes:
        level: The camera's axes as columns in ENU by it, north where no heading is known, float64 (3, 3).
        heading_rad: By it; 0 where it is not known.
        known: How many of pitch, roll and heading are known: 0, 2 or 3.
        white: What whitens the errors of these, float64 (3, 3).
        causes: What moves these by its sigmas, whitened, float64 (3, 4).
        turns: Whether turns about east, north and up are unknowns.
    """

    level: Floats = np.eye(3)
    heading_rad: float = 0.0
    known: int = 0
    white: Floats = np.eye(3)
    causes: Floats = np.zeros((3, 4))
    turns: tuple[bool, bool, bool] = (True, True, True)

    @classmethod
    def of(cls, attitude: Attitude | None, shaken_rad: float) -> Self:
        """What is known, where what shifts the images of all bars alike is a turn by `shaken_rad`."""
        if attitude is None:
            return cls()
        compass = attitude.heading_deg is not None
        turns = (True, True, True)
        unsure = (attitude.gravity_sigma_deg, attitude.white_sigma_deg, attitude.time_sigma_us)
        if not any((shaken_rad, *unsure)):
            turns = (False, False, not compass or attitude.heading_sigma_deg > 0)
        causes, known = attitude.bias_root_rad(), 3 if compass else 2
        # All err anew with each time, too: as the attitude's own noise does, and what shifts an image down or
        # aside, as a camera turns about its own axes across and upright: the second is not the world's.
        pitch = math.radians(attitude.pitch_deg)
        aside = [[1.0, 0.0], [0.0, math.tan(pitch)], [0.0, 1 / math.cos(pitch)]]
        moves = np.concatenate([causes, shaken_rad * np.array(aside)], 1)
        least = math.radians(attitude.white_sigma_deg) ** 2 + EXACT_RAD**2
        white = np.linalg.inv(np.linalg.cholesky(moves @ moves.T + least * np.eye(3)))
        if known < 3:
            white[2] = (0.0, 0.0, 1.0)
        heading_rad = math.radians(attitude.heading_deg or 0.0)
        return cls(attitude.rotation(), heading_rad, known, white, white @ causes, turns)


@dataclass(frozen=True, eq=False)
class Problem:
    """All points in one array, all sigmas, and which unknowns there are.

    Attributes:
        camera: The camera.
        attitude: What is known of its attitude; None for nothing.
        spec: Bounds and weights.
        points: A row a cluster that is seen: its place in the local axes and from its bar's centre, m, where
            it is seen, px, 1 / sigma, and the share of its variance that stands for a while, float64 (n, 10).
        bar: Number of each point's bar, rising, int64 (n,).
        errors: What the points of each bar share, float64 (bars, 3), (bars, 2, 2), (bars, 2, 2).
        transmitters: Number of each bar.
        lens_root: A lower root of the covariance of the camera's `CAMERA_PARAMETERS`, float64 (7, 7).
        shaken_rad: Sigma of what shifts the images of all bars alike.
    """

    camera: CameraModel
    attitude: Attitude | None
    spec: ErrorModel
    points: Floats
    bar: NDArray[np.int64]
    errors: SharedErrors
    transmitters: tuple[int, ...]
    lens_root: Floats
    shaken_rad: float

    @cached_property
    def angles(self) -> KnownAngles:
        """What the attitude says."""
        return KnownAngles.of(self.attitude, self.shaken_rad)

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which unknowns of the fit there are, bool (14,): see `model`."""
        free = np.ones(14, np.bool_)
        free[3:6], free[6], free[7:] = self.angles.turns, False, self.lens_root.any()
        return free

    @cached_property
    def parts(self) -> list[slice]:
        """Where each bar's points are."""
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
        """What the views give, or why that is too little for a position."""
        between = between_of(views)
        kept: list[int] = []
        parts: list[Floats] = []
        errors: list[SharedErrors] = []
        most = 0
        for view in views:
            whole = whole_clusters(view.points_px, view.sigma_px, camera.width, camera.height)
            number = int(whole.sum())
            most = max(most, number)
            if number >= spec.min_points:
                pixel = spec.pixel_sigma_px if view.pixel_px is None else view.pixel_px
                sigma_px = view.sigma_px[whole, None]
                # From the whole bar's centre: errors of its attitude turn it about that, whatever is seen.
                arm = (view.enu_m - view.enu_m.mean(0))[whole]
                share = np.minimum((pixel / sigma_px) ** 2, 1.0)
                kept.append(view.transmitter)
                columns = [view.enu_m[whole], arm, view.points_px[whole], 1 / sigma_px, share]
                parts.append(np.concatenate(columns, 1))
                errors.append(shared_errors(view, whole, spec, between))
        if not kept:
            why = f"{most} whole clusters of a bar seen, {spec.min_points} needed"
            return Rejection("too-few-clusters", why)
        problem = cls(
            camera=camera,
            attitude=attitude,
            spec=spec,
            points=np.concatenate(parts),
            bar=np.repeat(np.arange(len(parts)), [len(part) for part in parts]),
            errors=SharedErrors(*map(np.array, zip(*errors, strict=True))),
            transmitters=tuple(kept),
            lens_root=sigma.covariance_root(camera),
            shaken_rad=between * spec.shaken_sigma_px / camera.focal_px,
        )
        return problem._determined()

    @property
    def freedom(self) -> int:
        """Degrees of freedom.

        Every shared error has an observation of its own, that it is about 0; an angle that is exact is no
        unknown.
        """
        return max(2 * len(self.points) + self.angles.known - 6, 1)

    def with_attitude(self, attitude: Attitude | None) -> "Problem | Rejection":
        """The same where this is known of the attitude, or why that is too little."""
        return replace(self, attitude=attitude)._determined()

    def without(self, bar: int) -> "Problem | Rejection":
        """The same without a bar, by its place among `transmitters`, or why the others are too few."""
        kept = self.bar != bar
        others = self.bar[kept]
        fewer = replace(
            self,
            points=self.points[kept],
            bar=others - (others > bar),
            errors=SharedErrors(*(np.delete(one, bar, 0) for one in self.errors)),
            transmitters=self.transmitters[:bar] + self.transmitters[bar + 1 :],
        )
        return fewer._determined()

    def seen_by(self, sigma: CameraSigma) -> "Problem":
        """The same through a camera that is so surely known."""
        return replace(self, lens_root=sigma.covariance_root(self.camera))

    def _determined(self) -> "Problem | Rejection":
        """The same, or why its attitude is too little for its bars."""
        bars = len(self.transmitters)
        if bars == 1 and self.angles.known < 3:
            why = "one bar gives a position only with the camera's heading known"
            return Rejection("heading-unknown", why)
        if self.attitude is None:
            centres = np.array([self.points[part, :3].mean(0) for part in self.parts])
            # Along the line that fits the bars best, and across it.
            along, across = np.linalg.svd(centres - centres.mean(0), compute_uv=False)[:2]
            if bars < 3 or across <= _INLINE * along:
                many = "two bars give" if bars == 2 else "bars in line give"
                return Rejection("gravity-unknown", f"{many} a position only with gravity known")
        return self

    @cached_property
    def centre(self) -> Floats:
        """The mean of the points' places, float64 (3,)."""
        return np.asarray(self.points[:, :3].mean(0))

    @cached_property
    def surveyed(self) -> bool:
        """Whether places or attitudes of bars are not exact."""
        return bool(self.errors.survey[:, :2].any())


def between_of(views: Sequence[BarView]) -> float:
    """Of what moved between frames, the part that all bars have in common, see `BarView.between`."""
    return sum([view.between for view in views]) / max(len(views), 1)


def whole_clusters(points_px: Floats, sigma_px: Floats, width: int, height: int) -> NDArray[np.bool_]:
    """Which clusters of a bar count, bool (K,): seen, with a sigma, and not cut off.

    Of a cluster that touches the image's edge only a part is seen. It is as long as the spacing of
    neighbours; three quarters of that and a pixel of blur must be free.
    """
    seen = np.flatnonzero(np.isfinite(points_px[:, 0]))
    edge = 0.5
    if len(seen) > 1:
        first, last = seen[0], seen[-1]
        edge += 0.75 * math.dist(points_px[first], points_px[last]) / (last - first)
    inside = (points_px >= edge) & (points_px <= np.array([width, height]) - 1 - edge)
    counted: NDArray[np.bool_] = inside.all(1) & (sigma_px > 0) & (sigma_px < math.inf)
    return counted


def shared_errors(view: BarView, seen: NDArray[np.bool_], spec: ErrorModel, between: float) -> SharedErrors:
    """How a bar errs, by its clusters that are seen, bool (K,).

    Of a layout that is no line, what is along it holds in all directions. The whole is as long as from one of
    its clusters to the farthest other, and a cluster's own part; its image is so by what is seen of it.

    The image moves as one: of what is not known of it, a bar has for its own what it has more or less than
    others, see `between_of`. These count as independent, so that two bars differ by as much as they do.
    """
    moved = math.hypot(math.sqrt(2) * spec.shaken_sigma_px * abs(view.between - between), view.early_px)
    count, points = len(seen), view.points_px
    i, j = _ends(view.enu_m, np.flatnonzero(seen))
    first, last = _ends(view.enu_m, np.arange(count))
    share = math.dist(view.enu_m[first], view.enu_m[last]) / math.dist(view.enu_m[i], view.enu_m[j])
    share *= count / (count - 1)
    size = math.dist(points[i], points[j])
    along = math.hypot(spec.shared_along_px, moved, spec.shared_share * size * share)
    axis = (points[j] - points[i]) / size if size > 0 else np.array([1.0, 0.0])
    aside = (points[seen] - points[i]) @ np.array([axis[1], -axis[0]])
    # Half a cluster beside the line from end to end is no error of a point in it.
    line = size > 0 and bool((np.abs(aside) <= 0.5 * size * share / count).all())
    across = math.hypot(spec.shared_sigma_px, view.shift_px, moved) if line else along
    sideways = 1 / view.across if line else 1 / max(view.across, 1.0)
    (x, y), (place, turn, length) = axis.tolist(), view.survey
    way = np.array([[x * x, x * y], [x * y, y * y]])
    return SharedErrors(
        np.array([place, turn, math.hypot(length, spec.stretch_share, view.stretch)]),
        across * _BOTH + (along - across) * way,
        sideways * _BOTH + ((1.0 if line else sideways) - sideways) * way,
    )


def _ends(places: Floats, counted: NDArray[np.int64]) -> tuple[int, int]:
    """Two of the places that count, as far apart as any: the farthest from the farthest from one."""
    one = other = int(counted[0])
    for _ in range(2):
        away = np.linalg.norm(places[counted] - places[other], axis=1)
        one, other = other, int(counted[away.argmax()])
    return one, other
