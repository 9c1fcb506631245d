"""Kernels work where no cache can be written."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.kernels import _is_usual, njit

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


@pytest.mark.parametrize("refuses", ["save", "_load_index"])
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


def test_a_kernel_with_an_underscore_is_called_by_kernels_alone() -> None:
    @njit(nogil=True)
    def _third(x: float) -> float:
        return x / 3

    @njit(nogil=True)
    def ninth(x: float) -> float:
        return _third(_third(x))

    assert ninth(18.0) == 2.0
    for _ in range(2):
        with pytest.raises(TypeError, match="by kernels alone"):
            _third(18.0)


KERNEL = """
import numpy as np
from evlcp_sdk.kernels import njit


@njit(cache=True)
def half(x):
    return x / 2


@njit(cache=True)
def twice(x):
    return half(4 * x)


@njit(cache=True)
def sorted_sum(n):
    many = np.empty(n)
    for i in range(n):
        many[i] = n - i
    if n < 0:
        raise ValueError("a count")
    return np.argsort(many)[0], np.sum(many)
"""

COMPILED = """
import os, threading
from numba.core.event import install_timer
import mine
forks, compiled, fork = [], [], os.fork
os.fork = lambda: (forks.append(1), fork())[1]
{before}
with install_timer("numba:compile", compiled.append):
    said = mine.twice(2)
print(said, len(forks), len(compiled))
"""

THREAD = "end = threading.Event(); threading.Thread(target=end.wait, daemon=True).start()"
DIES = "import evlcp_sdk.kernels; evlcp_sdk.kernels._serve = lambda pipe: os._exit(1)"
NO_FORK = """
def fork():
    raise BlockingIOError("no more processes")
"""


def ran(folder: Path, code: str) -> str:
    """What Python prints that finds the module `mine` in a folder."""
    (folder / "mine.py").write_text(KERNEL)
    environment = os.environ | {"PYTHONPATH": f"{folder}:{os.environ.get('PYTHONPATH', SDK)}"}
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    ).stdout


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it is compiled in place")
@pytest.mark.parametrize(
    ("before", "forks"),
    [("", 1), (THREAD, 0), (DIES, 4), (NO_FORK, 4)],
    ids=["child", "thread", "dies", "none"],
)
def test_a_kernel_is_compiled_in_a_child_or_else_here_and_then_kept(
    tmp_path: Path, before: str, forks: int
) -> None:
    """Where it is tried in vain, it is so for the kernel within, too, and twice, as a child may have aged.

    Either way that is compiling, as `install_timer` has it: a run's speed is told without it.
    """
    said = ran(tmp_path, COMPILED.format(before=before)).split()
    assert said[:2] == ["4.0", str(forks)]
    assert int(said[2]) > 0
    if not before:
        assert ran(tmp_path, COMPILED.format(before="")) == "4.0 0 0\n"


WITHOUT = """
import sys
import numpy, scipy, mine
print(mine.sorted_sum(4), "numba.np.arraymath" in sys.modules, "scipy.linalg" in sys.modules)
try:
    mine.sorted_sum(-1)
except ValueError as error:
    print(error)
print(mine.twice(2.5), mine.sorted_sum(numpy.int32(3)))
"""


def test_a_kept_kernel_is_loaded_without_what_compiles(tmp_path: Path) -> None:
    """It takes as long as many kernels, and brings SciPy's linear algebra; a new signature then needs it."""
    ran(tmp_path, "import mine; mine.sorted_sum(4)")
    assert ran(tmp_path, WITHOUT).splitlines() == [
        "(3, 10.0) False False",
        "negative dimensions not allowed",
        "5.0 (2, 6.0)",
    ]


def test_a_cache_whose_files_were_mixed_up_is_not_believed(tmp_path: Path) -> None:
    """Two processes that keep a kernel at once may take one file for two signatures."""
    code = "import mine; print(mine.twice(2), mine.twice(1.5))"
    want = "4.0 3.0\n"
    assert ran(tmp_path, code) == want
    files = sorted((tmp_path / "__pycache__").glob("mine.twice-*.nbc"))
    assert len(files) == 2
    texts = [file.read_bytes() for file in files]
    for file, text in zip(files, texts[1:] + texts[:1], strict=True):
        file.write_bytes(text)
    assert ran(tmp_path, code) == want


INTERRUPTED = """
import os, signal, time
import evlcp_sdk.kernels as kernels
import mine
serve, children, fork = kernels._serve, [], os.fork
def told():
    children.append(fork())
    if children[-1]:
        signal.setitimer(signal.ITIMER_REAL, 0.2 if len(children) == 1 else 0)
    return children[-1]
os.fork = told
kernels._serve = lambda pipe: time.sleep(600)
signal.signal(signal.SIGALRM, signal.default_int_handler)
try:
    mine.twice(2)
except KeyboardInterrupt:
    print("interrupted")
try:
    os.kill(children[0], 0)
except ProcessLookupError:
    print("gone")
kernels._serve = serve
print(mine.twice(2), len(children))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it is compiled in place")
def test_an_interrupt_ends_the_child_that_compiles(tmp_path: Path) -> None:
    assert ran(tmp_path, INTERRUPTED).split() == ["interrupted", "gone", "4.0", "2"]


ORPHANED = """
import os, mine
fork = os.fork
def told():
    child = fork()
    if child:
        print(child, flush=True)
    return child
os.fork = told
mine.twice(2)
os._exit(0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it is compiled in place")
def test_the_child_ends_with_its_parent(tmp_path: Path) -> None:
    began = time.monotonic()
    child = int(ran(tmp_path, ORPHANED))
    while Path(f"/proc/{child}/cmdline").exists() and time.monotonic() - began < 60:
        if not Path(f"/proc/{child}/cmdline").read_bytes():
            break
        time.sleep(0.02)
    else:
        assert time.monotonic() - began < 60


def test_a_child_that_has_grown_makes_room_for_another(tmp_path: Path) -> None:
    code = "import evlcp_sdk.kernels; evlcp_sdk.kernels._GROWN_MB = -1000\n"
    code += COMPILED.format(before="").replace("mine.twice(2)", "mine.twice(2) + mine.twice(2j).imag")
    assert ran(tmp_path, code).split()[:2] == ["8.0", "2" if sys.platform == "linux" else "0"]


def test_compiling_is_said_when_it_takes_long(caplog: pytest.LogCaptureFixture) -> None:
    from evlcp_sdk import kernels

    now_s = iter([0.0, 1.5, 10.0, 11.0, 20.0, 25.0])
    patience = kernels._Patience()
    with pytest.MonkeyPatch.context() as patch, caplog.at_level("INFO", "evlcp_sdk"):
        patch.setattr(kernels.time, "perf_counter", lambda: next(now_s))
        for said in (0, 1, 1):
            patience.on_start(None)  # type: ignore[arg-type]
            # One that it needs.
            patience.on_start(None)  # type: ignore[arg-type]
            patience.on_end(None)  # type: ignore[arg-type]
            patience.on_end(None)  # type: ignore[arg-type]
            assert len(caplog.messages) == said
    assert caplog.messages[0].startswith("compiling kernels")


PACKS = """
import sys
from pathlib import Path
import mine_kernels
mine_kernels.twice(2)
mine_kernels.twice(2.5)
from evlcp_sdk.kernels import pack
print(pack(Path(sys.argv[1])).name)
"""

TAKES = """
import sys
from pathlib import Path
from numba.core.event import install_timer
from evlcp_sdk import kernels
kernels._PACKED = kernels._Packed(Path(sys.argv[1]))
{before}
import mine_kernels
compiled = []
with install_timer("numba:compile", compiled.append):
    said = mine_kernels.twice(2), mine_kernels.twice(1.5)
print(*said, len(compiled))
"""

FORGED = """
path = next(Path(sys.argv[1]).iterdir())
path.write_bytes(path.read_bytes()[:-200])
"""


def told(folder: Path, code: str, **environment: str) -> list[str]:
    """Words that Python prints that finds `mine_kernels` in a folder and keeps kernels nowhere else."""
    paths = f"{folder}:{os.environ.get('PYTHONPATH', SDK)}"
    own = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    return subprocess.run(
        [sys.executable, "-c", code, str(folder / "packed")],
        capture_output=True,
        text=True,
        check=True,
        env=own | {"PYTHONPATH": paths} | environment,
    ).stdout.split()


@pytest.mark.skipif(not _is_usual(), reason="packed kernels are for other processors")
def test_packed_kernels_are_taken_where_they_fit_and_else_compiled(tmp_path: Path) -> None:
    source = tmp_path / "mine_kernels.py"
    source.write_text(KERNEL)
    level = {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": "+avx2"}
    (name,) = told(tmp_path, PACKS, NUMBA_CACHE_DIR=str(tmp_path / "cache"), **level)
    assert name.endswith("x86-64-v3.bin")
    result = ["4.0", "3.0"]
    # As in a read-only installation without a home.
    nowhere = "kernels.FunctionCache._impl_class._locator_classes = []"
    assert told(tmp_path, TAKES.format(before=nowhere)) == [*result, "0"]
    assert told(tmp_path, TAKES.format(before="")) == [*result, "0"]
    assert not list((tmp_path / "__pycache__").glob("*.nb?"))
    others = (
        "kernels._FEATURES += ('none-has-this',)",
        "kernels.numba.__version__ = '0.0'",
        "kernels.platform.machine = lambda: 'aarch64'",
    )
    for other in others:
        assert told(tmp_path, TAKES.format(before=f"{nowhere}; {other}"))[:2] == result
        assert int(told(tmp_path, TAKES.format(before=f"{nowhere}; {other}"))[2]) > 0


AT_ONCE = """
import sys, time
from pathlib import Path
from numba.core.event import Listener, register
class Counts(Listener):
    def on_start(self, event):
        if event.data:
            print(event.data["dispatcher"].__name__, flush=True)
    def on_end(self, event):
        pass
register("numba:compile", Counts())
from evlcp_sdk import kernels
kernels._COMPILER.is_ready = lambda: False
save = kernels._Folder.save_overload
kernels._Folder.save_overload = lambda *of: (time.sleep(0.3), save(*of))
import mine
print("imported", flush=True)
sys.stdin.readline()
print(mine.twice(2))
"""


def test_of_two_processes_one_compiles_a_kernel_and_the_other_waits(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(KERNEL)
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', SDK)}"}
    both = [
        subprocess.Popen(
            [sys.executable, "-c", AT_ONCE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for _ in range(2)
    ]
    for one in both:
        assert one.stdout is not None
        assert one.stdout.readline() == "imported\n"
    for one in both:
        assert one.stdin is not None
        one.stdin.write("\n")
        one.stdin.flush()
    said = [word for one in both for word in one.communicate()[0].split()]
    assert sorted(said) == ["4.0", "4.0", "half", "twice"]
