"""Boards with a key: what is not sealed, sealed wrongly or played back does nothing."""

import contextlib
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_lines import Native, NoisyLine
from hypothesis import given, settings, strategies as st

from evlcp_sdk.link.resolve import load_link
from firmware_host.board.bank import bank_of, random_symbols
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

pytestmark = pytest.mark.usefixtures("compiler")

KEY = bytes(range(1, 17))
OTHER = bytes(range(2, 18))
LINK = load_link()
BANK = bank_of(random_symbols(2, 10, LINK.codebook, np.random.default_rng(0)), LINK)
ANOTHER = bank_of(random_symbols(1, 10, LINK.codebook, np.random.default_rng(2)), LINK)


class Recorded(SimulatedLine):
    """Keeps what the host has sent."""

    def __init__(self, board: SimulatedBoard) -> None:
        super().__init__(board)
        self.wire = b""

    def to_board(self, data: bytes) -> bytes:
        self.wire += data
        return data


def board_on(line: SimulatedLine, key: bytes | None = None) -> Board:
    return Board(Session(line, Timing(latency_s=0.02), key=key))


def locked(device: SimulatedBoard, key: bytes = KEY) -> Board:
    board = board_on(SimulatedLine(device))
    board.set_key(key)
    return board


def status_of(device: SimulatedBoard) -> StatusReply:
    return board_on(SimulatedLine(device)).status()


def test_a_locked_board_does_all_with_its_key_and_nothing_without() -> None:
    device = SimulatedBoard()
    board = locked(device)
    assert board.about.key_name == hashlib.sha256(KEY).digest()[:4]
    assert provision(board, BANK, Settings(level_ma=15)).swapped
    assert board.verify(BANK) == 0
    with board.stream(LINK) as stream:
        stream.send(random_symbols(1, 10, LINK.codebook, np.random.default_rng(1))[0])
    provision(board, BANK, Settings(start=False))
    board.start()
    stranger = board_on(SimulatedLine(device))
    before = stranger.status()
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
        lambda: stranger.program(
            bank_of(random_symbols(1, 10, LINK.codebook, np.random.default_rng(2)), LINK)
        ),
    ):
        with pytest.raises(RefusedError, match="it has a key: give it with --key") as told:
            refused()
        assert told.value.status == Status.NEEDS_KEY
    after = stranger.status()
    assert (after.state, after.level_ma, after.commits, after.watchdog) == (
        before.state,
        15,
        before.commits,
        before.watchdog,
    )
    with pytest.raises(RefusedError, match=r"has the key .*, this host's is"):
        board_on(SimulatedLine(device), OTHER)
    again = board_on(SimulatedLine(device), KEY)
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


def test_any_bit_that_is_changed_is_found() -> None:
    device = SimulatedBoard()
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
    board = board_on(line, key)
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
    board_on(SimulatedLine(device), KEY).level(40)
    # in a later session, with the HELLO of the recorded one, and after a reset
    for _ in range(2):
        before = status_of(device)
        seen = replayed(device, wire)
        assert Status.BAD_SEAL in seen
        assert not device.shown().any()
        after = status_of(device)
        assert (after.level_ma, after.commits, after.packets_sent) == (
            before.level_ma,
            before.commits,
            before.packets_sent,
        )
        device.reset()
    # in the same session: nothing is done twice
    line = Recorded(device)
    board = board_on(line, KEY)
    board.level(11)
    first = line.wire
    board.level(44)
    replayed(device, first[first.index(b"\0", 1) + 1 :])
    assert device.level_ma() == 44


def test_nor_when_the_numbers_of_a_session_wrap() -> None:
    device = SimulatedBoard()
    locked(device)
    line = Recorded(device)
    board = board_on(line, KEY)
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


def test_who_has_no_key_does_not_stand_in_for_the_host() -> None:
    device = SimulatedBoard()
    board = locked(device)
    provision(board, BANK, Settings(watchdog=Watchdog.DARK, watchdog_ms=500))
    stranger = board_on(SimulatedLine(device))
    for _ in range(20):
        stranger.status()
        device.run(50_000)
    assert not device.shown().any(), "the watchdog acts though a stranger asks"
    assert stranger.status().state == State.DARK


def test_a_monitor_without_the_key_says_that_the_watchdog_acts() -> None:
    def kinds(device: SimulatedBoard, key: bytes | None) -> list[type]:
        def opened() -> Any:
            return contextlib.nullcontext(board_on(SimulatedLine(device), key))

        return [type(seen) for seen in watch(opened, 0.01, count=2)]

    device = SimulatedBoard()
    board_on(SimulatedLine(device)).watchdog(Watchdog.DARK, 1000)
    assert kinds(device, None) == [StatusReply] * 2
    locked(device)
    assert kinds(device, KEY) == [StatusReply] * 2
    assert kinds(device, None) == [Unheard, *[StatusReply] * 2]
    board_on(SimulatedLine(device), KEY).watchdog(Watchdog.KEEP, 0)
    assert kinds(device, None) == [StatusReply] * 2


def test_a_key_is_kept_and_changed() -> None:
    device = SimulatedBoard()
    board = locked(device)
    device.reset()
    assert not any(board_on(SimulatedLine(device)).about.key_name), "not saved"
    board = locked(device)
    provision(board, BANK, Settings(start=False))
    board.save()
    device.reset()
    board = board_on(SimulatedLine(device), KEY)
    assert any(board.about.key_name)
    board.set_key(OTHER)
    board.recall()
    with pytest.raises(RefusedError):
        board_on(SimulatedLine(device), KEY)
    board = board_on(SimulatedLine(device), OTHER)
    board.save()
    device.reset()
    board = board_on(SimulatedLine(device), OTHER)
    # the newest slot's content is damaged: an older one plays, with the newest key all the same
    held = bytearray(device.flash())
    held[len(held) // 2 + 200] ^= 0x10
    device.set_flash(bytes(held))
    device.reset()
    board = board_on(SimulatedLine(device), OTHER)
    assert board.recall().slot == 0
    board.level(33)
    board.set_key(None)
    board_on(SimulatedLine(device)).level(34)
    assert device.level_ma() == 34


@pytest.mark.parametrize("seed", range(2))
def test_a_noisy_line_with_a_key(seed: int) -> None:
    device = SimulatedBoard()
    line = NoisyLine(device, 5e-4, 0.02, 0.03, seed)
    board = Board(Session(line, Timing(latency_s=0.004), tries=12))
    board.set_key(KEY)
    for level in range(40):
        board.session.call(LevelRequest(level))
        assert device.level_ma() == level
        assert board.session.call(StatusRequest()).level_ma == level
    board.session.call(BlankRequest())
    assert board.session.client.retries


# -- command line


def test_a_key_is_its_owners_alone(evlcp: Callable[..., Any], tmp_path: Path) -> None:
    file = tmp_path / "bar.key"
    made = evlcp("board", "keygen", file)
    assert (made.code, file.stat().st_mode & 0o777) == (0, 0o600)
    name = hashlib.sha256(bytes.fromhex(file.read_text())).hexdigest()[:8]
    assert made.out == f"{name}\n"
    again = evlcp("board", "keygen", file)
    assert again.code == 1
    assert "a key is not overwritten" in again.err
    assert evlcp("board", "keygen", file, "--show", "--json").out == json.dumps({"key": name}) + "\n"
    file.chmod(0o644)
    for command in (("keygen", file, "--show"), ("lock", file, "--port", "native:")):
        refused = evlcp("board", *command)
        assert refused.code == 3
        assert "mode 0644, expected a private key that its owner alone can use: chmod 600" in refused.err
    for text in ("", "00" * 16, "ab" * 15, "zz" * 16, "\udcff"):
        file.chmod(0o600)
        file.write_bytes(text.encode("utf-8", "surrogateescape"))
        wrong = evlcp("board", "--key", file, "--port", "native:", "hello")
        assert wrong.code == 3
        assert "expected 32 hex digits" in wrong.err
        assert wrong.err.count("\n") == 1


def test_tx_keygen_shows_a_public_key_again(evlcp: Callable[..., Any], tmp_path: Path) -> None:
    pytest.importorskip("cryptography", reason="the extra sign is not installed")
    made = evlcp("tx", "keygen", tmp_path / "private.pem").out
    assert evlcp("tx", "keygen", tmp_path / "private.pem", "--show").out == made


def test_locked_from_the_command_line(
    evlcp: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    port, file, other = f"unix:{tmp_path / 'board'}", tmp_path / "bar.key", tmp_path / "other.key"
    name, _ = make_board_key(file), make_board_key(other)
    emulated = Native(port, flash=tmp_path / "f.bin")

    def board(*arguments: object) -> Any:
        return evlcp("board", *map(str, arguments), "--port", port)

    assert json.loads(board("hello", "--json").out)["key"] is None
    assert board("lock", file).out == f"locked with key {name}; 'evlcp board save' keeps it over a reset\n"
    assert json.loads(board("hello", "--json").out)["key"] == name
    assert board("status").code == 0
    refused = board("program", "--random", 1)
    assert refused.code == 5
    assert "it has a key: give it with --key" in refused.err
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


def test_the_image_of_the_part_seals(needs: Callable[..., None]) -> None:
    """On the model of the STM32F405: its random numbers, its HMAC, a session played back."""
    needs("cc", "make", "arm-none-eabi-gcc")
    pytest.importorskip("unicorn", reason="unicorn missing: pip install --group dev installs it")
    from firmware_host import build
    from tests.models.stm32 import ModelLine, Stm32

    chip = Stm32(build.arm_image("stm32f405"))
    chip.run(15_000)
    board = Board(Session(ModelLine(chip), Timing(latency_s=0.02)))
    challenges = {board.about.challenge}
    board.set_key(KEY)
    challenges.add(board.about.challenge)
    board.level(31)
    stranger = Board(Session(ModelLine(chip), Timing(latency_s=0.02)))
    challenges.add(stranger.about.challenge)
    with pytest.raises(RefusedError):
        stranger.level(32)
    assert stranger.status().level_ma == 31
    assert len(challenges) == 3
