"""`evlcp board`: program and watch driver boards."""

import typer

__all__ = ["app"]

app = typer.Typer(no_args_is_help=True, rich_markup_mode="rich", help="Program and watch driver boards.")
