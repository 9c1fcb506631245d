"""Prophesee RAW files: a header of text lines, then the words of EVT2 or EVT3."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from evlcp_sdk.errors import InputError, RawFormatError
from evlcp_sdk.io import _words
from evlcp_sdk.io._codec import MAX_SIDE, Codec, Columns, Decoder
from evlcp_sdk.io.evt2 import EVT2
from evlcp_sdk.io.evt3 import EVT3
from evlcp_sdk.io.sources import DEFAULT_MAX_EVENTS, EventSource, Loss, check_max_events
from evlcp_sdk.types import Events, Triggers

__all__ = ["CODECS", "RawHeader", "RawSource", "parse_header"]

CODECS: Final = {codec.name: codec for codec in (EVT2, EVT3)}
"""The encodings that can be read and written, by name."""

MAX_HEADER_BYTES = 1 << 16
BUFFER_BYTES = 1 << 20

# Another encoding read as the declared one has a reserved type in a third of its words or more, and a camera
# never sends one. An eighth is far from both; and fewer than 16 words are not enough to say.
RESERVED_PROBE_WORDS = 1 << 15
RESERVED_SHARE = 1 / 8
RESERVED_LEAST = 16

# A camera sends a TIME_HIGH at least every 4096 us, in which its bus (1.6 Gbit/s) carries less than 1 MB.
TIMELESS_BYTES = 1 << 24


@dataclass(frozen=True)
class RawHeader:
    """What the header of a RAW file says.

    Attributes:
        fields: The text of each line by its first word, such as `{"evt": "3.0", "geometry": "1280x720"}`.
        codec: The encoding of the words behind it.
        width: Columns of the sensor, or None if no line tells.
        height: Rows of the sensor, or None if no line tells.
        size_bytes: Where the words start.
        closed: Whether it ends with `% end`.
    """

    fields: Mapping[str, str]
    codec: Codec
    width: int | None
    height: int | None
    size_bytes: int
    closed: bool


def parse_header(data: bytes, path: Path | str) -> RawHeader:
    """Read the header at the start of `data`, the first bytes of the file `path` (64 KiB suffice).

    The header ends behind the line `% end`, or else before the first line that does not start with `% `.

    Raises:
        RawFormatError: There is no header, or it does not tell the encoding, tells one that is not EVT2 or
            EVT3, or contradicts itself.
    """
    if not data:
        raise RawFormatError(path, 0, "an empty file", "a RAW header, '% evt 3.0' or '% evt 2.0'")
    if not data.startswith(b"% "):
        raise RawFormatError(path, 0, _describe(data), "a RAW header, lines that start with '% '")
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
    codec, width, height = _interpret(fields, offsets, path)
    return RawHeader(fields, codec, width, height, at, closed)


def _interpret(
    fields: Mapping[str, str], offsets: Mapping[str, int], path: Path | str
) -> tuple[Codec, int | None, int | None]:
    """Return the encoding and the size of the sensor that header lines tell."""
    known = " or ".join(CODECS)
    by_version = {codec.version: codec for codec in CODECS.values()}
    name, *options = fields.get("format", "").split(";")
    codec = None
    if "format" in fields:
        codec = CODECS.get(name)
        if codec is None:
            raise RawFormatError(path, offsets["format"], f"encoding {name!r}", known)
    if "evt" in fields:
        versioned = by_version.get(fields["evt"])
        if versioned is None:
            expected = " or ".join(by_version)
            raise RawFormatError(path, offsets["evt"], f"EVT version {fields['evt']!r}", expected)
        if codec is not None and versioned is not codec:
            found = f"'% evt {fields['evt']}' beside '% format {fields['format']}'"
            raise RawFormatError(path, offsets["evt"], found, "one encoding")
        codec = versioned
    if codec is None:
        raise RawFormatError(
            path, 0, f"a header without encoding ({', '.join(fields)})", "a line '% evt 3.0'"
        )

    sizes: dict[str, set[int]] = {"width": set(), "height": set()}
    for option in options:
        key, _, value = option.partition("=")
        if key in sizes:
            sizes[key].add(_side(value, offsets["format"], fields["format"], path))
    if "geometry" in fields:
        width, _, height = fields["geometry"].partition("x")
        sizes["width"].add(_side(width, offsets["geometry"], fields["geometry"], path))
        sizes["height"].add(_side(height, offsets["geometry"], fields["geometry"], path))
    for key, values in sizes.items():
        if len(values) > 1:
            found = f"'% geometry {fields['geometry']}' beside '% format {fields['format']}'"
            raise RawFormatError(path, offsets["geometry"], found, f"one {key}")
    return codec, next(iter(sizes["width"]), None), next(iter(sizes["height"]), None)


def _side(text: str, at: int, line: str, path: Path | str) -> int:
    """Return a width or height of the sensor."""
    if text.isascii() and text.isdigit() and 1 <= int(text) <= MAX_SIDE:
        return int(text)
    raise RawFormatError(path, at, repr(line), f"a width and a height from 1 to {MAX_SIDE}")


def _describe(data: bytes) -> str:
    """Say what the first bytes of a file look like."""
    magics = {
        b"\x89PNG": "a PNG image",
        b"\x89HDF": "an HDF5 file",
        b"PK\x03\x04": "a ZIP archive",
        b"\x1f\x8b": "a gzip file",
        b"%PDF": "a PDF document",
    }
    name = next((name for magic, name in magics.items() if data.startswith(magic)), None)
    start = data[:8].hex(" ")
    return f"{start} ({name})" if name else start


class RawSource(EventSource):
    """A RAW file, read with one buffer of fixed size.

    Args:
        path: The file.
        buffer_bytes: Size of the buffer.

    Raises:
        InputError: The file cannot be opened.
        RawFormatError: Its header is not one, or its words are of another encoding than the header says.
    """

    def __init__(self, path: Path | str, buffer_bytes: int = BUFFER_BYTES) -> None:
        self.path = Path(path)
        self._buffer = np.empty(max(buffer_bytes, MAX_HEADER_BYTES), np.uint8)
        self._position = 0  # byte offset in the file of the first byte not decoded
        self._start = self._end = 0  # the bytes of the buffer not decoded
        self._exhausted = False
        self._events = self._triggers = 0
        try:
            self._file = self.path.open("rb", buffering=0)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        try:
            self._open()
        except BaseException:
            self._file.close()
            raise

    def _open(self) -> None:
        self._fill()
        header = parse_header(self._buffer[: self._end].tobytes(), self.path)
        self.format = header.codec.name
        self.width, self.height = header.width, header.height
        self.header = header.fields
        size = self.path.stat().st_size if self.path.is_file() else 0
        self.size_bytes = size or None
        self._codec = header.codec
        self._decoder = Decoder(header.codec, header.width, header.height)
        if not header.closed:
            self._decoder.note(_words.HEADER_OPEN, header.size_bytes)
        self._start = self._position = self._data_start = header.size_bytes
        self._fill()
        words = self._words()[:RESERVED_PROBE_WORDS]
        reserved, share = self._codec.reserved_share(words)
        if reserved >= RESERVED_LEAST and share > RESERVED_SHARE:
            first = int(
                np.flatnonzero(~np.isin(words >> (8 * words.itemsize - 4), list(self._codec.types)))[0]
            )
            raise RawFormatError(
                self.path,
                self._position + first * words.itemsize,
                f"a word of a reserved type, as are {share:.0%} of the first {len(words)}",
                f"{self.format} words, as the header says",
            )

    def _fill(self) -> None:
        """Move what is left to the front of the buffer and read on until it is full or the file ends."""
        left = self._end - self._start
        self._buffer[:left] = self._buffer[self._start : self._end]
        self._start, self._end = 0, left
        view = memoryview(self._buffer)
        while not self._exhausted and self._end < len(self._buffer):
            try:
                size = self._file.readinto(view[self._end :])
            except OSError as error:
                raise InputError(f"{self.path}: at byte {self._position + left}: {error.strerror}") from error
            self._exhausted = not size
            self._end += size or 0

    def _words(self) -> np.ndarray[tuple[int], np.dtype[np.unsignedinteger]]:
        """Return the whole words in the buffer."""
        size = self._codec.word.itemsize
        count = (self._end - self._start) // size
        return self._buffer[self._start : self._start + count * size].view(self._codec.word)

    def stream(self, max_events: int = DEFAULT_MAX_EVENTS) -> Iterator[tuple[Events, Triggers]]:
        """As `EventSource.stream`.

        Raises:
            InputError: The file cannot be read on.
            RawFormatError: No word gives a time.
        """
        check_max_events(max_events)
        capacity = max(max_events, self._codec.burst)
        done = False
        while not done:
            out = Columns(capacity, max(capacity // 16, 1024))
            done = self._decode_into(out)
            self._events += out.events
            self._triggers += out.triggers
            events, triggers = out.taken()
            if len(events) <= max_events:
                if len(events) or len(triggers):
                    yield events, triggers
                continue
            for k in range(0, len(events), max_events):
                yield events[k : k + max_events], triggers if k == 0 else Triggers.empty()

    def _decode_into(self, out: Columns) -> bool:
        """Decode until `out` is full, and return False, or to the end of the file, and return True."""
        while out.events <= len(out.t_us) - self._codec.burst and out.triggers < len(out.channel):
            words = self._words()
            if not len(words):
                if self._exhausted:
                    self._finish()
                    return True
                self._fill()
                continue
            used = self._decoder.decode(words, self._position, out) * words.itemsize
            self._start += used
            self._position += used
            if not self._decoder.has_time and self._position - self._data_start > TIMELESS_BYTES:
                self._raise_timeless()
        return False

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

    @property
    def losses(self) -> dict[str, Loss]:
        """As `EventSource.losses`, with byte offsets."""
        return self._decoder.losses

    @property
    def counts(self) -> dict[str, int]:
        """`events`, `triggers`, `rollovers`, `time_gaps` and `other_words`."""
        return {"events": self._events, "triggers": self._triggers, **self._decoder.counts}

    def close(self) -> None:
        """Close the file."""
        self._file.close()
