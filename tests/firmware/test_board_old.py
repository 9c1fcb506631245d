"""What boards in the field speak must not change.

Wires recorded with the real firmware and the real host of protocol 2.0; and the bytes of each message of 2.0
and 2.1, and of those that 2.2 changed, made from the definitions of these versions without the codec.
"""

import dataclasses
import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_lines import board_link, some_bank

from firmware_host.board import session
from firmware_host.board.bank import Bank
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.errors import IncompatibleError, RefusedError
from firmware_host.ports.transport import ReplayTransport
from firmware_host.protocol.client import Timing
from firmware_host.protocol.datagram import Datagram, DatagramDecoder
from firmware_host.protocol.generated import requests
from firmware_host.protocol.wire import WireMessage

VECTORS = Path(__file__).parents[1] / "vectors"
MESSAGES = [json.loads(line) for line in (VECTORS / "protocol-2.jsonl").read_text().splitlines()]


def of(table: dict[str, Any]) -> type[WireMessage]:
    name = "".join(word.capitalize() for word in f"{table['name']}_{table['kind']}".split("_"))
    found: type[WireMessage] = getattr(requests, name, requests.REPLIES[table["type"]])
    return found


@pytest.mark.parametrize("table", MESSAGES, ids=lambda t: f"2.{t['minor']}-{t['name']}-{t['kind']}")
def test_bytes_of_each_message_are_those_of_its_version(table: dict[str, Any]) -> None:
    cls, wire = of(table), bytes.fromhex(table["hex"])
    assert cls is requests.REPLIES[table["type"]] or table["type"] == cls.TYPE
    message = cls.unpack(wire)
    assert message.pack(table["minor"]) == wire
    values = {field.name: getattr(message, field.name) for field in dataclasses.fields(message)}
    said = {name: value for name, value in values.items() if name in table["fields"]}
    plain = {
        n: v.hex() if isinstance(v, bytes) else list(v) if isinstance(v, tuple) else v
        for n, v in said.items()
    }
    assert plain == table["fields"]
    # what came later is zero to who does not know it
    later = [value for name, value in values.items() if name not in table["fields"]]
    assert not any(
        np.frombuffer(bytes(v), np.uint8).any() if isinstance(v, bytes) else np.any(v) for v in later
    )


def every_request(board: Board, bank: Bank, update: bytes) -> list[str]:
    """Say everything of protocol 2.0 once; what was answered, as text.

    Args:
        board: The board, just reset.
        bank: What to play.
        update: An image of its firmware.
    """
    call = board.session.call
    told = [str(board.about.minor)]

    def say(what: object) -> None:
        told.append(str(what))

    provision(board, bank, Settings(level_ma=11, start=False, level_limit_ma=40, duty_limit=0.75))
    say(board.verify(bank))
    board.watchdog(requests.Watchdog.IDLE, 60_000)
    say(board.save().slot)
    say(board.recall().slot)
    board.start()
    board.stop()
    say(board.wait_dark().level_limit_ma)
    board.blank()
    board.test_leds(0, 1, 1)
    board.wait_dark()
    try:
        board.level(41)
    except RefusedError as fault:
        say((fault.status, fault.detail))
    spare = 1 - board.status().active_bank
    digest = bytes.fromhex(bank.digest)
    slots = call(requests.StreamRequest(spare, requests.Format.WORDS, digest)).slots
    say(slots)
    push = call(requests.PushRequest(spare, 0, 0, 0, bank.content[:64]))
    say((push.number, push.offset, push.begun))
    state = call(requests.UpdateStatusRequest())
    say((state.running, state.next, state.target.rstrip(b"\0").decode()))
    call(requests.UpdateBeginRequest(state.next, len(update), zlib.crc32(update)))
    say(call(requests.UpdateWriteRequest(0, update)).count)
    say(call(requests.UpdateCommitRequest()).sequence)
    call(requests.UpdateConfirmRequest())
    call(requests.UpdateRestartRequest())
    return told


def replies(wire: bytes) -> list[Datagram]:
    return DatagramDecoder().feed(wire)


def recorded(name: str) -> list[tuple[str, bytes]]:
    lines = (VECTORS / name).read_text().splitlines()[1:]
    return [(e["dir"], bytes.fromhex(e["hex"])) for e in map(json.loads, lines)]


def test_this_host_and_the_firmware_of_2_0(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "MINOR", 1)  # what the host said that was recorded
    line = ReplayTransport(VECTORS / "board-2.0.jsonl")
    board = Board(Session(line, Timing(latency_s=2.0), first=line.first, nonce=line.nonce))
    assert board.session.client.minor == 0
    bank = some_bank(1, 1, board_link("air.frames_per_packet=4"))
    with pytest.raises(IncompatibleError, match=r"START with at_pulse is not in its protocol 2\.0"):
        board.start(at_pulse=5)
    assert every_request(board, bank, bytes(range(200))) == [
        *("0", "0", "0", "0", "40", "(3, 40)", "320", "(0, 64, 0)", "(0, 1, 'native')", "200", "1")
    ]
    assert not line._events


def test_the_host_of_2_0_and_this_firmware() -> None:
    """It is answered as by its own firmware, as far as an answer does not tell the time."""
    device = SimulatedBoard((7).to_bytes(12, "big"))
    expected, wire, seen = b"", b"", set()
    for direction, data in recorded("host-2.0.jsonl"):
        if direction == "rx":
            expected += data
            continue
        device.receive(data)
        for _ in range(40):
            device.run(1_000)
            wire += device.sent()
    theirs, ours = replies(expected), replies(wire)
    assert len(theirs) == len(ours) > 30
    for old, new in zip(theirs, ours, strict=True):
        head = (old.type, old.status, old.sequence, old.session)
        assert (new.type, new.status, new.sequence, new.session) == head
        seen.add(old.type & ~requests.REPLY_BIT)
        assert len(new.payload) >= len(old.payload)
        if old.type & ~requests.REPLY_BIT not in (requests.Type.HELLO, requests.Type.STATUS):
            assert new.payload[: len(old.payload)] == old.payload
    assert seen == {t["type"] for t in MESSAGES if t["minor"] == 0}
