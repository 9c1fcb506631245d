"""The camera's attitude: at one time, and over time from a file such as an IMU's log."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import read_csv

__all__ = ["Attitude", "AttitudeLog", "attitude_source"]

_MOST = 1e18
"""Size of the largest number of a log: microseconds since 1970 are 1e15."""

_NEEDED = ("t_us", "pitch_deg", "roll_deg")
_OPTIONAL = ("heading_deg", "gravity_sigma_deg", "heading_sigma_deg")


@dataclass(frozen=True)
class Attitude:
    """How the camera is turned, and how surely that is known: a compass and gravity.

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
        causes = np.zeros((3, 4))
        bias = (self.gravity_sigma_deg, self.gravity_sigma_deg, self.heading_sigma_deg)
        causes[:, :3] = np.diag(np.radians(bias))
        causes[:, 3] = np.radians(self.rate_deg_s) * self.time_sigma_us * 1e-6
        return causes

    def rotation(self) -> NDArray[np.float64]:
        """Camera axes (x right, y down, z forward) as columns in ENU, float64 (3, 3); north if unknown."""
        h, p, r = (math.radians(v) for v in (self.heading_deg or 0.0, self.pitch_deg, self.roll_deg))
        (sh, ch), (sp, cp), (sr, cr) = ((math.sin(v), math.cos(v)) for v in (h, p, r))
        level, down, forward = (ch, -sh, 0.0), (sp * sh, sp * ch, -cp), (cp * sh, cp * ch, sp)
        return np.array(
            [[a * cr + b * sr, b * cr - a * sr, c] for a, b, c in zip(level, down, forward, strict=True)]
        )

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
class AttitudeLog:
    """Attitudes at rising times, straight between them, nothing before and after.

    Attributes:
        t_us: Camera clock, us, float64 (n,), rising.
        pitch_deg: float64 (n,).
        roll_deg: float64 (n,).
        heading_deg: float64 (n,); None where the heading is not known.
        gravity_sigma_deg: float64 (n,).
        heading_sigma_deg: float64 (n,).
        white_sigma_deg: As an `Attitude` has it.
        time_sigma_us: The same.
    """

    t_us: NDArray[np.float64]
    pitch_deg: NDArray[np.float64]
    roll_deg: NDArray[np.float64]
    heading_deg: NDArray[np.float64] | None
    gravity_sigma_deg: NDArray[np.float64]
    heading_sigma_deg: NDArray[np.float64]
    white_sigma_deg: float = 0.0
    time_sigma_us: float = 0.0

    @classmethod
    def read(cls, path: Path | str, usual: Attitude | None = None) -> "AttitudeLog":
        """Read a CSV of t_us, pitch_deg, roll_deg and, optionally, heading_deg and both sigmas.

        Args:
            path: The file.
            usual: Its sigmas count where the file has none; None for the defaults.

        Raises:
            InputError: The file cannot be read.
            ConfigError: A column is missing, a value is not a number, or times do not rise.
        """
        usual = Attitude() if usual is None else usual
        names, rows = read_csv(path)
        lines = [line for line, _ in rows]
        missing = [name for name in _NEEDED if name not in names]
        if missing:
            known = ", ".join(_NEEDED + _OPTIONAL)
            raise ConfigError(f"{path}: line 1: no column {missing[0]} (columns: {known})")
        table: dict[str, NDArray[np.float64]] = {}
        for name in _NEEDED + _OPTIONAL:
            if name in names:
                table[name] = np.array([_number(path, line, name, row[name]) for line, row in rows])
        t_us = table["t_us"]
        if len(t_us) < 2:
            raise ConfigError(f"{path}: expected two lines or more with rising t_us")
        if (np.diff(t_us) <= 0).any():
            i = int(np.argmax(np.diff(t_us) <= 0)) + 1
            raise ConfigError(
                f"{path}: line {lines[i]}: t_us = {t_us[i]:.16g}: expected more than the line before,"
                f" {t_us[i - 1]:.16g}: rising t_us"
            )
        for name in ("gravity_sigma_deg", "heading_sigma_deg"):
            if name in table and (table[name] < 0).any():
                i = int(np.flatnonzero(table[name] < 0)[0])
                raise ConfigError(f"{path}: line {lines[i]}: {name} = {table[name][i]:g}: expected 0 or more")
        return cls(
            t_us,
            table["pitch_deg"],
            np.degrees(np.unwrap(np.radians(table["roll_deg"]))),
            np.degrees(np.unwrap(np.radians(table["heading_deg"]))) if "heading_deg" in table else None,
            table.get("gravity_sigma_deg", np.full(len(t_us), usual.gravity_sigma_deg)),
            table.get("heading_sigma_deg", np.full(len(t_us), usual.heading_sigma_deg)),
            usual.white_sigma_deg,
            usual.time_sigma_us,
        )

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
        lines = [",".join(columns), *(",".join(row) for row in zip(*columns.values(), strict=True))]
        return "\n".join(lines) + "\n"

    def at(self, t_us: float) -> Attitude | None:
        """The attitude at a time; None outside of the track."""
        if not self.t_us[0] <= t_us <= self.t_us[-1]:
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


def _number(path: Path | str, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text if text is not None else "")
    except ValueError:
        value = math.nan
    if not abs(value) <= _MOST:
        wanted = "a number" if not math.isfinite(value) else f"at most {_MOST:g}"
        raise ConfigError(f"{path}: line {line}: {name} = {text!r:.40}: expected {wanted}")
    return value
