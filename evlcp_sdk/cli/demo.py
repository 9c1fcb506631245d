"""`evlcp demo`."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._campaign import print_faults, show_progress
from evlcp_sdk.cli._common import Json, Workers, console, make_executor, print_json, progress_bar
from evlcp_sdk.cli._summary import print_summary
from evlcp_sdk.cli._tables import print_table

CAMPAIGN_NAME = "demo"

_WARM_UP_S = 0.06
"""Length of a first run that compiles the kernels: a packet at least."""


def demo_campaign() -> Path:
    """The demo's campaign: in the wheel, or in a checkout's `examples/campaigns`."""
    return sdk.files.find_shipped_file("campaigns", f"{CAMPAIGN_NAME}.toml")


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT", help="Folder of the result.")] = Path(
        "demo-out"
    ),
    recording: Annotated[
        bool, typer.Option("--recording", help="Decode the recording that comes with the package instead.")
    ] = False,
    workers: Workers = None,
    as_json: Json = False,
) -> None:
    """Simulate a drive, receive it, and compare with the paper.

    Four stretches at 30 km/h:            [bold]evlcp demo[/] or [bold]evlcp demo -o somewhere[/]
    A shipped recording, frame by frame:  [bold]evlcp demo --recording[/]
    """
    if recording:
        _decode_recording(out, as_json)
    else:
        _simulate_drive(out, workers, as_json)


def _simulate_drive(out: Path, workers: int | None, as_json: bool) -> None:
    plan = sdk.task.plan_campaign(demo_campaign())
    if not as_json:
        console().print(f"simulating and receiving {len(plan.jobs)} stretches of a drive ...", style="dim")
    with sdk.files.writing(out):
        out.mkdir(parents=True, exist_ok=True)
    results = out / f"{CAMPAIGN_NAME}.sqlite"
    for name in (results, *(results.with_name(results.name + end) for end in ("-wal", "-shm"))):
        name.unlink(missing_ok=True)
    with sdk.store.Store(results, create=True) as store:
        with progress_bar(plan.name) as advance:
            # Compile here, once and visibly, rather than in each worker.
            job = plan.jobs[0]
            sdk.task.run_job(replace(job, scene=replace(job.scene, duration_s=_WARM_UP_S)))
            progress = sdk.collect.collect_results(
                plan, store, make_executor(workers, None), sdk.task.run_job, partial(show_progress, advance)
            )
        summary = sdk.summary.summarize(store)
    print_faults(progress)
    if progress.faults:
        raise typer.Exit(max(fault.exit_code for _, fault in progress.faults))
    with sdk.files.Outputs() as outputs:
        sdk.drawing.save_plots(sdk.report.draw_charts(summary), summary.plan.name, out, outputs)
        outputs.write_text(sdk.report.render_campaign(summary), out / "report.html")
    if as_json:
        print_json(summary.to_dict())
        return
    print_drive(summary)
    console().print(
        f"written: {results}, {out}/report.html for a browser, and a picture: {out}/rmse.png", style="dim"
    )


def print_drive(summary: sdk.summary.Summary) -> None:
    """Print bits, BER with 95 % confidence and RMSE of each segment of distance, and the paper's."""
    (series,) = summary.series
    paper = {
        (c.reference.measure, begin): (
            f"{'≤ ' if c.reference.bound else ''}{c.reference.value:g}",
            "as good" if c.verdict == "agrees" else c.verdict,
        )
        for c in sdk.summary.compare_with_paper([series])
        for begin in range(c.reference.from_m, c.reference.to_m, sdk.tally.SEGMENT_M)
    }
    rows = []
    for begin, recordings in reversed(series.segments):
        tally = sdk.tally.Tally.sum(recordings)
        ber, rmse = (
            sdk.intervals.measure_figure(recordings, "ber"),
            sdk.intervals.measure_figure(recordings, "rmse_m"),
        )
        bits, metres = (paper.get((kind, begin), ("-", "-")) for kind in ("ber", "rmse_m"))
        rows.append(
            (
                f"{begin} to {begin + sdk.tally.SEGMENT_M} m",
                f"{tally.frames_found} of {tally.frames_sent}",
                f"{tally.bit_errors} of {tally.bits}",
                f"≤ {ber.high:.2g}" if ber.count else "-",
                bits[0],
                f"{rmse.value:.3f}" if rmse.count else "-",
                metres[0],
                f"{bits[1]}, {metres[1]}",
            )
        )
    head = ("distance", "frames", "wrong bits", "BER, 95 %", "paper", "RMSE, m", "paper", "bits, metres")
    print_table(console(), head, rows)


def _decode_recording(out: Path, as_json: bool) -> None:
    # In the wheel, or in a checkout's examples/recordings.
    recording = sdk.files.find_shipped_file("recordings", "night-50m-30kmh-cut.raw")
    if not as_json:
        console().print(f"decoding {recording.name} ...", style="dim")
    summary = sdk.run.receive_to_folder(recording, out, sinks=["figures"])
    # The written rows, as `evlcp score` reads them.
    score = sdk.score.score_frames(
        sdk.frames.read_frames(out), sdk.truth.read_truth(sdk.truth.truth_path(recording))
    )
    if as_json:
        print_json(summary | {"score": score})
        return
    _print_frames(out / "frames.csv")
    print_summary(summary, out)
    _print_score(score)


def _print_score(score: Mapping[str, Any]) -> None:
    (bar,) = score["bars"]
    rmse = "-" if bar["rmse_m"] is None else f"{bar['rmse_m']:.3f} m"
    console().print(
        f"against the truth: {bar['frames_found']} of {bar['frames_sent']} frames found,"
        f" {score['unmatched']} false, {bar['bit_errors']} of {bar['bits']} bits wrong, distance RMSE {rmse}"
    )


def _print_frames(file: Path) -> None:
    rows = []
    with file.open(newline="") as lines:
        for row in csv.DictReader(lines):
            distance_m, sigma_m = row["distance_m"], row["distance_sigma_m"]
            sigma = f"{float(sigma_m):.2f}" if sigma_m else "?"
            rows.append(
                (
                    f"{row['packet']}/{row['frame']}",
                    f"{float(row['t_us']) / 1e3:.1f}",
                    " ".join(f"{symbol:>2}" for symbol in row["symbols"].split()),
                    f"{float(distance_m):.2f} ± {sigma}" if distance_m else "-",
                )
            )
    print_table(console(), ("frame", "ms", "symbols of clusters 0 to 15", "distance, m"), rows, names=0)
