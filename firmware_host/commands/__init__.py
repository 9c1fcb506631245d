"""The commands `evlcp board`, `evlcp tx` and `evlcp loop`; thin, and light to import."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import typer

__all__ = ["register"]


def register(app: "typer.Typer") -> None:
    """Add both groups and the command."""
    from firmware_host.commands import board, loop, tx
    from firmware_host.commands._json import JsonCommand

    app.add_typer(tx.app, name="tx")
    app.add_typer(board.app, name="board")
    app.command("loop", cls=JsonCommand)(loop.loop)
