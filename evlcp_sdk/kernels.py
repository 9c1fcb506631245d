"""What every kernel is compiled with: numba, its cache where there can be one, a process to compile in.

A wheel may hold compiled kernels (`pack`): they are taken where Numba, Python and the processor are those
that they were made for and their source is the same; else they are compiled, as they are without.

LLVM keeps most of what it took to compile, some 300 MB for all kernels of the receiver. A kernel that goes
into the cache is therefore compiled by a child, which ends when it has grown, and loaded from there.
"""

import fcntl
import gc
import hashlib
import importlib
import io
import logging
import os
import pickle
import platform
import signal
import sys
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property, wraps
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import llvmlite
import llvmlite.binding
import numba
import numpy as np
from numba.core.caching import FunctionCache
from numba.core.compiler import CompileResult
from numba.core.environment import Environment, _rebuild_env
from numba.core.event import Event, Listener, register, trigger_event
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature

from evlcp_sdk.signals import ENDING

if TYPE_CHECKING:
    from evlcp_sdk.compiling import KeptKernel

__all__ = ["njit", "pack"]

F = TypeVar("F", bound=Callable[..., Any])

_GROWN_MB = 250
"""How much a child may grow before another takes its place, which compiles some helpers once more."""

_LONG_S = 2.0
"""Time spent on compiling after which that is said."""

_IDLE_S = 5.0
"""How long a child waits for another kernel."""

_FEATURES = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "popcnt", "xsave")
"""What a processor of level x86-64-v3 has, for which kernels are packed."""


def njit(*, cache: bool = False, **options: Any) -> Callable[[F], F]:
    """As `numba.njit`, but a cache that cannot be written or read does not matter.

    Where the package is installed read-only and there is no home, or on a full disk, kernels are compiled in
    each process. Where they can be kept, a child of it compiles them, unless it has threads; of several
    processes one compiles a kernel, and the others wait for it.

    A name with an underscore is called by kernels alone, never from Python: what that takes is left out, as
    what calls from C would take.
    """

    def compile_(function: F) -> F:
        inner = function.__name__.startswith("_")
        all_options: dict[str, Any] = options | {"no_cfunc_wrapper": True, "no_cpython_wrapper": inner}
        kernel = numba.njit(**all_options)(function)
        if cache:
            kernel._cache = kept = _Cache(function)
            kernel.compile = kept.guarded(kernel.compile)
        if inner:
            # Numba would call what there is not.
            kernel._insert = lambda *_, **__: None
            kernel._compile_for_args = _refuse
        compiled: F = kernel
        return compiled

    return compile_


def _refuse(*_: object, **__: object) -> NoReturn:
    raise TypeError("a kernel whose name has an underscore is called by kernels alone")


def pack(folder: Path) -> Path:
    """Write what is kept of the kernels that this process has imported into a file, and return its path.

    It is for a wheel's `evlcp_sdk/data/kernels`. All is to be compiled for the processor's level, with
    `NUMBA_CPU_NAME=x86-64-v3` and `NUMBA_CPU_FEATURES=+avx2`.
    """
    places: dict[tuple[str, str, str], tuple[int, int]] = {}
    sources: dict[str, bytes] = {}
    parts: list[bytes] = []
    at = 0
    for module in [m for name, m in sorted(sys.modules.items()) if name.endswith("_kernels")]:
        for name, kernel in sorted(vars(module).items()):
            if kernel is None or not isinstance(getattr(kernel, "_cache", None), _Cache):
                continue
            if kernel.py_func.__module__ != module.__name__:
                continue
            for args, state in kernel._cache.kept(kernel.targetctx):
                # What it says of types names this machine's files.
                state = (*state[:6], "", *state[7:])
                part = zlib.compress(dumps(state), 9)  # type: ignore[no-untyped-call]
                places[module.__name__, name, str(args)] = (at, len(part))
                parts.append(part)
                at += len(part)
            sources[module.__name__] = _digest(module)
    head = pickle.dumps((places, sources))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / _name_of_pack()
    path.write_bytes(len(head).to_bytes(8, "little") + head + b"".join(parts))
    return path


def _name_of_pack() -> str:
    """File of packed kernels for this Python, Numba and NumPy."""
    return (
        f"{sys.implementation.cache_tag}-numba{numba.__version__}-llvmlite{llvmlite.__version__}"
        f"-numpy{np.__version__.split('.')[0]}-x86-64-v3.bin"
    )


def _digest(module: ModuleType) -> bytes:
    """Of its source."""
    assert module.__file__ is not None
    return hashlib.sha256(Path(module.__file__).read_bytes()).digest()


class _Packed:
    """The kernels that came with the package, if there are any for this machine; read when one is needed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._places: dict[tuple[str, str, str], tuple[int, int]] | None = None
        self._sources: dict[str, bytes] = {}
        self._same: dict[str, bool] = {}
        self._file = -1
        self._begin = 0

    def find(self, module: str, name: str, args: Any, target_context: Any) -> Any:
        """A kernel for argument types, or None."""
        try:
            if self._places is None:
                self._places = self._read()
            place = self._places.get((module, name, str(args)))
            if place is None or not self._is_same(module):
                return None
            part = os.pread(self._file, place[1], self._begin + place[0])
            state = _unpickled(zlib.decompress(part))
            _make_ready(target_context)
            return CompileResult._rebuild(target_context, *state)  # type: ignore[no-untyped-call]
        except Exception:
            # Whatever is wrong with the file: kernels are compiled as if it were not there.
            self._places = {}
            return None

    def _read(self) -> dict[tuple[str, str, str], tuple[int, int]]:
        path = self._folder / _name_of_pack()
        if not (path.exists() and _is_usual()):
            return {}
        self._file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        size = int.from_bytes(os.pread(self._file, 8, 0), "little")
        places, self._sources = pickle.loads(os.pread(self._file, size, 8))
        self._begin = 8 + size
        found: dict[tuple[str, str, str], tuple[int, int]] = places
        return found

    def _is_same(self, module: str) -> bool:
        if module not in self._same:
            self._same[module] = self._sources[module] == _digest(sys.modules[module])
        return self._same[module]


def _is_usual() -> bool:
    """Whether this processor runs packed kernels, and nobody wants them compiled in another way."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return False
    own = {"NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS"}
    if any(name.startswith("NUMBA_") and name not in own for name in os.environ):
        return False
    has = llvmlite.binding.get_host_cpu_features()
    return all(has.get(feature, False) for feature in _FEATURES)


_PACKED = _Packed(Path(__file__).parent / "data" / "kernels")


class _Cache:
    """Where a kernel is looked for: among those of the package, in a folder, by having it compiled.

    Args:
        function: What is to be compiled.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._place = (function.__module__, function.__qualname__)
        self._function = function
        self._locked: list[tuple[int, int]] = []

    @cached_property
    def _folder(self) -> "_Folder | None":
        """Found when a kernel is used: Numba tries to write into it."""
        # numba says so by a RuntimeError where it finds no folder.
        with suppress(RuntimeError, OSError):
            return _Folder(self._function)  # type: ignore[no-untyped-call]
        return None

    @property
    def cache_path(self) -> str | None:
        """Folder of what is kept."""
        return None if self._folder is None else self._folder.cache_path

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kernel for a signature; None where it is to be compiled here."""
        within = _KEPT is not None and not _KEPT.is_it(*self._place)
        if within and self._place[1].startswith("_"):
            # It is kept as a part of others.
            return None
        args, _ = normalize_signature(sig)  # type: ignore[no-untyped-call]
        found = _PACKED.find(*self._place, args, target_context)
        if found is not None or self._folder is None:
            return found
        found = self._folder.load_overload(sig, target_context)
        if found is None and _COMPILER.is_ready():
            with trigger_event("numba:compile"):
                compiled = _COMPILER.compile(*self._place, sig)
            found = self._folder.load_overload(sig, target_context) if compiled else None
        if found is None and not within and self._lock():
            found = self._folder.load_overload(sig, target_context)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a kernel that was compiled here."""
        if self._folder is not None and (_KEPT is None or _KEPT.is_it(*self._place)):
            self._folder.save_overload(sig, data)  # type: ignore[no-untyped-call]

    def kept(self, target_context: Any) -> Iterator[tuple[Any, tuple[Any, ...]]]:
        """Argument types and state of all that the folder has of the kernel for this processor."""
        if self._folder is not None:
            yield from self._folder.states(target_context)

    def guarded(self, compile_: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """A kernel's `compile`, after which others may compile it."""

        @wraps(compile_)
        def guarded(sig: Any) -> Any:
            held = len(self._locked)
            try:
                return compile_(sig)
            finally:
                while len(self._locked) > held:
                    _LOCKS.let_go(*self._locked.pop())

        return guarded

    def _lock(self) -> bool:
        """Wait until no other process compiles this kernel; False where that cannot be known."""
        assert self._folder is not None
        held = _LOCKS.take(self._folder.cache_path, self._place[1])
        if held is not None:
            self._locked.append(held)
        return held is not None


class _Locks:
    """A byte for each kernel in one file a folder, locked by the process that compiles it.

    A process that ends lets go. Kernels that call one another in a circle there are none, so nobody waits for
    whoever waits for them; where two share a byte the system says so, and both compile.
    """

    def __init__(self) -> None:
        self._files: dict[str, int] = {}
        self._home = os.getpid()

    def take(self, folder: str, name: str) -> tuple[int, int] | None:
        """Wait for a kernel's byte; None where files cannot be locked."""
        if self._home != os.getpid():
            # Locks are not inherited, but closing a file of the parent's lets none of its locks go either.
            self._files, self._home = {}, os.getpid()
        try:
            if folder not in self._files:
                flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC
                self._files[folder] = os.open(f"{folder}/kernels.lock", flags, 0o644)
            file, at = self._files[folder], zlib.crc32(name.encode())
            fcntl.lockf(file, fcntl.LOCK_EX, 1, at)
        except OSError:
            return None
        return file, at

    def let_go(self, file: int, at: int) -> None:
        """Let others have it."""
        with suppress(OSError):
            fcntl.lockf(file, fcntl.LOCK_UN, 1, at)


_LOCKS = _Locks()


class _Folder(FunctionCache):
    """A kernel's files, which may be refused at any time."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What the folder has for a signature.

        Two processes that keep a kernel at the same time may take the same file for two signatures.
        """
        found = None
        _make_ready(target_context)
        with self._guard_against_spurious_io_errors():
            key = self._index_key(sig, target_context.codegen())  # type: ignore[no-untyped-call]
            name = self._cache_file._load_index().get(key)  # type: ignore[no-untyped-call]
            if name is not None:
                kept = Path(self._cache_file._data_path(name)).read_bytes()  # type: ignore[no-untyped-call]
                found = CompileResult._rebuild(target_context, *_unpickled(kept))  # type: ignore[no-untyped-call]
        wanted, _ = normalize_signature(sig)  # type: ignore[no-untyped-call]
        return None if found is None or tuple(found.signature.args) != tuple(wanted) else found

    def states(self, target_context: Any) -> Iterator[tuple[Any, tuple[Any, ...]]]:
        """Argument types and state of each kernel in it for this processor."""
        for key, name in self._cache_file._load_index().items():  # type: ignore[no-untyped-call]
            args, _ = normalize_signature(key[0])  # type: ignore[no-untyped-call]
            if key == self._index_key(key[0], target_context.codegen()):  # type: ignore[no-untyped-call]
                yield args, self._cache_file._load_data(name)  # type: ignore[no-untyped-call]

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        with suppress(OSError):
            yield


class _Patience(Listener):
    """Says once in a process, to the log, that kernels are being compiled, when that takes long."""

    def __init__(self) -> None:
        self._spent_s = self._began_s = 0.0
        self._depth = 0
        self._told = False

    def on_start(self, event: Event) -> None:
        """A kernel begins, which may need others."""
        if not self._depth:
            self._began_s = time.perf_counter()
            self._tell()
        self._depth += 1

    def on_end(self, event: Event) -> None:
        """It ends."""
        self._depth -= 1
        if not self._depth:
            self._spent_s += time.perf_counter() - self._began_s
            self._tell()

    def _tell(self) -> None:
        if self._spent_s > _LONG_S and not self._told:
            self._told = True
            logging.getLogger(__name__).info("compiling kernels, once on a machine; up to a minute in all")


def _make_ready(target_context: Any) -> None:
    """Let kernels that were compiled before be loaded.

    They need the symbols that Numba's runtime adds. What `target_context.refresh()` brings beside, all that
    Numba can compile, takes longer than to load every kernel; it comes with the first that is compiled here.
    """
    rtsys.initialize(target_context)


class _Unpickler(pickle.Unpickler):
    """Reads a kernel without the modules of Numba's that were needed to compile it."""

    def find_class(self, module: str, name: str) -> Any:
        """What a name in it stands for."""
        if (module, name) == (_rebuild_env.__module__, _rebuild_env.__name__):
            return _environment
        return super().find_class(module, name)


def _unpickled(kept: bytes) -> Any:
    """What is kept of a kernel."""
    return _Unpickler(io.BytesIO(kept)).load()


def _environment(module: str, constants: list[Any], name: str) -> Environment:
    """What compiled code finds its constants in; it looks up no global of the module that it is from.

    Those that came from Numba are not imported for it: some bring half of SciPy.
    """
    if module in sys.modules or module.partition(".")[0] != "numba" or name in Environment._memo:
        return _rebuild_env(module, constants, name)  # type: ignore[no-untyped-call, no-any-return]
    environment = Environment({"__name__": module})
    environment.consts[:] = constants
    environment.env_name = name
    Environment._memo[name] = environment
    return environment


class _Compiler:
    """A child that puts kernels into the cache; forked when there is one to compile, and gone soon after."""

    def __init__(self) -> None:
        self._child = 0
        self._pipe: Connection | None = None
        self._home = os.getpid()

    def is_ready(self) -> bool:
        """Whether there may be a child: without other threads, nobody else holds a lock that it needs."""
        return sys.platform == "linux" and os.getpid() == self._home and threading.active_count() == 1

    def compile(self, module: str, name: str, sig: Any) -> bool:
        """Have a kernel compiled and kept; whether that was tried."""
        # A child that has grown or waited too long is gone.
        for _ in range(2):
            try:
                if self._pipe is None:
                    self._fork()
                assert self._pipe is not None
                self._pipe.send((module, name, sig))
                return bool(self._pipe.recv())
            except (EOFError, OSError):
                self._end()
            except Exception:
                # A signature that cannot be sent.
                self._end()
                return False
            except BaseException:
                # An interrupt would leave an answer behind.
                self._end()
                raise
        return False

    def _fork(self) -> None:
        ours, theirs = Pipe()
        with warnings.catch_warnings():
            # Later Pythons warn of threads of libraries, too, which the child does not use.
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if child == 0:
            ours.close()
            _serve(theirs)
        theirs.close()
        self._child, self._pipe = child, ours

    def _end(self) -> None:
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
            # Somebody else may have been told of its end.
            with suppress(ChildProcessError):
                if os.waitpid(self._child, os.WNOHANG) == (0, 0):
                    os.kill(self._child, signal.SIGKILL)
                    os.waitpid(self._child, 0)


_COMPILER = _Compiler()

_KEPT: "KeptKernel | None" = None
"""In a child: the kernel that is to be kept; it keeps no other."""

register("numba:compile", _Patience())  # type: ignore[no-untyped-call]


def _serve(pipe: Connection) -> NoReturn:
    """What the child does until its parent ends, it has grown, or nothing comes; it says nothing."""
    try:
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)
        silence = os.open(os.devnull, os.O_RDWR)
        for said in (0, 1, 2):
            os.dup2(silence, said)
        warnings.simplefilter("ignore")
        # To look through what the parent has would copy it; what compiling leaves is looked at less often.
        gc.freeze()
        gc.set_threshold(100_000)
        from evlcp_sdk import compiling

        kept = compiling.KeptKernel()
        global _KEPT
        _KEPT = kept if compiling.prepare(kept) else None
        most_pages = _resident_pages() + (_GROWN_MB << 20) // os.sysconf("SC_PAGE_SIZE")
        while pipe.poll(_IDLE_S):
            module, name, sig = pipe.recv()
            kernel = getattr(importlib.import_module(module), name, None)
            if kernel is not None:
                kept.place = module, name
                # As a part of another it has nothing to be called by.
                kernel.overloads.pop(tuple(sig), None)
                with suppress(Exception):
                    kernel.compile(sig)
            pipe.send(kernel is not None)
            if _resident_pages() > most_pages:
                break
    finally:
        os._exit(0)


def _resident_pages() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1])
