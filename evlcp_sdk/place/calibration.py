"""Focal length, principal point and distortion from bars at known places, seen from known places.

One least-squares problem over all views: the camera's parameters and each view's position and attitude, as
far as these are not known. A parameter that the views do not determine keeps its configured value.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import check_columns, parse_csv_number, read_csv
from evlcp_sdk.place.error_model import USUAL, ErrorModel
from evlcp_sdk.place.gnss import PLACE
from evlcp_sdk.place.observations import BarView, between_of, camera_off, project_bars, shared_errors
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.camera import CAMERA_PARAMETERS, CameraModel, CameraSigma

Floats = NDArray[np.float64]

_ANGLES = ("heading_deg", "pitch_deg", "roll_deg")
"""Columns that come together."""

_OPTIONAL = ("recording", "position_sigma_m", "attitude_sigma_deg", *_ANGLES)

_RANGES = PLACE | {
    "position_sigma_m": (1e-6, 1e6),
    "attitude_sigma_deg": (1e-6, 1e6),
    "heading_deg": (-360.0, 360.0),
    "pitch_deg": (-90.0, 90.0),
    "roll_deg": (-360.0, 360.0),
    "t_us": (-1e18, 1e18),
}
"""What a pose's values may be; exact ones would outweigh all in double precision."""


@dataclass(frozen=True)
class KnownPose:
    """Where a camera was, and how it was turned if that is known: a row of `poses.csv`.

    Attributes:
        recording: Name of the recording's file; empty where there is only one.
        t_us: When, camera clock, us.
        position_sigma_m: Standard deviation of its place, WGS-84 and above the ellipsoid, in each axis, m.
        attitude: With heading; None where it is not known.
        attitude_sigma_deg: Standard deviation of a turn about each axis, degrees.
    """

    recording: str
    t_us: float
    latitude_deg: float
    longitude_deg: float
    height_m: float
    position_sigma_m: float
    attitude: Attitude | None
    attitude_sigma_deg: float


def read_poses(path: Path | str) -> list[KnownPose]:
    """Read a CSV of known poses.

    Columns t_us, latitude_deg, longitude_deg, height_m; optional recording, position_sigma_m (0.01),
    heading_deg, pitch_deg and roll_deg together, and attitude_sigma_deg (0.1).

    Raises:
        InputError: The file cannot be read.
        ConfigError: A column is missing, or a value is not a number or is out of range.
    """
    names, rows = read_csv(path)
    check_columns(path, names, ("t_us", *PLACE), _OPTIONAL)
    if not rows:
        raise ConfigError(f"{path}: expected one line of values or more")
    poses = []
    for line, row in rows:
        # Angles come together.
        angles = any(row.get(name) for name in _ANGLES)
        needed = ("t_us", *PLACE, *(_ANGLES if angles else ()))
        given = [name for name in _RANGES if name in needed or row.get(name)]
        value = {name: parse_csv_number(path, line, name, row.get(name), _RANGES[name]) for name in given}
        poses.append(
            KnownPose(
                row.get("recording") or "",
                value["t_us"],
                value["latitude_deg"],
                value["longitude_deg"],
                value["height_m"],
                value.get("position_sigma_m", 0.01),
                Attitude(value["pitch_deg"], value["roll_deg"], value["heading_deg"]) if angles else None,
                value.get("attitude_sigma_deg", 0.1),
            )
        )
    return poses


_USUAL = {
    "focal_mm": 0.2,
    "centre_x_px": 0.02,
    "centre_y_px": 0.02,
    "k1": 0.5,
    "k2": 1.0,
    "p1": 1e-3,
    "p2": 1e-3,
}
"""Sigmas before anything is seen, of the focal length as a share of itself, of the principal point as a share
of the columns: what lenses and their mounts have. What is not determined widens the sigmas of the rest."""

_LEARNT = 0.5
"""Share of that sigma below which the views, not it, determine a parameter."""

_STEPS = 60
_FREE_SIGMA_RAD = 0.5
"""Sigma of an attitude that is not known, about its closed-form start."""

_MOST_USUAL = 4.0
"""Sigmas of what is usual, 1 in 16 000, beyond which it is not the lens or its mount that is off."""

MOST_MISFIT = 4.0
"""Mean square of the misses, in sigmas, above which nothing is believed."""

_OF_CAMERA, _OF_BAR = len(CAMERA_PARAMETERS), 8
"""Unknowns of the camera, and of a bar: of its site three of place, three of turn, its length; how it looks
bent."""

_LINE = 1e-6
"""Share of the squares of a line's points about their middle that may lie across it."""


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The bars that a camera saw from a known place.

    Attributes:
        bars: What was seen.
        enu_m: The camera's place in the local axes, m, float64 (3,).
        position_sigma_m: Its standard deviation, m.
        rotation: Camera axes as columns in ENU, float64 (3, 3); None where they are not known.
        attitude_sigma_deg: Standard deviation of a turn about each axis, degrees.
    """

    bars: tuple[BarView, ...]
    enu_m: Floats
    position_sigma_m: float
    rotation: Floats | None
    attitude_sigma_deg: float


@dataclass(frozen=True)
class Calibrated:
    """A camera as the views show it.

    Attributes:
        camera: With what was determined; the rest as it was.
        sigma: Standard deviation of each parameter that was determined, in its unit.
        refused: Parameters that the views do not determine: how far the corners of the image would be
            uncertain by each, px.
        views, points: Numbers of these.
        misfit: Mean square of the misses in sigmas, over the degrees of freedom.
        camera_sigma: How precisely the camera is known by this, with what was not determined; as a link has
            it.
    """

    camera: CameraModel
    sigma: Mapping[str, float]
    refused: Mapping[str, float]
    views: int
    points: int
    misfit: float
    camera_sigma: CameraSigma


def calibrate(
    views: Sequence[CalibrationView], camera: CameraModel, spec: ErrorModel = USUAL, *, limit_px: float = 2.0
) -> Calibrated:
    """Fit the camera to all views.

    All parameters are fitted together, within what lenses own have. One is determined where the views say
    more than that, and leave the image's corners uncertain by no more than a limit; the sigmas of these
    contain what is not known of the others. Errors that a bar's points share are those of positions;
    errors of a bar's site are the same in all views.

    The fit starts at `camera`, of which is kept what is not determined: by one parameter the corners may be
    uncertain by `limit_px`.

    Raises:
        ConfigError: Not even the focal length is determined, or the views do not fit their places.
    """
    seen = [one for view in views if (one := SeenView.of(view, camera, spec)) is not None]
    if not seen:
        raise ConfigError("no view shows a bar at a known site: nothing to calibrate from")
    start = replace(camera, centre_x_px=camera.centre_px[0], centre_y_px=camera.centre_px[1])
    usual = _usual_sigma(start)
    # The focal length in mm.
    own, lens = np.array([start.focal_mm / start.focal_px, *np.ones(6)]), np.diag([*usual.values()])
    solved = solve_views(seen, start, lens / own[:, None])
    found, misfit = solved.camera, solved.misfit
    covariance = lens @ solved.covariance[:_OF_CAMERA, :_OF_CAMERA] @ lens.T
    sigma = dict(zip(CAMERA_PARAMETERS, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    # How far the image's farthest corner moves by each.
    corners = np.array([[x, y] for x in (0.0, start.width) for y in (0.0, start.height)])
    slopes = start.parameter_jacobian((corners - start.centre_px) / start.focal_px) / own
    moved = np.linalg.norm(slopes, axis=1).max(0)
    corner = {name: float(far) * sigma[name] for name, far in zip(CAMERA_PARAMETERS, moved, strict=True)}
    sure = [n for n in CAMERA_PARAMETERS if corner[n] <= limit_px and sigma[n] <= _LEARNT * usual[n]]
    if "focal_mm" not in sure:
        raise ConfigError(
            "the views do not determine the focal length: the image's corners stay uncertain by"
            f" {corner['focal_mm']:.1f} px, {limit_px:g} px allowed"
        )
    if misfit > MOST_MISFIT:
        raise ConfigError(
            f"the views miss their places by {math.sqrt(misfit):.1f} sigmas (rms):"
            " a site or pose is not as was said"
        )
    for name in CAMERA_PARAMETERS[1:]:
        value, said = getattr(found, name), getattr(start, name)
        if abs(value - said) > _MOST_USUAL * usual[name]:
            raise ConfigError(
                f"{name} = {value:.4g} would fit the views, {said:.4g} is configured and {usual[name]:.2g} a"
                " usual difference: angles of the poses, a place, or the configuration are not as was said"
            )
    kept = replace(start, **{name: getattr(found, name) for name in sure})
    # What keeps its configured value is off by as much as the fit has it elsewhere, too.
    off = np.array([getattr(kept, name) - getattr(found, name) for name in CAMERA_PARAMETERS])
    return Calibrated(
        replace(camera, **{name: getattr(found, name) for name in sure}),
        {name: sigma[name] for name in sure},
        {name: corner[name] for name in CAMERA_PARAMETERS if name not in sure},
        len(seen),
        sum(len(v.points_px) for v in seen),
        misfit,
        _camera_sigma(covariance + np.outer(off, off)),
    )


def _camera_sigma(covariance: Floats) -> CameraSigma:
    """As a link has it; sigmas and correlations with the digits that they are written with."""
    sigma = np.sqrt(np.diag(covariance))
    rows = np.round(covariance / sigma / sigma[:, None], 6)
    np.fill_diagonal(rows, 1.0)
    values = {name: float(f"{value:.6g}") for name, value in zip(CAMERA_PARAMETERS, sigma, strict=True)}
    return CameraSigma(**values, correlation=tuple(tuple(row) for row in rows.tolist()))


def _usual_sigma(camera: CameraModel) -> dict[str, float]:
    scale = {"focal_mm": camera.focal_mm, "centre_x_px": camera.width, "centre_y_px": camera.width}
    return {name: sigma * scale.get(name, 1.0) for name, sigma in _USUAL.items()}


@dataclass(frozen=True, eq=False)
class SeenView:
    """A view's points in one array, with what makes their errors white and of one sigma.

    `bend_px` is by how much a bar that looks bent along itself, by a sigma, moves them, (n, 2).
    """

    enu_m: Floats
    points_px: Floats
    whiten: Floats
    bar: NDArray[np.int64]
    arm_m: Floats
    bend_px: Floats
    survey: Mapping[int, tuple[float, float, float]]
    place_m: Floats
    place_sigma_m: float
    rotation: Floats
    turn_sigma_rad: float

    @classmethod
    def of(cls, view: CalibrationView, camera: CameraModel, spec: ErrorModel) -> "SeenView | None":
        """The points of the bars of which enough is seen; None where none is."""
        seen, whiten, survey = [], [], {}
        between = between_of(view.bars)
        for bar in view.bars:
            good = np.isfinite(bar.points_px).all(1) & (bar.sigma_px > 0)
            if good.sum() < spec.min_points:
                continue
            arm, number = (bar.enu_m - bar.enu_m.mean(0))[good], np.full(good.sum(), bar.transmitter)
            bend = spec.bend_sigma_px * _bend(bar.enu_m, good, bar.points_px)
            seen.append((bar.enu_m[good], bar.points_px[good], number, arm, bend))
            shared = shared_errors(bar, good, spec, between)
            place, turn, length = shared.survey.tolist()
            survey[bar.transmitter] = place, turn, length
            # In any direction at most.
            shift = float(np.linalg.eigvalsh(shared.root)[-1])
            covariance = np.diag((max(bar.across, 1.0) * bar.sigma_px[good]) ** 2) + shift**2
            whiten.append(np.linalg.inv(np.linalg.cholesky(covariance)))
        if not seen:
            return None
        enu, points, numbers, arms, bends = (np.concatenate(column) for column in zip(*seen, strict=True))
        rotation = view.rotation
        shaken_rad = between * spec.shaken_sigma_px / camera.focal_px
        sigma = math.hypot(math.radians(view.attitude_sigma_deg), shaken_rad)
        if rotation is None:
            # Brings sights best onto directions.
            sights = np.column_stack([camera.undistort(points), np.ones(len(points))])
            world = enu - view.enu_m
            sights, world = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (sights, world))
            rotation, sigma = Rotation.align_vectors(world, sights)[0].as_matrix(), _FREE_SIGMA_RAD
        camera_at = view.enu_m, view.position_sigma_m, rotation, sigma
        return cls(enu, points, block_diag(*whiten), numbers, arms, bends, survey, *camera_at)


def _bend(enu_m: Floats, seen: NDArray[np.bool_], points_px: Floats) -> Floats:
    """How the points that are seen of a line move as it bends along itself, in the image, float64 (n, 2).

    By what the square of a point's place has besides a constant and its place; the sum of squares over the
    whole bar is 1. Nothing where clusters are not in a line.
    """
    arm = enu_m - enu_m.mean(0)
    along = arm @ np.linalg.svd(arm)[2][0]
    if (arm**2).sum() - along @ along > _LINE * (arm**2).sum():
        return np.zeros((int(seen.sum()), 2))
    modes, _ = np.linalg.qr(np.stack([np.ones_like(along), along, along**2], 1))
    way = points_px[seen][-1] - points_px[seen][0]
    return np.asarray(modes[seen, 2][:, None] * (way / max(float(np.linalg.norm(way)), 1e-9)))


@dataclass(frozen=True, eq=False)
class SolvedViews:
    """All views solved together.

    Attributes:
        camera: With its parameters as found.
        x: All unknowns, in their sigmas: the camera's parameters, six of each view, eight of each bar, and
            six that all views share, float64 (n,).
        covariance: Of these, float64 (n, n).
        bars: Where a bar's eight are: its site's place, turn and length, and how it looks bent.
        misfit: Mean square of the misses in sigmas, over the degrees of freedom.
    """

    camera: CameraModel
    x: Floats
    covariance: Floats
    bars: Mapping[int, slice]
    misfit: float


@dataclass(frozen=True)
class _Model:
    """What the unknowns of `solve_views` make of each view.

    Attributes:
        root: A root of the covariance of the camera's parameters as they are known beforehand, the focal
            length in px, float64 (7, 7).
        common: Sigmas of an error of place, m, and of a turn, radians, that all views share.
        surveys: Sigmas of each bar's site that has any: of place, turn and length.
    """

    views: Sequence[SeenView]
    camera: CameraModel
    root: Floats
    common: tuple[float, float]
    surveys: Mapping[int, tuple[float, float, float]]

    @property
    def bars(self) -> dict[int, int]:
        """Where a bar's unknowns begin: errors of its site, in sigmas, behind the views."""
        begin = _OF_CAMERA + 6 * len(self.views)
        return {number: begin + _OF_BAR * i for i, number in enumerate(sorted(self.surveys))}

    def camera_of(self, x: Floats) -> CameraModel:
        """The camera by the unknowns."""
        return camera_off(self.camera, self.root @ x[:_OF_CAMERA])

    def parts(self, x: Floats) -> tuple[Floats, Floats]:
        """Misses in sigmas, float64 (m,), and their slopes, float64 (m, n)."""
        misses, rows = [x], [np.eye(len(x))]
        now = self.camera_of(x)
        for i, view in enumerate(self.views):
            place, block = self._seen(x, view, _OF_CAMERA + 6 * i, now)
            for axis in (0, 1):
                # A step that turns a point behind the camera is not to be taken.
                off = np.nan_to_num(place[:, axis] - view.points_px[:, axis], nan=1e6)
                misses.append(view.whiten @ off)
                rows.append(view.whiten @ np.nan_to_num(block[:, axis]))
        return np.concatenate(misses), np.concatenate(rows)

    def _seen(self, x: Floats, view: SeenView, at: int, now: CameraModel) -> tuple[Floats, Floats]:
        """Where a view has its points, px, float64 (p, 2), and the slopes of these, float64 (p, 2, n)."""
        own, common = np.repeat([view.place_sigma_m, view.turn_sigma_rad], 3), np.repeat(self.common, 3)
        off = own * x[at : at + 6] + common * x[-6:]
        rotation = Rotation.from_rotvec(off[3:]).as_matrix() @ view.rotation
        position = view.place_m + off[:3]
        stands, moves = view.enu_m.copy(), {}
        for number, column in self.bars.items():
            mine = view.bar == number
            if mine.any():
                moves[column] = mine, _site_slope(view.arm_m[mine], self.surveys[number])
                stands[mine] += moves[column][1] @ x[column : column + 7]
        place, slope = project_bars(stands, position, rotation, now)
        for column, (mine, _) in moves.items():
            place[mine] += x[column + 7] * view.bend_px[mine]
        seen = (stands - position) @ rotation
        block = np.zeros((len(place), 2, len(x)))
        block[:, :, :_OF_CAMERA] = now.parameter_jacobian(seen[:, :2] / seen[:, 2:]) @ self.root
        slope[:, :, 3:] = slope[:, :, 3:] @ _turn_slope(off[3:])
        block[:, :, at : at + 6], block[:, :, -6:] = slope * own, slope * common
        for column, (mine, by_site) in moves.items():
            block[mine, :, column : column + 7] = -slope[mine][:, :, :3] @ by_site
            block[mine, :, column + 7] = view.bend_px[mine]
        return place, block


def solve_views(
    views: Sequence[SeenView], camera: CameraModel, root: Floats, common: tuple[float, float] = (0.0, 0.0)
) -> SolvedViews:
    """Least squares over everything; `camera` is where the fit starts, the others as in `_Model`."""
    surveys: dict[int, tuple[float, float, float]] = {}
    for view in views:
        surveys |= {n: sigma for n, sigma in view.survey.items() if any(sigma) or view.bend_px.any()}
    model = _Model(views, camera, root, common, surveys)

    def misses_of(x: Floats) -> Floats:
        return model.parts(x)[0]

    def slopes_of(x: Floats) -> Floats:
        return model.parts(x)[1]

    start = np.zeros(_OF_CAMERA + 6 * len(views) + _OF_BAR * len(surveys) + 6)
    fit = least_squares(misses_of, start, slopes_of, x_scale="jac", max_nfev=_STEPS)
    misses, rows = model.parts(fit.x)
    scale = 1 / np.sqrt((rows**2).sum(0))
    half = np.linalg.inv(np.linalg.qr(rows * scale, mode="r"))
    covariance = (half @ half.T) * scale * scale[:, None]
    points = 2 * sum(len(v.points_px) for v in views)
    freedom = max(points - _OF_CAMERA - 3 * len(views), 1)
    where = {number: slice(column, column + _OF_BAR) for number, column in model.bars.items()}
    return SolvedViews(model.camera_of(fit.x), fit.x, covariance, where, float(misses @ misses) / freedom)


def _site_slope(arm_m: Floats, survey: tuple[float, float, float]) -> Floats:
    """How points of a bar move by one sigma of its site's place, turn and length: m, float64 (n, 3, 7)."""
    place, turn, length = survey
    moves = np.zeros((len(arm_m), 3, 7))
    moves[:, :, :3] = place * np.eye(3)
    moves[:, :, 3:6] = turn * np.cross(np.eye(3)[None], arm_m[:, None]).transpose(0, 2, 1)
    moves[:, :, 6] = length * arm_m
    return moves


def _turn_slope(turn: Floats) -> Floats:
    """Small turn of the whole by the parts of a rotation vector (the left Jacobian of the rotations)."""
    angle = float(np.linalg.norm(turn))
    cross = np.cross(np.eye(3), turn)
    if angle < 1e-6:
        return np.asarray(np.eye(3) + cross / 2)
    k = cross / angle
    return np.asarray(np.eye(3) + (1 - math.cos(angle)) / angle * k + (1 - math.sin(angle) / angle) * (k @ k))
