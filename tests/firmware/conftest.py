"""What the tests of the transmitter share: codebook, tools that may be missing, boards."""

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from board_lines import LINK, Native, board_on

from evlcp_sdk.air.codebook import Codebook
from firmware_host import build
from firmware_host.board.board import Board
from firmware_host.emulators.simulated import SimulatedBoard, SimulatedLine
from firmware_host.images import FlashImage

if TYPE_CHECKING:
    from tests.models.stm32 import Stm32

SANITIZED = "EVLCP_TEST_LIBRARY"
"""Names a library of the firmware, for tests that run in another process."""

INSTALL = "sh firmware_host/firmware/install-toolchain.sh installs it (as root)"


def tool(*names: str) -> None:
    """Skip, loudly, unless all these programs are there."""
    missing = [n for n in names if shutil.which(n) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} missing: {INSTALL}")


@pytest.fixture(scope="session")
def book() -> Codebook:
    return LINK.codebook


@pytest.fixture(scope="session", autouse=True)
def _library() -> None:
    """Skip without what builds the native board; take the one under sanitizers, where that is named."""
    tool("cc", "make")
    if path := os.environ.get(SANITIZED):
        build.native_library = lambda: Path(path)


@pytest.fixture(scope="session")
def needs() -> Callable[..., None]:
    return tool


@pytest.fixture(autouse=True)
def _no_port_and_a_wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the command line must not find in a developer's environment, and how wide its lines may be."""
    monkeypatch.delenv("EVLCP_PORT", raising=False)
    monkeypatch.setenv("COLUMNS", "200")


@pytest.fixture
def device() -> SimulatedBoard:
    return SimulatedBoard()


@pytest.fixture
def board(device: SimulatedBoard) -> Board:
    """A session with `device`."""
    return board_on(SimulatedLine(device))


@pytest.fixture
def native(tmp_path: Path) -> Iterator[str]:
    """The port of a native board that runs; its files are leds.bin and flash.bin."""
    place = f"unix:{tmp_path / 'board'}"
    emulated = Native(place, leds=tmp_path / "leds.bin", flash=tmp_path / "flash.bin")
    yield place
    emulated.end()


@pytest.fixture(scope="session")
def stm32() -> "Callable[..., tuple[Stm32, Board]]":
    """What starts an image on the model of the part, and connects to it."""
    tool("arm-none-eabi-gcc")
    pytest.importorskip("unicorn", reason="unicorn missing: pip install --group dev installs it")
    from tests.models.stm32 import Stm32, connect

    def started(
        image: FlashImage | None = None, hse_hz: int = 8_000_000, pulses: Sequence[float] = ()
    ) -> "tuple[Stm32, Board]":
        chip = Stm32(image or build.arm_image("stm32f405"), hse_hz)
        for time in pulses:
            chip.pulse_at(time)
        chip.run(15_000)
        return chip, connect(chip)

    return started
