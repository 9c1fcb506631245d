"""What the tests of the transmitter share: codebook, tools that may be missing, boards."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.link.resolve import load_link
from firmware_host import build

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
    return load_link().codebook


@pytest.fixture(scope="session", autouse=True)
def _library() -> None:
    """The firmware under sanitizers, where the environment names it."""
    if path := os.environ.get(SANITIZED):
        build.native_library = lambda: Path(path)


@pytest.fixture(scope="session")
def needs() -> Callable[..., None]:
    return tool


@pytest.fixture(scope="session")
def compiler() -> None:
    """Skip without what builds the native board."""
    tool("cc", "make")


@pytest.fixture(autouse=True)
def _no_port_and_a_wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the command line must not find in a developer's environment, and how wide its lines may be."""
    monkeypatch.delenv("EVLCP_PORT", raising=False)
    monkeypatch.setenv("COLUMNS", "200")
