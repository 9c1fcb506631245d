"""The use cases as functions, for programs and for the commands.

Positions and live runs take a tenth of a start to import, so only the functions that use them do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict
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
from evlcp_sdk.io.describe import Span, check_sensor, summarize_source
from evlcp_sdk.io.interruptible import open_until_stopped, stream_until_stopped
from evlcp_sdk.io.open import STDIN, is_recording
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.several import load_links, name_links
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
    from evlcp_sdk.place.navigator import PositionPlan
    from evlcp_sdk.scene.attitude import Attitude, AttitudeLog

Advance = Callable[[int, int | None], None]
"""Called after each piece with the bytes that are read, and of how many if that is known."""


def _ignore_progress(_done: int, _of: int | None) -> None:
    """The `Advance` of a caller who wants no progress."""


_DEGRADED_SHARE, _MIN_DEGRADED = 0.01, 100
"""Share and number of dropped events and words above which a result is `degraded`."""


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

    This includes packets that the end of the stream completes; then the source is closed.

    Args:
        source: What to open, plugins asked first; or an open source, which is read on and closed.
        link: The configuration, or a `link.toml`, or several of these; None for all defaults.
        registry: Plugins whose hooks are called; None for all that are installed.
        attitude: The camera's attitude, constant or over time, which gives the tilt of plumb bars against the
            sensor; None where it is not known.
        clock_zero: UTC of the camera clock's 0, or pulses on its trigger input that give it (a `PulseClock`
            for each recording), for the age of signed beacons; None where it is not known.
        workers: Number of processes, see `Receiver`.

    Raises:
        InputError: The source cannot be opened.
        ConfigError: The file does not describe a link, the recording's sensor is not the link's, or nothing
            says which second of UTC its pulses begin.
    """
    registry = Registry.load() if registry is None else registry
    links = load_links(link, registry=registry)
    with ExitStack() as stack:
        opened = stack.enter_context(open_until_stopped(source, registry, never_stop))
        pulses = _check_source(opened, _source_name(source, opened), links, clock_zero)
        receiver = Receiver(links, registry.hook, attitude=attitude, clock_zero=clock_zero, workers=workers)
        stack.pop_all()
    return Reception(opened, receiver, links[0], pulses)


def _source_name(source: EventSource | str | Path, opened: EventSource) -> str:
    return str(opened.path if isinstance(source, EventSource) or source == STDIN else source)


def _check_source(
    source: EventSource, url: str, links: Sequence[Link], clock_zero: ClockZero
) -> PulseClock | None:
    """Check a source; return the pulses that take its triggers, or None.

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


def _read_events(
    source: EventSource, pulses: PulseClock | None, stopped: Stopped = never_stop
) -> Iterator[Events]:
    """The events of a source; triggers are passed to the pulses before the events of their piece."""
    for events, triggers in stream_until_stopped(source, stopped):
        if pulses is not None:
            pulses.add(triggers, time.time(), span_us(events, triggers)[1])
        if len(events):
            yield events


class Reception(Iterator[Packet]):
    """The packets of a source as they are complete; made by `receive`.

    A context manager for programs that may stop before the end. A source that cannot be read on gives the
    packets until there, and then raises.

    Attributes:
        source: The source.
        receiver: The receiver.
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
                for events in _read_events(self.source, self._pulses):
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
        """Yield the frames of the following packets."""
        for packet in self:
            yield from packet.frames

    def to_pandas(self) -> pandas.DataFrame:
        """The frames of the following packets as a pandas table with the columns of `frames.csv`.

        Raises:
            ConfigError: pandas is not installed.
        """
        return frames_table(self, "pandas")

    def to_arrow(self) -> pyarrow.Table:
        """The same as an Arrow table.

        Raises:
            ConfigError: pyarrow is not installed.
        """
        return frames_table(self, "arrow")

    @property
    def counts(self) -> dict[str, int]:
        """The receiver's counts so far."""
        return self.receiver.counts

    @property
    def losses(self) -> dict[str, Loss]:
        """The source's losses so far, by kind."""
        return self.source.losses

    def close(self) -> None:
        """Close the source and end the workers, also before its end; incomplete packets are dropped."""
        self._packets = iter(())
        self.source.close()
        self.receiver.end_workers()

    def __repr__(self) -> str:
        counts = self.counts
        numbers = ", ".join(f"{counts[name]} {name}" for name in ("events", "packets", "frames"))
        return f"Reception({self.source.path}: {numbers} so far)"

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
    advance: Advance = _ignore_progress,
    stopped: Stopped = never_stop,
) -> dict[str, Any]:
    """Receive a recording into a folder: source, receiver, positions, sinks; in constant memory.

    Arguments are those of `receive`, and more: `folder` gets the result, is created if need be, and keeps an
    earlier result until the new one is complete; None to write nothing. `plan` is what positions are computed
    from; `sinks` are output formats beside the default ones, by name, e.g. `parquet`; `lines` takes a line of
    JSON for each frame, message and fix as it comes; `advance` gets the progress; `stopped` ends the run
    early, with what was decoded until then.

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
        url = _source_name(source, opened)
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
            pieces = ((events, receiver.feed(events)) for events in _read_events(opened, pulses, stopped))
            return _run_to_end(opened, url, receiver, writer, pieces, receiver.close, advance, stopped)


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
    """Receive in real time: publish results as they come, measure delays, and shed what is too much.

    See `evlcp_sdk.live` for how to subscribe. A recording is replayed at the pace of its clock. Arguments are
    those of `receive_to_folder`, and three more: `publisher` is closed at the end; `budget` limits shedding;
    `warm` loads all kernels before the first event, and before a source that does not wait is opened.

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
        # A recording waits for its reader, and a wrong name is reported at once.
        waits = not isinstance(source, EventSource) and is_recording(source)
        if warm and not waits:
            load_kernels(links, positions=plan is not None)
        opened = open_until_stopped(source, registry, stopped)
        if not opened.live and opened.size_bytes is not None:
            opened = ReplaySource(opened)
        with opened:
            url = _source_name(source, opened)
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
                on_fix=lambda placed: publisher.publish("fix", placed.fix.t_us, placed),
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
                ends = loop.close, _ignore_progress, stopped, loop.summary
                table = _run_to_end(opened, url, receiver, writer, loop.run(stopped), *ends)
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
    advance: Advance = _ignore_progress,
    stopped: Stopped = never_stop,
) -> dict[str, Any]:
    """Write events and triggers of a source into a recording, in constant memory.

    `source` and `registry` are those of `receive`, the recording `out` and its `format` those of
    `open_writer`; `size` is the sensor's, (columns, rows), where the source does not have it. `advance` gets
    the progress; `stopped` ends the run early: of a camera or a stream, all until then is written, of a
    recording nothing.

    Returns:
        Counts of what was written, losses of the source, `error`: the fault that ended the reading, or None,
        and whether a camera was unplugged.

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
                if not any(counts.values()):
                    raise
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


def _run_to_end(
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
    """Receive a source until it ends, is stopped or fails; return the summary."""
    status: Status = "complete"
    error = None
    broken: PluginError | WorkerError | None = None
    packet_count = 0
    pieces = iter(pieces)
    span, watch = Span(), Stopwatch()
    with watch.measure():
        try:
            while True:
                try:
                    events, packets = next(pieces)
                except StopIteration:
                    break
                except (PluginError, WorkerError) as fault:
                    if not packet_count and not receiver.pending_packets:
                        raise
                    # Earlier results are kept; the receiver has no more.
                    writer.write(receiver.pending_packets)
                    status, error, broken = "failed", str(fault), fault
                    break
                if len(events):
                    span.add(events)
                    writer.events(events)
                writer.write(packets)
                packet_count += len(packets)
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
    if status == "complete" and (reason := _describe_losses(source, receiver)):
        status, error = "degraded", f"{url}: {reason}"
    end = RunEnd(
        status,
        **_build_tables(source, url, watch, span),
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


def _build_tables(source: EventSource, url: str, watch: Stopwatch, span: Span) -> dict[str, dict[str, Any]]:
    recording = summarize_source(source, url, span)
    recording |= {"guessed": source.guessed, "step_us": source.step_us}
    duration_s = recording["duration_s"]
    processing = {
        "processor_s": round(watch.processor_s, 6),
        "elapsed_s": round(watch.elapsed_s, 6),
        "kernels_s": round(watch.kernels_s, 6),
        "events_per_s": round(source.counts["events"] / watch.processor_s),
        "times_real_time": round(times_real_time(duration_s, watch.processor_s), 3) if duration_s else None,
    }
    return {"recording": recording, "processing": processing}


def _describe_losses(source: EventSource, receiver: Receiver) -> str | None:
    """What was dropped of a recording, where that is too much for a complete result; else None."""
    lost = sum(loss.count for loss in source.losses.values())
    dropped = lost + sum(n for name, n in receiver.counts.items() if name.startswith("dropped_"))
    share = dropped / max(source.counts["events"] + lost, 1)
    if dropped < _MIN_DEGRADED or share <= _DEGRADED_SHARE:
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
    advance: Advance = _ignore_progress,
) -> dict[str, Any]:
    """Film a recording in slow motion, with regions, symbols and distances drawn in; in bounded memory.

    The recording is read twice: to decode it until the end of the film, and for the events.

    The film, `out`, is an animated picture, `.webp` or `.gif`, or `.mp4`. It starts `from_ms` after the first
    event, or with the first decoded frame, or at the start where there is none; it shows `for_ms` of the
    recording, slowed down by `slow`, in pictures of `longest_px`, and the bars only, or the `whole` image.
    `advance` gets the progress; other arguments are those of `receive`.

    Returns:
        A table of the film: pictures, their size, time, transmitters, frames.

    Raises:
        InputError: The recording cannot be read, or has no events there.
        ConfigError: The film would have too many pictures, or its format is unknown or needs an extra that
            is not installed.
        OutputError: It cannot be written.
    """
    # Imported here: Matplotlib and Pillow are slow to import.
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
        if source.size_bytes is None:
            raise ConfigError(f"{recording}: a film needs a file: it reads the recording twice")
        check_sensor(source, recording, camera)
        footage = gather_footage(source, str(recording), links, registry, from_ms, for_ms * 1e3, advance)
    plan = plan_film(footage, for_ms * 1e3, slow, camera, longest_px, whole=whole)
    with open_source(recording, registry) as source:
        drawn = list(draw_film(plan, source.chunks(), footage, links))
    with Outputs() as outputs, writing(out):
        save_film(drawn, outputs.path(out), kind)
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
