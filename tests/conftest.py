"""What tests share: the shipped recording and how the command line is run."""

import csv
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
from hypothesis import settings

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl

# A thread a core for matrices of a few rows takes ten times the processor, and each worker has a core: before
# numpy is there, which asks once. Processes that tests start inherit it.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# What a script starts in the background ignores Ctrl-C, and what tests start inherits that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).parents[1]

# The same examples on every machine; --hypothesis-profile=default draws new ones. Compiling takes seconds.
settings.register_profile("same", derandomize=True, deadline=None)
settings.load_profile("same")

# What parameters a command has is looked up at every run of it: much of the time of many tests.
typer.main.get_params_from_function = cache(typer.main.get_params_from_function)


LONG = (
    "tests/unit/test_site.py",
    "tests/packaging",
    "tests/camera",
    "tests/unit/test_notebooks.py",
    "tests/faults",
    "tests/acceptance",
    "tests/unit/plugins/test_uart.py",
    "tests/unit/study",
    "tests/unit/rx",
    "tests/firmware",
)
"""Files and folders with tests of 5 s and more, the longest first."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Several processes begin with what takes long: none is left with that when the others are done."""
    if hasattr(config, "workerinput"):
        items.sort(
            key=lambda item: next((k for k, at in enumerate(LONG) if item.nodeid.startswith(at)), len(LONG))
        )


class Brings:
    """A package with these algorithms."""

    def __init__(self, *records: Any) -> None:
        self.records = records

    @hookimpl
    def evlcp_algorithms(self) -> Iterator[Algorithm]:
        """Its records."""
        yield from self.records


@dataclass(frozen=True)
class Run:
    """How a command ended."""

    code: int
    out: str
    err: str


@pytest.fixture
def evlcp(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Run]:
    """Run the command line in this process, plugins and error handling included."""

    def run(*args: str | Path) -> Run:
        from evlcp_sdk.cli.main import main

        monkeypatch.setattr(sys, "argv", ["evlcp", *map(str, args)])
        capsys.readouterr()
        code = 0
        try:
            main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        finally:
            # A command keeps all that is there when it is loaded, as its process ends with it.
            gc.unfreeze()
        captured = capsys.readouterr()
        # Whichever test is the first to need kernels that are not kept yet.
        err = [line for line in captured.err.splitlines(keepends=True) if "compiling kernels" not in line]
        return Run(code, captured.out, "".join(err))

    return run


def rows_of(path: Path) -> list[dict[str, str]]:
    """Of a CSV file with a heading."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="session")
def demo_raw() -> Path:
    """The recording that comes with the package."""
    return ROOT / "examples" / "recordings" / "night-50m-30kmh-cut.raw"
