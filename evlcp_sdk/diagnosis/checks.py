"""The one list of checks: `receive` shows those that find something wrong, `diagnose` all, by stage.

A check is a generator of what it finds wrong, or of the count by which it is passed.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from evlcp_sdk.diagnosis import of_frames, of_light, of_positions
from evlcp_sdk.diagnosis.facts import Diagnostic, Facts, Found

_Of = Iterator[tuple[tuple[Any, ...], dict[str, Any]]]
"""What checks take, and whose their findings are."""


def _of_recording(facts: Facts) -> _Of:
    yield (facts,), {}


def _of_bar(facts: Facts) -> _Of:
    if (bar := facts.bar) is not None:
        yield (facts, bar), {}


def _of_links(facts: Facts) -> _Of:
    for name, part in (facts.parts or {"": facts}).items():
        yield (part,), {"link": name}


def _of_transmitters(facts: Facts, own_frames: int = -1) -> _Of:
    for (part,), whose in _of_links(facts):
        for number, one in sorted(part.tally.transmitters.items()):
            if one.frames - one.echoes >= own_frames:
                yield (part, one), whose | {"transmitter": number}


def _of_many_frames(facts: Facts) -> _Of:
    yield from _of_transmitters(facts, of_frames.FEW_FRAMES)


def _of_positions(facts: Facts) -> _Of:
    for (part,), whose in _of_links(facts):
        if part.positions_tried or part.positions.get("gnss") or part.positions.get("gnss_outside"):
            yield (part,), whose


CHECKS: tuple[tuple[str, Callable[[Facts], _Of], tuple[Callable[..., Found], ...]], ...] = (
    (
        "events",
        _of_recording,
        (of_light.check_events, of_light.check_times, of_light.check_room, of_light.check_links),
    ),
    ("readout", _of_recording, (of_light.check_readout,)),
    ("light", _of_recording, (of_light.check_light,)),
    ("polarity", _of_links, (of_light.check_edges,)),
    ("pixels", _of_bar, (of_light.check_pixels,)),
    ("size", _of_bar, (of_light.check_size,)),
    ("focus", _of_bar, (of_light.check_focus,)),
    ("brightness", _of_bar, (of_light.check_brightness,)),
    ("chip rate", _of_bar, (of_light.check_rate,)),
    ("preamble", _of_recording, (of_light.check_preamble,)),
    (
        "frames",
        _of_links,
        (
            of_frames.check_frames,
            of_frames.check_kinds_of_frames,
            of_frames.check_flooded,
            of_frames.check_alike,
        ),
    ),
    ("frames", _of_transmitters, (of_frames.check_reflection, of_frames.check_restart, of_frames.check_lit)),
    ("frames", _of_many_frames, (of_frames.check_clock, of_frames.check_hidden)),
    ("frames", _of_recording, (of_light.check_coverage,)),
    ("orientation", _of_transmitters, (of_frames.check_orientation,)),
    (
        "codewords",
        _of_many_frames,
        (
            of_frames.check_codewords,
            of_frames.check_symbols,
            of_frames.check_bit_order,
            of_frames.check_characters,
        ),
    ),
    ("distances", _of_many_frames, (of_frames.check_distances, of_frames.check_bent, of_frames.check_size)),
    ("distances", _of_transmitters, (of_frames.check_length,)),
    ("messages", _of_links, (of_frames.check_messages,)),
    ("messages", _of_transmitters, (of_frames.check_packets,)),
    (
        "positions",
        _of_positions,
        (
            of_positions.check_sigmas,
            of_positions.check_excluded,
            of_positions.check_biases,
            of_positions.check_inputs,
            of_positions.check_sites,
            of_positions.check_misfits,
        ),
    ),
)
"""Stages in the order in which light passes them, of what their checks are, and these."""


def run_checks(facts: Facts) -> list[Diagnostic]:
    """What each check finds, in their order."""
    found = []
    for stage, subjects, checks in CHECKS:
        for known, whose in subjects(facts):
            for check in checks:
                for one in check(*known):
                    one = Diagnostic("", one, verdict="pass") if isinstance(one, str) else one
                    found.append(replace(one, stage=stage, **whose))
    return found


def find_stages(facts: Facts) -> list[Diagnostic]:
    """All stages but those of positions: what looks wrong where frames are read all the same is a doubt.

    Where they are not, it is why: stages behind one that fails are not judged.
    """
    by_stage = defaultdict[str, list[Diagnostic]](list)
    for one in run_checks(facts):
        # What is lost of a recording stops no light.
        fails = one.verdict == "doubt" and not facts.reads and one.stage != "events"
        by_stage[one.stage].append(replace(one, verdict="fail") if fails else one)
    shown: list[Diagnostic] = []
    for stage in dict.fromkeys(name for name, subjects, _ in CHECKS if subjects is not _of_positions):
        failed = any(one.verdict == "fail" for one in shown)
        text = "not reached" if failed else "too little to tell"
        skipped = Diagnostic("", text, verdict="skip", stage=stage)
        shown += [skipped] if failed else by_stage[stage] or [skipped]
    return shown
