"""How a campaign is shown while it runs: a bar, and the jobs that failed."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from evlcp_sdk.cli._common import console
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
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress as Bar,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    from evlcp_sdk.kernels import count_compiled, count_imported

    class Work(ProgressColumn):
        """What is done now, and what was found so far."""

        def render(self, task: Task) -> Text:
            compiled = count_compiled()
            if compiled and not task.completed:
                return Text(f"compiling for the first run, {compiled} of {count_imported()}")
            return Text(task.fields["errors"])

    err = console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        Work(),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(name, total=None, errors="")

        def show(progress: "Progress") -> None:
            failed = f", {len(progress.faults)} failed" if progress.faults else ""
            errors = (
                f"{progress.bit_errors:,} errors in {progress.bits:,} bits{failed}"
                if progress.bits
                else failed
            )
            bar.update(task, completed=progress.done, total=progress.tasks, errors=errors)

        yield show
