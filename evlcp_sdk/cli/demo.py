"""`evlcp demo`."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from evlcp_sdk.cli._common import Json, Workers, console

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from evlcp_sdk.study.campaign.summary import Summary

__all__ = ["Score", "demo", "demo_campaign", "demo_files", "register", "score"]

DEMO_NAME = "night-50m-30kmh-cut"
CAMPAIGN_NAME = "demo"


@dataclass(frozen=True)
class Score:
    """Decoded frames held against the truth.

    Attributes:
        found: Frames decoded, of those sent.
        sent: Frames sent.
        unmatched: Rows that fit no sent frame.
        bit_errors: Wrong bits of the found frames.
        bits: Bits of the found frames.
        rmse_m: Root mean square error of distance, m; NaN without any.
    """

    found: int
    sent: int
    unmatched: int
    bit_errors: int
    bits: int
    rmse_m: float


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("demo")(demo)


def demo_files() -> tuple[Path, Path]:
    """The demo's recording and its truth: in the wheel, or in a checkout's `examples/recordings`."""
    raw = _shipped("recordings", f"{DEMO_NAME}.raw")
    return raw, raw.with_name(f"{DEMO_NAME}.truth.json")


def demo_campaign() -> Path:
    """The demo's campaign: in the wheel, or in a checkout's `examples/campaigns`."""
    return _shipped("campaigns", f"{CAMPAIGN_NAME}.toml")


def _shipped(folder: str, name: str) -> Path:
    import evlcp_sdk

    package = Path(evlcp_sdk.__file__).parent
    for path in (package / "data" / name, package.parent / "examples" / folder / name):
        if path.exists():
            return path
    raise FileNotFoundError(f"{name}: missing from the installation")


def score(rows: "Sequence[Mapping[str, str]]", truth: "Mapping[str, Any]") -> Score:
    """Hold rows of `frames.csv` against a demo truth: each beside the sent frame that began nearest."""
    sent = truth["frames"]
    found: set[int] = set()
    unmatched = errors = bits = 0
    squares = []
    for row in rows:
        t_us = float(row["t_us"])
        i = min(range(len(sent)), key=lambda k: abs(sent[k]["t_us"] - t_us))
        if abs(sent[i]["t_us"] - t_us) > truth["tolerance_us"] or i in found:
            unmatched += 1
            continue
        found.add(i)
        heard = [int(s) for s in row["symbols"].split()]
        errors += sum((a ^ b).bit_count() for a, b in zip(heard, sent[i]["symbols"], strict=True))
        bits += truth["bits_per_symbol"] * len(heard)
        if row["distance_m"]:
            squares.append((float(row["distance_m"]) - sent[i]["distance_m"]) ** 2)
    rmse_m = math.sqrt(math.fsum(squares) / len(squares)) if squares else math.nan
    return Score(len(found), len(sent), unmatched, errors, bits, rmse_m)


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
    """Drive towards a bar of LEDs, simulated; receive it, and compare with the paper.

    Four stretches of 0.3 s at 30 km/h:   [bold]evlcp demo[/] or [bold]evlcp demo -o somewhere[/]

    A shipped recording, frame by frame:  [bold]evlcp demo --recording[/]
    """
    if recording:
        _decode_recording(out, as_json)
    else:
        _drive(out, workers, as_json)


def _drive(out: Path, workers: int | None, as_json: bool) -> None:
    import json
    from contextlib import suppress

    from evlcp_sdk.cli._common import make_executor
    from evlcp_sdk.cli.sweep import progress_bar, tell_faults
    from evlcp_sdk.errors import ConfigError
    from evlcp_sdk.study.campaign.charts import charts_of, save_charts
    from evlcp_sdk.study.campaign.collect import collect
    from evlcp_sdk.study.campaign.report import save_page
    from evlcp_sdk.study.campaign.store import Store
    from evlcp_sdk.study.campaign.summary import summarize
    from evlcp_sdk.study.campaign.task import plan_of, run_job

    plan = plan_of(demo_campaign())
    if not as_json:
        console().print(
            f"simulating and receiving {len(plan.jobs)} stretches of a drive"
            " (the first run also compiles the kernels) ...",
            style="dim",
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise ConfigError(f"{out}: cannot be written: {fault.strerror}") from fault
    results = out / f"{CAMPAIGN_NAME}.sqlite"
    for name in (results, *(results.with_name(results.name + end) for end in ("-wal", "-shm"))):
        with suppress(FileNotFoundError):
            name.unlink()
    with Store(results, create=True) as store:
        with progress_bar(plan.name) as show_progress:
            progress = collect(plan, store, make_executor(workers, None), run_job, show_progress)
        summary = summarize(store)
    tell_faults(progress)
    if progress.faults:
        raise typer.Exit(max(fault.exit_code for _, fault in progress.faults))
    save_charts(charts_of(summary), summary.name, out)
    try:
        save_page(summary, out / "report.html")
        written = f"{out}/report.html, ber.png, rmse.png and more, {results}"
    except ConfigError as fault:
        written = f"{out}/ber.png, rmse.png and more, {results}; {fault}"
    if as_json:
        typer.echo(json.dumps(summary.to_dict()))
        return
    show_drive(summary)
    console().print(f"written: {written}", style="dim")


def show_drive(summary: "Summary") -> None:
    """Print BER and RMSE of each segment of distance beside the paper's."""
    from rich.table import Table

    from evlcp_sdk.study.campaign.summary import compare, measure
    from evlcp_sdk.study.tally import SEGMENT_M

    (series,) = summary.series
    paper = {
        (c.reference.measure, begin): f"{'at most ' if c.reference.bound else ''}{c.reference.value:g}"
        for c in compare([series])
        for begin in range(c.reference.from_m, c.reference.to_m, SEGMENT_M)
    }
    table = Table(box=None, pad_edge=False, header_style="dim")
    for number, name in enumerate(("distance", "frames", "BER", "paper", "RMSE, m", "paper")):
        table.add_column(name, justify="right" if number else "left", no_wrap=True)
    for begin, tally in reversed(series.statistics.segments):
        ber, rmse = measure(tally, "ber"), measure(tally, "rmse_m")
        none = ber.count and not ber.value
        table.add_row(
            f"{begin} to {begin + SEGMENT_M} m",
            f"{tally.frames_found} of {tally.frames_sent}",
            f"below {ber.high:.1g}" if none else f"{ber.value:.2g}" if ber.count else "-",
            paper.get(("ber", begin), "-"),
            f"{rmse.value:.3f}" if rmse.count else "-",
            paper.get(("rmse_m", begin), "-"),
        )
    console().print(table)


def _decode_recording(out: Path, as_json: bool) -> None:
    import csv
    import json
    from dataclasses import asdict

    from evlcp_sdk.cli.receive import decode, show
    from evlcp_sdk.link.resolve import load_link
    from evlcp_sdk.plugin.registry import Registry

    recording, truth_file = demo_files()
    link = load_link(None, (), Registry.load())
    if not as_json:
        console().print(
            f"decoding {recording.name} (the first run also compiles the kernels) ...", style="dim"
        )
    summary = decode(str(recording), out, link, lambda _done, _of: None, lambda: False, figures=True)
    with (out / "frames.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    result = score(rows, json.loads(truth_file.read_text(encoding="utf-8")))
    if as_json:
        typer.echo(json.dumps(summary | {"score": asdict(result)}))
        return
    _show_frames(rows)
    # Most of so short a run is the loading of kernels: its speed says nothing.
    show(summary, out, speed=False)
    print_score(result)
    console().print(f"figures: {out}/regions.png, presence.png, distance.png", style="dim")


def print_score(result: Score) -> None:
    """Print one line on how the frames compare with the truth."""
    rmse = "-" if math.isnan(result.rmse_m) else f"{result.rmse_m:.3f} m"
    console().print(
        f"against the truth: {result.found} of {result.sent} frames found, {result.unmatched} false,"
        f" {result.bit_errors} of {result.bits} bits wrong, distance RMSE {rmse}"
    )


def _show_frames(rows: "Sequence[Mapping[str, str]]") -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="dim")
    columns: tuple[tuple[str, Literal["left", "right"]], ...] = (
        ("frame", "right"),
        ("ms", "right"),
        ("symbols of clusters 0 to 15", "left"),
        ("distance, m", "right"),
    )
    for name, side in columns:
        table.add_column(name, justify=side, no_wrap=True)
    for row in rows:
        sigma = f"{float(row['distance_sigma_m']):.2f}" if row["distance_sigma_m"] else "?"
        table.add_row(
            f"{row['packet']}/{row['frame']}",
            f"{float(row['t_us']) / 1e3:.1f}",
            " ".join(f"{int(s):2}" for s in row["symbols"].split()),
            f"{float(row['distance_m']):.2f} ± {sigma}" if row["distance_m"] else "-",
        )
    console().print(table)
