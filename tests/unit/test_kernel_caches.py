"""Kernels work where no cache can be written."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.kernels import njit

SDK = Path(__file__).parents[2]

KERNELS = sorted(SDK.glob("evlcp_sdk/**/_kernels.py")) + sorted(SDK.glob("plugins/*/_kernels.py"))


def module_of(path: Path) -> str:
    return ".".join(
        path.relative_to(SDK / "plugins" if "plugins" in path.parts else SDK).with_suffix("").parts
    )


NOWHERE = """
import importlib, sys
from numba.core.caching import FunctionCache
FunctionCache._impl_class._locator_classes = []
for name in sys.argv[1:]:
    importlib.import_module(name)
from evlcp_sdk.kernels import njit
@njit(cache=True)
def twice(x):
    return 2 * x
print(twice(21))
"""


def test_kernels_are_imported_where_no_cache_can_be() -> None:
    """A read-only installation without a home: numba finds no folder for any function."""
    assert len(KERNELS) > 7
    done = subprocess.run(
        [sys.executable, "-c", NOWHERE, *map(module_of, KERNELS)], capture_output=True, text=True, check=False
    )
    assert (done.stdout, done.stderr) == ("42\n", "")


def test_every_kernel_is_compiled_in_this_way() -> None:
    for path in KERNELS:
        assert "from evlcp_sdk.kernels import njit\n" in path.read_text()
        assert "from numba import" not in path.read_text()


@pytest.mark.parametrize("refuses", ["save", "load"])
def test_a_cache_that_breaks_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refuses: str
) -> None:
    """A full disk while a kernel is kept, or a cache that cannot be read."""

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    @njit(cache=True, nogil=True)
    def thrice(x: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        return 3 * x

    monkeypatch.setattr(f"numba.core.caching.IndexDataCacheFile.{refuses}", refuse)
    np.testing.assert_array_equal(thrice(np.arange(3)), [0, 3, 6])


def test_a_cache_is_used_where_it_can_be(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from evlcp_sdk.kernels import njit\n\n\n@njit(cache=True)\ndef twice(x):\n    return 2 * x\n"
    )
    code = "import mine; print(mine.twice(2), sum(mine.twice.stats.cache_hits.values()))"
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', SDK)}"}
    for hits in (0, 1):
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
        )
        assert done.stdout == f"4 {hits}\n"
