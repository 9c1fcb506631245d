"""`summary.json`: what a run found, in which recording, how fast, and what was lost."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from evlcp_sdk.diagnosis.checks import run_checks
from evlcp_sdk.diagnosis.facts import Facts
from evlcp_sdk.diagnosis.tallies import TransmitterTally
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.source import Loss
from evlcp_sdk.results.packets_jsonl import decode_characters

Status = Literal["complete", "degraded", "interrupted", "failed"]
"""How a run ended: read to the end, likewise with much of it dropped, stopped by the user, or by input
that cannot be read."""


@dataclass(frozen=True, eq=False)
class RunEnd:
    """How a run ended, and what it read.

    Attributes:
        status: How it ended.
        recording: Path, format, size, duration and events of the recording.
        processing: How long it took.
        counts: The receiver's counts.
        losses: What the reader skipped, by kind, with byte offsets.
        error: The message, when `status` is `failed` or `degraded`.
        lit_us: First and last time of each transmitter's light, us; None if it is not known.
        live: Delays and dropped events of a live run; None for others.
        link_counts: The receiver's counts of each of several links, by name.
    """

    status: Status
    recording: Mapping[str, Any] = field(default_factory=dict)
    processing: Mapping[str, Any] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    losses: Mapping[str, Loss] = field(default_factory=dict)
    error: str | None = None
    lit_us: Mapping[int, tuple[float, float]] | None = None
    live: Mapping[str, Any] | None = None
    link_counts: Mapping[str, Mapping[str, int]] = field(default_factory=dict)


def build_summary(
    end: RunEnd,
    facts: Facts,
    versions: Mapping[str, str],
    sinks: Mapping[str, Mapping[str, Any]],
    pps: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """The content of `summary.json`.

    Args:
        end: How the run ended.
        facts: The receiver's findings and configuration.
        versions: Installed versions.
        sinks: Parts of the sinks that have one, by name.
        pps: Pulses of UTC, and the rate of the camera's clock by them; None where they are not used.
    """
    tally, diagnostics = facts.tally, run_checks(facts)
    if facts.parts:
        description: dict[str, Any] = {"links": {}}
        for name, part in facts.parts.items():
            results = {"counts": dict(part.counts), "messages_off": messages_off_reason(part.link)}
            description["links"][name] = _describe_link(part.link) | results
    else:
        description = _describe_link(facts.link)
    return {
        "status": end.status,
        "error": end.error,
        "result": tally.headline(),
        "transmitters": [
            one.to_dict() | _character_text(one, facts) for _, one in sorted(tally.transmitters.items())
        ],
        "recording": dict(end.recording),
        "processing": dict(end.processing),
        "counts": dict(facts.counts),
        "messages": tally.messages(),
        "messages_off": None if facts.reads_messages else messages_off_reason(facts.link),
        "warnings": [one.to_dict() for one in diagnostics if one.verdict in ("doubt", "fail")],
        "notes": [one.to_dict() for one in diagnostics if one.verdict == "note"],
        "losses": {kind: asdict(loss) for kind, loss in end.losses.items()},
        **description,
        "versions": dict(versions),
        **({"positions": dict(facts.positions)} if facts.positions else {}),
        **({"sinks": {name: dict(part) for name, part in sinks.items()}} if sinks else {}),
        **({"pps": dict(pps)} if pps is not None else {}),
        **({"live": dict(end.live)} if end.live is not None else {}),
    }


def _character_text(one: TransmitterTally, facts: Facts) -> dict[str, Any]:
    """A transmitter's text, if its framing sends characters and it sends no blocks."""
    link = facts.parts.get(one.link, facts).link
    is_text = link.characters_on_air and not one.blocks
    return {"text": decode_characters(one.first_symbols)} if is_text else {}


def _describe_link(link: Link) -> dict[str, Any]:
    return {
        "digest": link.digest,
        "codebook": {"digest": link.codebook.digest, "profile": link.codebook.profile},
        "revisions": dict(link.revisions),
        "configuration": {section: dict(keys) for section, keys in link.table.items()},
    }


def messages_off_reason(link: Link) -> str | None:
    """Why messages were not read; None where they were."""
    if not link.messages.decode:
        return "messages.decode = false"
    try:
        link.block_coder()
    except ConfigError as fault:
        return str(fault)
    return None
