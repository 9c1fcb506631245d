"""`evlcp survey`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._command import command
from evlcp_sdk.cli._common import Json, LinkFiles, Overrides, print_result
from evlcp_sdk.cli._receiving import PlaceOptions
from evlcp_sdk.formatting import format_count


@command
def survey(
    *,
    recordings: Annotated[
        list[str], typer.Argument(metavar="REC...", help="Recordings of bars that send their ids.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="site.toml", help="Where the bars stand.")],
    poses: Annotated[
        Path | None, typer.Option(metavar="poses.csv", help="Where the camera was, how turned, when.")
    ] = None,
    place: PlaceOptions,
    link_files: LinkFiles = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Estimate where bars stand, by a camera at known places.

    One recording:            [bold]evlcp survey REC.raw --poses poses.csv -o site.toml[/]
    By a calibrated camera:   [bold]evlcp survey REC.raw --poses poses.csv -c camera.toml -o site.toml[/]
    By its own track past known bars: [bold]evlcp survey REC.raw --sites known.toml --attitude imu.csv
    -c camera.toml -o new.toml[/]
    Bars of two kinds:        [bold]evlcp survey REC.raw --poses poses.csv -c a.toml -c b.toml -o site.toml[/]

    poses.csv is that of `evlcp calibrate`, with heading_deg, pitch_deg and roll_deg. What all poses may have
    wrong in common, by position_sigma_m and attitude_sigma_deg, is in the sigmas of the sites.
    """
    if (poses is None) == (place.sites is None):
        raise typer.BadParameter("give --poses, or --sites of known bars", param_hint="--poses")
    links = sdk.several.load_links(link_files, overrides or [])
    if poses is not None:
        for name, value in (
            ("--attitude", place.attitude_file),
            ("--gnss", place.gnss),
            ("--clock-zero", place.clock_zero),
        ):
            if value is not None:
                raise typer.BadParameter("needs --sites", param_hint=name)
        surveyed = sdk.surveying.survey(recordings, sdk.calibration.read_poses(poses), links, name=str(poses))
    else:
        plan = place.plan(links)
        assert plan is not None
        known = None if place.attitude_file is None else sdk.attitude.AttitudeLog.read(place.attitude_file)
        surveyed = sdk.surveying.survey_along_track(recordings, plan, links, attitude=known)
    _write(surveyed, out, as_json=as_json)


def _write(surveyed: Sequence[sdk.survey.SurveyedBar], out: Path, *, as_json: bool) -> None:
    with sdk.files.Outputs() as outputs:
        outputs.open(out).write(sdk.sites.to_toml([bar.site for bar in surveyed]))
    bars = [
        asdict(bar.site)
        | {"covariance_m2": bar.covariance_m2.tolist(), "views": bar.views}
        | ({"contradicted": bar.contradiction} if bar.contradiction else {})
        for bar in surveyed
    ]
    print_result("\n".join(map(_format_bar, surveyed)), {"bars": bars}, as_json, out=out)


def _format_bar(bar: sdk.survey.SurveyedBar) -> str:
    site = bar.site
    kind = f" ({site.link})" if site.link else ""
    return (
        f"transmitter {site.transmitter_id}{kind}: {site.latitude_deg:.9f}, {site.longitude_deg:.9f} deg,"
        f" {site.height_m:.3f} m, to {site.position_sigma_m:.3f} m, from {format_count(bar.views, 'view')}"
        + (f"; its beacon contradicts that: {bar.contradiction}" if bar.contradiction else "")
    )
