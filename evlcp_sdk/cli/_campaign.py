"""The display of a running campaign: its progress, and the failed jobs."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from evlcp_sdk.cli._stderr import print_stderr

if TYPE_CHECKING:
    from evlcp_sdk.study.collect import Progress

_MAX_FAULTS = 5


def print_faults(progress: "Progress") -> None:
    """Print the failed jobs, one line for equal faults."""
    lines = dict.fromkeys(fault.message for _, fault in progress.faults)
    for line in list(lines)[:_MAX_FAULTS]:
        number = sum(fault.message == line for _, fault in progress.faults)
        print_stderr(f"{number} job{'s' * (number > 1)} failed: {line}")
    if len(lines) > _MAX_FAULTS:
        print_stderr(f"{len(lines) - _MAX_FAULTS} more kinds of failure")


def show_progress(advance: Callable[..., None], progress: "Progress") -> None:
    """Advance a bar by tasks, with the errors so far."""
    failed = f", {len(progress.faults)} failed" if progress.faults else ""
    errors = f": {progress.bit_errors:,} errors in {progress.bits:,} bits" if progress.bits else ""
    advance(progress.done, progress.tasks, f"{progress.done}/{progress.tasks}{errors}{failed}")
