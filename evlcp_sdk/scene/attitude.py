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

_MOST_MEASURED = 1e5
"""Rate, degrees/s, or force, m/s2, of more than any sensor's."""

_NEEDED = {"t_us": ANY_NUMBER, "pitch_deg": (-90.0, 90.0), "roll_deg": ANY_NUMBER}
_OPTIONAL = {
    "heading_deg": ANY_NUMBER,
    **dict.fromkeys(("gravity_sigma_deg", "heading_sigma_deg"), (0.0, math.inf)),
    **dict.fromkeys(_RATES + _FORCES, (-_MOST_MEASURED, _MOST_MEASURED)),
}
"""Columns, and between what their values are."""

_GAP = 10.0
"""How many times as long as usual (the median) two lines lie apart where lines between them are lost: clocks
and buffers that jitter make it two or three."""

_PIECES = 32
"""Of a log, whose turns by headings and by rates are compared: of so many that have nothing to do with one
another, less than 1 in 100 000 agree by half (r2)."""

_DRIFT_DEG_S = 5.0
"""Rate that no gyroscope which is of use for a track has at rest."""

_MOST_KNOTS = 4096
"""Lines of a log that one step of a track goes by; of more, every second, third ... counts."""


@dataclass(frozen=True)
class Attitude:
    """How the camera is turned, and how certain that is: a compass and gravity.

    From looking level to the north it is first turned to the right, then up, then rolled.

    Attributes:
        pitch_deg: How far the optical axis points above the horizon.
        roll_deg: How far the camera's top leans to its right.
        heading_deg: Where the optical axis points to, clockwise from north; None when unknown.
        gravity_sigma_deg: Standard deviation of what stays wrong with pitch and roll each; 0: exact.
        heading_sigma_deg: The same of the heading; 0: exact.
        white_sigma_deg: Of what is new with every time, of each angle.
        time_sigma_us: Of the offset of its clock from the camera's, us.
        rate_deg_s: How fast pitch, roll and heading change, degrees / s: what an offset in time moves them
            by.

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

    def standing(self) -> NDArray[np.float64]:
        """What stays wrong with pitch, roll and heading, radians: float64 (3, 4), one column a cause.

        The causes are the bias of each, and the offset in time; all in their own sigmas.
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
    """Turn and push of a camera at times between two, straight lines between these.

    Attributes:
        t_s: Since the first time, s, rising from 0 to the last, float64 (k,), k >= 2.
        turn_rad: By how much the heading has changed since the first time, clockwise, radians, float64 (k,).
        gyro: The turn is that of a gyroscope, which has a bias and a noise that grows.
        push_m_s2: Acceleration without gravity, to the camera's right, forward, both level, and up, m/s2,
            float64 (k, 3); None without an accelerometer.
    """

    t_s: NDArray[np.float64]
    turn_rad: NDArray[np.float64]
    gyro: bool = False
    push_m_s2: NDArray[np.float64] | None = None

    @classmethod
    def even(cls, dt_s: float, turn_rad: float) -> "ImuMotion":
        """A turn at one rate."""
        return cls(np.array([0.0, dt_s]), np.array([0.0, turn_rad]))


@dataclass(frozen=True, eq=False)
class AttitudeLog:
    """Attitudes at rising times, straight between them, nothing before, after, and where lines are lost.

    Lines are lost where two lie ten times as far apart as they do usually (the median).

    Attributes:
        t_us: Camera clock, us, float64 (n,), rising.
        pitch_deg: float64 (n,).
        roll_deg: float64 (n,).
        heading_deg: float64 (n,); None where the heading is not known.
        gravity_sigma_deg: float64 (n,).
        heading_sigma_deg: float64 (n,).
        white_sigma_deg: As an `Attitude` has it.
        time_sigma_us: The same.
        rates_deg_s: What a gyroscope measures about the camera's axes right, down and forward, float64
            (n, 3); None where there is none. A turn to the right is positive about down.
        forces_m_s2: What an accelerometer measures along the same axes, float64 (n, 3): at rest and level
            -9.8 down; None where there is none.
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
    def read(cls, path: Path | str, usual: Attitude | None = None) -> "AttitudeLog":
        """Read a CSV of t_us, pitch_deg, roll_deg; optionally heading_deg, both sigmas, rates and forces.

        Args:
            path: The file.
            usual: Its sigmas count where the file has none; None for the defaults.

        Raises:
            InputError: The file cannot be read.
            ConfigError: A column is missing, a value is not a number, or times do not rise; of rates or
                forces one axis is there and another is not, or there are forces and no rates, or they are
                half as much from gravity as gravity is, or more, or rates turn the other way than headings
                do, or by another measure.
        """
        usual = Attitude() if usual is None else usual
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
            table.get("gravity_sigma_deg", np.full(len(t_us), usual.gravity_sigma_deg)),
            table.get("heading_sigma_deg", np.full(len(t_us), usual.heading_sigma_deg)),
            usual.white_sigma_deg,
            usual.time_sigma_us,
            *(np.stack([table[n] for n in a], 1) if a[0] in table else None for a in (_RATES, _FORCES)),
        )
        log._check_senses(path)
        return log

    def _check_senses(self, path: Path | str) -> None:
        """Refuse forces and rates that are of other signs or measures than they should be."""
        if self._push_m_s2 is not None:
            upward = float(self._push_m_s2[:, 2].mean()) + _GRAVITY_M_S2
            if not 0.5 * _GRAVITY_M_S2 < upward < 1.5 * _GRAVITY_M_S2:
                raise ConfigError(
                    f"{path}: forces hold the camera up by {upward:.1f} m/s2 on the mean, expected about 9.8:"
                    " a level camera at rest has force_down_m_s2 = -9.8"
                )
        times = self._times_turned()
        if times is not None and not 0.5 < times < 1.5:
            raise ConfigError(
                f"{path}: rates turn the camera {times:.3g} times as far as its headings do, expected 1:"
                " a turn to the right is positive about down, in degrees/s"
            )

    def _times_turned(self) -> float | None:
        """How many times as far as by headings the camera turns by rates; None where nothing says so.

        Noise of headings makes it less than 1, but not less than by what share both agree (r2).
        """
        turned = self._turned_rad
        if self.heading_deg is None or self.rates_deg_s is None or turned is None:
            return None
        ends = np.linspace(self.t_us[0], self.t_us[-1], _PIECES + 1)
        took_s = (ends[1] - ends[0]) * 1e-6
        logged = np.diff(np.interp(ends, self.t_us, self.heading_deg)) / took_s
        measured = np.degrees(np.diff(np.interp(ends, self.t_us, turned))) / took_s
        both, own = float(logged @ measured), float(logged @ logged)
        if np.sqrt(((measured - logged) ** 2).mean()) < _DRIFT_DEG_S:
            return None
        return both / own if both**2 > 0.5 * own * float(measured @ measured) else None

    def to_csv(self) -> str:
        """The text of a file that `read` takes."""
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

    def at(self, t_us: float) -> Attitude | None:
        """The attitude at a time; None outside of the track, and where lines are lost."""
        if not self.t_us[0] <= t_us <= self.t_us[-1]:
            return None
        before, after = (int(np.searchsorted(self.t_us, t_us, side)) for side in ("left", "right"))
        if before == after and self._is_lost(before - 1, after):
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

    def between(self, start_us: float, end_us: float) -> ImuMotion | None:
        """How the camera turned, and was pushed, from one time to a later one; None where that is not known.

        By the rates where there are any, else by the headings.
        """
        turned = self._turned_rad
        if turned is None or not self.t_us[0] <= start_us < end_us <= self.t_us[-1]:
            return None
        first, last = np.searchsorted(self.t_us, (start_us, end_us), "right").tolist()
        if self._is_lost(first - 1, int(np.searchsorted(self.t_us, end_us))):
            return None
        inner = self.t_us[first:last]
        inner = inner[inner < end_us][:: 1 + len(inner) // _MOST_KNOTS]
        t_us = np.concatenate([[start_us], inner, [end_us]])
        angle = np.interp(t_us, self.t_us, turned)
        push = self._push_m_s2
        if push is not None:
            push = np.stack([np.interp(t_us, self.t_us, column) for column in push.T], 1)
        return ImuMotion((t_us - start_us) * 1e-6, angle - angle[0], self.rates_deg_s is not None, push)

    def _is_lost(self, first: int, last: int) -> bool:
        """Whether lines are lost anywhere from one line to another."""
        return bool((np.diff(self.t_us[first : last + 1]) > self._longest_us).any())

    @cached_property
    def _longest_us(self) -> float:
        return _GAP * float(np.median(np.diff(self.t_us)))

    @cached_property
    def _turned_rad(self) -> NDArray[np.float64] | None:
        """The heading's change since the first line."""
        if self.rates_deg_s is None:
            return None if self.heading_deg is None else np.radians(self.heading_deg - self.heading_deg[0])
        rate = -(self.rates_deg_s * self._up()).sum(1)
        steps = np.diff(self.t_us) * (rate[1:] + rate[:-1]) / 2
        return np.radians(np.concatenate([[0.0], np.cumsum(steps)]) * 1e-6)

    @cached_property
    def _push_m_s2(self) -> NDArray[np.float64] | None:
        """Acceleration without gravity to the right, forward and up, level."""
        if self.forces_m_s2 is None:
            return None
        right, down, forward = self.forces_m_s2.T
        pitch, roll = np.radians(self.pitch_deg), np.radians(self.roll_deg)
        below = right * np.sin(roll) + down * np.cos(roll)
        return np.stack(
            [
                right * np.cos(roll) - down * np.sin(roll),
                below * np.sin(pitch) + forward * np.cos(pitch),
                (self.forces_m_s2 * self._up()).sum(1) - _GRAVITY_M_S2,
            ],
            1,
        )

    def _up(self) -> NDArray[np.float64]:
        """Up in the camera's axes, float64 (n, 3)."""
        pitch, roll = np.radians(self.pitch_deg), np.radians(self.roll_deg)
        level = -np.cos(pitch)
        return np.stack([level * np.sin(roll), level * np.cos(roll), np.sin(pitch)], 1)

    def _rate_deg_s(self, t_us: float) -> tuple[float, float, float]:
        """How fast the angles change between the lines about a time."""
        after = min(max(int(np.searchsorted(self.t_us, t_us, "right")), 1), len(self.t_us) - 1)
        dt_s = float(self.t_us[after] - self.t_us[after - 1]) * 1e-6

        def rate(column: NDArray[np.float64] | None) -> float:
            return 0.0 if column is None else float(column[after] - column[after - 1]) / dt_s

        return rate(self.pitch_deg), rate(self.roll_deg), rate(self.heading_deg)


def attitude_source(attitude: Attitude | AttitudeLog | None) -> Callable[[float], Attitude | None]:
    """The attitude at a time, us; None where nothing is known."""
    return attitude.at if isinstance(attitude, AttitudeLog) else lambda _t_us: attitude
