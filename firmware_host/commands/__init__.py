"""The commands `evlcp board` and `evlcp tx`; thin, and light to import."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import typer

__all__ = ["register"]


def register(app: "typer.Typer") -> None:
    """Add both groups."""
    from firmware_host.commands import board, tx

    app.add_typer(tx.app, name="tx")
    app.add_typer(board.app, name="board")
