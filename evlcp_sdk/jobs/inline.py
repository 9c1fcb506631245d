"""Jobs in this process, one after the other."""

from collections.abc import Callable, Generator, Iterable
from typing import TypeVar

from evlcp_sdk.jobs.executor import Outcome, attempt

__all__ = ["Inline"]

J = TypeVar("J")
R = TypeVar("R")


class Inline:
    """Runs jobs one after the other in this process."""

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Generator[Outcome[J, R], None, None]:
        """See `Executor.run`."""
        for job in jobs:
            yield attempt(function, job)
