"""`evlcp report`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evlcp_sdk.cli._common import Json, console, echo
from evlcp_sdk.cli._tables import print_table

if TYPE_CHECKING:
    from evlcp_sdk.study.summary import Summary


def report(
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="What evlcp sweep wrote.")],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="REPORT.html", help="The page.", show_default=False),
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option(
            "--figures",
            metavar="DIR",
            help="Folder of PNG and SVG; beside the page without it.",
            show_default=False,
        ),
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Tables as Markdown on stdout.")] = False,
    as_json: Json = False,
) -> None:
    """Show what a campaign found: tables here, one self-contained page and figures for others.

    Tables only:        [bold]evlcp report paper.sqlite[/]
    Page and figures:   [bold]evlcp report paper.sqlite -o report.html[/]

    The page needs no network. A campaign that still runs can be looked at, too.
    """
    import json

    from evlcp_sdk.files import Outputs
    from evlcp_sdk.report.drawing import save_plots
    from evlcp_sdk.study.campaign.charts import charts_of
    from evlcp_sdk.study.campaign.report import page
    from evlcp_sdk.study.store import Store
    from evlcp_sdk.study.summary import summarize

    if markdown and as_json:
        raise typer.BadParameter("give one of --markdown and --json", param_hint="--json")
    with Store(results) as store:
        summary = summarize(store)
    folder = figures or (out.parent / f"{out.stem}-figures" if out is not None else None)
    with Outputs() as outputs:
        if folder is not None:
            save_plots(charts_of(summary), summary.name, folder, outputs)
        if out is not None:
            outputs.write_text(page(summary), out)
        outputs.commit()
    if as_json:
        echo(json.dumps(summary.to_dict(), indent=1))
    elif markdown:
        echo(as_markdown(summary))
    else:
        if summary.done < summary.tasks:
            console().print(f"{summary.done} of {summary.tasks} tasks are done", style="yellow")
        show_series(summary)
        show_positions(summary)
        show_paper(summary)
        if out is not None:
            console().print(f"written: {out}, {folder}/*.png, *.svg", style="dim")


def show_series(summary: Summary) -> None:
    """Print BER, RMSE and gross errors of every series, a row a segment."""
    _print(*_series_table(summary), names=2)


def show_positions(summary: Summary) -> None:
    """Print what became of positions, a row a series, where there are any."""
    head, rows = _positions_table(summary)
    if rows:
        console().print()
        _print(head, rows, names=1)


def show_paper(summary: Summary) -> None:
    """Print the paper's figures beside those of the campaign."""
    head, rows = _paper_table(summary)
    if rows:
        console().print()
        _print(head, rows, names=3)


def as_markdown(summary: Summary) -> str:
    """The same tables as Markdown."""
    parts = []
    for head, rows in (_paper_table(summary), _positions_table(summary), _series_table(summary)):
        if rows:
            cells = [[cell.replace("\\", "\\\\").replace("|", "\\|") for cell in row] for row in rows]
            lines = [head, ["---"] * len(head), *cells]
            parts.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
    return "\n\n".join(parts)


_WIDE = ("bit errors", "bias, m", "RMSE in space, m")
"""Columns of the page for which a terminal has no room."""


def _series_table(summary: Summary) -> tuple[list[str], list[list[str]]]:
    from evlcp_sdk.study.campaign.report import figure_rows

    head, rows = figure_rows(summary)
    kept = [i for i, name in enumerate(head) if name not in _WIDE]
    return [head[i] for i in kept], [[row[i] for i in kept] for row in rows]


def _positions_table(summary: Summary) -> tuple[list[str], list[list[str]]]:
    from evlcp_sdk.study.campaign.report import POSITION_HEAD, position_rows

    return list(POSITION_HEAD), [list(row) for row in position_rows(summary)]


def _paper_table(summary: Summary) -> tuple[list[str], list[list[str]]]:
    from evlcp_sdk.study.campaign.report import comparison_rows
    from evlcp_sdk.study.summary import beside_paper

    rows = [list(row) for row in comparison_rows(beside_paper(summary.series))]
    return ["figure", "distance", "series", "paper", "here", "95 %", "verdict"], rows


def _print(head: list[str], rows: list[list[str]], names: int) -> None:
    print_table(console(), head, [[(text, False) for text in row] for row in rows], names)
