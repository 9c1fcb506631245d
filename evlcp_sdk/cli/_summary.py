"""Prints a summary."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import console, print_json
from evlcp_sdk.cli._receiving import LinePrinter
from evlcp_sdk.cli._stderr import print_stderr
from evlcp_sdk.cli._tables import print_table
from evlcp_sdk.formatting import format_count

if TYPE_CHECKING:
    from rich.console import Console

_MAX_MESSAGES, _MAX_CHARACTERS = 8, 200
"""Newest messages that are printed, and characters of each."""


def print_end(
    summary: dict[str, Any], folder: Path | None, lines: "LinePrinter | None", *, as_json: bool
) -> None:
    """Print a summary as the last line of JSON, and as text on stderr; or on stdout."""
    if lines is not None:
        lines(json.dumps({"line": "summary"} | summary))
    if as_json:
        print_json(summary)
    elif lines is None or not lines.closed or folder is not None:
        print_summary(summary, folder, stderr=lines is not None)
    if summary["status"] in ("failed", "degraded"):
        print_stderr(summary["error"])


def print_summary(summary: dict[str, Any], folder: Path | None, *, stderr: bool = False) -> None:
    """Print what was found, received and lost, where the result is, and how fast it was."""
    from rich.text import Text

    out = console(stderr=stderr)
    recording, processing = summary["recording"], summary["processing"]
    out.print(Text.assemble((Path(recording["path"]).name, "bold"), f": {summary['result']}"))
    _print_transmitters(summary, out)
    if text := _describe_messages(summary["counts"]):
        out.print(text)
    shown = summary["messages"][-_MAX_MESSAGES:]
    for message in shown:
        out.print(f"  {_format_message(message)}")
    if (more := summary["counts"].get("messages", 0) - len(shown)) > 0:
        out.print(f"  {more} before that: packets.jsonl" if folder else f"  {more} before that", style="dim")
    if "positions" in summary:
        out.print(_describe_positions(summary["positions"]))
        if last := summary["positions"]["last"]:
            out.print(f"  {_format_fix(last)}")
    out.print(
        f"{recording['counts']['events'] / 1e6:.2f} Mev of {recording['duration_s']:.3f} s"
        f" in {processing['processor_s']:.2f} s of one core:"
        f" {processing['events_per_s'] / 1e6:.1f} Mev/s,"
        f" {_format_or_dash(processing['times_real_time'], '{:.2f}')} x real time"
    )
    for text, style in _describe_timing(summary):
        out.print(text, style=style)
    if processing["kernels_s"] > 1:
        out.print(f"kernels compiled or loaded in {processing['kernels_s']:.0f} s", style="dim")
    for loss in summary["losses"].values():
        out.print(
            f"lost: {loss['count']} {loss['meaning']} (first at {loss['unit']} {loss['first']})",
            style="yellow",
        )
    for note in summary["notes"]:
        out.print(str(sdk.facts.Diagnostic(**note)), style="dim")
    for warning in summary["warnings"]:
        out.print(f"warning: {sdk.facts.Diagnostic(**warning)}", style="yellow")
    if folder is not None:
        out.print(f"written: {folder}/{', '.join([*summary['files'], 'summary.json'])}", style="dim")


def _print_transmitters(summary: Mapping[str, Any], out: "Console") -> None:
    from rich.text import Text

    if summary["transmitters"]:
        several = ("link",) if "links" in summary else ()
        head = ("transmitter", *several, "frames", "not seen", "quality", "clock", "distance")
        rows = [
            (
                _format_transmitter(t),
                *(t[name] for name in several),
                f"{t['frames_found']} of {t['frames_expected']}",
                _format_erased(t),
                _format_or_dash(t["quality"], "{:.2f}"),
                _format_or_dash(t["clock_ppm"], "{:+.0f} ppm"),
                _format_distances(t["distance_first_m"], t["distance_last_m"]),
            )
            for t in summary["transmitters"]
        ]
        print_table(out, head, rows, names=0)
    for t in summary["transmitters"]:
        if text := t.get("text"):
            more = "..." if len(text) > _MAX_CHARACTERS else ""
            out.print(Text(f"text of {_format_transmitter(t)}: {text[:_MAX_CHARACTERS]!r}{more}"))


def _describe_timing(summary: Mapping[str, Any]) -> Iterator[tuple[str, str | None]]:
    """Lines, each with a style, of delays, shed events and pulses, where there are any."""
    live = summary.get("live")
    if live is not None:
        for stage, what, since in (
            ("total", "frame", "from the last chip"),
            ("end_to_end", "message", "from the time that it says"),
        ):
            tally = live["delays"][stage]
            if tally["count"]:
                yield f"delay of {format_count(tally['count'], what)}, {since}: {format_delays(tally)}", None
        if shed := [f"{number} {name.replace('_', ' ')}" for name, number in live["shed"].items() if number]:
            yield f"left out, as there was no time: {', '.join(shed)}", "yellow"
    pps = summary.get("pps")
    if pps is not None:
        rate = _format_or_dash(pps["rate_ppm"], "{:+.3f} ppm")
        text = f"{pps['pulses']} pulses of UTC, {pps['pulses_rejected']} rejected: the camera's clock {rate}"
        none = f"no pulse of UTC came on channel {pps['channel']} of the trigger input"
        if pps["others"]:
            none += f"; on others something came: {', '.join(map(str, pps['others']))}"
        yield (text, None) if pps["pulses"] else (none, "yellow")


def format_delays(tally: Mapping[str, Any]) -> str:
    """Quantiles of delays, in words.

    >>> format_delays({"count": 3, "p50_ms": 1.98, "p99_ms": 2.4, "max_ms": 12.04})
    'p50 2.0, p99 2.4, max 12.0 ms'
    """
    return f"p50 {tally['p50_ms']:.1f}, p99 {tally['p99_ms']:.1f}, max {tally['max_ms']:.1f} ms"


def _format_message(message: Mapping[str, Any]) -> str:
    text = message["said"]
    text = text if len(text) <= _MAX_CHARACTERS else f"{text[:_MAX_CHARACTERS]}..."
    kind = "text " if message["kind"] == "text" else ""
    sender = f"from {message['transmitter_id']}, {message['trust']}"
    return f"{kind}{text}, {sender}, at {message['t_us'] / 1e3:.1f} ms"


def _format_fix(fix: Mapping[str, Any]) -> str:
    east, north, up = fix["sigma_m"]
    heading = "" if fix["heading_deg"] is None else f", heading {fix['heading_deg']:.1f} deg"
    return (
        f"the last one {fix['latitude_deg']:.7f}, {fix['longitude_deg']:.7f} deg, {fix['height_m']:.2f} m"
        f" (sigma {east:.2g} E, {north:.2g} N, {up:.2g} U m){heading}, at {fix['t_us'] / 1e3:.1f} ms"
    )


def _format_transmitter(figures: Mapping[str, Any]) -> str:
    number, echo_of = figures["transmitter"], figures["echo_of"]
    return f"{number}" if echo_of is None else f"{number}, reflection of {echo_of}"


def _format_erased(figures: Mapping[str, Any]) -> str:
    erased = figures["symbols_erased"]
    return f"{erased / (erased + figures['symbols_given']):.1%}" if erased else "-"


def _describe_positions(positions: Mapping[str, Any]) -> str:
    text = format_count(positions["fixes"], "position")
    if positions["fixes_verified"]:
        text += f", {positions['fixes_verified']} verified"
    if gnss := positions["gnss"]:
        text += f", {gnss - positions['gnss_left_out']} of {gnss} GNSS fixes in the track"
    for kind, number in positions["refused"].items():
        text += f"; {number} refused: {kind}"
    for reason in positions["sites_contradicted"].values():
        text += f"; left out: {reason}"
    return text


def _format_distances(first_m: float | None, last_m: float | None) -> str:
    """First and last distance.

    >>> _format_distances(49.4, 48.86), _format_distances(None, None)
    ('49.40 to 48.86 m', '-')
    """
    if first_m is None and last_m is None:
        return "-"
    return _format_or_dash(first_m, "{:.2f}") + " to " + _format_or_dash(last_m, "{:.2f} m")


def _describe_messages(counts: Mapping[str, int]) -> str:
    """The number of messages, and what was lost, in one line; empty where no packet has a block."""
    if not counts.get("blocks_decoded", 0) + counts.get("blocks_combined", 0):
        return ""
    text = format_count(counts["messages"], "message")
    trusts = {t: counts[f"beacons_{t}"] for t in ("verified", "unverified", "forged")}
    if beacons := [f"{'once' if n == 1 else f'{n} times'} {t}" for t, n in trusts.items() if n]:
        text += f"; beacons {', '.join(beacons)}"
    if counts["beacons_undated"]:
        text += "; how old verified ones are is not known without --clock-zero"
    for key, what, lost in (
        ("blocks_failed", "packet", "not readable"),
        ("blocks_other_codebook", "packet", "of another codebook"),
        ("blocks_malformed", "packet", "with no block of this format"),
        ("parts_missing", "part", "missing"),
        ("messages_mixed", "message", "put together from parts of two, left out"),
        ("messages_undecodable", "message", "without meaning"),
    ):
        if counts[key]:
            text += f"; {format_count(counts[key], what)} {lost}"
    return text


def _format_or_dash(value: float | None, template: str) -> str:
    return "-" if value is None else template.format(value)
