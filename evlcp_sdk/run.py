"""The use cases: what a program does with a recording, and what the commands parse and print.

What computes positions and what is live take a tenth of a start; they are imported by the functions that use
them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from evlcp_sdk.errors import (
    ConfigError,
    InputError,
    InterruptedRunError,
    PluginError,
    UnpluggedError,
    WorkerError,
)
from evlcp_sdk.files import Outputs, writing
from evlcp_sdk.io import EventSource, Loss, ReplaySource, open_source, open_writer
from evlcp_sdk.io.describe import check_sensor, summarize_source
from evlcp_sdk.io.interruptible import open_until_stopped, stream_until_stopped
from evlcp_sdk.io.open import STDIN, is_recording
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.link.several import load_links, name_links, select_positioning_links
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.results.columns import frames_table
from evlcp_sdk.results.summary import RunEnd, Status
from evlcp_sdk.results.writer import ResultWriter
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.signals import Stopped, never_stop
from evlcp_sdk.stopwatch import Stopwatch, times_real_time
from evlcp_sdk.utc import ClockZero, PulseClock
from evlcp_sdk.values import Events, Frame, Packet, span_us

if TYPE_CHECKING:
    import pandas
    import pyarrow

    from evlcp_sdk.live.budget import Budget
    from evlcp_sdk.live.publisher import Publisher
    from evlcp_sdk.place.bar_registry import BarRegistry
    from evlcp_sdk.place.calibration import CalibrationResult, CalibrationView, KnownPose
    from evlcp_sdk.place.navigator import PositionPlan
    from evlcp_sdk.place.observations import BarView
    from evlcp_sdk.place.survey import SurveyedBar
    from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
    from evlcp_sdk.scene.sites import BarSite, LocalAxes

Advance = Callable[[int, int | None], None]
"""Called after each piece with the bytes that are done, and of how many if that is known."""


def _say_nothing(_done: int, _of: int | None) -> None:
    """Who asks for no progress."""


DEGRADED_SHARE, DEGRADED_LEAST = 0.01, 100
"""Share, and number, of events and words dropped from which on a result is `degraded`."""


def receive(
    source: EventSource | str | Path,
    link: Link | Path | str | Sequence[Link | Path | str] | None = None,
    *,
    registry: Registry | None = None,
    attitude: Attitude | AttitudeLog | None = None,
    clock_zero: ClockZero = None,
    workers: int = 1,
) -> Reception:
    """Receive a recording or a camera: an iterator over its packets, in constant memory.

    The packets that the stream's end completes come, too, and the source is closed behind the last one.

    Args:
        source: What to open, plugins asked first; or a source that is open, which is read on and closed.
        link: The configuration, or a `link.toml`, or several of these; None for all defaults.
        registry: Plugins whose hooks are called; None for all that are installed.
        attitude: What is known of the camera's attitude, the same always or over time: how plumb bars lean
            against the sensor. None for nothing.
        clock_zero: UTC of the camera clock's 0, or pulses on its trigger input that say it (a `PulseClock`
            for each recording), for the age of signed beacons; None if it is not known.
        workers: Processes at work, see `Receiver`.

    Raises:
        InputError: The source cannot be opened.
        ConfigError: The file does not describe a link, the recording's sensor is not the link's, or nothing
            says which second of UTC its pulses begin.
    """
    registry = Registry.load() if registry is None else registry
    links = load_links(link, registry=registry)
    with ExitStack() as stack:
        opened = stack.enter_context(open_until_stopped(source, registry, never_stop))
        pulses = _check_source(opened, _name_of(source, opened), links, clock_zero)
        receiver = Receiver(links, registry.hook, attitude=attitude, clock_zero=clock_zero, workers=workers)
        stack.pop_all()
    return Reception(opened, receiver, links[0], pulses)


def _name_of(source: EventSource | str | Path, opened: EventSource) -> str:
    """What messages and the summary call a source."""
    return str(opened.path if isinstance(source, EventSource) or source == STDIN else source)


def _check_source(
    source: EventSource, url: str, links: Sequence[Link], clock_zero: ClockZero
) -> PulseClock | None:
    """What is told of a source's triggers; None for nobody.

    Raises:
        ConfigError: Its sensor is not the links', or nothing says which second of UTC its pulses begin.
    """
    check_sensor(source, url, links[0].camera)
    if not isinstance(clock_zero, PulseClock):
        return None
    if not (clock_zero.is_dated or source.live):
        raise ConfigError(
            f"{url}: a pulse says when a second of UTC begins, not which one: give --clock-zero, UTC of the"
            " camera clock's 0 to less than half a second"
        )
    return clock_zero


def _events_of(
    source: EventSource, pulses: PulseClock | None, stopped: Stopped = never_stop
) -> Iterator[Events]:
    """The events of a source; its triggers go to the pulses before the events that came with them."""
    for events, triggers in stream_until_stopped(source, stopped):
        if pulses is not None:
            pulses.add(triggers, time.time(), span_us(events, triggers)[1])
        if len(events):
            yield events


class Reception(Iterator[Packet]):
    """The packets of a source as they are complete; made by `receive`.

    A context manager for whoever may leave before the end. A source that cannot be read on gives the packets
    decoded until there, and then raises.

    Attributes:
        source: What is read.
        receiver: What decodes it.
        link: The configuration; the first of several.
    """

    def __init__(
        self, source: EventSource, receiver: Receiver, link: Link, pulses: PulseClock | None = None
    ) -> None:
        self.source = source
        self.receiver = receiver
        self.link = link
        self._pulses = pulses
        self._packets = self._read()

    def _read(self) -> Iterator[Packet]:
        with self.source:
            try:
                for events in _events_of(self.source, self._pulses):
                    yield from self.receiver.feed(events)
            except (PluginError, WorkerError):
                yield from self.receiver.pending_packets
                raise
            except InputError:
                yield from self.receiver.close()
                raise
            yield from self.receiver.close()

    def __next__(self) -> Packet:
        """The next packet.

        Raises:
            InputError: The source cannot be read on.
        """
        return next(self._packets)

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of the packets that follow."""
        for packet in self:
            yield from packet.frames

    def to_pandas(self) -> pandas.DataFrame:
        """The frames of the packets that follow as a table of pandas, with the columns of `frames.csv`.

        Raises:
            ConfigError: pandas is not installed.
        """
        frame: pandas.DataFrame = frames_table(self, "pandas")
        return frame

    def to_arrow(self) -> pyarrow.Table:
        """The same as a table of Arrow.

        Raises:
            ConfigError: pyarrow is not installed.
        """
        return frames_table(self, "arrow")

    @property
    def counts(self) -> dict[str, int]:
        """What the receiver has taken, found and dropped so far."""
        return self.receiver.counts

    @property
    def losses(self) -> dict[str, Loss]:
        """What the source had to skip or doubt so far, by kind."""
        return self.source.losses

    def close(self) -> None:
        """Close the source, before its end if need be; packets that are not complete are dropped."""
        self._packets = iter(())
        self.source.close()

    def __repr__(self) -> str:
        counts = self.counts
        found = ", ".join(f"{counts[name]} {name}" for name in ("events", "packets", "frames"))
        return f"Reception({self.source.path}: {found} so far)"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_fault: object) -> None:
        self.close()


def receive_to_folder(
    source: EventSource | str | Path,
    folder: Path | None,
    link: Link | Path | str | Sequence[Link | Path | str] | None = None,
    *,
    registry: Registry | None = None,
    plan: PositionPlan | None = None,
    attitude: Attitude | AttitudeLog | None = None,
    clock_zero: ClockZero = None,
    workers: int = 1,
    sinks: Sequence[str] = (),
    lines: Callable[[str], None] | None = None,
    advance: Advance = _say_nothing,
    stopped: Stopped = never_stop,
) -> dict[str, Any]:
    """Receive a recording into a folder: source, receiver, positions, sinks; in constant memory.

    Arguments are as of `receive`, and more: `folder` is where the result goes, made if need be, where an
    earlier result is replaced when the new one is complete; None: nothing is written. `plan` is what
    positions are computed from; `sinks` are output formats beside the default ones, by name, e.g. `parquet`;
    `lines` takes a line of JSON for each frame, message and fix as it comes; `advance` says how far the
    reading is; `stopped` ends the run early, and what was decoded until then is written.

    Returns:
        The summary; its `status` is `failed` when the recording cannot be read on, `degraded` when more
        than a hundredth of it was dropped.

    Raises:
        InputError: The recording cannot be opened; nothing is written.
        ConfigError: The recording's sensor is not the link's, nothing says which second of UTC its pulses
            begin, a sink cannot be used, or the folder cannot be written.
        PluginError: A plugin's code fails; nothing is written.
    """
    registry = Registry.load() if registry is None else registry
    links = load_links(link, registry=registry)
    with open_until_stopped(source, registry, stopped) as opened:
        url = _name_of(source, opened)
        pulses = _check_source(opened, url, links, clock_zero)
        with ResultWriter(
            folder,
            links,
            registry,
            name=Path(url).name,
            plan=plan,
            attitude=attitude,
            clock_zero=clock_zero,
            sinks=sinks,
            lines=lines,
        ) as writer:
            receiver = Receiver(
                links, registry.hook, attitude=attitude, clock_zero=clock_zero, workers=workers
            )
            pieces = ((events, receiver.feed(events)) for events in _events_of(opened, pulses, stopped))
            return _run(opened, url, receiver, writer, pieces, receiver.close, advance, stopped)


def live(
    source: EventSource | str | Path,
    folder: Path | None = None,
    link: Link | Path | str | Sequence[Link | Path | str] | None = None,
    *,
    registry: Registry | None = None,
    plan: PositionPlan | None = None,
    attitude: Attitude | AttitudeLog | None = None,
    clock_zero: ClockZero = None,
    workers: int = 1,
    sinks: Sequence[str] = (),
    lines: Callable[[str], None] | None = None,
    publisher: Publisher | None = None,
    budget: Budget | None = None,
    warm: bool = True,
    stopped: Stopped = never_stop,
) -> dict[str, Any]:
    """Receive in real time: results to listeners as they come, delays measured, what is too much left out.

    See `evlcp_sdk.live` for how to listen. A recording is replayed at the pace of its clock. Arguments are as
    of `receive_to_folder`, and three more: `publisher` is where listeners subscribe and pictures are drawn,
    and is closed at the end; `budget` says when what is left out; `warm` is to load all kernels before the
    first event, and before a source that does not wait is opened.

    Returns:
        The summary, as of `receive_to_folder`, with `live`: delays by stage, and what was shed.

    Raises:
        InputError: The source cannot be opened.
        ConfigError: The sensor is not the link's, or a sink cannot be used.
        PluginError: A plugin's code fails.
    """
    from evlcp_sdk.live.loop import LiveLoop
    from evlcp_sdk.live.publisher import Publisher
    from evlcp_sdk.live.warm import load_kernels

    registry = Registry.load() if registry is None else registry
    links = load_links(link, registry=registry)
    publisher = Publisher() if publisher is None else publisher
    try:
        # A recording waits for its reader, and what is wrong with its name is said at once.
        waits = not isinstance(source, EventSource) and is_recording(source)
        if warm and not waits:
            load_kernels(links, positions=plan is not None)
        opened = open_until_stopped(source, registry, stopped)
        if not opened.live and opened.size_bytes is not None:
            opened = ReplaySource(opened)
        with opened:
            url = _name_of(source, opened)
            check_sensor(opened, url, links[0].camera)
            if warm and waits:
                load_kernels(links, positions=plan is not None)
            loop: LiveLoop
            with ResultWriter(
                folder,
                links,
                registry,
                name=Path(url).name,
                plan=plan,
                attitude=attitude,
                clock_zero=clock_zero,
                sinks=sinks,
                lines=lines,
                on_fix=lambda placed: loop.publish_fix(placed),
            ) as writer:
                receiver = Receiver(
                    links,
                    registry.hook,
                    attitude=attitude,
                    clock_zero=clock_zero,
                    on_frame=lambda frame: loop.publish_frame(frame),
                    workers=workers,
                )
                pulses = clock_zero if isinstance(clock_zero, PulseClock) else None
                loop = LiveLoop(opened, receiver, links, publisher, budget, pulses=pulses)
                ends = loop.close, _say_nothing, stopped, loop.summary
                table = _run(opened, url, receiver, writer, loop.run(stopped), *ends)
        publisher.publish("end", float(table["recording"]["last_us"] or 0), table)
        return table
    finally:
        publisher.close()


def convert(
    source: EventSource | str | Path,
    out: Path,
    *,
    registry: Registry | None = None,
    size: tuple[int, int] | None = None,
    format: str | None = None,
    advance: Advance = _say_nothing,
    stopped: Stopped = never_stop,
) -> dict[str, Any]:
    """Write events and triggers of a source into a recording, in constant memory.

    `source` and `registry` are as of `receive`, the recording `out` and its `format` as of `open_writer`;
    `size` is that of the sensor, (columns, rows), where the source does not say it. `advance` says how far
    the reading is; `stopped` ends the run early: what was read of a camera or a stream until then is written,
    and nothing of a recording.

    Returns:
        Counts of what was written, losses of the source, `error`: what ended the reading early, or None, and
        whether a camera was unplugged.

    Raises:
        InputError: The source cannot be opened.
        OutputError: The recording cannot be written.
        InterruptedRunError: It was stopped while it read a recording.
        StreamError: The format is unknown, or has no place for a value.
    """
    registry = Registry.load() if registry is None else registry
    error: InputError | None = None
    counts = {"events": 0, "triggers": 0}
    with open_until_stopped(source, registry, stopped) as opened:
        width, height = size or (opened.width, opened.height)
        with open_writer(out, width, height, format, registry=registry) as writer:
            try:
                for events, triggers in stream_until_stopped(opened, stopped):
                    writer.write(events, triggers)
                    counts["events"] += len(events)
                    counts["triggers"] += len(triggers)
                    advance(opened.position_bytes, opened.size_bytes)
                    if stopped():
                        break
            except InputError as fault:
                error = fault
            if stopped() and not isinstance(source, EventSource) and is_recording(source):
                raise InterruptedRunError(f"interrupted; {out} is not written")
        losses = {kind: asdict(loss) for kind, loss in opened.losses.items()}
    return {
        "counts": counts,
        "losses": losses,
        "error": None if error is None else str(error),
        "unplugged": isinstance(error, UnpluggedError),
    }


def _run(
    source: EventSource,
    url: str,
    receiver: Receiver,
    writer: ResultWriter,
    pieces: Iterable[tuple[Events, list[Packet]]],
    close: Callable[[], list[Packet]],
    advance: Advance,
    stopped: Stopped,
    live: Callable[[], dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Receive a source to its end, or until it is stopped or fails; return the summary."""
    status: Status = "complete"
    error = None
    broken: PluginError | WorkerError | None = None
    given = 0
    pieces = iter(pieces)
    first_us = last_us = None
    watch = Stopwatch()
    with watch.measure():
        try:
            while True:
                try:
                    events, packets = next(pieces)
                except StopIteration:
                    break
                except (PluginError, WorkerError) as fault:
                    if not given and not receiver.pending_packets:
                        raise
                    # What it has let through is kept; the receiver cannot be asked for more.
                    writer.write(receiver.pending_packets)
                    status, error, broken = "failed", str(fault), fault
                    break
                if len(events):
                    first_us = int(events.t_us[0]) if first_us is None else first_us
                    last_us = int(events.t_us[-1])
                    writer.events(events)
                writer.write(packets)
                given += len(packets)
                advance(source.position_bytes, source.size_bytes)
                if stopped():
                    status = "interrupted"
                    break
        except InputError as fault:
            status, error = "failed", str(fault)
        if broken is None:
            if (live is not None or source.size_bytes is None) and stopped():
                status = "interrupted"
            writer.write(close())
    if status == "complete" and (reason := _much_dropped(source, receiver)):
        status, error = "degraded", f"{url}: {reason}"
    end = RunEnd(
        status,
        **_tables_of(source, url, watch, first_us, last_us),
        counts=receiver.counts,
        losses=source.losses,
        error=error,
        lit_us=receiver.lit_us,
        link_counts=receiver.link_counts,
        live=None if live is None else live(),
    )
    summary = writer.finish(end)
    if broken is not None:
        raise broken
    return summary


def _tables_of(
    source: EventSource, url: str, watch: Stopwatch, first_us: int | None, last_us: int | None
) -> dict[str, dict[str, Any]]:
    """What the summary says of a recording, and of how it was worked off."""
    recording = summarize_source(source, url, first_us, last_us)
    recording |= {"guessed": source.guessed, "step_us": source.step_us}
    duration_s = recording["duration_s"]
    pace = round(times_real_time(duration_s, watch.processor_s), 3) if duration_s else None
    processing = {
        "processor_s": round(watch.processor_s, 6),
        "elapsed_s": round(watch.elapsed_s, 6),
        "kernels_s": round(watch.kernels_s, 6),
        "events_per_s": round(source.counts["events"] / watch.processor_s),
        "times_real_time": pace,
    }
    return {"recording": recording, "processing": processing}


def _much_dropped(source: EventSource, receiver: Receiver) -> str | None:
    """How much of a recording was dropped, where that is too much to call the result whole."""
    lost = sum(loss.count for loss in source.losses.values())
    dropped = lost + sum(n for name, n in receiver.counts.items() if name.startswith("dropped_"))
    share = dropped / max(source.counts["events"] + lost, 1)
    if dropped < DEGRADED_LEAST or share <= DEGRADED_SHARE:
        return None
    return f"{dropped} events or words, {share:.1%}, were dropped: losses and counts in summary.json say why"


def film(
    recording: Path | str,
    out: Path,
    link: Link | Path | str | Sequence[Link | Path | str] | None = None,
    *,
    registry: Registry | None = None,
    from_ms: float | None = None,
    for_ms: float = 20.0,
    slow: float = 400.0,
    longest_px: int = 640,
    whole: bool = False,
    advance: Advance = _say_nothing,
) -> dict[str, Any]:
    """Film a recording in slow motion, with regions, symbols and distances drawn in; in bounded memory.

    The recording is read twice: to decode it until the end of what is shown, and for the events.

    The film, `out`, is an animated picture, `.webp` or `.gif`, or `.mp4`. It starts `from_ms` after the first
    event, or with the first frame that is decoded, or at the start where there is none; shows `for_ms` of the
    recording, `slow` times slower than it was, in pictures of `longest_px`, and the bars only, or the `whole`
    image. `advance` says how far the reading is; other arguments are as of `receive`.

    Returns:
        What it shows: pictures, their size, time, transmitters, frames.

    Raises:
        InputError: The recording cannot be read, or has nothing there.
        ConfigError: The film would have too many pictures, or is to be of another kind, or one whose
            extra is not installed.
        OutputError: It cannot be written.
    """
    # Matplotlib and Pillow take longer to import than other use cases to start.
    from evlcp_sdk.report.film import check_film, draw_film, gather_footage, plan_film, save_film

    kind = check_film(out, for_ms, slow)
    if str(recording) == STDIN:
        raise ConfigError(
            "a film needs a file: it reads the recording twice, and standard input gives it once"
        )
    registry = Registry.load() if registry is None else registry
    links = name_links(load_links(link, registry=registry))
    camera = next(iter(links.values())).camera
    with open_source(recording, registry) as source:
        check_sensor(source, recording, camera)
        footage = gather_footage(source, str(recording), links, registry, from_ms, for_ms * 1e3, advance)
    plan = plan_film(footage, for_ms * 1e3, slow, camera, longest_px, whole=whole)
    with open_source(recording, registry) as source:
        drawn = list(draw_film(plan, source.chunks(), footage, links))
    with Outputs() as outputs:
        with writing(out):
            save_film(drawn, outputs.path(out), kind)
        outputs.commit()
    width, height = plan.size_px
    return {
        "film": str(out),
        "pictures": plan.pictures,
        "width": width,
        "height": height,
        "bytes": out.stat().st_size,
        "from_ms": round((footage.start_us - footage.first_us) * 1e-3, 3),
        "for_ms": for_ms,
        "slow": slow,
        "transmitters": sorted({frame.transmitter for frame in footage.frames}),
        "frames": len(footage.frames),
    }


def calibrate(
    recordings: Sequence[str],
    sites: Sequence[BarSite],
    poses: Sequence[KnownPose],
    link: Link | None = None,
    *,
    registry: Registry | None = None,
    limit_px: float = 2.0,
    name: str = "poses",
) -> CalibrationResult:
    """Estimate focal length, principal point and distortion from bars at known places.

    `recordings` show bars that stand at `sites`; `poses` say where the camera was, and when, and `name` is
    what messages call the file they come from, which has a heading and a line a pose. `limit_px` is the
    uncertainty of the image's corners that is allowed; `link` and `registry` are as of `receive`.

    Raises:
        InputError: A recording cannot be read.
        ConfigError: A pose belongs to none of the recordings, a site contradicts its beacon, or too little
            was seen.
    """
    from evlcp_sdk.place.bar_registry import BarRegistry
    from evlcp_sdk.place.calibration import fit_camera
    from evlcp_sdk.place.error_model import ErrorModel
    from evlcp_sdk.scene.sites import LocalAxes

    registry = Registry.load() if registry is None else registry
    link = link if isinstance(link, Link) else load_link(link, registry=registry)
    _check_lines({"": link})
    _check_names(recordings, poses, name)
    axes = LocalAxes.of(sites)
    views: list[CalibrationView] = []
    for url in recordings:
        who = BarRegistry(sites, link.position)
        seen, _ = _seen_at(url, poses, {"": link}, registry, who, name)
        for how in who.contradictions.values():
            raise ConfigError(f"{url}: {how}")
        for pose, points in seen:
            bars = []
            for number, found in points.items():
                if (site := who.known_sites.get(number)) is not None:
                    enu = site.layout_positions_m(link.bar, axes)
                    bars.append(
                        replace(found, transmitter=site.transmitter_id, enu_m=enu, survey=site.survey_sigmas)
                    )
            views.append(_view(pose, bars, axes))
    return fit_camera(views, link.camera, ErrorModel.of(link.position), limit_px=limit_px)


def _check_lines(links: Mapping[str, Link]) -> None:
    for name, link in links.items():
        if not link.bar.is_even_line or link.bar.clusters < 2:
            which = f"link '{name}': " if name else ""
            raise ConfigError(
                f"{which}a survey is of bars whose clusters stand evenly in line; write a site.toml by hand"
            )


def _check_names(recordings: Sequence[str], poses: Sequence[KnownPose], source: str) -> None:
    names = [Path(url).name for url in recordings]
    known = names if len(names) > 1 else ["", *names]
    for line, pose in enumerate(poses, 2):
        if pose.recording not in known:
            expected = f"expected one of {', '.join(names)}"
            raise ConfigError(f"{source}: line {line}: recording = {pose.recording!r}: {expected}")


def _view(pose: KnownPose, bars: Sequence[BarView], axes: LocalAxes) -> CalibrationView:
    from evlcp_sdk.place.calibration import CalibrationView
    from evlcp_sdk.scene.sites import LocalAxes

    place = (pose.latitude_deg, pose.longitude_deg, pose.height_m)
    rotation = None
    if pose.attitude is not None:
        rotation = axes.rotation_from(LocalAxes(*place)) @ pose.attitude.rotation()
    where = axes.to_enu(*place)
    return CalibrationView(tuple(bars), where, pose.position_sigma_m, rotation, pose.attitude_sigma_deg)


def _seen_at(
    url: str,
    poses: Sequence[KnownPose],
    links: Mapping[str, Link],
    registry: Registry,
    who: BarRegistry,
    source: str,
) -> tuple[list[tuple[KnownPose, dict[int, BarView]]], dict[int, str]]:
    """The poses of a recording with the view of each transmitter then; the link of each transmitter.

    Raises:
        InputError: The recording cannot be read.
        ConfigError: No pose is of a time at which bars are in view.
    """
    from evlcp_sdk.place.error_model import ErrorModel
    from evlcp_sdk.place.points import interpolate_points

    poses = [pose for pose in poses if pose.recording in ("", Path(url).name)]
    placing = select_positioning_links(links)
    periods = {name: one.packet.packet_chips * one.packet.chip_us for name, one in placing.items()}
    frames: dict[int, list[Frame]] = {}
    link_of: dict[int, str] = {}
    first_us, last_us = math.inf, -math.inf
    with receive(url, list(links.values()), registry=registry) as packets:
        for packet in packets:
            if packet.link not in placing:
                continue
            who.add_packet(packet)
            if packet.echo_of is not None:
                frames.pop(packet.transmitter, None)
                continue
            link_of[packet.transmitter] = packet.link
            kept = frames.setdefault(packet.transmitter, [])
            clusters, period_us = placing[packet.link].bar.clusters, periods[packet.link]
            for one in packet.frames:
                first_us, last_us = min(first_us, one.t_us), max(last_us, one.t_us)
                if len(one.points_px) == clusters and any(
                    abs(one.points_t_us - pose.t_us) <= period_us for pose in poses
                ):
                    kept.append(one)
    found: list[tuple[KnownPose, dict[int, BarView]]] = []
    for pose in poses:
        found.append((pose, {}))
        for number, seen in frames.items():
            name = link_of[number]
            link = placing[name]
            errors = ErrorModel.of(link.position)
            layout_m = link.bar.cluster_positions_m()
            points = interpolate_points(number, seen, pose.t_us, periods[name], layout_m, errors)
            if points is not None:
                found[-1][1][number] = points
    times = [pose.t_us for pose in poses]
    shown = any(points for _, points in found) or any(first_us <= t <= last_us for t in times)
    if times and first_us <= last_us and not shown:
        raise ConfigError(
            f"{source}: t_us from {min(times):.16g} to {max(times):.16g}: expected the camera's clock, us,"
            f" which is at {first_us:.0f} to {last_us:.0f} where {url} shows bars"
        )
    return found, link_of


def survey(
    recordings: Sequence[str],
    poses: Sequence[KnownPose],
    link: Link | Path | str | Sequence[Link | Path | str] | None = None,
    *,
    registry: Registry | None = None,
    name: str = "poses",
    known: Sequence[BarSite] = (),
) -> list[SurveyedBar]:
    """Estimate where bars stand that send their ids, from known poses; the camera is known as the link says.

    Arguments are as of `calibrate`, with poses that say how the camera was turned, too; `known` are bars that
    need no survey. Bars of several links are told apart by their codes, and their sites name them.

    Raises:
        InputError: A recording cannot be read.
        ConfigError: A pose belongs to none of the recordings, or has no attitude, or too little was seen.
    """
    from evlcp_sdk.place.bar_registry import BarRegistry
    from evlcp_sdk.place.error_model import ErrorModel
    from evlcp_sdk.place.survey import survey_bars
    from evlcp_sdk.scene.sites import LocalAxes

    registry = Registry.load() if registry is None else registry
    links = name_links(load_links(link, registry=registry))
    placing = select_positioning_links(links)
    _check_lines(placing)
    _check_names(recordings, poses, name)
    listed = {site.transmitter_id for site in known}
    first, like = poses[0], next(iter(placing.values()))
    axes = LocalAxes(first.latitude_deg, first.longitude_deg, first.height_m)
    views: list[CalibrationView] = []
    sends: dict[int, str] = {}
    registries: list[BarRegistry] = []
    for url in recordings:
        who = BarRegistry((), like.position)
        seen, link_of = _seen_at(url, poses, links, registry, who, name)
        registries.append(who)
        ids = who.ids
        for pose, points in seen:
            bars = []
            for n, found in points.items():
                if n not in ids or ids[n] in listed:
                    continue
                number, by = ids[n], link_of[n]
                if sends.setdefault(number, by) != by:
                    raise ConfigError(
                        f"{url}: id {number} is sent by '{sends[number]}' and '{by}': give one link at a time"
                    )
                bars.append(replace(found, transmitter=number))
            views.append(_view(pose, bars, axes))
    long_m = {number: placing[by].bar.length_m for number, by in sends.items()}
    surveyed = survey_bars(views, axes, long_m, like.camera, like.camera_sigma, ErrorModel.of(like.position))
    named = [
        replace(bar, site=replace(bar.site, link=sends[bar.site.transmitter_id] or None)) for bar in surveyed
    ]
    sites = [bar.site for bar in named]
    said = {id_: how for who in registries for id_, how in who.find_contradictions(sites).items()}
    return [replace(bar, contradicted=said.get(bar.site.transmitter_id, "")) for bar in named]


def survey_on_the_way(
    recordings: Sequence[str],
    plan: PositionPlan,
    link: Link | Path | str | Sequence[Link | Path | str] | None = None,
    *,
    attitude: Attitude | AttitudeLog | None = None,
    registry: Registry | None = None,
) -> list[SurveyedBar]:
    """Estimate where new bars stand from the camera's own track past known ones.

    In the recordings known bars, or fixes of satellites, both in the plan, give positions, and new bars send
    their ids; other arguments are as of `receive`. A recording is read two times, and a third time where a
    new bar was alone in view before it sent its id.

    Raises:
        InputError: A recording cannot be read.
        ConfigError: No new bar is in view where the track is known, or too little was seen.
    """
    registry = Registry.load() if registry is None else registry
    links = load_links(link, registry=registry)
    plan.check_links(list(name_links(links)))
    poses: list[KnownPose] = []
    known = {site.transmitter_id: site for site in plan.sites}
    seen = []
    for url in recordings:
        found, placed, reason = _own_poses(url, plan, links, attitude, registry)
        poses += found
        known = {site.transmitter_id: site for site in placed} | known
        seen.append(f"{url}: {reason}")
    if not poses:
        raise ConfigError(
            f"no new bar was in view where the track is known: nothing to survey ({'; '.join(seen)})"
        )
    return survey(recordings, poses, links, registry=registry, name="track", known=[*known.values()])


def _own_poses(
    url: str,
    plan: PositionPlan,
    links: Sequence[Link],
    attitude: Attitude | AttitudeLog | None,
    registry: Registry,
) -> tuple[list[KnownPose], list[BarSite], str]:
    """The poses of a recording's own track while new bars are in view, the bars that it goes by, and what it
    saw.
    """
    from evlcp_sdk.place.navigator import Navigator
    from evlcp_sdk.place.survey import TrackPoses
    from evlcp_sdk.scene.attitude import attitude_source

    navigator = Navigator(select_positioning_links(name_links(links)), plan, attitude)
    track = TrackPoses(navigator, attitude_source(attitude), Path(url).name)
    taken: dict[int, BarSite] = {}
    with receive(url, links, registry=registry, attitude=attitude) as packets:
        for packet in packets:
            track.add_packet(packet)
            taken = navigator.positioner.bars.known_sites | taken
    poses, ids = track.close(), navigator.positioner.bars.ids
    wrong = [n for n, site in taken.items() if ids.get(n, site.transmitter_id) != site.transmitter_id]
    if not wrong:
        return poses, list(taken.values()), track.summary
    # A new bar was taken for a known one as long as it had not sent its id: its number is no site's.
    numbers = {said: number for number, said in ids.items()}
    none = max(ids) + 1
    sites = tuple(
        replace(site, transmitter=numbers.get(site.transmitter_id, none + i))
        for i, site in enumerate(plan.sites)
    )
    if sites == plan.sites:
        raise ConfigError(f"{url}: transmitter {wrong[0]} sends one id and then another")
    return _own_poses(url, replace(plan, sites=sites), links, attitude, registry)
