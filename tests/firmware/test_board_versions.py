"""Hosts and firmware of other minor versions: what boards in the field speak must not change.

Wires recorded with the real firmware and the real host of protocol 2.0; the bytes of each message of 2.0 and
2.1, and of those that 2.2 changed, made from these versions' definitions without the codec.
"""

import dataclasses
import json
import zlib
from pathlib import Path

import numpy as np
import pytest
from board_lines import board_link, some_bank

from firmware_host.board import session
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.board.tables import flag_names
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.errors import IncompatibleError, RefusedError
from firmware_host.ports.transport import ReplayTransport
from firmware_host.protocol.client import Timing
from firmware_host.protocol.datagram import DatagramDecoder
from firmware_host.protocol.generated import requests

VECTORS = Path(__file__).parents[1] / "vectors"
MESSAGES = [json.loads(line) for line in (VECTORS / "protocol-2.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("table", MESSAGES, ids=lambda t: f"2.{t['minor']}-{t['name']}-{t['kind']}")
def test_bytes_of_each_message_are_those_of_its_version(table):
    name = "".join(word.capitalize() for word in f"{table['name']}_{table['kind']}".split("_"))
    cls, wire = getattr(requests, name, requests.REPLIES[table["type"]]), bytes.fromhex(table["hex"])
    assert cls is requests.REPLIES[table["type"]] or table["type"] == cls.TYPE
    message = cls.unpack(wire)
    assert message.pack(table["minor"]) == wire
    values = {}
    for name, value in dataclasses.asdict(message).items():
        is_list = isinstance(table["fields"].get(name), list)
        value = np.frombuffer(value, "<u2").tolist() if is_list else value
        values[name] = value.hex() if isinstance(value, bytes) else value
    assert {name: value for name, value in values.items() if name in table["fields"]} == table["fields"]
    # what came later is zero to who does not know it
    later = [value for name, value in values.items() if name not in table["fields"]]
    assert not any(value.strip("0") if isinstance(value, str) else np.any(value) for value in later)


def every_request(board, bank, update):
    """Say everything of protocol 2.0 once to a board that was just reset; what was answered."""
    call = board.session.call
    provision(board, bank, Settings(level_ma=11, start=False, level_limit_ma=40, duty_limit=0.75))
    answers = [board.info.minor, board.verify(bank)]
    board.set_watchdog(requests.Watchdog.IDLE, 60_000)
    answers += [board.save().slot, board.recall().slot]
    board.start()
    board.stop()
    answers.append(board.wait_dark().level_limit_ma)
    board.blank()
    board.test_leds(0, 1, 1)
    board.wait_dark()
    with pytest.raises(RefusedError) as refused:
        board.set_level(41)
    answers.append((refused.value.status, refused.value.detail))
    spare = 1 - board.status().active_bank
    answers.append(call(requests.StreamRequest(spare, requests.Format.WORDS, bank.digest)).slots)
    push = call(requests.PushRequest(spare, 0, 0, 0, bank.content[:64]))
    state = call(requests.UpdateStatusRequest())
    answers += [
        (push.number, push.offset, push.begun),
        (state.running, state.next, state.target.rstrip(b"\0")),
    ]
    call(requests.UpdateBeginRequest(state.next, len(update), zlib.crc32(update)))
    answers += [
        call(requests.UpdateWriteRequest(0, update)).count,
        call(requests.UpdateCommitRequest()).sequence,
    ]
    call(requests.UpdateConfirmRequest())
    call(requests.UpdateRestartRequest())
    return answers


def test_this_host_and_the_firmware_of_2_0(monkeypatch):
    monkeypatch.setattr(session, "MINOR", 1)  # what the host said that was recorded
    line = ReplayTransport(VECTORS / "board-2.0.jsonl")
    board = Board(Session(line, Timing(latency_s=2.0), first=line.first, nonce=line.nonce))
    assert board.session.client.minor == 0
    bank = some_bank(1, 1, board_link("air.frames_per_packet=4"))
    with pytest.raises(IncompatibleError, match=r"START with at_pulse is not in its protocol 2\.0"):
        board.start(at_pulse=5)
    answers = [0, 0, 0, 0, 40, (3, 40), 320, (0, 64, 0), (0, 1, b"native"), 200, 1]
    assert every_request(board, bank, bytes(range(200))) == answers
    assert not line._events
    # a fault of a later firmware has a number
    assert flag_names(requests.BoardFault, 1 | 1 << 15) == ["over_temperature", "bit 0x8000"]


def test_the_host_of_2_0_and_this_firmware():
    """It is answered as by its own firmware, as far as an answer does not tell the time."""
    device = SimulatedBoard((7).to_bytes(12, "big"))
    expected, wire, seen = b"", b"", set()
    for line in (VECTORS / "host-2.0.jsonl").read_text().splitlines()[1:]:
        event = json.loads(line)
        if event["dir"] == "rx":
            expected += bytes.fromhex(event["hex"])
            continue
        device.receive(bytes.fromhex(event["hex"]))
        for _ in range(40):
            device.run(1_000)
            wire += device.take_output()
    theirs, ours = (DatagramDecoder().feed(whole) for whole in (expected, wire))
    assert len(theirs) == len(ours) > 30
    for old, new in zip(theirs, ours, strict=True):
        head = (old.type, old.status, old.sequence, old.session)
        assert (new.type, new.status, new.sequence, new.session) == head
        seen.add(old.type & ~requests.REPLY_BIT)
        assert len(new.payload) >= len(old.payload)
        if old.type & ~requests.REPLY_BIT not in (requests.Type.HELLO, requests.Type.STATUS):
            assert new.payload[: len(old.payload)] == old.payload
    assert seen == {t["type"] for t in MESSAGES if t["minor"] == 0}
