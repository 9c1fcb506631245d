"""Updates in the field: two images, trial, roll-back, power that fails at every step; one on the model."""

import contextlib
import ctypes
import json

import numpy as np
import pytest
from board_lines import FatalLine, NoisyLine, board_link, board_on, deafen, some_bank, state_of, symbols_of

from evlcp_sdk.errors import InputError
from firmware_host.board.bank import make_bank, symbol_chips
from firmware_host.board.board import Settings, provision
from firmware_host.board.update import UpdatePackage, confirm_update, update_firmware, update_status
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.errors import BoardError, IncompatibleError, LineError, RefusedError, VerifyError
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.requests import BoardFault, State, Status
from tests.models.usb import UsbLine


def package(seed, count=400):
    def some(seed):
        return np.random.default_rng(seed).integers(0, 256, count, np.uint8).tobytes()

    return UpdatePackage("native", {1: some(seed), 2: some(seed + 100)})


def image_of(device, image, count):
    """What stands in the place of image 1 or 2."""
    return ctypes.string_at(device.bench.images[image - 1], count)


def resets(device, count):
    """Which image runs after each of so many resets."""
    found = []
    for _ in range(count):
        device.reset()
        found.append(device.bench.running)
    return found


def test_updates_take_turns_and_run_after_every_reset(device, board):
    assert device.bench.running == 0
    assert update_status(board).next == 1
    for n, image in enumerate((1, 2, 1, 2), 1):
        reports = []
        new = package(n, 3_001)
        done = update_firmware(board, new, lambda at, total, reports=reports: reports.append((at, total)))
        assert (done.image, done.length, done.sequence) == (image, 3_001, n)
        assert reports[-1] == (3_001, 3_001)
        assert device.bench.running == image
        assert image_of(device, image, 3_001) == new.images[image]
        assert update_status(board).trial == 0
        assert resets(device, 4) == [image] * 4
        board = board_on(device)


def test_what_is_not_kept_is_left_at_the_third_reset(device, board):
    # without one before, back to the one that was flashed
    update_firmware(board, package(1), keep=False)
    assert resets(device, 3)[-1] == 0
    update_firmware(board_on(device), package(1))
    board = board_on(device)
    update_firmware(board, package(2), keep=False)
    assert update_status(board).trial == 1
    with pytest.raises(RefusedError, match="image 1 runs on trial; keep it first"):
        update_firmware(board, package(3))
    with pytest.raises(RefusedError, match="BUSY"):
        board.session.call(protocol.UpdateBeginRequest(update_status(board).next, 4, 0))
    assert resets(device, 4) == [1, 1, 2, 2]
    # and the place that it leaves takes the next one, which is confirmed by itself
    board = board_on(device)
    assert update_firmware(board, package(3), keep=False).image == 1
    confirm_update(board)
    assert resets(device, 5) == [1] * 5


@pytest.mark.parametrize("before", [0, 1])
def test_power_that_fails_at_every_step_leaves_one_of_the_two(before):
    """Words and erases of the flash, from the first of an update to its confirmation; the last ones all."""
    new = package(7)
    operations = 1 + 100 + 5 + 1 + 1  # erase, content, seal, try, confirmed
    ended = {"old": 0, "new": 0}
    moments = [*range(1, operations - 8, 6), *range(operations - 8, operations + 3)]
    for left in moments:
        device = SimulatedBoard()
        board = board_on(device)
        if before:
            update_firmware(board, package(1))
        old = device.bench.running
        device.bench.power_left, device.bench.power_fails = left, False
        with contextlib.suppress(BoardError):
            update_firmware(board, new, wait_s=0.5)
        device.bench.power_left, device.bench.power_fails = 0, False
        device.reset()
        place = 2 if before else 1
        if device.bench.running == place:
            ended["new"] += 1
            assert image_of(device, place, 400) == new.images[place]
        else:
            ended["old"] += 1
            assert device.bench.running == old
            if old:
                assert image_of(device, old, 400) == package(1).images[old]
        # the next run ends well, whatever was left
        board = board_on(device)
        if update_status(board).trial:
            confirm_update(board)
        done = update_firmware(board, package(9))
        assert image_of(device, done.image, 400) == package(9).images[done.image]
        device.reset()
        assert device.bench.running == done.image
    assert ended["new"] >= 2
    assert ended["old"] >= len(moments) - 6


def test_what_cannot_be_is_refused(device, board):
    with pytest.raises(IncompatibleError, match="is a native, the firmware is for stm32f405-8mhz"):
        update_firmware(board, UpdatePackage("stm32f405-8mhz", {1: b"1234", 2: b"1234"}))
    with pytest.raises(RefusedError, match="65473 bytes of firmware, an image may have 65472"):
        update_firmware(board, package(1, 65_473))
    begin, write = protocol.UpdateBeginRequest, protocol.UpdateWriteRequest
    for request, message in (
        (write(0, b"1234"), "NOTHING_COMMITTED"),
        (begin(2, 4, 0), "nearest value the board can take is 1"),
        (begin(1, 0, 0), "OUT_OF_RANGE"),
        (begin(1, 4, 5), None),
        (write(2, b"12"), "OUT_OF_RANGE"),
        (write(4, b"1"), "OUT_OF_RANGE"),
        (write(0, b"12345"), "OUT_OF_RANGE"),
        (write(8, b""), "OUT_OF_RANGE"),
        (write(0, b"1234"), None),
        (protocol.UpdateCommitRequest(), "BAD_CRC"),
    ):
        with pytest.raises(BoardError, match=message) if message else contextlib.nullcontext():
            board.session.call(request)
    assert resets(device, 1) == [0]
    board = board_on(device)
    provision(board, some_bank(), Settings())
    with pytest.raises(RefusedError, match="BUSY") as refused:
        update_firmware(board, package(1))
    assert refused.value.status == Status.BUSY
    assert board.status().state == State.PLAYING


def test_what_is_interrupted_keeps_the_old_one_and_ends_well_later(device):
    noisy = NoisyLine(device, flips=2e-4, drops=0.0, doubles=0.0, seed=3)
    assert (
        update_firmware(board_on(noisy, latency_s=0.01), package(4, 20_000)).image
        == device.bench.running
        == 1
    )
    assert noisy.counts["flipped"] > 2
    assert image_of(device, 1, 20_000) == package(4, 20_000).images[1]
    new = package(5, 20_000)
    with pytest.raises(LineError, match="was reset"):
        update_firmware(board_on(FatalLine(device, 3_000, lambda line: line.board.reset())), new)
    assert device.bench.running == 1
    with pytest.raises(LineError, match="it begins anew, and the board keeps the firmware that it runs"):
        update_firmware(board_on(FatalLine(device, 4_000, deafen), latency_s=0.01), new)
    board = board_on(device)
    assert (update_status(board).running, update_status(board).trial) == (1, 0)
    assert update_firmware(board, new).image == 2
    assert image_of(device, 2, 20_000) == new.images[2]


class SlowLine(UsbLine):
    """A line and a board that take two hundred times as long as they should."""

    def time_s(self):
        return 200 * super().time_s()

    def read(self, timeout_s):
        return super().read(timeout_s / 200)


def test_a_slow_board_is_waited_for(device):
    board = board_on(SlowLine(device, 0.0), latency_s=0.1)
    done = update_firmware(board, package(3, 30_000))
    assert (done.image, device.bench.running) == (1, 1)


def test_a_file_of_an_update(tmp_path):
    path = tmp_path / "a.update.json"
    path.write_text(package(1).to_json())
    assert UpdatePackage.read(path) == package(1)
    table = json.loads(path.read_text())
    harms = ({"crc32": [1, 2]}, {"images": {"1": "AAAA"}}, {"evlcp_update": 2}, {"target": 5})
    damaged = [json.dumps(table | harm).encode() for harm in harms]
    for content in (b"\xff\xfe\x00\x20" * 100, b"{", b"", *damaged):
        path.write_bytes(content)
        with pytest.raises(InputError) as caught:
            UpdatePackage.read(path)
        assert str(caught.value).startswith(f"{path}: not a firmware update, or damaged; expected TARGET.")
        assert "codec" not in str(caught.value)
    with pytest.raises(InputError, match="cannot be read: No such file"):
        UpdatePackage.read(tmp_path / "none.json")


# -- the real images, on the model of the part


def test_the_real_firmware_updates_itself(stm32, monkeypatch):
    from tests.models.stm32 import (
        RESET_BY_IWDG,
        RESET_BY_PIN,
        RESET_BY_SOFTWARE,
        US,
        Usart,
        connect,
        lit_rows,
    )

    new = UpdatePackage.build("stm32f405-8mhz")
    chip, board = stm32()
    link = board_link("air.frames_per_packet=4")
    symbols = symbols_of(1, 1, link)
    provision(board, make_bank(symbols, link), Settings(start=False, level_ma=13))
    board.save()
    with monkeypatch.context() as hurried:
        hurried.setattr(Usart, "BYTE", 4 * US)  # for the time that it takes
        done = update_firmware(board, new)
    assert (done.image, done.sequence) == (1, 1)
    assert chip.resets == [RESET_BY_PIN, RESET_BY_SOFTWARE]
    assert 0x08040000 <= chip.pc < 0x08060000
    # it plays what was saved, chip for chip, by its own interrupts
    board.recall()
    begin = len(chip.drivers.log)
    board.start()
    chip.run(12_000)
    assert state_of(board) == (State.PLAYING, 0)
    assert board.status().level_ma == 13
    rows, _ = lit_rows(chip.drivers.log[begin:])
    chips = symbol_chips(symbols, link)
    expected = np.repeat(np.roll(chips, -int(chips.any(1).argmax()), axis=0), 6, axis=1)
    assert (rows == np.resize(expected, rows.shape)).all()
    assert len(rows) > 80
    board.blank()

    # one that hangs at once: three tries, each ended by the watchdog, then the one before
    dead = new.images[2][:4] + (0x08060009).to_bytes(4, "little") + b"\xfe\xe7\xfe\xe7"
    with pytest.raises(VerifyError, match="runs image 1, expected 2: the new firmware did not start"):
        update_firmware(board, UpdatePackage(new.target, {1: new.images[1], 2: dead}))
    assert chip.resets[2:] == [RESET_BY_SOFTWARE, *[RESET_BY_IWDG] * 3]
    assert chip.drivers.dark
    assert update_status(board).running == 1
    # power fails while it is written, and before it is sealed
    call = board.session.call
    call(protocol.UpdateBeginRequest(update_status(board).next, len(new.images[2]), 0))
    call(protocol.UpdateWriteRequest(0, new.images[2][:400]))

    # without a crystal it answers and stays dark, at 16 MHz from power-up on; the watchdog's oscillator is as
    # fast as RM0090 allows: it bites soonest
    monkeypatch.setattr("tests.models.stm32.LSI_HZ", 47_000)
    chip.hse_works = False
    chip.reset(RESET_BY_PIN)
    chip.run(700_000)
    assert chip.resets[-2:] == [RESET_BY_IWDG, RESET_BY_PIN]
    board = connect(chip)
    assert update_status(board).running == 1
    assert state_of(board) == (State.FAULT, BoardFault.CLOCK)
    assert chip.drivers.dark
