"""Checks of what a link receives: its frames, their symbols and distances, and messages."""

import math

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.facts import BRIGHTER, Diagnostic, Facts, Findings, format_ms, measure_gap_px
from evlcp_sdk.diagnosis.tallies import SURE, TransmitterTally, count_missing_codewords
from evlcp_sdk.formatting import format_count
from evlcp_sdk.rx.distortion import CORRELATED_FRAMES, are_correlated

FEW_FRAMES = 10
"""Frames of a packet by default: fewer are not checked."""

_REJECTED_SHARE = 0.1
"""Share of rejected frames, or unread ones, above which they are reported: a bar that enters or leaves the
picture loses a frame or two."""

_REJECTED_BESIDE_READ_SHARE = 0.3
"""The same of rejected frames where most blocks are decoded, so that the link is right: a false lock costs a
packet; of three bars, one of another layout is still reported."""

_ASKEW_SHARE = 0.5
"""Share of frames that contradict the attitude: fewer are one bar of several that is mounted askew."""

_INVERTED_SHARE = 0.5
"""Share of frames that fit only a light that is on where the link says off: a link is wrong for all."""

_UNSEEN_SHARE = 0.05
"""Share of unseen clusters at the picture's edge, above which it is reported."""

_CRYSTALS_PPM = 200.0
"""Two crystals are this far apart at most, 100 ppm each."""

_MIN_CHARACTERS, _SAME_CHARACTER_SHARE = 50, 0.95
"""Of so many characters, no such share is the same one in a text, nor in other data of some content."""

_OTHER_CODE_SHARE = 0.9
"""Share of the symbols that are another modulation's, from which on that one is inferred."""

_UNSURE_SHARE = 0.3
"""Share of symbols of every cluster that are not given, from which on it is reported."""

_MIN_QUALITY = 0.4
"""Mean probability that all symbols of a frame are right, below which it is reported: of a bar 180 m away,
with 2.4 px a cluster, it is .75. A diagnosis reports it below `SURE`."""

_RANGED_SHARE = 0.25
"""Share of frames with a distance below which it is reported."""

_DISTORTED_SHARE = 0.1
"""Share of frames with a distorted image from which on it is reported: drops run down, poles pass."""

_DISTORTION_SIGMAS, _DISTORTION_PX = 4.0, 0.25
"""Mean offset of a boundary, in sigmas, 1 of 16000 by chance, and px, beyond which it is reported: where
nothing moves, those between two pixels are off by up to a fifth of one."""

_SIZE_TOLERANCE = 0.1
"""Relative difference of distances to those by the bar's length in the picture: distances of far bars, and
of tilted ones, are off by some percent."""

_LENGTH_TOLERANCE = 0.02
"""Relative difference of a beacon's length of its bar to the link's: both are measured by hand."""

_UPSIDE_DOWN, _MIRRORED = -0.5, -0.25
"""Cosine between a bar and its image below which it is upside down, as a horizontal one may point either
way; and the part of it, of one axis alone, below which left and right are exchanged."""

_RESTART_PACKETS, _RESTART_PX = 3, 30.0
"""Most packets between the last frame before a reset and the first after it, which takes two preambles, and
how far the image moves in between."""

_LIT_SHARE, _LIT_PACKETS = 0.2, 3
"""Share of a recording, and packets, for which a bar in the picture without a frame is not reported."""

_MIN_REPEATS = 3
"""Packets that repeat others, though none is decoded, from which on they carry a message."""

_FAILED_SHARE = 0.5
"""Share of packets that cannot be decoded, where others can, above which it is reported."""


_INVERT_LIST = "list:PATH?inverted=1 turns the polarities of a list"
"""The next step where ON and OFF may be exchanged."""


def check_frames(facts: Facts) -> Findings:
    """Due frames that are rejected: of another link, of a bar at the edge, or of another bar."""
    counts, better, reads = facts.counts, facts.better_trial, facts.is_read or not facts.has_survey
    frames, rejected = counts.get("frames", 0), counts.get("frames_rejected", 0)
    text = f"{frames} of {frames + rejected} frames accepted"
    given = sum(one.symbols_given for one in facts.tally.non_reflections)
    erased = sum(one.symbols_erased for one in facts.tally.non_reflections)
    unseen = erased / max(given + erased, 1)
    share = _REJECTED_SHARE
    if facts.blocks_read > counts.get("blocks_failed", 0):
        share = _REJECTED_BESIDE_READ_SHARE
    if facts.fits_inverted:
        step = f"{_INVERT_LIST}; else exchange them where it is written"
        yield Diagnostic("polarity", f"{text}; all fit where ON and OFF are exchanged", step)
    elif not reads and better is not None:
        by_other = f"{better.frames} of {better.frames + better.rejected} by another link"
        yield Diagnostic("link", f"{text}, {by_other}", better.options())
    elif facts.touches_edge and (not reads or unseen > _UNSEEN_SHARE):
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
            step if facts.has_survey else f"{step}; {_INVERT_LIST}; `evlcp diagnose` looks further",
        )
    else:
        yield text


def check_frame_kinds(facts: Facts) -> Findings:
    """Frames without a reliable symbol, or that contradict the stated polarity or attitude."""
    counts, frames = facts.counts, facts.counts.get("frames", 0)
    unread = counts.get("frames_unread", 0)
    # Without those that another link may fit better.
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


def check_flooded_frames(facts: Facts) -> Findings:
    """Frames without a symbol, due to a step of light."""
    if flooded := facts.counts.get("frames_flooded", 0):
        text = f"no symbol in {flooded} of {facts.counts['frames']} frames, as all light changed in them"
        yield Diagnostic("light-steps", text, verdict="note")


def check_reflection(_facts: Facts, one: TransmitterTally) -> Findings:
    """A transmitter that is a reflection of another one."""
    if one.echo_frames and one.echo_of is not None:
        text = f"a reflection of transmitter {one.echo_of}, {format_count(one.echo_frames, 'frame')}"
        step = "or a much weaker bar that says the same; in either case it is left out"
        yield Diagnostic("reflection", text, step, verdict="note")


def check_restart(facts: Facts, one: TransmitterTally) -> Findings:
    """A transmitter that has restarted in the place of another one."""
    for old in facts.tally.transmitters.values() if facts.counts.get("restarts") else ():
        gap_us = one.first_us - old.last_us
        moved_px = measure_gap_px(one.path_box_px, old.path_box_px)
        if 0 < gap_us < _RESTART_PACKETS * facts.link.packet.packet_us and moved_px < _RESTART_PX:
            time = format_ms(one.first_us - facts.first_us)
            text = f"it is transmitter {old.number}, begun anew {time} into the recording, as after a reset"
            yield Diagnostic("restart", text, verdict="note")


def check_same_symbols(facts: Facts) -> Findings:
    """Bars that send the same at the same time: a warning where it matters which one it is."""
    alike = facts.counts.get("frames_alike", 0)
    if alike:
        frames = format_count(alike, "frame")
        text = f"{frames} of bars, or of a bright mirror, that send the same at the same time"
        results = {"positions": facts.positions_tried, "messages": facts.tally.messages()}
        affected = [name for name, result in results.items() if result]
        step = f"give each bar messages of its own: {' and '.join(affected)} cannot say which is which"
        yield Diagnostic(
            "same-symbols", text, step if affected else "", verdict="doubt" if affected else "note"
        )


def check_clock(facts: Facts, one: TransmitterTally) -> Findings:
    """A clock that is off by more than any crystal."""
    packet, ppm = facts.link.packet, one.clock_ppm()
    # A packet's time may be half a chip off where the light changes.
    error_ppm = packet.chip_us / 2 / one.steps_us * 1e6 if one.steps_us else math.inf
    if abs(ppm) > _CRYSTALS_PPM + error_ppm:
        yield Diagnostic(
            "clock",
            f"its clock is {ppm:+.0f} ppm off the link's, crystals stay within {_CRYSTALS_PPM:.0f}",
            f"air.chip_rate_hz = {packet.chip_rate_hz * (1 + ppm * 1e-6):.6g} would fit",
        )


def check_hidden_clusters(facts: Facts, one: TransmitterTally) -> Findings:
    """Clusters that no frame shows."""
    hidden = [k for k in range(facts.link.codebook.clusters) if one.unseen_counts[k] == one.frames]
    if hidden:
        yield Diagnostic(
            "clusters-hidden",
            f"clusters never seen: {', '.join(map(str, hidden))}",
            "is something before them? are LEDs dead? if not, compare the link's [bar] and [pilots] with it",
        )


def check_light_span(facts: Facts, one: TransmitterTally) -> Findings:
    """Light long before the first frame or after the last one."""
    lit = (facts.lit_us or {}).get(one.number)
    if one.frames == one.echo_frames or lit is None or not facts.duration_us:
        return
    min_us = max(_LIT_SHARE * facts.duration_us, _LIT_PACKETS * facts.link.packet.packet_us)
    at = [format_ms(t_us - facts.first_us) for t_us in (one.first_us, lit[0], one.last_us, lit[1])]
    parts = []
    if one.first_us - lit[0] > min_us:
        parts.append(f"nothing before {at[0]}, though its light is there from {at[1]} on")
    if lit[1] - one.last_us > min_us:
        parts.append(f"nothing after {at[2]}, though its light is there until {at[3]}")
    if parts:
        yield Diagnostic(
            "coverage",
            "; ".join(parts),
            "compare air.chip_rate_hz and air.frames_per_packet with the transmitter's, or try --link auto",
        )


def check_orientation(facts: Facts, one: TransmitterTally) -> Findings:
    """A bar that is mirrored or upside down in the picture; where positions are computed, they show it."""
    if facts.positions or one.sized_frames < FEW_FRAMES:
        return
    centres_m = facts.link.bar.cluster_centres_m()
    along_px, along_m = np.array(one.along_px), centres_m[-1] - centres_m[0]
    parts = along_px * along_m / max(math.hypot(*along_px) * math.hypot(*along_m), 1e-12)
    # A panel that is turned by a quarter looks mirrored, too: only a diagnosis reports it.
    mirrored = facts.has_survey and parts.min() < _MIRRORED
    orientation = "upside down" if parts.sum() < _UPSIDE_DOWN else "mirrored" if mirrored else ""
    if orientation:
        yield Diagnostic(
            "turned",
            f"its clusters stand the other way round, {orientation}; its symbols and distances are right,"
            " positions are not",
            "turn the camera, or flip rows where it is read, unless the bar is mounted so (a column does not"
            " say whether left and right are mirrored, too)",
        )
    else:
        yield "clusters stand as in the link's bar"


def check_codewords(facts: Facts, one: TransmitterTally) -> Findings:
    """Codewords that never occur, and the modulation whose all others are."""
    link, codewords, name = facts.link, facts.link.codebook.data_symbols, facts.better_value("modulation.id")
    missing = count_missing_codewords(one, link)
    if not missing and name is None:
        yield f"all of {codewords} that should occur do"
        return
    text = f"only {len(one.symbol_counts)} of {codewords} symbols ever occur"
    if not missing:
        text = f"mean quality of {one.frames} frames {one.quality_sum / one.frames:.2f}"
    for other, words in facts.other_codewords().items() if name is None else ():
        inside = np.flatnonzero(_find_codewords(link.codebook.codewords, words)).tolist()
        received = [s for s in inside if one.symbol_counts[s]]
        share = sum(one.symbol_counts[s] for s in received) / one.symbols_given
        if len(words) < codewords and share >= _OTHER_CODE_SHARE and len(received) > len(words) / 2:
            name = other
            if len(one.symbol_counts) > len(words):
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
            f"{missing} of {codewords} codewords never occur in {one.symbols_given} symbols{unread}",
            "data that repeats, or another modulation than modulation.id",
        )


def check_bit_order(facts: Facts, one: TransmitterTally) -> Findings:
    """Characters that are text if their bits are reversed."""
    if not facts.link.characters_on_air or one.blocks or one.symbols_given < FEW_FRAMES:
        return
    bits = facts.link.codebook.bits_per_symbol
    text = {*range(0x20, 0x7F), 0x09, 0x0A, 0x0D}
    # Blanks and small letters are most of any text.
    common = {0x20, *range(0x61, 0x7B)}
    reversed_bits = {s: int(f"{s:0{bits}b}"[::-1], 2) for s in one.symbol_counts}
    counts = one.symbol_counts
    own, other = (
        [sum(counts[s] for s in counts if code(s) in of) / one.symbols_given for of in (text, common)]
        for code in (int, reversed_bits.__getitem__)
    )
    if other[0] > _OTHER_CODE_SHARE > own[0] + 0.1 and other[1] > own[1]:
        yield Diagnostic(
            "bit-order",
            f"{own[0]:.0%} of its characters are printable, and {other[0]:.0%} if their bits come the other"
            " way round",
            "compare framing.first_bit with the transmitter",
        )


def check_characters(facts: Facts, one: TransmitterTally) -> Findings:
    """Characters that are all the same, as of a lamp that blinks once in a character's time."""
    if not facts.link.characters_on_air or one.blocks or one.symbols_given < _MIN_CHARACTERS:
        return
    ((value, times),) = one.symbol_counts.most_common(1)
    if times > _SAME_CHARACTER_SHARE * one.symbols_given:
        digits = (facts.link.codebook.bits_per_symbol + 3) // 4
        yield Diagnostic(
            "one-character",
            f"{times} of its {one.symbols_given} characters are 0x{value:0{digits}x}: a lamp that blinks"
            " once in a character's time reads like that",
            "look where it stands in the picture",
        )


def check_symbols(facts: Facts, one: TransmitterTally) -> Findings:
    """Symbols that are not given, of every cluster, or that are probably wrong.

    Something that hides a part of a bar is no fault of the link's.
    """
    clusters = [k for k in range(facts.link.codebook.clusters) if one.unseen_counts[k] < one.frames]
    quality = one.quality_sum / one.frames
    if clusters and min(one.unseen_counts[k] for k in clusters) >= _UNSURE_SHARE * one.frames:
        share = sum(one.unseen_counts[k] for k in clusters) / (one.frames * len(clusters))
        text = f"{share:.0%} of its symbols are not sure, of every cluster {_UNSURE_SHARE:.0%} and more"
    elif quality < (SURE if facts.has_survey else _MIN_QUALITY):
        text = f"{1 - quality:.0%} of its frames have a symbol that is wrong, by the receiver's own account"
    else:
        return
    own, others = facts.link.codebook.codewords, facts.other_codewords().items()
    larger = [name for name, words in others if len(words) > len(own) and _find_codewords(own, words).all()]
    question = f"was this sent with {' or '.join(larger)} (modulation.id)? if not, " if larger else ""
    hint = "" if facts.has_survey else "; `evlcp diagnose` says what it lacks"
    yield Diagnostic("unsure", text, f"{question}{BRIGHTER}, a sharper image, or another decoding.id{hint}")


def _find_codewords(words: NDArray[np.uint8], others: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which words are among others, bool (symbols,); none where these are of another length."""
    if words.shape[1] != others.shape[1]:
        return np.zeros(len(words), np.bool_)
    return np.asarray((words[:, None] == others).all(-1).any(-1))


def check_distances(facts: Facts, one: TransmitterTally) -> Findings:
    """Frames without a distance."""
    link = facts.link
    if "ranging" not in link.algorithms or not link.algorithm("ranging").measures:
        return
    # Frames without ranging for lack of time, of any transmitter, do not count.
    due = (one.frames - one.echo_frames) / link.packet.pilot_every - facts.counts.get("frames_not_ranged", 0)
    text = f"{one.ranged_frames} of {max(due, one.ranged_frames):.0f} frames have a distance"
    if one.ranged_frames < _RANGED_SHARE * due:
        reason = "too few boundaries between clusters are seen, or their values do not fit the layout"
        yield Diagnostic("few-distances", f"{text}: {reason}", "another ranging.id may tolerate it")
    else:
        yield text


def check_distortion(facts: Facts, one: TransmitterTally) -> Findings:
    """Clusters off a straight bar, in the mean over the frames with a distorted image."""
    if one.distorted_frames < max(FEW_FRAMES, _DISTORTED_SHARE * one.ranged_frames):
        return
    seen = np.flatnonzero(one.distortion_px[0] >= FEW_FRAMES)
    count, total, squares = one.distortion_px[:, seen]
    mean_px = total / count
    noise_px = np.sqrt(np.maximum(squares / count - mean_px**2, 0) * CORRELATED_FRAMES / count)
    off = np.abs(mean_px) > np.maximum(_DISTORTION_SIGMAS * noise_px, _DISTORTION_PX)
    if not off.any():
        return
    # A boundary moves towards the cluster that lacks light.
    clusters = ", ".join(map(str, sorted({*(seen + (mean_px > 0))[off].tolist()})))
    max_px, correlated = float(np.abs(mean_px).max()), are_correlated(mean_px)
    max_cm = max_px * 100 * one.median_m() / facts.link.camera.focal_px
    yield Diagnostic(
        "image-bent",
        f"its image is bent in {one.distorted_frames} of {one.ranged_frames} frames"
        f" (their sigma {one.distortion_sigma_m:.2g} m):"
        f" clusters {clusters} by up to {max_px:.2f} px, {max_cm:.1f} cm at the bar,"
        f" {'neighbours alike' if correlated else 'each by itself'}",
        "clean what is before the camera: drops and uneven glass do this"
        if correlated
        else "look for LEDs of theirs that are dark, or hidden",
    )


def check_size(facts: Facts, one: TransmitterTally) -> Findings:
    """Distances against those by the bar's length in the picture."""
    if one.sized_frames < FEW_FRAMES:
        return
    link, centres_m = facts.link, facts.link.bar.cluster_centres_m()
    reach = math.exp(one.reach_sum / one.sized_frames)
    share = reach / (link.camera.focal_px * math.dist(centres_m[0], centres_m[-1])) - 1
    if abs(share) > _SIZE_TOLERANCE:
        yield Diagnostic(
            "size",
            f"its distances are {abs(share):.0%} too {'long' if share > 0 else 'short'} for a bar of"
            f" {link.bar.length_m:g} m that looks as long as this one",
            "try another ranging.id; a bar that leans looks shorter",
        )


def check_length(facts: Facts, one: TransmitterTally) -> Findings:
    """The bar's length by its own beacon."""
    beacon_m, length_m = one.beacon_m, facts.link.bar.length_m
    if abs(beacon_m / length_m - 1) > _LENGTH_TOLERANCE:
        error = f"{abs(length_m / beacon_m - 1):.0%} too {'long' if length_m > beacon_m else 'short'}"
        yield Diagnostic(
            "bar-length",
            f"its beacon says that the bar is {beacon_m:.3f} m long, the link {length_m:.3f}: its distances"
            f" are {error} if the beacon is right",
            "compare the link's [bar] with the transmitter's",
        )


def check_messages(facts: Facts) -> Findings:
    """Packets of another codebook, packets that repeat others without being decoded, or no messages."""
    if not facts.reads_messages:
        yield Diagnostic("messages", "not looked for", verdict="skip")
        return
    counts, tried = facts.counts, facts.counts.get("blocks_tried", 0)
    if other := counts.get("blocks_other_codebook", 0):
        text = f"{format_count(other, 'packet')} sent with another codebook"
        yield Diagnostic("other-codebook", text, "compare both ends' `evlcp config`")
    text = f"{facts.blocks_read or 'none'} of {format_count(tried, 'packet')} with a block that can be read"
    alike = counts.get("blocks_alike", 0)
    if not facts.blocks_read and alike >= _MIN_REPEATS:
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


def check_packets(facts: Facts, one: TransmitterTally) -> Findings:
    """Packets without a decoded block, of a transmitter that has some."""
    failed = one.packets - one.blocks
    if one.blocks and failed >= FEW_FRAMES and failed > _FAILED_SHARE * one.packets:
        yield Diagnostic(
            "blocks-failed",
            f"{failed} of {one.packets} packets cannot be read",
            "events came too late to be read: a quicker machine, or fewer events"
            if facts.late_events
            else "more light, a nearer or a better focused bar, or an error correction of a lower rate",
        )
