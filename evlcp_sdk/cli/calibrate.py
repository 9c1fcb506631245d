"""`evlcp calibrate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evlcp_sdk.cli._common import Json, LinkFile, Overrides, console

if TYPE_CHECKING:
    from collections.abc import Sequence

    from evlcp_sdk.link.resolve import Link
    from evlcp_sdk.place.calibration import Calibrated, CalibrationView
    from evlcp_sdk.place.poses import KnownPose
    from evlcp_sdk.scene.sites import BarSite, LocalFrame

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("calibrate")(calibrate)


def calibrate(
    recordings: Annotated[
        list[str], typer.Argument(metavar="REC...", help="Recordings of bars at known sites.")
    ],
    sites: Annotated[Path, typer.Option("--sites", metavar="site.toml", help="Where the bars stand.")],
    poses: Annotated[
        Path, typer.Option("--poses", metavar="poses.csv", help="Where the camera was, and when.")
    ],
    link_file: LinkFile = None,
    overrides: Overrides = None,
    limit_px: Annotated[
        float,
        typer.Option("--limit-px", min=0.01, help="Uncertainty of the image's corners that is allowed."),
    ] = 2.0,
    as_json: Json = False,
) -> None:
    """Estimate focal length, principal point and distortion; print a [camera] table for link.toml.

    One recording:  [bold]evlcp calibrate REC.raw --sites site.toml --poses poses.csv[/]

    Keep the table: [bold]evlcp calibrate REC.raw --sites site.toml --poses poses.csv > camera.toml[/]

    poses.csv: t_us, latitude_deg, longitude_deg, height_m; optional recording (the file's name),
    position_sigma_m, heading_deg, pitch_deg, roll_deg, attitude_sigma_deg. What the views do not
    determine keeps its configured value, and is told.
    """
    import json

    from evlcp_sdk.link.resolve import load_link
    from evlcp_sdk.place.calibration import calibrate as fit
    from evlcp_sdk.place.poses import read_poses
    from evlcp_sdk.plugin.registry import Registry
    from evlcp_sdk.scene.sites import LocalFrame, load_sites

    link = load_link(link_file, overrides or [], Registry.load())
    known = load_sites(sites)
    frame = LocalFrame.of(known)
    told = read_poses(poses)
    _check_names(recordings, told, poses)
    views: list[CalibrationView] = []
    for url in recordings:
        name = Path(url).name
        mine = [pose for pose in told if pose.recording in ("", name)]
        views += _views(url, mine, link, known, frame)
    found = fit(views, link.camera, link.position, limit_px=limit_px)
    if as_json:
        typer.echo(json.dumps(_table(found) | {"poses": len(told)}))
    else:
        console().print(_toml(found, len(told)), markup=False)


def _check_names(recordings: list[str], poses: "Sequence[KnownPose]", path: Path) -> None:
    from evlcp_sdk.errors import ConfigError

    names = [Path(url).name for url in recordings]
    for line, pose in enumerate(poses, 2):
        if pose.recording not in ("", *names):
            raise ConfigError(
                f"{path}: line {line}: recording = {pose.recording!r}: expected one of {', '.join(names)}"
            )
        if not pose.recording and len(names) > 1:
            raise ConfigError(f"{path}: line {line}: recording: expected one, as there are {len(names)}")


def _views(
    url: str,
    poses: "Sequence[KnownPose]",
    link: "Link",
    sites: "Sequence[BarSite]",
    frame: "LocalFrame",
) -> "list[CalibrationView]":
    """What a recording shows at the times of known poses."""
    from evlcp_sdk.errors import ConfigError
    from evlcp_sdk.io.open import open_source
    from evlcp_sdk.io.sensor import check_sensor
    from evlcp_sdk.place.calibration import CalibrationView
    from evlcp_sdk.place.observations import BarView
    from evlcp_sdk.place.points import points_at
    from evlcp_sdk.place.whereabouts import Whereabouts
    from evlcp_sdk.plugin.registry import Registry
    from evlcp_sdk.rx.receiver import Receiver
    from evlcp_sdk.scene.sites import LocalFrame
    from evlcp_sdk.values import Frame, Packet

    registry = Registry.load()
    receiver = Receiver(link, registry.hook)
    clusters, spec = link.bar.clusters, link.position
    period_us = link.packet.packet_chips * link.packet.chip_us
    who = Whereabouts(sites, spec)
    frames: dict[int, list[Frame]] = {}

    def take(packets: list[Packet]) -> None:
        for packet in packets:
            who.hear(packet)
            kept = frames.setdefault(packet.transmitter, [])
            for frame in packet.frames:
                if len(frame.points_px) == clusters and any(
                    abs(frame.points_t_us - pose.t_us) <= period_us for pose in poses
                ):
                    kept.append(frame)

    with open_source(url, registry) as source:
        check_sensor(source, url, link.camera)
        for events in source.chunks():
            take(receiver.feed(events))
        take(receiver.close())
    for how in who.contradicted.values():
        raise ConfigError(f"{url}: {how}")
    stands_at = who.stands_at
    views = []
    for pose in poses:
        bars = []
        for number, seen in frames.items():
            points = points_at(seen, pose.t_us, period_us, clusters, spec)
            if points is not None and number in stands_at:
                enu = stands_at[number].cluster_positions_m(clusters, frame)
                bars.append(BarView(number, enu, *points))
        place = (pose.latitude_deg, pose.longitude_deg, pose.height_m)
        rotation = None
        if pose.attitude is not None:
            rotation = frame.turn_from(LocalFrame(*place)) @ pose.attitude.rotation()
        views.append(
            CalibrationView(
                tuple(bars),
                frame.to_enu(*place),
                pose.position_sigma_m,
                rotation,
                pose.attitude_sigma_deg,
            )
        )
    return views


def _table(found: "Calibrated") -> dict[str, Any]:
    return {
        "camera": {name: getattr(found.camera, name) for name in found.sigma},
        "sigma": dict(found.sigma),
        "not_determined_corner_px": dict(found.refused),
        "views": found.views,
        "points": found.points,
        "misfit": found.misfit,
    }


def _toml(found: "Calibrated", poses: int) -> str:
    """The `[camera]` table, each value with its sigma; what was not determined as a comment."""
    lines = [
        f"# {found.views} views, {found.points} points, misses of {found.misfit**0.5:.2f} sigmas (rms)",
        *([f"# {poses - found.views} of {poses} poses show no bar"] if poses > found.views else []),
        "[camera]",
    ]
    for name, sigma in found.sigma.items():
        lines.append(f"{name} = {getattr(found.camera, name):.8g}  # +- {sigma:.2g}")
    for name, corner in found.refused.items():
        lines.append(
            f"# {name}: not determined (the image's corners move by {corner:.1f} px within its sigma)"
        )
    return "\n".join(lines)
