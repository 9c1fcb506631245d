"""`evlcp board`: program and watch driver boards."""

import contextlib
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evlcp_sdk.cli._common import LinkFile, Overrides
from firmware_host.commands import _source
from firmware_host.commands._line import (
    LINE,
    BoardLine,
    KeepAlive,
    LineCommand,
    SurveyCommand,
    from_command_line,
    keep_alive,
    line_options,
    open_board,
    progress_bar,
    say_done,
    say_watchdog,
)
from firmware_host.commands._source import RandomPackets, Seed, SymbolsFile

if TYPE_CHECKING:
    from firmware_host.board.bank import Bank
    from firmware_host.board.board import Board
    from firmware_host.protocol.requests import StatusReply

__all__ = ["app"]

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="""Program and watch driver boards.

    Exit codes: [bold]2[/] usage, [bold]3[/] input file, [bold]4[/] no board, [bold]5[/] refused,
    [bold]6[/] line, [bold]7[/] verify, [bold]8[/] incompatible.
    """,
)

app.callback()(line_options)

AsJson = Annotated[bool, typer.Option("--json", help="JSON on stdout.")]
Masks = Annotated[
    Path | None,
    typer.Option(metavar="FILE.npy", help="Chips instead: uint8, a column per LED or cluster."),
]


class Silence(StrEnum):
    """What a board does when the host falls silent."""

    KEEP = "keep"
    IDLE = "idle"
    DARK = "dark"


class Emulator(StrEnum):
    """Emulated boards."""

    NATIVE = "native"
    QEMU = "qemu"


def _show(table: dict[str, Any], as_json: bool) -> None:
    if as_json:
        import json

        typer.echo(json.dumps(table))
        return
    for key, value in table.items():
        text = ", ".join(map(str, value)) if isinstance(value, list) else value
        typer.echo(f"{key:20} {'-' if text in ('', None) else text}")


@app.command(cls=SurveyCommand)
def ports(context: typer.Context, as_json: AsJson = False) -> None:
    """List the serial ports, and which have a board.

    For example: [bold]evlcp board ports[/]
    """
    from firmware_host.board.survey import survey
    from firmware_host.board.tables import about_table

    line: BoardLine = context.obj
    found = survey(line.baud)
    if as_json:
        import json

        rows = [
            {"port": f.port, "description": f.description, "board": about_table(f.about) if f.about else None}
            for f in found
        ]
        typer.echo(json.dumps(rows))
        return
    for f in found:
        what = "no board answers"
        if f.about:
            about = about_table(f.about)
            what = f"{about['hal']} {about['unique_id']}, firmware {about['firmware']}"
        typer.echo(f"{f.port}  {f.description}  {what}")
    if not found:
        typer.echo("no serial ports; emulated boards: --port native: or --port qemu:")


@app.command(cls=LineCommand)
def hello(
    context: typer.Context,
    as_json: AsJson = False,
) -> None:
    """Show what a board is and what it can.

    For example: [bold]evlcp board --port native: hello[/]
    """
    from firmware_host.board.tables import about_table

    with open_board(context) as board:
        _show(about_table(board.about), as_json)


@app.command(cls=LineCommand)
def program(
    context: typer.Context,
    symbols: SymbolsFile = None,
    random: RandomPackets = None,
    masks: Masks = None,
    seed: Seed = 0,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    inventory: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="Program all boards of an inventory at once.")
    ] = None,
    level: Annotated[int | None, typer.Option(help="LED current, mA.", min=0, max=65535)] = None,
    watchdog: Annotated[Silence | None, typer.Option(help="What to do when the host is silent.")] = None,
    watchdog_ms: Annotated[int, typer.Option(help="After which silence, ms.", min=100, max=2**32 - 1)] = 5000,
    verify: Annotated[bool, typer.Option(help="Compare what the board holds.")] = True,
    start: Annotated[bool, typer.Option(help="Play when done.")] = True,
    stay: KeepAlive = False,
    as_json: AsJson = False,
) -> None:
    """Program a board, or all boards of an inventory: codebook, settings and payload.

    What is there already is not sent again. A board that plays changes between two packets, without a dark
    chip.

    For example: [bold]evlcp board --port /dev/ttyUSB0 program SYMBOLS.json[/]
    """
    if inventory is not None:
        from evlcp_sdk.errors import ConfigError

        given = [
            "/".join([*parameter.opts, *parameter.secondary_opts])
            for parameter in context.command.get_params(context)
            if parameter.name not in ("inventory", "verify", "as_json")
            and from_command_line(context, parameter.name or "")
        ]
        group = context.parent
        given += [f"--{name}" for name in LINE if group is not None and from_command_line(group, name)]
        if given:
            raise ConfigError(
                f"--inventory names ports, payloads and settings itself: write {given[0]} there,"
                " not on the command line"
            )
        _program_fleet(inventory, verify, as_json)
        return
    from firmware_host.board.board import Settings, provision
    from firmware_host.protocol.requests import Watchdog

    action = None if watchdog is None else Watchdog[watchdog.name]
    bank = _source.bank(symbols, random, masks, seed, link_file, overrides)
    settings = Settings(level, action, watchdog_ms, start)
    with open_board(context) as board:
        with progress_bar("programming") as progress:
            done = provision(board, bank, settings, verify, progress)
        say_done(done, as_json)
        if stay:
            keep_alive(board)


def _program_fleet(path: Path, verify: bool, as_json: bool) -> None:
    import json

    from firmware_host.board.fleet import Result, program_fleet, raise_failures, read_inventory

    inventory = read_inventory(path)

    def report(result: Result) -> None:
        typer.echo(json.dumps(result.to_dict()) if as_json else result.line)

    raise_failures(inventory, program_fleet(inventory, verify, report))


@app.command(cls=LineCommand)
def send(
    context: typer.Context,
    symbols: SymbolsFile = None,
    random: RandomPackets = None,
    masks: Masks = None,
    seed: Seed = 0,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    verify: Annotated[bool, typer.Option(help="Compare what the board holds.")] = True,
    as_json: AsJson = False,
) -> None:
    """Replace the payload of a programmed board, and nothing else.

    For example: [bold]evlcp board --port unix:/tmp/board send --random 4 --seed 7[/]
    """
    from firmware_host.errors import RefusedError
    from firmware_host.protocol.requests import NO_BANK, Status

    bank = _source.bank(symbols, random, masks, seed, link_file, overrides)
    with open_board(context) as board, progress_bar("sending") as progress:
        status = board.status()
        if status.active_bank == NO_BANK:
            raise RefusedError(
                f"{board.session.name}: nothing is programmed; 'evlcp board program' first",
                Status.NOTHING_COMMITTED,
            )
        _check_same_air(board, bank, status)
        done = board.program(bank, verify, progress)
    say_done(done, as_json)


def _check_same_air(board: "Board", bank: "Bank", status: "StatusReply") -> None:
    """What plays and what comes must be of one codebook and one chip rate."""
    from firmware_host.errors import IncompatibleError

    plays, comes = f"codebook {status.digest.hex()[:16]}", f"codebook {bank.codebook.digest[:16]}"
    if status.digest.hex() == bank.codebook.digest:
        if status.chip_rate_hz == bank.chip_rate_hz:
            return
        plays, comes = f"{status.chip_rate_hz} chips per second", f"air.chip_rate_hz = {bank.chip_rate_hz}"
    raise IncompatibleError(
        f"{board.session.name}: plays {plays}, this payload's link has {comes} ({bank.codebook.profile});"
        " give its link with -c or --set, or 'evlcp board program' to change it"
    )


@app.command(cls=LineCommand)
def start(context: typer.Context) -> None:
    """Play what is programmed."""
    with open_board(context) as board:
        board.start()


@app.command(cls=LineCommand)
def stop(context: typer.Context) -> None:
    """Finish the packet, then dark."""
    with open_board(context) as board:
        board.stop()
        board.wait_dark()


@app.command(cls=LineCommand)
def blank(context: typer.Context) -> None:
    """Dark at once."""
    with open_board(context) as board:
        board.blank()


@app.command(cls=LineCommand)
def level(
    context: typer.Context,
    level_ma: Annotated[int, typer.Argument(metavar="MA", help="LED current, mA.", min=0, max=65535)],
) -> None:
    """Set the LED current; above the board's maximum it is refused.

    For example: [bold]evlcp board --port /dev/ttyUSB0 level 20[/]
    """
    with open_board(context) as board:
        board.level(level_ma)


@app.command(cls=LineCommand)
def watchdog(
    context: typer.Context,
    action: Annotated[Silence, typer.Argument(help="What to do when the host is silent.")],
    after_ms: Annotated[int, typer.Option(help="After which silence, ms.", min=100, max=2**32 - 1)] = 5000,
) -> None:
    """Choose what the board does when the host falls silent: keep playing, idle pattern, or dark."""
    from firmware_host.protocol.requests import Watchdog

    with open_board(context) as board:
        board.watchdog(Watchdog[action.name], after_ms)
    say_watchdog(action, after_ms)


@app.command(cls=LineCommand)
def status(
    context: typer.Context,
    as_json: AsJson = False,
) -> None:
    """Show what a board does, and what went wrong since its reset."""
    from firmware_host.board.tables import status_table

    with open_board(context) as board:
        _show(status_table(board.status()), as_json)


@app.command(cls=LineCommand)
def monitor(
    context: typer.Context,
    interval: Annotated[float, typer.Option(help="Seconds between lines.", min=0.01)] = 1.0,
    count: Annotated[int | None, typer.Option(help="End after so many lines.", min=1)] = None,
    as_json: AsJson = False,
) -> None:
    """Show a line of status again and again, and keep the board's watchdog from acting; end with Ctrl-C."""
    import itertools
    import json

    from firmware_host.board.tables import name_of, status_table
    from firmware_host.protocol.requests import State

    with open_board(context) as board, contextlib.suppress(KeyboardInterrupt):
        for n in itertools.count(1):
            s = board.status()
            if as_json:
                typer.echo(json.dumps(status_table(s)))
            else:
                typer.echo(
                    f"{s.uptime_ms / 1e3:10.1f} s  {name_of(State, s.state):12} packets {s.packets_sent:8}"
                    f"  late {s.lateness_ticks:5} (max {s.lateness_max_ticks}) ticks"
                    f"  errors crc {s.crc_errors} framing {s.framing_errors} overflow {s.overflow_errors}"
                    f"  faults {s.faults:#04x}"
                )
            if n == count:
                return
            board.stay(interval, s)


@app.command(cls=LineCommand)
def verify(
    context: typer.Context,
    symbols: SymbolsFile = None,
    random: RandomPackets = None,
    masks: Masks = None,
    seed: Seed = 0,
    link_file: LinkFile = None,
    overrides: Overrides = None,
) -> None:
    """Read the active bank back and compare it with a payload; ends with 7 if it differs.

    For example: [bold]evlcp board --port /dev/ttyUSB0 verify SYMBOLS.json[/]
    """
    from firmware_host.errors import VerifyError
    from firmware_host.protocol.requests import NO_BANK

    bank = _source.bank(symbols, random, masks, seed, link_file, overrides)
    with open_board(context) as board:
        s = board.status()
        again = "'evlcp board program' brings it there"
        if s.active_bank == NO_BANK:
            raise VerifyError(f"{board.session.name}: nothing is programmed; {again}")
        _check_same_air(board, bank, s)
        packet = bank.packet
        shape = (s.format, s.packets, s.frames, s.pilot_every, s.length)
        if shape != (bank.format, bank.packets, packet.frames, packet.pilot_every, len(bank.content)):
            raise VerifyError(
                f"{board.session.name}: holds {s.packets} packets of {s.frames} frames, pilot in every"
                f" {s.pilot_every}, {s.length} bytes; expected {bank.packets} of {packet.frames},"
                f" pilot in every {packet.pilot_every}, {len(bank.content)} bytes; {again}"
            )
        held = board.read(s.active_bank, 0, s.length)
        differ = next((i for i, (a, b) in enumerate(zip(held, bank.content, strict=True)) if a != b), None)
        if differ is not None:
            raise VerifyError(
                f"{board.session.name}: byte {differ} of bank {s.active_bank} is {held[differ]:#04x},"
                f" expected {bank.content[differ]:#04x}; {again}"
            )
    typer.echo(f"same: {len(held)} bytes in bank {s.active_bank}, CRC {bank.crc:08x}")


@app.command("test-leds", cls=LineCommand)
def walk_leds(
    context: typer.Context,
    first: Annotated[int, typer.Option(help="First LED.", min=0, max=95)] = 0,
    last: Annotated[int, typer.Option(help="Last LED.", min=0, max=95)] = 95,
    dwell_ms: Annotated[int, typer.Option(help="Time each LED is on, ms.", min=1, max=65535)] = 100,
    wait: Annotated[bool, typer.Option(help="Wait until the walk has ended.")] = True,
) -> None:
    """Light the LEDs one by one.

    For example: [bold]evlcp board --port /dev/ttyUSB0 test-leds --dwell-ms 50[/]
    """
    with open_board(context) as board:
        board.test_leds(first, last, dwell_ms)
        if wait:
            board.wait_dark(10.0 + (last - first + 1) * dwell_ms * 2e-3)


@app.command(cls=LineCommand)
def save(
    context: typer.Context,
    autostart: Annotated[bool, typer.Option(help="Recall and play after a reset.")] = False,
) -> None:
    """Save payload and settings to the board's flash; stop it first.

    For example: [bold]evlcp board --port /dev/ttyUSB0 save --autostart[/]
    """
    with open_board(context) as board:
        reply = board.save(autostart)
    typer.echo(f"saved in slot {reply.slot}, number {reply.save_sequence}")


@app.command(cls=LineCommand)
def recall(context: typer.Context) -> None:
    """Take payload and settings from the board's flash."""
    with open_board(context) as board:
        reply = board.recall()
    typer.echo(f"recalled slot {reply.slot}, number {reply.save_sequence}")


@app.command()
def emulate(
    emulator: Annotated[Emulator, typer.Argument(help="native: a program; qemu: the ARM image.")],
    listen: Annotated[
        str, typer.Option(metavar="WHERE", help="unix:PATH, tcp:HOST:PORT, or (native) pty.")
    ] = "pty",
    leds: Annotated[Path | None, typer.Option(metavar="FILE", help="Record the LED outputs.")] = None,
    flash: Annotated[Path | None, typer.Option(metavar="FILE", help="(native) keep SAVE slots here.")] = None,
    link: Annotated[Path | None, typer.Option(metavar="PATH", help="(native) name for the pty.")] = None,
    baud: Annotated[int, typer.Option(help="(native) keep to a line rate; 0 as fast as it goes.", min=0)] = 0,
    unique_id: Annotated[int, typer.Option(help="(native) the board's number.", min=0, max=2**64 - 1)] = 0,
) -> None:
    """Run an emulated board in the foreground; end with Ctrl-C.

    For example: [bold]evlcp board emulate qemu --listen unix:/tmp/board --leds leds.bin[/]
    """
    import re
    import signal
    import subprocess

    from evlcp_sdk.errors import ConfigError, InputError
    from evlcp_sdk.files import check_output
    from firmware_host.emulators.processes import native_command, qemu_command, wait_for
    from firmware_host.errors import ToolchainError

    scheme, _, place = listen.partition(":")
    known = ("unix", "tcp") if emulator is Emulator.QEMU else ("unix", "tcp", "pty")
    if scheme not in known:
        raise ConfigError(f"--listen {listen}: expected {' or '.join(known)} for {emulator}")
    if scheme == "tcp":
        host, _, number = place.rpartition(":")
        if not host or not re.fullmatch("[0-9]{1,5}", number) or not 1 <= int(number) <= 65535:
            raise ConfigError(f"--listen {listen}: expected tcp:HOST:PORT with a port from 1 to 65535")
    if leds is not None:
        check_output(leds, regular=False)
    if emulator is Emulator.QEMU:
        command = qemu_command(listen, leds)
    else:
        command = native_command(listen, leds, flash, link, baud, unique_id)
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    # The emulator ends with this command, however that comes.
    signal.signal(signal.SIGTERM, lambda *_: process.terminate())
    try:
        if emulator is Emulator.QEMU and (line := wait_for(listen, process)) is not None:
            line.close()
            typer.echo(f"listening on {listen}")
        code = process.wait()
    except KeyboardInterrupt:
        process.terminate()
        process.wait()
        return
    if code == InputError.exit_code:
        raise typer.Exit(code)  # a file of the board's, which has said so
    if code not in (0, -signal.SIGTERM, -signal.SIGINT):
        raise ToolchainError(f"the {emulator} board ended with {code}; see its message above")


@app.command()
def leds(
    record: Annotated[Path, typer.Argument(metavar="FILE", help="LED record of an emulator.")],
    chips: Annotated[
        Path, typer.Option(metavar="OUT.npy", help="Chips: uint8, one row per chip, one column per cluster.")
    ],
    per_led: Annotated[bool, typer.Option("--per-led", help="One column an LED instead.")] = False,
) -> None:
    """Turn an LED record into a chip table; the ticks go into OUT.ticks.npy.

    Rows that are not a chip (dark, single-LED test) are left out. So is a last record that is cut off, and
    then the command ends with 3.

    For example: [bold]evlcp board leds leds.bin --chips chips.npy[/]
    """
    from evlcp_sdk.errors import ConfigError, InputError
    from evlcp_sdk.files import Outputs
    from firmware_host.commands._output import save_array
    from firmware_host.emulators.led_record import LedRecord

    played = LedRecord.read(record).played()
    try:
        table = played.chips(96 if per_led else 16)
    except ConfigError as fault:
        raise InputError(f"{record}: {fault}") from fault
    with Outputs() as outputs:
        save_array(chips, table, outputs)
        save_array(chips.with_suffix(".ticks.npy"), played.ticks, outputs)
        outputs.commit()
    typer.echo(f"{len(played)} chips")
    if played.cut_bytes:
        raise InputError(
            f"{record}: the last record is cut off ({played.cut_bytes} bytes) and left out;"
            f" the {len(played)} chips before it are in {chips}"
        )
