"""Checks of a recording and of the light in it, from its events to the preamble; most need a survey."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from evlcp_sdk.diagnosis.facts import (
    BRIGHTER,
    Diagnostic,
    Facts,
    Findings,
    format_ms,
    has_rate,
    measure_gap_px,
)
from evlcp_sdk.formatting import format_count
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.several import find_ambiguous_links

if TYPE_CHECKING:
    from evlcp_sdk.diagnosis.light import LightSource

_DROPPED_SHARE, _MIN_DROPPED = 0.001, 100
"""Dropped events that are reported, by share and number. A restart of the camera costs fewer."""

_ROOM_COUNTS = (
    ("dropped_crowded", "{} event{} of crowded time steps dropped"),
    ("dropped_no_room", "{} event{} of regions forgotten early"),
    ("frames_cut", "{} frame{} passed over for it"),
    ("regions_left_out", "{} time{} a region more was not followed"),
    ("regions_gave_way", "{} region{} without a bar let go for others"),
)
"""Counts of what was dropped for lack of room, and their texts."""

_COVERED_SHARE = 0.5
"""Share of a recording with frames below which the gaps are reported."""

_FEW_NEGATIVE = 0.1
"""Share of negative events below which some are missing: light goes off as often as on."""

_ONE_SIGN_SHARE, _ONE_SIGN_EVENTS = 0.02, 100
"""Without a survey: share of the rarer sign below which one kind of edges is missing, and events that are
needed. A light that goes on goes off again: cameras of unequal thresholds still give a tenth; noise alone may
give a few of either."""

_BLIND_CHIPS = 1.1
"""Time between events of a pixel, in chips, above which edges one chip apart are lost."""

_UNREADABLE_PX, _SMALL_PX = 1.5, 2.5
"""Pixels a cluster below which clusters cannot be separated, and below which errors are to be expected: two
samples a cluster are the least, and the pixels between two clusters show both."""

_SMEARED_CLUSTERS, _SHARP_PX = 2.0, 5.0
"""Width of a source, in clusters, above which the light of each covers its neighbours on both sides; and the
largest width of a column of LEDs in focus."""

_RARE_CHIPS, _WEAK = 5.0, 0.35
"""Median time between rises, in chips, above which, and strength, below which, light is too weak: a code
rises every 2.7 chips, and jitter of 20 us leaves .45 of the strength at 10 kHz."""

_ROW_US, _SLOW_SHARE = 0.2, 0.7
"""Time in which an IMX636 reads a row, by its latency against the lit area; and share of a chip above which
reading a bar's rows, one after another, mixes its edges with the next chip's."""

_MIN_RISES, _MIN_RATE_SHARE, _MIN_ASPECT = 500, 0.25, 4.0
"""Least rises, share of the link's rate and ratio of length to width of an unread bar. Passing leaves and
edges look like a code of some hundred chips a second, a lamp with missed periods like one of some
thousand."""

_ROUND_CHIPS = 0.75
"""Chips between two readings of a row from which on events of two edges, each of which takes 25 us, are read
together: at 17 m a bar is read without errors at .7."""

_GLOW_PX = 32
"""Gap up to which light beside a bar is its glow."""

_MIN_EVENT_SHARE = 0.02
"""Share of all events below which a source that sends no chips is not reported."""

_BLURRED_SHARE = 0.2
"""Ratio of width to length above which a flickering source is defocused."""

_RATE_TOLERANCE = 0.03
"""Relative difference of two equal rates."""

_MANY_EVENTS = 100_000
"""In regions without a preamble, above which it is reported: a bar sends so many in 20 ms, a lamp in a
second."""

_SHARPER = "focus the lens, clean it and the window; a smaller aperture is sharper"


def check_events(facts: Facts) -> Findings:
    """The number of events, and of those dropped for other reasons than room."""
    events = facts.counts.get("events", 0)
    losses = f"; lost: {'; '.join(map(str, facts.losses))}" if facts.losses else ""
    no_room = [name for name, _ in _ROOM_COUNTS]
    dropped = {n: k for n, k in facts.counts.items() if n.startswith("dropped_") and k and n not in no_room}
    lost = sum(loss.count for loss in facts.losses)
    number = sum(dropped.values()) + lost
    if number >= _MIN_DROPPED and number > _DROPPED_SHARE * (events + lost):
        kinds = [f"{k} {n.removeprefix('dropped_').replace('_', ' ')}" for n, k in dropped.items()]
        kinds += [f"{lost} in the file"] * (lost > 0)
        step = "losses and counts in summary.json say where and why, `evlcp info` what is in the recording"
        if 2 * dropped.get("dropped_off_sensor", 0) > number:
            step = "compare camera.width and camera.height with the sensor's"
        yield Diagnostic("dropped", f"{number} events or words dropped ({', '.join(kinds)})", step)
    if events or "events" not in facts.counts:
        yield f"{events:,} events in {facts.duration_us * 1e-6:.3f} s{losses}"
    else:
        step = "record again: `evlcp info` says what is in the file"
        yield Diagnostic("empty", f"no events{losses}", step, verdict="fail")


def check_times(facts: Facts) -> Findings:
    """Times in steps of more than a quarter of a chip, and guessed properties."""
    chip_us = min(one.link.packet.chip_us for one in (facts, *facts.parts.values()))
    grain = facts.readout.grain
    step_us = max(facts.step_us, grain.step_us if grain.known_us is not None else 0)
    if step_us > chip_us / 4:
        step = "export them in whole microseconds, or with six decimals of a second; of a sensor that reads"
        step += f" images, four to a chip: air.chip_rate_hz = {1e6 / (4 * step_us):.4g}"
        step = f"see first whether their unit is right; if so, {step}" if facts.guessed else step
        text = f"times come in steps of {step_us / 1000:g} ms; a chip is {chip_us / 1000:g} ms"
        yield Diagnostic("coarse-times", text, step, verdict="fail" if step_us > chip_us else "doubt")
    if facts.guessed:
        step = "where that is wrong, name the file with its unit and columns: list:PATH?unit=us&columns=t,p"
        yield Diagnostic("guessed", facts.guessed, step, verdict="note")
    silences, silent_us = facts.skipped_silences
    if silences:
        text = f"{format_count(silences, 'silence')} of {silent_us * 1e-6:.1f} s in all"
        text += ", where the recording is damaged, not waited for"
        yield Diagnostic("pace", text, verdict="note")


def check_room(facts: Facts) -> Findings:
    """What the receiver dropped for lack of room."""
    counts = ((facts.counts.get(name, 0), text) for name, text in _ROOM_COUNTS)
    dropped = [text.format(n, "s" * (n != 1)) for n, text in counts if n]
    if dropped:
        text = f"more than the receiver holds at a time: {'; '.join(dropped)}; frames may be missing"
        yield Diagnostic("no-room", text)


def find_alike_links(links: Mapping[str, Link]) -> Iterator[Diagnostic]:
    """Links that nothing on air distinguishes; known before anything is read."""
    for one, other in find_ambiguous_links(links):
        yield Diagnostic(
            "alike-links",
            f"what one of the links '{one}' and '{other}' sends, the other may read: the rates are alike,"
            " and codewords of one are codewords of the other",
            "give the one that is sent with, or let them differ in rate or parity",
        )


def check_links(facts: Facts) -> Findings:
    """Links that the receiver cannot distinguish."""
    yield from find_alike_links({name: part.link for name, part in facts.parts.items()})


def check_readout(facts: Facts) -> Findings:
    """A readout that is at its limit."""
    events, (row_us, round_us) = facts.readout.events, facts.readout.round_us()
    share, peak = events.measure_cap()
    chip_us = min(one.link.packet.chip_us for one in (facts, *facts.parts.values()))
    if round_us > _ROUND_CHIPS * chip_us:
        yield Diagnostic(
            "readout",
            f"the sensor reads without rest, {row_us:.2g} us a row, and comes to each row every"
            f" {round_us:.0f} us only, {round_us / chip_us:.2g} chips: changes in between are read together",
            "fewer rows: from farther away, with a region of interest or masks beside the bar, or a bar that"
            " lies; or a lower air.chip_rate_hz",
        )
    if events.at_limit:
        yield Diagnostic(
            "saturated",
            f"{share:.0%} of all milliseconds, {events.capped_ms}, hold {peak / 1e3:.3g} Mev/s,"
            " no more and no less: the sensor's readout is at its limit, and what is beyond is lost",
            "mask rows and columns beside the bar, close the aperture, or raise the event-rate limit",
        )
    else:
        yield f"at most {peak / 1e3:.3g} Mev/s, not at a limit"


def check_light(facts: Facts) -> Findings:
    """The sources of light: a bar, lamps alone, or none; and another bar that is not read."""
    if not facts.has_survey:
        return
    if not facts.is_read and facts.better_trial is not None and facts.better_trial.explanation:
        yield Diagnostic("link", facts.better_trial.explanation, facts.better_trial.options())
        return
    yield from (Diagnostic("", one.explanation, verdict="note") for one in facts.trials if one.explanation)
    if facts.is_read or (facts.bar is not None and not _is_lamp(facts.bar, facts)):
        yield (facts.is_read and _find_unread(facts)) or _describe_sources(facts)
        return
    if facts.speed_px_ms:
        step = "turn more slowly, or a shorter lens: up to 8 px/ms a bar is followed"
        yield Diagnostic(
            "motion", f"what shines {_describe_sweep(facts)}: hardly anything is read of it", step
        )
        return
    lamps = [one for one in facts.sources if one.kind == "lamp"]
    if lamps:
        rates = ", ".join([_format_rate(one.rate_hz) for one in lamps[:4]] + ["..."] * (len(lamps) > 4))
        yield Diagnostic(
            "lamp",
            f"{format_count(len(lamps), 'lamp')} blinking ({rates}), nothing sends chips",
            "is a bar in the picture, and on (`evlcp board status`)?",
        )
        return
    first = facts.sources[0] if facts.sources else None
    if first is None or (first.kind != "code" and first.events < _MIN_EVENT_SHARE * facts.counts["events"]):
        yield _describe_flicker(facts)
        return
    text = f"{_describe_sources(facts)}, but too rarely to recognise a code"
    long_px, wide_px = max(first.wide_px, first.high_px), min(first.wide_px, first.high_px)
    if wide_px > _BLURRED_SHARE * long_px:
        text += f": {wide_px:.0f} px wide, {long_px:.0f} px long, its light is spread"
        yield Diagnostic("defocus", text, _SHARPER)
    else:
        yield Diagnostic("dim", text, BRIGHTER)


def _find_unread(facts: Facts) -> Diagnostic | None:
    """A source of a code without frames, beside one with frames; None where there is none."""
    link_hz = facts.link.packet.chip_rate_hz
    places = [one.path_box_px for one in facts.tally.transmitters.values()]
    read = [one.box_px for one in facts.sources if any(measure_gap_px(one.box_px, at) <= 0 for at in places)]
    for source in facts.sources:
        same_rate = has_rate(source, link_hz)
        long_px, wide_px = sorted((source.wide_px, source.high_px), reverse=True)
        likely = source.rate_hz >= _MIN_RATE_SHARE * link_hz and long_px >= _MIN_ASPECT * wide_px
        if source.kind != "code" or source.rises < _MIN_RISES or not (same_rate or likely):
            continue
        # A bar's glow may be a little apart, and stays where the bar has been.
        if any(measure_gap_px(source.box_px, other) < _GLOW_PX for other in (*read, *places)):
            continue
        left, top, right, bottom = source.box_px
        rate = f"{float(f'{source.rate_hz:.2g}'):g}"
        other = f"another bar, of another rate? try it with --set air.chip_rate_hz={rate}"
        return Diagnostic(
            "unread",
            f"{_describe_sources(facts)}; no frame is read of the one in columns {left} to {right}, rows"
            f" {top} to {bottom}, {_format_rate(link_hz if same_rate else source.rate_hz)}",
            f"another bar? {BRIGHTER}" if same_rate else f"{other}; or light that is too weak for its chips",
        )
    return None


def _is_lamp(source: LightSource, facts: Facts) -> bool:
    """Whether a source is a lamp with missing periods rather than a bar of another rate."""
    same_rate = has_rate(source, facts.link.packet.chip_rate_hz)
    if facts.has_frames or same_rate or facts.better_trial is not None:
        return False
    lamps = [one.rate_hz for one in facts.sources if one.kind == "lamp"]
    harmonics = [factor * source.rate_hz for factor in (0.5, 1, 2)]
    same = any(abs(harmonic / rate - 1) < _RATE_TOLERANCE for rate in lamps for harmonic in harmonics)
    return same or facts.sources[0].kind == "lamp"


def _describe_flicker(facts: Facts) -> Diagnostic:
    if facts.restless_box is not None:
        left, top, right, bottom = facts.restless_box
        return Diagnostic(
            "dim",
            f"something flickers in columns {left} to {right}, rows {top} to {bottom}, without any rhythm:"
            " light that is too weak for its chips, or something that moves",
            BRIGHTER,
        )
    return Diagnostic(
        "dark",
        "nothing blinks: no rhythm between 60 Hz and 25 kHz anywhere",
        "is a bar in the picture, and on (`evlcp board status`)? One that is too weak, too far or behind a"
        " strong blur shows no rhythm, either",
    )


def check_edges(facts: Facts) -> Findings:
    """Light of which one kind of edges is hardly seen."""
    counts, bar = facts.counts, facts.bar
    if bar is not None:
        events, on, min_share = bar.events, round((1 - bar.negative_share) * bar.events), _FEW_NEGATIVE
    elif counts.get("frames", 0) and "events_in_regions_on" in counts:
        events, on, min_share = counts["events_in_regions"], counts["events_in_regions_on"], _ONE_SIGN_SHARE
        if events < _ONE_SIGN_EVENTS:
            return
    else:
        return
    if min(on, events - on) < min_share * events:
        sign, other = ("ON", "off") if 2 * on > events else ("OFF", "on")
        yield Diagnostic(
            "one-polarity",
            f"{max(on, events - on)} of {events} events are {sign}: when the light goes {other} is not seen",
            f"set bias_diff_{other} so that there are more; of a list, see its column of polarity",
        )
    else:
        yield f"{1 - on / events:.0%} of the bar's events are negative"


def check_pixels(facts: Facts, bar: LightSource) -> Findings:
    """Pixels that are blind for longer than a chip."""
    blind_us = bar.blind_us
    chips = blind_us / facts.link.packet.chip_us
    if chips > _BLIND_CHIPS:
        yield Diagnostic(
            "refractory",
            f"a pixel is silent for {blind_us:.0f} us after an event, {chips:.1f} chips: edges that come"
            " sooner are lost",
            "a shorter refractory time (bias_refr), or a lower air.chip_rate_hz at both ends",
        )
    else:
        yield f"pixels answer again within {blind_us:.0f} us" if blind_us else "pixels answer at once"


def check_size(facts: Facts, bar: LightSource) -> Findings:
    """A bar that is too small in the picture, or too high for the readout."""
    (px, steps), chip_us = _measure_clusters(facts, bar), facts.link.packet.chip_us
    if not px > 0:
        return
    text = f"{px:.1f} px a cluster"
    rows_us = bar.high_px * _ROW_US
    if px < (_SMALL_PX if facts.is_read else _UNREADABLE_PX):
        distance_m = facts.link.camera.focal_px * facts.link.bar.length_m / (px * (steps + 1))
        step = "nearer, or a longer lens" + ("" if facts.is_read else " (or fewer, larger clusters)")
        yield Diagnostic("far", f"{text}, as of a bar {distance_m:.0f} m away", step)
    elif rows_us >= _SLOW_SHARE * chip_us and not facts.is_certain and facts.better_trial is None:
        yield Diagnostic(
            "near",
            f"{bar.high_px:.0f} rows high: a sensor that reads a row in {_ROW_US:g} us takes {rows_us:.0f} us"
            f" for them, a chip lasts {chip_us:.0f}",
            "further away, a shorter lens, the camera turned by 90 degrees, so that the bar lies along rows,"
            " or a lower air.chip_rate_hz at both ends",
        )
    else:
        yield text


def check_focus(facts: Facts, bar: LightSource) -> Findings:
    """Clusters whose light overlaps."""
    px, _ = _measure_clusters(facts, bar)
    if not px > 0:
        return
    across_px = min(bar.wide_px, bar.high_px)
    text = f"{across_px:.0f} px across, {px:.1f} px a cluster along it"
    if not facts.is_certain and across_px > max(_SMEARED_CLUSTERS * px, _SHARP_PX):
        yield Diagnostic(
            "defocus",
            f"{text}: the light of each cluster covers its neighbours, or the layout is another one",
            f"{_SHARPER}; if the picture is sharp, compare [bar] with the transmitter's: `evlcp config` at"
            " both ends",
        )
    else:
        yield text


def _measure_clusters(facts: Facts, bar: LightSource) -> tuple[float, float]:
    """Spacing of the clusters, px, by frames or else by the source; and spacings from end to end."""
    centres_m, steps = facts.link.bar.cluster_centres_m(), 1.0
    if len(centres_m) > 1:
        step_m = min(math.dist(centres_m[0], other) for other in centres_m[1:])
        steps = math.dist(centres_m[0], centres_m[-1]) / step_m
    one = max(facts.tally.non_reflections, key=lambda tally: tally.sized_frames, default=None)
    if one is not None and one.sized_frames:
        return math.hypot(*one.along_px) / one.sized_frames / steps, steps
    # A source includes the whole clusters at the ends.
    return max(bar.wide_px, bar.high_px) / (steps + 1), steps


def check_brightness(facts: Facts, bar: LightSource) -> Findings:
    """Light that is too weak for its chips."""
    chips = bar.typical_us / facts.link.packet.chip_us
    text = f"a pixel of it rises every {chips:.1f} chips"
    if not facts.is_read and chips > _RARE_CHIPS and bar.strength < _WEAK:
        yield Diagnostic("dim", f"{text}, and late by many microseconds: it is too weak", BRIGHTER)
    else:
        yield text


def check_rate(facts: Facts, bar: LightSource) -> Findings:
    """Light of another rate than the link's."""
    link_hz = facts.link.packet.chip_rate_hz
    better_hz = facts.better_value("air.chip_rate_hz")
    if not facts.is_read and (better_hz is not None or not has_rate(bar, link_hz)):
        rate_hz = bar.rate_hz if better_hz is None else better_hz
        step = f"--set air.chip_rate_hz={rate_hz:g}"
        step += ", or the rate that it is sent with" if better_hz is None else ""
        yield Diagnostic(
            "rate", f"blinks at {_format_rate(rate_hz)}, the link says {_format_rate(link_hz)}", step
        )
    else:
        yield f"{_format_rate(link_hz)}, as the link says"


def check_preamble(facts: Facts) -> Findings:
    """Blinking light of which nothing is read."""
    counts, packet = facts.counts, facts.link.packet
    if facts.has_survey and not facts.is_read and facts.duration_us < 2 * packet.packet_us:
        yield Diagnostic(
            "short",
            f"the recording lasts {facts.duration_us / 1e3:.1f} ms, a packet {packet.packet_us / 1e3:.1f} ms",
            "record some packets: the next preamble may come after the end",
        )
    has_preamble = "preambles" in counts
    found, regions = counts.get("preambles", counts.get("frames", 0)), counts.get("regions_opened", 0)
    blinking = counts.get("events_in_regions", 0)
    if not found and (blinking >= _MANY_EVENTS or (facts.has_survey and has_preamble)):
        code, missing, compare = "no-frames", "frame is read", "[framing] with the transmitter's"
        if has_preamble:
            code, missing = "no-preamble", "preamble is detected"
            compare = "[pilots] with the transmitter's; a panel or leaves behind a bar may mask it"
        ask = "" if facts.has_survey else "; `evlcp diagnose` says what blinks, and how fast"
        yield Diagnostic(
            code,
            f"something blinks, {format_count(blinking, 'event')} in {format_count(regions, 'region')},"
            f" but no {missing}",
            f"compare air.chip_rate_hz and {compare}{ask}",
        )
    elif has_preamble:
        yield f"{found} detected in {format_count(regions, 'region')}"
    else:
        yield Diagnostic("preamble", "not looked for: the link's framing has none", verdict="skip")


def check_coverage(facts: Facts) -> Findings:
    """Links without a frame, and long gaps in a recording: neither is a fault by itself."""
    for name, part in (facts.parts or {"": facts}).items():
        if not part.tally.transmitters and facts.counts.get("events", 0) and not facts.has_survey:
            step = "`evlcp diagnose` says what blinks, and what to try"
            yield Diagnostic("nothing-found", "no frame was read", step, link=name, verdict="note")
    tallies, covered_us = facts.tally.transmitters.values(), facts.tally.covered_us
    if tallies and covered_us < (1 - _COVERED_SHARE) * facts.duration_us:
        before, after = min(one.first_us for one in tallies), max(one.last_us for one in tallies)
        text = (
            f"frames in {format_ms(covered_us)} of {format_ms(facts.duration_us)}: nothing before"
            f" {format_ms(before - facts.first_us)}, nothing after {format_ms(after - facts.first_us)}"
        )
        yield Diagnostic("coverage", text, verdict="note")


def _describe_sources(facts: Facts) -> str:
    numbers = Counter[str](one.kind for one in facts.sources)
    names = {"code": "source", "lamp": "lamp", "unclear": "unclear source"}
    words = [
        format_count(numbers[k], name) + " of chips" * (k == "code")
        for k, name in names.items()
        if numbers[k]
    ]
    text = ", ".join(words) or "no source of its own"
    return f"{text}; what shines {_describe_sweep(facts)}" if facts.speed_px_ms else text


def _describe_sweep(facts: Facts) -> str:
    return f"sweeps over the image at {facts.speed_px_ms:.1f} px/ms"


def _format_rate(rate_hz: float) -> str:
    return f"{rate_hz / 1e3:.4g} kHz" if rate_hz >= 1000 else f"{rate_hz:.3g} Hz"
