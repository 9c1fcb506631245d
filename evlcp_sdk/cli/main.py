"""Entry point of the `evlcp` command line."""

import sys
from typing import Annotated

import typer

__all__ = ["app", "main"]

app = typer.Typer(
    name="evlcp",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="""Read data and distance from blinking LEDs with an event camera.

    Exit codes: [bold]0[/] done, [bold]1[/] failed, [bold]2[/] usage or configuration,
    [bold]3[/] input that cannot be read.
    """,
)


def _version(show: bool) -> None:
    if show:
        from importlib.metadata import version

        typer.echo(f"evlcp-sdk {version('evlcp-sdk')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    del version


def main() -> None:
    """Run the command line; an SDK error becomes one line on stderr and its exit code."""
    from evlcp_sdk.cli import plugins
    from evlcp_sdk.errors import EvlcpError
    from evlcp_sdk.registry import Registry

    try:
        registry = Registry.load()
        plugins.register(app)
        registry.hook.evlcp_register_commands(app=app)
        app()
    except EvlcpError as fault:
        typer.echo(f"evlcp: {fault}", err=True)
        sys.exit(fault.exit_code)
