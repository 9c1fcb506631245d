"""What the `evlcp` command line consists of, plugins' commands included."""

import importlib
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from inspect import cleandoc
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup
from typer.models import CommandInfo

from evlcp_sdk.cli._common import echo, hush, log_on_stderr
from evlcp_sdk.printable import escape_controls

if TYPE_CHECKING:
    from evlcp_sdk.plugin.registry import Registry

HELP = """Read data and distance from blinking LEDs with an event camera.

[bold]evlcp loop[/] sends a text from end to end on this machine, board and camera emulated;
[bold]evlcp demo[/] simulates a drive; [bold]evlcp receive REC.raw -o out[/] decodes yours.

Exit codes: [bold]0[/] done, also without a transmitter; [bold]1[/] failed; [bold]2[/] usage, link or plugin;
[bold]3[/] input that cannot be read; [bold]4[/] much dropped; [bold]5[/] a camera that went away;
[bold]70[/] a fault of evlcp itself; [bold]130[/] interrupted.
"""


_OWN = (
    "receive",
    "live",
    "serve",
    "convert",
    "video",
    "info",
    "diagnose",
    "compare",
    "simulate",
    "score",
    "sweep",
    "report",
    "demo",
    "calibrate",
    "survey",
    "config",
    "plugins",
    "check",
    "warm_up",
)
"""Modules of our own commands, each of which has the one that it is named after."""

_WRAPPED = re.compile(r"(?<!\n)\n(?!\n|[A-Z][^\n:\[]+:\s+\[bold\])")
"""Where a help text goes on in the next line, which Typer keeps: no paragraph or example ends."""


class _Commands(TyperGroup):
    """The commands; what Typer says of a wrong command line repeats it, and moves no cursor either."""

    def make_context(self, *args: Any, **more: Any) -> Any:
        with _printable_faults():
            return super().make_context(*args, **more)

    def invoke(self, ctx: Any) -> Any:
        with _printable_faults():
            return super().invoke(ctx)


def _parse_once(command: Any, parse: Callable[..., Any], ctx: Any, args: list[str]) -> Any:
    """Refuse an option that takes one value and is given two, of which all but the last would be ignored."""
    try:
        _, _, order = command.make_parser(ctx).parse_args(list(args))
    except Exception:
        # The command itself says what is wrong with them.
        return parse(ctx, args)
    for option in order:
        many = option.param_type_name != "option" or option.multiple or option.is_flag or option.count
        if not many and order.count(option) > 1:
            said = f"{option.opts[-1]} is given {order.count(option)} times, expected once"
            if "--config" in option.opts:
                said += f": {ctx.info_name} goes by one link; run it once for each"
            ctx.fail(said)
    return parse(ctx, args)


@contextmanager
def _printable_faults() -> Iterator[None]:
    """Have those exceptions say it in printable words that Typer itself shows."""
    try:
        yield
    except Exception as fault:
        words = getattr(fault, "format_message", None)
        if words is not None:
            said = escape_controls(words())
            fault.format_message = lambda: said  # type: ignore[attr-defined]
        raise


def _finish(command: Any) -> None:
    """Have a command, and those of a group, wrap its help as the screen is wide, and take options once."""
    for nested in getattr(command, "commands", {}).values():
        _finish(nested)
    command.help = _WRAPPED.sub(" ", cleandoc(command.help or ""))
    command.parse_args = partial(_parse_once, command, command.parse_args)


def make_app(*modules: str) -> typer.Typer:
    """The command line with its own commands; plugins add theirs by `evlcp_register_commands`.

    Args:
        modules: Of these of `_OWN` alone; none for all.
    """
    app = typer.Typer(
        name="evlcp",
        cls=_Commands,
        no_args_is_help=True,
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        help=HELP,
    )
    app.callback()(_root)
    for module in modules or _OWN:
        command = getattr(importlib.import_module(f"evlcp_sdk.cli.{module}"), module)
        app.command(module.replace("_", "-"))(command)
    return app


def add_plugin_commands(app: typer.Typer, registry: "Registry") -> None:
    """Add the commands of plugins; a plugin whose commands cannot be built, or are there, is left out."""
    known = _names(app)
    for plugin in registry.plugins_with_hook("evlcp_register_commands"):
        added = typer.Typer()
        for _ in registry.call_hook("evlcp_register_commands", only=plugin, app=added):
            reason = None
            if registry.distribution_of(plugin)[0] != "evlcp-sdk":
                # Ours are built in any case, and tested.
                reason = _fault_of(added, known)
            if reason is not None:
                registry.leave_out(plugin, reason)
                continue
            known |= _names(added)
            app.registered_commands += added.registered_commands
            app.registered_groups += added.registered_groups


def _names(app: typer.Typer) -> set[str]:
    """Names of its commands and groups, as they are called."""
    named = {_name(command) for command in app.registered_commands}
    return named | {group.name or "" for group in app.registered_groups}


def _name(command: CommandInfo) -> str:
    """How a command is called, as Typer has it."""
    return command.name or str(getattr(command.callback, "__name__", "")).lower().replace("_", "-")


def _fault_of(added: typer.Typer, known: set[str]) -> str | None:
    """What is wrong with the commands of a plugin, in one line."""
    if not (added.registered_commands or added.registered_groups):
        return None
    # With a callback, a single command is built as one of a group, too.
    added.callback()(lambda: None)
    try:
        typer.main.get_command(added)
    except Exception as fault:
        return f"its commands cannot be built: {type(fault).__name__}: {' '.join(str(fault).split())}"
    twice = sorted(known & _names(added))
    return f"has the command '{twice[0]}', which is there already" if twice else None


def _version(show: bool) -> None:
    if show:
        from importlib.metadata import version

        echo(f"evlcp-sdk {version('evlcp-sdk')}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    del version


def run() -> None:
    """Parse the command line and run its command; a `PluginWarning` becomes a line on stderr.

    Raises:
        EvlcpError: What the command raises.
        SystemExit: The command has ended.
    """
    import warnings

    from evlcp_sdk.cli._complain import complain
    from evlcp_sdk.errors import PluginWarning

    others = warnings.showwarning
    said = set()

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if issubclass(category, PluginWarning):
            # Every registry of the process finds it again.
            if str(message) not in said:
                complain(f"warning: {message}")
            said.add(str(message))
        else:
            others(message, category, *place, **more)

    with warnings.catch_warnings(), log_on_stderr():
        warnings.simplefilter("always", PluginWarning)
        warnings.showwarning = show
        hush()
        module = "".join(sys.argv[1:2]).replace("-", "_")
        if module in _OWN and module != "plugins":
            # It needs neither others nor a plugin's, and would wait for these a tenth of its start.
            app = make_app(module)
        else:
            from evlcp_sdk.plugin.registry import Registry

            app = make_app()
            add_plugin_commands(app, Registry.load())
        group = typer.main.get_group(app)
        _finish(group)
        group()
