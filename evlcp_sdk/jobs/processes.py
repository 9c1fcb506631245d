"""Jobs in local processes, which may die without taking a job with them.

The module imports nothing heavy: a fresh process sets its number of threads before it meets the function's
imports.
"""

import multiprocessing
import os
import pickle
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Generic, TypeVar

from evlcp_sdk.errors import EvlcpError
from evlcp_sdk.jobs.executor import ATTEMPTS, Fault, Outcome, attempt

__all__ = ["Processes", "stop_workers"]

J = TypeVar("J")
R = TypeVar("R")


class Processes:
    """Runs jobs in processes of this machine.

    A process that dies is replaced, and its job started again, at most `ATTEMPTS` times in all. The processes
    end with this one, however it ends.

    Args:
        workers: Number of processes.

    Raises:
        EvlcpError: From `run`: a process dies before it takes a job, again and again.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Generator[Outcome[J, R], None, None]:
        """See `Executor.run`."""
        source = iter(jobs)
        again: deque[_Begun[J]] = deque()
        pool: list[_Worker[J]] = []
        stillborn = 0
        drained = False
        try:
            while True:
                while not drained or again:
                    idle = next((w for w in pool if w.begun is None), None)
                    if idle is None and len(pool) == self._workers:
                        break
                    begun = again.popleft() if again else _draw(source)
                    if begun is None:
                        drained = True
                        break
                    if idle is None:
                        idle = _Worker(pickle.dumps(function))
                        pool.append(idle)
                    idle.give(begun)
                busy = {w.pipe: w for w in pool if w.begun is not None}
                if not busy:
                    return
                for pipe in wait(list(busy)):
                    worker = busy[pipe]  # type: ignore[index]
                    begun = worker.begun
                    assert begun is not None
                    try:
                        said = worker.pipe.recv()
                    except (EOFError, OSError):
                        pool.remove(worker)
                        code = worker.end()
                        stillborn = 0 if worker.ready else stillborn + 1
                        if stillborn == ATTEMPTS * self._workers:
                            raise EvlcpError(
                                f"worker processes die at their start (exit code {code})"
                            ) from None
                        begun.deaths += worker.ready
                        if begun.deaths < ATTEMPTS:
                            again.append(begun)
                        else:
                            text = f"its process died {ATTEMPTS} times (exit code {code})"
                            yield Outcome(begun.job, fault=Fault(text))
                        continue
                    if said is None:
                        worker.ready = True
                        continue
                    worker.begun = None
                    value, fault = said
                    yield Outcome(begun.job, value, fault)
        finally:
            for worker in pool:
                worker.end()


@dataclass
class _Begun(Generic[J]):
    """A job that was given out, and how many processes died of it."""

    job: J
    deaths: int = 0


def _draw(source: Iterator[J]) -> "_Begun[J] | None":
    for job in source:
        return _Begun(job)
    return None


@dataclass
class _Worker(Generic[J]):
    """A process and what it works on."""

    function: bytes
    begun: _Begun[J] | None = None
    ready: bool = False
    pipe: Connection = field(init=False)
    process: SpawnProcess = field(init=False)

    def __post_init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, self.function), daemon=True)
        self.process.start()
        theirs.close()

    def give(self, begun: _Begun[J]) -> None:
        self.begun = begun
        # A process that is dead by now is found so when its answer is read.
        with suppress(OSError):
            self.pipe.send(begun.job)

    def end(self) -> int | None:
        self.pipe.close()
        self.process.kill()
        self.process.join()
        code = self.process.exitcode
        self.process.close()
        return code


def stop_workers() -> None:
    """Ask the jobs that run in processes of this one to stop, as a terminal's Ctrl-C does."""
    for process in multiprocessing.active_children():
        # It may have ended just now.
        with suppress(ProcessLookupError):
            if process.pid is not None:
                os.kill(process.pid, signal.SIGINT)


def _serve(pipe: Connection, function: bytes) -> None:
    """What a worker process does until its pipe closes."""
    # What a terminal sends is the parent's business; by SIGTERM it ends its processes.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    run = pickle.loads(function)
    with suppress(EOFError, OSError):
        pipe.send(None)
        while True:
            outcome = attempt(run, pipe.recv())
            pipe.send((outcome.value, outcome.fault))
