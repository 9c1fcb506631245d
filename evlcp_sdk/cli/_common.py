"""What the commands share: their options, where jobs run, what goes to stderr."""

import os
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from evlcp_sdk.jobs.executor import Executor

__all__ = [
    "Dask",
    "Json",
    "LinkFile",
    "Overrides",
    "Workers",
    "complain",
    "console",
    "make_executor",
]

LinkFile = Annotated[
    str | None, typer.Option("-c", "--config", metavar="link.toml", help="The link; all defaults without it.")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="TABLE.KEY=VALUE", help="Override one value; may be repeated."),
]
Json = Annotated[bool, typer.Option("--json", help="JSON on stdout, nothing else.")]

Workers = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=0,
        metavar="N",
        help="Local processes, one a core without it; 0: this one.",
        show_default=False,
    ),
]
Dask = Annotated[
    str | None,
    typer.Option(
        "--dask",
        metavar="ADDRESS",
        help="Run on the workers of a Dask scheduler, e.g. tcp://host:8786; needs the extra cluster.",
    ),
]


def complain(text: str) -> None:
    """Print one line a fault on stderr."""
    for line in text.splitlines():
        typer.echo(f"evlcp: {line}", err=True)


def console() -> "Console":
    """Where tables go: stdout, without colour where it is no terminal or NO_COLOR is set."""
    from rich.console import Console

    return Console(highlight=False, soft_wrap=True)


def make_executor(workers: int | None, dask: str | None) -> "Executor":
    """Where jobs run: on a cluster, in processes (None: one a core), or in this one for 0.

    Raises:
        ConfigError: The cluster is not there.
    """
    from evlcp_sdk.jobs.executor import Inline, Processes

    if dask is not None:
        if workers is not None:
            raise typer.BadParameter("give one of --workers and --dask", param_hint="--dask")
        from evlcp_sdk.jobs.dask import DaskCluster

        return DaskCluster(dask)
    if workers == 0:
        return Inline()
    return Processes(workers or os.cpu_count() or 1)
