"""What boards in the field speak must not change.

Wires recorded with the real firmware and the real host of protocol 2.0; and the bytes of each message of 2.0
and 2.1, and of those that 2.2 changed, made from the definitions of these versions without the codec.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from every_request import every_request

from evlcp_sdk.air.codebook import Codebook
from firmware_host.board import session
from firmware_host.board.bank import Bank, random_symbols
from firmware_host.board.board import Board
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.errors import IncompatibleError
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


def replies(wire: bytes) -> list[Datagram]:
    return DatagramDecoder().feed(wire)


def recorded(name: str) -> list[tuple[str, bytes]]:
    lines = (VECTORS / name).read_text().splitlines()[1:]
    return [(e["dir"], bytes.fromhex(e["hex"])) for e in map(json.loads, lines)]


def test_this_host_and_the_firmware_of_2_0(book: Codebook, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "MINOR", 1)  # what the host said that was recorded
    line = ReplayTransport(VECTORS / "board-2.0.jsonl")
    board = Board(Session(line, Timing(latency_s=2.0), first=line.first, nonce=line.nonce))
    assert board.session.client.minor == 0
    bank = Bank.of_symbols(random_symbols(1, 4, book, np.random.default_rng(1)), book)
    with pytest.raises(IncompatibleError, match=r"START with at_pulse is not in its protocol 2\.0"):
        board.start(at_pulse=5)
    assert every_request(board, bank, bytes(range(200))) == [
        *("0", "0", "0", "0", "40", "(3, 40)", "320", "(0, 64, 0)", "(0, 1, 'native')", "200", "1")
    ]
    assert not line._events


@pytest.mark.usefixtures("compiler")
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
