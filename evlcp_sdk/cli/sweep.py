"""`evlcp sweep`."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._campaign import print_faults, show_progress
from evlcp_sdk.cli._common import Dask, Json, Workers, console, make_executor, print_json, progress_bar
from evlcp_sdk.errors import InterruptedRunError

Out = Annotated[
    Path | None,
    typer.Option(
        "-o", "--out", metavar="RESULTS.sqlite", help="Results; NAME.sqlite without it.", show_default=False
    ),
]


def sweep(
    campaign: Annotated[Path, typer.Argument(metavar="CAMPAIGN.toml", help="The campaign.")],
    out: Out = None,
    workers: Workers = None,
    dask: Dask = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="TABLE.KEY=VALUE", help="Override campaign.KEY, scene.KEY or link.KEY."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what there is to do and what is done.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Simulate, receive and score every point of a campaign.

    A campaign:            [bold]evlcp sweep examples/campaigns/paper.toml -o paper.sqlite[/]
    A quick look at it:    [bold]evlcp sweep examples/campaigns/paper.toml --set campaign.seeds=1[/]
    On a Dask cluster:     [bold]evlcp sweep examples/campaigns/paper.toml --dask tcp://host:8786[/]
    What came out:         [bold]evlcp report paper.sqlite -o report.html[/]

    A result is kept as soon as it is there: stopped or killed at any moment, the same command goes on.
    """
    plan = sdk.task.plan_campaign(campaign, overrides or [])
    path = out or Path(f"{plan.name}.sqlite")
    if dry_run:
        kept = {}
        if path.exists():
            with sdk.store.Store(path) as store:
                kept = store.read_results()
        progress = sdk.collect.progress_of(plan, kept)
    else:
        executor = make_executor(workers, dask)
        with sdk.store.Store(path, create=True) as store:
            try:
                with progress_bar(plan.name) as advance:
                    progress = sdk.collect.collect_results(
                        plan, store, executor, sdk.task.run_job, partial(show_progress, advance)
                    )
            except KeyboardInterrupt:
                progress = sdk.collect.progress_of(plan, store.read_results())
                done = f"{progress.done} of {progress.tasks} tasks are in {path}"
                raise InterruptedRunError(f"interrupted; {done}; the same command goes on") from None
    print_faults(progress)
    if as_json:
        numbers = {k: v for k, v in asdict(progress).items() if k != "faults"}
        print_json({"results": str(path), **numbers, "failed": len(progress.faults)})
    else:
        _print_progress(plan.name, progress, None if dry_run else path)
    raise typer.Exit(max((fault.exit_code for _, fault in progress.faults), default=0))


def _print_progress(name: str, progress: sdk.collect.Progress, written: Path | None) -> None:
    screen = console()
    screen.print(
        f"{name}: {progress.done} of {progress.tasks} tasks,"
        f" {progress.points_done} of {progress.points} points,"
        f" {progress.bit_errors:,} of {progress.bits:,} bits wrong"
    )
    if written is not None:
        screen.print(f"written: {written}; look at it: evlcp report {written} -o report.html", style="dim")
