"""ROS bags with `event_camera_msgs/EventPacket`, EVT3 inside: ROS 1, and ROS 2 in SQLite or MCAP."""

import math
import re
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final

from evlcp_sdk.errors import InputError, import_extra, short_message
from evlcp_sdk.io.evt import EVT3
from evlcp_sdk.io.raw import ChunkReader, RawSource, format_header
from evlcp_sdk.io.urls import split_options
from evlcp_sdk.plugin.source import Loss
from evlcp_sdk.values import remember_newest

TYPES: Final = ("event_camera_msgs/msg/EventPacket", "event_camera_msgs/EventPacket")

_MAX_WAITING: Final = 256
"""Packets that may wait for earlier ones: some seconds of a camera, 30 MB."""

_STEPS: Final = 1_000_000
_STEPS_A_BYTE: Final = 4
_STEPS_AT_ONCE: Final = 10_000
"""Steps that SQLite may take, in all, per byte and between checks; a row of a message takes twenty."""


@dataclass(frozen=True)
class EventPacket:
    """A message with events.

    Attributes:
        width: Columns of the sensor.
        height: Rows of the sensor.
        seq: Number of the packet, by which lost ones are found.
        encoding: Encoding of the words, `evt3`.
        data: The words.
    """

    width: int
    height: int
    seq: int
    encoding: str
    data: memoryview


def open_bag(url: str) -> "BagSource":
    """Open `bag:PATH`, or `bag:PATH?topic=NAME`: a file of any kind, or a folder of ROS 2.

    Raises:
        InputError: It is not a bag, has no such topic, or other words than EVT3; or the extra `ros` is
            needed.
    """
    named, options = split_options(url, {"topic": str}) if url.startswith("bag:") else (url, {})
    return BagSource(named.removeprefix("bag:"), options.get("topic"))


class BagSource(RawSource):
    """Reads the events of a bag's topic (None: the only one), its packets as one stream of words.

    Packets that are out of order by up to a few hundred are sorted by their numbers; repeated ones are left
    out and counted (`packets_twice`), and missing ones are the loss `packets_lost`.
    """

    def __init__(self, path: Path | str, topic: str | None = None) -> None:
        target = Path(path)
        self._stack = ExitStack()
        try:
            self._packets = _PacketReader(target, _read_bag(target, topic, self._stack))
            super().__init__(target, file=self._packets)
        except BaseException:
            self._stack.close()
            raise
        self.format = "BAG"
        self.size_bytes = sum(file.stat().st_size for file in _list_files(target))

    @property
    def losses(self) -> dict[str, Loss]:
        """As `EventSource.losses`, with missing packets."""
        lost, first = self._packets.lost, self._packets.first_lost
        if not lost:
            return super().losses
        return super().losses | {"packets_lost": Loss(lost, first, "byte", "packets missing in the bag")}

    @property
    def counts(self) -> dict[str, int]:
        """As `EventSource.counts`, with packets that are repeated, or out of order."""
        packets = self._packets
        found = {"packets_twice": packets.twice, "packets_out_of_order": packets.out_of_order}
        return super().counts | {name: count for name, count in found.items() if count}

    def close(self) -> None:
        """Close the bag."""
        super().close()
        self._stack.close()


class _PacketReader(ChunkReader):
    """The words of a bag's packets by their numbers, each once, behind a header of their sensor.

    A number far below starts anew, as a driver does.

    Attributes:
        twice: Number of repeated packets, which are left out.
        out_of_order: Number of packets after a later one.
        lost: Number of missing packets.
        first_lost: Byte at which the first is missing.
    """

    def __init__(self, path: Path, packets: Iterator[EventPacket]) -> None:
        self._path = path
        self._waiting: dict[int, EventPacket] = {}
        self._past: dict[int, int] = {}
        self._next_seq: int | None = None
        self.twice = self.out_of_order = self.lost = self.first_lost = 0
        ordered = self._sort(packets)
        first = next(ordered, None)
        if first is None:
            raise InputError(f"{path}: no packets on its topic")
        self._packets: Iterator[EventPacket] = chain([first], ordered)
        self._check_encoding(first)
        super().__init__(format_header(EVT3, first.width, first.height))

    def _sort(self, packets: Iterator[EventPacket]) -> Iterator[EventPacket]:
        latest = -1
        for packet in packets:
            digest, same = zlib.crc32(packet.data), self._waiting.get(packet.seq)
            if self._past.get(packet.seq) == digest or (same is not None and same.data == packet.data):
                self.twice += 1
                continue
            self.out_of_order += packet.seq < latest <= packet.seq + _MAX_WAITING
            latest = packet.seq
            while packet.seq in self._waiting or len(self._waiting) >= _MAX_WAITING:
                yield self._pop()
            self._waiting[packet.seq] = packet
        while self._waiting:
            yield self._pop()

    def _pop(self) -> EventPacket:
        """Take out the packet that follows the last one, or else the first."""
        last = next(reversed(self._past), math.inf)
        near = [seq for seq in self._waiting if last < seq <= last + 1 + _MAX_WAITING]
        packet = self._waiting.pop(min(near or self._waiting))
        remember_newest(self._past, packet.seq, zlib.crc32(packet.data), _MAX_WAITING)
        return packet

    def read_chunk(self) -> memoryview:
        """Return the words of the next packet; none at the end."""
        for packet in self._packets:
            self._check_encoding(packet)
            if self._next_seq is not None and packet.seq > self._next_seq:
                if not self.lost:
                    self.first_lost = self.bytes_read
                self.lost += packet.seq - self._next_seq
            self._next_seq = packet.seq + 1
            if len(packet.data):
                return packet.data
        return memoryview(b"")

    def _check_encoding(self, packet: EventPacket) -> None:
        if packet.encoding != "evt3":
            raise InputError(
                f"{self._path}: packets of encoding {packet.encoding!r}, expected 'evt3', as"
                " metavision_driver records"
            )

    def close(self) -> None:
        """Stop reading."""
        self._packets, self._ready = iter(()), memoryview(b"")


def _list_files(path: Path) -> list[Path]:
    """List the files of a bag: itself, or those of its folder by metadata.yaml or by their numbers."""
    if not path.is_dir():
        return [path]
    try:
        text = (path / "metadata.yaml").read_text("utf-8", "replace")
    except OSError:
        text = ""
    listed = re.search(r"relative_file_paths:[ ]*\n((?:[ ]*-.*\n?)+)", text)
    if listed is not None:
        names = [line.strip()[1:].strip(" \"'") for line in listed[1].splitlines()]
        missing = next((name for name in names if not (path / name).is_file()), None)
        if missing is not None:
            raise InputError(f"{path}: metadata.yaml names {missing}, which is not there")
        return [path / name for name in names]
    found = (one for one in path.iterdir() if one.suffix in (".db3", ".mcap"))
    return sorted(
        found,
        key=lambda one: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", one.name)],
    )


def _read_bag(path: Path, topic: str | None, stack: ExitStack) -> Iterator[EventPacket]:
    at = path
    try:
        if not path.exists():
            raise InputError(f"{path}: No such file or directory")
        files = _list_files(path)
        if not files:
            raise InputError(f"{path}: a folder without .db3 or .mcap files, expected a bag")
        readers = [(file, _choose_reader(file)) for file in files]
        for at, reader in readers:
            yield from reader(at, topic, stack)
    except InputError:
        raise
    except Exception as fault:
        # A damaged bag makes a reader fail in any way.
        raise InputError(f"{at}: found a damaged bag ({short_message(fault)})") from fault


def _choose_reader(path: Path) -> Callable[[Path, str | None, ExitStack], Iterator[EventPacket]]:
    with path.open("rb") as file:
        start = file.read(16)
    for magic, reader in _READERS.items():
        if start.startswith(magic):
            return reader
    raise InputError(f"{path}: starts with {start[:8].hex(' ')}, expected a bag of ROS 1, SQLite or MCAP")


def _choose_topic(path: Path, topics: dict[str, str], topic: str | None) -> str:
    fitting = [name for name, kind in topics.items() if kind in TYPES]
    names = ", ".join(f"{name} ({kind})" for name, kind in sorted(topics.items())) or "none"
    if topic is not None:
        if topic not in fitting:
            raise InputError(f"{path}: topic {topic!r}, expected one of type EventPacket (topics: {names})")
        return topic
    if len(fitting) != 1:
        what = "no topic" if not fitting else f"{len(fitting)} topics"
        hint = "" if not fitting else "; choose one by ?topic=NAME"
        raise InputError(f"{path}: {what} of type event_camera_msgs/EventPacket (topics: {names}){hint}")
    return fitting[0]


def _read_sqlite(path: Path, topic: str | None, stack: ExitStack) -> Iterator[EventPacket]:
    # A live run opens in one thread and reads in another.
    base = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, check_same_thread=False)
    stack.enter_context(closing(base))
    _limit_sqlite(base, path)
    rows = base.execute("SELECT name, id, type FROM topics").fetchall()
    number = {name: number for name, number, _ in rows}
    chosen = _choose_topic(path, {name: kind for name, _, kind in rows}, topic)
    found = base.execute("SELECT data FROM messages WHERE topic_id = ? ORDER BY rowid", (number[chosen],))
    for (data,) in found:
        if not isinstance(data, bytes):
            raise InputError(f"{path}: a message of type {type(data).__name__}, expected bytes")
        yield _parse_cdr(path, data)


def _limit_sqlite(base: sqlite3.Connection, path: Path) -> None:
    """Limit the room and time of a database by its size, and check that it has the tables of a bag.

    Raises:
        InputError: It has something else by these names.
    """
    size = path.stat().st_size
    base.text_factory = lambda text: text.decode("utf-8", "replace")
    base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, 1 << 16))
    remaining = [_STEPS + size * _STEPS_A_BYTE]

    def count_down() -> bool:
        remaining[0] -= _STEPS_AT_ONCE
        return remaining[0] < 0

    base.set_progress_handler(count_down, _STEPS_AT_ONCE)
    base.execute("PRAGMA trusted_schema = OFF")
    found = dict(base.execute("SELECT name, type || coalesce(sql, '') FROM sqlite_master"))
    for name in ("topics", "messages"):
        definition = " ".join(str(found.get(name, "nothing")).upper().split())
        if not definition.startswith("TABLECREATE TABLE"):
            raise InputError(f"{path}: found no table '{name}', expected a bag of ROS 2")


def _read_mcap(path: Path, topic: str | None, stack: ExitStack) -> Iterator[EventPacket]:
    mcap = import_extra("mcap.reader", "ros", str(path), InputError)
    reader = mcap.make_reader(stack.enter_context(path.open("rb")))
    summary = reader.get_summary()
    schemas = summary.schemas if summary is not None else {}
    channels = summary.channels.values() if summary is not None else ()
    topics = {one.topic: schemas[one.schema_id].name for one in channels if one.schema_id in schemas}
    for _, _, message in reader.iter_messages([_choose_topic(path, topics, topic)], log_time_order=False):
        yield _parse_cdr(path, message.data)


def _read_ros1(path: Path, topic: str | None, stack: ExitStack) -> Iterator[EventPacket]:
    rosbag1 = import_extra("rosbags.rosbag1", "ros", str(path), InputError)
    reader = stack.enter_context(rosbag1.Reader(path))
    chosen = _choose_topic(path, {one.topic: one.msgtype for one in reader.connections}, topic)
    for _, _, data in reader.messages([one for one in reader.connections if one.topic == chosen]):
        # Fields without padding, and a header with a number of its own.
        yield _parse_packet(path, data, "<", "IIIsIIQQsBs", aligned=False)


_READERS: Final = {
    b"#ROSBAG V2.0": _read_ros1,
    b"SQLite format 3": _read_sqlite,
    b"\x89MCAP0\r\n": _read_mcap,
}


def _parse_cdr(path: Path, data: bytes) -> EventPacket:
    """Parse a message of ROS 2: aligned fields after four bytes with the byte order."""
    return _parse_packet(path, data[4:], "<" if data[1:2] == b"\x01" else ">", "iIsIIQQsBs", aligned=True)


def _parse_packet(path: Path, data: bytes, order: str, codes: str, *, aligned: bool) -> EventPacket:
    """Parse the fields of a packet by their codes of `struct`; `s` is a number of bytes, and these."""
    fields: list[Any] = []
    at = 0
    try:
        for code in codes:
            kind = struct.Struct(order + code.replace("s", "I"))
            at += -at % kind.size if aligned else 0
            value: Any = kind.unpack_from(data, at)[0]
            at += kind.size
            if code == "s":
                value, at = memoryview(data)[at : at + value], at + value
            fields.append(value)
    except struct.error:
        at = len(data) + 1
    if at > len(data):
        raise InputError(f"{path}: a message of {len(data)} bytes, expected more: it is cut")
    height, width, seq, _, encoding, _, words = fields[-7:]
    return EventPacket(width, height, seq, bytes(encoding).rstrip(b"\0").decode("utf-8", "replace"), words)
