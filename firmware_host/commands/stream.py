"""`evlcp board stream`: lines of input as packets on a board."""

from __future__ import annotations

import contextlib
import json
import queue
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._command import command
from evlcp_sdk.cli._common import LinkFile, Overrides, print_result
from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.formatting import format_count
from evlcp_sdk.signals import stop_on_request
from firmware_host.commands import _host as host
from firmware_host.commands._json import AsJson
from firmware_host.commands._line import open_board

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_POLL_S = 0.005
_MAX_LINES = 64

Ahead = Annotated[int, typer.Option(metavar="N", min=2, help="Packets on the board: few for a short delay.")]


@command
def stream(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="[FILE]", help="A line a message; - is stdin.")] = Path("-"),
    lines: Annotated[
        Literal["text", "symbols"],
        typer.Option(help="text: a message; symbols: JSON, \\[frame]\\[cluster], or a list of these."),
    ] = "text",
    ahead: Ahead = 4,
    transmitter_id: Annotated[
        int, typer.Option("--id", metavar="ID", min=0, max=2**32 - 1, help="Transmitter id of texts.")
    ] = 0,
    repeat: Annotated[int, typer.Option(metavar="N", min=1, max=1000, help="Send each packet so often.")] = 1,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Send what comes, line by line, until the input ends.

    The board queues the packets, and shows its idle pattern while it has none (an underrun). At the end
    it is dark.

    For example: [bold]date +%T | evlcp board --port native: stream[/]
    """
    link = sdk.resolve.load_link(link_file, overrides or [])
    # a link without room for messages is refused before the board waits
    coder = link.block_coder() if lines == "text" else None
    if coder is not None:
        coder.encode_symbols(bytes(coder.block_bytes))
    packets = _read_packets(file, link, coder, transmitter_id, repeat)
    with open_board(context) as board:
        queue = board.stream(link, ahead)
        with contextlib.suppress(KeyboardInterrupt), stop_on_request() as stopped, queue:
            for line in packets:
                if stopped():
                    break
                if line is None:
                    queue.wait(_POLL_S)
                    continue
                for packet in takewhile(lambda _: not stopped(), line):
                    queue.send(packet)
    print_stream_result(queue, as_json)


def print_stream_result(stream: host.stream.Stream, as_json: bool) -> None:
    """Print the result of a stream."""
    round_trips = round(stream.requests / max(1, stream.sent + stream.pauses), 3)
    summary = f"{format_count(stream.sent, 'packet')}, {round_trips:.2f} round trips a packet"
    if stream.underruns:
        summary += f", {format_count(stream.underruns, 'underrun')}: the board showed its idle pattern"
    else:
        summary += ", no underrun"
    table = {"packets": stream.sent, "underruns": stream.underruns, "round_trips": round_trips}
    print_result(summary, table, as_json)


def _read_packets(
    file: Path, link: sdk.resolve.Link, coder: sdk.blocks.BlockCoder | None, transmitter_id: int, repeat: int
) -> Iterator[Iterable[NDArray[np.int64]] | None]:
    """Packets (frames, clusters) of each line of input; None while there is none."""
    import numpy as np

    sequence = 0
    number = 0
    for line in _read_lines(file):
        if line is None:
            yield None
            continue
        number += 1
        if not line.strip():
            continue
        try:
            if coder is None:
                table = json.loads(line)
                while _list_depth(table) < 3:
                    table = [table]
                place = Path(f"{file}: line {number}")
                yield np.repeat(host.symbols.parse_symbols(place, table, link), repeat, axis=0)
            else:
                # the numbers of messages rise, also within a second
                sequence = max(sequence + 1, int(time.time()))
                messages = sdk.compose.make_messages(
                    link, text=line, transmitter_id=transmitter_id, sequence=sequence
                )
                yield sdk.compose.iterate_packets(messages, coder, repeat)
        except (ValueError, RecursionError) as fault:
            raise InputError(f"{file}: line {number}: not JSON: {fault}") from fault
        except ConfigError as fault:
            raise InputError(f"{file}: line {number}: {fault}") from fault


def _list_depth(table: Any) -> int:
    depth = 0
    while isinstance(table, list) and table and depth < 3:
        depth, table = depth + 1, table[0]
    return depth or 3


def _read_lines(file: Path) -> Iterator[str | None]:
    """Each line of input; None while there is none."""
    received: queue.Queue[str | Exception | None] = queue.Queue(_MAX_LINES)

    def read() -> None:
        try:
            with contextlib.ExitStack() as stack:
                opened = sys.stdin if str(file) == "-" else stack.enter_context(file.open(encoding="utf-8"))
                for line in opened:
                    received.put(line.rstrip("\r\n"))
            received.put(None)
        except (OSError, ValueError) as fault:
            received.put(fault)

    # it may still wait for input when the command ends
    threading.Thread(target=read, daemon=True).start()
    while True:
        if received.empty():
            yield None
            continue
        line = received.get()
        if line is None:
            return
        if isinstance(line, Exception):
            raise InputError(f"{file}: cannot be read: {line}") from line
        yield line
