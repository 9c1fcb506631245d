"""Jobs in this process, one after the other."""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from evlcp_sdk.jobs.executor import Outcome, attempt

__all__ = ["Inline"]

J = TypeVar("J")
R = TypeVar("R")


class Inline:
    """Runs jobs one after the other in this process."""

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Iterator[Outcome[J, R]]:
        """See `Executor.run`."""
        for job in jobs:
            yield attempt(function, job)
