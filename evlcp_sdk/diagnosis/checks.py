"""The one list of checks: `receive` shows their warnings, `diagnose` all of them, by stage.

A check is a generator of diagnostics, or of the counts by which it is passed.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from evlcp_sdk.diagnosis import frame_checks as frames, light_checks as light, position_checks as positions
from evlcp_sdk.diagnosis.facts import Diagnostic, Facts, Findings

_Subjects = Iterator[tuple[tuple[Any, ...], dict[str, Any]]]
"""Arguments of checks, and whom their findings are about."""


def _select_recording(facts: Facts) -> _Subjects:
    yield (facts,), {}


def _select_bar(facts: Facts) -> _Subjects:
    if (bar := facts.bar) is not None:
        yield (facts, bar), {}


def _select_links(facts: Facts) -> _Subjects:
    for name, part in (facts.parts or {"": facts}).items():
        yield (part,), {"link": name}


def _select_transmitters(facts: Facts, own_frames: int = -1) -> _Subjects:
    for (part,), subject in _select_links(facts):
        for number, one in sorted(part.tally.transmitters.items()):
            if one.frames - one.echo_frames >= own_frames:
                yield (part, one), subject | {"transmitter": number}


def _select_frequent(facts: Facts) -> _Subjects:
    yield from _select_transmitters(facts, frames.FEW_FRAMES)


def _select_positions(facts: Facts) -> _Subjects:
    for (part,), subject in _select_links(facts):
        if part.positions_tried or part.positions.get("gnss") or part.positions.get("gnss_outside"):
            yield (part,), subject


CHECKS: tuple[tuple[str, Callable[[Facts], _Subjects], tuple[Callable[..., Findings], ...]], ...] = (
    (
        "events",
        _select_recording,
        (light.check_events, light.check_times, light.check_room, light.check_links),
    ),
    ("readout", _select_recording, (light.check_readout,)),
    ("light", _select_recording, (light.check_light,)),
    ("polarity", _select_links, (light.check_edges,)),
    ("pixels", _select_bar, (light.check_pixels,)),
    ("size", _select_bar, (light.check_size,)),
    ("focus", _select_bar, (light.check_focus,)),
    ("brightness", _select_bar, (light.check_brightness,)),
    ("chip rate", _select_bar, (light.check_rate,)),
    ("preamble", _select_recording, (light.check_preamble,)),
    (
        "frames",
        _select_links,
        (
            frames.check_frames,
            frames.check_frame_kinds,
            frames.check_flooded_frames,
            frames.check_same_symbols,
        ),
    ),
    (
        "frames",
        _select_transmitters,
        (frames.check_reflection, frames.check_restart, frames.check_light_span),
    ),
    ("frames", _select_frequent, (frames.check_clock, frames.check_hidden_clusters)),
    ("frames", _select_recording, (light.check_coverage,)),
    ("orientation", _select_transmitters, (frames.check_orientation,)),
    (
        "codewords",
        _select_frequent,
        (frames.check_codewords, frames.check_symbols, frames.check_bit_order, frames.check_characters),
    ),
    ("distances", _select_frequent, (frames.check_distances, frames.check_distortion, frames.check_size)),
    ("distances", _select_transmitters, (frames.check_length,)),
    ("messages", _select_links, (frames.check_messages,)),
    ("messages", _select_transmitters, (frames.check_packets,)),
    (
        "positions",
        _select_positions,
        (
            positions.check_sigmas,
            positions.check_exclusions,
            positions.check_biases,
            positions.check_inputs,
            positions.check_sites,
            positions.check_misfits,
        ),
    ),
)
"""Stages in the order in which light passes them, the subjects of their checks, and these."""


def run_checks(facts: Facts) -> list[Diagnostic]:
    """The findings of all checks, in their order."""
    findings = []
    for stage, subjects, checks in CHECKS:
        for arguments, subject in subjects(facts):
            for check in checks:
                for one in check(*arguments):
                    one = Diagnostic("", one, verdict="pass") if isinstance(one, str) else one
                    findings.append(replace(one, stage=stage, **subject))
    return findings


def assess_stages(facts: Facts) -> list[Diagnostic]:
    """The findings of all stages but those of positions; a stage after one that fails is skipped.

    A doubt fails its stage if no frames are read.
    """
    by_stage = defaultdict[str, list[Diagnostic]](list)
    for one in run_checks(facts):
        # Lost events stop no light.
        fails = one.verdict == "doubt" and not facts.is_read and one.stage != "events"
        by_stage[one.stage].append(replace(one, verdict="fail") if fails else one)
    assessed: list[Diagnostic] = []
    for stage in dict.fromkeys(name for name, subjects, _ in CHECKS if subjects is not _select_positions):
        failed = any(one.verdict == "fail" for one in assessed)
        text = "not reached" if failed else "too little to tell"
        skipped = Diagnostic("", text, verdict="skip", stage=stage)
        assessed += [skipped] if failed else by_stage[stage] or [skipped]
    return assessed
