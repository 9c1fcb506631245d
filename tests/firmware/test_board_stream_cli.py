"""`evlcp board stream`: lines as they come, on a board that runs."""

import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_lines import Native
from test_board_cli import EVLCP
from test_board_messages import messages_of, symbols_of

from evlcp_sdk.air.blocks import Kind
from evlcp_sdk.air.kinds import CountdownKind, TimeKind
from evlcp_sdk.link.resolve import load_link
from firmware_host.emulators.led_record import RECORD, LedRecord

pytestmark = pytest.mark.usefixtures("compiler")

Evlcp = Callable[..., Any]
LINK = load_link()


def packets_on(leds: Path) -> np.ndarray:
    """Symbols of the packets that a board showed; what is between them is left out."""

    chips = LedRecord.read(leds).played().chips()
    preamble = LINK.codebook.preamble[:, None]
    found, at = [], 0
    while at + LINK.packet.packet_chips <= len(chips):
        if (chips[at : at + len(preamble)] == preamble).all():
            found.append(chips[at : at + LINK.packet.packet_chips])
            at += LINK.packet.packet_chips
        else:
            at += 1
    return symbols_of(np.concatenate(found), LINK)


def test_texts_go_out_as_they_come(tmp_path: Path) -> None:
    port, leds = f"unix:{tmp_path / 'board'}", tmp_path / "leds.bin"
    emulated = Native(port, leds=leds)
    command = [*EVLCP, "board", "stream", "--port", port, "--id", "7", "--json"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    # each when the one before has long been played
    for n in (3, 2, 1):
        process.stdin.write(f"Green in {n} s\n")
        process.stdin.flush()
        seen = leds.stat().st_size
        while leds.stat().st_size < seen + 2000 * RECORD.itemsize:
            time.sleep(0.02)
    process.stdin.close()
    done = json.loads(process.stdout.read())
    assert process.wait(20) == 0
    process.stdout.close()
    emulated.end()
    packets = packets_on(leds)
    said = [messages_of(packet[None], LINK)[Kind.TEXT] for packet in packets]
    assert [m.text for m in said] == ["Green in 3 s", "Green in 2 s", "Green in 1 s"]
    assert [m.transmitter_id for m in said] == [7, 7, 7]
    assert sorted({m.sequence for m in said}) == [m.sequence for m in said], "each with a higher number"
    assert done["packets"] == 3
    assert done["underruns"] in (2, 3)


def test_symbols_from_a_file(evlcp: Evlcp, tmp_path: Path) -> None:
    port, leds = f"unix:{tmp_path / 'board'}", tmp_path / "leds.bin"
    table = json.loads(evlcp("tx", "frames", "--random", 4, "--seed", 5, "--format", "json").out)["symbols"]
    file = tmp_path / "lines.jsonl"
    # a packet a line, then two on one
    file.write_text("\n".join(map(json.dumps, (table[0], table[1], table[2:]))) + "\n\n")
    emulated = Native(port, leds=leds)
    done = evlcp("board", "stream", file, "--lines", "symbols", "--repeat", 2, "--port", port)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("8 packets, ")
    emulated.end()
    assert packets_on(leds).tolist() == [packet for packet in table for _ in range(2)]


@pytest.mark.parametrize(
    ("text", "options", "says"),
    [
        ("hi\n[", ("--lines", "symbols"), "line 1: not JSON"),
        ("[[1]]", ("--lines", "symbols"), "line 1: symbols[0]: found 1 elements, expected 10 frames"),
        ("{}", ("--lines", "symbols"), "line 1: symbols: found {}"),
        ("[" * 100_000, ("--lines", "symbols"), "line 1: not JSON"),
        ("a" * 70_000, (), "line 1: message: 70000 bytes"),
        ("\udcff", (), "cannot be read"),
    ],
)
def test_a_wrong_line_is_told(
    evlcp: Evlcp, tmp_path: Path, text: str, options: tuple[str, ...], says: str
) -> None:
    file = tmp_path / "lines"
    file.write_bytes(text.encode("utf-8", "surrogateescape"))
    done = evlcp("board", "stream", file, "--port", "native:", *options)
    assert done.code == 3
    assert says in done.err
    assert done.err.count("\n") == 1


def test_a_message_that_changes(evlcp: Evlcp, tmp_path: Path) -> None:
    port, leds = f"unix:{tmp_path / 'board'}", tmp_path / "leds.bin"
    emulated = Native(port, leds=leds)
    began = time.time()
    said = ("--text", "{n}: {left} s left at {time}", "--time", "--countdown", 100, "--sequence", 40)
    done = evlcp(
        *("tx", "message", *said, "--signal", "amber", "--next", "red", "--every", 1, "--count", 2),
        *("--port", port, "--json"),
    )
    assert (done.code, done.err) == (0, "")
    emulated.end()
    packets = packets_on(leds)
    assert len(packets) == json.loads(done.out)["packets"] >= 45
    first, last = (messages_of(some, LINK) for some in (packets[:3], packets[-3:]))
    assert [m[Kind.TEXT].sequence for m in (first, last)] == [40, 41]
    for n, found in enumerate((first, last)):
        time_s = TimeKind().unpack(found[Kind.TIME].payload)
        left = CountdownKind().unpack(found[Kind.COUNTDOWN].payload)
        clock = time.strftime("%H:%M:%S", time.gmtime(time_s))
        assert found[Kind.TEXT].text == f"{n}: {left.left_s:.0f} s left at {clock}"
        assert (left.signal, left.next_signal) == ("amber", "red")
        assert began + n <= time_s <= time.time()
        assert time_s + left.left_s == pytest.approx(began + 100.0, abs=1.0)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--text", "a", "--every", "1"), "--every sends to a board: give --port"),
        (("--text", "a", "--every", "1", "-o", "m.json"), "-o and --chips hold what stays"),
        (("--text", "a", "--count", "3"), "--count belongs to --every"),
        (("--countdown", "3", "--signal", "blue", "--every", "1", "--port", "native:"), "signal = 'blue'"),
        (("--countdown", "1e9", "--json"), "expected 0 to 86400"),
        (
            ("--text", "a" * 8000, "--every", "1", "--port", "native:"),
            "takes 6.955 s on air, 201 packets of 34.6 ms; give --every 7 or more, or send less",
        ),
    ],
)
def test_a_wrong_one_is_one_line(
    evlcp: Evlcp, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], says: str
) -> None:
    monkeypatch.delenv("EVLCP_PORT", raising=False)
    done = evlcp("tx", "message", *options)
    assert done.code == 2
    assert says in done.err
    assert done.err.count("\n") == 1
