"""Calibration and survey: where a camera's lens and bars are, by recordings at known poses."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.link.several import load_links, name_links, select_positioning_links
from evlcp_sdk.place.bar_registry import BarRegistry
from evlcp_sdk.place.calibration import Calibration, CalibrationView, KnownPose, fit_camera
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.navigator import Navigator, PositionPlan
from evlcp_sdk.place.observations import BarView
from evlcp_sdk.place.points import views_at
from evlcp_sdk.place.survey import SurveyedBar, TrackPoses, survey_bars
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.run import receive
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog, attitude_source
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.values import Frame


def calibrate(
    recordings: Sequence[str],
    sites: Sequence[BarSite],
    poses: Sequence[KnownPose],
    link: Link | None = None,
    *,
    registry: Registry | None = None,
    limit_px: float = 2.0,
    name: str = "poses",
) -> Calibration:
    """Estimate focal length, principal point and distortion from bars at known places.

    `recordings` show bars at `sites`; `poses` are places and times of the camera, and `name` is the name in
    messages of their file. `limit_px` is the largest uncertainty of the image's corners; `link` and
    `registry` are those of `receive`.

    Raises:
        InputError: A recording cannot be read.
        ConfigError: A pose belongs to none of the recordings, a site contradicts its beacon, or too little
            was seen.
    """
    link = link if isinstance(link, Link) else load_link(link, registry=registry)
    _check_layouts({"": link})
    _check_recordings(recordings, poses, name)
    axes = LocalAxes.of(sites)
    views: list[CalibrationView] = []
    for url in recordings:
        bars = BarRegistry(sites, link.position)
        observed = _observe_bars(url, poses, {"": link}, registry, bars, name)
        for contradiction in bars.contradictions.values():
            raise ConfigError(f"{url}: {contradiction}")
        for pose, views_of in observed:
            known = []
            for number, view in views_of.items():
                if (site := bars.known_sites.get(number)) is not None:
                    enu = site.layout_positions_m(link.bar, axes)
                    placed = replace(view, enu_m=enu, survey_sigmas=site.survey_sigmas)
                    known.append(replace(placed, transmitter=site.transmitter_id))
            views.append(_make_view(pose, known, axes))
    return fit_camera(views, link.camera, ErrorModel.of(link.position), limit_px=limit_px)


def _check_layouts(links: Mapping[str, Link]) -> None:
    for name, link in links.items():
        if not link.bar.is_even_line or link.bar.clusters < 2:
            prefix = f"link '{name}': " if name else ""
            raise ConfigError(
                f"{prefix}a survey is of bars whose clusters stand evenly in line; write a site.toml by hand"
            )


def _check_recordings(recordings: Sequence[str], poses: Sequence[KnownPose], source: str) -> None:
    names = [Path(url).name for url in recordings]
    known = names if len(names) > 1 else ["", *names]
    for pose in poses:
        if pose.recording not in known:
            expected = f"expected one of {', '.join(names)}"
            raise ConfigError(f"{source}: line {pose.line}: recording = {pose.recording!r}: {expected}")


def _make_view(pose: KnownPose, bars: Sequence[BarView], axes: LocalAxes) -> CalibrationView:
    place = (pose.latitude_deg, pose.longitude_deg, pose.height_m)
    rotation = None
    if pose.attitude is not None:
        rotation = axes.rotation_from(LocalAxes(*place)) @ pose.attitude.rotation()
    enu_m = axes.to_enu(*place)
    return CalibrationView(tuple(bars), enu_m, pose.position_sigma_m, rotation, pose.attitude_sigma_deg)


def _observe_bars(
    url: str,
    poses: Sequence[KnownPose],
    links: Mapping[str, Link],
    registry: Registry | None,
    bars: BarRegistry,
    source: str,
) -> list[tuple[KnownPose, dict[int, BarView]]]:
    """The poses of a recording, each with the views of the transmitters.

    Raises:
        InputError: The recording cannot be read.
        ConfigError: No pose is of a time at which bars are in view.
    """
    poses = [pose for pose in poses if pose.recording in ("", Path(url).name)]
    placing = select_positioning_links(links)
    frames = defaultdict[int, list[Frame]](list)
    first_us, last_us = math.inf, -math.inf
    with receive(url, list(links.values()), registry=registry) as packets:
        for packet in packets:
            if packet.link not in placing:
                continue
            bars.add_packet(packet)
            if packet.echo_of is not None:
                frames.pop(packet.transmitter, None)
                continue
            link = placing[packet.link]
            for frame in packet.frames:
                first_us, last_us = min(first_us, frame.t_us), max(last_us, frame.t_us)
                if len(frame.points_px) == link.bar.clusters and any(
                    abs(frame.points_t_us - pose.t_us) <= link.packet.packet_us for pose in poses
                ):
                    frames[packet.transmitter].append(frame)
    errors = ErrorModel.of(next(iter(placing.values())).position)
    observed = [(pose, views_at(pose.t_us, frames, placing, errors)) for pose in poses]
    times = [pose.t_us for pose in poses]
    in_view = any(views for _, views in observed) or any(first_us <= t <= last_us for t in times)
    if times and first_us <= last_us and not in_view:
        raise ConfigError(
            f"{source}: t_us from {min(times):.16g} to {max(times):.16g}: expected the camera's clock, us,"
            f" which is at {first_us:.0f} to {last_us:.0f} where {url} shows bars"
        )
    return observed


def survey(
    recordings: Sequence[str],
    poses: Sequence[KnownPose],
    link: Link | Path | str | Sequence[Link | Path | str] | None = None,
    *,
    registry: Registry | None = None,
    name: str = "poses",
    known: Sequence[BarSite] = (),
) -> list[SurveyedBar]:
    """Estimate where bars stand that send their ids, from known poses; the link describes the camera.

    Arguments are those of `calibrate`, with poses that have an attitude, too; `known` are bars that need no
    survey. Bars of several links are distinguished by their codes, and their sites name them.

    Raises:
        InputError: A recording cannot be read.
        ConfigError: A pose belongs to none of the recordings, or has no attitude, or too little was seen.
    """
    links = name_links(load_links(link, registry=registry))
    placing = select_positioning_links(links)
    _check_layouts(placing)
    _check_recordings(recordings, poses, name)
    for pose in poses:
        if pose.attitude is None:
            raise ConfigError(f"{name}: line {pose.line}: a survey needs heading_deg, pitch_deg and roll_deg")
    known_ids = {site.transmitter_id for site in known}
    first, first_link = poses[0], next(iter(placing.values()))
    axes = LocalAxes(first.latitude_deg, first.longitude_deg, first.height_m)
    views: list[CalibrationView] = []
    link_of_id: dict[int, str] = {}
    registries: list[BarRegistry] = []
    for url in recordings:
        registries.append(BarRegistry((), first_link.position))
        observed = _observe_bars(url, poses, links, registry, registries[-1], name)
        ids = registries[-1].ids
        for pose, views_of in observed:
            new = []
            for number, view in views_of.items():
                if number not in ids or ids[number] in known_ids:
                    continue
                id, by = ids[number], registries[-1].link_of(number)
                if link_of_id.setdefault(id, by) != by:
                    raise ConfigError(
                        f"{url}: id {id} is sent by '{link_of_id[id]}' and '{by}': give one link at a time"
                    )
                new.append(replace(view, transmitter=id))
            views.append(_make_view(pose, new, axes))
    lengths_m = {id: placing[by].bar.length_m for id, by in link_of_id.items()}
    camera, errors = first_link.camera, ErrorModel.of(first_link.position)
    surveyed = survey_bars(views, axes, lengths_m, camera, first_link.camera_sigma, errors)
    sites = [replace(bar.site, link=link_of_id[bar.site.transmitter_id] or None) for bar in surveyed]
    contradictions = {id: text for bars in registries for id, text in bars.find_contradictions(sites).items()}
    return [
        replace(bar, site=site, contradiction=contradictions.get(site.transmitter_id, ""))
        for bar, site in zip(surveyed, sites, strict=True)
    ]


def survey_along_track(
    recordings: Sequence[str],
    plan: PositionPlan,
    link: Link | Path | str | Sequence[Link | Path | str] | None = None,
    *,
    attitude: Attitude | AttitudeLog | None = None,
    registry: Registry | None = None,
) -> list[SurveyedBar]:
    """Estimate where new bars stand from the camera's own track past known ones.

    In the recordings known bars, or fixes of satellites, both in the plan, give positions, and new bars send
    their ids; other arguments are those of `receive`. A recording is read twice, and a third time where a new
    bar was alone in view before it sent its id.

    Raises:
        InputError: A recording cannot be read.
        ConfigError: No new bar is in view where the track is known, or too little was seen.
    """
    links = load_links(link, registry=registry)
    plan.check_links(list(name_links(links)))
    poses: list[KnownPose] = []
    known = {site.transmitter_id: site for site in plan.sites}
    summaries = []
    for url in recordings:
        own_poses, sites, summary = _track_poses(url, plan, links, attitude, registry)
        poses += own_poses
        known = {site.transmitter_id: site for site in sites} | known
        summaries.append(f"{url}: {summary}")
    if not poses:
        raise ConfigError(
            f"no new bar was in view where the track is known: nothing to survey ({'; '.join(summaries)})"
        )
    return survey(recordings, poses, links, registry=registry, name="track", known=[*known.values()])


def _track_poses(
    url: str,
    plan: PositionPlan,
    links: Sequence[Link],
    attitude: Attitude | AttitudeLog | None,
    registry: Registry | None,
) -> tuple[list[KnownPose], list[BarSite], str]:
    """The poses of a recording's own track while new bars are in view, the known bars, and a summary."""
    navigator = Navigator(select_positioning_links(name_links(links)), plan, attitude)
    track = TrackPoses(navigator, attitude_source(attitude), Path(url).name)
    sites_of: dict[int, BarSite] = {}
    with receive(url, links, registry=registry, attitude=attitude) as packets:
        for packet in packets:
            track.add_packet(packet)
            sites_of = navigator.positioner.bars.known_sites | sites_of
    poses, ids = track.close(), navigator.positioner.bars.ids
    wrong = [n for n, site in sites_of.items() if ids.get(n, site.transmitter_id) != site.transmitter_id]
    if not wrong:
        return poses, list(sites_of.values()), track.summary
    # Until it sent its id, a new bar was taken for a known one: its number belongs to no site.
    numbers = {id: number for number, id in ids.items()}
    sites = tuple(replace(site, transmitter=numbers.get(site.transmitter_id, -1)) for site in plan.sites)
    if sites == plan.sites:
        raise ConfigError(f"{url}: transmitter {wrong[0]} sends one id and then another")
    return _track_poses(url, replace(plan, sites=sites), links, attitude, registry)
