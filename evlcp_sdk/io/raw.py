"""Prophesee RAW files: a header of text lines, then the words of EVT2, EVT2.1 or EVT3."""

import os
import select
import stat
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import FileIO, RawIOBase
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError, InputError, RawFormatError
from evlcp_sdk.files import Outputs
from evlcp_sdk.io import _kernels
from evlcp_sdk.io.evt import (
    EVT2,
    EVT3,
    EVT21,
    EVT21_LITTLE,
    MAX_SIDE,
    Codec,
    Decoder,
    EventBuffer,
    add_columns,
)
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.plugin.writer import EventWriter
from evlcp_sdk.values import Events, Triggers, span_us, to_kernel_array

_ORDERS: Final = {"legacy": EVT21, "little": EVT21_LITTLE}
"""EVT2.1 by its endianness; files that state none are of sensors older than the GenX320."""

CODECS: Final = {codec.name: codec for codec in (EVT2, EVT21, EVT3)}
"""The encodings that can be read and written, by name."""

MAX_HEADER_BYTES = 1 << 16
PIPE_BYTES, PIPE_WAIT_S = 1 << 17, 0.1
"""Bytes to wait for at the start of a pipe, and how long: enough words to check their encoding."""
WRITE_WORDS = 1 << 15

# Read as another encoding, a third of the words or more are of a reserved type, which a camera never sends.
# An eighth is far from both; fewer than 16 words are not enough to tell.
RESERVED_PROBE_WORDS = 1 << 15
RESERVED_FIRST_WORDS = 1 << 8
RESERVED_SHARE = 1 / 8
RESERVED_LEAST = 16

# A camera sends a TIME_HIGH at least every 4096 us, in which its bus (1.6 Gbit/s) carries less than 1 MB.
TIMELESS_BYTES = 1 << 24


class ChunkReader(ABC):
    """A raw file, as `io` has them, of bytes that come in chunks, after those that are `ready`.

    Without `fileno` it is read as a pipe.

    Attributes:
        bytes_read: Bytes that have been read.
    """

    def __init__(self, ready: bytes = b"") -> None:
        self._ready = memoryview(ready)
        self.bytes_read = 0

    @abstractmethod
    def read_chunk(self) -> bytes | memoryview:
        """Wait for the next chunk; empty at the end."""

    @abstractmethod
    def close(self) -> None:
        """Release the file; what is read then is empty."""

    def readinto(self, room: memoryview, /) -> int:
        """Wait for bytes, write them to the front of `room`, and return how many; 0 at the end."""
        if not len(self._ready):
            self._ready = memoryview(self.read_chunk())
        size = min(len(room), len(self._ready))
        room[:size] = self._ready[:size]
        self._ready = self._ready[size:]
        self.bytes_read += size
        return size


@dataclass(frozen=True)
class RawHeader:
    """The header of a RAW file.

    Attributes:
        fields: The text of each line by its first word, such as `{"evt": "3.0", "geometry": "1280x720"}`.
        codec: The encoding of the words.
        width: Columns of the sensor, or None if no line states them.
        height: Rows of the sensor, or None if no line states them.
        size_bytes: Where the words start.
        closed: Whether the header ends with `% end`.
    """

    fields: Mapping[str, str]
    codec: Codec
    width: int | None
    height: int | None
    size_bytes: int
    closed: bool


def parse_header(data: bytes, path: Path | str) -> RawHeader:
    """Parse the header in `data`, the first bytes of the file `path` (64 KiB suffice).

    The header ends after the line `% end`, or else before the first line that does not start with `%` and a
    space.

    Raises:
        RawFormatError: There is no header, or it states no encoding or one that is not EVT2, EVT2.1 or EVT3,
            or it contradicts itself.
    """
    if not data:
        raise RawFormatError(path, 0, "an empty file", "a RAW header, '% evt 3.0' or '% evt 2.0'")
    if not data.startswith(b"% "):
        raise RawFormatError(path, 0, data[:8].hex(" "), "a RAW header, lines that start with '% '")
    fields: dict[str, str] = {}
    offsets: dict[str, int] = {}
    at = 0
    closed = False
    while not closed and data.startswith(b"% ", at):
        end = data.find(b"\n", at, MAX_HEADER_BYTES)
        line = data[at:end] if end >= 0 else data[at : at + 32]
        text = line.decode("utf-8", "replace")
        if end < 0 or not text.rstrip("\r").isprintable() or "\ufffd" in text:
            raise RawFormatError(path, at, repr(line[:32]), "a header line of text, ended by a line feed")
        key, _, value = text[2:].strip().partition(" ")
        if key == "end":
            closed = True
        elif key in offsets and key in ("evt", "format", "geometry") and fields[key] != value.strip():
            raise RawFormatError(path, at, f"a second {text!r}", f"'% {key} {fields[key]}' as before")
        else:
            fields[key] = value.strip()
            offsets[key] = at
        at = end + 1
    codec, width, height = _parse_fields(fields, offsets, path)
    return RawHeader(fields, codec, width, height, at, closed)


def format_header(codec: Codec, width: int, height: int) -> bytes:
    """Return the header of a RAW file, as Prophesee's own reader accepts it.

    >>> print(format_header(EVT3, 1280, 720).decode(), end="")
    % evt 3.0
    % format EVT3;height=720;width=1280
    % geometry 1280x720
    % integrator_name Prophesee
    % system_ID 49
    % end
    """
    order = ";endianness=legacy" if codec is EVT21 else ""
    return (
        f"% evt {codec.version}\n"
        f"% format {codec.name};height={height};width={width}{order}\n"
        f"% geometry {width}x{height}\n"
        "% integrator_name Prophesee\n"
        "% system_ID 49\n"
        "% end\n"
    ).encode()


def _parse_fields(
    fields: Mapping[str, str], offsets: Mapping[str, int], path: Path | str
) -> tuple[Codec, int | None, int | None]:
    """Return the encoding and the columns and rows of the sensor by the fields of a header."""
    found: dict[str, tuple[str, Any]] = {}

    def set_once(what: str, key: str, value: Any, expected: str) -> None:
        line = f"'% {key} {fields[key]}'"
        if value is None:
            raise RawFormatError(path, offsets[key], line, expected)
        before, known = found.setdefault(what, (line, value))
        if value != known:
            raise RawFormatError(path, offsets[key], f"{line} beside {before}", f"one {what}")

    name, *options = fields.get("format", "").split(";")
    sides = [("format", *option.partition("=")[::2]) for option in options]
    if "geometry" in fields:
        width, _, height = fields["geometry"].partition("x")
        sides += [("geometry", "width", width), ("geometry", "height", height)]
    if "endianness" in fields:
        sides.append(("endianness", "endianness", fields["endianness"]))
    versions = {codec.version: codec for codec in CODECS.values()}
    for key, text, known in (("format", name, CODECS), ("evt", fields.get("evt", ""), versions)):
        if key in fields:
            set_once("encoding", key, known.get(text), " or ".join(known))
    if "encoding" not in found:
        listed = ", ".join(fields)
        raise RawFormatError(path, 0, f"a header without encoding ({listed})", "a line '% evt 3.0'")
    codec = found["encoding"][1]
    for key, side, text in sides:
        if side in ("width", "height"):
            value = int(text) if text.isascii() and text.isdigit() and 1 <= int(text) <= MAX_SIDE else None
            set_once(side, key, value, f"a width and a height from 1 to {MAX_SIDE}")
        elif side == "endianness" and codec is EVT21:
            set_once(side, key, _ORDERS.get(text), "endianness " + " or ".join(_ORDERS))
    codec = found.get("endianness", ("", codec))[1]
    return codec, *(found.get(side, ("", None))[1] for side in ("width", "height"))


class RawSource(EventSource):
    """A RAW file, read through one buffer of fixed size; of a pipe each piece is what has arrived.

    Args:
        path: The file, or the name of `file` in error messages.
        file: The open file, without a buffer; None opens `path`.

    Raises:
        InputError: The file cannot be opened.
        RawFormatError: It has no valid header, or its words are of another encoding than the header states.
    """

    _gives_bits = True

    def __init__(self, path: Path | str, file: RawIOBase | ChunkReader | None = None) -> None:
        self.path = Path(path) if file is None else path
        self._buffer = np.empty(2 * _kernels.LOOKAHEAD_BYTES, np.uint8)
        self._position = 0  # byte offset in the file of the first byte not decoded
        self._start = self._end = 0  # the bytes of the buffer not decoded
        self._exhausted = False
        try:
            self._file = FileIO(path) if file is None else file
            self._descriptor: int | None = getattr(self._file, "fileno", lambda: None)()
            status = None if self._descriptor is None else os.fstat(self._descriptor)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        self._is_pipe = status is None or not stat.S_ISREG(status.st_mode)
        try:
            self._fill_header()
            header = parse_header(self._buffer[: self._end].tobytes(), self.path)
            size = None if status is None or self._is_pipe else status.st_size
            self._codec = header.codec
            self._decoder = Decoder(header.codec, header.width, header.height)
            shape = header.width, header.height
            super().__init__(self.path, header.codec.name, *shape, header.fields, size, self._decoder)
            if not header.closed:
                self._decoder.count_loss(_kernels.HEADER_OPEN, header.size_bytes)
            self._start = self._position = self._data_start = header.size_bytes
            self._fill(0)
            if self._is_pipe and not self._exhausted and self._descriptor is not None:
                self._fill_from_pipe(self._descriptor)
            self._check_encoding()
        except BaseException:
            self._file.close()
            raise

    def _fill_header(self) -> None:
        """Read until the header is complete; of a file as much as there is room for."""
        while not self._exhausted and self._end < MAX_HEADER_BYTES:
            self._fill()
            start = self._buffer[: self._end].tobytes()
            lines = start.split(b"\n")
            # After a complete line another line of the header may come.
            if b"% end" in (line.rstrip(b"\r") for line in lines[:-1]) or any(
                len(line) > 1 and not line.startswith(b"% ") for line in lines
            ):
                return

    def _fill_from_pipe(self, number: int) -> None:
        """Wait a little for words enough to check the encoding; in the dark few come."""
        until_s = time.monotonic() + PIPE_WAIT_S
        ready = select.poll()
        ready.register(number, select.POLLIN)
        while not self._exhausted and self._end - self._start < PIPE_BYTES:
            left_s = until_s - time.monotonic()
            if left_s <= 0 or not ready.poll(left_s * 1e3):
                return
            self._fill()

    def _check_encoding(self) -> None:
        """Raise a RawFormatError if the first words look like another encoding."""
        codec = self._codec
        words = self._get_words()[codec.head :: codec.stride][:RESERVED_PROBE_WORDS]
        kinds = words >> (8 * words.itemsize - 4)
        reserved = codec.types >> kinds.astype(np.int64) & 1 == 0
        share = np.count_nonzero(reserved) / max(len(words), 1)
        # If only later words are wrong, bytes are missing, which the decoder handles.
        first = reserved[:RESERVED_FIRST_WORDS].mean() if len(words) else 0.0
        if min(share, first) > RESERVED_SHARE and share * len(words) >= RESERVED_LEAST:
            raise RawFormatError(
                self.path,
                self._position + int(reserved.argmax()) * codec.size_bytes,
                f"a word of a reserved type, as are {share:.0%} of the first {len(words)} words",
                f"{self.format}, as the header says",
            )

    def _fill(self, least: int = 1) -> None:
        """Move the rest to the front of the buffer, where words are aligned, and read until it is full.

        Of a pipe it reads until `least` more bytes are there.
        """
        left = self._end - self._start
        self._buffer[:left] = self._buffer[self._start : self._end]
        self._start, self._end = 0, left
        view = self._buffer.data
        enough = min(left + least, len(self._buffer)) if self._is_pipe else len(self._buffer)
        while not self._exhausted and self._end < enough:
            try:
                size = self._file.readinto(view[self._end :])
            except (OSError, ValueError) as error:  # ValueError: the file is closed
                raise InputError(f"{self.path}: at byte {self._position + left}: {error}") from error
            self._exhausted = not size
            self._end += size or 0

    def _get_words(self) -> np.ndarray[tuple[int], np.dtype[np.unsignedinteger]]:
        size = self._codec.size_bytes
        count = (self._end - self._start) // size
        return self._buffer[self._start : self._start + count * size].view(self._codec.word)

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        """As `EventSource.take`; words without any time raise a RawFormatError."""
        out = EventBuffer(max(max_events, self._codec.burst), max(max_events // 16, 1024))
        self._decode_into(out)
        return out.get_filled() if out.events or out.triggers else None

    def _decode_into(self, out: EventBuffer) -> None:
        """Decode until `out` is full or the file ends.

        Of a pipe it also stops as soon as it has something and would have to wait for more.
        """
        while out.events <= out.room - self._codec.burst and out.triggers < out.trigger_room:
            words = self._get_words()
            if self._exhausted and not len(words):
                self._finish()
                return
            used = self._decoder.decode(words, self._position, out, self._exhausted)
            self._start += used
            self._position += used
            if not used:
                if self._is_pipe and not self._exhausted and (out.events or out.triggers):
                    return
                self._fill()
            elif self._start % self._codec.size_bytes:
                self._fill(0)
            if self._position - self._data_start > TIMELESS_BYTES and not self._decoder.has_time:
                self._raise_timeless()

    def _finish(self) -> None:
        if self._position > self._data_start and not self._decoder.has_time:
            self._raise_timeless()
        odd = self._end - self._start
        self._decoder.finish(self._position, odd)
        self._start = self._end
        self._position += odd

    def _raise_timeless(self) -> None:
        found = f"no TIME_HIGH in {self._position - self._data_start} bytes"
        raise RawFormatError(self.path, self._data_start, found, f"{self.format} words, as the header says")

    @property
    def position_bytes(self) -> int:
        """How much of the file is decoded."""
        return self._position

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class RawEncoder:
    """Events and triggers as RAW words of an encoding, piece by piece."""

    def __init__(self, codec: Codec) -> None:
        self._codec = codec
        self._state = np.full(3, -1, np.int64)
        self._words = np.empty(WRITE_WORDS, codec.word)
        self._started = False

    def encode(self, events: Events, triggers: Triggers) -> Iterator[bytes]:
        """Yield the words of the next events and triggers, none of them earlier than those before."""
        if not self._started and (len(events) or len(triggers)):
            self._started = True
            words, self._state[0] = self._codec.encode_prelude(span_us(events, triggers)[0])
            yield self._to_bytes(words)
        event_columns = tuple(to_kernel_array(c) for c in (events.t_us, events.x, events.y, events.p))
        trigger_columns = tuple(to_kernel_array(c) for c in (triggers.t_us, triggers.channel, triggers.value))
        i = j = 0
        while i < len(events) or j < len(triggers):
            n, i, j = self._codec.encoder(self._words, self._state, event_columns, i, trigger_columns, j)
            yield self._to_bytes(self._words[:n])

    def _to_bytes(self, words: NDArray[Any]) -> bytes:
        return (words if self._codec.stride == 1 else add_columns(words)).tobytes()


class RawWriter(EventWriter):
    """Writes a RAW file in the words of a codec of `CODECS`.

    It reads back as it was written, in the same order; triggers at the time of events come first.

    Raises:
        OutputError: The file cannot be written.
        ConfigError: The size of the sensor is unknown, or larger than the words can address.
    """

    # Words do not state how often the clock has rolled over. Before a first time beyond its range (EVT3: 16.8
    # s) the writer lets it roll over that often; this limit keeps those words below 2 MB.
    times_us = (0, (1 << 40) - 1)

    def __init__(
        self,
        path: Path | str,
        width: int | None,
        height: int | None,
        codec: Codec = EVT3,
        outputs: Outputs | None = None,
    ) -> None:
        if width is None or height is None:
            raise ConfigError(
                f"{path}: the size of the sensor is not known, expected a width and a height for"
                f" {codec.name}, as `--size 1280x720` gives them"
            )
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
            raise ConfigError(f"{path}: sensor of {width}x{height}, expected 1 to {MAX_SIDE} each")
        self.channels = codec.channels
        self._encoder = RawEncoder(codec)
        self._header = format_header(codec, width, height)
        super().__init__(path, width, height, outputs)

    def _begin(self) -> None:
        self._file.write(self._header)

    def _write(self, events: Events, triggers: Triggers) -> None:
        for words in self._encoder.encode(events, triggers):
            self._file.write(words)
