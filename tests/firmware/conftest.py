"""What the tests of the transmitter share: codebook, tools that may be missing, boards."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable

import pytest

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.link.resolve import load_link

INSTALL = "sh firmware_host/firmware/install-toolchain.sh installs it (as root)"


def tool(*names: str) -> None:
    """Skip, loudly, unless all these programs are there."""
    missing = [n for n in names if shutil.which(n) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} missing: {INSTALL}")


@pytest.fixture(scope="session")
def book() -> Codebook:
    return load_link().codebook


@pytest.fixture(scope="session")
def needs() -> Callable[..., None]:
    return tool


@pytest.fixture(scope="session")
def compiler() -> None:
    """Skip without what builds the native board."""
    tool("cc", "make")


@pytest.fixture(scope="session")
def cli() -> Callable[..., "subprocess.CompletedProcess[str]"]:
    """Run `evlcp` with these arguments."""

    def run(*arguments: object, **options: object) -> "subprocess.CompletedProcess[str]":
        command = [sys.executable, "-c", "from evlcp_sdk.cli.main import main; main()", *map(str, arguments)]
        env = {k: v for k, v in os.environ.items() if k != "EVLCP_PORT"} | {"COLUMNS": "200"}
        return subprocess.run(
            command, capture_output=True, text=True, timeout=120, check=False, env=env, **options
        )

    return run
