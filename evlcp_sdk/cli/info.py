"""`evlcp info`."""

from collections import Counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evlcp_sdk.cli._common import Json

if TYPE_CHECKING:
    from evlcp_sdk.io import EventSource

__all__ = ["register"]

_RATE_WINDOW_US = 10_000


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("info")(info)


def info(
    recording: Annotated[str, typer.Argument(metavar="REC", help="A recording.")], as_json: Json = False
) -> None:
    """Say what a recording holds: header, duration, rate, triggers, anomalies.

    Reads it once from front to back and decodes no light: [bold]evlcp info REC.raw[/]
    """
    import json

    from evlcp_sdk.io.open import open_source

    with open_source(recording) as source:
        table = describe(source, recording)
    typer.echo(json.dumps(table, indent=2) if as_json else _text(table))


def describe(source: "EventSource", name: str) -> dict[str, Any]:
    """Read a source to its end and say what it holds, in constant memory."""
    from dataclasses import asdict

    import numpy as np

    first_us = last_us = None
    positive = 0
    window, in_window, peak = -1, 0, 0
    edges: Counter[tuple[int, int]] = Counter()
    for events, triggers in source.stream():
        edges.update(zip(triggers.channel.tolist(), triggers.value.tolist(), strict=True))
        if not len(events):
            continue
        first_us = int(events.t_us[0]) if first_us is None else first_us
        last_us = int(events.t_us[-1])
        positive += int(events.p.sum(dtype=np.int64))
        windows, counts = np.unique(events.t_us // _RATE_WINDOW_US, return_counts=True)
        for w, n in zip(windows.tolist(), counts.tolist(), strict=True):
            in_window = in_window + n if w == window else n
            window, peak = w, max(peak, in_window)
    total = source.counts["events"]
    duration_s = (last_us - first_us) * 1e-6 if first_us is not None and last_us is not None else 0.0
    return {
        "path": name,
        "format": source.format,
        "bytes": source.size_bytes,
        "width": source.width,
        "height": source.height,
        "header": dict(source.header),
        "first_us": first_us,
        "last_us": last_us,
        "duration_s": round(duration_s, 6),
        "events_per_s": round(total / duration_s) if duration_s else None,
        "peak_events_per_s": round(peak * 1e6 / _RATE_WINDOW_US),
        "positive_share": round(positive / total, 4) if total else None,
        "counts": dict(source.counts),
        "triggers": [
            {"channel": channel, "edge": "rising" if value else "falling", "count": count}
            for (channel, value), count in sorted(edges.items())
        ],
        "losses": {kind: asdict(loss) for kind, loss in source.losses.items()},
        "anomalies": [str(loss) for loss in source.losses.values()],
    }


def _text(table: dict[str, Any]) -> str:
    def line(name: str, value: str) -> str:
        return f"{name:<11}{value}"

    size = "" if table["bytes"] is None else f", {table['bytes']:,} bytes"
    sensor = "of unknown size" if table["width"] is None else f"{table['width']} x {table['height']}"
    lines = [line("recording", table["path"]), line("format", f"{table['format']}{size}")]
    lines.append(line("sensor", sensor))
    lines += [
        line("header" if i == 0 else "", f"{k} {v}") for i, (k, v) in enumerate(table["header"].items())
    ]
    if table["first_us"] is None:
        lines.append(line("events", "none"))
    else:
        lines.append(
            line(
                "time", f"{table['duration_s']:.6f} s, from {table['first_us']:,} to {table['last_us']:,} us"
            )
        )
        share = f"{table['positive_share']:.0%} positive"
        lines.append(line("events", f"{table['counts']['events']:,}, {share}"))
        mean = "-" if table["events_per_s"] is None else f"{table['events_per_s'] / 1e6:.3f}"
        peak = f"{table['peak_events_per_s'] / 1e6:.3f}"
        lines.append(line("rate", f"{mean} Mev/s, at most {peak} Mev/s over {_RATE_WINDOW_US / 1e3:.0f} ms"))
    triggers = [f"channel {t['channel']} {t['edge']}: {t['count']:,}" for t in table["triggers"]] or ["none"]
    lines += [line("triggers" if i == 0 else "", text) for i, text in enumerate(triggers)]
    lines += [
        line("anomalies" if i == 0 else "", text) for i, text in enumerate(table["anomalies"] or ["none"])
    ]
    return "\n".join(lines)
