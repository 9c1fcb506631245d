"""`summary.json`: what a run found, from what, how fast, and what was lost."""

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

from evlcp_sdk.diagnosis.tallies import RunTally
from evlcp_sdk.diagnosis.warnings import Diagnostic, LinkPart, Seen, notes_of, warnings_of, warnings_of_links
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.files import output_fault
from evlcp_sdk.formatting import characters
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.records import SUMMARY
from evlcp_sdk.results.folder import ResultFolder

__all__ = ["Status", "messages_off", "summary_of", "write_summary"]

Status = Literal["complete", "degraded", "interrupted", "failed"]
"""How a run ended: read to the end, the same with much of it dropped, stopped by the user, or stopped by
input that cannot be read."""


def summary_of(
    status: Status,
    links: Mapping[str, LinkPart],
    tally: RunTally,
    *,
    recording: Mapping[str, Any],
    processing: Mapping[str, Any],
    counts: Mapping[str, int],
    losses: Mapping[str, Mapping[str, Any]],
    versions: Mapping[str, str],
    seen: Seen | None = None,
    error: str | None = None,
    positions: Mapping[str, Any] | None = None,
    sinks: Mapping[str, Mapping[str, Any]] | None = None,
    live: Mapping[str, Any] | None = None,
    pps: Mapping[str, Any] | None = None,
    placing: str = "",
) -> dict[str, Any]:
    """The content of `summary.json`.

    Args:
        status: How the run ended.
        links: The configuration that the receiver ran with; where there are several, by name.
        tally: Figures of the transmitters.
        recording: What was read: path, format, size, duration, events.
        processing: How long it took.
        counts: The receiver's counts.
        losses: What the reader skipped, by kind, with byte offsets.
        versions: Installed versions.
        seen: What warnings need to know beside; None for nothing.
        error: The message, when `status` is `failed` or `degraded`.
        positions: Figures of the positions, where they were computed.
        sinks: What sinks say, by name; those that say nothing are left out.
        live: Delays, and what was shed, of a live run; None for others.
        pps: Pulses of UTC, and the rate of the camera's clock by them; None where nobody asked.
        placing: Where there are several links, name of the first whose bars positions are computed from.
    """
    seen = Seen() if seen is None else seen
    parts = list(links.values())
    reads = any(part.reads_messages for part in parts)
    off = None if reads else messages_off(parts[0].link)
    notes = notes_of(tally, counts, seen=seen, reads_messages=reads)
    if len(parts) == 1:
        link, seen = parts[0].link, replace(seen, others=parts[0].others)
        warnings = warnings_of(tally, counts, link, seen=seen, reads_messages=reads, positions=positions)
        described = _described(link)
    else:
        warnings = warnings_of_links(tally, counts, links, seen=seen, positions=positions, placing=placing)
        silent = [name for name in links if tally.transmitters and not tally.of_link(name)]
        notes += [Diagnostic("nothing-found", "no frame of it was read", link=name) for name in silent]
        described = {"links": {name: _described(part.link) | _told(part) for name, part in links.items()}}
    return {
        "status": status,
        "error": error,
        "result": tally.headline(),
        "transmitters": [one | _text(tally, one, links) for one in tally.to_list()],
        "recording": dict(recording),
        "processing": dict(processing),
        "counts": dict(counts),
        "messages": tally.messages(),
        "messages_off": off,
        "warnings": [warning.to_dict() for warning in warnings],
        "notes": [note.to_dict() for note in notes],
        "losses": {kind: dict(loss) for kind, loss in losses.items()},
        **described,
        "versions": dict(versions),
        **({"positions": dict(positions)} if positions is not None else {}),
        **({"sinks": {name: dict(part) for name, part in sinks.items()}} if sinks else {}),
        **({"pps": dict(pps)} if pps is not None else {}),
        **({"live": dict(live)} if live is not None else {}),
    }


def _text(tally: RunTally, told: Mapping[str, Any], links: Mapping[str, LinkPart]) -> dict[str, Any]:
    """What a transmitter says in characters, if its framing sends such and it sends no blocks."""
    part = links.get(told.get("link", ""), next(iter(links.values())))
    one = tally.transmitters[told["transmitter"]]
    if not part.link.characters_on_air or one.blocks:
        return {}
    return {"text": characters(one.firsts)}


def _described(link: Link) -> dict[str, Any]:
    """What a link is, so that a result can be made again."""
    return {
        "digest": link.digest,
        "codebook": {"digest": link.codebook.digest, "profile": link.codebook.profile},
        "revisions": dict(link.revisions),
        "configuration": {section: dict(keys) for section, keys in link.table.items()},
    }


def _told(part: LinkPart) -> dict[str, Any]:
    """What one of several links found, and whether its messages were read."""
    return {"counts": dict(part.counts), "messages_off": messages_off(part.link)}


def write_summary(table: Mapping[str, Any], folder: ResultFolder) -> None:
    """Write `summary.json`.

    Raises:
        OutputError: It cannot be written.
    """
    try:
        folder.open(SUMMARY).write(json.dumps(table, indent=2) + "\n")
    except OSError as fault:
        raise output_fault(folder.folder, fault) from fault


def messages_off(link: Link) -> str | None:
    """Why messages were not read; None where they were."""
    if not link.messages.decode:
        return "messages.decode = false"
    try:
        link.block_coder()
    except ConfigError as fault:
        return str(fault)
    return None
