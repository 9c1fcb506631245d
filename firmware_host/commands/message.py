"""`evlcp tx message` and `evlcp tx keygen`: messages to packets, chips and boards."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evlcp_sdk.cli._common import LinkFile, Overrides, echo
from firmware_host.commands._json import AsJson, print_json, say
from firmware_host.commands._line import BoardLine, KeepAlive, keep_alive, progress_bar, say_done
from firmware_host.commands.stream import Ahead, said_of, table_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from numpy.typing import NDArray

__all__ = ["keygen", "message"]

_MOST_NUMBER = 2**32 - 1


def message(
    text: Annotated[str | None, typer.Option(metavar="TEXT", help="Send a text.")] = None,
    file: Annotated[Path | None, typer.Option(metavar="FILE", help="Send a file's bytes.")] = None,
    beacon: Annotated[
        Path | None, typer.Option(metavar="site.toml", help="Send where the transmitter is.")
    ] = None,
    user: Annotated[str, typer.Option(metavar="TEXT", help="The beacon's own bytes, as text.")] = "",
    time: Annotated[bool, typer.Option("--time", help="Send the time.")] = False,
    countdown: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Send how long a signal still shows.", min=0.0)
    ] = None,
    signal: Annotated[str, typer.Option(help="What it shows: red, green and the like.")] = "red",
    next_signal: Annotated[str, typer.Option("--next", help="What it shows then.")] = "green",
    key: Annotated[
        Path | None, typer.Option(metavar="private.pem", help="Sign the beacon; needs the extra sign.")
    ] = None,
    transmitter_id: Annotated[
        int | None,
        typer.Option("--id", min=0, max=_MOST_NUMBER, help="Transmitter id; the site's, or 0, without it."),
    ] = None,
    sequence: Annotated[
        int | None,
        typer.Option(
            min=0, max=_MOST_NUMBER, help="Sequence number; seconds since 1970 without it, so that it rises."
        ),
    ] = None,
    repeat: Annotated[int, typer.Option(min=1, max=1000, help="Send each packet so often in a row.")] = 1,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="FILE.json", help="Write the symbols.")
    ] = None,
    chips: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.npy", help="Write the chips: uint8, a row per chip, a column per cluster."
        ),
    ] = None,
    port: Annotated[
        str | None,
        typer.Option(
            help="Program a board and play: device, pyserial URL, native:, as for 'evlcp board';"
            " EVLCP_PORT without it, unless -o or --chips is given."
        ),
    ] = None,
    baud: Annotated[int, typer.Option(help="Line rate, bit/s.", min=1200)] = 1_000_000,
    board_key: Annotated[
        Path | None,
        typer.Option(metavar="FILE", envvar="EVLCP_BOARD_KEY", help="The board's key, if it has one."),
    ] = None,
    every: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            min=1.0,
            help="Send it anew so often, to a board: with the time, with what is left, and in the text"
            " {time}, {left} and {n}; end with Ctrl-C, or when nothing is left.",
        ),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="With --every: end after so many.")] = None,
    ahead: Ahead = 2,
    stay: KeepAlive = False,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object on stdout, with the symbols.")
    ] = False,
) -> None:
    """Put a text, a file or a beacon on packets: symbols, chips, or a board that plays them.

    A text:          [bold]evlcp tx message --text "Tempo 30" --id 7 -o message.json[/]

    A beacon:        [bold]evlcp tx message --beacon site.toml --key private.pem --chips chips.npy[/]

    Onto a board:    [bold]evlcp tx message --text "Tempo 30" --port /dev/ttyUSB0[/]

    A countdown:     [bold]evlcp tx message --countdown 30 --every 1 --port /dev/ttyUSB0[/]
    """
    import dataclasses
    import json
    import os
    from contextlib import suppress
    from math import ceil
    from time import gmtime, strftime
    from time import time as clock_s

    from evlcp_sdk.air.blocks import Message
    from evlcp_sdk.air.kinds import Countdown
    from evlcp_sdk.errors import ConfigError
    from evlcp_sdk.files import Outputs
    from evlcp_sdk.link.compose import each_packet, messages_of, packets_of, utf8
    from evlcp_sdk.link.resolve import load_link
    from evlcp_sdk.plugin.registry import Registry
    from evlcp_sdk.signals import stop_on_request
    from firmware_host.board.bank import bank_of
    from firmware_host.board.board import Settings, provision
    from firmware_host.board.sites import site_that_sends
    from firmware_host.board.symbols import symbols_table

    link = load_link(link_file, overrides or [], Registry.load())
    if text is None and file is None and beacon is None and not time and countdown is None:
        raise ConfigError(
            "give what to send: --text TEXT, --file FILE, --beacon site.toml, --time or --countdown SECONDS"
        )
    if every is None and count is not None:
        raise ConfigError("--count belongs to --every SECONDS")
    if every is not None and (out is not None or chips is not None):
        raise ConfigError("--every sends what changes, to a board: -o and --chips hold what stays")
    if beacon is None and (key is not None or user):
        raise ConfigError("--key and --user belong to a beacon: give --beacon site.toml, too")
    for option, given in (("--text", text), ("--user", user)):
        utf8(given or "", option)
    data = None if file is None else _read(file)
    site = None if beacon is None else site_that_sends(beacon, transmitter_id, "--id")
    ends_s = None if countdown is None else clock_s() + countdown

    def made(at_s: float, number: int | None) -> list[Message]:
        """What is said at a time; of those that change, the one of a number."""
        other: dict[str, Any] = {}
        left_s = 0.0 if ends_s is None else max(0.0, ends_s - at_s)
        if time:
            other["time"] = at_s
        if ends_s is not None:
            other["countdown"] = Countdown(signal, next_signal, left_s)
        said = text
        if text is not None and number is not None:
            said = text.replace("{time}", strftime("%H:%M:%S", gmtime(at_s))).replace("{n}", str(number))
            said = said.replace("{left}", f"{left_s:.0f}")
        first = sequence if sequence is not None else int(begun_s)
        return messages_of(
            link,
            text=said,
            data=data,
            beacon=site,
            user=user.encode(),
            key=key,
            other=other,
            transmitter_id=transmitter_id,
            sequence=first + (number or 0),
        )

    begun_s = clock_s()
    packet_s = link.packet.packet_chips / link.air.chip_rate_hz
    if every is not None:
        port = port or os.environ.get("EVLCP_PORT") or None
        if port is None:
            raise ConfigError("--every sends to a board: give --port (or EVLCP_PORT)")
        coder = link.block_coder()
        # what is wrong is known before the board waits for it
        takes_s = len(packets_of(made(begun_s, 0), coder, repeat)) * packet_s
        if takes_s > every:
            raise ConfigError(
                f"--every {every:g}: what is to be sent takes {takes_s:.4g} s on air,"
                f" {takes_s / packet_s:.0f} packets of {1e3 * packet_s:.4g} ms;"
                f" give --every {ceil(takes_s)} or more, or send less"
            )
        with BoardLine(port, baud, key=board_key).open() as board:
            stream = board.stream(link, ahead)

            def next_one(number: int) -> Iterator[NDArray[np.int64]] | None:
                at_s = clock_s() + stream.delay_s
                over = ends_s is not None and number and at_s > ends_s + every
                if over or (count is not None and number >= count):
                    return None
                return each_packet(made(at_s, number), coder, repeat)

            with suppress(KeyboardInterrupt), stop_on_request() as asked, stream:
                stream.play(next_one, every, asked)
        say(said_of(stream), table_of(stream), as_json)
        return
    messages = made(begun_s, None)
    symbols = packets_of(messages, link.block_coder(), repeat)
    table = symbols_table(symbols, link, messages=True)
    with Outputs() as outputs:
        if chips is not None:
            from firmware_host.board.bank import symbol_chips

            outputs.write_array(symbol_chips(symbols, link.codebook, link.packet.pilot_every), chips)
        if out is not None:
            outputs.write_text(json.dumps(table) + "\n", out)
        outputs.commit()
    written = [str(path) for path in (out, chips) if path is not None]
    port = port or (None if written else os.environ.get("EVLCP_PORT") or None)
    summary: dict[str, Any] = {
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
        "duration_s": round(len(symbols) * packet_s, 6),
    }
    if port is None:
        if as_json:
            print_json(summary | {"board": None} | table)
            return
        _tell(summary, written, plays=False)
        if not written:
            raise ConfigError("nothing is sent or written: give --port (or EVLCP_PORT), -o or --chips")
        return
    bank = bank_of(symbols, link)
    with BoardLine(port, baud, key=board_key).open() as board:
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
