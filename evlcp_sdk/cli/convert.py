"""`evlcp convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, print_result, progress_bar
from evlcp_sdk.cli._stderr import print_stderr
from evlcp_sdk.errors import InputError, UnpluggedError
from evlcp_sdk.formatting import format_count
from evlcp_sdk.signals import stop_on_request


def convert(
    url: Annotated[
        str, typer.Argument(metavar="SOURCE", help="A recording, a stream, a camera, or what a plugin opens.")
    ],
    out: Annotated[
        Path,
        typer.Option("-o", "--out", metavar="OUT", help="By its suffix .raw, .mcap, .npz, .csv or .csv.gz."),
    ],
    size: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Of the sensor, where SOURCE does not say.")
    ] = None,
    format: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="EVT2, EVT21, EVT3, BAG, NPZ or CSV for any suffix."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write events and triggers into a recording of another format.

    A bag of ROS 2:           [bold]evlcp convert REC.raw -o drive.mcap[/]
    From one:                 [bold]evlcp convert bag:drive -o drive.raw[/]
    From HDF5:                [bold]evlcp convert REC.hdf5 --size 1280x720 -o REC.raw[/]
    A camera, until Ctrl-C:   [bold]evlcp convert camera: -o REC.raw[/]
    """
    sensor_size = None
    if size is not None:
        try:
            sensor_size = sdk.urls.parse_size(size)
        except ValueError as fault:
            raise typer.BadParameter(f"{size!r}: expected {fault}", param_hint="--size") from fault
    with stop_on_request() as stopped, progress_bar(Path(url).name, by_bytes=True) as advance:
        result = sdk.run.convert(url, out, size=sensor_size, format=format, advance=advance, stopped=stopped)
    counts = result["counts"]
    contents = [
        format_count(counts["events"], "event"),
        format_count(counts["triggers"], "trigger"),
        *(f"{one['count']} {one['meaning']}" for one in result["losses"].values()),
    ]
    print_result(f"{out}: {', '.join(contents)}", {"out": str(out)} | result, as_json, out=out)
    if result["error"] is not None:
        print_stderr(result["error"])
        raise typer.Exit((UnpluggedError if result["unplugged"] else InputError).exit_code)
