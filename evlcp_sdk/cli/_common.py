"""Shared by the commands: options, executors of jobs, and the terminal."""

import json
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._stderr import print_stderr
from evlcp_sdk.formatting import escape_controls

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment

LinkFile = Annotated[
    str | None, typer.Option("-c", "--config", metavar="link.toml", help="The link; all defaults without it.")
]
LinkFiles = Annotated[
    list[str] | None, typer.Option("-c", "--config", metavar="link.toml", help="The link, or several.")
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="TABLE.KEY=VALUE", help="Override one value; repeat it.")
]
Json = Annotated[bool, typer.Option("--json", help="JSON on stdout, nothing else.")]

Workers = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=0,
        metavar="N",
        help="Processes, one per core without it; 0: this one.",
        show_default=False,
    ),
]
Dask = Annotated[
    str | None, typer.Option("--dask", metavar="ADDRESS", help="Run on this Dask scheduler's workers.")
]


def echo(text: str, *, nl: bool = True) -> None:
    """Print a text on stdout, its control characters escaped."""
    typer.echo(escape_controls(text), nl=nl)


def print_json(value: object, indent: int | None = None) -> None:
    """Print a value as JSON on stdout: one line, unless indented."""
    echo(json.dumps(value, indent=indent))


def print_result(
    text: str, table: object, as_json: bool, indent: int | None = None, out: Path | None = None
) -> None:
    """Print a command's result, a text unless it is empty, or JSON; on stderr if stdout is its file `out`."""
    with suppress(OSError):
        if out is not None and os.path.samestat(out.stat(), os.fstat(1)):
            print_stderr(json.dumps(table, indent=indent) if as_json else text)
            return
    if as_json:
        print_json(table, indent)
    elif text:
        echo(text)


class _StderrHandler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print_stderr(record.getMessage())


@contextmanager
def log_on_stderr() -> "Iterator[None]":
    """Print the SDK's log on stderr, such as the progress of compiling kernels."""
    log, handler = logging.getLogger("evlcp_sdk"), _StderrHandler(logging.INFO)
    previous_level = log.level
    log.setLevel(logging.INFO)
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(previous_level)


def silence_matplotlib() -> None:
    """Keep Matplotlib from reporting the place of its caches on stderr when there is no home."""
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


def console(*, stderr: bool = False) -> "Console":
    """A console of Rich on stdout or stderr, without colour unless on a terminal and without NO_COLOR.

    Texts are printed as they are, without markup and with escaped control characters.
    """
    from rich.console import Console
    from rich.segment import Segment

    screen = Console(highlight=False, soft_wrap=True, markup=False, emoji=False, stderr=stderr)
    render_raw = screen.render

    def render(renderable: "RenderableType", options: "ConsoleOptions | None" = None) -> "Iterator[Segment]":
        for text, style, control in render_raw(renderable, options):
            yield Segment(text if control else escape_controls(text), style, control)

    screen.render = render  # type: ignore[method-assign]
    return screen


def make_executor(workers: int | None, dask: str | None) -> "sdk.jobs.Executor":
    """An executor on a Dask cluster, in processes (None: one per core), or in this one for 0.

    Raises:
        ConfigError: The cluster cannot be reached.
    """
    if dask is not None:
        if workers is not None:
            raise typer.BadParameter("give one of --workers and --dask", param_hint="--dask")
        return sdk.jobs.DaskCluster(dask)
    if workers == 0:
        return sdk.jobs.Inline()
    return sdk.jobs.Processes(workers or os.cpu_count() or 1)


@contextmanager
def progress_bar(name: str, *, by_bytes: bool = False) -> "Iterator[Callable[..., None]]":
    """A bar on stderr, on a terminal only; gives a function of the amount done, the total, and a text.

    Where the total is unknown, it shows the time alone.
    """
    forced = os.environ.get("FORCE_COLOR") or os.environ.get("TTY_COMPATIBLE")
    # Rich, which would know, loads slowly.
    if not forced and not (sys.stderr is not None and sys.stderr.isatty()):
        yield lambda _done, _total, _words="": None
        return
    from rich import progress

    err = console(stderr=True)
    columns = (
        *(progress.TextColumn("{task.description}", markup=False), progress.BarColumn()),
        progress.DownloadColumn() if by_bytes else progress.TaskProgressColumn(),
        *(progress.TimeElapsedColumn(), progress.TimeRemainingColumn()),
    )
    with progress.Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, total, words="": bar.update(
            task, completed=done, total=total, description=f"{name} {words}".rstrip()
        )
