"""The camera: a pinhole with distortion, its sensor and its lens."""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.errors import ConfigError

CAMERA_PARAMETERS = ("focal_mm", "centre_x_px", "centre_y_px", "k1", "k2", "p1", "p2")
"""The parameters that a calibration estimates, in the order of covariances."""

_NEWTON_STEPS = 12
"""Each doubles the digits; four suffice for real lenses."""

_ROUNDING = 1e-15
"""A step of a direction that is rounding: a few units in the last place of directions near 1."""


@dataclass(frozen=True)
class CameraModel:
    """A pinhole camera with Brown distortion: sensor size, pixel pitch, focal length, principal point.

    Its axes are x right, y down, z forward; the middle of pixel (i, j) is at (i, j). A direction
    (u, v) = (x / z, y / z) with r2 = u^2 + v^2 is seen in pixel

        column = centre_x_px + focal_px (u (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 u v + p2 (r2 + 2 u^2)),
        row    = centre_y_px + focal_px (v (1 + k1 r2 + k2 r2^2 + k3 r2^3) + p1 (r2 + 2 v^2) + 2 p2 u v)

    (Brown 1971, with the signs and names of OpenCV).

    >>> round(CameraModel().focal_px, 1)
    7201.6
    >>> CameraModel(k1=-0.1).project(np.array([0.5, 0.0, 10.0])).round(2).tolist()
    [999.99, 360.0]
    """

    width: Annotated[int, Field(gt=0, le=8192, description="Columns of the sensor.")] = 1280
    height: Annotated[int, Field(gt=0, le=8192, description="Rows of the sensor.")] = 720
    focal_mm: Annotated[float, Field(ge=0.01, le=1e5, description="Focal length of the lens.")] = 35.0
    pitch_um: Annotated[float, Field(ge=0.01, le=1e4, description="Spacing of the sensor's pixels.")] = 4.86
    centre_x_px: Annotated[
        float | None, Field(description="Column of the principal point; none: half the columns.")
    ] = None
    centre_y_px: Annotated[
        float | None, Field(description="Row of the principal point; none: half the rows.")
    ] = None
    k1: Annotated[
        float, Field(ge=-10, le=10, description="Radial distortion by the square of the angle.")
    ] = 0.0
    k2: Annotated[float, Field(ge=-100, le=100, description="Radial distortion by the fourth power.")] = 0.0
    p1: Annotated[
        float, Field(ge=-1, le=1, description="Tangential distortion of a lens tilted up or down.")
    ] = 0.0
    p2: Annotated[
        float, Field(ge=-1, le=1, description="Tangential distortion of a lens tilted to a side.")
    ] = 0.0
    k3: Annotated[float, Field(ge=-1000, le=1000, description="Radial distortion by the sixth power.")] = 0.0

    @cached_property
    def focal_px(self) -> float:
        """Focal length in pixels."""
        return self.focal_mm * 1e3 / self.pitch_um

    @cached_property
    def centre_px(self) -> tuple[float, float]:
        """Column and row where the optical axis meets the image."""
        x, y = self.centre_x_px, self.centre_y_px
        return self.width / 2 if x is None else x, self.height / 2 if y is None else y

    def project(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixel positions of points in camera axes, m, float64 (..., 3); NaN for points not in front."""
        z = points_m[..., 2:]
        return self.distort(points_m[..., :2] / np.where(z > 0, z, np.nan))

    def distort(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixel positions (column, row) of directions (x / z, y / z), float64 (..., 2) both."""
        if self.is_pinhole:
            return direction * self.focal_px + self.centre_px
        u, v = direction[..., 0], direction[..., 1]
        r2 = u * u + v * v
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        distorted_u = u * radial + 2 * self.p1 * u * v + self.p2 * (r2 + 2 * u * u)
        distorted_v = v * radial + self.p1 * (r2 + 2 * v * v) + 2 * self.p2 * u * v
        return np.stack([distorted_u, distorted_v], -1) * self.focal_px + self.centre_px

    def distortion_jacobian(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives of `distort` (column and row) by the direction, px, float64 (..., 2, 2)."""
        if self.is_pinhole:
            jacobian = np.zeros((*direction.shape, 2))
            jacobian[..., 0, 0] = jacobian[..., 1, 1] = self.focal_px
            return jacobian
        u, v = direction[..., 0], direction[..., 1]
        r2 = u * u + v * v
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        growth = 2 * (self.k1 + r2 * (2 * self.k2 + 3 * r2 * self.k3))
        cross = u * v * growth + 2 * self.p1 * u + 2 * self.p2 * v
        uu = radial + u * u * growth + 2 * self.p1 * v + 6 * self.p2 * u
        vv = radial + v * v * growth + 6 * self.p1 * v + 2 * self.p2 * u
        jacobian = np.stack([np.stack([uu, cross], -1), np.stack([cross, vv], -1)], -2)
        return np.asarray(jacobian * self.focal_px)

    def projection_jacobian(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives of `project` by the points, px / m, float64 (..., 2, 3); the points are in front."""
        z = points_m[..., 2]
        direction = points_m[..., :2] / z[..., None]
        by_point = np.zeros((*z.shape, 2, 3))
        by_point[..., 0, 0] = by_point[..., 1, 1] = 1 / z
        by_point[..., 2] = -direction / z[..., None]
        return self.distortion_jacobian(direction) @ by_point

    def parameter_jacobian(
        self, direction: NDArray[np.float64], seen_px: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Derivatives of `distort` by `CAMERA_PARAMETERS`, the focal length in px: float64 (..., 2, 7).

        `seen_px` is `distort(direction)`, if the caller has it already.
        """
        seen_px = self.distort(direction) if seen_px is None else seen_px
        u, v, f = direction[..., 0], direction[..., 1], self.focal_px
        r2 = u * u + v * v
        slope = np.zeros((*direction.shape, len(CAMERA_PARAMETERS)))
        slope[..., 0] = (seen_px - self.centre_px) / f
        slope[..., 0, 1] = slope[..., 1, 2] = 1.0
        slope[..., 3] = f * direction * r2[..., None]
        slope[..., 4] = slope[..., 3] * r2[..., None]
        slope[..., 0, 5] = slope[..., 1, 6] = 2 * f * u * v
        slope[..., 1, 5], slope[..., 0, 6] = f * (r2 + 2 * v * v), f * (r2 + 2 * u * u)
        return slope

    def undistort(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Directions (x / z, y / z) of pixel positions, float64 (..., 2) both: the inverse of `distort`.

        Newton steps from the undistorted direction; NaN where they do not converge, as for a pixel beyond the
        largest angle that a strong distortion can show.
        """
        undistorted = (points_px - self.centre_px) / self.focal_px
        if self.is_pinhole:
            return undistorted
        found = undistorted.copy()
        for _ in range(_NEWTON_STEPS):
            jacobian = self.distortion_jacobian(found) / self.focal_px
            miss = undistorted - (self.distort(found) - self.centre_px) / self.focal_px
            a, b, d = jacobian[..., 0, 0], jacobian[..., 0, 1], jacobian[..., 1, 1]
            # The Jacobian turns singular, and then negative, at the largest angle that is shown.
            determinant = np.where((a > 0) & (a * d > b * b), a * d - b * b, np.nan)
            step_u = (d * miss[..., 0] - b * miss[..., 1]) / determinant
            step_v = (a * miss[..., 1] - b * miss[..., 0]) / determinant
            # Each point stops when its own step is rounding, so that no point depends on the others.
            moves = ~(np.maximum(np.abs(step_u), np.abs(step_v)) <= _ROUNDING)
            if not moves.any():
                break
            found = np.where(moves[..., None], found + np.stack([step_u, step_v], -1), found)
        residual_px = np.abs(self.distort(found) - points_px).max(-1, keepdims=True)
        return np.where(residual_px < 1e-6, found, np.nan)

    @cached_property
    def is_pinhole(self) -> bool:
        """Whether there is no distortion."""
        return self.k1 == self.k2 == self.p1 == self.p2 == self.k3 == 0

    def direction(self, x_px: float, y_px: float) -> tuple[float, float]:
        """Direction (x / z, y / z) of one pixel position: `undistort` of a single point."""
        if self.is_pinhole:
            (centre_x_px, centre_y_px), focal_px = self.centre_px, self.focal_px
            return (x_px - centre_x_px) / focal_px, (y_px - centre_y_px) / focal_px
        u, v = self.undistort(np.array([x_px, y_px])).tolist()
        return u, v

    def distance_m(self, spacing_m: float, spacing_px: float) -> float:
        """Depth of two points parallel to the sensor, m: L = f S / (l' a) of arXiv 2510.17203.

        S is their distance `spacing_m`, and l' their distance in the image, `spacing_px`.
        """
        return self.focal_px * spacing_m / spacing_px


@dataclass(frozen=True)
class CameraSigma:
    """Standard deviations of the camera's parameters, and their correlation, from a calibration.

    Raises:
        ConfigError: The correlation is not that of seven parameters: its shape is another, its diagonal is
            not 1, it is not symmetric, or it has a direction of negative variance.

    >>> CameraSigma(focal_mm=0.035).covariance_root(CameraModel())[0, 0].round(2)
    np.float64(7.2)
    """

    focal_mm: Annotated[
        float, Field(ge=0, le=1e4, description="Standard deviation of the focal length; 0: exact.")
    ] = 0.0
    centre_x_px: Annotated[
        float, Field(ge=0, le=1e4, description="Standard deviation of the principal point's column.")
    ] = 0.0
    centre_y_px: Annotated[float, Field(ge=0, le=1e4, description="Standard deviation of its row.")] = 0.0
    k1: Annotated[float, Field(ge=0, le=10, description="Standard deviation of k1.")] = 0.0
    k2: Annotated[float, Field(ge=0, le=100, description="Standard deviation of k2.")] = 0.0
    p1: Annotated[float, Field(ge=0, le=1, description="Standard deviation of p1.")] = 0.0
    p2: Annotated[float, Field(ge=0, le=1, description="Standard deviation of p2.")] = 0.0
    correlation: Annotated[
        tuple[tuple[float, ...], ...],
        Field(description="Correlations of these seven in this order, row by row; empty: none."),
    ] = ()

    def __post_init__(self) -> None:
        if not self.correlation:
            return
        n = len(CAMERA_PARAMETERS)
        if len(self.correlation) != n or any(len(row) != n for row in self.correlation):
            raise ConfigError(f"camera_sigma.correlation: expected {n} rows of {n}")
        matrix = np.array(self.correlation)
        if not np.allclose(np.diag(matrix), 1, atol=1e-6) or not np.allclose(matrix, matrix.T, atol=1e-6):
            raise ConfigError("camera_sigma.correlation: expected 1 on the diagonal, the same on both sides")
        if float(np.linalg.eigvalsh(matrix)[0]) < -1e-6:
            raise ConfigError("camera_sigma.correlation: expected no direction of negative variance")

    @property
    def is_known(self) -> bool:
        """Whether any parameter has a standard deviation."""
        return any(getattr(self, name) > 0 for name in CAMERA_PARAMETERS)

    def covariance_root(self, camera: CameraModel) -> NDArray[np.float64]:
        """Lower root of the seven parameters' covariance, the focal length in px: float64 (7, 7)."""
        sigma = np.array([getattr(self, name) for name in CAMERA_PARAMETERS])
        sigma[0] *= camera.focal_px / camera.focal_mm
        if not self.correlation:
            return np.diag(sigma)
        # A correlation that is written with few digits may be singular.
        matrix = np.array(self.correlation) + 1e-9 * np.eye(len(sigma))
        return np.asarray(sigma[:, None] * np.linalg.cholesky((matrix + matrix.T) / 2))
