"""Traces of the wire that cannot be written."""

from pathlib import Path

import pytest

from evlcp_sdk.errors import OutputError
from firmware_host.ports.transport import ReplayTransport, TraceTransport


class Line:
    """A line on which nothing happens."""

    name = "line"

    def now(self) -> float:
        return 0.0

    def read(self, timeout_s: float) -> bytes:
        del timeout_s
        return b"\x01" * 100_000

    def write(self, data: bytes) -> None:
        pass

    def close(self) -> None:
        pass


def test_a_trace_outlasts_what_ends_without_a_word(tmp_path: Path) -> None:
    trace = TraceTransport(Line(), tmp_path / "wire.jsonl", 9600, 1, 2)
    trace.write(b"abc")
    trace.close()
    assert ReplayTransport(tmp_path / "wire.jsonl").nonce == 2


def test_a_trace_follows_no_link(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("mine")
    (tmp_path / "wire.jsonl").symlink_to(tmp_path / "victim")
    with pytest.raises(OutputError, match=r"wire\.jsonl: cannot be written: it is a link"):
        TraceTransport(Line(), tmp_path / "wire.jsonl", 9600, 1, 2)
    with pytest.raises(OutputError, match="cannot be written: No such file"):
        TraceTransport(Line(), tmp_path / "no" / "wire.jsonl", 9600, 1, 2)
    assert (tmp_path / "victim").read_text() == "mine"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_ends_a_trace_in_one_line() -> None:
    trace = TraceTransport(Line(), Path("/dev/full"), 9600, 1, 2)
    for end in (lambda: trace.read(0.1), trace.close):
        with pytest.raises(OutputError, match="/dev/full: cannot be written: No space left"):
            end()
