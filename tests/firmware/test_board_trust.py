"""Boards with a key: what is not sealed, sealed wrongly or played back does nothing."""

import contextlib
import hashlib
import json

import pytest
from board_lines import LINK, Native, board_on, check_fault, recording, some_bank, symbols_of
from hypothesis import given, settings, strategies as st

from firmware_host.board.board import Settings, provision
from firmware_host.board.keys import make_board_key
from firmware_host.board.monitor import KeyMissing, watch_board
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import RefusedError
from firmware_host.protocol.datagram import Datagram, DatagramDecoder
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.requests import State, Status, StatusReply, Watchdog

KEY = bytes(range(1, 17))
OTHER = bytes(range(2, 18))
BANK = some_bank(2)


def lock(device, key=KEY):
    board = board_on(device)
    board.set_key(key)
    return board


def held_state(device):
    """What a request that is refused leaves as it is."""
    status = board_on(device).status()
    return (status.state, status.level_ma, status.commits, status.watchdog)


def test_a_locked_board_does_all_with_its_key_and_nothing_without(device):
    board = lock(device)
    assert board.info.key_name == hashlib.sha256(KEY).digest()[:4]
    assert provision(board, BANK, Settings(level_ma=15)).swapped
    assert board.verify(BANK) == 0
    with board.stream(LINK) as stream:
        stream.send(symbols_of(1, 1)[0])
    provision(board, BANK, Settings(start=False))
    board.start()
    before = held_state(device)
    assert before[1] == 15
    stranger = board_on(device)
    assert stranger.read_crc(0, 0, 100) >= 0
    assert len(stranger.read_bank(0, 0, 100)) == 100
    for refused in (
        stranger.stop,
        stranger.blank,
        stranger.start,
        lambda: stranger.set_level(1),
        lambda: stranger.set_watchdog(Watchdog.DARK, 100),
        lambda: stranger.set_key(None),
        stranger.save,
        stranger.recall,
        lambda: stranger.session.call(protocol.WriteRequest(1, 0, b"x")),
        lambda: stranger.session.call(protocol.UpdateWriteRequest(0, b"1234")),
        lambda: stranger.program(some_bank(1, 2)),
    ):
        with pytest.raises(RefusedError, match="it has a key: give it with --key") as caught:
            refused()
        assert caught.value.status == Status.NEEDS_KEY
    assert held_state(device) == before
    with pytest.raises(RefusedError, match=r"has the key .*, this host's is"):
        board_on(device, key=OTHER)
    again = board_on(device, key=KEY)
    again.stop()
    assert again.wait_dark().state == State.DARK


@given(st.integers(0, 490), st.binary(min_size=16, max_size=16).filter(any))
@settings(max_examples=40, deadline=None)
def test_seals_are_hmac_sha256_of_any_length(count, key):
    """The firmware's HMAC against hashlib's, over every length of a block."""
    board = lock(SimulatedBoard(), key)
    count = min(count, board.session.max_payload - protocol.WriteRequest.min_bytes())
    data = bytes(n % 251 for n in range(count))
    written = board.session.call(protocol.WriteRequest(1, 7, data))
    assert written == protocol.WriteReply(1, 7, count)
    assert not count or board.read_bank(1, 7, count) == data


def test_any_bit_that_is_changed_is_found(device):
    board = lock(device)
    line, client = SimulatedLine(device), board.session.client
    client.submit(protocol.LevelRequest(33))
    wire = client.poll(0.0)[0]
    client.drop_requests()
    good = Datagram.decode(wire[:-1])
    body = bytes([good.type, good.status]) + good.sequence.to_bytes(2, "little") + good.payload
    answers = set()
    for bit in range(8 * len(body)):
        b = bytearray(body)
        b[bit // 8] ^= 1 << bit % 8
        if b[0] & protocol.REPLY_BIT:
            continue
        bad = Datagram(b[0], b[1], int.from_bytes(b[2:4], "little"), good.session, bytes(b[4:]))
        answers |= set(replay_datagrams(line, bad.encode()))
        assert device.bench.level_ma == 20
    # a sequence of another number, a type of another length or none at all: never done
    assert answers <= {Status.BAD_SEAL, Status.NEEDS_KEY, Status.UNKNOWN_TYPE, Status.BAD_LENGTH}
    assert replay_datagrams(line, wire) == [Status.OK]
    assert device.bench.level_ma == 33


def replay_datagrams(line, wire):
    """Statuses of the answers to bytes that are played back, one datagram after the other."""
    found = []
    for part in wire.rstrip(b"\0").split(b"\0"):
        line.write(part + b"\0")
        found += [reply.status for reply in DatagramDecoder().feed(line.read(0.02))]
    return found


def session_of(device, key):
    """What a host sends that sets a level, programs, starts and stops."""
    line = recording(device)
    board = board_on(line, key=key)
    provision(board, BANK, Settings(level_ma=15))
    board.stop()
    board.wait_dark()
    return line.written


def test_what_was_recorded_works_again_on_a_board_without_a_key_and_not_on_one_with():
    plain = SimulatedBoard()
    wire = session_of(plain, None)
    plain.reset()
    assert set(replay_datagrams(SimulatedLine(plain), wire)) >= {Status.OK}
    assert plain.bench.level_ma == 15, "the attack that a key is against"

    device = SimulatedBoard()
    board = lock(device)
    provision(board, BANK, Settings(start=False))
    board.save()
    wire = session_of(device, KEY)
    board_on(device, key=KEY).set_level(40)
    # in a later session, with the HELLO of the recorded one, and after a reset
    for _ in range(2):
        before = held_state(device)
        assert Status.BAD_SEAL in replay_datagrams(SimulatedLine(device), wire)
        assert not any(device.bench.shown)
        assert held_state(device) == before
        device.reset()


@pytest.mark.parametrize("wraps", [False, True])
def test_nor_is_anything_done_twice_in_a_session(device, wraps):
    """Not even when the numbers of its requests wrap."""
    lock(device)
    line = recording(device)
    board = board_on(line, key=KEY)
    line.written = b""
    board.set_level(11)
    first = line.written
    board.set_level(44)
    if wraps:
        client = board.session.client
        for _ in range(4):
            # as if so many requests had been sent in between
            client._tokens += 0x3FFF
            board.status()
        client._tokens = client._tokens // 65536 * 65536
    assert replay_datagrams(SimulatedLine(device), first) == [Status.BAD_SEAL if wraps else Status.STALE]
    assert device.bench.level_ma == 44


def test_who_has_no_key_does_not_stand_in_for_the_host(device):
    board = lock(device)
    provision(board, BANK, Settings(watchdog="dark", watchdog_ms=500))
    stranger = board_on(device)
    for _ in range(20):
        stranger.status()
        device.run(50_000)
    assert not any(device.bench.shown), "the watchdog acts though a stranger asks"
    assert stranger.status().state == State.DARK


def test_a_monitor_without_the_key_says_that_the_watchdog_acts(device):
    def kinds(key):
        def opened():
            return contextlib.nullcontext(board_on(device, key=key))

        return [type(seen) for seen in watch_board(opened, 0.01, count=2)]

    board_on(device).set_watchdog(Watchdog.DARK, 1000)
    assert kinds(None) == [StatusReply] * 2
    lock(device)
    assert kinds(KEY) == [StatusReply] * 2
    assert kinds(None) == [KeyMissing, *[StatusReply] * 2]
    board_on(device, key=KEY).set_watchdog(Watchdog.KEEP, 0)
    assert kinds(None) == [StatusReply] * 2


def test_a_key_is_kept_and_changed(device):
    board = lock(device)
    device.reset()
    assert not any(board_on(device).info.key_name), "not saved"
    board = lock(device)
    provision(board, BANK, Settings(start=False))
    board.save()
    device.reset()
    board = board_on(device, key=KEY)
    assert any(board.info.key_name)
    board.set_key(OTHER)
    board.recall()
    with pytest.raises(RefusedError):
        board_on(device, key=KEY)
    board_on(device, key=OTHER).save()
    # the newest slot's content is damaged: an older one plays, with the newest key all the same
    flash = bytearray(device.read_flash())
    flash[len(flash) // 2 + 200] ^= 0x10
    device.replace_flash(bytes(flash))
    board = board_on(device, key=OTHER)
    assert board.recall().slot == 0
    board.set_level(33)
    board.set_key(None)
    board_on(device).set_level(34)
    assert device.bench.level_ma == 34


# -- command line


def test_a_key_is_its_owners_alone(evlcp, tmp_path):
    file = tmp_path / "bar.key"
    made = evlcp("board", "keygen", file)
    assert (made.code, file.stat().st_mode & 0o777) == (0, 0o600)
    name = hashlib.sha256(bytes.fromhex(file.read_text())).hexdigest()[:8]
    assert made.out == f"{name}\n"
    check_fault(evlcp("board", "keygen", file), 1, "a key is not overwritten")
    assert evlcp("board", "keygen", file, "--show", "--json").out == json.dumps({"key": name}) + "\n"
    file.chmod(0o644)
    for command in (("keygen", file, "--show"), ("lock", file, "--port", "native:")):
        message = "mode 0644, expected a private key that its owner alone can use: chmod 600"
        check_fault(evlcp("board", *command), 3, message)
    file.chmod(0o600)
    for text in (b"", b"00" * 16, b"ab" * 15, b"zz" * 16, b"\xff"):
        file.write_bytes(text)
        check_fault(evlcp("board", "--key", file, "--port", "native:", "hello"), 3, "expected 32 hex digits")


def test_locked_from_the_command_line(evlcp, monkeypatch, tmp_path):
    port, file, other = f"unix:{tmp_path / 'board'}", tmp_path / "bar.key", tmp_path / "other.key"
    name, _ = make_board_key(file), make_board_key(other)
    emulated = Native(port, flash=tmp_path / "f.bin")

    def board(*arguments):
        return evlcp("board", *arguments, "--port", port)

    def key():
        return json.loads(board("hello", "--json").out)["key"]

    assert key() is None
    assert board("lock", file).out == f"locked with key {name}; 'evlcp board save' keeps it over a reset\n"
    assert key() == name
    assert board("status").code == 0
    check_fault(board("program", "--random", 1), 5, "it has a key: give it with --key")
    assert board("level", 10, "--key", other).code == 5
    assert board("program", "--random", 1, "--no-start", "--key", file).code == 0
    assert board("save", "--key", file).code == 0
    assert evlcp("tx", "message", "--text", "hi", "--port", port, "--board-key", file).code == 0
    (tmp_path / "one.toml").write_text(
        f'[[board]]\nid = "a"\nport = "{port}"\nposition_m = [0, 0, 0]\nrandom = 1\nboard_key = "bar.key"\n'
    )
    for command in ("program", "blank", "save"):
        assert evlcp("board", command, "--inventory", tmp_path / "one.toml").code == 0
    monkeypatch.setenv("EVLCP_BOARD_KEY", str(file))
    assert board("start").code == 0
    emulated.end()
    emulated = Native(port, flash=tmp_path / "f.bin")
    assert key() == name
    assert board("lock", other).code == 0
    assert board("unlock", "--key", other).code == 0
    monkeypatch.delenv("EVLCP_BOARD_KEY")
    assert board("level", 9).code == 0
    emulated.end()


def test_the_image_of_the_part_seals(stm32):
    """On the model of the STM32F405: its random numbers, its HMAC, a stranger."""
    from tests.models.stm32 import connect

    chip, board = stm32()
    challenges = {board.info.challenge}
    board.set_key(KEY)
    challenges.add(board.info.challenge)
    board.set_level(31)
    stranger = connect(chip)
    challenges.add(stranger.info.challenge)
    with pytest.raises(RefusedError):
        stranger.set_level(32)
    assert stranger.status().level_ma == 31
    assert len(challenges) == 3
