"""`evlcp calibrate`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, LinkFile, Overrides, print_result
from evlcp_sdk.formatting import format_count


def calibrate(
    recordings: Annotated[
        list[str], typer.Argument(metavar="REC...", help="Recordings of bars at known sites.")
    ],
    sites: Annotated[Path, typer.Option(metavar="site.toml", help="Where the bars stand.")],
    poses: Annotated[Path, typer.Option(metavar="poses.csv", help="Where the camera was, and when.")],
    link_file: LinkFile = None,
    overrides: Overrides = None,
    limit_px: Annotated[
        float, typer.Option(min=0.01, help="Uncertainty of the image's corners that is allowed.")
    ] = 2.0,
    as_json: Json = False,
) -> None:
    """Estimate focal length, principal point and distortion.

    They are printed with their covariance, as a link.toml.

    One recording:  [bold]evlcp calibrate REC.raw --sites site.toml --poses poses.csv[/]
    Keep the table: [bold]evlcp calibrate REC.raw --sites site.toml --poses poses.csv > camera.toml[/]

    poses.csv: t_us, latitude_deg, longitude_deg, height_m; optional recording (the file's name),
    position_sigma_m, heading_deg, pitch_deg, roll_deg, attitude_sigma_deg. What the views do not
    determine keeps its configured value, and is named.
    """
    link = sdk.resolve.load_link(link_file, overrides or [])
    bars = sdk.sites.load_sites(sites)
    known = sdk.calibration.read_poses(poses)
    result = sdk.surveying.calibrate(recordings, bars, known, link, limit_px=limit_px, name=str(poses))
    table = {
        "camera": {name: getattr(result.camera, name) for name in result.sigma},
        "sigma": dict(result.sigma),
        "camera_sigma": asdict(result.camera_sigma),
        "not_determined_corner_px": dict(result.undetermined_px),
        "views": result.views,
        "points": result.points,
        "misfit": result.misfit,
        "poses": len(known),
    }
    print_result(_to_toml(result, len(known)), table, as_json)


def _to_toml(result: sdk.calibration.Calibration, poses: int) -> str:
    """The tables `[camera]` and `[camera_sigma]`; as comments what was not determined."""
    lines = [
        f"# {format_count(result.views, 'view')}, {format_count(result.points, 'point')},"
        f" misses of {result.misfit**0.5:.2f} sigmas (rms)",
        *([f"# {poses - result.views} of {poses} poses show no bar"] if poses > result.views else []),
        "[camera]",
    ]
    for name, sigma in result.sigma.items():
        lines.append(f"{name} = {getattr(result.camera, name):.8g}  # +- {sigma:.2g}")
    for name, corner in result.undetermined_px.items():
        lines.append(
            f"# {name}: not determined (the image's corners move by {corner:.1f} px within its sigma)"
        )
    lines += ["", "[camera_sigma]"]
    for name in result.camera_sigma.__dataclass_fields__:
        if name != "correlation":
            lines.append(f"{name} = {getattr(result.camera_sigma, name):.6g}")
    lines += ["correlation = [", *(f"  {list(row)}," for row in result.camera_sigma.correlation), "]"]
    return "\n".join(lines)
