"""`evlcp board`: program and watch driver boards."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._command import command
from evlcp_sdk.cli._common import LinkFile, Overrides, echo, print_json, print_result, progress_bar
from evlcp_sdk.cli._stderr import print_stderr
from evlcp_sdk.errors import ConfigError, EvlcpError, InputError, name_place
from evlcp_sdk.files import Outputs, check_output
from evlcp_sdk.signals import stop_on_request
from firmware_host.commands import _firmware, _host as host
from firmware_host.commands._json import AsJson, JsonCommand, fault_table
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
    print_program_result,
    print_watchdog,
)
from firmware_host.commands._source import BankOptions
from firmware_host.commands.stream import stream
from firmware_host.errors import BoardError, RefusedError

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="""Program and watch driver boards.

    Exit codes: [bold]2[/] usage, [bold]3[/] input file, [bold]4[/] no board, [bold]5[/] refused,
    [bold]6[/] line, [bold]7[/] verify, [bold]8[/] incompatible.
    """,
)

app.callback()(line_options)
app.command("build", cls=JsonCommand)(_firmware.build_images)
app.command(cls=_firmware.FlashCommand)(_firmware.flash)
app.command(cls=LineCommand)(_firmware.update)

InventoryFile = Annotated[
    Path | None, typer.Option("--inventory", metavar="FILE.toml", help="All boards of an inventory at once.")
]


Silence = Literal["keep", "idle", "dark"]
"""What a board does when the host falls silent."""


def _print_table(table: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(table)
        return
    for key, value in table.items():
        text = ", ".join(map(str, value)) if isinstance(value, list) else value
        echo(f"{key:20} {'-' if text in ('', None) else text}")


@app.command(cls=SurveyCommand)
def ports(
    context: typer.Context,
    usb: Annotated[
        str | None,
        typer.Option(metavar="VID:PID", help="Only ports with this USB id; VID, VID:PID or VID:PID:SERIAL."),
    ] = None,
    ask: Annotated[bool, typer.Option(help="Say HELLO on ports whose USB id boards usually have.")] = True,
    every: Annotated[bool, typer.Option("--all", help="Say HELLO on every port.")] = False,
    as_json: AsJson = False,
) -> None:
    """List the serial ports, their USB ids, and which have a board.

    Nothing is written to a port whose USB id is not that of a bridge that boards usually have,
    unless --usb or --all asks for it.

    For example: [bold]evlcp board ports --usb 0403[/]
    """
    line: BoardLine = context.obj
    found = host.survey.survey_ports(line.baud, usb, every, ask)
    if as_json:
        rows = []
        for f in found:
            port = asdict(f.port)
            info = host.tables.info_table(f.info) if f.info else None
            answer = {"asked": f.asked, "board": info, "fault": f.fault or None}
            rows.append({"port": port.pop("device"), **port, **answer})
        print_json(rows)
        return
    for f in found:
        what = f.fault
        if f.info:
            info = host.tables.info_table(f.info)
            what = f"{info['hal']} {info['unique_id']}, firmware {info['firmware']}"
        serial = f" {f.port.serial_number}" if f.port.serial_number else ""
        echo(f"{f.port.device}  {f.port.usb or '-'}{serial}  {f.port.description}  {what}")
    if not found:
        which = "no serial ports" if usb is None else f"no serial port with USB id {usb}"
        echo(f"{which}; an emulated board: --port native:")


@app.command(cls=LineCommand)
def hello(context: typer.Context, as_json: AsJson = False) -> None:
    """Show what a board is and what it can.

    For example: [bold]evlcp board --port native: hello[/]
    """
    with open_board(context) as board:
        _print_table(host.tables.info_table(board.info), as_json)


@app.command(cls=LineCommand)
@command
def program(
    *,
    context: typer.Context,
    payload: BankOptions,
    inventory: InventoryFile = None,
    level: Annotated[
        int | None, typer.Option(help="LED current, mA.", min=0, max=65535, metavar="MA")
    ] = None,
    level_limit: Annotated[
        int | None, typer.Option(help="Largest LED current from now on, mA.", min=1, max=65535, hidden=True)
    ] = None,
    duty_limit: Annotated[
        float | None,
        typer.Option(help="Largest share of time that a LED is on.", min=0.001, max=1.0, hidden=True),
    ] = None,
    watchdog: Annotated[Silence | None, typer.Option(help="What to do when the host is silent.")] = None,
    watchdog_ms: Annotated[
        int, typer.Option(help="After which silence, ms.", min=100, max=2**32 - 1, hidden=True)
    ] = 5000,
    verify: Annotated[bool, typer.Option(help="Compare it there.", show_default=False)] = True,
    start: Annotated[bool, typer.Option(help="Play when done.", show_default=False)] = True,
    stay: KeepAlive = False,
    as_json: AsJson = False,
) -> None:
    """Program a board, or all boards of an inventory.

    What is there already is not sent again. It changes between two packets.

    Symbols:  [bold]evlcp board --port /dev/ttyUSB0 program SYMBOLS.json[/]
    A text:   [bold]evlcp tx message --text "Tempo 30" --port /dev/ttyUSB0[/]
    """
    if inventory is not None:
        _check_inventory_options(context, "verify", "stay")
        entries, banks = host.fleet.read_inventory(inventory)
        host.fleet.program_fleet(inventory, entries, banks, verify, partial(print_result, as_json=as_json))
        if stay:
            _watch_fleet(inventory, entries, 1.0, None, True, as_json, quiet=True)
        return
    bank = payload.load_bank()
    settings = host.board.Settings(level, watchdog, watchdog_ms, start, level_limit, duty_limit)
    with open_board(context) as board:
        with progress_bar("programming") as progress:
            done = host.board.provision(board, bank, settings, verify, progress)
        print_program_result(done, as_json)
        if stay:
            keep_alive(board)


def _check_inventory_options(context: typer.Context, *allowed: str) -> None:
    given = [
        "/".join([*parameter.opts, *parameter.secondary_opts])
        for parameter in context.command.get_params(context)
        if parameter.name not in ("inventory", "as_json", *allowed)
        and from_command_line(context, parameter.name or "")
    ]
    group = context.parent
    given += [f"--{name}" for name in LINE if group is not None and from_command_line(group, name)]
    if given:
        raise ConfigError(
            f"--inventory names ports, payloads and settings itself: write {given[0]} there,"
            " not on the command line"
        )


def _run_on_boards(
    context: typer.Context,
    inventory: Path | None,
    as_json: bool,
    work: Callable[[host.fleet.FleetEntry | None, host.board.Board], tuple[str, dict[str, Any]]],
    *allowed: str,
) -> None:
    """Work on a board, or on all of an inventory, and print the results.

    With an inventory, `allowed` options may be given, and the exit code is that of the first failed board.
    """
    if inventory is None:
        with open_board(context) as board:
            text, table = work(None, board)
        print_result(text, table, as_json)
        return
    _check_inventory_options(context, *allowed)
    host.fleet.run_fleet(
        inventory, host.fleet.read_entries(inventory), work, partial(print_result, as_json=as_json)
    )


@app.command(cls=LineCommand)
@command
def send(
    *,
    context: typer.Context,
    payload: BankOptions,
    verify: Annotated[bool, typer.Option(help="Compare it there.", show_default=False)] = True,
    as_json: AsJson = False,
) -> None:
    """Replace the payload of a programmed board, and nothing else.

    For example: [bold]evlcp board --port unix:/tmp/board send --random 4 --seed 7[/]
    """
    bank = payload.load_bank()
    with open_board(context) as board, progress_bar("sending") as progress:
        status = board.status()
        if status.active_bank == host.requests.NO_BANK:
            raise RefusedError(
                f"{board.session.name}: nothing is programmed; 'evlcp board program' first",
                host.requests.Status.NOTHING_COMMITTED,
            )
        board.check_same_air(bank, status)
        done = board.program(bank, verify, progress)
    print_program_result(done, as_json)


app.command(cls=LineCommand)(stream)


@app.command(cls=LineCommand)
def start(
    context: typer.Context,
    inventory: InventoryFile = None,
    pulse_hz: Annotated[
        int | None,
        typer.Option(
            metavar="HZ",
            help="All at the same pulse of their pulse inputs, and in step from then on.",
            min=1,
            max=65535,
        ),
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            min=0.0,
            help="With --pulse-hz: stay until they play; if the pulse has not come by then, stop them.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Play what is programmed.

    With --pulse-hz a board is armed, and waits in the dark for a pulse on its pulse input (PPS).

    For example: [bold]evlcp board start --inventory tunnel.toml --pulse-hz 1[/]
    """
    if pulse_hz is not None:
        _start_together(context, inventory, pulse_hz, timeout, as_json)
        return
    if timeout is not None:
        raise ConfigError("--timeout belongs to --pulse-hz: without it a board plays at once")
    _change_state(context, inventory, as_json, lambda board: board.start(), "playing")


@app.command(cls=LineCommand)
def stop(context: typer.Context, inventory: InventoryFile = None, as_json: AsJson = False) -> None:
    """Finish the packet, then dark; what waits in a stream is dropped."""

    def work(board: host.board.Board) -> None:
        board.stop()
        board.wait_dark()

    _change_state(context, inventory, as_json, work, "dark")


@app.command(cls=LineCommand)
def blank(context: typer.Context, inventory: InventoryFile = None, as_json: AsJson = False) -> None:
    """Dark at once."""
    _change_state(context, inventory, as_json, lambda board: board.blank(), "dark")


def _start_together(
    context: typer.Context, inventory: Path | None, pulse_hz: int, timeout_s: float | None, as_json: bool
) -> None:
    with contextlib.ExitStack() as stack:
        if inventory is None:
            boards = [stack.enter_context(open_board(context))]
        else:
            _check_inventory_options(context, "pulse_hz", "timeout")
            entries = host.fleet.read_entries(inventory)
            boards = [
                stack.enter_context(host.fleet.open_entry(entry, inventory.parent)) for entry in entries
            ]
        targets = host.step.start_together(boards, pulse_hz)
        table = {board.session.name: target for board, target in zip(boards, targets, strict=True)}
        words = ", ".join(f"{name} for its pulse {target}" for name, target in table.items())
        if timeout_s is None:
            text = (
                f"armed: waits for a pulse on PPS ({words}); 'evlcp board status' shows whether it has come"
            )
            print_result(text, {"state": "waiting", "at_pulse": table}, as_json)
            return
        if not as_json:
            echo(f"armed: waits for a pulse on PPS ({words}), for at most {timeout_s:g} s")
        host.step.wait_for_pulse(boards, timeout_s)
    print_result("plays", {"state": "playing", "at_pulse": table}, as_json)


def _change_state(
    context: typer.Context,
    inventory: Path | None,
    as_json: bool,
    ask: Callable[[host.board.Board], Any],
    state: str,
) -> None:

    def work(_: host.fleet.FleetEntry | None, board: host.board.Board) -> tuple[str, dict[str, Any]]:
        ask(board)
        return state if inventory else "", {"state": state}

    _run_on_boards(context, inventory, as_json, work)


@app.command(cls=LineCommand)
def level(
    context: typer.Context,
    level_ma: Annotated[int, typer.Argument(metavar="MA", help="LED current, mA.", min=0, max=65535)],
    as_json: AsJson = False,
) -> None:
    """Set the LED current, up to the board's maximum.

    For example: [bold]evlcp board --port /dev/ttyUSB0 level 20[/]
    """
    with open_board(context) as board:
        board.set_level(level_ma)
    print_result("", {"level_ma": level_ma}, as_json)


@app.command(cls=LineCommand)
def watchdog(
    context: typer.Context,
    action: Annotated[Silence, typer.Argument(help="What to do when the host is silent.")],
    after_ms: Annotated[int, typer.Option(help="After which silence, ms.", min=100, max=2**32 - 1)] = 5000,
    as_json: AsJson = False,
) -> None:
    """Choose what the board does when the host falls silent."""
    with open_board(context) as board:
        board.set_watchdog(host.requests.Watchdog[action.upper()], after_ms)
    if as_json:
        print_json({"watchdog": action, "watchdog_ms": after_ms})
    else:
        print_watchdog(action, after_ms)


@app.command(cls=LineCommand)
def status(context: typer.Context, inventory: InventoryFile = None, as_json: AsJson = False) -> None:
    """Show what a board does, and what went wrong since its reset."""
    if inventory is None:
        with open_board(context) as board:
            _print_table(host.tables.status_table(board.status()), as_json)
        return

    def work(_: host.fleet.FleetEntry | None, board: host.board.Board) -> tuple[str, dict[str, Any]]:
        found = host.tables.status_table(board.status())
        faults = f", faults {', '.join(found['faults'])}" if found["faults"] else ""
        return f"{found['state']}, {found['packets_sent']} packets sent{faults}", {"status": found}

    _run_on_boards(context, inventory, as_json, work)


@app.command(cls=LineCommand)
def monitor(
    context: typer.Context,
    interval: Annotated[float, typer.Option(help="Seconds between lines.", min=0.01)] = 1.0,
    count: Annotated[int | None, typer.Option(help="End after so many lines.", min=1)] = None,
    reconnect: Annotated[bool, typer.Option(help="Look for a board that is gone until it answers.")] = True,
    inventory: InventoryFile = None,
    as_json: AsJson = False,
) -> None:
    """Show the status again and again, until Ctrl-C.

    That keeps the board's watchdog from acting. A board that is gone is looked for until it answers again.
    """
    if inventory is not None:
        _check_inventory_options(context, "interval", "count", "reconnect")
        _watch_fleet(inventory, host.fleet.read_entries(inventory), interval, count, reconnect, as_json)
        return
    line: BoardLine = context.obj
    # Without a named port, the one that is found now is kept.
    named = line if line.port or line.replay else replace(line, port=line.find_port())
    with contextlib.suppress(KeyboardInterrupt):
        for event in host.monitor.watch_board(named.open, interval, count, reconnect):
            _print_event(event, {"port": named.port}, as_json)


def _watch_fleet(
    path: Path,
    entries: Sequence[host.fleet.FleetEntry],
    interval: float,
    count: int | None,
    reconnect: bool,
    as_json: bool,
    quiet: bool = False,
) -> None:
    """Watch all boards of an inventory until Ctrl-C, or until each has had `count` statuses.

    `quiet` prints only lost and returned boards. One that fails is reported, and the others are watched on.
    """
    from concurrent.futures import ThreadPoolExecutor

    ended, printing, codes = threading.Event(), threading.Lock(), list[int]()

    def watch_entry(entry: host.fleet.FleetEntry) -> None:
        which = {"id": entry.id, "port": entry.port}
        try:
            for event in host.monitor.watch_board(
                partial(host.fleet.open_entry, entry, path.parent),
                *(interval, count, reconnect, reconnect, ended),
            ):
                if quiet and isinstance(event, host.requests.StatusReply):
                    continue
                with printing:
                    _print_event(event, which, as_json)
        except EvlcpError as fault:
            codes.append(fault.exit_code)
            with printing:
                if as_json:
                    print_json(which | fault_table(fault))
                print_stderr(f"{entry.id}: {fault}")

    with ThreadPoolExecutor(len(entries)) as pool:
        try:
            for watch in [pool.submit(watch_entry, entry) for entry in entries]:
                watch.result()
        except KeyboardInterrupt:
            return
        finally:
            ended.set()
    if codes:
        raise typer.Exit(codes[0])


def _print_event(
    event: host.requests.StatusReply | BoardError | host.monitor.BoardReturned | host.monitor.KeyMissing,
    which: dict[str, Any],
    as_json: bool,
) -> None:
    """Print a line of `monitor`: a status on stdout, other events on stderr."""
    name = which.get("id") or which["port"]
    if isinstance(event, BoardError):
        if as_json:
            print_json(which | fault_table(event))
        print_stderr(f"{event}; it is looked for, end with Ctrl-C")
    elif isinstance(event, host.monitor.BoardReturned):
        if as_json:
            print_json(which | {"back_after_s": round(event.after_s, 3)})
        print_stderr(f"{name}: answers again after {event.after_s:.1f} s")
    elif isinstance(event, host.monitor.KeyMissing):
        print_stderr(
            f"{name}: has a key: without it (--key) this host does not keep its watchdog from acting"
        )
    elif as_json:
        print_json(which | host.tables.status_table(event))
    else:
        head = f"{name}  " if "id" in which else ""
        echo(
            f"{head}{event.uptime_ms / 1e3:10.1f} s"
            f"  {host.tables.enum_name(host.requests.State, event.state):12} packets {event.packets_sent:8}"
            f"  late {event.lateness_ticks:5} (max {event.lateness_max_ticks}) ticks"
            f"  errors crc {event.crc_errors} framing {event.framing_errors} overflow {event.overflow_errors}"
            f"  faults {event.faults:#04x}"
        )


@app.command(cls=LineCommand)
@command
def verify(
    *, context: typer.Context, payload: BankOptions, inventory: InventoryFile = None, as_json: AsJson = False
) -> None:
    """Compare the active bank with a payload; 7 if it differs.

    For example: [bold]evlcp board --port /dev/ttyUSB0 verify SYMBOLS.json[/]
    """
    if inventory is None:
        banks = {"": payload.load_bank()}
    else:
        _check_inventory_options(context)
        _, banks = host.fleet.read_inventory(inventory)

    def compare(entry: host.fleet.FleetEntry | None, board: host.board.Board) -> tuple[str, dict[str, Any]]:
        bank = banks[entry.id if entry else ""]
        number = board.verify(bank)
        table = {"bytes": len(bank.content), "bank": number, "crc": f"{bank.crc:08x}"}
        return f"same: {len(bank.content)} bytes in bank {number}, CRC {bank.crc:08x}", table

    _run_on_boards(context, inventory, as_json, compare)


@app.command("test-leds", cls=LineCommand)
def walk_leds(
    context: typer.Context,
    first: Annotated[int, typer.Option(help="First LED.", min=0, max=95)] = 0,
    last: Annotated[int, typer.Option(help="Last LED.", min=0, max=95)] = 95,
    dwell_ms: Annotated[int, typer.Option(help="Time each LED is on, ms.", min=1, max=65535)] = 100,
    wait: Annotated[bool, typer.Option(help="Wait until the walk has ended.")] = True,
    as_json: AsJson = False,
) -> None:
    """Light the LEDs one by one.

    For example: [bold]evlcp board --port /dev/ttyUSB0 test-leds --dwell-ms 50[/]
    """
    with open_board(context) as board:
        board.test_leds(first, last, dwell_ms)
        if wait:
            board.wait_dark(10.0 + (last - first + 1) * dwell_ms * 2e-3)
    print_result("", {"first": first, "last": last, "dwell_ms": dwell_ms}, as_json)


@app.command(cls=LineCommand)
def save(
    context: typer.Context,
    autostart: Annotated[bool, typer.Option(help="Recall and play after a reset.")] = False,
    inventory: InventoryFile = None,
    as_json: AsJson = False,
) -> None:
    """Save payload and settings to a stopped board's flash.

    For example: [bold]evlcp board --port /dev/ttyUSB0 save --autostart[/]
    """

    def work(_: host.fleet.FleetEntry | None, board: host.board.Board) -> tuple[str, dict[str, Any]]:
        reply = board.save(autostart)
        table = {"slot": reply.slot, "save_sequence": reply.save_sequence, "autostart": autostart}
        return f"saved in slot {reply.slot}, number {reply.save_sequence}", table

    _run_on_boards(context, inventory, as_json, work, "autostart")


@app.command(cls=LineCommand)
def recall(context: typer.Context, as_json: AsJson = False) -> None:
    """Take payload and settings from the board's flash."""
    with open_board(context) as board:
        reply = board.recall()
    table = {"slot": reply.slot, "save_sequence": reply.save_sequence}
    print_result(f"recalled slot {reply.slot}, number {reply.save_sequence}", table, as_json)


@app.command()
def emulate(
    emulator: Annotated[
        Literal["native", "stm32", "rom"],
        typer.Argument(
            help="native: the firmware in this process; stm32: the image as flashed; rom: a part to flash."
        ),
    ],
    listen: Annotated[
        str, typer.Option(metavar="WHERE", help="unix:PATH, tcp:HOST:PORT, or (native) pty.")
    ] = "pty",
    leds: Annotated[Path | None, typer.Option(metavar="FILE", help="Record the LED outputs.")] = None,
    flash: Annotated[
        Path | None, typer.Option(metavar="FILE", help="(native) keep SAVE slots here; (rom) the flash.")
    ] = None,
    link: Annotated[Path | None, typer.Option(metavar="PATH", help="(native) name for the pty.")] = None,
    unique_id: Annotated[int, typer.Option(help="(native) the board's number.", min=0, max=2**64 - 1)] = 0,
) -> None:
    """Run an emulated board in the foreground; end with Ctrl-C.

    For example: [bold]evlcp board emulate native --listen unix:/tmp/board --leds leds.bin[/]
    """
    host.listening.check_listen_address(listen, pty=emulator == "native")
    if leds is not None:
        check_output(leds, regular=False)
        if flash is not None and leds.resolve() == flash.resolve():
            raise ConfigError(f"--leds and --flash: {leds} cannot be both; choose two files")
    with contextlib.ExitStack() as stack:
        if emulator == "native":
            board = stack.enter_context(contextlib.closing(host.native.NativeBoard(leds, flash, unique_id)))
        else:
            image = host.models.part_image(emulator == "rom", flash)
        line = stack.enter_context(contextlib.closing(host.listening.HostLine(listen, link)))
        stopped = stack.enter_context(stop_on_request())
        echo(f"listening on {line.place}")
        if emulator == "native":
            host.native.serve_board(board, line, stopped)
        else:
            host.models.serve_part(line, image, flash, leds, stopped)


@app.command(cls=JsonCommand)
def keygen(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Where the key goes.")],
    show: Annotated[bool, typer.Option("--show", help="Print the name of one that is there.")] = False,
    as_json: AsJson = False,
) -> None:
    """Make a key for boards; print its name, by which boards know it.

    For example: [bold]evlcp board keygen bar.key[/]
    """
    name = (
        host.seal.key_name(host.keys.read_board_key(file)).hex() if show else host.keys.make_board_key(file)
    )
    print_result(name, {"key": name}, as_json)


@app.command(cls=LineCommand)
def lock(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The key, as 'evlcp board keygen' makes it.")],
    as_json: AsJson = False,
) -> None:
    """Give a board a key, without which it can only be looked at.

    Another one is taken with --key OLD.


    The key goes over the line as it is: do it where nobody listens. It is gone with a reset unless saved.

    For example: [bold]evlcp board --port /dev/ttyUSB0 lock bar.key[/]
    """
    key = host.keys.read_board_key(file)
    with open_board(context) as board:
        board.set_key(key)
        name = board.info.key_name.hex()
    print_result(f"locked with key {name}; 'evlcp board save' keeps it over a reset", {"key": name}, as_json)


@app.command(cls=LineCommand)
def unlock(context: typer.Context, as_json: AsJson = False) -> None:
    """Take a board's key away, until a reset unless it is saved."""
    with open_board(context) as board:
        board.set_key(None)
    print_result("unlocked; 'evlcp board save' keeps it so over a reset", {"key": None}, as_json)


@app.command(cls=JsonCommand)
def leds(
    record: Annotated[Path, typer.Argument(metavar="FILE", help="LED record of an emulator.")],
    chips: Annotated[
        Path,
        typer.Option(
            metavar="OUT.npy", help="Chips: uint8, one row per chip, one column per cluster of the link."
        ),
    ],
    per_led: Annotated[bool, typer.Option("--per-led", help="One column an LED instead.")] = False,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Turn an LED record into a chip table.

    The ticks go into OUT.ticks.npy. Rows that are not a chip (dark, single-LED test) are left out. So is a
    last record that is cut off, and then the command ends with 3.

    For example: [bold]evlcp board leds leds.bin --chips chips.npy[/]
    """
    ticks = chips.with_suffix(".ticks.npy")
    if record.resolve() in (chips.resolve(), ticks.resolve()):
        raise ConfigError(f"--chips {chips}: would overwrite the record {record}; choose another file")
    played = host.led_record.LedRecord.read(record).select_chips()
    clusters = None if per_led else sdk.resolve.load_link(link_file, overrides or []).bar.led_clusters()
    with name_place(f"{record}: ", InputError):
        table = played.chips(clusters)
    with Outputs() as outputs:
        outputs.write_array(table, chips)
        outputs.write_array(played.ticks, ticks)
    print_result(f"{len(played)} chips", {"chips": len(played), "cut_bytes": played.cut_bytes}, as_json)
    if played.cut_bytes:
        raise InputError(
            f"{record}: the last record is cut off ({played.cut_bytes} bytes) and left out;"
            f" the {len(played)} chips before it are in {chips}"
        )
