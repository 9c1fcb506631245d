"""Processes that decode the frames of whole bars, each with its bars' states; events are in shared memory.

What they answer is applied when it would be if it had been decoded here, so results are the same.
"""

import multiprocessing
import os
import pickle
import select
import signal
import socket
import struct
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError, EvlcpError, PluginError, WorkerError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.roles import STEPS
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.alignment import DueFrame
from evlcp_sdk.rx.placement import layout_of
from evlcp_sdk.rx.reading import BarDecoder, BarState, FrameDecoder, FrameJob, FrameResult, LocalBarDecoder
from evlcp_sdk.rx.regions import EVENT_BYTES, RegionTrack, TrackedRegion
from evlcp_sdk.values import Events, Region, SyncLock

_ROOM_BYTES: Final = 1 << 26
"""Memory that a worker's events wait in, as much as usual limits let a frame have; where it is full, answers
are awaited."""

_START_S, _STALL_S = 600.0, 60.0
"""How long it may take to start, where kernels have to be compiled, and to answer: a frame takes some ms."""

_AWAKE_S = 0.001
"""How long the other end is awaited without sleep: four bars have a frame in 0.8 ms."""

_DRAWN_PX, _FEW = 9, 0.2
"""From cluster to cluster in the frames that kernels are loaded by; share of the events of the second one."""


class Workers:
    """Some worker processes, which have started.

    Args:
        links: Whose frames they decode, by name.
        many: How many.

    Raises:
        WorkerError: One does not start.
    """

    def __init__(self, links: Mapping[str, Link], many: int) -> None:
        self._links = links
        for link in links.values():
            # Compiled here, where that is said, and kept.
            load_kernels(link)
        self._all = [_Worker(number, links) for number in range(1, many + 1)]
        for one in self._all:
            one.receive(_START_S)

    @classmethod
    def beside(cls, links: Mapping[str, Link], processes: int, *, announced: bool) -> "Workers | None":
        """The workers beside this process; None where it is the only one, or has nothing to share.

        Raises:
            ConfigError: There is none, or somebody follows the stages, which workers do not announce; or an
                algorithm cannot be sent to them.
            WorkerError: One does not start.
        """
        if processes < 1 or (processes > 1 and announced):
            why = ", as a sink or plugin follows the stages" if announced and processes > 0 else " or more"
            raise ConfigError(f"workers: {processes}, expected 1{why}")
        shared = {name: link for name, link in links.items() if _decodes_frames(link)}
        return cls(shared, processes - 1) if processes > 1 and shared else None

    def bars(self, link: str) -> list["_WorkerBars"]:
        """Those that they decode of a link; nothing of one that has none."""
        shared = self._links.get(link)
        return [] if shared is None else [_WorkerBars(one, link, shared.regions.step_us) for one in self._all]

    def close(self) -> None:
        """End them."""
        for one in self._all:
            one.close()


def _decodes_frames(link: Link) -> bool:
    """Whether a link has frames of bars that can be decoded by themselves."""
    return link.algorithm("framing").roles >= STEPS and link.algorithm("detection").rhythmic


class _Worker:
    """One worker process; it answers in order."""

    def __init__(self, number: int, links: Mapping[str, Link]) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._pipe, far_end = spawn.Pipe()
        memory = spawn.RawArray("B", _ROOM_BYTES)
        self._memory = np.frombuffer(memory, np.uint8)
        arguments = far_end, memory, dict(links)
        self._process = spawn.Process(target=_work, args=arguments, name=f"worker {number}", daemon=True)
        try:
            self._process.start()
        except (pickle.PickleError, AttributeError, TypeError) as fault:
            raise ConfigError(f"workers: an algorithm cannot be sent to another process: {fault}") from fault
        far_end.close()
        self._ready = _watched(self._pipe)
        with socket.socket(fileno=os.dup(self._pipe.fileno())) as sender:
            timeout = struct.pack("ll", *divmod(int(_STALL_S * 1e6), 1_000_000))
            sender.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, timeout)
        # Of each request that is not answered, oldest first, where its events lie and where the answer goes.
        self._open: deque[tuple[range, list[Any]]] = deque()
        self._next = 0

    def send(self, *request: Any) -> None:
        """Send what has no answer."""
        try:
            # A pipe's own `send` makes a pickler in Python each time.
            self._pipe.send_bytes(pickle.dumps(request))
        except BlockingIOError as fault:
            raise self._stalled(_STALL_S) from fault
        except OSError as fault:
            raise self._ended() from fault

    def ask(self, *request: Any, room: range = range(0)) -> Callable[[], Any]:
        """Send what has an answer, with its events in a part of the memory; gives what to call for that."""
        while self._open and self._ready.poll(0):
            self._receive_oldest()
        self.send(*request)
        answer: list[Any] = []
        self._open.append((room, answer))

        def wait() -> Any:
            while not answer:
                self._receive_oldest()
            return answer[0]

        return wait

    def placed(self, pieces: list[tuple[int, Events]]) -> tuple[list[tuple[int, int, int]], range]:
        """Copy a job's events to where the worker finds them.

        Returns:
            (start us, first byte, how many) of each piece, and the part of the memory that they take.

        Raises:
            WorkerError: There are more than it holds.
        """
        sizes = [-(-EVENT_BYTES * events.t_us.size // 8) * 8 for _, events in pieces]
        total = sum(sizes)
        if total > _ROOM_BYTES:
            raise WorkerError(
                f"a frame has {total} bytes of events, a worker takes {_ROOM_BYTES}: use one core"
            )
        # From the start again where nothing is open: so little of it is used, and stays in a cache.
        begin = self._next if self._open and self._next + total <= _ROOM_BYTES else 0
        room = range(begin, begin + total)
        while any(begin < taken.stop and taken.start < room.stop for taken, _ in self._open):
            self._receive_oldest()
        self._next, where = room.stop, []
        for (start_us, events), size in zip(pieces, sizes, strict=True):
            many = events.t_us.size
            where.append((start_us, begin, many))
            columns = events.t_us, events.x, events.y, events.p
            for into, column in zip(_columns_at(self._memory, begin, many), columns, strict=True):
                into[:] = column
            begin += size
        return where, room

    def receive(self, within_s: float) -> Any:
        """The next answer.

        Raises:
            WorkerError: It has ended, or takes too long, or what failed there.
        """
        try:
            if not _poll(self._ready, within_s):
                raise self._stalled(within_s)
            answer = self._pipe.recv()
        except (OSError, EOFError) as fault:
            raise self._ended() from fault
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self) -> None:
        """End it."""
        self._pipe.close()
        self._process.kill()
        self._process.join()

    def _receive_oldest(self) -> None:
        self._open[0][1].append(self.receive(_STALL_S))
        self._open.popleft()

    @property
    def _name(self) -> str:
        return f"{self._process.name} of the receiver, process {self._process.pid},"

    def _stalled(self, for_s: float) -> WorkerError:
        """It does nothing, and is ended."""
        self._process.kill()
        return WorkerError(f"{self._name} did not answer for {for_s:g} s, and was ended: receive again")

    def _ended(self) -> WorkerError:
        """It has ended, and how."""
        self._process.join(1.0)
        code = self._process.exitcode
        how = f"by {signal.Signals(-code).name}" if code is not None and code < 0 else f"with code {code}"
        return WorkerError(f"{self._name} ended {how}; what it was decoding is lost: receive again")


class _WorkerBars:
    """`BarDecoder` of one link that a worker decodes."""

    is_immediate = False

    def __init__(self, worker: _Worker, link: str, step_us: int) -> None:
        self._worker, self._link, self._step_us = worker, link, step_us
        self._bars: set[int] = set()

    def __len__(self) -> int:
        return len(self._bars)

    def put_state(self, bar: int, state: BarState) -> None:
        """See `BarDecoder`."""
        self._bars.add(bar)
        self._worker.send("put", self._link, bar, state)

    def take_state(self, bar: int) -> BarState:
        """See `BarDecoder`."""
        self._bars.remove(bar)
        state: BarState = self._worker.ask("take", self._link, bar, None)()
        return state

    def decode(self, bar: int, job: FrameJob) -> Callable[[], FrameResult | None]:
        """See `BarDecoder`."""
        region, due = job.region, job.due
        pieces, room = self._worker.placed(region.pieces_between(due.start_us, due.read_us, self._step_us))
        bare = TrackedRegion(region.id, region.track, region.first_us, size_px=region.size_px)
        return self._worker.ask("decode", self._link, bar, (job._replace(region=bare), pieces), room=room)


def _watched(pipe: Connection) -> select.poll:
    """Says whether there is something to receive: a pipe's own `poll` takes ten times as long."""
    ready = select.poll()
    ready.register(pipe.fileno(), select.POLLIN)
    return ready


def _poll(ready: select.poll, within_s: float | None) -> bool:
    """Wait until there is something to receive; whether there is.

    At first without sleep: who sleeps is woken on the core of the one that wakes it, which then waits.
    """
    sleeps_s = time.perf_counter() + _AWAKE_S
    while time.perf_counter() < sleeps_s:
        os.sched_yield()
        if ready.poll(0):
            return True
    return bool(ready.poll(None if within_s is None else within_s * 1000))


def _columns_at(memory: NDArray[np.uint8], begin: int, many: int) -> _kernels.Columns:
    """Times, columns, rows and polarities of so many events from a byte of the memory on."""
    x, y, p = begin + 8 * many, begin + 10 * many, begin + 12 * many
    t_us, xs = memory[begin:x].view(np.int64), memory[x:y].view(np.uint16)
    return t_us, xs, memory[y:p].view(np.uint16), memory[p : p + many]


def _work(pipe: Connection, memory: Any, links: Mapping[str, Link]) -> None:
    """A worker's life: until the other end of the pipe is closed."""
    # Who asks for its end by the keyboard means the process that closes the pipe then.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    shared, ready = np.frombuffer(memory, np.uint8), _watched(pipe)
    try:
        bars = {name: LocalBarDecoder(FrameDecoder(link)) for name, link in links.items()}
        for link in links.values():
            load_kernels(link)
        pipe.send(None)
        while True:
            _poll(ready, None)
            kind, name, bar, given = pipe.recv()
            if kind == "put":
                bars[name].put_state(bar, given)
            elif kind == "take":
                pipe.send(bars[name].take_state(bar))
            else:
                job, pieces = given
                pipe.send(_decode(bars[name], bar, job, pieces, shared))
    except (EOFError, OSError):
        return


def _decode(
    bars: BarDecoder, bar: int, job: FrameJob, pieces: list[tuple[int, int, int]], memory: NDArray[np.uint8]
) -> FrameResult | Exception | None:
    """What a frame says, or what failed."""
    job.region.pieces = deque(
        (start_us, Events.from_columns(*_columns_at(memory, begin, many))) for start_us, begin, many in pieces
    )
    try:
        found = bars.decode(bar, job)()
        _measure_spread(found)
    except EvlcpError as fault:
        return fault
    except Exception as fault:
        return RuntimeError(f"{type(fault).__name__}: {fault}\n{traceback.format_exc()}")
    return found


def _measure_spread(found: FrameResult | None) -> None:
    """Measure how light spreads in a frame now: until then it holds the pilot."""
    if found is not None and found.reading.spread is not None:
        found.reading.spread()


def load_kernels(link: Link) -> None:
    """Decode two frames of a drawn bar, a clear one and one of few events: takes a second, the first time."""
    book, rng = link.codebook, np.random.default_rng(0)
    layout = layout_of(link.bar.cluster_centres_m())
    centres = layout.centres_m * _DRAWN_PX / layout.spacing_m
    middle = complex(link.camera.width, link.camera.height) / 2
    side = np.arange(_DRAWN_PX - 2) - _DRAWN_PX // 2
    places = np.rint(centres - centres.mean() + middle)[:, None, None] + side + 1j * side[:, None]
    symbols = np.arange(book.clusters) % len(book.codewords)
    chips = np.concatenate([book.pilots, book.codewords[symbols]], 1).astype(np.int8)
    edges = np.diff(chips, axis=1, prepend=0, append=0)
    cluster, chip = np.nonzero(edges)
    shape = len(chip), places[0].size
    ends = np.ptp(centres.real) + _DRAWN_PX, np.ptp(centres.imag) + _DRAWN_PX
    chip_us, many = link.packet.chip_us, chips.shape[1]
    lock, end_us = SyncLock(0.0, chip_us, 0.0, 0.0, 1.0), many * chip_us
    middle_us = link.packet.pilot_chips // 2 * chip_us
    read_us = end_us + book.trailing_chips * chip_us
    due = DueFrame(0, 0, 0, many, True, 0.0, 0.0, end_us, lock, read_us, middle_us)
    t_us = (chip[:, None] + rng.uniform(0.1, 0.9, shape)) * chip_us
    pixels = places.reshape(book.clusters, -1)[cluster]
    columns = t_us, pixels.real, pixels.imag, np.broadcast_to(edges[cluster, chip][:, None] > 0, shape)
    order = np.argsort(t_us, axis=None)
    events = Events.of(*(column.ravel()[order].astype(np.int64) for column in columns))
    decoder = FrameDecoder(link)
    bars = LocalBarDecoder(decoder)
    for some in (events, events[rng.random(len(events)) < _FEW]):
        region = TrackedRegion(
            0, RegionTrack([Region(0, t, middle.real, middle.imag, *ends) for t in (0.0, due.end_us)]), 0
        )
        region.size_px = ends
        region.add(0, some)
        bars.put_state(0, decoder.init_state())
        # An algorithm that fails here and with no frame of a camera is no matter.
        with suppress(PluginError):
            _measure_spread(bars.decode(0, FrameJob(region, due, None, ranged=True))())
