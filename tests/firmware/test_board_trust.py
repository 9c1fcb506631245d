"""Boards with a key: what is not sealed, sealed wrongly or played back does nothing."""

import contextlib
import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from board_lines import LINK, Native, NoisyLine, board_on, check_fault, some_bank, symbols_of
from hypothesis import given, settings, strategies as st

from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.keys import make_board_key, read_board_key
from firmware_host.board.monitor import Unheard, watch
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import RefusedError
from firmware_host.protocol.client import Timing
from firmware_host.protocol.datagram import Datagram, DatagramDecoder
from firmware_host.protocol.generated.requests import (
    REPLY_BIT,
    BlankRequest,
    LevelRequest,
    State,
    Status,
    StatusReply,
    StatusRequest,
    Watchdog,
    WriteReply,
    WriteRequest,
)
from tests.conftest import Run

KEY = bytes(range(1, 17))
OTHER = bytes(range(2, 18))
BANK = some_bank(2)


class Recorded(SimulatedLine):
    """Keeps what the host has sent."""

    def __init__(self, board: SimulatedBoard) -> None:
        super().__init__(board)
        self.wire = b""

    def to_board(self, data: bytes) -> bytes:
        self.wire += data
        return data


def host_of(device: SimulatedBoard, key: bytes | None = None) -> Board:
    return board_on(SimulatedLine(device), key=key)


def locked(device: SimulatedBoard, key: bytes = KEY) -> Board:
    board = host_of(device)
    board.set_key(key)
    return board


def state_of(device: SimulatedBoard) -> tuple[object, ...]:
    """What a request that is refused leaves as it is."""
    status = host_of(device).status()
    return (status.state, status.level_ma, status.commits, status.watchdog)


def test_a_locked_board_does_all_with_its_key_and_nothing_without(device: SimulatedBoard) -> None:
    board = locked(device)
    assert board.about.key_name == hashlib.sha256(KEY).digest()[:4]
    assert provision(board, BANK, Settings(level_ma=15)).swapped
    assert board.verify(BANK) == 0
    with board.stream(LINK) as stream:
        stream.send(symbols_of(1, 1)[0])
    provision(board, BANK, Settings(start=False))
    board.start()
    before = state_of(device)
    assert before[1] == 15
    stranger = host_of(device)
    assert stranger.crc(0, 0, 100) >= 0
    assert len(stranger.read(0, 0, 100)) == 100
    for refused in (
        stranger.stop,
        stranger.blank,
        stranger.start,
        lambda: stranger.level(1),
        lambda: stranger.watchdog(Watchdog.DARK, 100),
        lambda: stranger.set_key(None),
        lambda: stranger.save(),
        lambda: stranger.recall(),
        lambda: stranger.session.call(WriteRequest(1, 0, b"x")),
        lambda: stranger.program(some_bank(1, 2)),
    ):
        with pytest.raises(RefusedError, match="it has a key: give it with --key") as told:
            refused()
        assert told.value.status == Status.NEEDS_KEY
    assert state_of(device) == before
    with pytest.raises(RefusedError, match=r"has the key .*, this host's is"):
        host_of(device, OTHER)
    again = host_of(device, KEY)
    again.stop()
    assert again.wait_dark().state == State.DARK


@given(st.integers(0, 490), st.binary(min_size=16, max_size=16).filter(any))
@settings(max_examples=40, deadline=None)
def test_seals_are_hmac_sha256_of_any_length(count: int, key: bytes) -> None:
    """The firmware's HMAC against hashlib's, over every length of a block."""
    board = locked(SimulatedBoard(), key)
    count = min(count, board.session.max_payload - WriteRequest.fixed_bytes())
    data = bytes(n % 251 for n in range(count))
    assert board.session.call(WriteRequest(1, 7, data)) == WriteReply(1, 7, count)
    assert board.read(1, 7, count) == data if count else True


def test_any_bit_that_is_changed_is_found(device: SimulatedBoard) -> None:
    board = locked(device)
    line = board.session.transport
    assert isinstance(line, SimulatedLine)
    client = board.session.client
    client.submit(LevelRequest(33))
    wire = client.poll(0.0)[0]
    client.forget()
    good = Datagram.decode(wire[:-1])
    body = bytes([good.type, good.status]) + good.sequence.to_bytes(2, "little") + good.payload
    answers: set[int] = set()
    for bit in range(8 * len(body)):
        b = bytearray(body)
        b[bit // 8] ^= 1 << bit % 8
        if b[0] & REPLY_BIT:
            continue
        bad = Datagram(b[0], b[1], int.from_bytes(b[2:4], "little"), good.session, bytes(b[4:]))
        line.write(bad.encode())
        for reply in DatagramDecoder().feed(line.read(0.05)):
            answers.add(reply.status)
        assert device.level_ma() == 20
    # a sequence of another number, a type of another length or none at all: never done
    assert answers <= {Status.BAD_SEAL, Status.NEEDS_KEY, Status.UNKNOWN_TYPE, Status.BAD_LENGTH}
    line.write(wire)
    line.read(0.05)
    assert device.level_ma() == 33


def replayed(device: SimulatedBoard, wire: bytes) -> list[int]:
    """Statuses of the answers to bytes that are played back, one datagram after the other."""
    line = SimulatedLine(device)
    found = []
    for part in wire.split(b"\0"):
        line.write(part + b"\0")
        found += [reply.status for reply in DatagramDecoder().feed(line.read(0.02))]
    return found


def session_of(device: SimulatedBoard, key: bytes | None) -> bytes:
    """What a host sends that sets a level, programs, starts and stops."""
    line = Recorded(device)
    board = board_on(line, key=key)
    provision(board, BANK, Settings(level_ma=15))
    board.stop()
    board.wait_dark()
    return line.wire


def test_what_was_recorded_works_again_on_a_board_without_a_key_and_not_on_one_with() -> None:
    plain = SimulatedBoard()
    wire = session_of(plain, None)
    plain.reset()
    assert set(replayed(plain, wire)) >= {Status.OK}
    assert plain.level_ma() == 15, "the attack that a key is against"

    device = SimulatedBoard()
    board = locked(device)
    provision(board, BANK, Settings(start=False))
    board.save()
    wire = session_of(device, KEY)
    host_of(device, KEY).level(40)
    # in a later session, with the HELLO of the recorded one, and after a reset
    for _ in range(2):
        before = state_of(device)
        seen = replayed(device, wire)
        assert Status.BAD_SEAL in seen
        assert not device.shown().any()
        assert state_of(device) == before
        device.reset()
    # in the same session: nothing is done twice
    line = Recorded(device)
    board = board_on(line, key=KEY)
    board.level(11)
    first = line.wire
    board.level(44)
    replayed(device, first[first.index(b"\0", 1) + 1 :])
    assert device.level_ma() == 44


def test_nor_when_the_numbers_of_a_session_wrap(device: SimulatedBoard) -> None:
    locked(device)
    line = Recorded(device)
    board = board_on(line, key=KEY)
    line.wire = b""
    board.level(11)
    recorded = line.wire
    board.level(44)
    client = board.session.client
    for _ in range(4):
        # as if so many requests had been sent in between
        client._tokens += 0x3FFF
        board.status()
    client._tokens = client._tokens // 65536 * 65536
    assert replayed(device, recorded) == [Status.BAD_SEAL]
    assert device.level_ma() == 44


def test_who_has_no_key_does_not_stand_in_for_the_host(device: SimulatedBoard) -> None:
    board = locked(device)
    provision(board, BANK, Settings(watchdog=Watchdog.DARK, watchdog_ms=500))
    stranger = host_of(device)
    for _ in range(20):
        stranger.status()
        device.run(50_000)
    assert not device.shown().any(), "the watchdog acts though a stranger asks"
    assert stranger.status().state == State.DARK


def test_a_monitor_without_the_key_says_that_the_watchdog_acts() -> None:
    def kinds(device: SimulatedBoard, key: bytes | None) -> list[type]:
        def opened() -> Any:
            return contextlib.nullcontext(host_of(device, key))

        return [type(seen) for seen in watch(opened, 0.01, count=2)]

    device = SimulatedBoard()
    host_of(device).watchdog(Watchdog.DARK, 1000)
    assert kinds(device, None) == [StatusReply] * 2
    locked(device)
    assert kinds(device, KEY) == [StatusReply] * 2
    assert kinds(device, None) == [Unheard, *[StatusReply] * 2]
    host_of(device, KEY).watchdog(Watchdog.KEEP, 0)
    assert kinds(device, None) == [StatusReply] * 2


def test_a_key_is_kept_and_changed(device: SimulatedBoard) -> None:
    board = locked(device)
    device.reset()
    assert not any(host_of(device).about.key_name), "not saved"
    board = locked(device)
    provision(board, BANK, Settings(start=False))
    board.save()
    device.reset()
    board = host_of(device, KEY)
    assert any(board.about.key_name)
    board.set_key(OTHER)
    board.recall()
    with pytest.raises(RefusedError):
        host_of(device, KEY)
    board = host_of(device, OTHER)
    board.save()
    device.reset()
    board = host_of(device, OTHER)
    # the newest slot's content is damaged: an older one plays, with the newest key all the same
    held = bytearray(device.flash())
    held[len(held) // 2 + 200] ^= 0x10
    device.set_flash(bytes(held))
    device.reset()
    board = host_of(device, OTHER)
    assert board.recall().slot == 0
    board.level(33)
    board.set_key(None)
    host_of(device).level(34)
    assert device.level_ma() == 34


def test_a_noisy_line_with_a_key(device: SimulatedBoard) -> None:
    line = NoisyLine(device, 5e-4, 0.02, 0.03, seed=1)
    board = Board(Session(line, Timing(latency_s=0.004), first=1, nonce=1, tries=12))
    board.set_key(KEY)
    for level in range(40):
        board.session.call(LevelRequest(level))
        assert device.level_ma() == level
        assert board.session.call(StatusRequest()).level_ma == level
    board.session.call(BlankRequest())
    assert board.session.client.retries


# -- command line


def test_a_key_is_its_owners_alone(evlcp, tmp_path: Path) -> None:
    file = tmp_path / "bar.key"
    made = evlcp("board", "keygen", file)
    assert (made.code, file.stat().st_mode & 0o777) == (0, 0o600)
    name = hashlib.sha256(bytes.fromhex(file.read_text())).hexdigest()[:8]
    assert made.out == f"{name}\n"
    check_fault(evlcp("board", "keygen", file), 1, "a key is not overwritten")
    assert evlcp("board", "keygen", file, "--show", "--json").out == json.dumps({"key": name}) + "\n"
    file.chmod(0o644)
    for command in (("keygen", file, "--show"), ("lock", file, "--port", "native:")):
        says = "mode 0644, expected a private key that its owner alone can use: chmod 600"
        check_fault(evlcp("board", *command), 3, says)
    file.chmod(0o600)
    for text in (b"", b"00" * 16, b"ab" * 15, b"zz" * 16, b"\xff"):
        file.write_bytes(text)
        check_fault(evlcp("board", "--key", file, "--port", "native:", "hello"), 3, "expected 32 hex digits")


def test_locked_from_the_command_line(evlcp, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    port, file, other = f"unix:{tmp_path / 'board'}", tmp_path / "bar.key", tmp_path / "other.key"
    name, _ = make_board_key(file), make_board_key(other)
    emulated = Native(port, flash=tmp_path / "f.bin")

    def board(*arguments: object) -> Run:
        return evlcp("board", *arguments, "--port", port)

    assert json.loads(board("hello", "--json").out)["key"] is None
    assert board("lock", file).out == f"locked with key {name}; 'evlcp board save' keeps it over a reset\n"
    assert json.loads(board("hello", "--json").out)["key"] == name
    assert board("status").code == 0
    check_fault(board("program", "--random", 1), 5, "it has a key: give it with --key")
    assert board("level", 10, "--key", other).code == 5
    assert board("program", "--random", 1, "--no-start", "--key", file).code == 0
    assert board("save", "--key", file).code == 0
    assert evlcp("tx", "message", "--text", "hi", "--port", port, "--board-key", file).code == 0
    trace = tmp_path / "wire.jsonl"
    assert board("level", 12, "--key", file, "--trace", trace).code == 0
    assert evlcp("board", "level", 12, "--key", file, "--replay", trace).code == 0
    (tmp_path / "one.toml").write_text(
        f'[[board]]\nid = "a"\nport = "{port}"\nposition_m = [0, 0, 0]\nrandom = 1\nboard_key = "bar.key"\n'
    )
    for command in ("program", "blank", "save"):
        assert evlcp("board", command, "--inventory", tmp_path / "one.toml").code == 0
    monkeypatch.setenv("EVLCP_BOARD_KEY", str(file))
    assert board("start").code == 0
    emulated.end()
    emulated = Native(port, flash=tmp_path / "f.bin")
    assert json.loads(board("hello", "--json").out)["key"] == name
    assert board("lock", other).code == 0
    assert board("unlock", "--key", other).code == 0
    monkeypatch.delenv("EVLCP_BOARD_KEY")
    assert board("level", 9).code == 0
    assert read_board_key(file) != read_board_key(other)
    emulated.end()


def test_the_image_of_the_part_seals(stm32) -> None:
    """On the model of the STM32F405: its random numbers, its HMAC, a stranger."""
    from tests.models.stm32 import connect

    chip, board = stm32()
    challenges = {board.about.challenge}
    board.set_key(KEY)
    challenges.add(board.about.challenge)
    board.level(31)
    stranger = connect(chip)
    challenges.add(stranger.about.challenge)
    with pytest.raises(RefusedError):
        stranger.level(32)
    assert stranger.status().level_ma == 31
    assert len(challenges) == 3
