"""`evlcp tx message` and `evlcp tx keygen`: messages to packets, chips and boards."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evlcp_sdk.cli._common import LinkFile, Overrides, echo
from firmware_host.commands._json import AsJson, print_json, say
from firmware_host.commands._line import BoardLine, KeepAlive, keep_alive, progress_bar, say_done
from firmware_host.commands.stream import Ahead, said_of, table_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from evlcp_sdk.link.resolve import Link
    from firmware_host.board.messages import Content

__all__ = ["keygen", "message"]

_MOST_NUMBER = 2**32 - 1

Text = Annotated[str | None, typer.Option(metavar="TEXT", help="Send a text.")]
DataFile = Annotated[Path | None, typer.Option(metavar="FILE", help="Send a file's bytes.")]
BeaconFile = Annotated[Path | None, typer.Option(metavar="site.toml", help="Send where the transmitter is.")]
User = Annotated[str, typer.Option(metavar="TEXT", help="The beacon's own bytes, as text.")]
Time = Annotated[bool, typer.Option("--time", help="Send the time.")]
CountdownS = Annotated[
    float | None, typer.Option(metavar="SECONDS", help="Send how long a signal still shows.", min=0.0)
]
Signal = Annotated[str, typer.Option(help="What it shows: red, green and the like.")]
NextSignal = Annotated[str, typer.Option("--next", help="What it shows then.")]
KeyFile = Annotated[
    Path | None, typer.Option(metavar="private.pem", help="Sign the beacon; needs the extra sign.")
]
TransmitterId = Annotated[
    int | None,
    typer.Option("--id", min=0, max=_MOST_NUMBER, help="Transmitter id; the site's, or 0, without it."),
]
Sequence = Annotated[
    int | None,
    typer.Option(
        min=0, max=_MOST_NUMBER, help="Sequence number; seconds since 1970 without it, so that it rises."
    ),
]
Repeat = Annotated[int, typer.Option(min=1, max=1000, help="Send each packet so often in a row.")]
SymbolsOut = Annotated[
    Path | None, typer.Option("-o", "--out", metavar="FILE.json", help="Write the symbols.")
]
ChipsOut = Annotated[
    Path | None,
    typer.Option(metavar="FILE.npy", help="Write the chips: uint8, a row per chip, a column per cluster."),
]
Port = Annotated[
    str | None,
    typer.Option(
        help="Program a board and play: device, pyserial URL, native:, as for 'evlcp board';"
        " EVLCP_PORT without it, unless -o or --chips is given."
    ),
]
Baud = Annotated[int, typer.Option(help="Line rate, bit/s.", min=1200)]
BoardKey = Annotated[
    Path | None,
    typer.Option(metavar="FILE", envvar="EVLCP_BOARD_KEY", help="The board's key, if it has one."),
]
Every = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        min=1.0,
        help="Send it anew so often, to a board: with the time, with what is left, and in the text"
        " {time}, {left} and {n}; end with Ctrl-C, or when nothing is left.",
    ),
]
Count = Annotated[int | None, typer.Option(min=1, help="With --every: end after so many.")]
JsonObject = Annotated[bool, typer.Option("--json", help="One JSON object on stdout, with the symbols.")]


def message(
    text: Text = None,
    file: DataFile = None,
    beacon: BeaconFile = None,
    user: User = "",
    time: Time = False,
    countdown: CountdownS = None,
    signal: Signal = "red",
    next_signal: NextSignal = "green",
    key: KeyFile = None,
    transmitter_id: TransmitterId = None,
    sequence: Sequence = None,
    repeat: Repeat = 1,
    out: SymbolsOut = None,
    chips: ChipsOut = None,
    port: Port = None,
    baud: Baud = 1_000_000,
    board_key: BoardKey = None,
    every: Every = None,
    count: Count = None,
    ahead: Ahead = 2,
    stay: KeepAlive = False,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    as_json: JsonObject = False,
) -> None:
    """Put a text, a file or a beacon on packets: symbols, chips, or a board that plays them.

    A text:          [bold]evlcp tx message --text "Tempo 30" --id 7 -o message.json[/]

    A beacon:        [bold]evlcp tx message --beacon site.toml --key private.pem --chips chips.npy[/]

    Onto a board:    [bold]evlcp tx message --text "Tempo 30" --port /dev/ttyUSB0[/]

    A countdown:     [bold]evlcp tx message --countdown 30 --every 1 --port /dev/ttyUSB0[/]
    """
    from time import time as clock_s

    from evlcp_sdk.errors import ConfigError
    from evlcp_sdk.link.compose import utf8
    from evlcp_sdk.link.resolve import load_link
    from evlcp_sdk.plugin.registry import Registry
    from firmware_host.board.messages import Content
    from firmware_host.board.sites import site_that_sends

    link = load_link(link_file, overrides or [], Registry.load())
    for wrong, why in (
        (
            text is None and file is None and beacon is None and not time and countdown is None,
            "give what to send: --text TEXT, --file FILE, --beacon site.toml, --time or --countdown SECONDS",
        ),
        (every is None and count is not None, "--count belongs to --every SECONDS"),
        (
            every is not None and (out is not None or chips is not None),
            "--every sends what changes, to a board: -o and --chips hold what stays",
        ),
        (
            beacon is None and (key is not None or bool(user)),
            "--key and --user belong to a beacon: give --beacon site.toml, too",
        ),
    ):
        if wrong:
            raise ConfigError(why)
    for option, given in (("--text", text), ("--user", user)):
        utf8(given or "", option)
    content = Content(
        text=text,
        data=None if file is None else _read(file),
        site=None if beacon is None else site_that_sends(beacon, transmitter_id, "--id"),
        user=user.encode(),
        key=key,
        time=time,
        ends_s=None if countdown is None else clock_s() + countdown,
        signals=(signal, next_signal),
        transmitter_id=transmitter_id,
        sequence=int(clock_s()) if sequence is None else sequence,
    )
    if every is not None:
        line = _line(port, baud, board_key)
        if line is None:
            raise ConfigError("--every sends to a board: give --port (or EVLCP_PORT)")
        _send_anew(content, link, line, repeat, every, count, ahead, as_json=as_json)
        return
    symbols, summary = _compose(content, link, repeat)
    written = _write(symbols, link, out, chips)
    line = _line(port, baud, board_key, only_named=bool(written))
    if line is None and not written and not as_json:
        _tell(summary, written, plays=False)
        raise ConfigError("nothing is sent or written: give --port (or EVLCP_PORT), -o or --chips")
    _program(symbols, link, line, summary, written, stay=stay, as_json=as_json)


def _line(port: str | None, baud: int, key: Path | None, *, only_named: bool = False) -> BoardLine | None:
    """The line of a board: the one that is named, or else that of the environment; None for no board."""
    port = port or (None if only_named else os.environ.get("EVLCP_PORT") or None)
    return None if port is None else BoardLine(port, baud, key=key)


def _send_anew(
    content: Content,
    link: Link,
    line: BoardLine,
    repeat: int,
    every_s: float,
    count: int | None,
    ahead: int,
    *,
    as_json: bool,
) -> None:
    """Send content anew until it ends; say how that went."""
    from contextlib import suppress

    from evlcp_sdk.signals import stop_on_request
    from firmware_host.board.messages import check_interval, send_anew

    # What is wrong is known before the board waits for it.
    check_interval(content, link, repeat, every_s)
    with line.open() as board:
        stream = board.stream(link, ahead)
        with suppress(KeyboardInterrupt), stop_on_request() as stopped, stream:
            send_anew(stream, content, link, repeat, every_s, count, stopped)
    say(said_of(stream), table_of(stream), as_json)


def _compose(content: Content, link: Link, repeat: int) -> tuple[NDArray[np.int64], dict[str, Any]]:
    """Symbols of the packets that say it now, and what they are."""
    from time import time as clock_s

    from evlcp_sdk.link.compose import packets_of
    from firmware_host.board.messages import packet_s

    messages = content.at(link, clock_s())
    symbols = packets_of(messages, link.block_coder(), repeat)
    return symbols, {
        "messages": [
            {
                "kind": m.kind_name,
                "transmitter_id": m.transmitter_id,
                "sequence": m.sequence,
                "bytes": len(m.payload),
            }
            for m in messages
        ],
        "packets": len(symbols),
        "duration_s": round(len(symbols) * packet_s(link), 6),
    }


def _write(symbols: NDArray[np.int64], link: Link, out: Path | None, chips: Path | None) -> list[str]:
    """Write symbols and chips where that is asked for; the files."""
    import json

    from evlcp_sdk.files import Outputs
    from firmware_host.board.bank import symbol_chips
    from firmware_host.board.symbols import symbols_table

    with Outputs() as outputs:
        if chips is not None:
            outputs.write_array(symbol_chips(symbols, link.codebook, link.packet.pilot_every), chips)
        if out is not None:
            outputs.write_text(json.dumps(symbols_table(symbols, link, messages=True)) + "\n", out)
        outputs.commit()
    return [str(path) for path in (out, chips) if path is not None]


def _program(
    symbols: NDArray[np.int64],
    link: Link,
    line: BoardLine | None,
    summary: dict[str, Any],
    written: list[str],
    *,
    stay: bool,
    as_json: bool,
) -> None:
    """Program a board, if there is one, with packets; say what was done."""
    import dataclasses

    from firmware_host.board.bank import bank_of
    from firmware_host.board.board import Settings, provision
    from firmware_host.board.symbols import symbols_table

    table = symbols_table(symbols, link, messages=True)
    if line is None:
        if as_json:
            print_json(summary | {"board": None} | table)
        else:
            _tell(summary, written, plays=False)
        return
    bank = bank_of(symbols, link)
    with line.open() as board:
        with progress_bar("programming") as progress:
            programmed = provision(board, bank, Settings(), True, progress)
        if as_json:
            print_json(summary | {"board": dataclasses.asdict(programmed)} | table)
        else:
            _tell(summary, written, plays=True)
            say_done(programmed, as_json=False)
        if stay:
            keep_alive(board)


def _tell(summary: dict[str, Any], written: list[str], plays: bool) -> None:
    """Say what was put on packets, and where they are."""
    for m in summary["messages"]:
        echo(
            f"{m['kind']:9} {m['bytes']:5} bytes, transmitter {m['transmitter_id']}, sequence {m['sequence']}"
        )
    number = summary["packets"]
    said = f"{number} packet{'s' * (number != 1)}, {summary['duration_s']:.4g} s"
    if written:
        said += f", in {' and '.join(written)}"
    echo(said + ", again and again" * plays)


def keygen(
    private: Annotated[Path, typer.Argument(metavar="private.pem", help="Where the private key goes.")],
    show: Annotated[bool, typer.Option("--show", help="Print the public key of one that is there.")] = False,
    as_json: AsJson = False,
) -> None:
    """Make an Ed25519 key that signs beacons; print the public key, for messages.trusted_keys.

    For example: [bold]evlcp tx keygen private.pem[/]
    """
    from evlcp_sdk.air.signing import make_key, public_key, read_key

    public = public_key(read_key(private)) if show else make_key(private)
    say(public, {"public_key": public}, as_json)


def _read(path: Path) -> bytes:
    from evlcp_sdk.errors import InputError

    try:
        return path.read_bytes()
    except OSError as fault:
        raise InputError(f"{path}: cannot be read: {fault.strerror}") from fault
