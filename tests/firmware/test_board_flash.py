"""The firmware as files, and into a part by its ROM; what is in there then boots on the model."""

import itertools
import json
import time
from contextlib import suppress
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from board_lines import check_fault, needs, well
from test_board_cli import Emulated

from evlcp_sdk.errors import InputError
from firmware_host import build
from firmware_host.board.update import UpdatePackage
from firmware_host.errors import LineError, NoBoardError, RefusedError, VerifyError
from firmware_host.images import FLASH_START, FlashImage
from firmware_host.ports.rom import SECTORS, RomLoader, flash_image
from tests.models.rom import RomEmulator, RomLine


def random_image(count, seed=0, address=FLASH_START):
    return FlashImage(address, np.random.default_rng(seed).integers(0, 256, count, np.uint8).tobytes())


def test_files_hold_one_image(evlcp, tmp_path):
    needs("arm-none-eabi-gcc", "arm-none-eabi-objcopy")
    for target in ("stm32f405-8mhz", "stm32f405-12mhz"):
        done = well(evlcp("board", "build", "--target", target, "-o", tmp_path / "new", "--json"))
        table = json.loads(done.out)
        *files, package = (Path(file) for file in table["files"])
        assert UpdatePackage.read(package) == UpdatePackage.build(target)
        elf, hexed, binary = (FlashImage.read(path) for path in files)
        assert elf == hexed == binary
        assert (elf.address, len(elf.data)) == (FLASH_START, table["bytes"])
        check_fault(evlcp("board", "update", "--target", target, "--port", "native:"), 8, "is a native")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.hex", b":0100000001FF\n", "line 1: not a record of Intel HEX, or its check sum is wrong"),
        ("a.hex", b":0100000001FE\n", "has no end record"),
        ("a.hex", b":0000000900\n", "line 1: not a record"),
        ("a.hex", b":00000009F7\n", "record type 9, expected 0 to 5"),
        ("a.hex", b":0100000001FE\n:00000001FF\n", "expected within the flash"),
        ("a.bin", b"", "holds no bytes"),
        ("a.update.json", b"{}", "expected .elf, .hex or .bin"),
        ("a.bin", bytes((1 << 20) + 1), "expected within the flash"),
        ("a.elf", b"\x7fELF\x01\x01", "cut off"),
        ("a.elf", b"\x7fELF\x02\x01" + bytes(60), "not one of 32 bits"),
    ],
)
def test_damaged_images_are_reported(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        FlashImage.read(tmp_path / name)


def test_a_device_that_is_never_silent_is_no_boot_loader():
    clock = itertools.count(0.0, 0.01)
    line = Mock(name="line", time_s=lambda: next(clock), read=lambda _: b"$GPGGA")
    with pytest.raises(NoBoardError, match="no boot loader answers"):
        RomLoader(line)


def test_flashed_read_back_started_and_the_rest_left_alone():
    old, end = random_image(1 << 20, 1).data, sum(SECTORS[:5])
    rom, new = RomEmulator(old), random_image(70_001, 2)
    reports = []
    loader = RomLoader(RomLine(rom))
    sectors = flash_image(loader, new, progress=lambda done, total: reports.append((done, total)))
    assert sectors == rom.erased == [0, 1, 2, 3, 4]
    assert rom.flash == new.data + b"\xff" * (end - 70_001) + old[end:]
    assert rom.started == FLASH_START
    assert (reports[0], reports[-1]) == ((0, 140_008), (140_008, 140_008))
    assert reports == sorted(reports)
    # one elsewhere takes its own sectors
    rom = RomEmulator(bytes(1 << 20))
    flash_image(RomLoader(RomLine(rom)), random_image(10, 3, FLASH_START + (128 << 10) - 4), start=False)
    assert (rom.erased, rom.started) == ([4, 5], None)


class BadLine(RomLine):
    """Loses a byte or turns a bit, now and then."""

    def __init__(self, rom, seed, one_in):
        super().__init__(rom)
        self._rng, self._one_in = np.random.default_rng(seed), one_in

    def to_part(self, data):
        dice = self._rng.integers(0, 2 * self._one_in, len(data))
        return bytes(byte ^ (0x10 if n == 1 else 0) for byte, n in zip(data, dice, strict=True) if n)

    to_host = to_part


def test_a_bad_line_gets_through_or_is_reported():
    through = 0
    for seed in range(12):
        rom, new = RomEmulator(), random_image(6_000, seed)
        with suppress(LineError, RefusedError, VerifyError, NoBoardError):
            flash_image(RomLoader(BadLine(rom, seed, 3_000)), new)
            through += 1
            assert rom.flash[:6_000] == new.data
            assert rom.started == FLASH_START
    assert through >= 8


class Cut(RomLine):
    """Ends after so many bytes."""

    def __init__(self, rom, left):
        super().__init__(rom)
        self.left = left

    def to_part(self, data):
        self.left -= len(data)
        return data if self.left > 0 else b""


class Worn(RomEmulator):
    """Has a bit that stays."""

    def _write(self, address):
        good = yield from super()._write(address)
        self.flash[77] |= 1
        return good


def test_what_cannot_be_flashed_is_reported():
    with pytest.raises(NoBoardError, match="set BOOT0 high, press reset"):
        RomLoader(Cut(RomEmulator(), 0))
    rom = Worn()
    for part, fault, expected in (
        (RomEmulator(protected=True), RefusedError, "read-out is protected"),
        (RomEmulator(product=0x419), RefusedError, "0x419, expected 0x413"),
        (rom, VerifyError, "at 0x800004d, expected"),
    ):
        with pytest.raises(fault, match=expected):
            flash_image(RomLoader(RomLine(part)), FlashImage(FLASH_START, bytes(100)))
    assert rom.started is None
    # a line that ends in the middle is told, and the next run goes through
    rom = RomEmulator()
    with pytest.raises(LineError, match="no answer to WRITE at 0x8000"):
        flash_image(RomLoader(Cut(rom, 3_000)), random_image(6_000))
    flash_image(RomLoader(RomLine(rom)), random_image(6_000))
    assert rom.flash[:6_000] == random_image(6_000).data


def test_what_the_command_flashes_boots_where_it_was_flashed(evlcp, tmp_path):
    needs("arm-none-eabi-gcc")
    pytest.importorskip("unicorn", reason="unicorn missing: pip install --group dev installs it")
    port, kept = f"unix:{tmp_path / 'part'}", tmp_path / "flash.bin"
    kept.write_bytes(random_image(1 << 20, 5).data)
    emulated = Emulated("rom", "--listen", port, "--flash", kept)
    try:
        assert emulated.first_line == f"listening on {port}\n"
        done = well(evlcp("board", "flash", "--target", "stm32f405-8mhz", "--port", port, "--json"))
        table = json.loads(done.out)
        assert (table["verified"], table["started"], table["brown_out"]) == (True, True, False)
        assert table["sectors"][0] == 0
        # what was flashed answers when the file has it
        end = time.monotonic() + 20.0
        while (hello := evlcp("board", "hello", "--port", port, "--json")).code:
            assert time.monotonic() < end, hello
        assert json.loads(hello.out)["hal"] == "stm32f405"
        image = FlashImage.read(build.arm_image("stm32f405"))
        assert kept.read_bytes()[: len(image.data)] == image.data
    finally:
        assert emulated.end() == 0
    emulate = ("board", "emulate", "rom", "--listen", port, "--flash")
    done = evlcp(*emulate, tmp_path / "part.bin", "--leds", tmp_path)
    assert (done.code, done.out) == (1, "")
    (tmp_path / "short.bin").write_bytes(b"12")
    check_fault(
        evlcp(*emulate, tmp_path / "short.bin"), 3, "2 bytes, expected 1048576, the flash of the part"
    )


def test_the_image_for_another_crystal_boots_by_that_one(stm32):
    rom = RomEmulator(random_image(1 << 20, 5).data)
    flash_image(RomLoader(RomLine(rom)), FlashImage.read(build.arm_image("stm32f405-12mhz")))
    flash = FlashImage(FLASH_START, bytes(rom.flash))
    _, board = stm32(flash, 12_000_000)
    assert board.info.hal.rstrip(b"\0") == b"stm32f405"
    for wrong, hse_hz in ((flash, 8_000_000), (FlashImage.read(build.arm_image("stm32f405")), 12_000_000)):
        with pytest.raises(AssertionError, match="not 168 MHz by this crystal"):
            stm32(wrong, hse_hz)


def test_a_part_without_brown_out_is_reported(evlcp, monkeypatch, tmp_path):
    (tmp_path / "image.bin").write_bytes(random_image(1_000).data)
    for warns, options in ((True, ()), (False, ("--brown-out",))):
        rom = RomEmulator()
        before = bytes(rom.options)
        monkeypatch.setattr(
            "firmware_host.ports.transport.open_transport", lambda *_, rom=rom, **__: RomLine(rom)
        )
        done = well(evlcp("board", "flash", tmp_path / "image.bin", "--port", "rom:", *options))
        assert ("brown-out reset is off: flash with --brown-out" in done.out) == warns
        assert rom.resets == (not warns)
        # that is set, and nothing else
        assert rom.options[0] == (before[0] if warns else before[0] & 0xF3)
        assert rom.options[1:] == before[1:]
