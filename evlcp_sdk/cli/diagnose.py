"""`evlcp diagnose`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, LinkFile, Overrides, console, print_json, progress_bar
from evlcp_sdk.cli._tables import print_table


def diagnose(
    recording: Annotated[str, typer.Argument(metavar="REC", help="A recording.")],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="PAGE.html", help="Also write a page with maps.")
    ] = None,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Say why a recording is read, or is not, stage by stage.

    In words:       [bold]evlcp diagnose REC.raw[/]
    With pictures:  [bold]evlcp diagnose REC.raw -o REC.html[/]
    Against a link: [bold]evlcp diagnose REC.raw -c link.toml[/]

    Sources of light are found without a link, too: what blinks at which rate, lamps and all. Where a stage
    fails, other chip rates, modulations and lengths of a packet are tried, and characters of one LED of any
    rate and format. Ends with 0 whatever is wrong.
    """
    link = sdk.resolve.load_link(link_file, overrides or [])
    with progress_bar(Path(recording).name, by_bytes=True) as advance:
        diagnosis = sdk.diagnose.diagnose(recording, link, advance=advance)
    if out is not None:
        with sdk.files.Outputs() as outputs:
            outputs.write_text(sdk.diagnosis_page.render_diagnosis(diagnosis), out)
    if as_json:
        print_json(diagnosis.to_dict())
        return
    _print_diagnosis(diagnosis)
    if out is not None:
        console().print(f"written: {out}", style="dim")


_STYLES = {
    "pass": ("ok", "green"),
    "doubt": ("doubt", "yellow"),
    "fail": ("fails", "bold red"),
    "note": ("-", "dim"),
    "skip": ("-", "dim"),
}


def _print_diagnosis(diagnosis: sdk.diagnose.Diagnosis) -> None:
    from rich.table import Table
    from rich.text import Text

    out = console()
    out.print(Text.assemble((Path(diagnosis.recording).name, "bold"), f": {diagnosis.headline}"))
    stages = Table(box=None, pad_edge=False, show_header=False)
    for one in diagnosis.checks:
        word, style = _STYLES[one.verdict]
        stages.add_row(one.stage, Text(word, style), one.statement)
    out.print(stages)
    if diagnosis.sources:
        cells = [light.table_cells() for light in diagnosis.sources[:8]]
        print_table(out, list(cells[0]), [list(one.values()) for one in cells], names=0)
        if len(diagnosis.sources) > 8:
            out.print(f"and {len(diagnosis.sources) - 8} more", style="dim")
    for one in diagnosis.checks:
        if one.next_step and one.verdict in ("doubt", "fail"):
            out.print(f"next: {one.next_step}", style="yellow")
