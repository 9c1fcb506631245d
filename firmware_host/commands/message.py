"""`evlcp tx message` and `evlcp tx keygen`: messages as packets and chips, and on boards."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from time import time as clock_s
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._command import command
from evlcp_sdk.cli._common import LinkFile, Overrides, print_result, progress_bar
from evlcp_sdk.cli._stderr import print_stderr
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import Outputs, read_bytes
from evlcp_sdk.signals import stop_on_request
from firmware_host.commands import _host as host
from firmware_host.commands._json import AsJson
from firmware_host.commands._line import BoardLine, KeepAlive, keep_alive, print_program_result
from firmware_host.commands.stream import Ahead, print_stream_result

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_MAX_NUMBER = 2**32 - 1


@dataclass(frozen=True)
class ContentOptions:
    """The content of messages."""

    PANEL: ClassVar[str] = "What is sent"

    text: Annotated[str | None, typer.Option(metavar="TEXT", help="Send a text.")] = None
    file: Annotated[Path | None, typer.Option(metavar="FILE", help="Send a file's bytes.")] = None
    beacon: Annotated[
        Path | None, typer.Option(metavar="site.toml", help="Send where the transmitter is.")
    ] = None
    user: Annotated[
        str, typer.Option(metavar="TEXT", hidden=True, help="The beacon's own bytes, as text.")
    ] = ""
    time: Annotated[bool, typer.Option("--time", help="Send the time.")] = False
    countdown: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Send how long a signal still shows.", min=0.0)
    ] = None
    signal: Annotated[str, typer.Option(hidden=True, help="What it shows: red, green and the like.")] = "red"
    next_signal: Annotated[str, typer.Option("--next", hidden=True, help="What it shows then.")] = "green"
    key: Annotated[
        Path | None, typer.Option(metavar="private.pem", help="Sign the beacon; needs the extra sign.")
    ] = None
    transmitter_id: Annotated[
        int | None, typer.Option("--id", metavar="ID", min=0, max=_MAX_NUMBER, help="Transmitter id.")
    ] = None
    sequence: Annotated[
        int | None,
        typer.Option(
            hidden=True,
            min=0,
            max=_MAX_NUMBER,
            help="Sequence number; seconds since 1970 without it, so that it rises.",
        ),
    ] = None

    def make(self) -> host.messages.Content:
        """The content, with times from now on.

        Raises:
            ConfigError: It is empty, or there are options of a beacon without one.
            InputError: The file cannot be read.
        """
        if not self.time and (self.text, self.file, self.beacon, self.countdown) == (None,) * 4:
            raise ConfigError(
                "give what to send: --text TEXT, --file FILE, --beacon site.toml, --time or --countdown"
                " SECONDS"
            )
        if self.beacon is None and (self.key is not None or self.user):
            raise ConfigError("--key and --user belong to a beacon: give --beacon site.toml, too")
        for option, given in (("--text", self.text), ("--user", self.user)):
            sdk.compose.encode_utf8(given or "", option)
        site = (
            None
            if self.beacon is None
            else host.messages.choose_site(self.beacon, self.transmitter_id, "--id")
        )
        fixed = {
            "data": None if self.file is None else read_bytes(self.file),
            "beacon": site,
            "user": self.user.encode(),
            "key": self.key,
            "transmitter_id": self.transmitter_id,
        }
        now_s = clock_s()
        return host.messages.Content(
            fixed,
            text=self.text,
            time=self.time,
            ends_s=None if self.countdown is None else now_s + self.countdown,
            signals=(self.signal, self.next_signal),
            sequence=int(now_s) if self.sequence is None else self.sequence,
        )


@dataclass(frozen=True)
class LineOptions:
    """The board that plays the messages."""

    PANEL: ClassVar[str] = "Board"

    port: Annotated[
        str | None,
        typer.Option(
            metavar="PORT", help="Device, URL, native:; or EVLCP_PORT, unless -o or --chips is given."
        ),
    ] = None
    baud: Annotated[int, typer.Option(hidden=True, help="Line rate, bit/s.", min=1200)] = 1_000_000
    board_key: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            envvar="EVLCP_BOARD_KEY",
            show_envvar=False,
            help="The board's key, or EVLCP_BOARD_KEY.",
        ),
    ] = None

    def line(self, *, only_named: bool = False) -> BoardLine | None:
        """The line of the named port, or else that of the environment; None for no board."""
        port = self.port or (None if only_named else os.environ.get("EVLCP_PORT") or None)
        return None if port is None else BoardLine(port, self.baud, key=self.board_key)


@dataclass(frozen=True)
class PeriodOptions:
    """Period of messages that change."""

    every: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", min=1.0, help="Send it anew so often, with {time}, {left} and {n} in the text."
        ),
    ] = None
    count: Annotated[
        int | None, typer.Option(hidden=True, min=1, help="With --every: end after so many.")
    ] = None
    ahead: Ahead = 2


@command
def message(
    *,
    content: ContentOptions,
    repeat: Annotated[
        int, typer.Option(hidden=True, min=1, max=1000, help="Send each packet so often in a row.")
    ] = 1,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="FILE.json", help="Write the symbols.")
    ] = None,
    chips: Annotated[
        Path | None, typer.Option(metavar="FILE.npy", help="Write the chips: a row per chip.")
    ] = None,
    board: LineOptions,
    anew: PeriodOptions,
    stay: KeepAlive = False,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON on stdout, with the symbols.")] = False,
) -> None:
    """Put a text, a file or a beacon on packets, or on a board.

    A text:          [bold]evlcp tx message --text "Tempo 30" --id 7 -o message.json[/]
    A beacon:        [bold]evlcp tx message --beacon site.toml --key private.pem --chips chips.npy[/]
    Onto a board:    [bold]evlcp tx message --text "Tempo 30" --port /dev/ttyUSB0[/]
    A countdown:     [bold]evlcp tx message --countdown 30 --every 1 --port /dev/ttyUSB0[/]
    """
    link = sdk.resolve.load_link(link_file, overrides or [])
    made = content.make()
    if fields := made.unfilled_fields(anew.every is not None):
        print_stderr(
            f"--text: {', '.join(fields)} sent as it stands; --every SECONDS fills in {{time}}, {{n}} and,"
            " with --countdown, {left}"
        )
    if anew.every is None and anew.count is not None:
        raise ConfigError("--count belongs to --every SECONDS")
    if anew.every is not None:
        if out is not None or chips is not None:
            raise ConfigError("--every sends what changes, to a board: -o and --chips hold what stays")
        _send_periodically(made, link, board.line(), repeat, anew, as_json=as_json)
        return
    symbols, summary = _encode_content(made, link, repeat)
    table = host.symbols.symbols_table(symbols, link, messages=True)
    write_files(symbols, link, chips, out, table)
    written = [str(path) for path in (out, chips) if path is not None]
    line = board.line(only_named=bool(written))
    text = _describe_summary(summary, written)
    if line is None:
        print_result(text, summary | {"board": None} | table, as_json)
        if not written and not as_json:
            raise ConfigError("nothing is sent or written: give --port (or EVLCP_PORT), -o or --chips")
        return
    if made.time or made.ends_s is not None:
        print_stderr("--time, --countdown: the board repeats what holds now; --every SECONDS sends it anew")
    with line.open() as opened:
        with progress_bar("programming") as progress:
            done = host.board.provision(
                opened, host.bank.make_bank(symbols, link), host.board.Settings(), True, progress
            )
        print_result(f"{text}, again and again", summary | {"board": asdict(done)} | table, as_json)
        if not as_json:
            print_program_result(done, as_json)
        if stay:
            keep_alive(opened)


def write_files(
    symbols: NDArray[np.int64],
    link: sdk.resolve.Link,
    chips: Path | None,
    out: Path | None = None,
    table: dict[str, Any] | None = None,
) -> None:
    """Write the chips of symbols (packets, frames, clusters), and a table of them, each if it has a file."""
    with Outputs() as outputs:
        if chips is not None:
            outputs.write_array(host.bank.symbol_chips(symbols, link), chips)
        if out is not None:
            outputs.write_text(json.dumps(table) + "\n", out)


def _send_periodically(
    content: host.messages.Content,
    link: sdk.resolve.Link,
    line: BoardLine | None,
    repeat: int,
    anew: PeriodOptions,
    *,
    as_json: bool,
) -> None:
    assert anew.every is not None
    if line is None:
        raise ConfigError("--every sends to a board: give --port (or EVLCP_PORT)")
    # Errors are reported before the board waits.
    host.messages.check_interval(content, link, repeat, anew.every)
    with line.open() as board:
        stream = board.stream(link, anew.ahead)
        with suppress(KeyboardInterrupt), stop_on_request() as stopped, stream:
            host.messages.send_periodically(stream, content, link, repeat, anew.every, anew.count, stopped)
    print_stream_result(stream, as_json)


def _encode_content(
    content: host.messages.Content, link: sdk.resolve.Link, repeat: int
) -> tuple[NDArray[np.int64], dict[str, Any]]:
    """Symbols of the packets with the content now, and a summary of its messages."""
    messages = content.messages_at(link, clock_s())
    symbols = sdk.compose.encode_messages(messages, link.block_coder(), repeat)
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
        "duration_s": round(len(symbols) * (link.packet.packet_us / 1e6), 6),
    }


def _describe_summary(summary: dict[str, Any], written: list[str]) -> str:
    lines = [
        f"{m['kind']:9} {m['bytes']:5} bytes, transmitter {m['transmitter_id']}, sequence {m['sequence']}"
        for m in summary["messages"]
    ]
    number = summary["packets"]
    where = f", in {' and '.join(written)}" if written else ""
    lines.append(f"{number} packet{'s' * (number != 1)}, {summary['duration_s']:.4g} s{where}")
    return "\n".join(lines)


def keygen(
    private: Annotated[Path, typer.Argument(metavar="private.pem", help="Where the private key goes.")],
    show: Annotated[bool, typer.Option("--show", help="Print the public key of one that is there.")] = False,
    as_json: AsJson = False,
) -> None:
    """Make an Ed25519 key that signs beacons.

    Its public key is printed, for messages.trusted_keys.

    For example: [bold]evlcp tx keygen private.pem[/]
    """
    public = sdk.signing.public_key(sdk.signing.read_key(private)) if show else sdk.signing.make_key(private)
    print_result(public, {"public_key": public}, as_json)
