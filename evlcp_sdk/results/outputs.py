"""What the receiver leaves behind: `frames.csv`, `packets.jsonl`, `summary.json`, Parquet on request.

Rows are written as they come, in constant memory, to hidden files beside the final ones; `finish` moves them
into place together, the summary last. Until then, and after a crash, an earlier result stays as it was; a run
that is interrupted or meets unreadable input is finished too, and its summary says so in `status`.
"""

import csv
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, TextIO

from evlcp_sdk.air.frames import bits_of_symbols
from evlcp_sdk.errors import ConfigError, EvlcpError
from evlcp_sdk.files import hidden_path
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.values import Frame, Packet, ReceivedMessage

__all__ = [
    "FIGURE_NAMES",
    "FILTERED_COLUMNS",
    "FRAME_COLUMNS",
    "ResultWriter",
    "Status",
    "TransmitterTally",
    "filtered_row",
    "frame_row",
    "message_line",
]

FRAME_COLUMNS = (
    "transmitter",
    "packet",
    "frame",
    "t_us",
    "symbols",
    "quality",
    "distance_m",
    "distance_sigma_m",
    "x_px",
    "y_px",
)
"""Columns of `frames.csv` and `frames.parquet`."""

FILTERED_COLUMNS = ("distance_filtered_m", "distance_filtered_sigma_m")
"""Columns that follow where a tracking algorithm filters the distance."""

FIGURE_NAMES = ("regions.png", "presence.png", "distance.png")
"""Figures that a run may leave in its folder."""

Status = Literal["complete", "interrupted", "failed"]
"""How a run ended: read to the end, stopped by the user, or stopped by input that cannot be read."""

_POSITION_FILES = ("fixes.csv", "track.csv", "fixes.geojson", "fixes.nmea", "fixes.mcap", "track.png")
_FILES = ("frames.csv", "packets.jsonl", "frames.parquet", *_POSITION_FILES, "summary.json")
_CELL_M = 0.01
_FARTHEST_M = 10_000.0
_MOST_CLOCK_ERROR = 0.01


@dataclass
class TransmitterTally:
    """Running figures of one transmitter, in constant memory.

    Args:
        packet_frames: Frames that a packet has.
        nominal_packet_us: Length of a packet that the configuration states, us.
    """

    packet_frames: int
    nominal_packet_us: float
    packets: int = 0
    frames: int = 0
    first_frame: int = -1
    last_frame: int = -1
    last_packet: tuple[int, float] = (0, math.nan)
    steps_us: float = 0.0
    nominal_steps_us: float = 0.0
    quality_sum: float = 0.0
    ranged: int = 0
    first_m: float = math.nan
    last_m: float = math.nan
    cells: Counter[int] = field(default_factory=Counter)

    def add(self, packet: Packet) -> None:
        """Count a packet and its frames."""
        self.packets += 1
        self.frames += len(packet.frames)
        number, t_us = self.last_packet
        step_us, nominal_us = packet.t_us - t_us, (packet.packet - number) * self.nominal_packet_us
        if abs(step_us - nominal_us) < _MOST_CLOCK_ERROR * nominal_us:
            self.steps_us += step_us
            self.nominal_steps_us += nominal_us
        self.last_packet = (packet.packet, packet.t_us)
        for frame in packet.frames:
            number = frame.packet * self.packet_frames + frame.frame
            self.first_frame = number if self.first_frame < 0 else self.first_frame
            self.last_frame = number
            self.quality_sum += frame.soft.quality
            distance_m = frame.range.distance_m
            if math.isfinite(distance_m):
                self.ranged += 1
                self.last_m = distance_m
                if self.ranged == 1:
                    self.first_m = distance_m
                self.cells[round(min(distance_m, _FARTHEST_M) / _CELL_M)] += 1

    def median_m(self) -> float:
        """Median distance to the centimetre, m; NaN without any."""
        seen = 0
        for cell in sorted(self.cells):
            seen += self.cells[cell]
            if 2 * seen >= self.ranged:
                return round(cell * _CELL_M, 2)
        return math.nan

    def clock_ppm(self) -> float:
        """The transmitter's chip rate against the camera's clock, ppm; NaN before the second packet.

        Taken from the times of the packets, so it is the surer the longer the recording; a step from one
        packet to the next that no clock explains, as after a loss of lock, is left out.
        """
        return (self.nominal_steps_us / self.steps_us - 1) * 1e6 if self.steps_us else math.nan

    def to_dict(self) -> dict[str, Any]:
        """The figures as JSON values; what was never measured is null.

        `frames_expected` counts what was sent from the first decoded frame to the last.
        """
        return {
            "packets": self.packets,
            "frames_found": self.frames,
            "frames_expected": self.last_frame - self.first_frame + 1 if self.frames else 0,
            "quality": _number(self.quality_sum / self.frames if self.frames else math.nan, 4),
            "clock_ppm": _number(self.clock_ppm(), 2),
            "frames_ranged": self.ranged,
            "distance_first_m": _number(self.first_m, 4),
            "distance_last_m": _number(self.last_m, 4),
            "distance_median_m": _number(self.median_m(), 2),
        }


class ResultWriter:
    """Writes one recording's result into a folder; use as a context manager, end with `finish`.

    Args:
        folder: Made if need be; an earlier result in it is replaced by `finish`.
        link: The configuration that the receiver ran with.
        parquet: Also write `frames.parquet` (needs the extra `parquet`).

    Raises:
        ConfigError: The folder cannot be written, or the extra is not installed.
    """

    def __init__(self, folder: Path, link: Link, *, parquet: bool = False) -> None:
        self.folder = folder
        self.transmitters: dict[int, TransmitterTally] = {}
        self._link = link
        self._filtered = link.algorithm("tracking").compile().distance is not None
        self._parquet: _ParquetRows | None = None
        if parquet:
            _check_parquet()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._frames_file = self._open("frames.csv")
            self._packets_file = self._open("packets.jsonl")
            if parquet:
                self._parquet = _ParquetRows(self._hidden("frames.parquet"), self._filtered)
        except OSError as fault:
            raise ConfigError(f"{folder}: cannot be written: {fault.strerror}") from fault
        self._rows = csv.writer(self._frames_file, lineterminator="\n")
        self._rows.writerow(FRAME_COLUMNS + (FILTERED_COLUMNS if self._filtered else ()))

    def _hidden(self, name: str) -> Path:
        return hidden_path(self.folder, name)

    def _open(self, name: str) -> TextIO:
        return self._hidden(name).open("w", encoding="utf-8", newline="")

    def write(self, packets: Iterable[Packet]) -> None:
        """Append packets and their frames.

        Raises:
            EvlcpError: A file cannot be written, e.g. the disk is full.
        """
        try:
            for packet in packets:
                self._write(packet)
        except OSError as fault:
            raise EvlcpError(f"{self.folder}: cannot be written: {fault.strerror}") from fault

    def _write(self, packet: Packet) -> None:
        tally = self.transmitters.get(packet.transmitter)
        if tally is None:
            form = self._link.packet
            tally = TransmitterTally(packet.sent, form.packet_chips * form.chip_us)
            self.transmitters[packet.transmitter] = tally
        tally.add(packet)
        self._packets_file.write(json.dumps(self._packet_line(packet)) + "\n")
        for message in packet.messages:
            self._packets_file.write(json.dumps(message_line(message), ensure_ascii=False) + "\n")
        for frame in packet.frames:
            self._rows.writerow(frame_row(frame) + (filtered_row(frame) if self._filtered else []))
            if self._parquet is not None:
                self._parquet.add(frame)

    def _packet_line(self, packet: Packet) -> dict[str, Any]:
        book = self._link.codebook
        symbols: list[list[int] | None] = [None] * packet.sent
        bits = ["?" * (book.clusters * book.bits_per_symbol)] * packet.sent
        for frame in packet.frames:
            symbols[frame.frame] = frame.soft.symbols.tolist()
            frame_bits = bits_of_symbols(frame.soft.symbols[None], book.bits_per_symbol)
            bits[frame.frame] = (frame_bits + ord("0")).tobytes().decode("ascii")
        return {
            "kind": "packet",
            "transmitter": packet.transmitter,
            "packet": packet.packet,
            "t_us": round(packet.t_us, 2),
            "chip_us": round(packet.chip_us, 6),
            "frames_sent": packet.sent,
            "frames_received": len(packet.frames),
            "symbols": symbols,
            "bits": "".join(bits),
        }

    def finish(
        self,
        status: Status,
        recording: Mapping[str, Any],
        processing: Mapping[str, Any],
        counts: Mapping[str, int],
        losses: Mapping[str, Mapping[str, Any]],
        versions: Mapping[str, str],
        error: str | None = None,
        positions: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Write the summary, move all files into place, and drop what an earlier run left.

        Args:
            status: How the run ended.
            recording: What was read: path, format, size, duration, events.
            processing: How long it took.
            counts: The receiver's counts.
            losses: What the reader skipped, by kind, with byte offsets.
            versions: Installed versions.
            error: The message, when `status` is `failed`.
            positions: What `PositionWriter.finish` returned, where positions were computed.

        Returns:
            The content of `summary.json`.

        Raises:
            EvlcpError: A file cannot be written, e.g. the disk is full.
        """
        table = {
            "status": status,
            "error": error,
            "result": self.headline(),
            "transmitters": [
                {"transmitter": n} | tally.to_dict() for n, tally in sorted(self.transmitters.items())
            ],
            "recording": dict(recording),
            "processing": dict(processing),
            "counts": dict(counts),
            "messages_off": self._messages_off(),
            "losses": {kind: dict(loss) for kind, loss in losses.items()},
            "digest": self._link.digest,
            "codebook": {"digest": self._link.codebook.digest, "profile": self._link.codebook.profile},
            "revisions": dict(self._link.revisions),
            "configuration": {section: dict(keys) for section, keys in self._link.table.items()},
            "versions": dict(versions),
            **({"positions": dict(positions)} if positions is not None else {}),
        }
        try:
            self._hidden("summary.json").write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
            self._close()
            for name in FIGURE_NAMES:
                (self.folder / name).unlink(missing_ok=True)
            for name in _FILES:
                if self._hidden(name).exists():
                    self._hidden(name).replace(self.folder / name)
                else:
                    (self.folder / name).unlink(missing_ok=True)
        except OSError as fault:
            raise EvlcpError(f"{self.folder}: cannot be written: {fault.strerror}") from fault
        return table

    def _messages_off(self) -> str | None:
        """Why messages were not read; None where they were."""
        if not self._link.messages.decode:
            return "messages.decode = false"
        try:
            self._link.block_coder()
        except ConfigError as fault:
            return str(fault)
        return None

    def headline(self) -> str:
        """What was found, in one sentence."""
        if not self.transmitters:
            return "no transmitter was found"
        found = sum(tally.frames for tally in self.transmitters.values())
        number = len(self.transmitters)
        return f"{number} transmitter{'s' * (number > 1)}, {found} frame{'s' * (found != 1)}"

    def _close(self) -> None:
        self._frames_file.close()
        self._packets_file.close()
        if self._parquet is not None:
            self._parquet.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Drop what `finish` has not moved into place."""
        # A file that could not be written cannot be flushed either, and is dropped.
        with suppress(OSError):
            self._close()
        for name in _FILES:
            self._hidden(name).unlink(missing_ok=True)


def message_line(received: ReceivedMessage) -> dict[str, Any]:
    """A message's line of `packets.jsonl`, as JSON values."""
    message = received.message
    line: dict[str, Any] = {
        "kind": message.kind.name.lower(),
        "transmitter": received.transmitter,
        "packet": received.packet,
        "t_us": round(received.t_us, 2),
        "transmitter_id": message.transmitter_id,
        "sequence": message.sequence,
        "verified": received.trust == "verified",
        "trust": received.trust,
        "reason": received.reason,
    }
    if received.beacon is not None:
        return line | asdict(received.beacon) | {"user": received.beacon.user.hex()}
    if message.text is not None:
        return line | {"text": message.text}
    return line | {"data": message.payload.hex()}


def frame_row(frame: Frame) -> list[str]:
    """The frame's values of `FRAME_COLUMNS` as text; empty where there is none."""
    return [
        str(frame.transmitter),
        str(frame.packet),
        str(frame.frame),
        f"{frame.t_us:.2f}",
        " ".join(map(str, frame.soft.symbols.tolist())),
        f"{frame.soft.quality:.4f}",
        _text(frame.range.distance_m),
        _text(frame.range.sigma_m),
        f"{frame.x_px:.3f}",
        f"{frame.y_px:.3f}",
    ]


def filtered_row(frame: Frame) -> list[str]:
    """The frame's values of `FILTERED_COLUMNS` as text; empty where there is none."""
    if frame.filtered is None:
        return ["", ""]
    return [_text(frame.filtered.distance_m), _text(frame.filtered.sigma_m)]


def _text(value: float) -> str:
    return f"{value:.4f}" if math.isfinite(value) else ""


def _number(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


def _check_parquet() -> None:
    if find_spec("pyarrow") is None:
        raise ConfigError("Parquet needs the extra: pip install 'evlcp-sdk[parquet]', or leave --parquet out")


class _ParquetRows:
    """Rows of `frames.parquet`, one row group every `GROUP` frames."""

    GROUP = 4096

    def __init__(self, path: Path, filtered: bool) -> None:
        import pyarrow
        import pyarrow.parquet

        whole, real = pyarrow.int64(), pyarrow.float64()
        types = [whole, whole, whole, real, pyarrow.list_(whole), real, real, real, real, real]
        self._columns = FRAME_COLUMNS + (FILTERED_COLUMNS if filtered else ())
        types += [real] * (len(self._columns) - len(types))
        self._schema = pyarrow.schema(list(zip(self._columns, types, strict=True)))
        self._arrow = pyarrow
        self._writer = pyarrow.parquet.ParquetWriter(path, self._schema)
        self._waiting: list[dict[str, Any]] = []

    def add(self, frame: Frame) -> None:
        distances = (
            [frame.range, frame.filtered] if len(self._columns) > len(FRAME_COLUMNS) else [frame.range]
        )
        found = [(None, None) if r is None else (r.distance_m, r.sigma_m) for r in distances]
        numbers = [[None if v is None else _number(v, 15) for v in pair] for pair in found]
        values = (
            frame.transmitter,
            frame.packet,
            frame.frame,
            frame.t_us,
            frame.soft.symbols.tolist(),
            frame.soft.quality,
            *numbers[0],
            frame.x_px,
            frame.y_px,
            *(numbers[1] if len(numbers) > 1 else ()),
        )
        self._waiting.append(dict(zip(self._columns, values, strict=True)))
        if len(self._waiting) == self.GROUP:
            self._flush()

    def _flush(self) -> None:
        self._writer.write_table(self._arrow.Table.from_pylist(self._waiting, schema=self._schema))
        self._waiting = []

    def close(self) -> None:
        if self._writer.is_open:
            if self._waiting:
                self._flush()
            self._writer.close()
