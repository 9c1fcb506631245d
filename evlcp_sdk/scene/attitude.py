"""The camera's attitude: at one time, and over time from a file such as an IMU's log."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import ANY_NUMBER, read_table

_AXES = ("right", "down", "forward")
_RATES = tuple(f"rate_{axis}_deg_s" for axis in _AXES)
_FORCES = tuple(f"force_{axis}_m_s2" for axis in _AXES)

_GRAVITY_M_S2 = 9.80665
"""On earth it is within 0.03 of this, less than an accelerometer's bias."""

_LARGEST_READING = 1e5
"""A rate, degrees/s, or force, m/s2, above any sensor's range."""

PITCH_DEG = -89.0, 89.0
"""Range of a camera's pitch: who looks straight up or down has no heading."""

_NEEDED = {"t_us": ANY_NUMBER, "pitch_deg": PITCH_DEG, "roll_deg": ANY_NUMBER}
_OPTIONAL = {
    "heading_deg": ANY_NUMBER,
    **dict.fromkeys(("gravity_sigma_deg", "heading_sigma_deg"), (0.0, math.inf)),
    **dict.fromkeys(_RATES + _FORCES, (-_LARGEST_READING, _LARGEST_READING)),
}
"""Columns, and the range of their values."""

_GAP_INTERVALS = 10.0
"""Time between two lines, in median intervals, above which lines are lost; jitter of clocks and buffers makes
it two or three."""

_COMPARED_PIECES = 32
"""Pieces of a log in which turns by headings and by rates are compared: of so many unrelated ones, less than
1 in 100 000 agree by half (r2)."""

_LARGEST_DRIFT_DEG_S = 5.0
"""Rate at rest above that of any gyroscope that is of use for a track."""

_MAX_KNOTS = 4096
"""Lines of a log that one step of a track uses; of more, every second, third ... counts."""


@dataclass(frozen=True)
class Attitude:
    """The camera's pitch, roll and heading, and their errors: from gravity and a compass.

    From looking level to the north the camera is first turned to the right, then up, then rolled.

    Attributes:
        pitch_deg: How far the optical axis points above the horizon.
        roll_deg: How far the camera's top tilts to its right.
        heading_deg: Where the optical axis points to, clockwise from north; None when unknown.
        gravity_sigma_deg: Standard deviation of the bias of pitch and of roll; 0: exact.
        heading_sigma_deg: Standard deviation of the heading's bias; 0: exact.
        white_sigma_deg: Standard deviation of each angle's error that is independent at every time.
        time_sigma_us: Standard deviation of the clock's offset from the camera's, us.
        rate_deg_s: Rates of change of pitch, roll and heading, degrees / s, by which an offset in time
            shifts them.

    >>> Attitude(heading_deg=90.0).rotation()[:, 2].round(6).tolist()
    [1.0, 0.0, 0.0]
    """

    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    heading_deg: float | None = None
    gravity_sigma_deg: float = 0.1
    heading_sigma_deg: float = 0.5
    white_sigma_deg: float = 0.0
    time_sigma_us: float = 0.0
    rate_deg_s: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def bias_root_rad(self) -> NDArray[np.float64]:
        """Shifts of pitch, roll and heading by one sigma of each persistent error, float64 (3, 4).

        The columns are the biases of the three, and the offset in time.
        """
        tilt, turn = math.radians(self.gravity_sigma_deg), math.radians(self.heading_sigma_deg)
        pitch, roll, heading = (math.radians(v) * self.time_sigma_us * 1e-6 for v in self.rate_deg_s)
        return np.array([[tilt, 0.0, 0.0, pitch], [0.0, tilt, 0.0, roll], [0.0, 0.0, turn, heading]])

    def rotation(self) -> NDArray[np.float64]:
        """Camera axes (x right, y down, z forward) as columns in ENU, float64 (3, 3); north if unknown."""
        h, p, r = (math.radians(v) for v in (self.heading_deg or 0.0, self.pitch_deg, self.roll_deg))
        (sh, ch), (sp, cp), (sr, cr) = ((math.sin(v), math.cos(v)) for v in (h, p, r))
        # Each a row to the right and one down, not rolled, and one ahead.
        rows = (ch, sp * sh, cp * sh), (-sh, sp * ch, cp * ch), (0.0, -cp, sp)
        return np.array([(a * cr + b * sr, b * cr - a * sr, c) for a, b, c in rows])

    @classmethod
    def of_rotation(cls, rotation: NDArray[np.float64]) -> "Attitude":
        """The attitude of camera axes in ENU, float64 (3, 3); heading in 0 to 360, no sigmas.

        >>> a = Attitude.of_rotation(Attitude(pitch_deg=5.0, roll_deg=-3.0, heading_deg=200.0).rotation())
        >>> round(a.pitch_deg, 6), round(a.roll_deg, 6), round(a.heading_deg or 0, 6)
        (5.0, -3.0, 200.0)
        """
        forward, up = rotation[:, 2], rotation[2]
        heading = float(np.degrees(np.arctan2(forward[0], forward[1]))) % 360.0
        pitch = float(np.degrees(np.arcsin(np.clip(forward[2], -1, 1))))
        roll = float(np.degrees(np.arctan2(-up[0], -up[1])))
        return cls(pitch, roll, heading, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class ImuMotion:
    """Turn and acceleration of a camera from one time to another, linear between samples.

    Attributes:
        t_s: Times of the samples since the first, s, rising, float64 (k,), k >= 2.
        turn_rad: Clockwise change of the heading since the first time, radians, float64 (k,).
        has_gyro: Whether a gyroscope measured the turn, with a bias and a noise that grows.
        acceleration_m_s2: Acceleration without gravity, to the camera's right, forward, both level, and up,
            m/s2, float64 (k, 3); None without an accelerometer.
    """

    t_s: NDArray[np.float64]
    turn_rad: NDArray[np.float64]
    has_gyro: bool = False
    acceleration_m_s2: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class AttitudeLog:
    """Attitudes at rising times, linear between them; unknown before, after, and where lines are lost.

    Lines are lost between two that are more than ten median intervals apart.

    Attributes:
        t_us: Camera clock, us, float64 (n,), rising.
        pitch_deg: float64 (n,).
        roll_deg: float64 (n,).
        heading_deg: float64 (n,); None if the heading is unknown.
        gravity_sigma_deg: float64 (n,).
        heading_sigma_deg: float64 (n,).
        white_sigma_deg: As in `Attitude`.
        time_sigma_us: As in `Attitude`.
        rates_deg_s: A gyroscope's rates about the camera's axes right, down and forward, float64 (n, 3);
            None without one. A turn to the right is positive about down.
        forces_m_s2: An accelerometer's forces along the same axes, float64 (n, 3), at rest and level -9.8
            down; None without one.
    """

    t_us: NDArray[np.float64]
    pitch_deg: NDArray[np.float64]
    roll_deg: NDArray[np.float64]
    heading_deg: NDArray[np.float64] | None
    gravity_sigma_deg: NDArray[np.float64]
    heading_sigma_deg: NDArray[np.float64]
    white_sigma_deg: float = 0.0
    time_sigma_us: float = 0.0
    rates_deg_s: NDArray[np.float64] | None = None
    forces_m_s2: NDArray[np.float64] | None = None

    @classmethod
    def read(cls, path: Path | str, default: Attitude | None = None) -> "AttitudeLog":
        """Read a CSV of t_us, pitch_deg, roll_deg; optionally heading_deg, both sigmas, rates and forces.

        Args:
            path: The file.
            default: Gives the sigmas that the file lacks; None for an `Attitude` of defaults.

        Raises:
            InputError: The file cannot be read.
            ConfigError: A column is missing, a value is not a number, or times do not rise; rates or forces
                lack an axis; there are forces without rates; the mean upward force differs from gravity by
                half or more; or rates and headings turn in opposite directions or at different scales.
        """
        default = Attitude() if default is None else default
        _, table = read_table(path, _NEEDED, _OPTIONAL, rising="t_us")
        for axes in (_RATES, _FORCES):
            absent = [name for name in axes if name not in table]
            if 0 < len(absent) < len(axes):
                raise ConfigError(f"{path}: line 1: no column {absent[0]} (columns: {', '.join(axes)})")
        if _FORCES[0] in table and _RATES[0] not in table:
            raise ConfigError(f"{path}: line 1: no column {_RATES[0]}: forces need the rates, too")
        t_us = table["t_us"]
        if len(t_us) < 2:
            raise ConfigError(f"{path}: expected two lines or more with rising t_us")
        log = cls(
            t_us,
            table["pitch_deg"],
            np.degrees(np.unwrap(np.radians(table["roll_deg"]))),
            np.degrees(np.unwrap(np.radians(table["heading_deg"]))) if "heading_deg" in table else None,
            table.get("gravity_sigma_deg", np.full(len(t_us), default.gravity_sigma_deg)),
            table.get("heading_sigma_deg", np.full(len(t_us), default.heading_sigma_deg)),
            default.white_sigma_deg,
            default.time_sigma_us,
            *(np.stack([table[n] for n in a], 1) if a[0] in table else None for a in (_RATES, _FORCES)),
        )
        log._check_conventions(path)
        return log

    def _check_conventions(self, path: Path | str) -> None:
        if self._acceleration_m_s2 is not None:
            upward = float(self._acceleration_m_s2[:, 2].mean()) + _GRAVITY_M_S2
            if not 0.5 * _GRAVITY_M_S2 < upward < 1.5 * _GRAVITY_M_S2:
                raise ConfigError(
                    f"{path}: forces hold the camera up by {upward:.1f} m/s2 on the mean, expected about 9.8:"
                    " a level camera at rest has force_down_m_s2 = -9.8"
                )
        scale = self._rate_scale()
        if scale is not None and not 0.5 < scale < 1.5:
            raise ConfigError(
                f"{path}: rates turn the camera {scale:.3g} times as far as its headings do, expected 1:"
                " a turn to the right is positive about down, in degrees/s"
            )

    def _rate_scale(self) -> float | None:
        """The turn by rates as a multiple of that by headings; None if the log does not determine it.

        Noise of the headings makes it less than 1, but not less than their agreement (r2).
        """
        turn_rad = self._heading_change_rad
        if self.heading_deg is None or self.rates_deg_s is None or turn_rad is None:
            return None
        ends_us = np.linspace(self.t_us[0], self.t_us[-1], _COMPARED_PIECES + 1)
        piece_s = (ends_us[1] - ends_us[0]) * 1e-6
        logged = np.diff(np.interp(ends_us, self.t_us, self.heading_deg)) / piece_s
        measured = np.degrees(np.diff(np.interp(ends_us, self.t_us, turn_rad))) / piece_s
        both, own = float(logged @ measured), float(logged @ logged)
        if np.sqrt(((measured - logged) ** 2).mean()) < _LARGEST_DRIFT_DEG_S:
            return None
        return both / own if both**2 > 0.5 * own * float(measured @ measured) else None

    def to_csv(self) -> str:
        """The log as the text of a CSV file for `read`."""
        columns = {
            "t_us": [f"{v:.0f}" for v in self.t_us],
            "pitch_deg": [f"{v:.5f}" for v in self.pitch_deg],
            "roll_deg": [f"{v:.5f}" for v in self.roll_deg],
            "gravity_sigma_deg": [f"{v:g}" for v in self.gravity_sigma_deg],
        }
        if self.heading_deg is not None:
            columns["heading_deg"] = [f"{v % 360:.5f}" for v in self.heading_deg]
            columns["heading_sigma_deg"] = [f"{v:g}" for v in self.heading_sigma_deg]
        for names, values in ((_RATES, self.rates_deg_s), (_FORCES, self.forces_m_s2)):
            if values is not None:
                columns |= {n: [f"{v:.5f}" for v in c] for n, c in zip(names, values.T, strict=True)}
        lines = [",".join(columns), *(",".join(row) for row in zip(*columns.values(), strict=True))]
        return "\n".join(lines) + "\n"

    def interpolate(self, t_us: float) -> Attitude | None:
        """The attitude at a time, linear between lines; None outside the log and where lines are lost."""
        if not self.t_us[0] <= t_us <= self.t_us[-1]:
            return None
        before, after = (int(np.searchsorted(self.t_us, t_us, side)) for side in ("left", "right"))
        if before == after and self._has_gap(before - 1, after):
            return None

        def value(column: NDArray[np.float64]) -> float:
            return float(np.interp(t_us, self.t_us, column))

        return Attitude(
            value(self.pitch_deg),
            value(self.roll_deg),
            None if self.heading_deg is None else value(self.heading_deg) % 360,
            value(self.gravity_sigma_deg),
            value(self.heading_sigma_deg),
            self.white_sigma_deg,
            self.time_sigma_us,
            self._rate_deg_s(t_us),
        )

    def motion_between(self, start_us: float, end_us: float) -> ImuMotion | None:
        """The camera's turn and acceleration from one time to a later one; None if they are not known.

        The turn is by the rates if the log has any, else by the headings.
        """
        turn_rad = self._heading_change_rad
        if turn_rad is None or not self.t_us[0] <= start_us < end_us <= self.t_us[-1]:
            return None
        first, last = np.searchsorted(self.t_us, (start_us, end_us), "right").tolist()
        if self._has_gap(first - 1, int(np.searchsorted(self.t_us, end_us))):
            return None
        inner = self.t_us[first:last]
        inner = inner[inner < end_us][:: 1 + len(inner) // _MAX_KNOTS]
        t_us = np.concatenate([[start_us], inner, [end_us]])
        angle = np.interp(t_us, self.t_us, turn_rad)
        acceleration = self._acceleration_m_s2
        if acceleration is not None:
            acceleration = np.stack([np.interp(t_us, self.t_us, column) for column in acceleration.T], 1)
        has_gyro = self.rates_deg_s is not None
        return ImuMotion((t_us - start_us) * 1e-6, angle - angle[0], has_gyro, acceleration)

    def _has_gap(self, first: int, last: int) -> bool:
        return bool((np.diff(self.t_us[first : last + 1]) > self._longest_interval_us).any())

    @cached_property
    def _longest_interval_us(self) -> float:
        return _GAP_INTERVALS * float(np.median(np.diff(self.t_us)))

    @cached_property
    def _heading_change_rad(self) -> NDArray[np.float64] | None:
        """The heading's change since the first line, by rates if there are any, float64 (n,)."""
        if self.rates_deg_s is None:
            return None if self.heading_deg is None else np.radians(self.heading_deg - self.heading_deg[0])
        rate = -(self.rates_deg_s * self._up_axis()).sum(1)
        steps = np.diff(self.t_us) * (rate[1:] + rate[:-1]) / 2
        return np.radians(np.concatenate([[0.0], np.cumsum(steps)]) * 1e-6)

    @cached_property
    def _acceleration_m_s2(self) -> NDArray[np.float64] | None:
        """Acceleration without gravity to the right, forward and up, both level, float64 (n, 3)."""
        if self.forces_m_s2 is None:
            return None
        right, down, forward = self.forces_m_s2.T
        pitch, roll = np.radians(self.pitch_deg), np.radians(self.roll_deg)
        below = right * np.sin(roll) + down * np.cos(roll)
        return np.stack(
            [
                right * np.cos(roll) - down * np.sin(roll),
                below * np.sin(pitch) + forward * np.cos(pitch),
                (self.forces_m_s2 * self._up_axis()).sum(1) - _GRAVITY_M_S2,
            ],
            1,
        )

    def _up_axis(self) -> NDArray[np.float64]:
        """The vertical in camera axes, float64 (n, 3)."""
        pitch, roll = np.radians(self.pitch_deg), np.radians(self.roll_deg)
        level = -np.cos(pitch)
        return np.stack([level * np.sin(roll), level * np.cos(roll), np.sin(pitch)], 1)

    def _rate_deg_s(self, t_us: float) -> tuple[float, float, float]:
        after = min(max(int(np.searchsorted(self.t_us, t_us, "right")), 1), len(self.t_us) - 1)
        dt_s = float(self.t_us[after] - self.t_us[after - 1]) * 1e-6

        def rate(column: NDArray[np.float64] | None) -> float:
            return 0.0 if column is None else float(column[after] - column[after - 1]) / dt_s

        return rate(self.pitch_deg), rate(self.roll_deg), rate(self.heading_deg)


def attitude_source(attitude: Attitude | AttitudeLog | None) -> Callable[[float], Attitude | None]:
    """A function that gives the attitude at a time, us; None where it is unknown."""
    return attitude.interpolate if isinstance(attitude, AttitudeLog) else lambda _t_us: attitude
