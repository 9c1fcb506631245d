"""`evlcp receive`."""

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evlcp_sdk.cli._common import Dask, LinkFile, Overrides, complain, console, make_executor
from evlcp_sdk.errors import InputError, InterruptedRunError

if TYPE_CHECKING:
    from evlcp_sdk.link.resolve import Link
    from evlcp_sdk.results.positions import PositionPlan
    from evlcp_sdk.values import Packet

__all__ = ["bytes_bar", "decode", "register", "show"]

Advance = Callable[[int, int | None], None]
"""Told, after each piece, how many bytes are done, and of how many if that is known."""


@dataclass(frozen=True)
class Job:
    """One recording and the folder that its result goes to."""

    url: str
    folder: Path


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("receive")(receive)


def receive(
    recordings: Annotated[
        list[str], typer.Argument(metavar="REC...", help="Recordings, or what a plugin can open.")
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="OUT", help="Folder of the result; made if need be.")
    ],
    link_file: LinkFile = None,
    overrides: Overrides = None,
    as_json: Annotated[bool, typer.Option("--json", help="Each summary as one line of JSON.")] = False,
    figures: Annotated[
        bool, typer.Option("--figures", help="Draw regions.png, presence.png, distance.png, track.png.")
    ] = False,
    parquet: Annotated[bool, typer.Option("--parquet", help="Also write frames.parquet.")] = False,
    workers: Annotated[
        int, typer.Option("--workers", min=0, metavar="N", help="Processes for many recordings; 0: this one.")
    ] = 0,
    dask: Dask = None,
    sites: Annotated[
        Path | None,
        typer.Option("--sites", metavar="site.toml", help="Where the bars stand: compute positions."),
    ] = None,
    attitude: Annotated[
        Path | None, typer.Option("--attitude", metavar="FILE.csv", help="The camera's attitude over time.")
    ] = None,
    heading_deg: Annotated[
        float | None, typer.Option("--heading-deg", help="Its heading, clockwise from north, if known.")
    ] = None,
    pitch_deg: Annotated[float | None, typer.Option("--pitch-deg", help="Its pitch, up.")] = None,
    roll_deg: Annotated[float | None, typer.Option("--roll-deg", help="Its roll, top to the right.")] = None,
    heading_sigma_deg: Annotated[
        float,
        typer.Option(
            "--heading-sigma-deg", min=0, help="Standard deviation of the heading, unless a file tells it."
        ),
    ] = 0.5,
    gravity_sigma_deg: Annotated[
        float, typer.Option("--gravity-sigma-deg", min=0, help="The same of pitch and roll.")
    ] = 0.1,
    clock_zero: Annotated[
        str | None,
        typer.Option("--clock-zero", metavar="UTC", help="UTC of the camera clock's 0, for NMEA and MCAP."),
    ] = None,
    mcap: Annotated[bool, typer.Option("--mcap", help="Also write fixes.mcap, for Foxglove.")] = False,
) -> None:
    """Decode recordings: symbols and distances into OUT.

    One recording:       [bold]evlcp receive REC.raw -o out[/]

    With figures:        [bold]evlcp receive REC.raw -o out --figures[/]

    Another profile:     [bold]evlcp receive REC.raw -o out --set modulation.id=wh8[/]

    Your own link:       [bold]evlcp receive REC.raw -o out -c link.toml[/]

    Several recordings:  [bold]evlcp receive a.raw b.raw -o out[/] writes out/a and out/b

    Two at a time:       [bold]evlcp receive *.raw -o out --workers 2[/]

    Positions, with the camera level and looking north: [bold]evlcp receive REC.raw -o out --sites site.toml
    --heading-deg 0 --pitch-deg 0 --roll-deg 0[/]

    Positions, with an IMU's log: [bold]evlcp receive REC.raw -o out --sites site.toml --attitude imu.csv[/]

    OUT gets frames.csv (a row a frame), packets.jsonl (a line a packet or message) and summary.json.
    With --sites it gets fixes.csv, track.csv, fixes.geojson and fixes.nmea, too.
    An earlier result there is replaced when the new one is complete.
    """
    import json

    from evlcp_sdk.link.resolve import load_link
    from evlcp_sdk.plugin.registry import Registry

    jobs = _jobs(recordings, out)
    link = load_link(link_file, overrides or [], Registry.load())
    angles = (heading_deg, pitch_deg, roll_deg)
    plan = _position_plan(sites, attitude, angles, (gravity_sigma_deg, heading_sigma_deg), clock_zero, mcap)
    here = dask is None and (not workers or len(jobs) == 1)
    executor = make_executor(0 if here else workers or None, dask)
    worst = 0
    interrupted: list[Path] = []
    with _stop_on_request() as stopped, _recordings_bar(0 if here else len(jobs)) as count:
        run = partial(
            _decode_job,
            link=link,
            figures=figures,
            parquet=parquet,
            plan=plan,
            stopped=stopped if here else None,
        )
        for outcome in executor.run(run, _until(stopped, jobs)):
            count()
            job, summary, fault = outcome.job, outcome.value, outcome.fault
            if summary is None:
                message = fault.message if fault else "no result"
                complain(f"{fault.trace}{message}" if fault else message)
                worst = max(worst, fault.exit_code if fault else 1)
                if as_json:
                    failed = {"status": "failed", "error": message, "recording": {"path": job.url}}
                    typer.echo(json.dumps(failed))
                continue
            if as_json:
                typer.echo(json.dumps(summary))
            else:
                show(summary, job.folder)
            if summary["status"] == "failed":
                complain(summary["error"])
                worst = max(worst, InputError.exit_code)
            if summary["status"] == "interrupted":
                interrupted.append(job.folder)
        if stopped():
            folder = interrupted[0] if len(interrupted) == 1 else out
            raise InterruptedRunError(f"interrupted; what was decoded until then is in {folder}")
    raise typer.Exit(worst)


def _position_plan(
    sites: Path | None,
    file: Path | None,
    angles: tuple[float | None, float | None, float | None],
    sigmas: tuple[float, float],
    clock_zero: str | None,
    mcap: bool,
) -> "PositionPlan | None":
    """What the options say of positions; None without sites."""
    heading, pitch, roll = angles
    if sites is None:
        given = {"--attitude": file, "--heading-deg": heading, "--pitch-deg": pitch, "--roll-deg": roll}
        for name, value in (given | {"--clock-zero": clock_zero, "--mcap": mcap or None}).items():
            if value is not None:
                raise typer.BadParameter("needs --sites", param_hint=name)
        return None
    import math
    from datetime import UTC, datetime

    from evlcp_sdk.results.positions import PositionPlan
    from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
    from evlcp_sdk.scene.sites import load_sites

    if file is not None and angles != (None, None, None):
        raise typer.BadParameter("give a file or angles, not both", param_hint="--attitude")
    if (pitch is None) != (roll is None) or (heading is not None and pitch is None):
        raise typer.BadParameter(
            "gravity needs --pitch-deg and --roll-deg; a heading needs gravity", param_hint="--pitch-deg"
        )
    names = ("--heading-deg", "--pitch-deg", "--roll-deg", "--gravity-sigma-deg", "--heading-sigma-deg")
    for name, given_deg in zip(names, (*angles, *sigmas), strict=True):
        if given_deg is not None and not math.isfinite(given_deg):
            raise typer.BadParameter(f"{given_deg}: expected a finite number", param_hint=name)
    attitude: AttitudeLog | Attitude | None = None
    if file is not None:
        attitude = AttitudeLog.read(file, Attitude(0.0, 0.0, None, *sigmas))
    elif pitch is not None and roll is not None:
        attitude = Attitude(pitch, roll, heading, *sigmas)
    zero = None
    if clock_zero is not None:
        try:
            zero = datetime.fromisoformat(clock_zero)
        except ValueError as fault:
            text = f"{clock_zero!r}: expected a time such as 2026-03-01T10:15:00Z"
            raise typer.BadParameter(text, param_hint="--clock-zero") from fault
        zero = zero if zero.tzinfo is not None else zero.replace(tzinfo=UTC)
        # MCAP counts from 1970 on, and NMEA has two digits of the year.
        if not datetime(1970, 1, 1, tzinfo=UTC) <= zero < datetime(2200, 1, 1, tzinfo=UTC):
            raise typer.BadParameter(f"{clock_zero!r}: expected 1970 to 2199", param_hint="--clock-zero")
    return PositionPlan(load_sites(sites), attitude, zero, mcap)


def _decode_job(
    job: Job,
    *,
    link: "Link",
    figures: bool,
    parquet: bool,
    plan: "PositionPlan | None",
    stopped: Callable[[], bool] | None,
) -> dict[str, Any]:
    """Decode a recording here, with a bar; or, without `stopped`, quietly in a worker."""
    extras: dict[str, Any] = {"figures": figures, "parquet": parquet, "plan": plan}
    if stopped is not None:
        with bytes_bar(Path(job.url).name) as advance:
            return decode(job.url, job.folder, link, advance, stopped, **extras)
    # A terminal sends Ctrl-C to workers, too; only a main thread can listen to it.
    main = threading.current_thread() is threading.main_thread()
    listening: AbstractContextManager[Callable[[], bool]]
    listening = _stop_on_request() if main else nullcontext(lambda: False)
    with listening as asked:
        return decode(job.url, job.folder, link, lambda _a, _b: None, asked, **extras)


def _until(stopped: Callable[[], bool], jobs: Sequence[Job]) -> Iterator[Job]:
    for job in jobs:
        if stopped():
            return
        yield job


def decode(
    url: str,
    folder: Path,
    link: "Link",
    advance: Advance,
    stopped: Callable[[], bool],
    *,
    figures: bool = False,
    parquet: bool = False,
    plan: "PositionPlan | None" = None,
) -> dict[str, Any]:
    """Decode one recording into a folder, in constant memory.

    Args:
        url: The recording.
        folder: Where the result goes.
        link: The configuration.
        advance: Told how far the reading is.
        stopped: Asked after every piece whether to end early.
        figures: Draw the figures.
        parquet: Write Parquet, too.
        plan: What positions are computed from; None for none.

    Returns:
        The summary; its `status` is `failed` when the recording cannot be read on.

    Raises:
        InputError: The recording cannot be opened; nothing is written.
        ConfigError: The recording's sensor is not the link's, or the folder cannot be written.
    """
    from numba.core.event import install_timer

    from evlcp_sdk.io.open import open_source
    from evlcp_sdk.io.sensor import check_sensor
    from evlcp_sdk.plugin.registry import Registry
    from evlcp_sdk.results.outputs import ResultWriter, Status
    from evlcp_sdk.rx.receiver import Receiver

    compiled_s: list[float] = []
    probes: list[Any] = []
    if figures:
        from evlcp_sdk.results.figures import FigureProbe

        probes.append(FigureProbe(link.camera))
    tracks = []
    if figures and plan is not None:
        from evlcp_sdk.results.figures import TrackProbe

        tracks.append(TrackProbe())
    registry = Registry.load(*probes)
    with open_source(url, registry) as source:
        check_sensor(source, url, link.camera)
        with ResultWriter(folder, link, parquet=parquet) as writer, ExitStack() as closing:
            receiver = Receiver(link, registry.hook)
            positions = None
            if plan is not None:
                from evlcp_sdk.results.positions import PositionWriter

                positions = closing.enter_context(PositionWriter(folder, link, plan, tracks))

            def write(packets: list["Packet"]) -> None:
                writer.write(packets)
                if positions is not None:
                    positions.write(packets)

            status: Status = "complete"
            error = None
            first_us = last_us = None
            began = time.perf_counter()
            with install_timer("numba:compile", compiled_s.append):
                try:
                    for events in source.chunks():
                        first_us = int(events.t_us[0]) if first_us is None else first_us
                        last_us = int(events.t_us[-1])
                        for probe in probes:
                            probe.watch(events)
                        write(receiver.feed(events))
                        advance(source.position_bytes, source.size_bytes)
                        if stopped():
                            status = "interrupted"
                            break
                except InputError as fault:
                    status, error = "failed", str(fault)
                write(receiver.close())
            # Kernels are compiled once on a machine, which says nothing of the receiver's speed.
            elapsed_s = time.perf_counter() - began - sum(compiled_s)
            read = source.counts["events"]
            duration_s = (last_us - first_us) * 1e-6 if first_us is not None and last_us is not None else 0.0
            summary = writer.finish(
                status,
                recording={
                    "path": url,
                    "format": source.format,
                    "bytes": source.size_bytes,
                    "width": source.width,
                    "height": source.height,
                    "first_us": first_us,
                    "last_us": last_us,
                    "duration_s": round(duration_s, 6),
                    "events_per_s": round(read / duration_s) if duration_s else None,
                    "counts": dict(source.counts),
                },
                processing={
                    "elapsed_s": round(elapsed_s, 6),
                    "compiled_s": round(sum(compiled_s), 6),
                    "events_per_s": round(read / elapsed_s),
                    "times_real_time": round(duration_s / elapsed_s, 3),
                },
                counts=receiver.counts,
                losses={kind: asdict(loss) for kind, loss in source.losses.items()},
                versions=registry.versions(),
                error=error,
                positions=positions.finish() if positions is not None else None,
            )
    if figures:
        from evlcp_sdk.results.figures import save_figures

        for probe in probes:
            save_figures(probe, Path(url).name, folder)
    for track in tracks:
        from evlcp_sdk.results.figures import save_track

        assert positions is not None
        save_track(track, positions.bars_enu_m(), Path(url).name, folder / "track.png")
    return summary


def show(summary: dict[str, Any], folder: Path, *, speed: bool = True) -> None:
    """Print what was found, what was lost, where the result is, and how fast it went."""
    from rich.markup import escape
    from rich.table import Table

    out = console()
    recording, processing = summary["recording"], summary["processing"]
    out.print(f"[bold]{escape(Path(recording['path']).name)}[/]: {summary['result']}")
    if summary["transmitters"]:
        table = Table(box=None, pad_edge=False, header_style="dim")
        for name in ("transmitter", "frames", "quality", "clock", "distance"):
            table.add_column(name, justify="right")
        for t in summary["transmitters"]:
            table.add_row(
                str(t["transmitter"]),
                f"{t['frames_found']} of {t['frames_expected']}",
                _or_dash(t["quality"], "{:.2f}"),
                _or_dash(t["clock_ppm"], "{:+.0f} ppm"),
                _or_dash(t["distance_first_m"], "{:.2f}")
                + " to "
                + _or_dash(t["distance_last_m"], "{:.2f} m"),
            )
        out.print(table)
    if text := _messages(summary["counts"]):
        out.print(text)
    if "positions" in summary:
        out.print(_positions(summary["positions"]))
    if speed:
        out.print(
            f"{recording['counts']['events'] / 1e6:.2f} Mev of {recording['duration_s']:.3f} s"
            f" in {processing['elapsed_s']:.2f} s:"
            f" {processing['events_per_s'] / 1e6:.1f} Mev/s, {processing['times_real_time']:.2f} x real time"
        )
        if processing["compiled_s"] > 1:
            out.print(f"kernels compiled, once for all, in {processing['compiled_s']:.0f} s", style="dim")
    for loss in summary["losses"].values():
        out.print(
            f"lost: {loss['count']} {loss['meaning']} (first at {loss['unit']} {loss['first']})",
            style="yellow",
        )
    out.print(f"written: {escape(str(folder))}/frames.csv, packets.jsonl, summary.json", style="dim")


def _positions(told: Mapping[str, Any]) -> str:
    """How many positions there are, and why not more, in one line."""
    text = f"{told['fixes']} position{'s' * (told['fixes'] != 1)}"
    if told["fixes_verified"]:
        text += f", {told['fixes_verified']} verified"
    for kind, number in told["refused"].items():
        text += f"; {number} refused: {kind}"
    for how in told["sites_contradicted"].values():
        text += f"; left out: {how}"
    return text


def _messages(counts: Mapping[str, int]) -> str:
    """What was read of messages, in one line; empty where there was nothing to read."""
    if not counts.get("blocks_decoded", 0) + counts.get("blocks_combined", 0):
        return ""
    number = counts["messages"]
    text = f"{number} message{'s' * (number != 1)}"
    trusts = {t: counts[f"beacons_{t}"] for t in ("verified", "unverified", "forged")}
    if any(trusts.values()):
        text += f"; beacons told {', '.join(f'{n} times {t}' for t, n in trusts.items() if n)}"
    for key, lost in (
        ("blocks_failed", "packets not readable"),
        ("blocks_other_codebook", "packets of another codebook"),
        ("blocks_malformed", "packets with no block of this format"),
        ("parts_missing", "parts missing"),
        ("messages_undecodable", "messages without meaning"),
    ):
        if counts[key]:
            text += f"; {counts[key]} {lost}"
    return text


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def _jobs(recordings: Sequence[str], out: Path) -> list[Job]:
    if len(recordings) == 1:
        return [Job(recordings[0], out)]
    jobs = [Job(url, out / _stem(url)) for url in recordings]
    folders = [job.folder for job in jobs]
    for job in jobs:
        if folders.count(job.folder) > 1:
            raise typer.BadParameter(
                f"two recordings would both be written to {job.folder}; receive them one by one",
                param_hint="REC...",
            )
    return jobs


def _stem(url: str) -> str:
    """The recording's name without its kind: `night.csv.gz` gives `night`."""
    name = Path(url).name
    return name.removesuffix(".gz").rsplit(".", 1)[0] or name


@contextmanager
def bytes_bar(name: str) -> Iterator[Advance]:
    """A bar by bytes read, on a terminal only."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    err = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextmanager
def _recordings_bar(number: int) -> Iterator[Callable[[], None]]:
    """A bar by recordings, on a terminal only; none for 0."""
    from rich.console import Console
    from rich.progress import Progress

    err = Console(stderr=True)
    with Progress(console=err, transient=True, disable=not (number and err.is_terminal)) as bar:
        task = bar.add_task("recordings", total=number)
        yield lambda: bar.advance(task)


@contextmanager
def _stop_on_request() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C end the run after the piece in hand; a second one ends it at once."""
    asked = False

    def ask(_number: int, _frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)
