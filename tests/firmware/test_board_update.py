"""Updates in the field: two images, trial, roll-back, power that fails at every step; one on the model."""

import contextlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from board_lines import board_on

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import InputError
from firmware_host import build
from firmware_host.board.bank import Bank, random_symbols, symbol_chips
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.session import Session
from firmware_host.board.update import Package, confirm, update, update_status
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.errors import (
    BoardError,
    BoardResetError,
    IncompatibleError,
    LineError,
    RefusedError,
    VerifyError,
)
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import (
    BoardFault,
    State,
    Status,
    UpdateBeginRequest,
    UpdateCommitRequest,
    UpdateWriteRequest,
)

pytestmark = pytest.mark.usefixtures("compiler")


def some(seed: int, count: int = 400) -> bytes:
    return np.random.default_rng(seed).integers(0, 256, count, np.uint8).tobytes()


def package(seed: int, count: int = 400) -> Package:
    return Package("native", {1: some(seed, count), 2: some(seed + 100, count)})


def fresh() -> tuple[SimulatedBoard, Board]:
    device = SimulatedBoard()
    return device, board_on(SimulatedLine(device))


def test_updates_take_turns_and_run_after_every_reset() -> None:
    device, board = fresh()
    assert device.running() == 0
    assert update_status(board).next == 1
    for n, image in enumerate((1, 2, 1, 2), 1):
        told: list[tuple[int, int]] = []
        new = package(n, 3_001)
        done = update(board, new, lambda at, total, told=told: told.append((at, total)))
        assert (done.image, done.length, done.sequence) == (image, 3_001, n)
        assert told[-1] == (3_001, 3_001)
        assert device.running() == image
        assert device.image(image, 3_001) == new.images[image]
        assert update_status(board).trial == 0
        for _ in range(5):
            device.reset()
            assert device.running() == image
        board = board_on(SimulatedLine(device))


def test_what_is_not_kept_is_left_at_the_third_reset() -> None:
    device, board = fresh()
    update(board, package(1))
    update(board, package(2), keep=False)
    assert update_status(board).trial == 1
    with pytest.raises(RefusedError, match="image 2 runs on trial; keep it first"):
        update(board, package(3))
    runs = []
    for _ in range(4):
        device.reset()
        runs.append(device.running())
    assert runs == [2, 2, 1, 1]
    # and the place that it leaves takes the next one
    board = board_on(SimulatedLine(device))
    assert update(board, package(3)).image == 2
    # without one before, back to the one that was flashed
    device, board = fresh()
    update(board, package(1), keep=False)
    for _ in range(3):
        device.reset()
    assert device.running() == 0
    device, board = fresh()
    update(board, package(1), keep=False)
    confirm(board)
    for _ in range(5):
        device.reset()
    assert device.running() == 1


@pytest.mark.parametrize("before", [0, 1])
def test_power_that_fails_at_every_step_leaves_one_of_the_two(before: int) -> None:
    """Words and erases of the flash, from the first of an update to its confirmation; the last ones all."""
    new = package(7)
    operations = 1 + 100 + 5 + 1 + 1  # erase, content, seal, try, confirmed
    ended = {"old": 0, "new": 0}
    moments = [*range(1, operations - 8, 6), *range(operations - 8, operations + 3)]
    for left in moments:
        device, board = fresh()
        if before:
            update(board, package(1))
        old = device.running()
        device.cut_power(left)
        with contextlib.suppress(BoardError):
            update(board, new, wait_s=0.5)
        device.cut_power(0)
        device.reset()
        place = 2 if before else 1
        if device.running() == place:
            ended["new"] += 1
            assert device.image(place, 400) == new.images[place]
        else:
            ended["old"] += 1
            assert device.running() == old
            if old:
                assert device.image(old, 400) == package(1).images[old]
        # the next run ends well, whatever was left
        board = board_on(SimulatedLine(device))
        if update_status(board).trial:
            confirm(board)
        done = update(board, package(9))
        assert device.image(done.image, 400) == package(9).images[done.image]
        device.reset()
        assert device.running() == done.image
    assert ended["new"] >= 2
    assert ended["old"] >= len(moments) - 6


def test_what_cannot_be_is_refused(book: Codebook) -> None:
    device, board = fresh()
    with pytest.raises(IncompatibleError, match="is a native, the firmware is for stm32f405-8mhz"):
        update(board, Package("stm32f405-8mhz", {1: b"1234", 2: b"1234"}))
    with pytest.raises(RefusedError, match="65473 bytes of firmware, an image may have 65472"):
        update(board, package(1, 65_473))
    with pytest.raises(RefusedError, match="NOTHING_COMMITTED"):
        board.session.call(UpdateWriteRequest(0, b"1234"))
    with pytest.raises(RefusedError, match="nearest value the board can take is 1"):
        board.session.call(UpdateBeginRequest(2, 4, 0))
    with pytest.raises(RefusedError, match="OUT_OF_RANGE"):
        board.session.call(UpdateBeginRequest(1, 0, 0))
    board.session.call(UpdateBeginRequest(1, 4, 5))
    for offset, data in ((2, b"12"), (4, b"1"), (0, b"12345"), (8, b"")):
        with pytest.raises(RefusedError, match="OUT_OF_RANGE"):
            board.session.call(UpdateWriteRequest(offset, data))
    board.session.call(UpdateWriteRequest(0, b"1234"))
    with pytest.raises(VerifyError, match="BAD_CRC"):
        board.session.call(UpdateCommitRequest())
    device.reset()
    assert device.running() == 0
    board = board_on(SimulatedLine(device))
    bank = Bank.of_symbols(random_symbols(1, 10, book, np.random.default_rng(0)), book)
    provision(board, bank, Settings())
    with pytest.raises(RefusedError, match="BUSY") as refused:
        update(board, package(1))
    assert refused.value.status == Status.BUSY
    assert board.status().state == State.PLAYING


def test_a_noisy_line_and_a_reset_half_way() -> None:
    device, board = fresh()

    class Noisy(SimulatedLine):
        rng = np.random.default_rng(3)

        def to_board(self, data: bytes) -> bytes:
            out = bytearray(data)
            if self.rng.random() < 0.1 and out:
                out[int(self.rng.integers(len(out)))] ^= 0x20
            return bytes(out)

    board = Board(Session(Noisy(device), Timing(latency_s=0.01)))
    done = update(board, package(4, 20_000))
    assert device.image(1, 20_000) == package(4, 20_000).images[1]
    assert done.image == device.running() == 1

    class Resets(SimulatedLine):
        left = 8

        def to_board(self, data: bytes) -> bytes:
            self.left -= 1
            if self.left == 0:
                self.board.reset()
            return data

    with pytest.raises((BoardResetError, LineError)):
        update(Board(Session(Resets(device), Timing())), package(5, 20_000))
    assert device.running() == 1
    assert update(board_on(SimulatedLine(device)), package(5)).image == 2


def test_interrupted_and_run_again() -> None:
    class Ends(SimulatedLine):
        left = 4_000

        def to_board(self, data: bytes) -> bytes:
            self.left -= len(data)
            return data if self.left > 0 else b""

    device, board = fresh()
    update(board, package(1, 20_000))
    board = Board(Session(Ends(device), Timing(latency_s=0.01)))
    with pytest.raises(LineError, match="it begins anew, and the board keeps the firmware that it runs"):
        update(board, package(2, 20_000))
    board = board_on(SimulatedLine(device))
    assert (update_status(board).running, update_status(board).trial) == (1, 0)
    done = update(board, package(2, 20_000))
    assert (done.image, device.image(2, 20_000)) == (2, package(2, 20_000).images[2])


class SlowLine(SimulatedLine):
    """A line and a board that take two hundred times as long as they should."""

    def __init__(self, board: SimulatedBoard) -> None:
        super().__init__(board)
        self.under_way: list[tuple[int, bytes]] = []

    def now(self) -> float:
        return 200 * super().now()

    def write(self, data: bytes) -> None:
        begins = max([self.board.now_us, *(at for at, _ in self.under_way)])
        self.under_way.append((begins + 10 * len(data), data))

    def read(self, timeout_s: float) -> bytes:
        end = self.board.now_us + max(self.step_us, int(timeout_s / 200 * 1e6))
        while self.board.now_us < end:
            while self.under_way and self.under_way[0][0] <= self.board.now_us:
                self.board.receive(self.under_way.pop(0)[1])
            self.board.run(self.step_us)
            if data := self.board.sent():
                return data
        return b""


def test_a_slow_board_is_waited_for() -> None:
    device = SimulatedBoard()
    board = Board(Session(SlowLine(device), Timing()))
    done = update(board, package(3, 30_000))
    assert (done.image, device.running()) == (1, 1)
    # the first ones go out again; then it is known how long an answer takes
    assert board.session.client.retries < 20


def test_a_board_with_a_key_takes_updates_from_its_host_alone(book: Codebook) -> None:
    key = bytes(range(16))
    device, board = fresh()
    bank = Bank.of_symbols(random_symbols(1, 10, book, np.random.default_rng(0)), book)
    provision(board, bank, Settings(start=False))
    board.set_key(key)
    board.save()  # or the key is gone with the restart
    with pytest.raises(RefusedError, match="NEEDS_KEY"):
        update(board_on(SimulatedLine(device)), package(1))
    with pytest.raises(RefusedError, match="NEEDS_KEY"):
        board_on(SimulatedLine(device)).session.call(UpdateWriteRequest(0, b"1234"))
    assert device.running() == 0
    done = update(Board(Session(SimulatedLine(device), Timing(latency_s=0.01), key=key)), package(1))
    assert done.image == device.running() == 1


def test_a_file_of_an_update(tmp_path: Path) -> None:
    path = tmp_path / "a.update.json"
    path.write_text(package(1).to_json())
    assert Package.read(path) == package(1)
    table = json.loads(path.read_text())
    for name, content in (("x.bin", b"\xff\xfe\x00\x20" * 100), ("x.json", b"{"), ("y.bin", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError) as told:
            Package.read(tmp_path / name)
        assert str(told.value).startswith(
            f"{tmp_path / name}: not a firmware update, or damaged; expected TARGET."
        )
        assert "codec" not in str(told.value)
    with pytest.raises(InputError, match="cannot be read: No such file"):
        Package.read(tmp_path / "none.json")
    for harm in ({"crc32": [1, 2]}, {"images": {"1": "AAAA"}}, {"evlcp_update": 2}, {"target": 5}):
        path.write_text(json.dumps(table | harm))
        with pytest.raises(InputError, match="not a firmware update, or damaged"):
            Package.read(path)


# -- the real images, on the model of the part


def test_an_update_without_a_crystal_answers_and_stays_dark(
    needs: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 16 MHz from power-up on, the watchdog's oscillator as fast as RM0090 allows: it bites soonest."""
    needs("make", "arm-none-eabi-gcc")
    pytest.importorskip("unicorn", reason="unicorn missing: pip install --group dev installs it")
    from tests.models import stm32

    chip = stm32.Stm32(build.arm_image("stm32f405"))
    chip.run(15_000)
    update(Board(Session(stm32.ModelLine(chip), Timing(latency_s=0.02))), Package.built("stm32f405-8mhz"))
    monkeypatch.setattr(stm32, "LSI_HZ", 47_000)
    chip.hse_works = False
    chip.reset(stm32.RESET_BY_PIN)
    chip.run(800_000)
    assert chip.resets[-1] == stm32.RESET_BY_PIN
    board = Board(Session(stm32.ModelLine(chip), Timing(latency_s=0.02)))
    assert update_status(board).running == 1
    status = board.status()
    assert (status.state, status.faults) == (State.FAULT, BoardFault.CLOCK)
    assert chip.drivers.dark


def test_the_real_firmware_updates_itself(book: Codebook, needs: Callable[..., None]) -> None:
    needs("make", "arm-none-eabi-gcc")
    pytest.importorskip("unicorn", reason="unicorn missing: pip install --group dev installs it")
    from tests.models.stm32 import RESET_BY_IWDG, RESET_BY_PIN, RESET_BY_SOFTWARE, ModelLine, Stm32

    new = Package.built("stm32f405-8mhz")
    chip = Stm32(build.arm_image("stm32f405"))
    chip.run(15_000)
    board = Board(Session(ModelLine(chip), Timing(latency_s=0.02)))
    symbols = random_symbols(1, 4, book, np.random.default_rng(1))
    provision(board, Bank.of_symbols(symbols, book), Settings(start=False, level_ma=13))
    board.save()
    done = update(board, new)
    assert (done.image, done.sequence) == (1, 1)
    assert chip.resets == [RESET_BY_PIN, RESET_BY_SOFTWARE]
    assert 0x08040000 <= chip.pc < 0x08060000
    # it plays what was saved, chip for chip, by its own interrupts
    board.recall()
    begin = len(chip.drivers.log)
    board.start()
    chip.run(12_000)
    status = board.status()
    assert (status.state, status.level_ma, status.faults) == (State.PLAYING, 13, 0)
    shown = [s.row for s in chip.drivers.log[begin:] if s.latched and not s.dark]
    while not shown[0]:
        del shown[0]
    rows = np.array([[int(bit) for bit in f"{row:096b}"] for row in shown])
    chips = symbol_chips(symbols, book)
    expected = np.repeat(np.roll(chips, -int(chips.any(1).argmax()), axis=0), 6, axis=1)
    assert (rows == np.resize(expected, rows.shape)).all()
    assert len(rows) > 80
    board.blank()

    # one that hangs at once: three tries, each ended by the watchdog, then the one before
    dead = new.images[2][:4] + (0x08060009).to_bytes(4, "little") + b"\xfe\xe7\xfe\xe7"
    with pytest.raises(VerifyError, match="runs image 1, expected 2: the new firmware did not start"):
        update(board, Package(new.target, {1: new.images[1], 2: dead}))
    assert chip.resets[2:] == [RESET_BY_SOFTWARE, *[RESET_BY_IWDG] * 3]
    assert chip.drivers.dark
    assert update_status(board).running == 1
    # power fails while it is written, and before it is sealed
    wanted = update_status(board).next
    board.session.call(UpdateBeginRequest(wanted, len(new.images[2]), 0))
    board.session.call(UpdateWriteRequest(0, new.images[2][:400]))
    chip.reset(RESET_BY_PIN)
    chip.run(60_000)
    board = Board(Session(ModelLine(chip), Timing(latency_s=0.02)))
    assert update_status(board).running == 1
