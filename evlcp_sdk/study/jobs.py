"""Executors of jobs: in this process, in processes of this machine, or on a Dask cluster; workers may die.

An executor draws a job only when it has room for one, so that the generator of jobs may decide late; outcomes
come as they are ready, in any order. The module imports nothing heavy: a fresh process sets its number of
threads before it imports the function's modules.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent import futures
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any, Generic, TypeVar

from evlcp_sdk.errors import ConfigError, EvlcpError, explain_fault, import_extra

J = TypeVar("J")
R = TypeVar("R")

_ATTEMPTS = 3
"""How often a job is started whose worker dies, before it has failed."""

_CONNECT_S = 10
_WORKERS_S = 60
_WAITING_PER_THREAD = 2


@dataclass(frozen=True)
class Fault:
    """Why a job has no value, a line a fault, and the exit code of a command for it."""

    message: str
    exit_code: int = 1


@dataclass(frozen=True)
class Outcome(Generic[J, R]):
    """The outcome of a job: a value or a fault."""

    job: J
    value: R | None = None
    fault: Fault | None = None


class Inline:
    """Runs jobs one after the other in this process."""

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Generator[Outcome[J, R], None, None]:
        """Run the function over the jobs, drawn only when there is room for one.

        Function, jobs and values can be pickled. Closing the generator before its end stops what runs.
        """
        for job in jobs:
            yield _run_job(function, job)


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
        spawn = multiprocessing.get_context("spawn")
        own_end, workers_end = spawn.Pipe()
        # A pool is one process, so that its death concerns one job.
        make_pool = partial(futures.ProcessPoolExecutor, 1, spawn, _prepare_worker, (workers_end,))
        pools: dict[futures.Future[Any], futures.ProcessPoolExecutor] = {}

        def start(job: J) -> futures.Future[Any]:
            idle = next((future for future in pools if future.done()), None)
            # A terminal that closes concerns the parent, not its children.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
            try:
                pool = make_pool() if idle is None else pools.pop(idle)
                future = pool.submit(_run_job, function, job)
            except futures.BrokenExecutor:
                # The process has died.
                pool = make_pool()
                future = pool.submit(_run_job, function, job)
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGHUP})
            pools[future] = pool
            return future

        try:
            yield from _run_jobs(start, lambda: self._workers, futures.BrokenExecutor, jobs)
        finally:
            own_end.close()
            for pool in pools.values():
                pool.shutdown(cancel_futures=True)
            workers_end.close()


class DaskCluster:
    """Runs jobs on the workers of a Dask scheduler; needs the extra `cluster`.

    Workers may come, go and die meanwhile: a job is started again on another, at most three times in all.
    Only as many jobs are submitted as keep the workers busy.

    Args:
        address: Of the scheduler, e.g. `tcp://10.0.0.1:8786`.

    Raises:
        ConfigError: Dask is not installed, or no scheduler answers there.
        EvlcpError: From `run`: the scheduler is gone, or no worker comes.
    """

    def __init__(self, address: str) -> None:
        distributed = import_extra("distributed", "cluster", "--dask")
        self._address = address
        self._died: type[Exception] = distributed.scheduler.KilledWorker
        try:
            # A client with an invalid address takes 20 s to close, with a traceback.
            distributed.comm.get_address_host_port(address)
            self._client: Any = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError, ImportError) as fault:
            raise ConfigError(f"--dask {address}: no Dask scheduler answers there") from fault

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Generator[Outcome[J, R], None, None]:
        """See `Inline.run`."""
        client = self._client
        pool = client.get_executor(pure=False, retries=0)

        def slots() -> int:
            threads: int = sum(client.nthreads().values())
            return _WAITING_PER_THREAD * max(threads, 1)

        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
            yield from _run_jobs(lambda job: pool.submit(_run_job, function, job), slots, self._died, jobs)
        except TimeoutError as fault:
            text = f"--dask {self._address}: no worker came within {_WORKERS_S} s"
            raise EvlcpError(text) from fault
        except (OSError, futures.CancelledError) as fault:
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
    """Interrupt the jobs in child processes, as a terminal's Ctrl-C does."""
    for process in multiprocessing.active_children():
        # It may have ended just now.
        with suppress(ProcessLookupError):
            if process.pid is not None:
                os.kill(process.pid, signal.SIGINT)


def _run_job(function: Callable[[J], R], job: J) -> Outcome[J, R]:
    try:
        return Outcome(job, function(job))
    except (Exception, SystemExit) as fault:
        return Outcome(job, fault=Fault(*explain_fault(fault)))


def _run_jobs(
    start: Callable[[J], futures.Future[Any]],
    slots: Callable[[], int],
    died: type[Exception],
    jobs: Iterable[J],
) -> Generator[Outcome[J, Any], None, None]:
    """Keep as many jobs running as there are slots; restart one whose worker dies."""
    source = ((job, 1) for job in jobs)
    retries: deque[tuple[J, int]] = deque()
    running: dict[futures.Future[Any], tuple[J, int]] = {}
    while True:
        for _ in range(slots() - len(running)):
            next_job = retries.popleft() if retries else next(source, None)
            if next_job is None:
                break
            running[start(next_job[0])] = next_job
        if not running:
            return
        for future in futures.wait(running, return_when=futures.FIRST_COMPLETED).done:
            job, attempt = running.pop(future)
            try:
                outcome = future.result()
            except died:
                if attempt < _ATTEMPTS:
                    retries.append((job, attempt + 1))
                    continue
                outcome = Outcome(job, fault=Fault(f"its process died {_ATTEMPTS} times"))
            # The original job, not its copy.
            yield Outcome(job, outcome.value, outcome.fault)


def _prepare_worker(pipe: Connection) -> None:
    """Prepare a worker process, which ends when the parent's end of the pipe is closed, also by its death."""
    # Ctrl-C is for the parent.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")

    def exit_with_parent() -> None:
        with suppress(EOFError, OSError):
            pipe.recv()
        os._exit(1)

    Thread(target=exit_with_parent, daemon=True).start()
