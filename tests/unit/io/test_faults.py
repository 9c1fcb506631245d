"""Bad RAW input: each fault is an error that says where, what and what else, or a counted loss."""

import io
import json
import os
import pty
import subprocess
import sys
import threading

import numpy as np
import pytest

from evlcp_sdk.errors import InputError, RawFormatError
from evlcp_sdk.io import RawSource, open_source, write_events
from evlcp_sdk.io.evt import EVT3, EVT21, EVT21_LITTLE
from evlcp_sdk.io.raw import CODECS, format_header, parse_header
from evlcp_sdk.values import Events

HEADER = format_header(CODECS["EVT3"], 640, 480)
GOOD = [0x8001, 0x6002, 0x0003, 0x2804]


def raw(path, words, header=HEADER, tail=b"", dtype="<u2"):
    path.write_bytes(header + np.array(words, dtype).tobytes() + tail)
    return path


def some_events(n=3000):
    rng = np.random.default_rng(2)
    x, y, p = (rng.integers(0, end, n) for end in (640, 480, 2))
    return Events.of(np.sort(rng.integers(0, 10_000, n)), x, y, p)


BAD_HEADERS = {
    "empty file": (b"", 0, "an empty file", "a RAW header"),
    "PNG": (b"\x89PNG\r\n\x1a\n" + bytes(50), 0, "89 50 4e 47", "'% '"),
    "no encoding": (b"% date today\n% end\n", 0, "a header without encoding", "'% evt 3.0'"),
    "EVT4": (b"% date x\n% format EVT4;height=1;width=1\n% end\n", 9, "'% format EVT4;", "EVT21 or EVT3"),
    "two encodings": (b"% evt 2.0\n% format EVT3\n% end\n", 0, "'% evt 2.0' beside '% format EVT3'", "one"),
    "two sizes": (
        b"% format EVT3;height=4;width=5\n% geometry 6x4\n% end\n",
        *(31, "'% geometry 6x4' beside", "one width"),
    ),
    "a line twice": (b"% geometry 4x4\n% geometry 5x4\n% end\n", 15, "a second", "'% geometry 4x4'"),
    "zero width": (b"% evt 3.0\n% geometry 0x4\n% end\n", 10, "'% geometry 0x4'", "from 1 to 2048"),
    "big-endian": (b"% evt 2.1\n% endianness big\n% end\n", 10, "'% endianness big'", "legacy or little"),
    "two orders": (
        b"% format EVT21;endianness=little\n% endianness legacy\n% end\n",
        33,
        "beside",
        "one end",
    ),
    "huge width": (b"% format EVT3;height=720;width=99999\n% end\n", 0, "width=99999", "from 1 to 2048"),
    "binary in the header": (b"% evt 3.0\n% \xff\x00\n% end\n", 10, r"b'% \xff", "a header line"),
    "header cut": (b"% evt 3.0\n% forma", 10, "b'% forma'", "ended by a line feed"),
}


@pytest.mark.parametrize("name", BAD_HEADERS)
def test_bad_header_is_an_error_with_offset_found_expected(name, tmp_path):
    data, offset, found, expected = BAD_HEADERS[name]
    path = tmp_path / "bad.raw"
    path.write_bytes(data)
    with pytest.raises(RawFormatError) as caught:
        open_source(path)
    assert caught.value.path == path
    assert caught.value.offset == offset
    assert found in caught.value.found
    assert expected in caught.value.expected
    assert str(caught.value).startswith(f"{path}: at byte {offset}: found ")


def test_header_without_end_is_counted(tmp_path):
    header = HEADER.removesuffix(b"% end\n")
    with open_source(raw(tmp_path / "a.raw", GOOD, header)) as source:
        events, _ = source.read()
    assert events.x.tolist() == [4]
    assert source.losses.keys() == {"header_without_end"}
    assert source.losses["header_without_end"].first == len(header)


def test_header_lines_of_a_real_camera():
    lines = b"% evt 3.0\r\n% date 2024-01-01 10:00:00\n% geometry 1280x720\n% plugin\n% end\n\x01\x80"
    header = parse_header(lines, "a.raw")
    date = "2024-01-01 10:00:00"
    assert header.fields == {"evt": "3.0", "date": date, "geometry": "1280x720", "plugin": ""}
    assert (header.codec.name, header.width, header.height) == ("EVT3", 1280, 720)
    assert (header.size_bytes, header.closed) == (len(lines) - 2, True)


def test_the_order_of_evt21_is_what_the_header_says():
    stated = {b"": EVT21, b"% endianness legacy\n": EVT21, b"% endianness little\n": EVT21_LITTLE}
    stated |= {b"% format EVT21;height=9;endianness=little\n": EVT21_LITTLE}
    for line, codec in stated.items():
        assert parse_header(line + b"% evt 2.1\n% end\n", "a.raw").codec is codec
    assert parse_header(b"% evt 3.0\n% endianness little\n% end\n", "a.raw").codec is EVT3


@pytest.mark.parametrize(("written", "declared"), [("EVT2", "EVT3"), ("EVT3", "EVT2")])
@pytest.mark.parametrize("n", [100, 3000])
def test_another_encoding_than_declared(written, declared, n, tmp_path):
    path = tmp_path / "a.raw"
    write_events(path, some_events(n), 640, 480, format=written)
    data = path.read_bytes()
    header = format_header(CODECS[declared], 640, 480)
    path.write_bytes(header + data[data.index(b"% end\n") + 6 :])
    with pytest.raises(RawFormatError) as caught, open_source(path):
        pass
    assert "a word of a reserved type" in caught.value.found
    assert f"{declared}, as the header says" in caught.value.expected
    assert caught.value.offset >= len(header)


@pytest.mark.parametrize(
    ("name", "words", "tail", "kind", "count", "first"),
    [
        ("EVT3", [0x0003, 0x2804, 0x6001, *GOOD], b"", "words_before_time", 3, 0),
        ("EVT3", GOOD, b"\x01", "odd_bytes", 1, 8),
        ("EVT3", [*GOOD, 0x2000 | 640, 0x2000 | 700], b"", "outside_sensor", 2, 8),
        ("EVT2", [0x80000001, 0x1], b"\x01\x02\x03", "odd_bytes", 3, 8),
    ],
)
def test_loss_is_counted_with_its_first_offset(name, words, tail, kind, count, first, tmp_path):
    """As a file says it; any words against a twin: `test_evt.py`."""
    header = format_header(CODECS[name], 640, 480)
    with open_source(raw(tmp_path / "a.raw", words, header, tail, CODECS[name].word)) as source:
        got, _ = source.read()
    assert len(got) == 1
    assert source.losses.keys() == {kind}
    loss = source.losses[kind]
    assert (loss.count, loss.first, loss.unit) == (count, len(header) + first, "byte")
    assert str(loss) == f"{count} {loss.meaning} (first at byte {len(header) + first})"
    assert source.position_bytes == source.size_bytes


@pytest.mark.parametrize("name", ["dir.raw", "dir.npz", "dir.es"])
def test_directory(name, tmp_path):
    (tmp_path / name).mkdir()
    with pytest.raises(InputError, match=f"{name}: "):
        open_source(tmp_path / name)


@pytest.mark.parametrize("bytes_at_a_time", [1000, 4099, 70_001])
def test_a_pipe_gives_what_is_there(bytes_at_a_time):
    """Words in pieces of any size are read as if they came at once, and given before the next ones come."""
    good = np.array(GOOD * 60_000, "<u2")
    # Bytes that are missing make the reader look ahead.
    data = HEADER + good[:200_000].tobytes() + good[200_000:].tobytes()[101:]
    with RawSource("whole", file=_pipe(data, len(data))) as source:
        whole, _ = source.read()
        losses = source.losses
    seen = threading.Event()
    with RawSource("pieces", file=_pipe(data, bytes_at_a_time, seen)) as source:
        pieces = []
        for events in source.chunks():
            pieces.append(events)
            seen.set()
    assert len(pieces) > 2
    together = Events.concat(pieces)
    for column in ("t_us", "x", "y", "p"):
        assert (getattr(together, column) == getattr(whole, column)).all()
    assert source.losses == losses


def _pipe(data, at_a_time, seen=None):
    """The end of a pipe into which a thread writes; behind the middle only when the first half is `seen`."""
    end, start = os.pipe()

    def write():
        with os.fdopen(start, "wb", buffering=0) as file:
            for at in range(0, len(data), at_a_time):
                if seen is not None and at > len(data) // 2:
                    assert seen.wait(20)
                file.write(data[at : at + at_a_time])

    threading.Thread(target=write, daemon=True).start()
    return io.FileIO(end)


def test_standard_input_is_a_recording(tmp_path):
    path = raw(tmp_path / "a.raw", GOOD * 100)
    command = [sys.executable, "-c", "from evlcp_sdk.cli.main import main; main()", "info", "-", "--json"]
    with path.open("rb") as file:
        result = json.loads(subprocess.run(command, stdin=file, capture_output=True, check=True).stdout)
    assert (result["path"], result["counts"]["events"]) == ("standard input", 100)
    inside, outside = pty.openpty()
    done = subprocess.run(command, stdin=outside, capture_output=True, text=True, check=False)
    os.close(inside)
    os.close(outside)
    assert done.returncode == 3
    assert "standard input is a terminal, expected a recording" in done.stderr
