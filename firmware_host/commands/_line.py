"""A board on a line, as commands open it, and what they say of programming it."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from firmware_host.board.board import Board

__all__ = ["open_board", "progress_bar", "tell"]


@contextlib.contextmanager
def open_board(port: str | None, baud: int, trace: Path | None, replay: Path | None) -> "Iterator[Board]":
    """The board at a port, or a recorded one."""
    from evlcp_sdk.errors import ConfigError, InputError
    from firmware_host.board.board import Board
    from firmware_host.board.session import Session
    from firmware_host.board.survey import find
    from firmware_host.emulators.opening import open_port
    from firmware_host.ports.transport import ReplayTransport, TraceTransport, Transport
    from firmware_host.protocol.client import Timing

    transport: Transport
    first = nonce = None
    if replay is not None:
        if trace is not None:
            raise ConfigError("--trace and --replay: give one of the two")
        transport = played = ReplayTransport(replay)
        first, nonce, baud = played.first, played.nonce, played.baud
    else:
        transport = open_port(port or find(baud), baud)
        if trace is not None:
            import random

            draw = random.SystemRandom()
            first, nonce = draw.randrange(1 << 16), draw.randrange(1 << 32)
            try:
                file = trace.open("w", encoding="utf-8")
            except OSError as fault:
                transport.close()
                raise InputError(f"{trace}: cannot be written: {fault.strerror}") from fault
            transport = TraceTransport(transport, file, baud, first, nonce)
    with Session(transport, Timing(baud), first, nonce) as session:
        yield Board(session)


@contextlib.contextmanager
def progress_bar(what: str) -> "Iterator[Any]":
    """A bar by bytes, on a terminal only: a function of what is done and what there is."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def tell(done: Any, as_json: bool) -> None:
    """Say what programming did."""
    if as_json:
        import dataclasses
        import json

        typer.echo(json.dumps(dataclasses.asdict(done)))
    elif not done.swapped:
        typer.echo(f"was there already: {done.length} bytes in bank {done.bank}")
    else:
        typer.echo(f"sent {done.written} of {done.length} bytes; bank {done.bank} is active")
