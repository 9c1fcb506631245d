"""How a campaign is shown while it runs: a bar, and the jobs that failed."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from evlcp_sdk.cli._common import progress_bar
from evlcp_sdk.cli._complain import complain

if TYPE_CHECKING:
    from evlcp_sdk.study.collect import Progress

_MOST_FAULTS = 5


def show_faults(progress: "Progress") -> None:
    """Say which jobs failed, one line each, equal faults once."""
    lines = dict.fromkeys(fault.message for _, fault in progress.faults)
    for line in list(lines)[:_MOST_FAULTS]:
        number = sum(fault.message == line for _, fault in progress.faults)
        complain(f"{number} job{'s' * (number > 1)} failed: {line}")
    if len(lines) > _MOST_FAULTS:
        complain(f"{len(lines) - _MOST_FAULTS} more kinds of failure")


@contextmanager
def campaign_bar(name: str) -> "Iterator[Callable[[Progress], None]]":
    """A bar by tasks, with the errors so far, on a terminal only."""
    with progress_bar(name) as advance:

        def show(progress: "Progress") -> None:
            failed = f", {len(progress.faults)} failed" if progress.faults else ""
            errors = f": {progress.bit_errors:,} errors in {progress.bits:,} bits" if progress.bits else ""
            advance(progress.done, progress.tasks, f"{progress.done}/{progress.tasks}{errors}{failed}")

        yield show
