"""Groups of options of `receive`, `live` and `survey`."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, ClassVar

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import LinkFiles, Overrides, echo
from evlcp_sdk.cli._stderr import print_stderr


def parse_utc(text: str) -> datetime:
    """Parse a time in ISO 8601, UTC unless it has another zone."""
    try:
        time = datetime.fromisoformat(text)
    except ValueError as fault:
        raise typer.BadParameter(f"{text!r}: expected a time such as 2026-03-01T10:15:00Z") from fault
    time = time if time.tzinfo is not None else time.replace(tzinfo=UTC)
    # MCAP counts from 1970 on, and NMEA has two digits of the year.
    if not datetime(1970, 1, 1, tzinfo=UTC) <= time < datetime(2200, 1, 1, tzinfo=UTC):
        raise typer.BadParameter(f"{text!r}: expected 1970 to 2199")
    return time


@dataclass(frozen=True)
class LinkOptions:
    """The link, or several."""

    link_files: LinkFiles = None
    overrides: Overrides = None

    def load(self) -> "tuple[sdk.resolve.Link, ...]":
        """Load the links; warn on stderr of those that a receiver cannot distinguish."""
        links = sdk.several.load_links(self.link_files, self.overrides or [])
        if len(links) > 1:
            for warning in sdk.light_checks.find_alike_links(sdk.several.name_links(links)):
                print_stderr(f"warning: {warning}")
        return links


@dataclass(frozen=True)
class ResultOptions:
    """The folder and the formats of results."""

    PANEL: ClassVar[str] = "Results"

    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="OUT", help="Folder of the result; made if need be.")
    ] = None
    json_lines: Annotated[
        str | None, typer.Option(metavar="-", help="Lines of JSON on stdout as they come.")
    ] = None
    as_json: Annotated[bool, typer.Option("--json", help="Each summary as one line of JSON.")] = False
    figures: Annotated[
        bool, typer.Option("--figures", help="Draw regions, presence, distance and track.")
    ] = False
    report: Annotated[bool, typer.Option("--report", help="Write report.html, a page to look at.")] = False
    parquet: Annotated[bool, typer.Option("--parquet", hidden=True, help="Also write frames.parquet.")] = (
        False
    )
    mcap: Annotated[
        bool, typer.Option("--mcap", hidden=True, help="Also write fixes.mcap, for Foxglove.")
    ] = False
    sinks: Annotated[
        list[str] | None,
        typer.Option("--sink", metavar="NAME", help="Also write this format, e.g. mcap; repeat it."),
    ] = None

    def make_line_printer(self, recordings: Sequence[str]) -> "LinePrinter | None":
        """A printer of lines of JSON as they come; None without `--json-lines`."""
        if self.json_lines is None:
            return None
        for is_wrong, reason in (
            (self.json_lines != sdk.open.STDIN, f"{self.json_lines}: expected -, standard output"),
            (self.as_json, "end with the summary: give one of --json and --json-lines"),
            (len(recordings) > 1, "are those of one recording"),
        ):
            if is_wrong:
                raise typer.BadParameter(reason, param_hint="--json-lines")
        return LinePrinter()

    def load_sink_names(self, *, positions: bool) -> tuple[str, ...]:
        """Names of the sinks in use, those with options of their own first, after a check that all load."""
        own_options = [name for name in ("figures", "report", "parquet", "mcap") if getattr(self, name)]
        names = tuple(dict.fromkeys([*own_options, *(self.sinks or [])]))
        sdk.sinks.load_sinks(
            sdk.records.choose_sinks(sdk.registry.Registry.load(), names, positions=positions)
        )
        if names and self.out is None:
            raise typer.BadParameter(
                f"{', '.join(names)} goes into a folder: give -o OUT", param_hint="--out"
            )
        return names


Cores = Annotated[
    int,
    typer.Option("--cores", min=1, metavar="N", show_default=False, help="Processes for a recording's bars."),
]


@dataclass(frozen=True)
class PlaceOptions:
    """Inputs of positions: bars, the camera's attitude over time, satellites, and UTC of its clock's 0."""

    PANEL: ClassVar[str] = "Positions"

    sites: Annotated[
        Path | None, typer.Option(metavar="site.toml", help="Where known bars stand: compute positions.")
    ] = None
    attitude_file: Annotated[
        Path | None, typer.Option("--attitude", metavar="FILE.csv", help="The camera's attitude over time.")
    ] = None
    gnss: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            hidden=True,
            help="Fixes of satellites, with sigmas, which enter the track: CSV, or .nmea with --clock-zero.",
        ),
    ] = None
    clock_zero: Annotated[
        datetime | None,
        typer.Option(
            parser=parse_utc,
            metavar="UTC",
            hidden=True,
            help="UTC of the camera clock's 0, for the age of signed beacons, NMEA and MCAP.",
        ),
    ] = None

    def plan(
        self, links: "Sequence[sdk.resolve.Link]", *, mcap: bool = False
    ) -> "sdk.navigator.PositionPlan | None":
        """The inputs of positions, for the links that allow them; None without sites."""
        if self.sites is None:
            for name, is_given in (("--mcap", mcap), ("--gnss", self.gnss is not None)):
                if is_given:
                    raise typer.BadParameter("needs --sites", param_hint=name)
            return None
        link = next(iter(sdk.several.select_positioning_links(sdk.several.name_links(links)).values()))
        log = None
        if self.gnss is not None:
            log = sdk.gnss.GnssLog.read(self.gnss, self.clock_zero, link.position.gnss_sigma_m)
        return sdk.navigator.PositionPlan(sdk.sites.load_sites(self.sites), log)


@dataclass(frozen=True)
class CameraOptions:
    """The camera's attitude and clock."""

    PANEL: ClassVar[str] = "Positions"

    heading_deg: Annotated[
        float | None, typer.Option(metavar="DEG", help="The camera's heading, clockwise from north.")
    ] = None
    pitch_deg: Annotated[float | None, typer.Option(metavar="DEG", help="Its pitch, up.")] = None
    roll_deg: Annotated[float | None, typer.Option(metavar="DEG", help="Its roll, top to the right.")] = None
    heading_sigma_deg: Annotated[
        float, typer.Option(min=0, hidden=True, help="Sigma of the heading, unless a file has it.")
    ] = 0.5
    gravity_sigma_deg: Annotated[
        float | None,
        typer.Option(
            min=0,
            hidden=True,
            help="The same of pitch and roll.  [default: 0.1 with a file, 0.5 with angles]",
        ),
    ] = None
    white_sigma_deg: Annotated[
        float, typer.Option(min=0, hidden=True, help="Of what is new in each angle with each line.")
    ] = 0.0
    time_sigma_us: Annotated[
        float, typer.Option(min=0, hidden=True, help="Of the file's times from the camera's.")
    ] = 0.0
    pps: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=255,
            metavar="CHANNEL",
            hidden=True,
            help="This trigger input gets a pulse each second of UTC (PPS), and outputs have that time.",
        ),
    ] = None

    def attitude(self, place: PlaceOptions) -> "sdk.attitude.Attitude | sdk.attitude.AttitudeLog | None":
        """The camera's known attitude; None where it is unknown."""
        gravity_deg = self.gravity_sigma_deg
        if gravity_deg is None:
            # An IMU's samples follow a swaying camera; angles by hand hold for a whole drive.
            gravity_deg = 0.5 if place.attitude_file is None else 0.1
        sigmas = gravity_deg, self.heading_sigma_deg, self.white_sigma_deg, self.time_sigma_us
        angles = heading, pitch, roll = self.heading_deg, self.pitch_deg, self.roll_deg
        if place.attitude_file is not None and angles != (None, None, None):
            raise typer.BadParameter("give a file or angles, not both", param_hint="--attitude")
        if (pitch is None) != (roll is None) or (heading is not None and pitch is None):
            raise typer.BadParameter(
                "gravity needs --pitch-deg and --roll-deg; a heading needs gravity", param_hint="--pitch-deg"
            )
        for name, value in vars(self).items():
            if isinstance(value, float) and not math.isfinite(value):
                option = f"--{name.replace('_', '-')}"
                raise typer.BadParameter(f"{value}: expected a finite number", param_hint=option)
        low, high = sdk.attitude.PITCH_DEG
        if pitch is not None and not low <= pitch <= high:
            raise typer.BadParameter(f"{pitch}: expected {low:g} to {high:g}", param_hint="--pitch-deg")
        if place.attitude_file is not None:
            return sdk.attitude.AttitudeLog.read(
                place.attitude_file, sdk.attitude.Attitude(0.0, 0.0, None, *sigmas)
            )
        return (
            sdk.attitude.Attitude(pitch, roll, heading, *sigmas)
            if pitch is not None and roll is not None
            else None
        )

    def clock(self, place: PlaceOptions) -> "datetime | sdk.utc.PulseClock | None":
        """The UTC of a camera's clock: pulses of a recording, or that of its zero; None if unknown."""
        return place.clock_zero if self.pps is None else sdk.utc.PulseClock(self.pps, place.clock_zero)


class LinePrinter:
    """Prints lines as they come, until their reader has left, or standard output fails.

    Attributes:
        closed: One of these has happened.
        failed: Standard output has failed, which was reported.
    """

    def __init__(self) -> None:
        self.closed = self.failed = False

    def __call__(self, line: str) -> None:
        if self.closed:
            return
        try:
            echo(line)
        except OSError as fault:
            self.closed, self.failed = True, not isinstance(fault, BrokenPipeError)
            if self.failed:
                print_stderr(f"standard output: {fault.strerror}")
            # Or else the interpreter tries again at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
