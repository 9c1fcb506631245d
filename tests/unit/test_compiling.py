"""What the child compiles computes what Numba's own way of compiling does, to the last bit."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from evlcp_sdk import compiling

SDK = Path(__file__).parents[2]

KERNELS = '''
from math import exp, sqrt

import numpy as np

from evlcp_sdk.kernels import njit


@njit(cache=True, nogil=True)
def _least(values, first):
    """A part that takes arrays, and slices of them."""
    at = first
    for i in range(first, values.size):
        if values[i] < values[at]:
            at = i
    return at


@njit(cache=True, nogil=True)
def sorted_up(values):
    """Another kernel's part, and one by itself."""
    out = values.copy()
    for i in range(out.size):
        at = _least(out, i)
        out[i], out[at] = out[at], out[i]
    return out


@njit(cache=True, nogil=True)
def _turned(at, by):
    return at * by / abs(by), np.floor(at.real), int(np.rint(at.imag))


@njit(cache=True, nogil=True)
def mixed(images, weights, box, unit):
    """Views, strides, negative indices, tuples, optional and complex numbers, lists of what is not there."""
    left, top, right, bottom = box
    total, seen = 0.0, None
    rows = np.zeros(images.shape[1])
    for image in images:
        for v in range(top, bottom):
            line = image[v, left:right]
            for u in range(-1, -line.size - 1, -1):
                rows[v] += weights[u] * line[u]
            if rows[v] > 1e-3 and seen is None:
                seen = v
        rows[:] = sorted_up(rows)
        total += image[::2, -1].sum()
    place, down, right = _turned(complex(total, rows[-1]), unit)
    spread = np.sqrt(((rows - rows.mean()) ** 2).sum()) + exp(-abs(total)) + sqrt(abs(down))
    shares = (rows.max(), right // 3, right % -3, -7 // 2 + right)
    return spread, place, shares, seen, rows.reshape(-1, 2).T.copy()


@njit(cache=True, nogil=True)
def built(values):
    """Lists that become arrays, a function within, values set before a branch and used behind, an error."""

    def smaller(a, b):
        return a if a < b else b

    squares = np.array([v * v for v in values])
    ends = np.array([values[0], 2.0])
    count, rest = values.size, values[1:]
    found = 0
    try:
        if count > 3:
            raise ValueError
        found = 1
    except Exception:
        found = count
    for i in range(count):
        if i % 3 == 1:
            rest = squares[i:]
        found += int(rest[0] > smaller(squares[i], ends[1]))
    return squares, ends, rest.sum(), found


@njit(cache=True, nogil=True)
def counted(first, last, most, wide):
    """Ranges up, down, by more and of nothing, lengths of them, the less and the greater of many, zeros."""
    up, down, by_two = np.zeros(last), np.zeros((last, 2), np.int16), np.zeros((2, wide, 3), np.bool_)
    for i in range(first, last):
        up[i] = max(most, i, 2.5) - min(i, wide, most)
    for i in range(last - 1, first, -1):
        down[i] = max(i, wide), min(i - 2, wide)
    for i in range(first, last, 2):
        by_two[i % 2, i % wide] = True
    for i in range(last, first):
        up[i] = np.nan
    empty = np.empty((0, wide), np.float32)
    lengths = len(range(first, last)), len(range(last, first)), len(range(last, first, -1))
    return up, down, by_two, empty, lengths, (max(np.nan, most), max(most, np.nan), min(np.nan, most), i)


@njit(cache=True, nogil=True)
def refused(n):
    """Errors raised here, in what is called, and where no array can be made."""
    if n == -1:
        raise ValueError("a count")
    return np.ones(n).sum() + np.zeros((n, 2)).size + counted(0, n, 1.0, 2)[0].sum()
'''

RUN = """
import sys
from pathlib import Path
import numpy as np
from evlcp_sdk import compiling
if sys.argv[1] == "by itself":
    compiling._TRIED = ()
import mine
rng = np.random.default_rng(3)
said = []
images = rng.normal(size=(3, 8, 11)).astype(np.float32)
said.extend(mine.mixed(images, rng.random(11), (2, 1, 9, 7), 0.3 - 1.7j))
said.append(mine.sorted_up(rng.normal(size=9)))
said.extend(mine.built(rng.normal(size=7)))
said.extend(mine.counted(np.uint32(1), 7, -0.5, np.int16(4)))
for count in (-1, -2, 1 << 61):
    try:
        mine.refused(count)
    except (ValueError, MemoryError) as error:
        said.append(str(error))
said.append(mine.refused(3))
print([one.tolist() if hasattr(one, "tolist") else one for one in said])
print(len(list(Path(mine.__file__).parent.rglob("*.nbc"))))
"""


def said(folder: Path, way: str) -> tuple[str, int]:
    """What the kernels give, compiled in a way and kept, in all its digits, and in how many files."""
    folder.mkdir()
    (folder / "mine.py").write_text(KERNELS)
    environment = os.environ | {"PYTHONPATH": f"{folder}:{os.environ.get('PYTHONPATH', SDK)}"}
    environment.pop("NUMBA_CACHE_DIR", None)
    given = []
    for _ in range(2):
        ran = subprocess.run(
            [sys.executable, "-c", RUN, way], capture_output=True, text=True, check=True, env=environment
        )
        results, files = ran.stdout.splitlines()
        given.append((results, int(files)))
    # The second time they are only loaded.
    assert given[0] == given[1]
    return given[0]


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere kernels are compiled in place")
def test_kernels_of_the_child_give_the_same_bits(tmp_path: Path) -> None:
    whole, files = said(tmp_path / "whole", "whole")
    by_itself, more = said(tmp_path / "by", "by itself")
    assert whole == by_itself
    assert "'a count', 'negative dimensions not allowed', 'array is too big" in whole
    # Parts are kept with what they are a part of.
    assert (files, more) == (5, 8)


def test_another_version_of_numba_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    resolve = compiling.BaseFunction.get_call_type
    monkeypatch.setattr(compiling.numba, "__version__", "0.99.0")
    assert not compiling.prepare(compiling.KeptKernel())
    assert compiling.BaseFunction.get_call_type is resolve
