"""What looks wrong in a result, in words, each with the next step to try; and what it has none of.

A check is a generator: of facts, of facts and one transmitter, or of facts and the figures of positions.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.facts import Diagnostic, Facts
from evlcp_sdk.diagnosis.tallies import TransmitterTally, count_missing_codewords
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.several import alike_links
from evlcp_sdk.spelling import counted

Found = Iterator[Diagnostic]

_MOST_IDS = 5
"""Ids that a warning names; how many there are besides, it counts."""

_DRIVE_SIGMAS = 3.0
"""Sigmas beyond which what a drive shows is hinted at."""

_MANY_CHARACTERS, _ALIKE_SHARE = 50, 0.95
"""Of so many characters, no such share is one and the same in a text, nor in any data that says much."""

_FEW_FRAMES = 10
"""Frames of a packet by default: of fewer, nothing is said."""

_REJECTED_SHARE = 0.1
"""Rejected frames, or unread ones, of which more is said: a bar that comes into view, or leaves it, loses a
frame or two."""

_REJECTED_BESIDE_READ_SHARE = 0.3
"""The same of rejected frames where most blocks are read, so that the link is right: a false lock costs a
packet; of three bars, one of another layout is still named."""

_ASKEW_SHARE = 0.5
"""Of frames that contradict the attitude: fewer are one bar of several that is mounted askew."""

_INVERTED_SHARE = 0.5
"""Of frames that fit only a light that is on where the link says off: one link says one thing of all."""

_ONE_SIGN_SHARE, _ONE_SIGN_EVENTS = 0.02, 100
"""Events of the rarer sign, by their share of all, below which nothing is known of one half of the edges, and
events from which on it is said. A light that goes on goes off again: cameras whose thresholds are unlike
still give a tenth; noise alone may give a few of either."""

_CRYSTALS_PPM = 200.0
"""Two crystals are this far apart at most, 100 ppm each."""

_MANY_EVENTS = 100_000
"""In regions without a preamble, of which more is said: a bar sends so many in 20 ms, a lamp in a second."""

_RANGED_SHARE = 0.25
"""Frames with a distance of which fewer is said."""

_SIZE_OFF = 0.1
"""Share by which distances and the bar's length in the picture may disagree: distances of far bars, and of
bars that lean, are off by some percent."""

_LENGTH_OFF = 0.02
"""Share by which a beacon's length of its bar may be another than the link's: both are measured by hand."""

_ALIKE = 3
"""Packets that repeat others without being read, from which on there is something to be read."""

_FAILED_SHARE = 0.5
"""Packets that cannot be read, where others can, of which more is said."""

_SPLIT = 0.9
"""Share of the symbols that are another modulation's from which on that one is taken to be what is sent."""

_UNSURE_SHARE = 0.3
"""Share of symbols of every cluster that are not given, of which more is said."""

_LEAST_QUALITY = 0.4
"""Mean probability that all symbols of a frame are right, below which more is said: of a bar 180 m away, with
2.4 px a cluster, it is .75."""

_HEAD_DOWN = 0.5
"""Cosine beyond which a bar stands on its head: one that lies may point either way."""

_COVERED = 0.5
"""Share of a recording of which no more is without frames unless it is said."""

_LIT_SHARE, _LIT_PACKETS = 0.2, 3
"""Share of a recording, and packets, for which a bar is in the picture without a frame before it is said."""

_DROPPED_SHARE, _DROPPED_LEAST = 0.001, 100
"""Of the events: dropped ones of which more is said. A restart of the camera costs fewer."""

_NO_ROOM = (
    ("dropped_crowded", "{} event{} of crowded time steps dropped"),
    ("dropped_no_room", "{} event{} of regions forgotten early"),
    ("frames_cut", "{} frame{} passed over for it"),
    ("regions_left_out", "{} time{} a region more was not followed"),
    ("regions_gave_way", "{} region{} without a bar let go for others"),
)
"""Counts of what there was no room for, and how they are stated."""

_SUSPECTS = {
    "focal length": "camera.focal_mm, or give camera_sigma.focal_mm, and the drive shows the right one",
    "heading": "--heading-deg, or that of the attitude file: the camera's, clockwise from north",
    "attitude": "pitch and roll, their signs, and how the camera is mounted",
}
"""What to compare where a part of a position is what the rest contradicts."""


def find_warnings(facts: Facts) -> list[Diagnostic]:
    """What looks wrong in a result: the recording first, then what each link has read.

    What is said to be a reflection is not doubted.
    """
    found = _check(_OF_RECORDING, facts)
    found += check_alike({name: part.link for name, part in facts.parts.items()})
    if not facts.parts or not facts.tally.transmitters:
        found += _check(_OF_FRAMES, facts)
        return found if facts.parts else found + _of_link(facts)
    for name, part in facts.parts.items():
        of_frames = _check(_OF_FRAMES, part)
        # Another link may have found the light that blinks.
        own = [one for one in of_frames if one.code not in ("no-preamble", "no-frames")] + _of_link(part)
        found += [replace(one, link=name) for one in own]
    return found


def _check(checks: Sequence[Any], *known: Any) -> list[Diagnostic]:
    return [one for check in checks for one in check(*known)]


def _of_link(facts: Facts) -> list[Diagnostic]:
    """What looks wrong in what a link has read."""
    found: list[Diagnostic] = []
    for number, one in sorted(facts.tally.transmitters.items()):
        checks = (*_OF_MANY_FRAMES * (one.frames - one.echoes >= _FEW_FRAMES), *_OF_TRANSMITTER)
        found += [replace(wrong, transmitter=number) for wrong in _check(checks, facts, one)]
    if facts.reads_messages:
        found += _check(_OF_MESSAGES, facts)
    if facts.positions and _tried(facts) + facts.positions["gnss"] + facts.positions["gnss_outside"]:
        found += _check(_OF_POSITIONS, facts)
    return found


# Of the recording


def check_saturation(facts: Facts) -> Found:
    """A readout that is at its limit."""
    if facts.readout is not None and facts.readout.at_limit:
        share, _ = facts.readout.capped()
        yield Diagnostic(
            "saturated",
            f"{share:.0%} of all milliseconds, {facts.readout.capped_ms}, hold {facts.peak_mev_s:.3g} Mev/s,"
            " no more and no less: the sensor's readout is at its limit, and what is beyond is lost",
            "mask rows and columns beside the bar, close the aperture, or raise the event-rate limit",
        )


def check_times(facts: Facts) -> Found:
    """Times in steps of more than a quarter of a chip: of when a light changed, little is left."""
    chip_us = min(one.link.packet.chip_us for one in (facts, *facts.parts.values()))
    if facts.step_us > chip_us / 4:
        yield Diagnostic(
            "coarse-times",
            f"times are rounded to {facts.step_us / 1000:g} ms; a chip is {chip_us / 1000:g} ms",
            "export them in whole microseconds, or with six decimals of a second",
        )


def check_dropped(facts: Facts) -> Found:
    """Events that were there and did not count, for other reasons than room."""
    names = [name for name, _ in _NO_ROOM]
    dropped = {n: k for n, k in facts.counts.items() if n.startswith("dropped_") and k and n not in names}
    number = sum(dropped.values()) + facts.lost
    most = _DROPPED_SHARE * (facts.counts.get("events", 0) + facts.lost)
    if number >= _DROPPED_LEAST and number > most:
        kinds = [f"{k} {n.removeprefix('dropped_').replace('_', ' ')}" for n, k in dropped.items()]
        kinds += [f"{facts.lost} in the file"] * (facts.lost > 0)
        yield Diagnostic(
            "dropped",
            f"{number} events or words dropped ({', '.join(kinds)})",
            "losses and counts in summary.json say where and why; `evlcp info` says what is in the recording",
        )


def check_room(facts: Facts) -> Found:
    """What the receiver had no room for."""
    found = [text.format(n, "s" * (n != 1)) for name, text in _NO_ROOM if (n := facts.counts.get(name, 0))]
    if found:
        yield Diagnostic(
            "no-room",
            f"more than the receiver holds at a time: {'; '.join(found)}; frames may be missing",
        )


def check_alike(links: Mapping[str, Link]) -> Found:
    """Links of which nothing on air tells one from the other, by name: known before anything is read."""
    for one, other in alike_links(links):
        yield Diagnostic(
            "alike-links",
            f"what one of the links '{one}' and '{other}' sends, the other may read: the rates are alike,"
            " and codewords of one are codewords of the other",
            "give the one that is sent with, or let them differ in rate or parity",
        )


# Of all frames of a link


def check_blinking(facts: Facts) -> Found:
    """Something that blinks, and of which nothing is read."""
    counts = facts.counts
    blinking = counts.get("events_in_regions", 0)
    if blinking < _MANY_EVENTS or counts.get("locks", counts.get("frames", 0)):
        return
    code, what, compare = "no-frames", "frame is read", "[framing] with the transmitter's"
    if "locks" in counts:
        code, what, compare = "no-preamble", "preamble is detected", "the preamble with the transmitter's"
        compare += "; a panel or leaves behind a bar may mask it"
    yield Diagnostic(
        code,
        f"something blinks, {blinking} events in {counted(counts.get('regions_opened', 0), 'region')}, but no"
        f" {what}",
        f"compare air.chip_rate_hz and {compare}; `evlcp diagnose` says what blinks, and how fast",
    )


def check_polarity(facts: Facts) -> Found:
    """Frames of a light that is the other way round than the link says."""
    counts, frames = facts.counts, facts.counts.get("frames", 0)
    # Of several links those that another one fits better may all be among them.
    inverted = counts.get("frames_inverted", 0) - counts.get("frames_of_others", 0)
    if frames and inverted >= _FEW_FRAMES and inverted > _INVERTED_SHARE * frames:
        yield Diagnostic(
            "polarity",
            f"{inverted} of {frames} frames fit only a light that is on where the link says off, and were"
            " read so",
            "compare framing.idle with the transmitter, and the polarities of a list: "
            "list:PATH?inverted=1 turns them",
        )


def check_edges(facts: Facts) -> Found:
    """Frames of a light of which one kind of edges is not seen."""
    on, events = facts.counts.get("events_in_regions_on"), facts.counts.get("events_in_regions", 0)
    if not facts.counts.get("frames", 0) or on is None or events < _ONE_SIGN_EVENTS:
        return
    if min(on, events - on) < _ONE_SIGN_SHARE * events:
        sign, other = ("ON", "off") if 2 * on > events else ("OFF", "on")
        yield Diagnostic(
            "one-polarity",
            f"{max(on, events - on)} of {events} events are {sign}: when the light goes {other} is not"
            " seen, so that most of what it says may be read in several ways",
            "give events of both polarities: see the list's column of polarity, or the camera's thresholds",
        )


def check_rejected(facts: Facts) -> Found:
    """Frames that are due and are not there, or whose symbols are not."""
    counts, frames = facts.counts, facts.counts.get("frames", 0)
    rejected = counts.get("frames_rejected", 0)
    reads = facts.blocks_read > counts.get("blocks_failed", 0)
    share = _REJECTED_BESIDE_READ_SHARE if reads else _REJECTED_SHARE
    if rejected >= _FEW_FRAMES and rejected > share * (frames + rejected):
        yield Diagnostic(
            "frames-rejected",
            f"{rejected} of {frames + rejected} frames rejected, as their clusters do not stand where the bar"
            " has them",
            "compare the link's [bar], [pilots] and [air] with the transmitter's, or try --link auto",
        )
    unread = counts.get("frames_unread", 0)
    if unread >= _FEW_FRAMES and unread > _REJECTED_SHARE * (frames + unread):
        yield Diagnostic(
            "frames-unread",
            f"{unread} of {frames + unread} frames show their clusters, but not one symbol that is sure",
            "compare modulation.id with the transmitter's; in little light another decoding.id may do",
        )


def check_askew(facts: Facts) -> Found:
    """Bars that do not stand plumb by the camera's attitude."""
    askew, frames = facts.counts.get("frames_askew", 0), facts.counts.get("frames", 0)
    if askew >= _FEW_FRAMES and askew > _ASKEW_SHARE * frames:
        yield Diagnostic(
            "attitude",
            f"{min(askew, frames)} of {frames} frames show bars that do not stand plumb by the camera's"
            " attitude, which does not correct their distances",
            "check pitch and roll, their signs and their sigma",
        )


# Of a transmitter


def check_clock(facts: Facts, one: TransmitterTally) -> Found:
    """A clock that no crystal has."""
    packet, ppm = facts.link.packet, one.clock_ppm()
    # A packet's time may be half a chip off where the light changes.
    unsure_ppm = packet.chip_us / 2 / one.steps_us * 1e6 if one.steps_us else math.inf
    if abs(ppm) > _CRYSTALS_PPM + unsure_ppm:
        yield Diagnostic(
            "clock",
            f"its clock is {ppm:+.0f} ppm off the link's, crystals stay within {_CRYSTALS_PPM:.0f}",
            f"air.chip_rate_hz = {packet.chip_rate_hz * (1 + ppm * 1e-6):.6g} would fit",
        )


def check_codewords(facts: Facts, one: TransmitterTally) -> Found:
    """Codewords that never occur, and the modulation that they are all of."""
    link = facts.link
    # Of characters a text has few.
    never = 0 if link.characters_on_air and not one.blocks else count_missing_codewords(one, link)
    if not never:
        return
    codewords, occur = link.codebook.carrying, len(one.values)
    tried = facts.counts.get("blocks_tried", 0)
    unread = f", {tried} of {tried} blocks unreadable" if tried and not facts.blocks_read else ""
    for name, words in facts.others().items():
        inside = np.flatnonzero(_among(link.codebook.codewords, words)).tolist()
        received = [s for s in inside if one.values[s]]
        share = sum(one.values[s] for s in received) / one.given
        if len(words) < codewords and share >= _SPLIT and len(received) > len(words) / 2:
            text = f"only {occur} of {codewords} symbols ever occur"
            if occur > len(words):
                text = f"{share:.0%} of its symbols are {len(received)} of {codewords}"
            asked = f"was this sent with {name}? try --set modulation.id={name}"
            yield Diagnostic("profile", text + unread, asked)
            return
    yield Diagnostic(
        "codewords",
        f"{never} of {codewords} codewords never occur in {one.given} symbols{unread}",
        "data that repeats, or another modulation than modulation.id",
    )


def check_bit_order(facts: Facts, one: TransmitterTally) -> Found:
    """Characters that are text if their bits come the other way round."""
    if not facts.link.characters_on_air or one.blocks or one.given < _FEW_FRAMES:
        return
    each = facts.link.codebook.bits_per_symbol
    text = {*range(0x20, 0x7F), 0x09, 0x0A, 0x0D}
    # Blanks and small letters are most of any text.
    usual = {0x20, *range(0x61, 0x7B)}
    turned = {s: int(f"{s:0{each}b}"[::-1], 2) for s in one.values}
    own, other = (
        [sum(one.values[s] for s in one.values if code(s) in of) / one.given for of in (text, usual)]
        for code in (int, turned.__getitem__)
    )
    if other[0] > _SPLIT > own[0] + 0.1 and other[1] > own[1]:
        yield Diagnostic(
            "bit-order",
            f"{own[0]:.0%} of its characters are printable, and {other[0]:.0%} if their bits come the other"
            " way round",
            "compare framing.first_bit with the transmitter",
        )


def check_characters(facts: Facts, one: TransmitterTally) -> Found:
    """Characters that are all the same, as those of a lamp are that blinks once in a character's time."""
    if not facts.link.characters_on_air or one.blocks or one.given < _MANY_CHARACTERS:
        return
    ((value, times),) = one.values.most_common(1)
    if times > _ALIKE_SHARE * one.given:
        digits = (facts.link.codebook.bits_per_symbol + 3) // 4
        yield Diagnostic(
            "one-character",
            f"{times} of its {one.given} characters are 0x{value:0{digits}x}: a lamp that blinks"
            " once in a character's time reads like that",
            "look where it stands in the picture",
        )


def check_symbols(facts: Facts, one: TransmitterTally) -> Found:
    """Symbols that are not given, of every cluster, or that are said to be wrong.

    What covers some of a bar is no fault of the link's.
    """
    clusters = [k for k in range(facts.link.codebook.clusters) if one.unseen[k] < one.frames]
    quality = one.quality_sum / one.frames
    if clusters and min(one.unseen[k] for k in clusters) >= _UNSURE_SHARE * one.frames:
        share = sum(one.unseen[k] for k in clusters) / (one.frames * len(clusters))
        text = f"{share:.0%} of its symbols are not sure, of every cluster {_UNSURE_SHARE:.0%} and more"
    elif quality < _LEAST_QUALITY:
        text = f"{1 - quality:.0%} of its frames have a symbol that is wrong, by the receiver's own account"
    else:
        return
    own, others = facts.link.codebook.codewords, facts.others().items()
    larger = [name for name, words in others if len(words) > len(own) and _among(own, words).all()]
    asked = f"was this sent with {' or '.join(larger)} (modulation.id)? if not, " if larger else ""
    yield Diagnostic(
        "unsure",
        text,
        f"{asked}more light, a sharper image, or another decoding.id; `evlcp diagnose` says what it lacks",
    )


def _among(words: NDArray[np.uint8], others: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which words are others, too, bool (symbols,); none where they are of another length."""
    if words.shape[1] != others.shape[1]:
        return np.zeros(len(words), np.bool_)
    return np.asarray((words[:, None] == others).all(-1).any(-1))


def check_distances(facts: Facts, one: TransmitterTally) -> Found:
    """Frames without a distance."""
    link = facts.link
    # What was left out for lack of time, of whichever transmitter, says nothing of the bar.
    own = (one.frames - one.echoes) / link.packet.pilot_every - facts.counts.get("frames_not_ranged", 0)
    measures = "ranging" in link.algorithms and link.algorithm("ranging").measures
    if measures and one.ranged < _RANGED_SHARE * own:
        yield Diagnostic(
            "few-distances",
            f"{one.ranged} of {own:.0f} frames have a distance: too few boundaries between clusters are seen,"
            " or their values do not fit the layout",
            "another ranging.id may tolerate it",
        )


def check_hidden(facts: Facts, one: TransmitterTally) -> Found:
    """Clusters that no frame shows."""
    hidden = [k for k in range(facts.link.codebook.clusters) if one.unseen[k] == one.frames]
    if hidden:
        yield Diagnostic(
            "clusters-hidden",
            f"clusters never seen: {', '.join(map(str, hidden))}",
            "is something before them? if not, compare the link's [bar] and [pilots] with the bar",
        )


def check_size(facts: Facts, one: TransmitterTally) -> Found:
    """Distances against those that the bar's length in the picture gives."""
    if one.sized < _FEW_FRAMES:
        return
    link, centres_m = facts.link, facts.link.bar.cluster_centres_m()
    reach = math.exp(one.reach_sum / one.sized)
    share = reach / (link.camera.focal_px * math.dist(centres_m[0], centres_m[-1])) - 1
    if abs(share) > _SIZE_OFF:
        yield Diagnostic(
            "size",
            f"its distances are {abs(share):.0%} too {'long' if share > 0 else 'short'} for a bar of"
            f" {link.bar.length_m:g} m that looks as long as this one",
            "try another ranging.id; a bar that leans looks shorter",
        )


def check_coverage(facts: Facts, one: TransmitterTally) -> Found:
    """Light that is there before the first frame or after the last one."""
    lit = (facts.lit_us or {}).get(one.number)
    if one.frames == one.echoes or lit is None or not facts.duration_us:
        return
    packet = facts.link.packet
    least_us = max(_LIT_SHARE * facts.duration_us, _LIT_PACKETS * packet.packet_chips * packet.chip_us)
    at = [_ms(t_us - facts.first_us) for t_us in (one.first_us, lit[0], one.last_us, lit[1])]
    parts = []
    if one.first_us - lit[0] > least_us:
        parts.append(f"nothing before {at[0]}, though its light is there from {at[1]} on")
    if lit[1] - one.last_us > least_us:
        parts.append(f"nothing after {at[2]}, though its light is there until {at[3]}")
    if parts:
        yield Diagnostic(
            "coverage",
            "; ".join(parts),
            "compare air.chip_rate_hz and air.frames_per_packet with the transmitter's, or try --link auto",
        )


def check_length(facts: Facts, one: TransmitterTally) -> Found:
    """The bar's length as its own beacon says it."""
    beacon_m, length_m = one.beacon_m, facts.link.bar.length_m
    if abs(beacon_m / length_m - 1) > _LENGTH_OFF:
        how = f"{abs(length_m / beacon_m - 1):.0%} too {'long' if length_m > beacon_m else 'short'}"
        yield Diagnostic(
            "bar-length",
            f"its beacon says that the bar is {beacon_m:.3f} m long, the link {length_m:.3f}: its distances"
            f" are {how} if the beacon is right",
            "compare the link's [bar] with the transmitter's",
        )


def check_turned(facts: Facts, one: TransmitterTally) -> Found:
    """A bar that stands on its head in the picture; where positions are computed, they tell."""
    if facts.positions or one.sized < _FEW_FRAMES:
        return
    centres_m = facts.link.bar.cluster_centres_m()
    along, way = np.array(one.along_px), centres_m[-1] - centres_m[0]
    if along @ way < -_HEAD_DOWN * math.hypot(*along) * math.hypot(*way):
        yield Diagnostic(
            "turned",
            "its clusters stand the other way round in the picture",
            "is the camera upside down, its picture mirrored, or the bar mounted so? positions have to know",
        )


def check_packets(_facts: Facts, one: TransmitterTally) -> Found:
    """Packets without a block of a transmitter that sends some; another one may send none at all."""
    failed = one.packets - one.blocks
    if one.blocks and failed >= _FEW_FRAMES and failed > _FAILED_SHARE * one.packets:
        yield Diagnostic(
            "blocks-failed",
            f"{failed} of {one.packets} packets cannot be read",
            "more light, a nearer or a better focused bar, or an error correction of a lower rate",
        )


# Of messages


def check_codebook(facts: Facts) -> Found:
    """Packets that are sent with another codebook."""
    if other := facts.counts.get("blocks_other_codebook", 0):
        text = f"{counted(other, 'packet')} sent with another codebook"
        yield Diagnostic("other-codebook", text, "compare both ends' `evlcp config`")


def check_blocks(facts: Facts) -> Found:
    """Packets that repeat others, and cannot be read."""
    alike = facts.counts.get("blocks_alike", 0)
    if not facts.blocks_read and alike >= _ALIKE:
        yield Diagnostic(
            "blocks-unread",
            f"none of {facts.counts.get('blocks_tried', 0)} packets has a block that can be read, though"
            f" {alike} of them repeat others",
            "another error correction than error-correction.id, or frames taken from another place in the"
            " packet than they were sent in; if no messages are sent, say messages.decode = false",
        )


# Of positions


def _tried(facts: Facts) -> int:
    """Positions of bars, given or refused."""
    return int(facts.positions["fixes"] + sum(facts.positions["refused"].values()))


def _fitting_lens(facts: Facts) -> str:
    """The focal length that would fit, where one is known; else empty."""
    fits_mm, focal_mm = facts.positions.get("focal_mm_fits"), facts.link.camera.focal_mm
    return f"camera.focal_mm = {focal_mm:g}: about {fits_mm:.3g} would fit" if fits_mm else ""


def check_sigmas(facts: Facts) -> Found:
    """What has no sigma, and so is taken as exact."""
    exact = facts.positions["bars_exact"]
    unsaid = [f"bars {', '.join(map(str, exact))} (position_sigma_m in site.toml)"] if exact else []
    if not facts.link.camera_sigma.known:
        unsaid.append("the camera ([camera_sigma], which evlcp calibrate prints)")
    if unsaid:
        yield Diagnostic(
            "no-sigma",
            f"positions take as exact what has no sigma: {' and '.join(unsaid)}; their sigmas and protection"
            " levels hold only if it is",
        )


def check_excluded(facts: Facts) -> Found:
    """Parts that the rest contradicts."""
    lens = _fitting_lens(facts)
    for name, number in facts.positions["excluded"].items():
        steps = [lens] if lens and name != "focal length" else []
        steps.append(_SUSPECTS.get(name, "its place, angles and length, and their sigmas"))
        yield Diagnostic(
            "excluded",
            f"{counted(number, 'position')} without {name}, which the rest contradicts",
            f"compare {'; or '.join(steps)}",
        )


def check_biases(facts: Facts) -> Found:
    """What the drive shows of bars and camera, against what is stated of them."""
    focal_mm = facts.link.camera.focal_mm
    for row in facts.positions["learnt"]:
        off, sigma, stated = row["correction"], row["sigma"], row["stated_sigma"]
        if not row["determined"]:
            continue
        if abs(off) > _DRIVE_SIGMAS * stated:
            yield Diagnostic(
                "learnt",
                f"the drive shows {row['part']}, {row['what']}, {off:+.3g} off what is stated, {stated:.3g}"
                f" (sigma): {abs(off) / stated:.1f} sigmas",
                "compare it with what is there",
            )
        elif row["what"] == "focal_mm" and abs(off) > _DRIVE_SIGMAS * sigma:
            yield Diagnostic(
                "focal",
                f"the drive shows a focal length of {focal_mm + off:.5g} +- {sigma:.2g} mm, not {focal_mm:g}",
                "camera.focal_mm and camera_sigma.focal_mm may say so",
            )


def check_gnss(facts: Facts) -> Found:
    """GNSS that contradicts bars."""
    number, apart_m = facts.positions["alarms"].get("contradicted", 0), facts.positions["gnss_apart_m"]
    if not number:
        return
    apart = ""
    if apart_m is not None:
        east, north, up = (f"{value:+.3g}" for value in apart_m)
        apart = f": it is {east} m east, {north} north, {up} up of them"
    yield Diagnostic(
        "gnss-contradicted",
        f"{counted(number, 'time')} bars and GNSS contradict one another{apart}",
        "compare heights (above the ellipsoid), the sigmas of both, position.antenna_m, and both clocks",
    )


def check_inputs(facts: Facts) -> Found:
    """Attitudes and GNSS that do not go with the recording."""
    outside = facts.positions["attitude_outside"]
    if (number := facts.positions["attitude_missing"]) and not outside:
        yield Diagnostic(
            "attitude-missing",
            f"{number} of {_tried(facts)} positions have no attitude: its file does not reach there, or"
            " lacks lines",
            "t_us of its file has to be the camera's clock, us, from before the first bar to after the last",
        )
    if outside:
        yield Diagnostic(
            "attitude-outside",
            f"none of the attitude's {outside} lines is within the recording's time",
            "t_us of its file has to be the camera's clock, us",
        )
    if (number := facts.positions["gnss_outside"]) and not facts.positions["gnss"]:
        yield Diagnostic(
            "gnss-outside",
            f"none of {number} GNSS fixes is within the recording's time",
            "t_us of their file has to be the camera's clock",
        )
    if number := facts.positions["gnss_without_heading"]:
        yield Diagnostic(
            "gnss-without-heading",
            f"{number} GNSS fix{'es' * (number != 1)} not used, as no heading says where the antenna is"
            " (position.antenna_m)",
            "give an attitude with a heading",
        )


def check_sites(facts: Facts) -> Found:
    """Ids that are received and in no site."""
    received, unseen = facts.positions["heard"], facts.positions["sites_unseen"]
    if (number := facts.positions["refused"].get("no-site", 0)) and not facts.positions["fixes"]:
        yield Diagnostic(
            "no-site",
            f"{counted(number, 'position')} refused, as no bar in view stands at a known place;"
            f" received: {_ids(sorted(set(received.values()))) or 'no id'}",
            "compare transmitter_id in site.toml",
        )
    placed = {*facts.positions["bars"], *facts.positions["sites_contradicted"]}
    strange = sorted({one for n, one in received.items() if n not in placed})
    if facts.positions["fixes"] and strange and unseen:
        # Either alone is no fault: a bar that is not on the list, a bar of the list that is elsewhere.
        yield Diagnostic(
            "unknown-id",
            f"positions are without {_ids(strange)}, received and in no site;"
            f" {_ids(unseen)} of the sites {'were' if len(unseen) > 1 else 'was'} not",
            "compare transmitter_id in site.toml",
        )


def _ids(ids: Sequence[int]) -> str:
    """Ids, the first ones by name; empty for none."""
    more = f" and {len(ids) - _MOST_IDS} more" if len(ids) > _MOST_IDS else ""
    return f"id{'s' * (len(ids) > 1)} {', '.join(map(str, ids[:_MOST_IDS]))}{more}" if ids else ""


def check_misfits(facts: Facts) -> Found:
    """Positions refused, with the parts that would each explain most of them."""
    number = facts.positions["refused"].get("misfit", 0)
    if not number:
        return
    suspects, lens = facts.positions.get("suspects", {}), _fitting_lens(facts)
    likely = {name: times for name, times in suspects.items() if 2 * times > number}
    steps = {name: _SUSPECTS.get(name, f"place, angles and length of {name}") for name in likely}
    if lens and "focal length" not in likely:
        # One that is far off; what explains all of them at once is the first to compare.
        likely["focal length"] = number + 1
        steps["focal length"] = lens
    names = sorted(likely, key=lambda name: -likely[name])
    text = f"{counted(number, 'position')} refused, as bars, attitude and camera contradict one another"
    if names:
        text += f"; another {' or another '.join(names)} would explain it"
    what = "sites, angles and [camera], its focal_mm first, with what is there, and their sigmas"
    yield Diagnostic("misfit", text, f"compare {'; '.join(steps[name] for name in names) or what}")


_OF_RECORDING = (check_saturation, check_times, check_dropped, check_room)
_OF_FRAMES = (check_blinking, check_polarity, check_edges, check_rejected, check_askew)
_OF_MANY_FRAMES = (
    *(check_clock, check_codewords, check_bit_order, check_characters, check_symbols, check_distances),
    *(check_hidden, check_size),
)
"""Of transmitters with some frames of their own."""
_OF_TRANSMITTER = (check_coverage, check_length, check_turned, check_packets)
_OF_MESSAGES = (check_codebook, check_blocks)
_OF_POSITIONS = (
    *(check_sigmas, check_excluded, check_biases, check_gnss, check_inputs, check_sites, check_misfits),
)


def find_notes(facts: Facts) -> list[Diagnostic]:
    """Plain statements: reflections, what was guessed or skipped, what had no frames, and no messages."""
    transmitters = facts.tally.transmitters
    found = [
        Diagnostic(
            "reflection", f"a reflection of transmitter {one.echo_of}, {counted(one.echoes, 'frame')}", "", n
        )
        for n, one in sorted(transmitters.items())
        if one.echoes and one.echo_of is not None
    ]
    if facts.guessed:
        step = "where it is wrong, list:PATH?columns=...&unit=... says it"
        found.append(Diagnostic("guessed", facts.guessed, step))
    silences, silent_us = facts.skipped
    if silences:
        text = f"{counted(silences, 'silence')} of {silent_us * 1e-6:.1f} s in all"
        found.append(Diagnostic("pace", f"{text}, where the recording is damaged, not waited for"))
    if not transmitters and facts.counts.get("events", 0):
        step = "`evlcp diagnose` says what blinks, and what to try"
        found.append(Diagnostic("nothing-found", "no frame was read", step))
    covered_us = facts.tally.covered_us
    if transmitters and covered_us < (1 - _COVERED) * facts.duration_us:
        first_us = min(one.first_us for one in transmitters.values())
        last_us = max(one.last_us for one in transmitters.values())
        text = (
            f"frames in {_ms(covered_us)} of {_ms(facts.duration_us)}: nothing before"
            f" {_ms(first_us - facts.first_us)}, nothing after {_ms(last_us - facts.first_us)}"
        )
        found.append(Diagnostic("coverage", text))
    tried = facts.counts.get("blocks_tried", 0)
    if facts.reads_messages and tried and not facts.blocks_read:
        what = f"none of {tried} packets has" if tried > 1 else "the packet does not have"
        found.append(Diagnostic("no-messages", f"no messages: {what} a block that can be read"))
    silent = [name for name, part in facts.parts.items() if transmitters and not part.tally.transmitters]
    return found + [Diagnostic("nothing-found", "no frame of it was read", link=name) for name in silent]


def _ms(t_us: float) -> str:
    return f"{t_us * 1e-3:.0f} ms" if t_us < 1e7 else f"{t_us * 1e-6:.1f} s"
