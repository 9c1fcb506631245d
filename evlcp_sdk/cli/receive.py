"""`evlcp receive`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._command import command
from evlcp_sdk.cli._common import Dask, make_executor, print_json, progress_bar, silence_matplotlib
from evlcp_sdk.cli._receiving import (
    CameraOptions,
    Cores,
    LinePrinter,
    LinkOptions,
    PlaceOptions,
    ResultOptions,
)
from evlcp_sdk.cli._stderr import print_stderr
from evlcp_sdk.cli._summary import print_end
from evlcp_sdk.errors import DEGRADED, InputError, InterruptedRunError, OutputError
from evlcp_sdk.signals import EndRequest, stop_on_request


@dataclass(frozen=True)
class ReceiveJob:
    """One recording, the folder of its result, and its link if it has one of its own."""

    url: str
    folder: Path | None
    link: sdk.resolve.Link | None = None


@command
def receive(
    *,
    recordings: Annotated[
        list[str], typer.Argument(metavar="REC...", help="Recordings; - for RAW on stdin.")
    ],
    link: LinkOptions,
    link_mode: Annotated[
        Literal["given", "auto"],
        typer.Option("--link", show_default=False, help="auto: what fits best, or one LED."),
    ] = "given",
    strict: Annotated[
        bool, typer.Option("--strict", hidden=True, help="End with 1 where there are warnings.")
    ] = False,
    result: ResultOptions,
    workers: Annotated[
        int, typer.Option(min=0, metavar="N", show_default=False, help="Processes for many recordings.")
    ] = 0,
    cores: Cores = 1,
    dask: Dask = None,
    place: PlaceOptions,
    camera: CameraOptions,
) -> None:
    """Decode recordings: symbols and distances into OUT.

    One recording:      [bold]evlcp receive REC.raw -o out[/]
    A page to look at:  [bold]evlcp receive REC.raw -o out --report[/]
    Settings unknown:   [bold]evlcp receive REC.raw -o out --link auto[/]
    Your own link:      [bold]evlcp receive REC.raw -o out -c link.toml[/]
    As it comes:        [bold]CAMERA | evlcp receive - --json-lines -[/]
    Several recordings: [bold]evlcp receive *.raw -o out --workers 2[/]
    Positions:          [bold]evlcp receive REC.raw -o out --sites site.toml[/]

    OUT gets frames.csv (a row a frame), packets.jsonl (a line a packet or message) and summary.json; with
    --sites fixes.csv, track.csv, fixes.geojson and fixes.nmea, too. An earlier result there is replaced.
    """
    lines = result.make_line_printer(recordings)
    jobs = _make_jobs(recordings, result.out, lines)
    links = link.load()
    if link_mode == "auto":
        if len(links) > 1:
            raise typer.BadParameter("varies one link: give one -c, or none", param_hint="--link")
        jobs = [_infer_job_link(job, links[0]) for job in jobs]
    plan = place.plan(links, mcap=result.mcap)
    sinks = result.load_sink_names(positions=plan is not None)
    decode = partial(
        _decode,
        links=links,
        clock=partial(camera.clock, place),
        lines=lines,
        plan=plan,
        attitude=camera.attitude(place),
        sinks=sinks,
        workers=cores,
    )
    in_process = dask is None and (not workers or len(jobs) == 1)
    if lines is not None and not in_process:
        raise typer.BadParameter("are given by this process only", param_hint="--json-lines")
    executor = make_executor(0 if in_process else workers or None, dask)
    outcomes = _run_jobs(jobs, decode, executor, result, lines, in_process=in_process)
    raise typer.Exit(_exit_code(outcomes, strict=strict) or int(lines is not None and lines.failed))


def _run_jobs(
    jobs: Sequence[ReceiveJob],
    decode: Callable[..., dict[str, Any]],
    executor: sdk.jobs.Executor,
    result: ResultOptions,
    lines: LinePrinter | None,
    *,
    in_process: bool,
) -> list[sdk.jobs.Outcome[ReceiveJob, dict[str, Any]]]:
    """Decode all, in this process or in workers; print how each ended.

    Raises:
        InterruptedRunError: The user has ended it.
    """
    outcomes: list[sdk.jobs.Outcome[ReceiveJob, dict[str, Any]]] = []
    with (
        stop_on_request(sdk.jobs.stop_workers) as stopped,
        # In this process, each recording has a bar of its own.
        nullcontext() if in_process else progress_bar("recordings") as advance,
        ExitStack() as stack,
    ):
        run = partial(decode, stopped=stopped if in_process else None)
        due = takewhile(lambda _: not stopped(), jobs)
        for outcome in stack.enter_context(closing(executor.run(run, due))):
            outcomes.append(outcome)
            if advance is not None:
                advance(len(outcomes), len(jobs))
            if outcome.value is None:
                _print_failure(outcome, as_json=result.as_json)
            else:
                print_end(outcome.value, outcome.job.folder, lines, as_json=result.as_json)
        if stopped():
            ended = [one.job.folder for one in outcomes if one.value and one.value["status"] == "interrupted"]
            folder = ended[0] if len(ended) == 1 else result.out
            where = "was printed" if folder is None else f"is in {folder}"
            raise InterruptedRunError(f"interrupted; what was decoded until then {where}")
    return outcomes


def _print_failure(outcome: sdk.jobs.Outcome[ReceiveJob, dict[str, Any]], *, as_json: bool) -> None:
    message = outcome.fault.message if outcome.fault else "no result"
    print_stderr(message)
    if as_json:
        print_json({"status": "failed", "error": message, "recording": {"path": outcome.job.url}})


def _exit_code(outcomes: Sequence[sdk.jobs.Outcome[ReceiveJob, dict[str, Any]]], *, strict: bool) -> int:
    """The code of the worst failure; else of a recording of which much was dropped, or of a warning."""
    failures = [one.fault.exit_code for one in outcomes if one.fault is not None]
    summaries = [one.value for one in outcomes if one.value is not None]
    statuses = [summary["status"] for summary in summaries]
    if "failed" in statuses:
        failures.append(InputError.exit_code)
    has_warnings = any(summary["warnings"] for summary in summaries)
    return max(failures, default=0) or DEGRADED * ("degraded" in statuses) or int(strict and has_warnings)


def _infer_job_link(job: ReceiveJob, link: sdk.resolve.Link) -> ReceiveJob:
    """Give a job the link that fits its recording best, and print it."""
    if job.url == sdk.open.STDIN:
        raise typer.BadParameter(
            "standard input is read once, and links are tried on it first", param_hint="--link"
        )
    with sdk.open.open_source(job.url) as source:
        trials = sdk.diagnose.infer_link(source, link)
    best = trials[0]
    name, due = Path(job.url).name, best.frames + best.rejected
    for explanation in dict.fromkeys(one.explanation for one in trials if one.explanation):
        print_stderr(f"{name}: {explanation}")
    if not best.fits:
        print_stderr(
            f"{name}: no link that was tried fits, so the one given is taken; see evlcp diagnose {name}"
        )
        return job
    print_stderr(f"{name}: link {best.options() or 'as given'}, {best.frames} of {due} frames accepted")
    return replace(job, link=best.link)


def _decode(
    job: ReceiveJob,
    *,
    stopped: EndRequest | None,
    links: tuple[sdk.resolve.Link, ...],
    clock: Callable[[], datetime | sdk.utc.PulseClock | None],
    lines: LinePrinter | None,
    **options: Any,
) -> dict[str, Any]:
    """Decode a recording with a bar until `stopped`, or quietly in a worker; return its summary."""
    run = partial(
        sdk.run.receive_to_folder, job.url, job.folder, job.link or links, clock_zero=clock(), **options
    )
    if stopped is not None:
        stop = stopped.or_when(lambda: job.folder is None and lines is not None and lines.closed)
        with progress_bar(_source_name(job.url), by_bytes=True) as advance:
            return run(lines=lines, advance=advance, stopped=stop)
    silence_matplotlib()
    # A terminal sends Ctrl-C to workers, too.
    with stop_on_request() as stop:
        return run(stopped=stop)


def _source_name(url: str) -> str:
    return "standard input" if url == sdk.open.STDIN else Path(url).name


def _make_jobs(recordings: Sequence[str], out: Path | None, lines: LinePrinter | None) -> list[ReceiveJob]:
    if sdk.open.STDIN in recordings and len(recordings) > 1:
        raise typer.BadParameter("standard input is received by itself", param_hint="REC...")
    if out is None:
        if lines is None:
            raise typer.BadParameter("give -o OUT, or --json-lines -", param_hint="--out")
        return [ReceiveJob(recordings[0], None)]
    if len(recordings) == 1:
        return [ReceiveJob(recordings[0], out)]
    jobs = [ReceiveJob(url, out / _stem(url)) for url in recordings]
    folders = [job.folder for job in jobs]
    for job in jobs:
        fault = ""
        if _stem(job.url) in ("", ".", ".."):
            fault = f"{job.url}: gives no name of a folder in {out}; receive it by itself"
        elif folders.count(job.folder) > 1:
            fault = f"two recordings would both be written to {job.folder}; receive them one by one"
        if fault:
            raise typer.BadParameter(fault, param_hint="REC...")
        # The user has named OUT, but nothing in it.
        if job.folder is not None and job.folder.is_symlink():
            raise OutputError(f"{job.folder}: cannot be written: it is a link, which may lead out of {out}")
    return jobs


def _stem(url: str) -> str:
    """A recording's name without its suffixes: `night.csv.gz` gives `night`."""
    name = Path(url).name
    return name.removesuffix(".gz").rsplit(".", 1)[0] or name
