"""Move the camera, and project points into its image."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import read_table
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim.scene import NEAREST_M, MotionSpec

Floats = NDArray[np.float64]

_SINES = 128

_MAX_VALUE = 1e6
"""Largest number of a path: beyond, its splines lose millimetres."""

_SHORTEST_S = 1e-6


@dataclass(frozen=True, eq=False)
class Vibration:
    """Gaussian pitch and yaw rates as a sum of sines, computed at any time.

    The spectrum (a guess, after the sensor model): 45 % of the power around 1.5 Hz (the body on its springs),
    40 % around 12 Hz (the wheels), 15 % in a tail that falls with the square of frequency to 200 Hz.

    Attributes:
        frequency_hz: Frequencies of yaw and of pitch, float64 (2, n).
        phase: Phases of the same shape, radians.
        amplitude_rad_s: Amplitude of each sine of the rate.
    """

    frequency_hz: Floats
    phase: Floats
    amplitude_rad_s: float

    @classmethod
    def of(cls, rate_rad_s: float, seed: int) -> "Vibration":
        """Draw a vibration whose rates have this rms over long times."""
        rng = np.random.default_rng([seed, 0x71B])
        share = (np.arange(_SINES) + rng.random((2, _SINES))) / _SINES
        body, wheels, tail = share < 0.45, share < 0.85, share >= 0.85
        frequency = np.empty((2, _SINES))
        frequency[body] = np.clip(rng.normal(1.5, 0.35, body.sum()), 0.5, 3)
        wheels &= ~body
        frequency[wheels] = np.clip(rng.normal(12, 2, wheels.sum()), 6, 18)
        u = (share[tail] - 0.85) / 0.15
        frequency[tail] = 1 / (1 / 15 - u * (1 / 15 - 1 / 200))
        phase = rng.random((2, _SINES)) * 2 * math.pi
        return cls(frequency, phase, rate_rad_s * math.sqrt(2 / _SINES))

    def angle_rad(self, t_us: ArrayLike) -> Floats:
        """Return yaw and pitch at times (n,), float64 (2, n)."""
        if self.amplitude_rad_s == 0:
            return np.zeros((2, np.size(t_us)))
        scale = self.amplitude_rad_s / (2 * math.pi * self.frequency_hz)
        t_s = np.asarray(t_us, np.float64) * 1e-6
        phase = 2 * math.pi * self.frequency_hz[:, :, None] * t_s + self.phase[:, :, None]
        return np.asarray((scale[:, :, None] * np.sin(phase)).sum(1))


class CameraPath:
    """Position and attitude of the camera at any time of a scene, with a vibration of this seed.

    Raises:
        InputError: The file of a path cannot be read.
        ConfigError: It is not a path, or too short.
    """

    def __init__(self, motion: MotionSpec, duration_s: float, seed: int) -> None:
        self._motion = motion
        self._vibration = Vibration.of(motion.vib_rate_rad_s, seed)
        self._spline: CubicSpline | None = None
        if motion.path_file is not None:
            self._spline = _read_path(Path(motion.path_file), duration_s)

    def sample(self, t_us: ArrayLike) -> tuple[Floats, Floats]:
        """Return positions (n, 3), m, and attitudes (yaw, pitch, roll) (n, 3), radians, at times (n,)."""
        t_us = np.atleast_1d(np.asarray(t_us, np.float64))
        m = self._motion
        if self._spline is None:
            t_s = t_us * 1e-6
            position = np.stack([m.lateral_mps * t_s, 0 * t_s, m.speed_mps * t_s - m.distance_m], 1)
            attitude = np.tile(np.radians([m.yaw_deg, m.pitch_deg, m.roll_deg]), (len(t_s), 1))
            attitude[:, 0] += math.radians(m.yaw_rate_deg_s) * t_s
        else:
            values: Floats = self._spline(t_us * 1e-6)
            position, attitude = values[:, :3], np.radians(values[:, 3:])
        vibration_rad = self._vibration.angle_rad(t_us)
        attitude[:, 0] += m.vib_yaw_share * vibration_rad[0]
        attitude[:, 1] += vibration_rad[1]
        attitude[:, 1] += pothole_angle_rad(m, t_us)
        return position, attitude


def pothole_angle_rad(motion: MotionSpec, t_us: ArrayLike) -> Floats:
    """Return the pitch that potholes add at times (n,): after each, that of a damped spring after a blow.

    It is A sin(2 pi f t) exp(-t / decay) / (2 pi f), whose rate starts at A, `pothole_rad_s`.
    """
    t_s = np.asarray(t_us, np.float64) * 1e-6
    after = np.maximum(t_s[:, None] - np.array(motion.pothole_s), 0.0)
    turn = 2 * math.pi * motion.pothole_hz
    ringing: Floats = np.sin(turn * after) * np.exp(-after / motion.pothole_decay_s)
    return np.asarray(motion.pothole_rad_s / turn * ringing.sum(1))


def _read_path(path: Path, duration_s: float) -> CubicSpline:
    names = ("t_s", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
    _, columns = read_table(path, dict.fromkeys(names, (-_MAX_VALUE, _MAX_VALUE)), {}, rising="t_s")
    table = np.stack([columns[name] for name in names], 1)
    if len(table) < 2 or (np.diff(table[:, 0]) < _SHORTEST_S).any():
        raise ConfigError(f"{path}: expected two lines or more with rising t_s, {_SHORTEST_S:g} s apart")
    if table[0, 0] > 0 or table[-1, 0] < duration_s:
        raise ConfigError(
            f"{path}: lasts from {table[0, 0]} to {table[-1, 0]} s, the scene to {duration_s} s"
        )
    return CubicSpline(table[:, 0], table[:, 1:])


def project(
    points_m: Floats, position_m: Floats, attitude_rad: Floats, camera: CameraModel
) -> tuple[Floats, Floats]:
    """Project points into the image at several times; the middle of pixel (i, j) is at (i, j).

    Args:
        points_m: The points, float64 (p, 3), m.
        position_m: Positions of the camera, float64 (n, 3), m.
        attitude_rad: Its (yaw, pitch, roll), float64 (n, 3): first turned right, then up, then rolled with
            its top to the right.
        camera: The camera, with its principal point and distortion.

    Returns:
        Image points, px, float64 (n, p, 2), not valid closer than 0.5 m; and depths along the optical axis,
        m, float64 (n, p).
    """
    yaw, pitch, roll = attitude_rad.T[:, :, None]
    offset = points_m[None] - position_m[:, None]
    x, y, z = offset[..., 0], offset[..., 1], offset[..., 2]
    x, z = x * np.cos(yaw) - z * np.sin(yaw), x * np.sin(yaw) + z * np.cos(yaw)
    y, z = y * np.cos(pitch) + z * np.sin(pitch), z * np.cos(pitch) - y * np.sin(pitch)
    x, y = x * np.cos(roll) + y * np.sin(roll), y * np.cos(roll) - x * np.sin(roll)
    return camera.distort(np.stack([x, y], -1) / np.maximum(z, NEAREST_M)[..., None]), z
