"""The camera's attitude over time, from a file such as an IMU's log."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.geometry import Attitude

__all__ = ["AttitudeTrack"]

_NEEDED = ("t_us", "pitch_deg", "roll_deg")
_OPTIONAL = ("heading_deg", "gravity_sigma_deg", "heading_sigma_deg")


@dataclass(frozen=True, eq=False)
class AttitudeTrack:
    """Attitudes at rising times, straight between them, nothing before and after.

    Attributes:
        t_us: Camera clock, us, float64 (n,), rising.
        pitch_deg: float64 (n,).
        roll_deg: float64 (n,).
        heading_deg: float64 (n,); None where the heading is not known.
        gravity_sigma_deg: float64 (n,).
        heading_sigma_deg: float64 (n,).
    """

    t_us: NDArray[np.float64]
    pitch_deg: NDArray[np.float64]
    roll_deg: NDArray[np.float64]
    heading_deg: NDArray[np.float64] | None
    gravity_sigma_deg: NDArray[np.float64]
    heading_sigma_deg: NDArray[np.float64]

    @classmethod
    def read(cls, path: Path | str, usual: Attitude | None = None) -> "AttitudeTrack":
        """Read a CSV of t_us, pitch_deg, roll_deg and, optionally, heading_deg and both sigmas.

        Args:
            path: The file.
            usual: Its sigmas count where the file has none; None for the defaults.

        Raises:
            InputError: The file cannot be read.
            ConfigError: A column is missing, a value is no number, or times do not rise.
        """
        usual = Attitude() if usual is None else usual
        try:
            # Spreadsheets begin a file with a byte order mark.
            with Path(path).open(newline="", encoding="utf-8-sig") as file:
                reader = csv.DictReader(file)
                names = tuple(reader.fieldnames or ())
                # Empty lines give no row.
                lines, rows = [], []
                for row in reader:
                    lines.append(reader.line_num)
                    rows.append(row)
        except OSError as fault:
            raise InputError(f"{path}: cannot be read: {fault.strerror}") from fault
        except (UnicodeDecodeError, csv.Error) as fault:
            raise InputError(f"{path}: not a CSV file: {fault}") from fault
        missing = [name for name in _NEEDED if name not in names]
        if missing:
            known = ", ".join(_NEEDED + _OPTIONAL)
            raise ConfigError(f"{path}: line 1: no column {missing[0]} (columns: {known})")
        table: dict[str, NDArray[np.float64]] = {}
        for name in _NEEDED + _OPTIONAL:
            if name in names:
                table[name] = np.array(
                    [_number(path, line, name, row[name]) for line, row in zip(lines, rows, strict=True)]
                )
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
        )


def _number(path: Path | str, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text if text is not None else "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{path}: line {line}: {name} = {text!r}: expected a number")
    return value
