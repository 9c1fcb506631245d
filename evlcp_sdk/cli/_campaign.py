"""The display of a running campaign: its progress, and the failed jobs."""

from collections.abc import Callable

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._stderr import print_stderr

_MAX_FAULTS = 5


def print_faults(progress: "sdk.collect.Progress") -> None:
    """Print the failed jobs, one line for equal faults."""
    lines = dict.fromkeys(fault.message for _, fault in progress.faults)
    for line in list(lines)[:_MAX_FAULTS]:
        number = sum(fault.message == line for _, fault in progress.faults)
        print_stderr(f"{number} job{'s' * (number > 1)} failed: {line}")
    if len(lines) > _MAX_FAULTS:
        print_stderr(f"{len(lines) - _MAX_FAULTS} more kinds of failure")


def show_progress(advance: Callable[..., None], progress: "sdk.collect.Progress") -> None:
    """Advance a bar by tasks, with the errors so far."""
    failed = f", {len(progress.faults)} failed" if progress.faults else ""
    errors = f": {progress.bit_errors:,} errors in {progress.bits:,} bits" if progress.bits else ""
    advance(progress.done, progress.tasks, f"{progress.done}/{progress.tasks}{errors}{failed}")
