"""Entry point of the `evlcp` command line."""

import sys
from typing import Annotated

import typer

__all__ = ["main", "make_app"]

HELP = """Read data and distance from blinking LEDs with an event camera.

[bold]evlcp demo[/] decodes a small recording that comes with the package;
[bold]evlcp receive REC.raw -o out[/] decodes yours.

Exit codes: [bold]0[/] done (also when no transmitter was there), [bold]1[/] failed,
[bold]2[/] usage or configuration, [bold]3[/] input that cannot be read, [bold]130[/] interrupted.
"""


def make_app() -> typer.Typer:
    """The command line with its own commands; plugins add theirs by `evlcp_register_commands`."""
    from evlcp_sdk.cli import (
        calibrate,
        check,
        compare,
        config,
        demo,
        info,
        plugins,
        receive,
        report,
        score,
        simulate,
        sweep,
    )

    app = typer.Typer(
        name="evlcp", no_args_is_help=True, rich_markup_mode="rich", pretty_exceptions_enable=False, help=HELP
    )
    app.callback()(_root)
    first = (receive, info, compare, simulate, score, sweep, report, demo)
    for module in (*first, calibrate, config, plugins, check):
        module.register(app)
    return app


def _version(show: bool) -> None:
    if show:
        from importlib.metadata import version

        typer.echo(f"evlcp-sdk {version('evlcp-sdk')}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    del version


def main() -> None:
    """Run the command line; an SDK error becomes one line a fault on stderr and its exit code."""
    from evlcp_sdk.cli._common import complain
    from evlcp_sdk.errors import EvlcpError
    from evlcp_sdk.plugin.registry import Registry

    try:
        app = make_app()
        Registry.load().hook.evlcp_register_commands(app=app)
        app()
    except EvlcpError as fault:
        complain(str(fault))
        sys.exit(fault.exit_code)
    except SystemExit as end:
        if end.code == 130:
            complain("interrupted")
        raise
