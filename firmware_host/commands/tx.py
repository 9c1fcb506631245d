"""`evlcp tx`: packets, words and light of a transmitter."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._command import command
from evlcp_sdk.cli._common import echo, print_json
from evlcp_sdk.errors import ConfigError
from firmware_host.commands import _host as host
from firmware_host.commands._json import AsJson, JsonCommand
from firmware_host.commands._source import SymbolOptions
from firmware_host.commands.message import keygen, message, write_files

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode="rich", help="Make, show and check what goes on air."
)
app.command(cls=JsonCommand)(message)
app.command(cls=JsonCommand)(keygen)


@app.command()
@command
def frames(
    *,
    sent: SymbolOptions,
    form: Annotated[
        Literal["table", "hex", "c", "json"], typer.Option("--format", help="How the words are printed.")
    ] = "table",
    chips: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.npy", help="Write the chips: uint8, one row per chip, one column per cluster."
        ),
    ] = None,
) -> None:
    """Show the words that go on air for these symbols.

    By the file's own link unless one is given.

    For example: [bold]evlcp tx frames --random 2 --seed 1 --chips chips.npy[/]
    """
    table, link = sent.load()
    write_files(table, link, chips)
    echo(_FORMATTERS[form](table, link))


def _format_words(codes: NDArray[np.uint8]) -> list[str]:
    """Codes as hex words, the last chip the least significant bit; empty for codes of no chips."""
    if not codes.shape[1]:
        return [""] * len(codes)
    width = -(-codes.shape[1] // 4)
    return [f"{sdk.codebook.word_of_chips(code):0{width}x}" for code in codes]


def _format_table(symbols: NDArray[np.int64], link: sdk.resolve.Link) -> str:
    pilots, info = _format_words(link.codebook.pilots), _format_words(link.codebook.codewords)
    none = "-".rjust(len(pilots[0]))
    lines = ["packet frame cluster symbol pilot info"]
    for p, packet in enumerate(symbols.tolist()):
        for f, frame in enumerate(packet):
            for k, symbol in enumerate(frame):
                pilot = (pilots[k] if link.packet.has_pilot(f) else "") or none
                lines.append(f"{p:6} {f:5} {k:7} {symbol:6}  {pilot} {info[symbol]}")
    return "\n".join(lines)


def _format_hex(symbols: NDArray[np.int64], link: sdk.resolve.Link) -> str:
    pilots, info = _format_words(link.codebook.pilots), _format_words(link.codebook.codewords)
    return "\n".join(
        " ".join(
            (pilots[k] if link.packet.has_pilot(f) else "") + info[symbol] for k, symbol in enumerate(frame)
        )
        for packet in symbols.tolist()
        for f, frame in enumerate(packet)
    )


def _format_json(symbols: NDArray[np.int64], link: sdk.resolve.Link) -> str:
    info = _format_words(link.codebook.codewords)
    return json.dumps(
        host.symbols.symbols_table(symbols, link)
        | {
            "pilot_words": _format_words(link.codebook.pilots),
            "info_words": [[[info[s] for s in frame] for frame in packet] for packet in symbols.tolist()],
        }
    )


def _format_c(symbols: NDArray[np.int64], link: sdk.resolve.Link) -> str:
    book = link.codebook
    bits = next((n for n in (16, 32, 64) if n >= link.packet.info_chips), None)
    if bits is None:
        raise ConfigError(f"--format c: info segments of {link.packet.info_chips} chips, at most 64")
    info = _format_words(book.codewords)
    packets, frames, clusters = symbols.shape
    lines = [
        "/* Info words of evlcp tx frames; pilots and preamble are in codebook.h. */",
        "#include <stdint.h>",
        f"/* Codebook {book.digest[:16]}, profile {book.profile}, pilot in every frame f with"
        f" f % {link.packet.pilot_every} == 0. */",
        f"static const uint{bits}_t evlcp_info[{packets}][{frames}][{clusters}] = {{",
    ]
    for packet in symbols.tolist():
        rows = [", ".join(f"0x{info[symbol]}u" for symbol in frame) for frame in packet]
        lines.append("    {" + ",\n     ".join(f"{{{row}}}" for row in rows) + "},")
    return "\n".join([*lines, "};"])


_FORMATTERS = {"table": _format_table, "hex": _format_hex, "c": _format_c, "json": _format_json}


@app.command(cls=JsonCommand)
@command
def check(*, sent: SymbolOptions, as_json: AsJson = False) -> None:
    """Check balance and flicker.

    On-share, longest run, and lines below 3 kHz against IEEE Std 1789-2015.

    Ends with 1 if a cluster's light is beyond the low-risk bound.

    For example: [bold]evlcp tx check --random 100[/]
    """
    symbols, link = sent.load()
    chip_rate = link.packet.chip_rate_hz
    rows = host.flicker.measure_flicker(host.bank.symbol_chips(symbols, link), chip_rate)
    if as_json:
        print_json({"chip_rate_hz": chip_rate, "clusters": [r.to_dict() for r in rows]})
    else:
        echo("cluster  on-share  longest-run  worst-line  modulation  no-effect bound  verdict")
        for r in rows:
            verdict = "no effect" if r.no_effect else "low risk" if r.low_risk else "FLICKERS"
            echo(
                f"{r.cluster:7}  {r.on_share:8.4f}  {r.longest_run:11}  {r.line_hz:7.1f} Hz"
                f"  {r.line_percent:8.2f} %  {r.limit_percent:13.2f} %  {verdict}"
            )
    if not all(r.low_risk for r in rows):
        raise typer.Exit(1)
