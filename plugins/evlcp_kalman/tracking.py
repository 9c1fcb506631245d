"""Constant-velocity Kalman filters of distance and image position."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.plugin.roles import Filter, Tracker, Tracking


@dataclass(frozen=True)
class NoTracking(Tracking):
    """Every frame by itself."""

    def compile(self) -> Tracker:
        """No filters."""
        return Tracker(position=None, distance=None)


@dataclass(frozen=True)
class KalmanTracking(Tracking):
    """Causal filters whose state is value and velocity, driven by white acceleration (Bar-Shalom, chapter 6).

    The measurement's variance is pooled over frames, as a single frame's sigma is itself a rough estimate,
    and weights by it would favour frames that look better than they are. A measurement far from its
    prediction is left out. In the image, a pothole changes the speed at once: a measurement that only such a
    jolt explains is followed, as if the speed had become unknown by so much at the last one.
    """

    acceleration_m2_s3: Annotated[
        float,
        Field(gt=0, description="Power density of the change of speed: 1 m/s2 that lasts for a second."),
    ] = 1.0
    speed_m_s: Annotated[float, Field(gt=0, description="Speeds that are likely at first (sigma).")] = 20.0
    acceleration_px2_s3: Annotated[
        float,
        Field(gt=0, description="The same in the image: 430 px/s at 15 Hz, for 10 ms, have 3e7, peaks more."),
    ] = 1e8
    speed_px_s: Annotated[
        float, Field(gt=0, description="Image speeds that are likely at first: peaks of vibration.")
    ] = 1500.0
    jolt_px_s: Annotated[
        float,
        Field(ge=0, description="Change of image speed in a jolt (sigma): a pothole peaks at 7000 px/s."),
    ] = 3000.0
    gate: Annotated[
        float, Field(gt=1, description="Sigmas off the prediction from which on it is a jolt's or left out.")
    ] = 5.0
    pooled_frames: Annotated[
        int, Field(ge=1, description="Frames over which the measurement's variance is averaged.")
    ] = 30

    def compile(self) -> Tracker:
        """Filters of position (px) and distance (m)."""
        return Tracker(
            position=_ConstantVelocity(
                self.acceleration_px2_s3, self.speed_px_s, self.jolt_px_s, self.gate, self.pooled_frames
            ),
            distance=_ConstantVelocity(
                self.acceleration_m2_s3, self.speed_m_s, 0.0, self.gate, self.pooled_frames
            ),
        )


@dataclass(frozen=True, eq=False)
class _State:
    """Values and velocities (2, n), their covariance (2, 2) common to all, and the pooled variance."""

    t_s: float
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    variance: float
    count: int
    missed: int


@dataclass(frozen=True)
class _ConstantVelocity(Filter):
    density: float
    speed: float
    jolt: float
    gate: float
    pooled: int

    def init(self) -> None:
        return None

    def predict(self, state: _State | None, t_us: float) -> tuple[NDArray[np.float64], float] | None:
        if state is None:
            return None
        mean, covariance = self._predict_state(state, t_us)
        return mean[0], float(np.sqrt(covariance[0, 0]))

    def step(
        self, state: _State | None, t_us: float, value: NDArray[np.float64], sigma: float
    ) -> tuple[_State, NDArray[np.float64], float]:
        t_s = t_us * 1e-6
        if state is None:
            state = _State(
                t_s,
                np.stack([value, np.zeros_like(value)]),
                np.diag([sigma**2, self.speed**2]),
                sigma**2,
                1,
                0,
            )
            return state, value.copy(), sigma
        count = min(state.count + 1, self.pooled)
        variance = state.variance + (sigma**2 - state.variance) / count
        mean, covariance = self._predict_state(state, t_us)
        innovation = value - mean[0]
        off = float(np.abs(innovation).max())
        spread = covariance[0, 0] + variance
        if off > self.gate * np.sqrt(spread):
            dt = t_s - state.t_s
            covariance = covariance + self.jolt**2 * np.array([[dt**2, dt], [dt, 1.0]])
            spread = covariance[0, 0] + variance
        missed = 0
        if off > self.gate * np.sqrt(spread):
            # No jolt explains it either: neither the measurement nor a jolt is taken in.
            mean, covariance = self._predict_state(state, t_us)
            missed = state.missed + 1
            if missed > self.pooled // 2:
                # So many in a row are no outliers: the target has changed.
                return self.step(None, t_us, value, sigma)
        else:
            gain = covariance[:, 0] / spread
            mean = mean + gain[:, None] * innovation
            covariance = covariance - np.outer(gain, covariance[0])
        state = _State(t_s, mean, covariance, variance, count, missed)
        return state, mean[0].copy(), float(np.sqrt(covariance[0, 0]))

    def _predict_state(self, state: _State, t_us: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        dt = t_us * 1e-6 - state.t_s
        move = np.array([[1.0, dt], [0.0, 1.0]])
        noise = self.density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, abs(dt)]])
        return move @ state.mean, move @ state.covariance @ move.T + noise
