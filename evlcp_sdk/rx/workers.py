"""Processes that decode the frames of whole bars, each with its bars' states; events are in shared memory.

Their results are applied when those of this process would be, so they are the same.
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
from evlcp_sdk.rx.reading import BarDecoder, BarState, FrameDecoder, FrameJob, FrameResult
from evlcp_sdk.rx.regions import EVENT_BYTES, Piece, RegionTrack, TrackedRegion
from evlcp_sdk.values import Events, Region, SyncLock

_MEMORY_BYTES: Final = 1 << 26
"""Memory for a worker's events, as much as usual limits let a frame have; where it is full, results are
awaited."""

_START_S, _STALL_S = 600.0, 60.0
"""Time to start, where kernels have to be compiled, and to answer: a frame takes some ms."""

_SPIN_S = 0.001
"""Time for which the other end is awaited without sleep: four bars have a frame in 0.8 ms."""

_CLUSTER_PX, _FEW_SHARE = 9, 0.2
"""Spacing of clusters in the frames that kernels are loaded by; share of the events in the second one."""


class Workers:
    """Worker processes that have started.

    Args:
        links: Links whose frames they decode, by name.
        number: Number of processes.

    Raises:
        WorkerError: One does not start.
    """

    def __init__(self, links: Mapping[str, Link], number: int) -> None:
        self._links = links
        for link in links.values():
            # Compiled here, where that is reported, and cached.
            load_decoder_kernels(link)
        self._workers = [_Worker(index, links) for index in range(1, number + 1)]
        for worker in self._workers:
            worker.receive(_START_S)

    @classmethod
    def start(cls, links: Mapping[str, Link], processes: int, *, has_announcer: bool) -> "Workers | None":
        """Start the workers besides this process; None where it is the only one, or has nothing to share.

        Raises:
            ConfigError: There is no process, or somebody follows the stages, which workers do not announce;
                or an algorithm cannot be sent to them.
            WorkerError: One does not start.
        """
        if processes < 1:
            raise ConfigError(f"workers: {processes}, expected 1 or more")
        if processes > 1 and has_announcer:
            raise ConfigError(
                f"{processes} processes, expected 1 (--cores, workers): a sink or plugin follows the stages"
            )
        shared = {name: link for name, link in links.items() if has_bar_frames(link)}
        return cls(shared, processes - 1) if processes > 1 and shared else None

    def bar_decoders(self, link: str) -> list["WorkerBarDecoder"]:
        """A decoder in each worker for the bars of a link; none where that has no bars."""
        workers = self._workers if link in self._links else []
        return [WorkerBarDecoder(worker, link, self._links[link].regions.step_us) for worker in workers]

    def close(self) -> None:
        """End the processes."""
        for worker in self._workers:
            worker.close()


class _Worker:
    """A worker process, which answers requests in order."""

    def __init__(self, number: int, links: Mapping[str, Link]) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._pipe, far_end = spawn.Pipe()
        memory = spawn.RawArray("B", _MEMORY_BYTES)
        self._memory = np.frombuffer(memory, np.uint8)
        arguments = far_end, memory, dict(links)
        self._process = spawn.Process(
            target=_run_worker, args=arguments, name=f"worker {number}", daemon=True
        )
        try:
            self._process.start()
        except (pickle.PickleError, AttributeError, TypeError) as fault:
            raise ConfigError(f"workers: an algorithm cannot be sent to another process: {fault}") from fault
        far_end.close()
        self._poller = _make_poller(self._pipe)
        with socket.socket(fileno=os.dup(self._pipe.fileno())) as sender:
            timeout = struct.pack("ll", *divmod(int(_STALL_S * 1e6), 1_000_000))
            sender.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, timeout)
        # Of each open request, oldest first, the memory of its events and the list that takes the answer.
        self._open: deque[tuple[range, list[Any]]] = deque()
        self._next_byte = 0

    def send(self, *request: Any) -> None:
        """Send a request that has no answer."""
        try:
            # A pipe's own `send` makes a pickler in Python each time.
            self._pipe.send_bytes(pickle.dumps(request))
        except BlockingIOError as fault:
            raise self._stall_error(_STALL_S) from fault
        except OSError as fault:
            raise self._exit_error() from fault

    def request(self, *request: Any, memory: range = range(0)) -> Callable[[], Any]:
        """Send a request with its events in a part of the memory; return what fetches the answer."""
        while self._open and self._poller.poll(0):
            self._receive_oldest()
        self.send(*request)
        answer: list[Any] = []
        self._open.append((memory, answer))

        def fetch() -> Any:
            while not answer:
                self._receive_oldest()
            return answer[0]

        return fetch

    def copy_events(self, pieces: list[Piece]) -> tuple[list[tuple[int, int, int]], range]:
        """Copy a job's events to the shared memory.

        Returns:
            (start us, first byte, number of events) of each piece, and the part of the memory that they take.

        Raises:
            WorkerError: There are more than it holds.
        """
        sizes = [-(-EVENT_BYTES * events.t_us.size // 8) * 8 for _, events in pieces]
        total = sum(sizes)
        if total > _MEMORY_BYTES:
            raise WorkerError(
                f"a frame has {total} bytes of events, a worker takes {_MEMORY_BYTES}: use one core"
            )
        # From the start again where nothing is open: so little of it is used, and stays in a cache.
        begin = self._next_byte if self._open and self._next_byte + total <= _MEMORY_BYTES else 0
        memory = range(begin, begin + total)
        while any(begin < used.stop and used.start < memory.stop for used, _ in self._open):
            self._receive_oldest()
        self._next_byte, places = memory.stop, []
        for (start_us, events), size in zip(pieces, sizes, strict=True):
            number = events.t_us.size
            places.append((start_us, begin, number))
            columns = events.t_us, events.x, events.y, events.p
            for into, column in zip(_columns_at(self._memory, begin, number), columns, strict=True):
                into[:] = column
            begin += size
        return places, memory

    def receive(self, timeout_s: float) -> Any:
        """Receive the next answer.

        Raises:
            WorkerError: The worker has ended, or takes too long.
            Exception: What failed there.
        """
        try:
            if not _wait_readable(self._poller, timeout_s):
                raise self._stall_error(timeout_s)
            answer = self._pipe.recv()
        except (OSError, EOFError) as fault:
            raise self._exit_error() from fault
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.kill()
        self._process.join()

    def _receive_oldest(self) -> None:
        self._open[0][1].append(self.receive(_STALL_S))
        self._open.popleft()

    @property
    def _name(self) -> str:
        return f"{self._process.name} of the receiver, process {self._process.pid},"

    def _stall_error(self, for_s: float) -> WorkerError:
        """End the process, which does nothing; return an error that says so."""
        self._process.kill()
        return WorkerError(f"{self._name} did not answer for {for_s:g} s, and was ended: receive again")

    def _exit_error(self) -> WorkerError:
        """An error that says how the process has ended."""
        self._process.join(1.0)
        code = self._process.exitcode
        how = f"by {signal.Signals(-code).name}" if code is not None and code < 0 else f"with code {code}"
        return WorkerError(f"{self._name} ended {how}; what it was decoding is lost: receive again")


class WorkerBarDecoder:
    """Hands the frames of a link's bars to the `BarDecoder` of a worker; used like that one."""

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
        state: BarState = self._worker.request("take", self._link, bar, None)()
        return state

    def decode(self, bar: int, job: FrameJob) -> Callable[[], FrameResult | None]:
        """See `BarDecoder`."""
        region, due = job.region, job.due
        pieces = region.pieces_between(due.start_us, due.read_us, self._step_us)
        places, memory = self._worker.copy_events(pieces)
        bare = TrackedRegion(region.id, region.track, region.first_us, size_px=region.size_px)
        content = job._replace(region=bare), places
        return self._worker.request("decode", self._link, bar, content, memory=memory)


AnyBarDecoder = BarDecoder | WorkerBarDecoder
"""Decodes the frames of bars, here or in a worker."""


def _make_poller(pipe: Connection) -> select.poll:
    """A poller of what there is to receive: a pipe's own `poll` takes ten times as long."""
    poller = select.poll()
    poller.register(pipe.fileno(), select.POLLIN)
    return poller


def _wait_readable(poller: select.poll, timeout_s: float | None) -> bool:
    """Wait until there is something to receive; False if there is not in time.

    At first without sleep: who sleeps is woken on the core of the one that wakes it, which then waits.
    """
    spin_until_s = time.perf_counter() + _SPIN_S
    while time.perf_counter() < spin_until_s:
        os.sched_yield()
        if poller.poll(0):
            return True
    return bool(poller.poll(None if timeout_s is None else timeout_s * 1000))


def _columns_at(memory: NDArray[np.uint8], begin: int, number: int) -> _kernels.Columns:
    """Times, columns, rows and polarities of so many events from a byte of the memory on."""
    x, y, p = begin + 8 * number, begin + 10 * number, begin + 12 * number
    t_us, xs = memory[begin:x].view(np.int64), memory[x:y].view(np.uint16)
    return t_us, xs, memory[y:p].view(np.uint16), memory[p : p + number]


def _run_worker(pipe: Connection, memory: Any, links: Mapping[str, Link]) -> None:
    """Serve requests until the other end of the pipe is closed."""
    # An interrupt by the keyboard is for the process that closes the pipe then.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    shared, poller = np.frombuffer(memory, np.uint8), _make_poller(pipe)
    try:
        decoders = {name: BarDecoder(FrameDecoder(link)) for name, link in links.items()}
        for link in links.values():
            load_decoder_kernels(link)
        pipe.send(None)
        while True:
            _wait_readable(poller, None)
            kind, name, bar, content = pipe.recv()
            if kind == "put":
                decoders[name].put_state(bar, content)
            elif kind == "take":
                pipe.send(decoders[name].take_state(bar))
            else:
                job, places = content
                pipe.send(_decode_frame(decoders[name], bar, job, places, shared))
    except (EOFError, OSError):
        return


def _decode_frame(
    decoder: BarDecoder,
    bar: int,
    job: FrameJob,
    places: list[tuple[int, int, int]],
    memory: NDArray[np.uint8],
) -> FrameResult | Exception | None:
    """Decode a frame whose events are in the memory; return what fails instead of the result."""
    job.region.pieces = deque(
        (start_us, Events.from_columns(*_columns_at(memory, begin, number)))
        for start_us, begin, number in places
    )
    try:
        result = decoder.decode(bar, job)()
        _measure_spread(result)
    except EvlcpError as fault:
        return fault
    except Exception as fault:
        return RuntimeError(f"{type(fault).__name__}: {fault}\n{traceback.format_exc()}")
    return result


def _measure_spread(result: FrameResult | None) -> None:
    """Measure the spread of a frame's light now: until then the result holds the pilot."""
    if result is not None and result.spread is not None:
        result.spread()


def has_bar_frames(link: Link) -> bool:
    """Whether a link's bars have frames that can be decoded by themselves."""
    return link.algorithm("framing").roles >= STEPS and link.algorithm("detection").rhythmic


def load_decoder_kernels(link: Link) -> None:
    """Decode two frames of a drawn bar, a clear one and one of few events: the first time takes a second."""
    book, rng = link.codebook, np.random.default_rng(0)
    layout = layout_of(link.bar.cluster_centres_m())
    centres = layout.centres_m * _CLUSTER_PX / layout.spacing_m
    middle = complex(link.camera.width, link.camera.height) / 2
    offsets = np.arange(_CLUSTER_PX - 2) - _CLUSTER_PX // 2
    places = np.rint(centres - centres.mean() + middle)[:, None, None] + offsets + 1j * offsets[:, None]
    symbols = np.arange(book.clusters) % len(book.codewords)
    chips = np.concatenate([book.pilots, book.codewords[symbols]], 1).astype(np.int8)
    edges = np.diff(chips, axis=1, prepend=0, append=0)
    cluster, chip = np.nonzero(edges)
    shape = len(chip), places[0].size
    size_px = np.ptp(centres.real) + _CLUSTER_PX, np.ptp(centres.imag) + _CLUSTER_PX
    chip_us, number = link.packet.chip_us, chips.shape[1]
    lock, end_us = SyncLock(0.0, chip_us, 0.0, 0.0, 1.0), number * chip_us
    middle_us = link.packet.pilot_chips // 2 * chip_us
    read_us = end_us + book.trailing_chips * chip_us
    due = DueFrame(0, 0, 0, number, True, 0.0, 0.0, end_us, lock, read_us, middle_us)
    t_us = (chip[:, None] + rng.uniform(0.1, 0.9, shape)) * chip_us
    pixels = places.reshape(book.clusters, -1)[cluster]
    columns = t_us, pixels.real, pixels.imag, np.broadcast_to(edges[cluster, chip][:, None] > 0, shape)
    order = np.argsort(t_us, axis=None)
    events = Events.of(*(column.ravel()[order].astype(np.int64) for column in columns))
    frame_decoder = FrameDecoder(link)
    decoder = BarDecoder(frame_decoder)
    for some in (events, events[rng.random(len(events)) < _FEW_SHARE]):
        region = TrackedRegion(
            0, RegionTrack([Region(0, t, middle.real, middle.imag, *size_px) for t in (0.0, due.end_us)]), 0
        )
        region.size_px = size_px
        region.add(0, some)
        decoder.put_state(0, frame_decoder.init_state())
        # An algorithm may fail here: what matters is a frame of a camera.
        with suppress(PluginError):
            _measure_spread(decoder.decode(0, FrameJob(region, due, None, ranged=True))())
