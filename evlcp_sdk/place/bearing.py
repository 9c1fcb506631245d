"""Where a bar is in the camera's axes, by one frame: for whoever needs no place on earth."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.points import unseen_px
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.values import Frame

Floats = NDArray[np.float64]

_STEPS = (1.0, 0.1, 0.1, 1e-4, 1e-4, 1e-6, 1e-6)
"""Changes of the camera's parameters that slopes are taken over; the focal length in px."""


@dataclass(frozen=True, eq=False)
class BarPoint:
    """A bar's centre in the camera's axes: x right, y down, z forward.

    Attributes:
        point_m: float64 (3,), m.
        covariance_m2: Of it, float64 (3, 3).
        standing: The part of this that stays over frames, as the point's moves by one sigma of each of the
            camera's parameters, and of how long the bar looks, m, float64 (3, 8).
    """

    point_m: Floats
    covariance_m2: Floats
    standing: Floats


def bar_point(
    frame: Frame,
    length_m: float,
    camera: CameraModel,
    sigma: CameraSigma | None = None,
    spec: ErrorModel | None = None,
) -> BarPoint | None:
    """Where the centre of a frame's bar is; None where the frame has no distance.

    The distance is that along the optical axis, with its sigma; the bearing is that of the bar's centre in
    the image. They err together where the camera's focal length does.

    Args:
        frame: A frame.
        length_m: Length of the bar.
        camera: The camera.
        sigma: How precisely it is known; None: exactly.
        spec: Errors that a bar's points share; None for the defaults.
    """
    spec = ErrorModel() if spec is None else spec
    depth = frame.range.distance_m
    sight = camera.undistort(np.array([frame.x_px, frame.y_px]))
    if not (math.isfinite(depth) and math.isfinite(frame.range.sigma_m) and np.isfinite(sight).all()):
        return None
    along = np.array([sight[0], sight[1], 1.0])
    grown = spec.shared_share * camera.focal_px * length_m / depth
    shift = math.hypot(
        spec.shaken_sigma_px,
        max(
            math.hypot(spec.shared_sigma_px, unseen_px(frame.points_flank_px)),
            math.hypot(spec.shared_along_px, grown),
        ),
    )
    across = depth * np.linalg.inv(camera.distort_slope(sight)) * shift
    standing = np.zeros((3, 8))
    if sigma is not None and sigma.known:
        standing[:, :7] = _slopes(frame, depth, camera) @ sigma.root(camera)
    standing[:, 7] = along * depth * spec.stretch_share
    new = np.zeros((3, 3))
    new[:, 0] = along * frame.range.sigma_m
    new[:2, 1:] = across
    return BarPoint(along * depth, new @ new.T + standing @ standing.T, standing)


def _slopes(frame: Frame, depth_m: float, camera: CameraModel) -> Floats:
    """How the point moves by each parameter of the camera, its focal length in px: float64 (3, 7)."""
    pixel, f = np.array([frame.x_px, frame.y_px]), camera.focal_px

    def point(parameters: Floats) -> Floats:
        focal, x, y, k1, k2, p1, p2 = parameters.tolist()
        changed = replace(
            camera,
            focal_mm=camera.focal_mm * focal / f,
            centre_x_px=x,
            centre_y_px=y,
            k1=k1,
            k2=k2,
            p1=p1,
            p2=p2,
        )
        # A bar of so many pixels is the farther, the longer the lens.
        return np.asarray(np.append(changed.undistort(pixel), 1.0) * depth_m * focal / f)

    here = np.array([f, *camera.centre_px, camera.k1, camera.k2, camera.p1, camera.p2])
    steps = np.diag(_STEPS)
    return np.stack([(point(here + s) - point(here - s)) / (2 * s.sum()) for s in steps], 1)
