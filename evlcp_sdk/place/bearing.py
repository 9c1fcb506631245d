"""Where a bar is in the camera's axes, by one frame: for whoever needs no place on earth."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.points import unseen_px
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.values import Frame

Floats = NDArray[np.float64]


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
    inverse = depth * np.linalg.inv(camera.distort_slope(sight))
    standing = np.zeros((3, 8))
    if sigma is not None and sigma.known:
        standing[:2, :7] = -inverse @ camera.parameter_slope(sight)
        # A bar of so many pixels is the farther, the longer the lens.
        standing[:, 0] += along * depth / camera.focal_px
        standing[:, :7] = standing[:, :7] @ sigma.root(camera)
    standing[:, 7] = along * depth * spec.stretch_share
    new = np.zeros((3, 3))
    new[:, 0] = along * frame.range.sigma_m
    new[:2, 1:] = inverse * shift
    return BarPoint(along * depth, new @ new.T + standing @ standing.T, standing)
