"""How a camera turns, and is pushed, between two times: what an IMU says where no bar is seen."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Swing:
    """Turn and push of a camera at times between two, straight lines between these.

    Attributes:
        t_s: Since the first time, s, rising from 0 to the last, float64 (k,), k >= 2.
        turn_rad: By how much the heading has changed since the first time, clockwise, radians, float64 (k,).
        gyro: The turn is that of a gyroscope, which has a bias and a noise that grows.
        push_m_s2: Acceleration without gravity, to the camera's right, forward, both level, and up, m/s2,
            float64 (k, 3); None without an accelerometer.
    """

    t_s: Floats
    turn_rad: Floats
    gyro: bool = False
    push_m_s2: Floats | None = None

    @classmethod
    def even(cls, dt_s: float, turn_rad: float) -> "Swing":
        """A turn at one rate."""
        return cls(np.array([0.0, dt_s]), np.array([0.0, turn_rad]))
