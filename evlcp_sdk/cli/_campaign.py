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
    from evlcp_sdk.kernels import count_compiled, count_imported

    found = ""

    def words(done: float, total: float | None, _elapsed_s: float) -> str:
        compiled = count_compiled()
        if compiled and not done:
            return f"compiling for the first run, {compiled} of {count_imported()}"
        return f"{done:.0f}/{total:.0f} {found}" if total else ""

    with progress_bar(name, words) as advance:

        def show(progress: "Progress") -> None:
            nonlocal found
            failed = f", {len(progress.faults)} failed" if progress.faults else ""
            errors = f"{progress.bit_errors:,} errors in {progress.bits:,} bits" if progress.bits else ""
            found = errors + failed
            advance(progress.done, progress.tasks)

        yield show
