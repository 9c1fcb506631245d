"""What a camera sees of bars at known places, with everything that is known of its errors, in arrays."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.late import Late
from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.place.points import SeenPoints
from evlcp_sdk.place.refusals import Refusal
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CameraModel, CameraSigma

if TYPE_CHECKING:
    from evlcp_sdk.place import _kernels
else:
    _kernels = Late("evlcp_sdk.place._kernels")

__all__ = ["EXACT_RAD", "BarView", "Problem", "between_of", "project_bars", "shared_sigmas"]

Floats = NDArray[np.float64]

_INLINE = 0.02
"""Bars whose centres lie within this share of their extent from a line stand in line: beyond, the shape of a
triangle of 10 m at 50 m is seen to better than a pixel of 7000 px."""

EXACT_RAD = 1e-7
"""Least sigma of an angle, so that exact knowledge stays solvable: 5 um at 50 m."""


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
        shift_px: What all points share across the bar besides `position.shared_sigma_px`, px.
        between: How far the image may have moved otherwise than its frames show, in `position.
            shaken_sigma_px`.
        early_px: What all points share in any direction besides, as a moving image is seen early or late, px.
        across: Errors of points across the bar, in those along it, which `sigma_px` are.
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

    @classmethod
    def of(
        cls,
        transmitter: int,
        enu_m: Floats,
        seen: SeenPoints,
        survey: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> "BarView":
        """A bar by its points as they are seen."""
        return cls(
            transmitter,
            enu_m,
            seen.points_px,
            seen.sigma_px,
            survey,
            seen.pixel_px,
            seen.shift_px,
            seen.between,
            seen.early_px,
            seen.across,
        )


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
    """All points in one array, all sigmas, and which unknowns there are.

    Attributes:
        camera: The camera.
        attitude: What is known of its attitude; None for nothing.
        spec: Bounds and weights.
        points: A row a cluster that is seen: its place in the local axes and from its bar's centre, m, where
            it is seen, px, 1 / sigma, and the share of its variance that stands for a while, float64 (n, 10).
        bar: Number of each point's bar, rising, int64 (n,).
        bar_sigma: Of each bar: its survey, a root of the covariance of its image's shift, px, and what makes
            errors of points even in all directions, float64 (bars, 9): see `_kernels.shared`.
        transmitters: Number of each bar.
        lens: Focal length, px, principal point, px, k1, k2, p1, p2, k3, float64 (8,).
        lens_root: A lower root of the covariance of the first seven, float64 (7, 7).
        level: The camera's axes as columns in ENU by the attitude, north where no heading is known, float64
            (3, 3).
        felt: Up in the camera's axes by that, float64 (3,).
        heading_rad: By the attitude; 0 where it is not known.
        angles: How many of pitch, roll and heading are known: 0, 2 or 3.
        white: What whitens the errors of these, float64 (3, 3).
        said: What moves these as they are said, whitened, by its sigmas, float64 (3, 4).
        free: Which unknowns of the fit there are, bool (14,): see `_kernels`.
        shaken_rad: Sigma of what shifts the images of all bars alike.
    """

    camera: CameraModel
    attitude: Attitude | None
    spec: PositionSpec
    points: Floats
    bar: NDArray[np.int64]
    bar_sigma: Floats
    transmitters: tuple[int, ...]
    lens: Floats
    lens_root: Floats
    level: Floats
    felt: Floats
    heading_rad: float
    angles: int
    white: Floats
    said: Floats
    free: NDArray[np.bool_]
    shaken_rad: float

    @classmethod
    def of(
        cls,
        views: Sequence[BarView],
        camera: CameraModel,
        attitude: Attitude | None,
        spec: PositionSpec,
        sigma: CameraSigma,
    ) -> "Problem | Refusal":
        """What the views give, or why that is too little for a position."""
        count = sum([len(view.sigma_px) for view in views])
        points, bar, bar_sigma = np.empty((count, 10)), np.empty(count, np.int64), np.empty((len(views), 9))
        width, height, between = camera.width, camera.height, between_of(views)
        kept: list[int] = []
        at = most = 0
        for view in views:
            own = bar_sigma[len(kept)]
            own[:3] = view.survey
            pixel = spec.pixel_sigma_px if view.pixel_px is None else view.pixel_px
            number = _kernels.gathered(
                view.enu_m, view.points_px, view.sigma_px, pixel, width, height, _usual(spec, view, between),
                spec.min_points,
                len(kept), at, points, bar, own,
            )  # fmt: skip
            most = max(most, number)
            if number >= spec.min_points:
                kept.append(view.transmitter)
                at += number
        if not kept:
            return Refusal(
                "too-few-clusters", f"{most} whole clusters of a bar seen, {spec.min_points} needed"
            )
        points, bar = points[:at], bar[:at]
        shaken_rad = between * spec.shaken_sigma_px / camera.focal_px
        told = _told(attitude, points, bar, len(kept), shaken_rad)
        if isinstance(told, Refusal):
            return told
        known = sigma.known
        free = np.empty(14, np.bool_)
        free[3:6], free[:3], free[6], free[7:] = told.pop("turns"), True, False, known
        return cls(
            camera=camera,
            attitude=attitude,
            spec=spec,
            points=points,
            bar=bar,
            bar_sigma=bar_sigma[: len(kept)],
            transmitters=tuple(kept),
            lens=np.array(
                [camera.focal_px, *camera.centre_px, camera.k1, camera.k2, camera.p1, camera.p2, camera.k3]
            ),
            lens_root=sigma.root(camera) if known else np.zeros((7, 7)),
            free=free,
            shaken_rad=shaken_rad,
            **told,
        )

    @property
    def freedom(self) -> int:
        """Degrees of freedom.

        Every shared error has an observation of its own, that it is about 0; an angle that is exact is no
        unknown.
        """
        return max(2 * len(self.points) + self.angles - 6, 1)

    def told(self, attitude: Attitude | None) -> "Problem | Refusal":
        """The same where this is known of the attitude, or why that is too little."""
        told = _told(attitude, self.points, self.bar, len(self.transmitters), self.shaken_rad)
        if isinstance(told, Refusal):
            return told
        free = self.free.copy()
        free[3:6] = told.pop("turns")
        return self._but(attitude=attitude, free=free, **told)

    def without(self, bar: int) -> "Problem | Refusal":
        """The same without a bar, by its place among `transmitters`, or why the others are too few."""
        kept = self.bar != bar
        others = self.bar[kept]
        fewer = self._but(
            points=self.points[kept],
            bar=others - (others > bar),
            bar_sigma=np.delete(self.bar_sigma, bar, 0),
            transmitters=self.transmitters[:bar] + self.transmitters[bar + 1 :],
        )
        return fewer.told(self.attitude)

    def seen_by(self, sigma: CameraSigma) -> "Problem":
        """The same through a camera that is so surely known."""
        free = self.free.copy()
        free[7:] = sigma.known
        return self._but(lens_root=sigma.root(self.camera), free=free)

    def halved(self) -> "Problem":
        """The same by the means of the halves of each bar: a few points that say nearly as much."""
        bars = len(self.transmitters)
        points, bar = np.empty((2 * bars, 10)), np.empty(2 * bars, np.int64)
        count = _kernels.halved(self.points, self.bar, points, bar)
        return self._but(points=points[:count], bar=bar[:count])

    def _but(self, **changes: Any) -> "Problem":
        """The same with other fields, in a fifth of the time of `dataclasses.replace`."""
        other = object.__new__(Problem)
        vars(other).update(vars(self), **changes)
        return other


def _told(
    attitude: Attitude | None, points: Floats, bar: NDArray[np.int64], bars: int, shaken_rad: float
) -> Any:
    """What an attitude says to a `Problem`, and which of the turns are free; or why it is too little.

    What shifts the images of all bars alike is to a position as if the camera were turned by `shaken_rad`.
    """
    compass = attitude is not None and attitude.heading_deg is not None
    if not compass and bars == 1:
        return Refusal("heading-unknown", "one bar gives a position only with the camera's heading known")
    if attitude is None:
        if bars < 3 or _kernels.flatness(points, bar, bars) < _INLINE:
            many = "two bars give" if bars == 2 else "bars in line give"
            return Refusal("gravity-unknown", f"{many} a position only with gravity known")
        return {
            "level": np.eye(3),
            "felt": np.zeros(3),
            "heading_rad": 0.0,
            "angles": 0,
            "white": np.eye(3),
            "said": np.zeros((3, 4)),
            "turns": True,
        }
    turns = (True, True, True)
    if shaken_rad == attitude.gravity_sigma_deg == attitude.white_sigma_deg == attitude.time_sigma_us == 0:
        turns = (False, False, not compass or attitude.heading_sigma_deg > 0)
    angles = 3 if compass else 2
    level = attitude.rotation()
    causes = attitude.standing()
    white = _whitening(attitude, causes, angles, shaken_rad)
    return {
        "level": level,
        "felt": level[2],
        "heading_rad": math.radians(attitude.heading_deg or 0.0),
        "angles": angles,
        "white": white,
        "said": white @ causes,
        "turns": turns,
    }


def between_of(views: Sequence[BarView]) -> float:
    """Of what moved between frames, the part that all bars have in common, see `BarView.between`."""
    return sum([view.between for view in views]) / max(len(views), 1)


def shared_sigmas(
    view: BarView, seen: NDArray[np.bool_], spec: PositionSpec, between: float
) -> tuple[float, ...]:
    """Of a bar: its image's shift, px, in any direction at most; its place, m, turn, radians, and length, a
    share. `between` is what it has in common with others, see `between_of`.
    """
    found = np.array([*view.survey, *[0.0] * 6])
    _kernels.shared(view.enu_m, view.points_px, seen, _usual(spec, view, between), found)
    place, turn, length, columns, both, rows = found[:6].tolist()
    return float(np.linalg.eigvalsh([[columns, both], [both, rows]])[-1]), place, turn, length


def _usual(spec: PositionSpec, view: BarView, between: float) -> Floats:
    """What kernels take of these, float64 (5,): see `_kernels.shared`.

    The image moves as one: of what is not known of it, a bar has for its own what it has more or less than
    others. These count as independent, so that two bars differ by as much as they do.
    """
    moved = math.hypot(math.sqrt(2) * spec.shaken_sigma_px * abs(view.between - between), view.early_px)
    across = math.hypot(spec.shared_sigma_px, view.shift_px, moved)
    shift = across, math.hypot(spec.shared_along_px, moved), spec.shared_share
    return np.array([*shift, spec.stretch_share, view.across], np.float64)


def _whitening(attitude: Attitude, causes: Floats, angles: int, shaken_rad: float) -> Floats:
    """What makes errors of pitch, roll and heading, `causes` (3, 4), independent and of sigma 1: (3, 3).

    All have those that are new with each time, too: the attitude's own and, of what shifts an image down or
    aside, `shaken_rad`.
    """
    white = np.zeros((3, 3))
    least = math.radians(attitude.white_sigma_deg) ** 2 + EXACT_RAD**2
    pitch = math.radians(attitude.pitch_deg)
    # As a camera turns about its own axes across and upright: the second is not the world's.
    aside = [[1.0, 0.0], [0.0, math.tan(pitch)], [0.0, 1 / math.cos(pitch)]]
    _kernels.whitening(np.concatenate([causes, shaken_rad * np.array(aside)], 1), least, white)
    if angles < 3:
        white[2] = (0.0, 0.0, 1.0)
    return white
