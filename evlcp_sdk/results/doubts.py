"""What looks wrong in a result, in words, each with the next step to try."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.results.tallies import RunTally, TransmitterTally

__all__ = ["codewords_never", "warnings_of"]

_TOLD_SIGMAS = 3.0
"""Sigmas beyond which what a drive tells is hinted at."""

_FEW_FRAMES = 10
"""Frames of a packet by default: of fewer, nothing is said."""

_REJECTED_SHARE = 0.1
"""Rejected frames, or unread ones, of which more is said: a bar that comes into view, or leaves it, loses a
frame or two."""

_ASKEW_SHARE = 0.5
"""Of frames that contradict the attitude: fewer are one bar of several that is mounted askew."""

_CRYSTALS_PPM = 200.0
"""Two crystals are this far apart at most, 100 ppm each."""

_MANY_EVENTS = 100_000
"""In regions without a preamble, of which more is said: a bar sends so many in 20 ms, a lamp in a second."""

_RANGED_SHARE = 0.25
"""Frames with a distance of which fewer is said."""

_NO_ROOM = (
    ("dropped_crowded", "{} events of crowded time steps dropped"),
    ("dropped_no_room", "{} events of regions forgotten early"),
    ("frames_cut", "{} frames passed over for it"),
    ("regions_left_out", "{} times a region more was not followed"),
    ("regions_gave_way", "{} regions without a bar let go for others"),
)
"""Counts of what there was no room for, and how they are told."""

_BY_CHANCE = 1e-6
"""Probability of a finding by chance below which it is told."""


def warnings_of(
    tally: RunTally,
    counts: Mapping[str, int],
    link: Link,
    *,
    reads_messages: bool = True,
    positions: Mapping[str, Any] | None = None,
) -> list[str]:
    """What looks wrong in a result, a line each.

    Args:
        tally: Figures of the transmitters; what is said to be a reflection is not doubted.
        counts: The receiver's counts.
        link: The configuration that it ran with.
        reads_messages: Whether messages were looked for.
        positions: Figures of the positions, where they were computed.
    """
    found = [*_frames(counts), *_room(counts)]
    for number, one in sorted(tally.transmitters.items()):
        if one.frames - one.echoes >= _FEW_FRAMES:
            found += [f"transmitter {number}: {text}" for text in _transmitter(one, link)]
    if reads_messages:
        found += _blocks(counts, tally)
    if positions is not None:
        found += _positions(positions, link)
    return found


def _positions(positions: Mapping[str, Any], link: Link) -> Iterator[str]:
    if (
        not positions["fixes"]
        + sum(positions["refused"].values())
        + positions["gnss"]
        + positions["gnss_outside"]
    ):
        return
    exact = positions["bars_exact"]
    unsaid = [f"bars {', '.join(map(str, exact))} (position_sigma_m in site.toml)"] if exact else []
    if not link.camera_sigma.known:
        unsaid.append("the camera ([camera_sigma], which evlcp calibrate prints)")
    if unsaid:
        yield (
            f"positions take as exact what has no sigma: {' and '.join(unsaid)}; their sigmas and protection"
            " levels hold only if it is"
        )
    for name, number in positions["excluded"].items():
        yield (
            f"{number} positions are without {name}, which the rest contradicts: compare its place or angles"
            " and their sigmas with what is there"
        )
    yield from _learnt(positions["learnt"], link)
    if number := positions["alarms"].get("contradicted", 0):
        yield (
            f"{number} times bars and GNSS contradict one another: compare the sigmas of both,"
            " position.antenna_m, and the clock of the GNSS file with the camera's"
        )
    if (number := positions["gnss_outside"]) and not positions["gnss"]:
        yield (
            f"none of {number} GNSS fixes is within the recording's time: t_us of their file has to be the"
            " camera's clock"
        )
    if number := positions["gnss_without_heading"]:
        yield (
            f"{number} GNSS fixes not used, as no heading says where the antenna is (position.antenna_m):"
            " give an attitude with a heading"
        )
    if number := positions["refused"].get("misfit", 0):
        yield (
            f"{number} positions refused, as bars, attitude and camera contradict one another: compare sites,"
            " angles and [camera] with what is there, and their sigmas"
        )


def _learnt(rows: Sequence[Mapping[str, Any]], link: Link) -> Iterator[str]:
    for row in rows:
        off, sigma, stated = row["correction"], row["sigma"], row["stated_sigma"]
        if not row["told"]:
            continue
        if abs(off) > _TOLD_SIGMAS * stated:
            yield (
                f"the drive shows {row['part']}, {row['what']}, {off:+.3g} off what is stated, {stated:.3g}"
                f" (sigma): {abs(off) / stated:.1f} sigmas; compare it with what is there"
            )
        elif row["what"] == "focal_mm" and abs(off) > _TOLD_SIGMAS * sigma:
            yield (
                f"the drive shows a focal length of {link.camera.focal_mm + off:.5g} +- {sigma:.2g} mm, not"
                f" {link.camera.focal_mm:g}: camera.focal_mm and camera_sigma.focal_mm may say so"
            )


def _frames(counts: Mapping[str, int]) -> Iterator[str]:
    blinking = counts.get("events_in_regions", 0)
    if blinking >= _MANY_EVENTS and not counts.get("locks", 0):
        regions = counts.get("regions_opened", 0)
        yield (
            f"something blinks, {blinking} events in {regions} regions, but no preamble is heard: compare"
            " air.chip_rate_hz and the preamble with the transmitter's; a panel or leaves behind a bar may"
            " drown it, see `evlcp info` and --figures"
        )
    rejected, frames = counts.get("frames_rejected", 0), counts.get("frames", 0)
    if rejected >= _FEW_FRAMES and rejected > _REJECTED_SHARE * (frames + rejected):
        yield (
            f"{rejected} of {frames + rejected} frames rejected, as their clusters do not stand where the bar"
            " has them: compare the link's [bar] and [pilots] with the transmitter's, and see --figures"
        )
    unread = counts.get("frames_unread", 0)
    if unread >= _FEW_FRAMES and unread > _REJECTED_SHARE * (frames + unread):
        yield (
            f"{unread} of {frames + unread} frames show their clusters, but not one symbol that is sure:"
            " compare modulation.id with the transmitter's; in little light another decoding.id may do"
        )
    askew = counts.get("frames_askew", 0)
    if askew >= _FEW_FRAMES and askew > _ASKEW_SHARE * frames:
        yield (
            f"{askew} of {frames} frames show bars that do not stand plumb by the camera's attitude: it does"
            " not correct their distances; check pitch and roll, their signs and their sigma"
        )


def _room(counts: Mapping[str, int]) -> Iterator[str]:
    """What the receiver had no room for."""
    found = [text for name, text in _NO_ROOM if (n := counts.get(name, 0)) for text in [text.format(n)]]
    if found:
        yield f"more than the receiver holds at a time: {'; '.join(found)}; frames may be missing"


def _transmitter(one: TransmitterTally, link: Link) -> Iterator[str]:
    ppm = one.clock_ppm()
    # A packet's time may be half a chip off where the light changes.
    unsure_ppm = link.packet.chip_us / 2 / one.steps_us * 1e6 if one.steps_us else math.inf
    if abs(ppm) > _CRYSTALS_PPM + unsure_ppm:
        fits = link.packet.chip_rate_hz * (1 + ppm * 1e-6)
        yield (
            f"its clock is {ppm:+.0f} ppm off the link's, crystals stay within {_CRYSTALS_PPM:.0f}:"
            f" air.chip_rate_hz = {fits:.6g} would fit"
        )
    if never := codewords_never(one, link):
        yield (
            f"{never} of {len(link.codebook.codewords)} codewords never occur in {one.given} symbols: data"
            " that repeats, or another modulation than modulation.id"
        )
    own = (one.frames - one.echoes) / link.packet.pilot_every
    if one.ranged < _RANGED_SHARE * own:
        yield (
            f"{one.ranged} of {own:.0f} frames have a distance: too few boundaries between clusters are seen,"
            " or their values do not fit the layout; another ranging.id may bear it"
        )
    hidden = [k for k in range(link.codebook.clusters) if one.unseen[k] == one.frames]
    if hidden:
        yield (
            f"clusters never seen: {', '.join(map(str, hidden))}: something covers them, or the bar has other"
            " clusters than the link's"
        )


def codewords_never(one: TransmitterTally, link: Link) -> int:
    """How many codewords never occur in what a transmitter sent, 0 where that may be chance.

    Packets may repeat one another, so that all of them say no more than one.
    """
    codewords = len(link.codebook.codewords)
    never = codewords - len(one.values)
    if not one.given or not never:
        return 0
    # Equally likely codewords; the union of all sets of so many bounds the chance that they never occur.
    ways = math.lgamma(codewords + 1) - math.lgamma(never + 1) - math.lgamma(codewords - never + 1)
    given = min(one.given, link.packet.frames * link.codebook.clusters)
    chance = ways + given * math.log1p(-never / codewords)
    return never if chance < math.log(_BY_CHANCE) else 0


def _blocks(counts: Mapping[str, int], tally: RunTally) -> Iterator[str]:
    tried = counts.get("blocks_tried", 0)
    read = counts.get("blocks_decoded", 0) + counts.get("blocks_combined", 0)
    if other := counts.get("blocks_other_codebook", 0):
        yield f"{other} packets were sent with another codebook: compare both ends' `evlcp config`"
    # Packets with frames missing may fail by themselves.
    whole = sum(one.frames - one.echoes for one in tally.transmitters.values()) >= _FEW_FRAMES
    if tried and not read and whole:
        yield (
            f"none of {tried} packets has a block that can be read: another error correction than"
            " error-correction.id, or no messages were sent (say messages.decode = false)"
        )
