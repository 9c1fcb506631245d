"""Kernels: compiled once and kept, warmed up by a command, and their time counted apart."""

import json
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from evlcp_sdk.cli.warm_up import compile_kernels
from evlcp_sdk.kernels import COMPILE_TIMER, njit
from evlcp_sdk.stopwatch import Stopwatch
from tests.conftest import ROOT

OWN = """
import logging, sys
logging.basicConfig(level="INFO", format="%(message)s")
sys.path.insert(0, sys.argv[1])
import own_kernels
from evlcp_sdk import kernels
kernels.COMPILE_TIMER._report_at_s = 0.0
print(own_kernels.twice(21), len(kernels.LOADED), kernels.count_compiled())
print(kernels.find_cache_folder())
"""


def run(folder: Path, env: dict[str, str]) -> tuple[list[str], str]:
    """A kernel in a file of its own, called in a process of its own."""
    source = folder / "own_kernels.py"
    if not source.exists():
        source.write_text(
            "from evlcp_sdk.kernels import njit\n\n\n@njit(error_model='numpy')\n"
            "def twice(x):\n    return 2 * x\n\n\n@njit\ndef never(x):\n    return x\n"
        )
    done = subprocess.run(
        [sys.executable, "-c", OWN, folder], env=env, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines(), done.stderr


def test_a_kernel_is_compiled_once_and_kept(tmp_path: Path) -> None:
    out, err = run(tmp_path, {})
    assert out == ["42 2 1", str(tmp_path / "__pycache__")]
    assert err == "compiling kernels, once on a machine: 1 of 2\n"
    out, err = run(tmp_path, {})
    assert out[0] == "42 2 0"
    # To load it, which many processes at once make slow, too, is nothing to tell.
    assert err == ""
    assert run(tmp_path, {"NUMBA_DISABLE_JIT": "1"})[0][0] == "42 0 0"


def test_what_is_kept_of_a_type_that_is_gone_is_forgotten(tmp_path: Path) -> None:
    """Numba reads its index before it sees that the source is another."""
    source = """
from typing import NamedTuple
from evlcp_sdk.kernels import njit
class NAME(NamedTuple):
    x: int
    y: int
@njit
def add(pair):
    return pair.x + pair.y
MADE = NAME
"""
    code = "import sys; sys.path.insert(0, sys.argv[1]); import own_kernels as k; print(k.add(k.MADE(40, 2)))"
    for name in ("Pair", "Both"):
        (tmp_path / "own_kernels.py").write_text(source.replace("NAME", name))
        command = [sys.executable, "-B", "-c", code, str(tmp_path)]
        assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "42\n"


def test_kernels_work_where_no_cache_can_be(tmp_path: Path) -> None:
    """Installed read-only, without a home: a file stands where the cache's folder would."""
    (tmp_path / "__pycache__").write_text("")
    out, _ = run(
        tmp_path, {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null", "PYTHONDONTWRITEBYTECODE": "1"}
    )
    assert out == ["42 2 1", "None"]


def test_a_disk_without_room_takes_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1000}))

    @njit
    def thrice(x: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        return 3 * x

    assert thrice.stats.cache_path is None  # type: ignore[attr-defined]
    np.testing.assert_array_equal(thrice(np.arange(3)), [0, 3, 6])


def busy(seconds: float) -> None:
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass


def test_time_for_kernels_is_left_out() -> None:
    watch, stats = Stopwatch(), SimpleNamespace(cache_misses={})
    inner = COMPILE_TIMER.watch(SimpleNamespace(compile=lambda _: busy(0.05), stats=stats))
    outer = COMPILE_TIMER.watch(SimpleNamespace(compile=lambda sig: (busy(0.05), inner(sig)), stats=stats))
    with watch.measure():
        began_s = time.perf_counter()
        outer(None)
        took_s = time.perf_counter() - began_s
        busy(0.02)
    # The inner one's time is in the outer's, and counts once.
    assert 0.1 <= watch.kernels_s <= took_s
    assert 0.02 <= watch.processor_s < 0.05


def test_a_warm_up_leaves_nothing_to_compile() -> None:
    """The first compiles what there is not; the second finds all of it."""
    steps: list[tuple[int, int]] = []
    warmth = compile_kernels(lambda *step: steps.append(step))
    assert steps == [(0, 2), (1, 2)]
    assert warmth["kept_in"] is not None
    assert compile_kernels(lambda *_: None)["compiled"] == 0


@pytest.mark.parametrize(
    ("compiled", "elapsed_s", "words"),
    [
        (0, 2.5, "nothing to compile; tried in 2.5 s"),
        (7, 31.0, "7 kernels compiled in 31 s they cannot be kept"),
    ],
)
def test_the_command_says_what_it_did(
    evlcp, monkeypatch, compiled: int, elapsed_s: float, words: str
) -> None:
    warmth = {"compiled": compiled, "elapsed_s": elapsed_s, "kept_in": None}
    monkeypatch.setattr("evlcp_sdk.cli.warm_up.compile_kernels", lambda _: warmth)
    done = evlcp("warm-up")
    assert done.code == 0
    assert " ".join(done.out.split()).startswith(words)
    assert json.loads(evlcp("warm-up", "--json").out) == warmth


def test_every_kernel_is_compiled_in_this_way() -> None:
    kernels = [path for room in ("evlcp_sdk", "plugins") for path in (ROOT / room).glob("**/_kernels.py")]
    assert len(kernels) > 7
    for path in kernels:
        assert "from evlcp_sdk.kernels import njit\n" in path.read_text()
        assert "from numba import" not in path.read_text()
