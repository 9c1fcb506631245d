"""`evlcp demo`."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from evlcp_sdk.cli._common import Json, console

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["Score", "demo", "demo_files", "register", "score"]

DEMO_NAME = "night-50m-30kmh-cut"


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
    import evlcp_sdk

    package = Path(evlcp_sdk.__file__).parent
    for folder in (package / "data", package.parent / "examples" / "recordings"):
        raw = folder / f"{DEMO_NAME}.raw"
        if raw.exists():
            return raw, folder / f"{DEMO_NAME}.truth.json"
    raise FileNotFoundError(f"{DEMO_NAME}.raw: missing from the installation")


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
    as_json: Json = False,
) -> None:
    """Decode a small recording that comes with the package, and draw its figures.

    A 96-LED bar, 50 m ahead of a car that drives towards it at 30 km/h by night:
    [bold]evlcp demo[/] or [bold]evlcp demo -o somewhere[/]
    """
    import csv
    import json
    from dataclasses import asdict

    from evlcp_sdk.cli.receive import decode, show
    from evlcp_sdk.config import load_link
    from evlcp_sdk.registry import Registry

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
