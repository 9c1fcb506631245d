"""Decoded frames for scoring: from a receiver's packets, or read from `frames.csv`."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from evlcp_sdk.errors import ConfigError, InputError, name_place
from evlcp_sdk.files import parse_csv_number, read_csv
from evlcp_sdk.results.folder import check_result_file, read_summary
from evlcp_sdk.values import Packet


@dataclass(frozen=True)
class FrameRow:
    """One decoded frame, as `Frame` has it.

    Attributes:
        symbols: Symbol of each cluster, cluster 0 first; -1 for one that is not given.
        distance_m: Distance along the optical axis, m; NaN for none, as its sigma and the filtered one.
    """

    transmitter: int
    t_us: float
    symbols: tuple[int, ...]
    distance_m: float
    sigma_m: float
    filtered_m: float
    x_px: float
    y_px: float
    echo_of: int | None = None
    link: str = ""


def frames_of(packets: Iterable[Packet]) -> list[FrameRow]:
    """Rows of the packets' frames, in order."""
    return [
        FrameRow(
            transmitter=frame.transmitter,
            t_us=frame.t_us,
            symbols=tuple(frame.soft.symbols.tolist()),
            distance_m=frame.range.distance_m,
            sigma_m=frame.range.sigma_m,
            filtered_m=math.nan if frame.filtered is None else frame.filtered.distance_m,
            x_px=frame.x_px,
            y_px=frame.y_px,
            echo_of=frame.echo_of,
            link=frame.link,
        )
        for packet in packets
        for frame in packet.frames
    ]


FRAMES = "frames.csv"

_NEEDED = ("transmitter", "t_us", "symbols", "distance_m", "x_px", "y_px")


def read_frames(folder: Path | str) -> list[FrameRow]:
    """Read the rows of a result's `frames.csv`.

    Needed are the columns transmitter, t_us, symbols, distance_m, x_px and y_px; distance_sigma_m,
    distance_filtered_m, echo_of and link are optional.

    Raises:
        InputError: It is missing, it is not the file of the `summary.json` beside it, a column is missing, or
            a value is not a number; with file and line.
    """
    path = Path(folder) / FRAMES
    summary = read_summary(folder)
    if summary is not None:
        check_result_file(folder, FRAMES, summary)
    names, rows = read_csv(path)
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise InputError(f"{path}: without the columns {', '.join(missing)}")
    with name_place("", InputError):
        return [_parse_row(path, line, row) for line, row in rows]


def _parse_row(path: Path, line: int, row: Mapping[str, str | None]) -> FrameRow:
    def number(name: str, *, optional: bool = False) -> float:
        text = row.get(name)
        return math.nan if optional and not text else parse_csv_number(path, line, name, text)

    def integer(name: str, text: str | None) -> int:
        try:
            return int(text or "")
        except ValueError:
            place = f"{path}: line {line}: {name} = {text!r:.40}"
            raise ConfigError(f"{place}: expected a whole number") from None

    echo = row.get("echo_of")
    return FrameRow(
        transmitter=integer("transmitter", row["transmitter"]),
        t_us=number("t_us"),
        symbols=tuple(-1 if s == "-" else integer("symbols", s) for s in (row["symbols"] or "").split()),
        distance_m=number("distance_m", optional=True),
        sigma_m=number("distance_sigma_m", optional=True),
        filtered_m=number("distance_filtered_m", optional=True),
        x_px=number("x_px"),
        y_px=number("y_px"),
        echo_of=integer("echo_of", echo) if echo else None,
        link=row.get("link") or "",
    )
