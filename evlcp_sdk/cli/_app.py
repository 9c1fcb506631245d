"""The `evlcp` command line, with the commands of plugins."""

import importlib
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from inspect import cleandoc
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import echo, log_on_stderr, silence_matplotlib
from evlcp_sdk.formatting import escape_controls

HELP = """Read data and distance from blinking LEDs with an event camera.

[bold]evlcp loop[/] sends a text from end to end on this machine, board and camera emulated;
[bold]evlcp demo[/] simulates a drive; [bold]evlcp receive REC.raw -o out[/] decodes yours.

Exit codes: [bold]0[/] done, also without a transmitter; [bold]1[/] failed; [bold]2[/] usage, link or plugin;
[bold]3[/] input that cannot be read; [bold]4[/] much dropped; [bold]5[/] a camera that went away;
[bold]70[/] a fault of evlcp itself; [bold]130[/] interrupted.
"""


_BUILT_IN = (
    *("receive", "live", "serve", "convert", "video", "info", "diagnose", "compare", "simulate", "score"),
    *("sweep", "report", "demo", "calibrate", "survey", "config", "plugins", "check", "warm_up"),
)
"""Modules of the built-in commands, each with the function of its name."""

_LINE_BREAK = re.compile(r"(?<!\n)\n(?!\n|[A-Z][^\n:\[]+:\s+\[bold\])")
"""Line breaks of a help text, which Typer keeps, within a paragraph or example."""


class _Commands(TyperGroup):
    """The commands; Typer's messages, which repeat a wrong command line, are escaped."""

    def make_context(self, *args: Any, **more: Any) -> Any:
        with _escape_messages():
            return super().make_context(*args, **more)

    def invoke(self, ctx: Any) -> Any:
        with _escape_messages():
            return super().invoke(ctx)


def _parse_once(command: Any, parse: Callable[..., Any], ctx: Any, args: list[str]) -> Any:
    """Refuse an option that takes one value and is given twice; Typer would take the last."""
    try:
        _, _, order = command.make_parser(ctx).parse_args(list(args))
    except Exception:
        # The command itself reports what is wrong.
        return parse(ctx, args)
    for option in order:
        repeats = option.param_type_name != "option" or option.multiple or option.is_flag or option.count
        if not repeats and order.count(option) > 1:
            message = f"{option.opts[-1]} is given {order.count(option)} times, expected once"
            if "--config" in option.opts:
                message += f": {ctx.info_name} goes by one link; run it once for each"
            ctx.fail(message)
    rest = parse(ctx, args)
    _refuse_overwriting(ctx)
    return rest


def _refuse_overwriting(ctx: Any) -> None:
    """Refuse an option -o that names a file which is read, perhaps as `list:FILE?unit=ms`."""
    names: dict[bool, list[str]] = {True: [], False: []}
    for key, value in ctx.params.items():
        values = value if isinstance(value, (list, tuple)) else [value]
        names[key == "out"] += [str(one) for one in values if one is not None]
    for out in filter(os.path.isfile, names[True]):
        for name in names[False] + [name.partition(":")[2].partition("?")[0] for name in names[False]]:
            with suppress(OSError):
                if Path(name).samefile(out):
                    ctx.fail(f"-o {out}: it is read, and would be overwritten; give another name")


@contextmanager
def _escape_messages() -> Iterator[None]:
    """Escape control characters in the messages of exceptions that Typer prints."""
    try:
        yield
    except Exception as fault:
        if hasattr(fault, "format_message"):
            message = escape_controls(fault.format_message())
            fault.format_message = lambda: message
        raise


def _prepare_command(command: Any) -> None:
    """Let a command, and those of a group, wrap its help, give flags no type, and refuse repeated options."""
    for nested in getattr(command, "commands", {}).values():
        _prepare_command(nested)
    command.help = _LINE_BREAK.sub(" ", cleandoc(command.help or ""))
    for flag in (one for one in command.get_params(typer.Context(command)) if getattr(one, "is_flag", False)):
        flag.metavar = ""
    command.parse_args = partial(_parse_once, command, command.parse_args)


def make_app(*modules: str) -> typer.Typer:
    """The command line with these of the built-in commands, by default all; plugins add theirs later."""
    app = typer.Typer(
        name="evlcp",
        cls=_Commands,
        no_args_is_help=True,
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        help=HELP,
    )
    app.callback()(_root)
    for module in modules or _BUILT_IN:
        command = getattr(importlib.import_module(f"evlcp_sdk.cli.{module}"), module)
        app.command(module.replace("_", "-"))(command)
    return app


def add_plugin_commands(app: typer.Typer, registry: "sdk.registry.Registry") -> dict[str, str]:
    """Add the commands of plugins; return the plugin of each that is not the SDK's own.

    A plugin whose commands cannot be built, or exist already, is left out.
    """
    known, strangers = _command_names(app), dict[str, str]()
    for plugin in registry.plugins_with_hook("evlcp_register_commands"):
        added = typer.Typer()
        for _ in registry.call_hook("evlcp_register_commands", only=plugin, app=added):
            if registry.distribution_of(plugin)[0] != "evlcp-sdk":
                # The SDK's own are tested.
                if (reason := _find_fault(added, known)) is not None:
                    registry.leave_out(plugin, reason)
                    continue
                strangers |= dict.fromkeys(_command_names(added), plugin)
            known |= _command_names(added)
            app.registered_commands += added.registered_commands
            app.registered_groups += added.registered_groups
    return strangers


def _command_names(app: typer.Typer) -> set[str]:
    names = {group.name or "" for group in app.registered_groups}
    for command in app.registered_commands:
        names.add(command.name or str(getattr(command.callback, "__name__", "")).lower().replace("_", "-"))
    return names


def _find_fault(added: typer.Typer, known: set[str]) -> str | None:
    """Why the commands of a plugin cannot be added, in one line; None where they can."""
    # With a callback, a single command is built as a group, too.
    added.callback()(lambda: None)
    try:
        typer.main.get_command(added)
    except Exception as fault:
        return f"its commands cannot be built: {type(fault).__name__}: {' '.join(str(fault).split())}"
    duplicates = sorted(known & _command_names(added))
    return f"has the command '{duplicates[0]}', which is there already" if duplicates else None


def _print_version(show: bool) -> None:
    if show:
        from importlib.metadata import version

        echo(f"evlcp-sdk {version('evlcp-sdk')}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end."),
    ] = False,
) -> None:
    del version


def run() -> None:
    """Parse the command line and run its command; a `PluginWarning` becomes a line on stderr.

    Raises:
        EvlcpError: The command has failed.
        SystemExit: The command has ended.
    """
    import warnings

    from evlcp_sdk.cli._stderr import print_stderr
    from evlcp_sdk.errors import OWN_FAULT, PluginError, PluginWarning, describe_plugin_fault, explain_fault

    show_other = warnings.showwarning
    # Every registry of the process repeats it; Python's own filter forgets when a library changes it.
    print_once = cache(print_stderr)

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if issubclass(category, PluginWarning):
            print_once(f"warning: {message}")
        else:
            show_other(message, category, *place, **more)

    with warnings.catch_warnings(), log_on_stderr():
        warnings.simplefilter("always", PluginWarning)
        warnings.showwarning = show
        silence_matplotlib()
        name = "".join(sys.argv[1:2])
        module, registry, strangers = name.replace("-", "_"), None, dict[str, str]()
        if module in _BUILT_IN and module != "plugins":
            # Neither other commands nor plugins are needed, which take a tenth of a start.
            app = make_app(module)
        else:
            app, registry = make_app(), sdk.registry.Registry.load()
            strangers = add_plugin_commands(app, registry)
        group = typer.main.get_group(app)
        _prepare_command(group)
        try:
            group(obj=registry)
        except Exception as fault:
            if name not in strangers or explain_fault(fault)[1] != OWN_FAULT:
                raise
            blamed = f"command '{name}' of plugin {strangers[name]}: {describe_plugin_fault(fault)}"
            raise PluginError(blamed) from fault
