"""`evlcp loop`: a text by an emulated board to a simulated camera, and back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import LinkFile, Overrides, console, echo, progress_bar
from firmware_host.commands import _host as host


def loop(
    text: Annotated[str, typer.Option(metavar="TEXT", help="What is sent.")] = "Road works",
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT", help="Folder of all files.")] = Path(
        "loop-out"
    ),
    distance_m: Annotated[
        float, typer.Option("--distance", metavar="M", min=1.0, max=1000.0, help="From camera to bar.")
    ] = 50.0,
    seed: Annotated[
        int, typer.Option(min=0, max=2**32 - 1, help="Seed of the scene: its noise, its start.")
    ] = 0,
    report: Annotated[
        bool, typer.Option("--report", help="Also write received/report.html: the bar in slow motion, plots.")
    ] = False,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    as_json: Annotated[bool, typer.Option("--json", help="Each step as a line of JSON.")] = False,
) -> None:
    """Send a text from end to end on this machine, and read it.

    The board runs the real firmware, compiled here (needs cc and make); the camera is simulated. Ends with 1
    if the text does not arrive.

    Your own text:       [bold]evlcp loop --text "Tempo 30" --distance 60[/]
    At slower chips:     [bold]evlcp loop --set air.chip_rate_hz=5000.0[/]
    """
    link = sdk.resolve.load_link(link_file, overrides or [])
    screen = console()
    if not as_json:
        screen.print(
            "a text from end to end (the first run also compiles firmware and kernels) ...", style="dim"
        )
    files: list[str] = []
    sinks = ["report"] if report else []
    with progress_bar("rendering") as bar:
        for step in host.loop.run_loop(
            text, link, out, distance_m=distance_m, seed=seed, sinks=sinks, progress=bar
        ):
            files += step.files
            if as_json:
                echo(json.dumps({"step": step.name, **step.figures, "files": list(step.files)}))
                continue
            screen.print(f"{step.name:9} {step.summary}")
            for warning in step.figures.get("warnings", ()):
                screen.print(f"          warning: {sdk.facts.Diagnostic(**warning)}", style="yellow")
    if not as_json:
        screen.print(f"written: {out}/{', '.join(files)}", style="dim")
    if not step.figures["as_sent"]:
        raise typer.Exit(1)
