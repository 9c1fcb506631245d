"""How a summary is printed."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evlcp_sdk.cli._common import console, print_json
from evlcp_sdk.cli._complain import complain
from evlcp_sdk.cli._tables import print_table
from evlcp_sdk.suggestions import format_count

if TYPE_CHECKING:
    from rich.console import Console

    from evlcp_sdk.cli._receiving import LinePrinter

_MOST_SHOWN, _MOST_SAID = 8, 200
"""Messages that are shown, the newest, and characters of each."""


def print_end(
    summary: dict[str, Any], folder: Path | None, lines: "LinePrinter | None", *, as_json: bool
) -> None:
    """Say how a recording ended: as the last line of JSON, and to read on stderr; or on stdout."""
    if lines is not None:
        lines(json.dumps({"line": "summary"} | summary))
    if as_json:
        print_json(summary)
    elif lines is None or not lines.gone or folder is not None:
        show(summary, folder, stderr=lines is not None)
    if summary["status"] in ("failed", "degraded"):
        complain(summary["error"])


def show(summary: dict[str, Any], folder: Path | None, *, stderr: bool = False) -> None:
    """Print what was found and received, what was lost, where the result is, and how fast it went."""
    from rich.text import Text

    from evlcp_sdk.diagnosis.facts import Diagnostic

    out = console(stderr=stderr)
    recording, processing = summary["recording"], summary["processing"]
    out.print(Text.assemble((Path(recording["path"]).name, "bold"), f": {summary['result']}"))
    _show_transmitters(summary, out)
    if text := _messages(summary["counts"]):
        out.print(text)
    shown = summary["messages"][-_MOST_SHOWN:]
    for told in shown:
        out.print(f"  {_message(told)}")
    if (more := summary["counts"].get("messages", 0) - len(shown)) > 0:
        out.print(f"  {more} before that: packets.jsonl" if folder else f"  {more} before that", style="dim")
    if "positions" in summary:
        out.print(_positions(summary["positions"]))
        if last := summary["positions"]["last"]:
            out.print(f"  {_last(last)}")
    out.print(
        f"{recording['counts']['events'] / 1e6:.2f} Mev of {recording['duration_s']:.3f} s"
        f" in {processing['processor_s']:.2f} s of one core:"
        f" {processing['events_per_s'] / 1e6:.1f} Mev/s,"
        f" {_or_dash(processing['times_real_time'], '{:.2f}')} x real time"
    )
    for text, style in _real_time(summary):
        out.print(text, style=style)
    if processing["kernels_s"] > 1:
        out.print(f"kernels compiled or loaded in {processing['kernels_s']:.0f} s", style="dim")
    for loss in summary["losses"].values():
        out.print(
            f"lost: {loss['count']} {loss['meaning']} (first at {loss['unit']} {loss['first']})",
            style="yellow",
        )
    for note in summary["notes"]:
        out.print(str(Diagnostic(**note)), style="dim")
    for warning in summary["warnings"]:
        out.print(f"warning: {Diagnostic(**warning)}", style="yellow")
    if folder is not None:
        out.print(f"written: {folder}/{', '.join([*summary['files'], 'summary.json'])}", style="dim")


def _show_transmitters(summary: Mapping[str, Any], out: "Console") -> None:
    """Print a row for each transmitter, and the texts that they say."""
    from rich.text import Text

    if summary["transmitters"]:
        several = ("link",) if "links" in summary else ()
        head = ("transmitter", *several, "frames", "not seen", "quality", "clock", "distance")
        rows = [
            (
                _who(t),
                *(t[name] for name in several),
                f"{t['frames_found']} of {t['frames_expected']}",
                _erased(t),
                _or_dash(t["quality"], "{:.2f}"),
                _or_dash(t["clock_ppm"], "{:+.0f} ppm"),
                _distances(t["distance_first_m"], t["distance_last_m"]),
            )
            for t in summary["transmitters"]
        ]
        print_table(out, head, rows, names=0)
    for t in summary["transmitters"]:
        if said := t.get("text"):
            more = "..." if len(said) > _MOST_SAID else ""
            out.print(Text(f"text of {_who(t)}: {said[:_MOST_SAID]!r}{more}"))


def _real_time(summary: Mapping[str, Any]) -> Iterator[tuple[str, str | None]]:
    """Delays, what was left out, and pulses, in a line each with its style, where there are any."""
    live = summary.get("live")
    if live is not None:
        for stage, what, since in (
            ("total", "frame", "from the last chip"),
            ("end_to_end", "message", "from the time that it says"),
        ):
            tally = live["delays"][stage]
            if tally["count"]:
                yield f"delay of {format_count(tally['count'], what)}, {since}: {delays_text(tally)}", None
        if left := [f"{many} {name.replace('_', ' ')}" for name, many in live["shed"].items() if many]:
            yield f"left out, as there was no time: {', '.join(left)}", "yellow"
    pps = summary.get("pps")
    if pps is not None:
        rate = _or_dash(pps["rate_ppm"], "{:+.3f} ppm")
        text = f"{pps['pulses']} pulses of UTC, {pps['pulses_rejected']} rejected: the camera's clock {rate}"
        none = f"no pulse of UTC came on channel {pps['channel']} of the trigger input"
        if pps["others"]:
            none += f"; on others something came: {', '.join(map(str, pps['others']))}"
        yield (text, None) if pps["pulses"] else (none, "yellow")


def delays_text(tally: Mapping[str, Any]) -> str:
    """Quantiles of delays, in words.

    >>> delays_text({"count": 3, "p50_ms": 1.98, "p99_ms": 2.4, "max_ms": 12.04})
    'p50 2.0, p99 2.4, max 12.0 ms'
    """
    return f"p50 {tally['p50_ms']:.1f}, p99 {tally['p99_ms']:.1f}, max {tally['max_ms']:.1f} ms"


def _message(told: Mapping[str, Any]) -> str:
    """What a message says, on one line, and from whom."""
    said = told["said"]
    text = said if len(said) <= _MOST_SAID else f"{said[:_MOST_SAID]}..."
    kind = "text " if told["kind"] == "text" else ""
    return f"{kind}{text}, from {told['transmitter_id']}, {told['trust']}, at {told['t_us'] / 1e3:.1f} ms"


def _last(told: Mapping[str, Any]) -> str:
    """The last position, in one line."""
    east, north, up = told["sigma_m"]
    heading = "" if told["heading_deg"] is None else f", heading {told['heading_deg']:.1f} deg"
    return (
        f"the last one {told['latitude_deg']:.7f}, {told['longitude_deg']:.7f} deg, {told['height_m']:.2f} m"
        f" (sigma {east:.2g} E, {north:.2g} N, {up:.2g} U m){heading}, at {told['t_us'] / 1e3:.1f} ms"
    )


def _who(told: Mapping[str, Any]) -> str:
    """A transmitter's number, and of which one it is a reflection."""
    echo_of = told["echo_of"]
    return f"{told['transmitter']}" if echo_of is None else f"{told['transmitter']}, reflection of {echo_of}"


def _erased(told: Mapping[str, Any]) -> str:
    """The share of symbols that are not given."""
    erased = told["symbols_erased"]
    return f"{erased / (erased + told['symbols_given']):.1%}" if erased else "-"


def _positions(told: Mapping[str, Any]) -> str:
    """How many positions there are, and why not more, in one line."""
    text = format_count(told["fixes"], "position")
    if told["fixes_verified"]:
        text += f", {told['fixes_verified']} verified"
    if told["gnss"]:
        text += f", {told['gnss'] - told['gnss_left_out']} of {told['gnss']} GNSS fixes in the track"
    for kind, number in told["refused"].items():
        text += f"; {number} refused: {kind}"
    for how in told["sites_contradicted"].values():
        text += f"; left out: {how}"
    return text


def _distances(first_m: float | None, last_m: float | None) -> str:
    """First and last distance.

    >>> _distances(49.4, 48.86), _distances(None, None)
    ('49.40 to 48.86 m', '-')
    """
    if first_m is None and last_m is None:
        return "-"
    return _or_dash(first_m, "{:.2f}") + " to " + _or_dash(last_m, "{:.2f} m")


def _messages(counts: Mapping[str, int]) -> str:
    """What was read of messages, in one line; empty where there was nothing to read."""
    if not counts.get("blocks_decoded", 0) + counts.get("blocks_combined", 0):
        return ""
    number = counts["messages"]
    text = format_count(number, "message")
    trusts = {t: counts[f"beacons_{t}"] for t in ("verified", "unverified", "forged")}
    if any(trusts.values()):
        text += f"; beacons {', '.join(_times(n, t) for t, n in trusts.items() if n)}"
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


def _times(number: int, what: str) -> str:
    return f"once {what}" if number == 1 else f"{number} times {what}"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)
