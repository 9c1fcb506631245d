"""Transmitter of the EVLCP SDK: protocol, host tool, firmware and emulators of the 96-LED driver board."""

from typing import TYPE_CHECKING

from evlcp_sdk.plugin.hooks import hookimpl

if TYPE_CHECKING:
    import typer

__all__ = ["evlcp_register_commands"]


@hookimpl
def evlcp_register_commands(app: "typer.Typer") -> None:
    """Add `evlcp board`, `evlcp tx` and `evlcp loop`."""
    from firmware_host.commands import board, loop, tx
    from firmware_host.commands._json import JsonCommand

    app.add_typer(tx.app, name="tx")
    app.add_typer(board.app, name="board")
    app.command("loop", cls=JsonCommand)(loop.loop)
