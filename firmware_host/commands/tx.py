"""`evlcp tx`: what a transmitter would send."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from firmware_host.commands import _source
from firmware_host.commands._output import save_array
from firmware_host.commands._source import Frames, PilotEvery, ProfileName, RandomPackets, Seed, SymbolsFile
from firmware_host.commands.message import keygen, message

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from evlcp_sdk.air.codebook import Codebook

__all__ = ["app"]

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode="rich", help="Make, show and check what goes on air."
)
app.command()(message)
app.command()(keygen)


class Form(StrEnum):
    """How `tx frames` prints the words."""

    TABLE = "table"
    HEX = "hex"
    C = "c"
    JSON = "json"


@app.command()
def frames(
    symbols: SymbolsFile = None,
    random: RandomPackets = None,
    seed: Seed = 0,
    frames: Frames = 10,
    pilot_every: PilotEvery = 1,
    profile: ProfileName = "wh4x2",
    form: Annotated[Form, typer.Option("--format", help="How the words are printed.")] = Form.TABLE,
    chips: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.npy", help="Write the chips: uint8, one row a chip, one column a cluster."
        ),
    ] = None,
) -> None:
    """Show the words that a board would be sent for these symbols.

    For example: [bold]evlcp tx frames --random 2 --seed 1 --chips chips.npy[/]
    """
    book = _source.codebook(profile)
    table = _source.symbols(symbols, random, seed, frames, pilot_every, book)
    if chips is not None:
        from firmware_host.board.bank import symbol_chips

        save_array(chips, symbol_chips(table, book, pilot_every))
    typer.echo(_FORMS[form](table, book, pilot_every))


def _table(symbols: "NDArray[np.int64]", book: "Codebook", pilot_every: int) -> str:
    from firmware_host.board.bank import word_table

    lines = ["packet frame cluster symbol pilot info"]
    for p, packet in enumerate(word_table(symbols, book)):
        for f, frame in enumerate(packet):
            for k, (pilot, info) in enumerate(frame):
                shown = f"{pilot:04x}" if f % pilot_every == 0 else "   -"
                lines.append(f"{p:6} {f:5} {k:7} {symbols[p, f, k]:6}  {shown} {info:04x}")
    return "\n".join(lines)


def _hex(symbols: "NDArray[np.int64]", book: "Codebook", pilot_every: int) -> str:
    from firmware_host.board.bank import word_table

    words = word_table(symbols, book)
    return "\n".join(
        " ".join(f"{p:04x}{i:04x}" if f % pilot_every == 0 else f"{i:04x}" for p, i in frame)
        for packet in words
        for f, frame in enumerate(packet)
    )


def _c(symbols: "NDArray[np.int64]", book: "Codebook", pilot_every: int) -> str:
    from firmware_host.board.bank import word_table

    info = word_table(symbols, book)[..., 1]
    packets, frames, clusters = info.shape
    lines = [
        "/* Info words of evlcp tx frames; pilots and preamble are in codebook.h. */",
        "#include <stdint.h>",
        f"/* Codebook {book.digest[:16]}, profile {book.profile}, pilot in every frame f with"
        f" f % {pilot_every} == 0. */",
        f"static const uint16_t evlcp_info[{packets}][{frames}][{clusters}] = {{",
    ]
    for packet in info:
        rows = [", ".join(f"0x{w:04x}u" for w in frame) for frame in packet]
        lines.append("    {" + ",\n     ".join(f"{{{row}}}" for row in rows) + "},")
    return "\n".join([*lines, "};"])


def _json(symbols: "NDArray[np.int64]", book: "Codebook", pilot_every: int) -> str:
    import json

    from firmware_host.board.bank import word_table

    words = word_table(symbols, book)
    return json.dumps(
        {
            "profile": book.profile,
            "digest": book.digest,
            "pilot_every": pilot_every,
            "symbols": symbols.tolist(),
            "pilot_words": [f"{w:04x}" for w in words[0, 0, :, 0]],
            "info_words": [[[f"{w:04x}" for w in frame] for frame in packet] for packet in words[..., 1]],
        }
    )


_FORMS = {Form.TABLE: _table, Form.HEX: _hex, Form.C: _c, Form.JSON: _json}


@app.command()
def check(
    symbols: SymbolsFile = None,
    random: RandomPackets = None,
    seed: Seed = 0,
    frames: Frames = 10,
    pilot_every: PilotEvery = 1,
    profile: ProfileName = "wh4x2",
    chip_rate: Annotated[float, typer.Option(help="Chips per second.", min=1.0, max=1e6)] = 10_000.0,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Check balance and flicker: on-share, longest run, lines below 3 kHz against IEEE Std 1789-2015.

    Ends with 1 if a cluster's light is beyond the low-risk bound.

    For example: [bold]evlcp tx check --random 100[/]
    """
    from firmware_host.board.bank import symbol_chips
    from firmware_host.flicker import check as measure

    book = _source.codebook(profile)
    table = symbol_chips(_source.symbols(symbols, random, seed, frames, pilot_every, book), book, pilot_every)
    rows = measure(table, chip_rate)
    if as_json:
        import json

        typer.echo(json.dumps({"chip_rate_hz": chip_rate, "clusters": [r.to_dict() for r in rows]}))
    else:
        typer.echo("cluster  on-share  longest-run  worst-line  modulation  no-effect bound  verdict")
        for r in rows:
            verdict = "no effect" if r.no_effect else "low risk" if r.low_risk else "FLICKERS"
            typer.echo(
                f"{r.cluster:7}  {r.on_share:8.4f}  {r.longest_run:11}  {r.line_hz:7.1f} Hz"
                f"  {r.line_percent:8.2f} %  {r.limit_percent:13.2f} %  {verdict}"
            )
    if not all(r.low_risk for r in rows):
        raise typer.Exit(1)
