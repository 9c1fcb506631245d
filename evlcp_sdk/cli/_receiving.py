"""What `receive`, `live` and `survey` read from their options."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evlcp_sdk.cli._common import complain, echo

if TYPE_CHECKING:
    from datetime import datetime

    from evlcp_sdk.link.resolve import Link
    from evlcp_sdk.place.navigator import PositionPlan
    from evlcp_sdk.plugin.registry import Registry
    from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
    from evlcp_sdk.utc import PulseClock

__all__ = [
    "AttitudeFile",
    "ClockZero",
    "Figures",
    "Gnss",
    "GravitySigmaDeg",
    "HeadingDeg",
    "HeadingSigmaDeg",
    "LinePrinter",
    "Mcap",
    "Parquet",
    "PitchDeg",
    "Pps",
    "Report",
    "RollDeg",
    "SinkNames",
    "Sites",
    "TimeSigmaUs",
    "WhiteSigmaDeg",
    "attitude_of",
    "clock_of",
    "clock_zero_of",
    "json_lines_of",
    "plan_of",
    "say_alike",
    "sinks_of",
]

Sites = Annotated[
    Path | None,
    typer.Option("--sites", metavar="site.toml", help="Where the bars stand: compute positions."),
]
HeadingDeg = Annotated[
    float | None, typer.Option("--heading-deg", help="Its heading, clockwise from north, if known.")
]
PitchDeg = Annotated[float | None, typer.Option("--pitch-deg", help="Its pitch, up.")]
RollDeg = Annotated[float | None, typer.Option("--roll-deg", help="Its roll, top to the right.")]
AttitudeFile = Annotated[
    Path | None,
    typer.Option(
        "--attitude",
        metavar="FILE.csv",
        help="The camera's attitude over time, for distances and positions.",
    ),
]
HeadingSigmaDeg = Annotated[
    float,
    typer.Option(
        "--heading-sigma-deg", min=0, help="Standard deviation of the heading, unless a file has it."
    ),
]
GravitySigmaDeg = Annotated[
    float | None,
    typer.Option(
        "--gravity-sigma-deg",
        min=0,
        help="The same of pitch and roll.  [default: 0.1 with a file, 0.5 with angles]",
    ),
]
WhiteSigmaDeg = Annotated[
    float,
    typer.Option(
        "--white-sigma-deg", min=0, help="Of what is new in each angle with every line of the file."
    ),
]
TimeSigmaUs = Annotated[
    float,
    typer.Option("--time-sigma-us", min=0, help="Of the offset of the file's times from the camera's."),
]
Gnss = Annotated[
    Path | None,
    typer.Option(
        "--gnss",
        metavar="FILE",
        help="Fixes of satellites, with sigmas, which enter the track: CSV, or .nmea with --clock-zero.",
    ),
]
ClockZero = Annotated[
    str | None,
    typer.Option(
        "--clock-zero",
        metavar="UTC",
        help="UTC of the camera clock's 0, for the age of signed beacons, NMEA and MCAP.",
    ),
]
Pps = Annotated[
    int | None,
    typer.Option(
        "--pps",
        min=0,
        max=255,
        metavar="CHANNEL",
        help="This trigger input gets a pulse each second of UTC (PPS), and outputs have that time.",
    ),
]
Figures = Annotated[
    bool, typer.Option("--figures", help="Draw regions.png, presence.png, distance.png, track.png.")
]
Report = Annotated[
    bool, typer.Option("--report", help="Write report.html: the recording on one page, to look at.")
]
Parquet = Annotated[bool, typer.Option("--parquet", help="Also write frames.parquet.")]
Mcap = Annotated[bool, typer.Option("--mcap", help="Also write fixes.mcap, for Foxglove.")]
SinkNames = Annotated[
    list[str] | None,
    typer.Option("--sink", metavar="NAME", help="Also write this format; may be repeated."),
]


def attitude_of(
    file: Path | None,
    angles: tuple[float | None, float | None, float | None],
    sigmas: tuple[float | None, float, float, float],
) -> "Attitude | AttitudeLog | None":
    """What the options say of the camera's attitude; None for nothing.

    Args:
        file: Of a log.
        angles: Heading, pitch and roll, degrees.
        sigmas: Of gravity, of the heading and of what is new in each line, degrees, and of time, us.
    """
    import math

    from evlcp_sdk.scene.attitude import Attitude, AttitudeLog

    gravity_deg, heading_deg, white_deg, time_us = sigmas
    if gravity_deg is None:
        # An IMU's samples follow a camera that sways; angles by hand hold for a whole drive.
        gravity_deg = 0.5 if file is None else 0.1
    told = gravity_deg, heading_deg, white_deg, time_us
    heading, pitch, roll = angles
    if file is not None and angles != (None, None, None):
        raise typer.BadParameter("give a file or angles, not both", param_hint="--attitude")
    if (pitch is None) != (roll is None) or (heading is not None and pitch is None):
        raise typer.BadParameter(
            "gravity needs --pitch-deg and --roll-deg; a heading needs gravity", param_hint="--pitch-deg"
        )
    names = (
        *("--heading-deg", "--pitch-deg", "--roll-deg"),
        *("--gravity-sigma-deg", "--heading-sigma-deg", "--white-sigma-deg", "--time-sigma-us"),
    )
    for name, said in zip(names, (*angles, *told), strict=True):
        if said is not None and not math.isfinite(said):
            raise typer.BadParameter(f"{said}: expected a finite number", param_hint=name)
    if file is not None:
        return AttitudeLog.read(file, Attitude(0.0, 0.0, None, *told))
    return Attitude(pitch, roll, heading, *told) if pitch is not None and roll is not None else None


def clock_of(pps: int | None, zero: "datetime | None") -> "datetime | PulseClock | None":
    """What says the UTC of a camera's clock: pulses of a recording, or its zero; None for nothing."""
    from evlcp_sdk.utc import PulseClock

    return zero if pps is None else PulseClock(pps, zero)


def say_alike(links: "Sequence[Link]") -> None:
    """Say on stderr, before anything is read, which links a receiver cannot tell apart."""
    if len(links) < 2:
        return
    from evlcp_sdk.diagnosis.warnings import check_alike
    from evlcp_sdk.link.several import named_links

    for warning in check_alike(named_links(links)):
        complain(f"warning: {warning}")


def plan_of(
    sites: Path | None,
    gnss: Path | None,
    links: "Sequence[Link]",
    zero: "datetime | None",
    *,
    mcap: bool,
) -> "PositionPlan | None":
    """What the options say of positions, of those of several links that they are computed from."""
    from evlcp_sdk.link.several import named_links, placing_links

    placing = links[0]
    if sites is not None:
        placing = next(iter(placing_links(named_links(links)).values()))
    return _position_plan_of(sites, gnss, placing, zero, mcap=mcap)


def sinks_of(
    registry: "Registry",
    short: Mapping[str, bool],
    sinks: Sequence[str] | None,
    out: Path | None,
    *,
    positions: bool,
) -> tuple[str, ...]:
    """Names of the formats that are asked for, those with an option of their own first; all can be loaded."""
    from evlcp_sdk.plugin.records import choose_sinks
    from evlcp_sdk.results.sinks import load_sinks

    asked = tuple(dict.fromkeys([*(name for name, given in short.items() if given), *(sinks or [])]))
    load_sinks(choose_sinks(registry, asked, positions=positions))
    if asked and out is None:
        raise typer.BadParameter(f"{', '.join(asked)} goes into a folder: give -o OUT", param_hint="--out")
    return asked


def _position_plan_of(
    sites: Path | None, gnss: Path | None, link: "Link", zero: "datetime | None", *, mcap: bool
) -> "PositionPlan | None":
    """What the options say of positions; None without sites."""
    if sites is None:
        for name, given in (("--mcap", mcap), ("--gnss", gnss is not None)):
            if given:
                raise typer.BadParameter("needs --sites", param_hint=name)
        return None
    from evlcp_sdk.place.gnss import GnssLog
    from evlcp_sdk.place.navigator import PositionPlan
    from evlcp_sdk.scene.sites import load_sites

    log = None if gnss is None else GnssLog.read(gnss, zero, link.position.gnss_sigma_m)
    return PositionPlan(load_sites(sites), log)


def clock_zero_of(text: str | None) -> "datetime | None":
    """UTC of the camera clock's 0; None if it is not given."""
    from datetime import UTC, datetime

    if text is None:
        return None
    try:
        zero = datetime.fromisoformat(text)
    except ValueError as fault:
        said = f"{text!r}: expected a time such as 2026-03-01T10:15:00Z"
        raise typer.BadParameter(said, param_hint="--clock-zero") from fault
    zero = zero if zero.tzinfo is not None else zero.replace(tzinfo=UTC)
    # MCAP counts from 1970 on, and NMEA has two digits of the year.
    if not datetime(1970, 1, 1, tzinfo=UTC) <= zero < datetime(2200, 1, 1, tzinfo=UTC):
        raise typer.BadParameter(f"{text!r}: expected 1970 to 2199", param_hint="--clock-zero")
    return zero


class LinePrinter:
    """Prints lines as they come, until whoever reads them has left.

    Attributes:
        gone: The reader has left.
    """

    def __init__(self) -> None:
        self.gone = False

    def __call__(self, line: str) -> None:
        if self.gone:
            return
        try:
            echo(line)
        except BrokenPipeError:
            self.gone = True
            # Or else the interpreter tries once more as it ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def json_lines_of(where: str | None, recordings: Sequence[str], *, as_json: bool) -> LinePrinter | None:
    """What prints lines as they come; None where nobody asked."""
    from evlcp_sdk.io.open import STDIN

    if where is None:
        return None
    for wrong, why in (
        (where != STDIN, f"{where}: expected -, standard output"),
        (as_json, "end with the summary: give one of --json and --json-lines"),
        (len(recordings) > 1, "are those of one recording"),
    ):
        if wrong:
            raise typer.BadParameter(why, param_hint="--json-lines")
    return LinePrinter()
