"""Host and firmware together in virtual time: programming, swaps, noise, dying hosts, resets."""

import numpy as np
import pytest
from board_lines import (
    LINK,
    FatalLine,
    NoisyLine,
    board_link,
    board_on,
    check_order,
    deafen,
    packet_sequence,
    recording,
    some_bank,
    state_of,
    symbols_of,
)

from firmware_host.board.bank import make_bank
from firmware_host.board.board import Settings, provision
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import BoardResetError, IncompatibleError, NoBoardError, RefusedError
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.requests import MAJOR, MINOR, BoardFault, State, Watchdog


def test_what_is_there_is_not_sent_again(board):
    symbols = symbols_of(64)
    payload, half = make_bank(symbols, LINK), make_bank(symbols[:32], LINK)
    seen = []
    done = board.program(payload, progress=lambda a, b: seen.append((a, b)))
    assert (done.written, done.length, done.swapped, done.bank) == (20480, 20480, True, 0)
    assert (seen[0], seen[-1]) == ((0, 20480), (20480, 20480))
    assert seen == sorted(seen)
    again = board.program(payload)
    assert (again.written, again.swapped) == (0, False)
    assert not board.is_active_bank(make_bank(symbols, LINK.with_air(pilot_every=4)), board.status())
    assert board.program(half).bank == 1
    # bank 0 still holds the first payload: only the commit is needed
    back = board.program(payload)
    assert (back.written, back.swapped, back.bank) == (0, True, 0)
    symbols[40, 3, 5] ^= 1
    board.program(half)
    assert board.program(make_bank(symbols, LINK)).written == 2048


def test_hitless_swaps(device, board):
    payloads = {f"p{n}": symbols_of(1 + n % 4, 100 + n) for n in range(12)}
    for n, symbols in enumerate(payloads.values()):
        provision(board, make_bank(symbols, LINK), Settings())
        device.run(int(np.random.default_rng(n).integers(200_000, 500_000)))
    played = device.take_led_record().select_chips()
    assert (np.diff(played.ticks) == 1000).all(), "a chip was lost or late"
    assert (played.numbers == np.arange(len(played))).all()
    sequence = packet_sequence(played, payloads)
    assert len(sequence) > 80
    assert check_order(sequence, {n: len(s) for n, s in payloads.items()}) == list(payloads)


def test_programming_over_a_very_noisy_line(device):
    board = board_on(NoisyLine(device, flips=2e-3, drops=0.01, doubles=0.01, seed=5))
    symbols = symbols_of(64, 6)
    payload = make_bank(symbols, LINK)
    assert provision(board, payload, Settings()).retries > 20
    device.run(3_000_000)
    assert board.read_crc(0, 0, len(payload.content)) == payload.crc
    sequence = packet_sequence(device.take_led_record().select_chips(), {"new": symbols})
    assert check_order(sequence, {"new": 64}) == ["new"]
    assert len(sequence) > 64


OLD = symbols_of(2, 1)


def playing():
    """A board that plays OLD."""
    device = SimulatedBoard()
    provision(board_on(device), make_bank(OLD, LINK), Settings())
    device.run(50_000)
    return device


def test_host_killed_at_any_moment():
    def dies(_):
        raise KeyboardInterrupt

    new = symbols_of(24, 2)
    bank = make_bank(new, LINK)
    line = recording(playing())
    provision(board_on(line, nonce=7), bank, Settings())
    total = len(line.written)
    random = np.random.default_rng(7)
    # the commit and the wait for it are the last bytes: half of the moments lie there
    moments = [*random.integers(1, total, 8), *random.integers(total - 320, total, 10)]
    ends = {"old": 0, "new": 0}
    for moment in moments:
        device = playing()
        with pytest.raises(KeyboardInterrupt):
            provision(board_on(FatalLine(device, int(moment), dies), nonce=7), bank, Settings())
        device.run(400_000)
        sequence = packet_sequence(device.take_led_record().select_chips(), {"old": OLD, "new": new})
        order = check_order(sequence, {"old": 2, "new": 24})
        assert order in (["old"], ["old", "new"])
        ends[order[-1]] += 1
        # the next host finishes the work
        board = board_on(device)
        assert provision(board, bank, Settings()).swapped == (order[-1] == "old")
        assert board.is_active_bank(bank, board.status())
    assert min(ends.values()) > 1


def test_silence_is_reported(device):
    line = SimulatedLine(device)
    deafen(line)
    with pytest.raises(NoBoardError, match="no board answers; check power, cable and --baud"):
        board_on(line)


@pytest.mark.parametrize(("major", "older"), [(MAJOR - 1, "host"), (MAJOR + 1, "firmware")])
def test_another_major_version_is_incompatible(device, monkeypatch, major, older):
    monkeypatch.setattr("firmware_host.board.session.MAJOR", major)
    words = rf"it speaks protocol {MAJOR}\.{MINOR}, this host .*; update the {older}"
    with pytest.raises(IncompatibleError, match=words):
        board_on(device)


def test_save_survives_reset_and_damage(device, board):
    other = board_link(
        "modulation.id=ppm", "separation.id=edges", "decoding.id=edges", "air.chip_rate_hz=5000.0"
    )
    first, second = some_bank(1, 1), some_bank(2, 2, other)
    assert (first.format, second.format) == (protocol.Format.WORDS, protocol.Format.CLUSTERS)
    for bank in (first, second):
        provision(board, bank, Settings(level_ma=33, watchdog="idle", watchdog_ms=700, start=False))
        board.save()
    device.reset()
    board = board_on(device)
    assert board.recall().slot == 1
    status = board.status()
    assert board.is_active_bank(second, status)
    assert not board.program(second).written
    assert (status.level_ma, status.watchdog, status.watchdog_ms) == (33, Watchdog.IDLE, 700)
    held = bytearray(device.read_flash())
    held[len(held) // 2 + 200] ^= 0x10
    device.replace_flash(bytes(held))
    board = board_on(device)
    assert board.recall().slot == 0
    assert board.is_active_bank(first, board.status())
    board.save(autostart=True)
    device.reset()
    device.take_led_record()
    device.run(100_000)
    assert (device.take_led_record().select_chips().chips()[:346] == first.chips).all()
    device.bench.flash_fails = True
    board = board_on(device)
    board.blank()
    with pytest.raises(RefusedError, match="flash"):
        board.save()


def test_faults_show_and_darken_and_end_the_led_test(device, board):
    provision(board, some_bank(), Settings())
    health = device.bench.health
    health.temperature_dc, health.faults, health.open_leds[-1] = 300, BoardFault.OPEN_LED, 1
    device.run(300_000)
    status = board.status()
    assert (status.temperature_dc, status.faults, status.open_leds[-1]) == (300, BoardFault.OPEN_LED, 1)
    # the fault that comes back ends the test, though it was latched before
    for tested in (False, True):
        health.faults = BoardFault.OVER_TEMPERATURE
        device.run(300_000)
        assert board.status().state == State.FAULT
        assert not any(device.bench.shown)
        with pytest.raises(RefusedError, match="a fault holds the LEDs dark"):
            board.start()
        health.faults = 0
        device.run(300_000)
        assert tested or state_of(board) == (State.FAULT, BoardFault.OVER_TEMPERATURE), "until START"
        if not tested:
            board.test_leds(0, 95, 1000)
            assert any(device.bench.shown)
    board.start()
    device.run(10_000)
    assert state_of(board) == (State.PLAYING, 0)


def test_board_reset_at_any_moment():
    bank, line, reported = some_bank(12, 2), recording(playing()), []
    provision(board_on(line, nonce=7), bank, Settings())
    for moment in np.random.default_rng(8).integers(1, len(line.written), 14):
        device = playing()
        line = FatalLine(device, int(moment), lambda line: line.board.reset())
        try:
            provision(board_on(line, nonce=7), bank, Settings())
        except BoardResetError as fault:
            reported.append(str(fault))
        board = board_on(device)
        if board.status().state == State.PLAYING:
            assert board.is_active_bank(bank, board.status())
        provision(board, bank, Settings())
        assert board.is_active_bank(bank, board.status())
        assert board.status().state == State.PLAYING
    # a reset before HELLO arrives, or after the last request, goes unnoticed by right
    assert len(reported) > 9
    assert all("was reset" in words and "run the command again" in words for words in reported)
