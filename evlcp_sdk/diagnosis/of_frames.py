"""Checks of what a link reads: its frames, their symbols and distances, and messages."""

import math

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.facts import BRIGHTER, Diagnostic, Facts, Found, in_ms
from evlcp_sdk.diagnosis.tallies import SURE, TransmitterTally, count_missing_codewords
from evlcp_sdk.rx.distortion import CORRELATED_FRAMES, are_correlated
from evlcp_sdk.suggestions import format_count

FEW_FRAMES = 10
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

_UNSEEN_SHARE = 0.05
"""Share of unseen clusters, at the picture's edge, of which more is stated."""

_CRYSTALS_PPM = 200.0
"""Two crystals are this far apart at most, 100 ppm each."""

_MANY_CHARACTERS, _ALIKE_SHARE = 50, 0.95
"""Of so many characters, no such share is one and the same in a text, nor in any data that says much."""

_SPLIT = 0.9
"""Share of the symbols that are another modulation's from which on that one is taken to be what is sent."""

_UNSURE_SHARE = 0.3
"""Share of symbols of every cluster that are not given, of which more is said."""

_LEAST_QUALITY = 0.4
"""Mean probability that all symbols of a frame are right, below which more is said: of a bar 180 m away, with
2.4 px a cluster, it is .75. Who asks for a diagnosis is told below `SURE`."""

_RANGED_SHARE = 0.25
"""Frames with a distance of which fewer is said."""

_BENT_SHARE = 0.1
"""Share of frames whose image is bent of which more is said: drops run over the glass, poles pass."""

_STANDING_OFF, _STANDING_PX = 4.0, 0.25
"""Sigmas of a boundary's mean, 1 of 16000 by chance, and px, beyond which it stands off: where nothing moves,
those between two pixels do by up to a fifth of one."""

_SIZE_OFF = 0.1
"""Share by which distances and the bar's length in the picture may disagree: distances of far bars, and of
bars that lean, are off by some percent."""

_LENGTH_OFF = 0.02
"""Share by which a beacon's length of its bar may be another than the link's: both are measured by hand."""

_HEAD_DOWN, _MIRRORED = -0.5, -0.25
"""Cosine between a bar and its image beyond which it stands on its head, as one that lies may point either
way; and the part of it, of one axis alone, beyond which left and right are exchanged."""

_ANEW_PACKETS, _ANEW_PX = 3, 30.0
"""Packets between the last frame before a reset and the first after it, which two preambles tell, and how far
the image moves in between."""

_LIT_SHARE, _LIT_PACKETS = 0.2, 3
"""Share of a recording, and packets, for which a bar is in the picture without a frame before it is said."""

_ALIKE = 3
"""Packets that repeat others without being read, from which on there is something to be read."""

_FAILED_SHARE = 0.5
"""Packets that cannot be read, where others can, of which more is said."""


_TURN_LIST = "list:PATH?inverted=1 turns the polarities of a list"
"""What to try where ON and OFF may be exchanged."""


def check_frames(facts: Facts) -> Found:
    """Frames that are due and are not there: of another link, of a bar at the edge, or of another bar."""
    counts, better, reads = facts.counts, facts.better, facts.reads or not facts.surveyed
    frames, rejected = counts.get("frames", 0), counts.get("frames_rejected", 0)
    text = f"{frames} of {frames + rejected} frames accepted"
    given, erased = (sum(getattr(one, name) for one in facts.tally.own) for name in ("given", "erased"))
    unseen = erased / max(given + erased, 1)
    share = _REJECTED_SHARE
    if facts.blocks_read > counts.get("blocks_failed", 0):
        share = _REJECTED_BESIDE_READ_SHARE
    if facts.inverted:
        step = f"{_TURN_LIST}; else exchange them where it is written"
        yield Diagnostic("polarity", f"{text}; all fit where ON and OFF are exchanged", step)
    elif not reads and better is not None:
        with_it = f"{better.frames} of {better.frames + better.rejected} by another link"
        yield Diagnostic("link", f"{text}, {with_it}", better.options())
    elif facts.at_edge and (not reads or unseen > _UNSEEN_SHARE):
        yield Diagnostic(
            "outside",
            f"{text}, {unseen:.0%} of their clusters unseen; the source touches the picture's edge",
            "turn the camera so that the whole bar is in the picture",
        )
    elif not reads or (rejected >= FEW_FRAMES and rejected > share * (frames + rejected)):
        step = "compare the link's [bar], [pilots] and [air] with the transmitter's, or try --link auto"
        yield Diagnostic(
            "frames-rejected",
            f"{rejected} of {frames + rejected} frames rejected, as their clusters do not stand where the bar"
            " has them",
            # A diagnosis has tried the latter.
            step if facts.surveyed else f"{step}; {_TURN_LIST}; `evlcp diagnose` looks further",
        )
    else:
        yield text


def check_kinds_of_frames(facts: Facts) -> Found:
    """Frames that show nothing sure, or a light or a bar that is another way round than is stated."""
    counts, frames = facts.counts, facts.counts.get("frames", 0)
    unread = counts.get("frames_unread", 0)
    # Of several links those that another one fits better may all be among them.
    inverted = counts.get("frames_inverted", 0) - counts.get("frames_of_others", 0)
    for code, number, due, share, text, step in (
        (
            "frames-unread",
            unread,
            frames + unread,
            _REJECTED_SHARE,
            "show their clusters, but not one symbol that is sure",
            "compare modulation.id with the transmitter's; in little light another decoding.id may do",
        ),
        (
            "polarity",
            inverted,
            frames,
            _INVERTED_SHARE,
            "fit only a light that is on where the link says off, and were read so",
            "compare framing.idle with the transmitter, and the polarities of a list: list:PATH?inverted=1"
            " turns them",
        ),
        (
            "attitude",
            counts.get("frames_askew", 0),
            frames,
            _ASKEW_SHARE,
            "show bars that do not stand plumb by the camera's attitude, which does not"
            " correct their distances",
            "check pitch and roll, their signs and their sigma",
        ),
    ):
        if due and number >= FEW_FRAMES and number > share * due:
            yield Diagnostic(code, f"{min(number, due)} of {due} frames {text}", step)


def check_flooded(facts: Facts) -> Found:
    """Frames that a step of light leaves without a symbol."""
    if flooded := facts.counts.get("frames_flooded", 0):
        text = f"no symbol in {flooded} of {facts.counts['frames']} frames, as all light changed in them"
        yield Diagnostic("light-steps", text, verdict="note")


def check_reflection(_facts: Facts, one: TransmitterTally) -> Found:
    """A transmitter that is a reflection of another one."""
    if one.echoes and one.echo_of is not None:
        text = f"a reflection of transmitter {one.echo_of}, {format_count(one.echoes, 'frame')}"
        step = "or a much weaker bar that says the same; in either case it is left out"
        yield Diagnostic("reflection", text, step, verdict="note")


def check_restart(facts: Facts, one: TransmitterTally) -> Found:
    """A transmitter that has begun anew in the place of another one."""
    left, top, right, bottom = one.passed_px
    for old in facts.tally.transmitters.values() if facts.counts.get("restarts") else ():
        between_us = one.first_us - old.last_us
        x0, y0, x1, y1 = old.passed_px
        moved_px = max(left - x1, x0 - right, top - y1, y0 - bottom)
        if 0 < between_us < _ANEW_PACKETS * facts.link.packet.packet_us and moved_px < _ANEW_PX:
            at = in_ms(one.first_us - facts.first_us)
            text = f"it is transmitter {old.number}, begun anew {at} into the recording, as after a reset"
            yield Diagnostic("restart", text, verdict="note")


def check_alike(facts: Facts) -> Found:
    """Bars that send the same at the same time: a warning where it matters which is which."""
    alike = facts.counts.get("frames_alike", 0)
    if alike:
        frames = format_count(alike, "frame")
        text = f"{frames} of bars, or of a bright mirror, that send the same at the same time"
        asked = {"positions": facts.positions_tried, "messages": facts.tally.messages()}
        what = [name for name, found in asked.items() if found]
        step = f"give each bar messages of its own: {' and '.join(what)} cannot say which is which"
        yield Diagnostic("same-symbols", text, step if what else "", verdict="doubt" if what else "note")


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


def check_hidden(facts: Facts, one: TransmitterTally) -> Found:
    """Clusters that no frame shows."""
    hidden = [k for k in range(facts.link.codebook.clusters) if one.unseen[k] == one.frames]
    if hidden:
        yield Diagnostic(
            "clusters-hidden",
            f"clusters never seen: {', '.join(map(str, hidden))}",
            "is something before them? are LEDs dead? if not, compare the link's [bar] and [pilots] with it",
        )


def check_lit(facts: Facts, one: TransmitterTally) -> Found:
    """Light that is there before the first frame or after the last one."""
    lit = (facts.lit_us or {}).get(one.number)
    if one.frames == one.echoes or lit is None or not facts.duration_us:
        return
    least_us = max(_LIT_SHARE * facts.duration_us, _LIT_PACKETS * facts.link.packet.packet_us)
    at = [in_ms(t_us - facts.first_us) for t_us in (one.first_us, lit[0], one.last_us, lit[1])]
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


def check_orientation(facts: Facts, one: TransmitterTally) -> Found:
    """A bar that is mirrored or on its head in the picture; where positions are computed, they tell."""
    if facts.positions or one.sized < FEW_FRAMES:
        return
    centres_m = facts.link.bar.cluster_centres_m()
    along_px, way_m = np.array(one.along_px), centres_m[-1] - centres_m[0]
    parts = along_px * way_m / max(math.hypot(*along_px) * math.hypot(*way_m), 1e-12)
    # A panel that is turned by a quarter looks mirrored, too: who asks is told.
    mirrored = facts.surveyed and parts.min() < _MIRRORED
    how = "upside down" if parts.sum() < _HEAD_DOWN else "mirrored" if mirrored else ""
    if how:
        yield Diagnostic(
            "turned",
            f"its clusters stand the other way round, {how}; its symbols and distances are right,"
            " positions are not",
            "turn the camera, or flip rows where it is read, unless the bar is mounted so (a column does not"
            " say whether left and right are mirrored, too)",
        )
    else:
        yield "clusters stand as in the link's bar"


def check_codewords(facts: Facts, one: TransmitterTally) -> Found:
    """Codewords that never occur, and the modulation that they are all of."""
    link, codewords, name = facts.link, facts.link.codebook.data_symbols, facts.better_value("modulation.id")
    never = count_missing_codewords(one, link)
    if not never and name is None:
        yield f"all of {codewords} that should occur do"
        return
    text = f"only {len(one.values)} of {codewords} symbols ever occur"
    if not never:
        text = f"mean quality of {one.frames} frames {one.quality_sum / one.frames:.2f}"
    for other, words in facts.others().items() if name is None else ():
        inside = np.flatnonzero(_among(link.codebook.codewords, words)).tolist()
        received = [s for s in inside if one.values[s]]
        share = sum(one.values[s] for s in received) / one.given
        if len(words) < codewords and share >= _SPLIT and len(received) > len(words) / 2:
            name = other
            if len(one.values) > len(words):
                text = f"{share:.0%} of its symbols are {len(received)} of {codewords}"
            break
    tried = facts.counts.get("blocks_tried", 0)
    unread = f", {tried} of {tried} blocks unreadable" if tried and not facts.blocks_read else ""
    if name is not None:
        step = f"was this sent with {name}? try --set modulation.id={name}"
        yield Diagnostic("profile", text + unread, step, verdict="fail")
    else:
        yield Diagnostic(
            "codewords",
            f"{never} of {codewords} codewords never occur in {one.given} symbols{unread}",
            "data that repeats, or another modulation than modulation.id",
        )


def check_bit_order(facts: Facts, one: TransmitterTally) -> Found:
    """Characters that are text if their bits come the other way round."""
    if not facts.link.characters_on_air or one.blocks or one.given < FEW_FRAMES:
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
    elif quality < (SURE if facts.surveyed else _LEAST_QUALITY):
        text = f"{1 - quality:.0%} of its frames have a symbol that is wrong, by the receiver's own account"
    else:
        return
    own, others = facts.link.codebook.codewords, facts.others().items()
    larger = [name for name, words in others if len(words) > len(own) and _among(own, words).all()]
    asked = f"was this sent with {' or '.join(larger)} (modulation.id)? if not, " if larger else ""
    ask = "" if facts.surveyed else "; `evlcp diagnose` says what it lacks"
    yield Diagnostic("unsure", text, f"{asked}{BRIGHTER}, a sharper image, or another decoding.id{ask}")


def _among(words: NDArray[np.uint8], others: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which words are others, too, bool (symbols,); none where they are of another length."""
    if words.shape[1] != others.shape[1]:
        return np.zeros(len(words), np.bool_)
    return np.asarray((words[:, None] == others).all(-1).any(-1))


def check_distances(facts: Facts, one: TransmitterTally) -> Found:
    """Frames without a distance."""
    link = facts.link
    if "ranging" not in link.algorithms or not link.algorithm("ranging").measures:
        return
    # What was left out for lack of time, of whichever transmitter, says nothing of the bar.
    own = (one.frames - one.echoes) / link.packet.pilot_every - facts.counts.get("frames_not_ranged", 0)
    text = f"{one.ranged} of {max(own, one.ranged):.0f} frames have a distance"
    if one.ranged < _RANGED_SHARE * own:
        why = "too few boundaries between clusters are seen, or their values do not fit the layout"
        yield Diagnostic("few-distances", f"{text}: {why}", "another ranging.id may tolerate it")
    else:
        yield text


def check_bent(facts: Facts, one: TransmitterTally) -> Found:
    """Clusters that stand off a straight bar, in the mean over the frames whose image is bent."""
    if one.bent < max(FEW_FRAMES, _BENT_SHARE * one.ranged):
        return
    seen = np.flatnonzero(one.bent_px[0] >= FEW_FRAMES)
    count, total, squares = one.bent_px[:, seen]
    mean_px = total / count
    noise_px = np.sqrt(np.maximum(squares / count - mean_px**2, 0) * CORRELATED_FRAMES / count)
    off = np.abs(mean_px) > np.maximum(_STANDING_OFF * noise_px, _STANDING_PX)
    if not off.any():
        return
    # A boundary moves towards the cluster that lacks light there.
    clusters = ", ".join(map(str, sorted({*(seen + (mean_px > 0))[off].tolist()})))
    most_px, correlated = float(np.abs(mean_px).max()), are_correlated(mean_px)
    most_cm = most_px * 100 * one.median_m() / facts.link.camera.focal_px
    yield Diagnostic(
        "image-bent",
        f"its image is bent in {one.bent} of {one.ranged} frames (their sigma {one.bent_sigma_m:.2g} m):"
        f" clusters {clusters} by up to {most_px:.2f} px, {most_cm:.1f} cm at the bar,"
        f" {'neighbours alike' if correlated else 'each by itself'}",
        "clean what is before the camera: drops and uneven glass do this"
        if correlated
        else "look for LEDs of theirs that are dark, or hidden",
    )


def check_size(facts: Facts, one: TransmitterTally) -> Found:
    """Distances against those that the bar's length in the picture gives."""
    if one.sized < FEW_FRAMES:
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


def check_messages(facts: Facts) -> Found:
    """Packets of another codebook, or that cannot be read though they repeat others; or no messages."""
    if not facts.reads_messages:
        yield Diagnostic("messages", "not looked for", verdict="skip")
        return
    counts, tried = facts.counts, facts.counts.get("blocks_tried", 0)
    if other := counts.get("blocks_other_codebook", 0):
        text = f"{format_count(other, 'packet')} sent with another codebook"
        yield Diagnostic("other-codebook", text, "compare both ends' `evlcp config`")
    text = f"{facts.blocks_read or 'none'} of {format_count(tried, 'packet')} with a block that can be read"
    alike = counts.get("blocks_alike", 0)
    if not facts.blocks_read and alike >= _ALIKE:
        yield Diagnostic(
            "blocks-unread",
            f"{text}, though {alike} of them repeat others",
            "another error correction than error-correction.id, or frames taken from another place in the"
            " packet than they were sent in; if no messages are sent, say messages.decode = false",
        )
    elif tried and not facts.blocks_read:
        step = "right for symbols without messages; else compare error-correction.id with the transmitter's"
        yield Diagnostic("no-messages", f"no messages: {text}", step, verdict="note")
    elif tried:
        yield text


def check_packets(facts: Facts, one: TransmitterTally) -> Found:
    """Packets without a block of a transmitter that sends some; another one may send none at all."""
    failed = one.packets - one.blocks
    if one.blocks and failed >= FEW_FRAMES and failed > _FAILED_SHARE * one.packets:
        yield Diagnostic(
            "blocks-failed",
            f"{failed} of {one.packets} packets cannot be read",
            "events came too late to be read: a quicker machine, or fewer events"
            if facts.late_events
            else "more light, a nearer or a better focused bar, or an error correction of a lower rate",
        )
