"""`evlcp report`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, console, echo, print_json
from evlcp_sdk.cli._tables import print_table


def report(
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="What evlcp sweep wrote.")],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="REPORT.html", help="The page.", show_default=False)
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of PNG and SVG; beside the page without it.",
            show_default=False,
        ),
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Tables as Markdown on stdout.")] = False,
    as_json: Json = False,
) -> None:
    """Show what a campaign found: tables, one page, figures.

    Tables only:        [bold]evlcp report paper.sqlite[/]
    Page and figures:   [bold]evlcp report paper.sqlite -o report.html[/]

    The page needs no network. A campaign that still runs can be looked at, too.
    """
    if markdown and as_json:
        raise typer.BadParameter("give one of --markdown and --json", param_hint="--json")
    with sdk.store.Store(results) as store:
        summary = sdk.summary.summarize(store)
    folder = figures or (out.parent / f"{out.stem}-figures" if out is not None else None)
    with sdk.files.Outputs() as outputs:
        if folder is not None:
            sdk.drawing.save_plots(sdk.report.draw_charts(summary), summary.plan.name, folder, outputs)
        if out is not None:
            outputs.write_text(sdk.report.render_campaign(summary), out)
    if as_json:
        print_json(summary.to_dict(), 1)
    elif markdown:
        echo(to_markdown(summary))
    else:
        if summary.done < summary.tasks:
            console().print(f"{summary.done} of {summary.tasks} tasks are done", style="yellow")
        print_tables(summary)
        if out is not None:
            console().print(f"written: {out}, {folder}/*.png, *.svg", style="dim")


def print_tables(summary: sdk.summary.Summary) -> None:
    """Print every figure, the positions, and the paper's figures beside those of the campaign."""
    for number, (head, rows, names) in enumerate(_collect_tables(summary)):
        if number:
            console().print()
        print_table(console(), head, rows, names)


def to_markdown(summary: sdk.summary.Summary) -> str:
    """The same tables as Markdown, the paper's first."""
    parts = []
    for head, rows, _ in reversed(_collect_tables(summary)):
        cells = [[cell.replace("\\", "\\\\").replace("|", "\\|") for cell in row] for row in rows]
        lines = [head, ["---"] * len(head), *cells]
        parts.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
    return "\n\n".join(parts)


def _collect_tables(summary: sdk.summary.Summary) -> list[tuple[Sequence[str], Sequence[Sequence[str]], int]]:
    """Head and rows of each table that has rows, and the number of columns that name a row."""
    tables: list[tuple[Sequence[str], Sequence[Sequence[str]], int]] = [
        (*sdk.report.figure_rows(summary), 2),
        (sdk.report.POSITION_HEAD, sdk.report.position_rows(summary), 1),
        (sdk.report.PAPER_HEAD, sdk.report.paper_rows(sdk.summary.compare_with_paper(summary.series)), 3),
    ]
    return [table for table in tables if table[1]]
