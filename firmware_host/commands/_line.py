"""The board of a command: the options that select it, and how commands open it."""

import contextlib
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import typer

from evlcp_sdk.cli._command import command
from evlcp_sdk.cli._common import echo, print_json
from evlcp_sdk.cli._stderr import print_stderr
from evlcp_sdk.errors import ConfigError
from firmware_host.commands import _host as host
from firmware_host.commands._json import JsonCommand


@dataclass(frozen=True)
class BoardLine:
    """The line to the board."""

    PANEL: ClassVar[str] = "Line"

    port: Annotated[
        str | None,
        typer.Option(
            envvar="EVLCP_PORT",
            show_envvar=False,
            metavar="PORT",
            help="Device, URL, usb:VID:PID, unix:PATH, native:; or all are asked.",
        ),
    ] = None
    baud: Annotated[
        int, typer.Option(help="Line rate, bit/s.", min=1200, metavar="RATE", show_default=False)
    ] = 1_000_000
    trace: Annotated[Path | None, typer.Option(metavar="FILE", help="Record the wire.")] = None
    replay: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Play a recorded wire back; no board.")
    ] = None
    key: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            envvar="EVLCP_BOARD_KEY",
            show_envvar=False,
            help="The board's key, or EVLCP_BOARD_KEY.",
        ),
    ] = None

    def find_port(self) -> str:
        """The named port, or else the only one on which a board answers."""
        return self.port or host.survey.find_board_port(self.baud)

    @contextlib.contextmanager
    def open(self) -> "Iterator[host.board.Board]":
        """Open the board on the line, or the recorded one."""
        # an invalid key is reported before the line is opened
        key = None if self.key is None else host.keys.read_board_key(self.key)
        if self.replay is None:
            line = host.opening.open_port(self.find_port(), self.baud)
            session = host.session.Session(line, host.client.Timing(self.baud), key=key, trace=self.trace)
        elif self.trace is not None:
            raise ConfigError("--trace and --replay: give one of the two")
        else:
            trace = host.transport.ReplayTransport(self.replay)
            session = host.session.Session(
                trace, host.client.Timing(trace.baud), trace.first, trace.nonce, key=key
            )
        with session:
            yield host.board.Board(session)


LINE = tuple(field.name for field in fields(BoardLine))
"""The options of a line."""


@command
def line_options(*, context: typer.Context, line: BoardLine) -> None:
    """The callback of a group whose commands work on a board."""
    name = context.invoked_subcommand or ""
    allowed = getattr(getattr(context.command, "commands", {}).get(name), "line", ())
    for option in LINE:
        if option not in allowed and from_command_line(context, option):
            raise typer.BadParameter(f"'{name}' takes no --{option}", param_hint=f"--{option}")
    context.obj = line


class LineCommand(JsonCommand):
    """A command on a board: the group's options of the line may follow its name, too."""

    line: ClassVar[tuple[str, ...]] = LINE

    def get_params(self, ctx: Any) -> Any:
        """The command's own parameters, and those of the group."""
        group = ctx.parent.command.params if ctx.parent is not None else []
        return [*super().get_params(ctx), *(p for p in group if p.name in self.line)]

    def invoke(self, ctx: Any) -> Any:
        """Run it; options after its name override those before it."""
        given = {name: ctx.params.pop(name) for name in self.line}
        after_name = {name: value for name, value in given.items() if from_command_line(ctx, name)}
        ctx.obj = replace(ctx.obj or BoardLine(), **after_name)
        return super().invoke(ctx)


class SurveyCommand(LineCommand):
    """A command on all ports."""

    line = ("baud",)


def from_command_line(context: Any, name: str) -> bool:
    """Whether a parameter comes from the command line, not from its default or the environment."""
    return getattr(context.get_parameter_source(name), "name", "") == "COMMANDLINE"


def open_board(context: typer.Context) -> "AbstractContextManager[host.board.Board]":
    """Open the board that a command's options select."""
    line: BoardLine = context.obj
    return line.open()


def print_watchdog(action: str, timeout_ms: int) -> None:
    """Print what the board's watchdog will do after this command, unless it keeps playing."""
    if action != "keep":
        what = "shows its idle pattern" if action == "idle" else "goes dark"
        echo(
            f"watchdog: the board {what} once no host has spoken for {timeout_ms / 1e3:g} s;"
            " 'evlcp board monitor' or --keep-alive keeps it playing"
        )


KeepAlive = Annotated[
    bool, typer.Option("--keep-alive", help="Stay, for the board's watchdog, until Ctrl-C.")
]


def keep_alive(board: "host.board.Board") -> None:
    """Keep a board's watchdog from acting until Ctrl-C; print changes of state and faults on stderr."""
    status = board.status()
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            before = (status.state, status.faults)
            board.wait_with_keep_alive(1.0, status)
            status = board.status()
            if (status.state, status.faults) != before:
                faults = ", ".join(host.tables.flag_names(host.requests.BoardFault, status.faults)) or "none"
                print_stderr(
                    f"{board.session.name}: state {host.tables.enum_name(host.requests.State, status.state)},"
                    f" faults {faults}"
                )


def print_program_result(done: Any, as_json: bool) -> None:
    """Print the result of programming."""
    if as_json:
        print_json(asdict(done))
        return
    if not done.swapped:
        echo(f"was there already: {done.length} bytes in bank {done.bank}")
    else:
        echo(f"sent {done.written} of {done.length} bytes; bank {done.bank} is active")
    print_watchdog(done.watchdog, done.watchdog_ms)
