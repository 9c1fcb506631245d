"""`evlcp live`."""

import json
from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli._common import LinkFile, Overrides, complain, echo
from evlcp_sdk.cli._receiving import attitude_of, clock_zero_of, json_lines_of, position_plan_of
from evlcp_sdk.cli._summary import show

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("live")(live)


def live(
    url: Annotated[
        str,
        typer.Argument(
            metavar="URL",
            help="replay:REC, tcp://HOST:PORT, udp://HOST:PORT, unix:PATH, - for standard input, or what a"
            " plugin can open; a recording is replayed at its own pace.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", metavar="OUT", help="Also write a result, as receive does, into a folder."
        ),
    ] = None,
    link_file: LinkFile = None,
    overrides: Overrides = None,
    json_lines: Annotated[
        str | None,
        typer.Option(
            "--json-lines",
            metavar="-",
            help="Frames, messages and fixes as lines of JSON on stdout as they come.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The summary as one line of JSON.")] = False,
    sites: Annotated[
        Path | None,
        typer.Option("--sites", metavar="site.toml", help="Where the bars stand: compute positions."),
    ] = None,
    heading_deg: Annotated[
        float | None, typer.Option("--heading-deg", help="Its heading, clockwise from north, if known.")
    ] = None,
    pitch_deg: Annotated[float | None, typer.Option("--pitch-deg", help="Its pitch, up.")] = None,
    roll_deg: Annotated[float | None, typer.Option("--roll-deg", help="Its roll, top to the right.")] = None,
    clock_zero: Annotated[
        str | None,
        typer.Option("--clock-zero", metavar="UTC", help="UTC of the camera clock's 0."),
    ] = None,
    waiting_ms: Annotated[
        float,
        typer.Option(
            "--waiting-ms", min=1.0, help="How long events may wait before something is left out, in ms."
        ),
    ] = 20.0,
) -> None:
    """Receive in real time: results as they come, delays measured.

    A recording, at its own pace:   [bold]evlcp live replay:REC.raw[/]

    Again and again, twice as fast: [bold]evlcp live 'replay:REC.raw?loop=1&speed=2'[/]

    From another machine:           [bold]evlcp live tcp://192.168.1.7:5600[/]

    From another program:           [bold]CAMERA | evlcp live - --json-lines -[/]

    With positions:                 [bold]evlcp live URL --sites site.toml --pitch-deg 0 --roll-deg 0[/]

    Where the receiver cannot keep up, it leaves out, in this order, and counts: rows outside of regions, the
    distances of most frames, all outside of regions, the oldest events. Ctrl-C ends it, with its summary.
    """
    from evlcp_sdk.errors import InputError, InterruptedRunError
    from evlcp_sdk.link.resolve import load_link
    from evlcp_sdk.live.budget import Budget
    from evlcp_sdk.plugin.registry import Registry
    from evlcp_sdk.run import live as run_live
    from evlcp_sdk.run import stop_on_request

    lines = json_lines_of(json_lines, [url], as_json=as_json)
    registry = Registry.load()
    link = load_link(link_file, overrides or [], registry)
    attitude = attitude_of(None, (heading_deg, pitch_deg, roll_deg), (0.5, 0.5, 0.0, 0.0))
    zero = clock_zero_of(clock_zero)
    plan = position_plan_of(sites, None, link, zero, mcap=False)
    with stop_on_request() as stopped:
        summary = run_live(
            url,
            out,
            link,
            registry=registry,
            plan=plan,
            attitude=attitude,
            clock_zero=zero,
            lines=lines,
            budget=Budget(waiting_ms=waiting_ms, most_ms=10 * waiting_ms),
            stopped=lambda: stopped() or (out is None and lines is not None and lines.gone),
        )
        if lines is not None:
            lines(json.dumps({"line": "summary"} | summary))
        elif as_json:
            echo(json.dumps(summary))
        else:
            show(summary, out, stderr=False)
        if summary["status"] in ("failed", "degraded"):
            complain(summary["error"])
        if stopped() and out is not None:
            raise InterruptedRunError(f"interrupted; what was decoded until then is in {out}")
    raise typer.Exit(InputError.exit_code if summary["status"] == "failed" else 0)
