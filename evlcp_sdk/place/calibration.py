"""Calibration of a camera: focal length, principal point and distortion from known bars and camera places.

One least-squares problem over all views: the camera's parameters and each view's position and attitude, as
far as these are unknown. A parameter that the views do not determine keeps its configured value.
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
from evlcp_sdk.place.error_model import DEFAULT_ERRORS, ErrorModel
from evlcp_sdk.place.gnss import PLACE
from evlcp_sdk.place.observations import (
    BarView,
    common_vibration,
    compute_shared_errors,
    perturb_camera,
    project_bars,
)
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
"""Ranges of a pose's values; exact ones would outweigh all in double precision."""


@dataclass(frozen=True)
class KnownPose:
    """A camera's place, and its attitude if known, at a time: a row of `poses.csv`.

    Attributes:
        recording: Name of the recording's file; empty if there is only one.
        t_us: When, camera clock, us.
        position_sigma_m: Standard deviation of its place (WGS-84, above the ellipsoid) in each axis, m.
        attitude: With heading; None if it is unknown.
        attitude_sigma_deg: Standard deviation of a rotation about each axis, degrees.
        line: Of the file, from 1; 0 of no file.
    """

    recording: str
    t_us: float
    latitude_deg: float
    longitude_deg: float
    height_m: float
    position_sigma_m: float
    attitude: Attitude | None
    attitude_sigma_deg: float
    line: int = 0


def read_poses(path: Path | str) -> list[KnownPose]:
    """Read a CSV of known poses.

    Columns t_us, latitude_deg, longitude_deg, height_m; optional recording, position_sigma_m (0.01),
    heading_deg, pitch_deg and roll_deg together, and attitude_sigma_deg (0.1).

    Raises:
        InputError: The file cannot be read.
        ConfigError: A column is missing, or a value is not a number or is out of range.
    """
    names, rows = read_csv(path)
    angles = _ANGLES if any(name in names for name in _ANGLES) else ()
    check_columns(path, names, ("t_us", *PLACE, *angles), _OPTIONAL)
    if not rows:
        raise ConfigError(f"{path}: expected one line of values or more")
    poses = []
    for line, row in rows:
        has_angles = any(row.get(name) for name in _ANGLES)
        needed = ("t_us", *PLACE, *(_ANGLES if has_angles else ()))
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
                Attitude(value["pitch_deg"], value["roll_deg"], value["heading_deg"]) if has_angles else None,
                value.get("attitude_sigma_deg", 0.1),
                line,
            )
        )
    return poses


_USUAL_SIGMAS = {
    "focal_mm": 0.2,
    "centre_x_px": 0.02,
    "centre_y_px": 0.02,
    "k1": 0.5,
    "k2": 1.0,
    "p1": 1e-3,
    "p2": 1e-3,
}
"""Prior sigmas of lenses and their mounts: of the focal length as a share of itself, of the principal point
as a share of the columns. What is not determined widens the sigmas of the rest."""

_DETERMINED_SHARE = 0.5
"""Share of the prior sigma below which the views, not the prior, determine a parameter."""

_STEPS = 60
_FREE_SIGMA_RAD = 0.5
"""Sigma of an unknown attitude about its closed-form start."""

_MAX_SIGMAS = 4.0
"""Prior sigmas, 1 in 16 000, beyond which it is not the lens or its mount that is wrong."""

MAX_MISFIT = 4.0
"""Mean square of the residuals, in sigmas, above which no result is given."""

_CAMERA_SIZE, _BAR_SIZE = len(CAMERA_PARAMETERS), 8
"""Unknowns of the camera, and of a bar: of its site three of place, three of rotation, its length; its
apparent curvature."""


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The bars that a camera saw from a known place.

    Attributes:
        bars: The views of the bars.
        enu_m: The camera's place in the local axes, m, float64 (3,).
        position_sigma_m: Its standard deviation, m.
        rotation: Camera axes as columns in ENU, float64 (3, 3); None where they are unknown.
        attitude_sigma_deg: Standard deviation of a rotation about each axis, degrees.
    """

    bars: tuple[BarView, ...]
    enu_m: Floats
    position_sigma_m: float
    rotation: Floats | None
    attitude_sigma_deg: float


@dataclass(frozen=True)
class Calibration:
    """A camera as calibrated.

    Attributes:
        camera: With the determined parameters; the others are as configured.
        sigma: Standard deviation of each determined parameter, in its unit.
        undetermined_px: Parameters that the views do not determine: uncertainty of the image's corners by
            each.
        views, points: Numbers of these.
        misfit: Mean square of the residuals in sigmas, over the degrees of freedom.
        camera_sigma: Sigmas and correlations of all parameters, as a link has them.
    """

    camera: CameraModel
    sigma: Mapping[str, float]
    undetermined_px: Mapping[str, float]
    views: int
    points: int
    misfit: float
    camera_sigma: CameraSigma


def fit_camera(
    views: Sequence[CalibrationView],
    camera: CameraModel,
    spec: ErrorModel = DEFAULT_ERRORS,
    *,
    limit_px: float = 2.0,
) -> Calibration:
    """Fit the camera to all views.

    All parameters are fitted together, with the priors of usual lenses. One is determined if the views tell
    more than its prior and leave the image's corners uncertain by no more than `limit_px`; others keep the
    value of `camera`, at which the fit starts. The sigmas of the determined ones hold the uncertainty of the
    others. Errors that a bar's points share are modelled as for positions; errors of a bar's site are the
    same in all views.

    Raises:
        ConfigError: Not even the focal length is determined, or the views do not fit their places.
    """
    seen = [one for view in views if (one := WhitenedView.of(view, camera, spec)) is not None]
    if not seen:
        raise ConfigError("no view shows a bar at a known site: nothing to calibrate from")
    start = replace(camera, centre_x_px=camera.centre_px[0], centre_y_px=camera.centre_px[1])
    scale = {"focal_mm": start.focal_mm, "centre_x_px": start.width, "centre_y_px": start.width}
    usual = {name: sigma * scale.get(name, 1.0) for name, sigma in _USUAL_SIGMAS.items()}
    # The focal length in mm.
    units, lens = np.array([start.focal_mm / start.focal_px, *np.ones(6)]), np.diag([*usual.values()])
    solution = solve_views(seen, start, lens / units[:, None])
    found, misfit = solution.camera, solution.misfit
    covariance = lens @ solution.covariance[:_CAMERA_SIZE, :_CAMERA_SIZE] @ lens.T
    sigma = dict(zip(CAMERA_PARAMETERS, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    corners = np.array([[x, y] for x in (0.0, start.width) for y in (0.0, start.height)])
    slopes = start.parameter_jacobian((corners - start.centre_px) / start.focal_px) / units
    farthest = np.linalg.norm(slopes, axis=1).max(0).tolist()
    corner = {name: slope * sigma[name] for name, slope in zip(CAMERA_PARAMETERS, farthest, strict=True)}
    determined = [
        name
        for name in CAMERA_PARAMETERS
        if corner[name] <= limit_px and sigma[name] <= _DETERMINED_SHARE * usual[name]
    ]
    if "focal_mm" not in determined:
        raise ConfigError(
            "the views do not determine the focal length: the image's corners stay uncertain by"
            f" {corner['focal_mm']:.1f} px, {limit_px:g} px allowed"
        )
    if misfit > MAX_MISFIT:
        raise ConfigError(
            f"the views miss their places by {math.sqrt(misfit):.1f} sigmas (rms):"
            " a site or pose is not as stated"
        )
    for name in CAMERA_PARAMETERS[1:]:
        value, configured = getattr(found, name), getattr(start, name)
        if abs(value - configured) > _MAX_SIGMAS * usual[name]:
            raise ConfigError(
                f"{name} = {value:.4g} would fit the views, {configured:.4g} is configured and"
                f" {usual[name]:.2g} a usual difference: angles of the poses, a place, or the configuration"
                " are not as stated"
            )
    changes = {name: getattr(found, name) for name in determined}
    kept = replace(start, **changes)
    # A parameter that keeps its configured value is wrong by its distance from the fit, too.
    errors = np.array([getattr(kept, name) - getattr(found, name) for name in CAMERA_PARAMETERS])
    return Calibration(
        replace(camera, **changes),
        {name: sigma[name] for name in determined},
        {name: corner[name] for name in CAMERA_PARAMETERS if name not in determined},
        len(seen),
        sum(len(v.points_px) for v in seen),
        misfit,
        _to_camera_sigma(covariance + np.outer(errors, errors)),
    )


def _to_camera_sigma(covariance: Floats) -> CameraSigma:
    """Convert a covariance; sigmas and correlations get the digits that they are written with."""
    sigma = np.sqrt(np.diag(covariance))
    rows = np.round(covariance / sigma / sigma[:, None], 6)
    np.fill_diagonal(rows, 1.0)
    values = {name: float(f"{value:.6g}") for name, value in zip(CAMERA_PARAMETERS, sigma, strict=True)}
    return CameraSigma(**values, correlation=tuple(tuple(row) for row in rows.tolist()))


@dataclass(frozen=True, eq=False)
class WhitenedView:
    """A view's points in one array, with a matrix that makes their errors white and of sigma 1.

    `curvature_px` are the points' shifts by one sigma of their bar's apparent curvature, (n, 2).
    """

    enu_m: Floats
    points_px: Floats
    whiten: Floats
    bar: NDArray[np.int64]
    arm_m: Floats
    curvature_px: Floats
    bar_sigmas: Mapping[int, tuple[float, float, float]]
    place_m: Floats
    place_sigma_m: float
    rotation: Floats
    turn_sigma_rad: float

    @classmethod
    def of(cls, view: CalibrationView, camera: CameraModel, spec: ErrorModel) -> "WhitenedView | None":
        """The points of the bars with enough of them; None if there is none."""
        columns, whiten, bar_sigmas = [], [], {}
        vibration = common_vibration(view.bars)
        for bar in view.bars:
            usable = np.isfinite(bar.points_px).all(1) & (bar.sigma_px > 0)
            if usable.sum() < spec.min_points:
                continue
            arm, number = (bar.enu_m - bar.enu_m.mean(0))[usable], np.full(usable.sum(), bar.transmitter)
            curvature = spec.curvature_sigma_px * _curvature_slopes(bar.enu_m, usable, bar.points_px)
            columns.append((bar.enu_m[usable], bar.points_px[usable], number, arm, curvature))
            shared = compute_shared_errors(bar, usable, spec, vibration)
            place, turn, length = shared.bar_sigmas.tolist()
            bar_sigmas[bar.transmitter] = place, turn, length
            # The largest in any direction.
            shift = float(np.linalg.eigvalsh(shared.root)[-1])
            covariance = np.diag((max(bar.across, 1.0) * bar.sigma_px[usable]) ** 2) + shift**2
            whiten.append(np.linalg.inv(np.linalg.cholesky(covariance)))
        if not columns:
            return None
        enu, points, numbers, arms, curves = (np.concatenate(parts) for parts in zip(*columns, strict=True))
        rotation = view.rotation
        vibration_rad = vibration * spec.vibration_sigma_px / camera.focal_px
        sigma = math.hypot(math.radians(view.attitude_sigma_deg), vibration_rad)
        if rotation is None:
            seen_at = np.column_stack([camera.undistort(points), np.ones(len(points))])
            to, at = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (enu - view.enu_m, seen_at))
            rotation, sigma = Rotation.align_vectors(to, at)[0].as_matrix(), _FREE_SIGMA_RAD
        camera_at = view.enu_m, view.position_sigma_m, rotation, sigma
        return cls(enu, points, block_diag(*whiten), numbers, arms, curves, bar_sigmas, *camera_at)


def _curvature_slopes(enu_m: Floats, seen: NDArray[np.bool_], points_px: Floats) -> Floats:
    """Shifts of the seen points of a line by its curvature along itself, in the image, float64 (n, 2).

    The mode is quadratic in a point's place, without constant and linear part; the sum of squares over the
    whole bar is 1.
    """
    arm = enu_m - enu_m.mean(0)
    along = arm @ np.linalg.svd(arm)[2][0]
    modes, _ = np.linalg.qr(np.stack([np.ones_like(along), along, along**2], 1))
    axis = points_px[seen][-1] - points_px[seen][0]
    return np.asarray(modes[seen, 2][:, None] * (axis / max(float(np.linalg.norm(axis)), 1e-9)))


@dataclass(frozen=True, eq=False)
class ViewSolution:
    """The solution of all views together.

    Attributes:
        camera: With fitted parameters.
        x: All unknowns, in their sigmas: the camera's parameters, six of each view, eight of each bar, and
            six that all views share, float64 (n,).
        covariance: Of these, float64 (n, n).
        bars: Slices of each bar's eight: its site's place, rotation and length, and its apparent curvature.
        misfit: Mean square of the residuals in sigmas, over the degrees of freedom.
    """

    camera: CameraModel
    x: Floats
    covariance: Floats
    bars: Mapping[int, slice]
    misfit: float


@dataclass(frozen=True)
class _ViewModel:
    """The model of `solve_views`: each view's residuals by the unknowns.

    Attributes:
        root: A root of the prior covariance of the camera's parameters, the focal length in px, float64 (7,
            7).
        common: Sigmas of an error of place, m, and of a rotation, radians, that all views share.
        surveys: Sigmas of each bar's site that has any: of place, rotation and length.
    """

    views: Sequence[WhitenedView]
    camera: CameraModel
    root: Floats
    common: tuple[float, float]
    surveys: Mapping[int, tuple[float, float, float]]

    @property
    def bars(self) -> dict[int, int]:
        """First column of each bar's unknowns, behind those of the views."""
        begin = _CAMERA_SIZE + 6 * len(self.views)
        return {number: begin + _BAR_SIZE * i for i, number in enumerate(sorted(self.surveys))}

    def camera_of(self, x: Floats) -> CameraModel:
        """The camera by the unknowns."""
        return perturb_camera(self.camera, self.root @ x[:_CAMERA_SIZE])

    def linearize(self, x: Floats) -> tuple[Floats, Floats]:
        """Residuals in sigmas, float64 (m,), and their slopes, float64 (m, n)."""
        residuals, rows = [x], [np.eye(len(x))]
        camera = self.camera_of(x)
        for i, view in enumerate(self.views):
            points, block = self._project_view(x, view, _CAMERA_SIZE + 6 * i, camera)
            for axis in (0, 1):
                # A step that puts a point behind the camera must not be taken.
                error_px = np.nan_to_num(points[:, axis] - view.points_px[:, axis], nan=1e6)
                residuals.append(view.whiten @ error_px)
                rows.append(view.whiten @ np.nan_to_num(block[:, axis]))
        return np.concatenate(residuals), np.concatenate(rows)

    def _project_view(
        self, x: Floats, view: WhitenedView, first: int, camera: CameraModel
    ) -> tuple[Floats, Floats]:
        """A view's expected points, px, float64 (p, 2), and their slopes, float64 (p, 2, n)."""
        sigmas, common = np.repeat([view.place_sigma_m, view.turn_sigma_rad], 3), np.repeat(self.common, 3)
        errors = sigmas * x[first : first + 6] + common * x[-6:]
        rotation = Rotation.from_rotvec(errors[3:]).as_matrix() @ view.rotation
        position = view.place_m + errors[:3]
        places, site_slopes = view.enu_m.copy(), {}
        for number, column in self.bars.items():
            rows = view.bar == number
            if rows.any():
                site_slopes[column] = rows, _site_slope(view.arm_m[rows], self.surveys[number])
                places[rows] += site_slopes[column][1] @ x[column : column + 7]
        points, slope = project_bars(places, position, rotation, camera)
        for column, (rows, _) in site_slopes.items():
            points[rows] += x[column + 7] * view.curvature_px[rows]
        in_camera = (places - position) @ rotation
        block = np.zeros((len(points), 2, len(x)))
        directions = in_camera[:, :2] / in_camera[:, 2:]
        block[:, :, :_CAMERA_SIZE] = camera.parameter_jacobian(directions) @ self.root
        slope[:, :, 3:] = slope[:, :, 3:] @ _turn_slope(errors[3:])
        block[:, :, first : first + 6], block[:, :, -6:] = slope * sigmas, slope * common
        for column, (rows, by_site) in site_slopes.items():
            block[rows, :, column : column + 7] = -slope[rows][:, :, :3] @ by_site
            block[rows, :, column + 7] = view.curvature_px[rows]
        return points, block


def solve_views(
    views: Sequence[WhitenedView], camera: CameraModel, root: Floats, common: tuple[float, float] = (0.0, 0.0)
) -> ViewSolution:
    """Solve the least squares of all views, from `camera` on; other arguments are as of `_ViewModel`."""
    surveys: dict[int, tuple[float, float, float]] = {}
    for view in views:
        surveys |= {n: s for n, s in view.bar_sigmas.items() if any(s) or view.curvature_px.any()}
    model = _ViewModel(views, camera, root, common, surveys)

    def residuals_of(x: Floats) -> Floats:
        return model.linearize(x)[0]

    def slopes_of(x: Floats) -> Floats:
        return model.linearize(x)[1]

    start = np.zeros(_CAMERA_SIZE + 6 * len(views) + _BAR_SIZE * len(surveys) + 6)
    x = least_squares(residuals_of, start, slopes_of, x_scale="jac", max_nfev=_STEPS).x
    residuals, rows = model.linearize(x)
    scale = 1 / np.sqrt((rows**2).sum(0))
    factor = np.linalg.inv(np.linalg.qr(rows * scale, mode="r"))
    covariance = (factor @ factor.T) * scale * scale[:, None]
    points = 2 * sum(len(v.points_px) for v in views)
    misfit = float(residuals @ residuals) / max(points - _CAMERA_SIZE - 3 * len(views), 1)
    slices = {number: slice(column, column + _BAR_SIZE) for number, column in model.bars.items()}
    return ViewSolution(model.camera_of(x), x, covariance, slices, misfit)


def _site_slope(arm_m: Floats, bar_sigmas: tuple[float, float, float]) -> Floats:
    """Shifts of a bar's points, m, by sigmas of its site's place, rotation and length, float64 (n, 3, 7)."""
    place, turn, length = bar_sigmas
    moves = np.zeros((len(arm_m), 3, 7))
    moves[:, :, :3] = place * np.eye(3)
    moves[:, :, 3:6] = turn * np.cross(np.eye(3)[None], arm_m[:, None]).transpose(0, 2, 1)
    moves[:, :, 6] = length * arm_m
    return moves


def _turn_slope(turn: Floats) -> Floats:
    """Small rotation by the components of a rotation vector (the left Jacobian of the rotation group)."""
    angle = float(np.linalg.norm(turn))
    cross = np.cross(np.eye(3), turn)
    if angle < 1e-6:
        return np.asarray(np.eye(3) + cross / 2)
    k = cross / angle
    return np.asarray(np.eye(3) + (1 - math.cos(angle)) / angle * k + (1 - math.sin(angle) / angle) * (k @ k))
