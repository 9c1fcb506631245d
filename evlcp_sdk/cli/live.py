"""`evlcp live`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._command import command
from evlcp_sdk.cli._common import console
from evlcp_sdk.cli._receiving import CameraOptions, Cores, LinkOptions, PlaceOptions, ResultOptions
from evlcp_sdk.cli._stderr import print_stderr
from evlcp_sdk.cli._summary import format_delays, print_end
from evlcp_sdk.errors import InputError, InterruptedRunError, UnpluggedError
from evlcp_sdk.formatting import format_count
from evlcp_sdk.signals import stop_on_request

_HERE = "127.0.0.1"
_SERVED = {"view": "look on", "nmea": "NMEA", "gpsd": "gpsd's JSON"}


@dataclass(frozen=True)
class ServingOptions:
    """Options of the services."""

    view: Annotated[bool, typer.Option("--view", help="Serve a page for browsers.")] = False
    view_host: Annotated[
        str, typer.Option(metavar="ADDRESS", show_default=False, help="0.0.0.0: for other machines, too.")
    ] = _HERE
    view_port: Annotated[
        int,
        typer.Option(
            hidden=True,
            min=0,
            max=65535,
            metavar="PORT",
            show_default=False,
            help="Its port; without it, any that is free.",
        ),
    ] = 0
    view_record: Annotated[
        bool,
        typer.Option("--view-record", hidden=True, help="Who looks on may record, into OUT or this folder."),
    ] = False
    nmea_port: Annotated[
        int | None, typer.Option(min=0, max=65535, metavar="PORT", help="Serve NMEA-0183 by TCP.")
    ] = None
    gpsd_port: Annotated[
        int | None, typer.Option(min=0, max=65535, metavar="PORT", help="Serve positions as gpsd does.")
    ] = None

    def check(self, *, positions: bool) -> None:
        """Refuse options that need others."""
        for name, needed, lacks in (
            ("--nmea-port", "--sites", self.nmea_port is not None and not positions),
            ("--gpsd-port", "--sites", self.gpsd_port is not None and not positions),
            ("--view-host", "--view", self.view_host != _HERE and not self.view),
            ("--view-port", "--view", self.view_port != 0 and not self.view),
            ("--view-record", "--view", self.view_record and not self.view),
        ):
            if lacks:
                raise typer.BadParameter(f"needs {needed}", param_hint=name)


Waiting = Annotated[
    float,
    typer.Option(
        "--waiting-ms", hidden=True, min=1.0, help="How long events may wait before some are left out."
    ),
]


@command
def live(
    *,
    url: Annotated[str, typer.Argument(metavar="URL", help="Where events come from; - for RAW on stdin.")],
    link: LinkOptions,
    result: ResultOptions,
    place: PlaceOptions,
    camera: CameraOptions,
    reconnect: Annotated[bool, typer.Option("--reconnect", help="Go on when a camera is back.")] = False,
    waiting_ms: Waiting = 20.0,
    cores: Cores = 1,
    serving: ServingOptions,
) -> None:
    """Receive in real time: results as they come, delays measured.

    A camera:             [bold]evlcp live camera:[/]
    A recording again:    [bold]evlcp live 'replay:REC.raw?loop=1'[/]
    From another machine: [bold]evlcp live tcp://192.168.1.7:5600[/]
    In a browser:         [bold]evlcp live URL --view[/]
    Positions:            [bold]evlcp live URL --sites site.toml --attitude imu.csv[/]
    For gpsd's programs:  [bold]evlcp live URL --sites site.toml --gpsd-port 2947[/]

    What comes too fast is left out, and counted. Ctrl-C ends it.
    """
    out, lines = result.out, result.make_line_printer([url])
    links = link.load()
    plan = place.plan(links, mcap=result.mcap)
    clock = camera.clock(place)
    serving.check(positions=plan is not None)
    sinks = result.load_sink_names(positions=plan is not None)
    attitude, publisher = camera.attitude(place), sdk.publisher.Publisher()
    with (
        stop_on_request() as stopped,
        _serve(serving, publisher, links, url, plan, clock, out),
    ):
        with _show_status(publisher, silent=lines is not None):
            summary = sdk.run.live(
                sdk.reconnect.ReconnectingSource(partial(sdk.open.open_source, url), stopped)
                if reconnect
                else url,
                out,
                links,
                plan=plan,
                attitude=attitude,
                clock_zero=clock,
                workers=cores,
                sinks=sinks,
                lines=lines,
                publisher=publisher,
                budget=sdk.budget.Budget(waiting_ms=waiting_ms, most_ms=10 * waiting_ms),
                stopped=stopped.or_when(lambda: out is None and lines is not None and lines.closed),
            )
        print_end(summary, out, lines, as_json=result.as_json)
        code = _exit_code(summary, out if stopped() else None)
    raise typer.Exit(code or int(lines is not None and lines.failed))


@contextmanager
def _serve(
    options: ServingOptions,
    publisher: sdk.publisher.Publisher,
    links: Sequence[sdk.resolve.Link],
    url: str,
    plan: sdk.navigator.PositionPlan | None,
    clock: sdk.utc.ClockZero,
    out: Path | None,
) -> Iterator[None]:
    """Serve what is asked for, and print where; browsers record into `out`, or this folder."""
    camera, recorder = links[0].camera, None
    if options.view_record:
        recorder = sdk.recorder.Recorder(publisher, out or Path.cwd(), camera.width, camera.height)
    servers: dict[str, sdk.server.Server] = {}
    if options.view:
        servers["view"] = sdk.viewer.Viewer(
            publisher,
            sdk.several.name_links(links),
            name=Path(url).name,
            sites=plan.sites if plan is not None else (),
            host=options.view_host,
            port=options.view_port,
            recorder=recorder,
        )
    for kind, port in (("nmea", options.nmea_port), ("gpsd", options.gpsd_port)):
        if port is not None:
            servers[kind] = sdk.tcp_output.TcpOutput(
                publisher, gpsd=kind == "gpsd", port=port, clock_zero=clock
            )
    try:
        with sdk.server.serve(publisher, servers.values(), recorder) if servers else nullcontext():
            for kind, server in servers.items():
                print_stderr(f"{_SERVED[kind]} at {server.url}")
            yield
    finally:
        for server in servers.values():
            if missed := server.dropped:
                print_stderr(f"{server.url}: {missed} results were not sent, as clients were too slow")
        if recorder is not None:
            state = recorder.state
            if state["fault"]:
                print_stderr(f"the recording ended: {state['fault']}")
            if state["dropped"]:
                print_stderr(f"{state['file']}: {state['dropped']} pieces are missing: the disk was too slow")


def _exit_code(summary: dict[str, Any], interrupted: Path | None) -> int:
    """The exit code of a run; raises where it was interrupted."""
    if interrupted is not None:
        raise InterruptedRunError(f"interrupted; what was decoded until then is in {interrupted}")
    if summary["status"] != "failed":
        return 0
    return (UnpluggedError if summary["live"]["unplugged"] else InputError).exit_code


@contextmanager
def _show_status(publisher: sdk.publisher.Publisher, *, silent: bool) -> Iterator[None]:
    """Show the status in a line on stderr, on a terminal only, and not between lines of JSON."""
    from rich.live import Live
    from rich.text import Text

    err = console(stderr=True)
    if silent or not err.is_interactive:
        yield
        return
    # Too long a line goes on in the next: what is lost stands last.
    subscription, text = publisher.subscribe({"status"}, most=1), Text(overflow="fold", no_wrap=False)

    def draw() -> Text:
        for news in subscription.take(0):
            text.plain = format_status(news.value)
        return text

    with Live(console=err, transient=True, get_renderable=draw):
        yield


def format_status(status: sdk.loop.LiveStatus) -> str:
    """The status of a live run, in a line."""
    text = f"{status.elapsed_s:.0f} s, {status.events_per_s / 1e6:.1f} Mev/s"
    for noun in ("frame", "message"):
        if number := status.counts.get(f"{noun}s", 0):
            text += f", {format_count(number, noun)}"
    if (recent := status.recent["total"])["count"]:
        text += f", delay {format_delays(recent)}"
    if lost := sum(loss.count for loss in status.losses.values()):
        text += f", {lost} lost"
    # The text of a level adds to those before.
    shed = ", ".join(sdk.budget.LEVELS[1 : status.level + 1])
    return f"{text}; {shed}" if shed else text
