"""Boards for the tests of the transmitter, and what of a developer's environment they must not see."""

import os
from pathlib import Path

import pytest
from board_lines import Native, board_on, needs

from firmware_host import build
from firmware_host.emulators.simulated import SimulatedBoard

SANITIZED = "EVLCP_TEST_LIBRARY"
"""Names a library of the firmware, for tests that run in another process."""


@pytest.fixture(scope="session", autouse=True)
def _library():
    """Skip without what builds the native board; take the one under sanitizers, where that is named."""
    needs("cc", "make")
    if path := os.environ.get(SANITIZED):
        build.native_library = lambda: Path(path)


@pytest.fixture(autouse=True)
def _no_port_and_a_wide_terminal(monkeypatch):
    monkeypatch.delenv("EVLCP_PORT", raising=False)
    monkeypatch.setenv("COLUMNS", "200")


@pytest.fixture
def device():
    return SimulatedBoard()


@pytest.fixture
def board(device):
    """A session with `device`."""
    return board_on(device)


@pytest.fixture
def native(tmp_path):
    """The port of a native board that runs; its files are leds.bin and flash.bin."""
    place = f"unix:{tmp_path / 'board'}"
    emulated = Native(place, leds=tmp_path / "leds.bin", flash=tmp_path / "flash.bin")
    yield place
    emulated.end()


@pytest.fixture(scope="session")
def stm32():
    """What starts an image on the model of the part, and connects to it."""
    needs("arm-none-eabi-gcc")
    pytest.importorskip("unicorn", reason="unicorn missing: pip install --group dev installs it")
    from tests.models.stm32 import Stm32, connect

    def started(image=None, hse_hz=8_000_000, pulses=()):
        chip = Stm32(image or build.arm_image("stm32f405"), hse_hz)
        for time in pulses:
            chip.pulse_at(time)
        chip.run(15_000)
        return chip, connect(chip)

    return started
