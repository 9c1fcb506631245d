"""Where jobs run: in this process, or in local processes that may die without taking a job with them.

An executor draws jobs only when it has room for one, so the drawer may decide late; outcomes come as they
are ready, in any order. `cluster.DaskCluster` does the same on other machines. The module imports nothing
heavy: a fresh process sets its number of threads before it meets the function's imports.
"""

import multiprocessing
import os
import pickle
import signal
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Generic, Protocol, TypeVar

from evlcp_sdk.errors import EvlcpError

__all__ = ["ATTEMPTS", "Executor", "Fault", "Inline", "Outcome", "Processes", "attempt"]

ATTEMPTS = 3
"""How often a job is started whose worker dies, before it counts as failed."""

J = TypeVar("J")
R = TypeVar("R")


@dataclass(frozen=True)
class Fault:
    """Why a job has no value.

    Attributes:
        message: One line.
        exit_code: What the command line would end with.
        trace: Where an unexpected fault was raised; empty for the SDK's own.
    """

    message: str
    exit_code: int = 1
    trace: str = ""


@dataclass(frozen=True)
class Outcome(Generic[J, R]):
    """How a job ended: with a value or a fault."""

    job: J
    value: R | None = None
    fault: Fault | None = None


class Executor(Protocol):
    """Runs a function over jobs; function, jobs and values can be pickled."""

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[Outcome[J, R]]:
        """Run the function over the jobs; `jobs` is drawn from only when there is room for one.

        Raises:
            EvlcpError: The executor itself cannot go on.
        """
        ...


def attempt(function: Callable[[J], R], job: J) -> Outcome[J, R]:
    """Run one job; whatever it raises becomes a fault."""
    try:
        return Outcome(job, function(job))
    except EvlcpError as fault:
        return Outcome(job, fault=Fault(str(fault), fault.exit_code))
    except Exception as fault:
        text = f"{type(fault).__name__}: {fault}".splitlines()[0]
        return Outcome(job, fault=Fault(text, trace=traceback.format_exc()))


class Inline:
    """Runs jobs one after the other in this process."""

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[Outcome[J, R]]:
        """See `Executor.run`."""
        for job in jobs:
            yield attempt(function, job)


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

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[Outcome[J, R]]:
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


def _serve(pipe: Connection, function: bytes) -> None:
    """What a worker process does until its pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    run = pickle.loads(function)
    with suppress(EOFError, OSError):
        pipe.send(None)
        while True:
            outcome = attempt(run, pipe.recv())
            pipe.send((outcome.value, outcome.fault))
