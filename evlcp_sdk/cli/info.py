"""`evlcp info`."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import Json, print_result


def info(
    recording: Annotated[str, typer.Argument(metavar="REC", help="A recording; - for standard input.")],
    as_json: Json = False,
) -> None:
    """Say what a recording holds: header, rate, triggers, anomalies.

    Reads it once from front to back and decodes no light: [bold]evlcp info REC.raw[/]
    """
    with sdk.open.open_source(recording) as source:
        table = sdk.describe.describe_source(
            source, str(source.path) if recording == sdk.open.STDIN else recording
        )
    print_result(_format_table(table), table, as_json, 2)


def _format_table(table: dict[str, Any]) -> str:
    size = "" if table["bytes"] is None else f", {table['bytes']:,} bytes"
    sensor = "of unknown size" if table["width"] is None else f"{table['width']} x {table['height']}"
    rows = {
        "recording": [table["path"]],
        "format": [f"{table['format']}{size}"],
        "sensor": [sensor],
        "header": [f"{name} {value}" for name, value in table["header"].items()],
    }
    if table["first_us"] is None:
        rows["events"] = ["none"]
    else:
        span = f"from {table['first_us']:,} to {table['last_us']:,} us"
        rows["time"] = [f"{table['duration_s']:.6f} s, {span}"]
        rows["events"] = [f"{table['counts']['events']:,}, {table['positive_share']:.0%} positive"]
        mean = "-" if table["events_per_s"] is None else f"{table['events_per_s'] / 1e6:.3f}"
        peak = f"{table['peak_events_per_s'] / 1e6:.3f}"
        rows["rate"] = [f"{mean} Mev/s, at most {peak} Mev/s over {sdk.describe.RATE_WINDOW_US / 1e3:.0f} ms"]
    triggers = [f"channel {t['channel']} {t['edge']}: {t['count']:,}" for t in table["triggers"]]
    rows |= {"triggers": triggers or ["none"], "anomalies": table["anomalies"] or ["none"]}
    lines = ((name if not i else "", text) for name, texts in rows.items() for i, text in enumerate(texts))
    return "\n".join(f"{name:<11}{text}" for name, text in lines)
