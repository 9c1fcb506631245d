"""Position and velocity carried from one time to a later one by how the camera turned and was pushed.

East and north are one complex number, east + i north: a turn by an angle clockwise is a factor exp(-i angle).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.scene.attitude import Swing

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Reckoned:
    """What time makes of position, m, and velocity, m/s: east, north, up of each.

    Attributes:
        move: How they depend on what they were, float64 (6, 6).
        added: What a push adds to them, float64 (6,).
        noise: Covariance of what is not known of it, float64 (6, 6).
        by_imu: How they depend on the IMU's biases in their sigmas, float64 (6, 0, 1 or 4).
        turn_rad: By how much the heading changes, clockwise.
    """

    move: Floats
    added: Floats
    noise: Floats
    by_imu: Floats
    turn_rad: float


def imu_sigmas(swing: Swing, spec: ErrorModel) -> Floats:
    """Sigmas of an IMU's biases: the gyroscope's, radians/s, the accelerometer's, m/s2: none, 1 or 4."""
    sigmas = [np.radians(spec.rate_sigma_deg_s)] if swing.gyro else []
    if swing.push_m_s2 is not None:
        sigmas += 3 * [spec.push_sigma_m_s2]
    return np.array(sigmas)


def reckon(
    swing: Swing,
    velocity_m_s: Floats,
    heading_rad: float,
    heading_sigma_rad: float,
    imu: Floats,
    spec: ErrorModel,
) -> Reckoned:
    """Carry position and velocity over a time.

    Without a push the velocity turns as the camera does, driven by white acceleration; with one it changes by
    what is measured.

    Args:
        swing: How the camera turned, and was pushed.
        velocity_m_s: At its start, east, north, up, float64 (3,).
        heading_rad: The camera's at its start, clockwise from north; matters for a push only.
        heading_sigma_rad: Of it.
        imu: Estimated biases of the IMU in their sigmas, float64 (0, 1 or 4,).
        spec: Powers of what is not known.
    """
    sigmas = imu_sigmas(swing, spec)
    bias = imu * sigmas
    s, weight = _nodes(swing.t_s)
    span = float(s[-1])
    angle = np.interp(s, swing.t_s, swing.turn_rad)
    if swing.gyro:
        angle = angle - bias[0] * s
    turned, way = np.exp(-1j * angle), _integral_of_turn(s, angle)
    pushed = None
    if swing.push_m_s2 is None:
        ahead = complex(velocity_m_s[0], velocity_m_s[1])
        rest = way[-1] - way
        by_angle = -1j * ahead * np.stack([rest, np.full_like(rest, turned[-1])])
        kicked = np.stack([rest, np.full_like(rest, turned[-1])]) / turned
        white = spec.acceleration_m2_s3
        move_to = complex(way[-1]), complex(turned[-1])
        added = np.zeros(6)
    else:
        pushed = swing.push_m_s2 - bias[-3:]
        level = np.interp(s, swing.t_s, pushed[:, 0]) + 1j * np.interp(s, swing.t_s, pushed[:, 1])
        facing = np.exp(-1j * heading_rad)
        speed = _running(s, facing * turned * level)
        place = _running(s, speed)
        by_angle = -1j * np.stack([place[-1] - place - speed * (span - s), speed[-1] - speed])
        kicked = np.stack([span - s, np.ones_like(s)]).astype(np.complex128)
        white = spec.push_white_m2_s3
        move_to = complex(span), complex(1.0)
        up = np.interp(s, swing.t_s, pushed[:, 2])
        climb = _running(s, up)
        high = _running(s, climb)
        added = np.array(
            [place[-1].real, place[-1].imag, high[-1], speed[-1].real, speed[-1].imag, climb[-1]]
        )
    move = np.eye(6)
    move[:2, 3:5], move[3:5, 3:5] = _matrix(move_to[0]), _matrix(move_to[1])
    move[2, 5] = span
    noise = white * _white(kicked, weight)
    noise[np.ix_((2, 5), (2, 5))] = white * np.array([[span**3 / 3, span**2 / 2], [span**2 / 2, span]])
    flat = np.stack([by_angle[0].real, by_angle[0].imag, by_angle[1].real, by_angle[1].imag])
    level_rows = [0, 1, 3, 4]
    by_imu = np.zeros((6, len(sigmas)))
    if swing.gyro:
        drift = np.radians(spec.rate_white_deg_rts) ** 2
        noise[np.ix_(level_rows, level_rows)] += drift * (flat * weight) @ flat.T
        by_imu[level_rows, 0] = -(flat @ weight) * sigmas[0]
    if pushed is not None:
        facing = np.exp(-1j * heading_rad)
        along = (complex(facing * (way @ weight)), complex(facing * way[-1]))
        for row, c in zip((0, 3), along, strict=True):
            by_imu[row : row + 2, -3:-1] = -_matrix(c) * sigmas[-1]
        by_imu[2, -1], by_imu[5, -1] = -(span**2) / 2 * sigmas[-1], -span * sigmas[-1]
        askew = flat[:, 0] * heading_sigma_rad
        noise[np.ix_(level_rows, level_rows)] += np.outer(askew, askew)
    return Reckoned(move, added, noise, by_imu, float(angle[-1]))


def _nodes(t_s: Floats) -> tuple[Floats, Floats]:
    """Times with one midway between each two, and Simpson's weights of them."""
    step = np.diff(t_s)
    s = np.empty(2 * len(t_s) - 1)
    s[::2], s[1::2] = t_s, t_s[:-1] + step / 2
    weight = np.zeros(len(s))
    weight[1::2] = 4 * step / 6
    weight[:-1:2] += step / 6
    weight[2::2] += step / 6
    return s, weight


def _integral_of_turn(s: Floats, angle: Floats) -> Complex:
    """The integral of exp(-i angle) from the start to each time; the angle is a straight line between two."""
    half = np.diff(angle) / 2
    chord = np.diff(s) * np.sinc(half / np.pi) * np.exp(-1j * (angle[:-1] + half))
    return np.concatenate([np.zeros(1, np.complex128), np.cumsum(chord)])


def _running(s: Floats, values: NDArray[Any]) -> NDArray[Any]:
    """The integral from the start to each time, by the trapezoidal rule."""
    area = np.cumsum(np.diff(s) * (values[1:] + values[:-1]) / 2)
    return np.concatenate([np.zeros(1, values.dtype), area])


def _white(kicked: Complex, weight: Floats) -> Floats:
    """Covariance of east and north of place and speed by white kicks of power 1, in (6, 6)."""
    place, speed = kicked
    noise = np.zeros((6, 6))
    noise[:2, :2] = np.eye(2) * float(weight @ abs(place) ** 2)
    noise[3:5, 3:5] = np.eye(2) * float(weight @ abs(speed) ** 2)
    noise[:2, 3:5] = _matrix(complex(weight @ (place * speed.conj())))
    noise[3:5, :2] = noise[:2, 3:5].T
    return noise


def _matrix(c: complex) -> Floats:
    """What multiplies (east, north) as `c` does east + i north."""
    return np.array([[c.real, -c.imag], [c.imag, c.real]])
