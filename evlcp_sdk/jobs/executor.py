"""What every place where jobs run has in common: jobs in, outcomes out.

An executor draws jobs only when it has room for one, so the drawer may decide late; outcomes come as they
are ready, in any order.
"""

from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from evlcp_sdk.errors import explained

__all__ = ["ATTEMPTS", "Executor", "Fault", "Outcome", "attempt"]

ATTEMPTS = 3
"""How often a job is started whose worker dies, before it counts as failed."""

J = TypeVar("J")
R = TypeVar("R")


@dataclass(frozen=True)
class Fault:
    """Why a job has no value.

    Attributes:
        message: A line a fault.
        exit_code: What the command line would end with.
    """

    message: str
    exit_code: int = 1


@dataclass(frozen=True)
class Outcome(Generic[J, R]):
    """How a job ended: with a value or a fault."""

    job: J
    value: R | None = None
    fault: Fault | None = None


class Executor(Protocol):
    """Runs a function over jobs; function, jobs and values can be pickled."""

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Generator[Outcome[J, R], None, None]:
        """Run the function over the jobs; `jobs` is drawn from only when there is room for one.

        Who leaves before the end closes it, which ends what runs.

        Raises:
            EvlcpError: The executor itself cannot go on.
        """
        ...


def attempt(function: Callable[[J], R], job: J) -> Outcome[J, R]:
    """Run one job; whatever it raises becomes a fault."""
    try:
        return Outcome(job, function(job))
    except (Exception, SystemExit) as fault:
        return Outcome(job, fault=Fault(*explained(fault)))
