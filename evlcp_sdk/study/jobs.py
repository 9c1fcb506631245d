"""Jobs in this process, in processes of this machine, or on a Dask cluster; which may die without them.

An executor draws jobs only when it has room for one, so the drawer may decide late; outcomes come as they
are ready, in any order. The module imports nothing heavy: a fresh process sets its number of threads before
it meets the function's imports.
"""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from threading import Thread
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from evlcp_sdk.errors import ConfigError, EvlcpError, explain_fault

if TYPE_CHECKING:
    from concurrent.futures import Future, ProcessPoolExecutor
    from multiprocessing.connection import Connection

J = TypeVar("J")
R = TypeVar("R")

_ATTEMPTS = 3
"""How often a job is started whose worker dies, before it counts as failed."""

_CONNECT_S = 10
_WORKERS_S = 60
_WAITING_PER_THREAD = 2


@dataclass(frozen=True)
class Fault:
    """Why a job has no value, a line a fault, and what the command line would end with."""

    message: str
    exit_code: int = 1


@dataclass(frozen=True)
class Outcome(Generic[J, R]):
    """How a job ended: with a value or a fault."""

    job: J
    value: R | None = None
    fault: Fault | None = None


class Inline:
    """Runs jobs one after the other in this process."""

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Generator[Outcome[J, R], None, None]:
        """Run the function over the jobs; `jobs` is drawn from only when there is room for one.

        Function, jobs and values can be pickled. Who leaves before the end closes it, which ends what runs.
        """
        for job in jobs:
            yield _attempt(function, job)


class Processes:
    """Runs jobs in processes of this machine.

    A process that dies is replaced, and its job started again, at most three times in all. The processes end
    with this one, however it ends.

    Args:
        workers: Number of processes.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Generator[Outcome[J, R], None, None]:
        """See `Inline.run`."""
        import multiprocessing
        from concurrent.futures import ProcessPoolExecutor
        from concurrent.futures.process import BrokenProcessPool

        spawn = multiprocessing.get_context("spawn")
        leash, held = spawn.Pipe()
        # A pool is one process, so that its death is of one job.
        make_pool = partial(ProcessPoolExecutor, 1, spawn, _begin, (held,))
        pools: dict[Future[Any], ProcessPoolExecutor] = {}

        def start(job: J) -> Future[Any]:
            idle = next((future for future in pools if future.done()), None)
            # A terminal that closes is the parent's business, not that of what it starts.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
            try:
                pool = make_pool() if idle is None else pools.pop(idle)
                future = pool.submit(_attempt, function, job)
            except BrokenProcessPool:
                # It died with its job, or since.
                pool = make_pool()
                future = pool.submit(_attempt, function, job)
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGHUP})
            pools[future] = pool
            return future

        try:
            yield from _run(start, lambda: self._workers, BrokenProcessPool, jobs)
        finally:
            leash.close()
            for pool in pools.values():
                pool.shutdown(cancel_futures=True)
            held.close()


class DaskCluster:
    """Runs jobs on the workers of a Dask scheduler, as `Processes` does on this machine's; needs `cluster`.

    Workers may come, go and die while it runs: a job is started again on another, at most three times in all.
    Only as many jobs are handed over as keep the workers busy.

    Args:
        address: Of the scheduler, e.g. `tcp://10.0.0.1:8786`.

    Raises:
        ConfigError: Dask is not installed, or no scheduler answers there.
        EvlcpError: From `run`: the scheduler is gone, or no worker comes.
    """

    def __init__(self, address: str) -> None:
        try:
            distributed: Any = import_module("distributed")
        except ImportError as fault:
            raise ConfigError(
                "--dask needs the extra: pip install 'evlcp-sdk[cluster]', or leave --dask out"
            ) from fault
        self._address = address
        self._died: type[Exception] = distributed.scheduler.KilledWorker
        try:
            # A client of an address that cannot be one takes 20 s to close, with a traceback.
            distributed.comm.get_address_host_port(address)
            self._client: Any = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError, ImportError) as fault:
            raise ConfigError(f"--dask {address}: no Dask scheduler answers there") from fault

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Generator[Outcome[J, R], None, None]:
        """See `Inline.run`."""
        from concurrent.futures import CancelledError

        client = self._client
        pool = client.get_executor(pure=False, retries=0)

        def room() -> int:
            threads: int = sum(client.nthreads().values())
            return _WAITING_PER_THREAD * max(threads, 1)

        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
            yield from _run(lambda job: pool.submit(_attempt, function, job), room, self._died, jobs)
        except TimeoutError as fault:
            text = f"--dask {self._address}: no worker came within {_WORKERS_S} s"
            raise EvlcpError(text) from fault
        except (OSError, CancelledError) as fault:
            text = "the scheduler is gone; what was finished is kept, run again to go on"
            raise EvlcpError(f"--dask {self._address}: {text}") from fault
        finally:
            with suppress(Exception):
                pool.shutdown(wait=False)
            with suppress(Exception):
                client.close(timeout=2)


Executor = Inline | Processes | DaskCluster
"""Runs a function over jobs; its `run` raises `EvlcpError` where it cannot go on."""


def stop_workers() -> None:
    """Ask the jobs that run in processes of this one to stop, as a terminal's Ctrl-C does."""
    import multiprocessing

    for process in multiprocessing.active_children():
        # It may have ended just now.
        with suppress(ProcessLookupError):
            if process.pid is not None:
                os.kill(process.pid, signal.SIGINT)


def _attempt(function: Callable[[J], R], job: J) -> Outcome[J, R]:
    """Run one job; whatever it raises becomes a fault."""
    try:
        return Outcome(job, function(job))
    except (Exception, SystemExit) as fault:
        return Outcome(job, fault=Fault(*explain_fault(fault)))


def _run(
    start: Callable[[J], Future[Any]], room: Callable[[], int], died: type[Exception], jobs: Iterable[J]
) -> Generator[Outcome[J, Any], None, None]:
    """Keep as many jobs under way as there is room for; one whose worker dies is started again."""
    from concurrent.futures import FIRST_COMPLETED, wait

    source = ((job, 1) for job in jobs)
    again: deque[tuple[J, int]] = deque()
    running: dict[Future[Any], tuple[J, int]] = {}
    while True:
        for _ in range(room() - len(running)):
            begun = again.popleft() if again else next(source, None)
            if begun is None:
                break
            running[start(begun[0])] = begun
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            job, attempt = running.pop(future)
            try:
                outcome = future.result()
            except died:
                if attempt < _ATTEMPTS:
                    again.append((job, attempt + 1))
                    continue
                outcome = Outcome(job, fault=Fault(f"its process died {_ATTEMPTS} times"))
            # The job as it was given, not its copy.
            yield Outcome(job, outcome.value, outcome.fault)


def _begin(held: Connection) -> None:
    """Prepare a worker process: it ends when the other end of a pipe is closed, by hand or by death."""
    # So is a terminal's Ctrl-C.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")

    def end() -> None:
        with suppress(EOFError, OSError):
            held.recv()
        os._exit(1)

    Thread(target=end, daemon=True).start()
