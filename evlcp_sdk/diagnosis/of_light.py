"""Checks of a recording and of the light in it, from its events to the preamble; most ask for a survey."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from evlcp_sdk.clock import TimeGrain
from evlcp_sdk.diagnosis.facts import BRIGHTER, Diagnostic, Facts, Found, has_rate, in_ms
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.several import find_ambiguous_links
from evlcp_sdk.suggestions import format_count

if TYPE_CHECKING:
    from evlcp_sdk.diagnosis.light import LightSource

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

_COVERED = 0.5
"""Share of a recording of which no more is without frames unless it is said."""

_FEW_NEGATIVE = 0.1
"""Share of negative events below which they are missing: as much light goes as comes."""

_ONE_SIGN_SHARE, _ONE_SIGN_EVENTS = 0.02, 100
"""Where nobody surveyed the light: events of the rarer sign, by their share of all, below which nothing is
known of one half of the edges, and events from which on it is said. A light that goes on goes off again:
cameras whose thresholds are unlike still give a tenth; noise alone may give a few of either."""

_BLIND_CHIPS = 1.1
"""Time from event to event of a pixel, in chips, above which edges one chip apart are lost."""

_SMALLEST_PX, _SMALL_PX = 1.5, 2.5
"""Pixels a cluster below which clusters cannot be told apart, and below which errors are to be expected: two
sampled points a cluster are the least, and the pixels between two clusters show both."""

_SMEARED_CLUSTERS, _SHARP_PX = 2.0, 5.0
"""Width of a source, in clusters, above which the light of each covers its neighbours on both sides, and up
to how many px wide a column of LEDs in focus may look."""

_RARE_CHIPS, _WEAK = 5.0, 0.35
"""Median time between rises, in chips, and mean of the comb, beyond both of which light is too weak: a code
rises every 2.7 chips, and jitter of 20 us leaves .45 of the mean at 10 kHz."""

_ROW_US, _SLOW_SHARE = 0.2, 0.7
"""What an IMX636 takes to read a row, by its latency against the lit area, and the share of a chip above
which reading a bar's rows, one after another, mixes its edges with the next chip's."""

_MIN_RISES, _LEAST_RATE, _SLENDER = 500, 0.25, 4.0
"""Of light that is not read beside a bar that is: rises; the least share of the link's rate that it has; how
many times longer than wide it is. Leaves and edges that pass look like a code of some hundred chips a second,
a lamp whose periods are missed like one of some thousand."""

_ROUND_CHIPS = 0.75
"""Chips between two readings of a row from which on events of one edge, which come within 25 us, are read
together with those of the next: at 17 m a bar is read without fault at .7."""

_GLOW_PX = 32
"""Gap up to which light beside a bar is its own."""

_SOME = 0.02
"""Share of all events below which what blinks is not worth a word where nothing sends chips."""

_BLURRED_SHARE = 0.2
"""Width of what flickers, as a share of its length, above which its light is too weak for being spread."""

_SAME_RATE = 0.03
"""How far two rates may be apart and be one."""

_MANY_EVENTS = 100_000
"""In regions without a preamble, of which more is said: a bar sends so many in 20 ms, a lamp in a second."""

_SHARPER = "focus the lens, clean it and the window; a smaller aperture is sharper"


def check_events(facts: Facts) -> Found:
    """What there is, and what of it did not count for other reasons than room."""
    events = facts.counts.get("events", 0)
    losses = f"; lost: {'; '.join(map(str, facts.losses))}" if facts.losses else ""
    no_room = [name for name, _ in _NO_ROOM]
    dropped = {n: k for n, k in facts.counts.items() if n.startswith("dropped_") and k and n not in no_room}
    lost = sum(loss.count for loss in facts.losses)
    number = sum(dropped.values()) + lost
    if number >= _DROPPED_LEAST and number > _DROPPED_SHARE * (events + lost):
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


def check_times(facts: Facts) -> Found:
    """Times in steps of more than a quarter of a chip, of which little is left; or guessed ones."""
    chip_us = min(one.link.packet.chip_us for one in (facts, *facts.parts.values()))
    grain = facts.readout.grain if facts.readout is not None else TimeGrain()
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
    silences, silent_us = facts.skipped
    if silences:
        text = f"{format_count(silences, 'silence')} of {silent_us * 1e-6:.1f} s in all"
        text += ", where the recording is damaged, not waited for"
        yield Diagnostic("pace", text, verdict="note")


def check_room(facts: Facts) -> Found:
    """What the receiver had no room for."""
    found = [text.format(n, "s" * (n != 1)) for name, text in _NO_ROOM if (n := facts.counts.get(name, 0))]
    if found:
        text = f"more than the receiver holds at a time: {'; '.join(found)}; frames may be missing"
        yield Diagnostic("no-room", text)


def find_alike_links(links: Mapping[str, Link]) -> Iterator[Diagnostic]:
    """Links of which nothing on air tells one from the other, by name: known before anything is read."""
    for one, other in find_ambiguous_links(links):
        yield Diagnostic(
            "alike-links",
            f"what one of the links '{one}' and '{other}' sends, the other may read: the rates are alike,"
            " and codewords of one are codewords of the other",
            "give the one that is sent with, or let them differ in rate or parity",
        )


def check_links(facts: Facts) -> Found:
    """Links that the receiver cannot tell apart."""
    yield from find_alike_links({name: part.link for name, part in facts.parts.items()})


def check_readout(facts: Facts) -> Found:
    """A readout that is at its limit."""
    if facts.readout is None:
        return
    events, (row_us, round_us) = facts.readout.events, facts.readout.round_us()
    share, peak = events.capped()
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


def check_light(facts: Facts) -> Found:
    """What blinks: a bar, lamps alone, or nothing that is worth a word; and a bar more that is not read."""
    if not facts.surveyed:
        return
    if not facts.reads and facts.better is not None and facts.better.said:
        yield Diagnostic("link", facts.better.said, facts.better.options())
        return
    yield from (Diagnostic("", one.said, verdict="note") for one in facts.trials if one.said)
    if facts.reads or (facts.bar is not None and not _is_lamp(facts.bar, facts)):
        yield (facts.reads and _find_unread(facts)) or _describe_sources(facts)
        return
    if facts.speed_px_ms:
        step = "turn more slowly, or a shorter lens: up to 8 px/ms a bar is followed"
        yield Diagnostic("motion", f"what shines {_sweeps(facts)}: hardly anything is read of it", step)
        return
    lamps = [one for one in facts.sources if one.kind == "lamp"]
    if lamps:
        rates = ", ".join([_hz(one.rate_hz) for one in lamps[:4]] + ["..."] * (len(lamps) > 4))
        yield Diagnostic(
            "lamp",
            f"{format_count(len(lamps), 'lamp')} blinking ({rates}), nothing sends chips",
            "is a bar in the picture, and on (`evlcp board status`)?",
        )
        return
    first = facts.sources[0] if facts.sources else None
    if first is None or (first.kind != "code" and first.events < _SOME * facts.counts["events"]):
        yield _without_rhythm(facts)
        return
    text = f"{_describe_sources(facts)}, but too rarely to recognise a code"
    long_px, wide_px = max(first.wide_px, first.high_px), min(first.wide_px, first.high_px)
    if wide_px > _BLURRED_SHARE * long_px:
        text += f": {wide_px:.0f} px wide, {long_px:.0f} px long, its light is spread"
        yield Diagnostic("defocus", text, _SHARPER)
    else:
        yield Diagnostic("dim", text, BRIGHTER)


def _find_unread(facts: Facts) -> Diagnostic | None:
    """Light of a code where no frame is read, beside one that is; None where there is none."""
    link_hz = facts.link.packet.chip_rate_hz
    places = [one.passed_px for one in facts.tally.transmitters.values()]
    read = [one.box_px for one in facts.sources if any(_gap_px(one.box_px, at) <= 0 for at in places)]
    for source in facts.sources:
        same = has_rate(source, link_hz)
        long_px, wide_px = sorted((source.wide_px, source.high_px), reverse=True)
        likely = source.rate_hz >= _LEAST_RATE * link_hz and long_px >= _SLENDER * wide_px
        if source.kind != "code" or source.rises < _MIN_RISES or not (same or likely):
            continue
        # A bar's own glow may stand a little apart, and is left where it has been.
        if any(_gap_px(source.box_px, other) < _GLOW_PX for other in (*read, *places)):
            continue
        left, top, right, bottom = source.box_px
        rate = f"{float(f'{source.rate_hz:.2g}'):g}"
        other = f"another bar, of another rate? try it with --set air.chip_rate_hz={rate}"
        return Diagnostic(
            "unread",
            f"{_describe_sources(facts)}; no frame is read of the one in columns {left} to {right}, rows"
            f" {top} to {bottom}, {_hz(link_hz if same else source.rate_hz)}",
            f"another bar? {BRIGHTER}" if same else f"{other}; or light that is too weak for its chips",
        )
    return None


def _gap_px(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """How far two boxes (left, top, right, bottom) are apart, across or down; 0 or less where they meet."""
    return max(one[0] - other[2], other[0] - one[2], one[1] - other[3], other[1] - one[3])


def _is_lamp(source: LightSource, facts: Facts) -> bool:
    """Whether a source is rather the light of a lamp, with periods missing, than a bar of another rate."""
    same_rate = has_rate(source, facts.link.packet.chip_rate_hz)
    if facts.some_frames or same_rate or facts.better is not None:
        return False
    lamps = [one.rate_hz for one in facts.sources if one.kind == "lamp"]
    same = (abs(times * source.rate_hz / rate - 1) < _SAME_RATE for rate in lamps for times in (0.5, 1, 2))
    return facts.sources[0].kind == "lamp" or any(same)


def _without_rhythm(facts: Facts) -> Diagnostic:
    """What is found where nothing blinks that is worth a word."""
    if facts.restless is not None:
        left, top, right, bottom = facts.restless
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


def check_edges(facts: Facts) -> Found:
    """Light of which one kind of edges is hardly seen."""
    counts, bar = facts.counts, facts.bar
    if bar is not None:
        events, on, least = bar.events, round((1 - bar.negative_share) * bar.events), _FEW_NEGATIVE
    elif counts.get("frames", 0) and "events_in_regions_on" in counts:
        events, on, least = counts["events_in_regions"], counts["events_in_regions_on"], _ONE_SIGN_SHARE
        if events < _ONE_SIGN_EVENTS:
            return
    else:
        return
    if min(on, events - on) < least * events:
        sign, other = ("ON", "off") if 2 * on > events else ("OFF", "on")
        yield Diagnostic(
            "one-polarity",
            f"{max(on, events - on)} of {events} events are {sign}: when the light goes {other} is not seen",
            f"set bias_diff_{other} so that there are more; of a list, see its column of polarity",
        )
    else:
        yield f"{1 - on / events:.0%} of the bar's events are negative"


def check_pixels(facts: Facts, bar: LightSource) -> Found:
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


def check_size(facts: Facts, bar: LightSource) -> Found:
    """A bar that is too small in the picture, or of more rows than are read in a chip."""
    (px, steps), chip_us = _measure_clusters(facts, bar), facts.link.packet.chip_us
    if not px > 0:
        return
    text = f"{px:.1f} px a cluster"
    rows_us = bar.high_px * _ROW_US
    if px < (_SMALL_PX if facts.reads else _SMALLEST_PX):
        far_m = facts.link.camera.focal_px * facts.link.bar.length_m / (px * (steps + 1))
        step = "nearer, or a longer lens" + ("" if facts.reads else " (or fewer, larger clusters)")
        yield Diagnostic("far", f"{text}, as of a bar {far_m:.0f} m away", step)
    elif rows_us >= _SLOW_SHARE * chip_us and not facts.sure and facts.better is None:
        yield Diagnostic(
            "near",
            f"{bar.high_px:.0f} rows high: a sensor that reads a row in {_ROW_US:g} us takes {rows_us:.0f} us"
            f" for them, a chip lasts {chip_us:.0f}",
            "further away, a shorter lens, the camera turned by 90 degrees, so that the bar lies along rows,"
            " or a lower air.chip_rate_hz at both ends",
        )
    else:
        yield text


def check_focus(facts: Facts, bar: LightSource) -> Found:
    """Clusters that cover one another."""
    px, _ = _measure_clusters(facts, bar)
    if not px > 0:
        return
    across_px = min(bar.wide_px, bar.high_px)
    text = f"{across_px:.0f} px across, {px:.1f} px a cluster along it"
    if not facts.sure and across_px > max(_SMEARED_CLUSTERS * px, _SHARP_PX):
        yield Diagnostic(
            "defocus",
            f"{text}: the light of each cluster covers its neighbours, or the layout is another one",
            f"{_SHARPER}; if the picture is sharp, compare [bar] with the transmitter's: `evlcp config` at"
            " both ends",
        )
    else:
        yield text


def _measure_clusters(facts: Facts, bar: LightSource) -> tuple[float, float]:
    """From cluster to cluster, px, by frames that are read or else by the source; steps from end to end."""
    centres_m, steps = facts.link.bar.cluster_centres_m(), 1.0
    if len(centres_m) > 1:
        step_m = min(math.dist(centres_m[0], other) for other in centres_m[1:])
        steps = math.dist(centres_m[0], centres_m[-1]) / step_m
    one = max(facts.tally.own, key=lambda tally: tally.sized, default=None)
    if one is not None and one.sized:
        return math.hypot(*one.along_px) / one.sized / steps, steps
    # A source shows the clusters at the ends whole.
    return max(bar.wide_px, bar.high_px) / (steps + 1), steps


def check_brightness(facts: Facts, bar: LightSource) -> Found:
    """Light that is too weak for its chips."""
    chips = bar.typical_us / facts.link.packet.chip_us
    text = f"a pixel of it rises every {chips:.1f} chips"
    if not facts.reads and chips > _RARE_CHIPS and bar.strength < _WEAK:
        yield Diagnostic("dim", f"{text}, and late by many microseconds: it is too weak", BRIGHTER)
    else:
        yield text


def check_rate(facts: Facts, bar: LightSource) -> Found:
    """Light of another rate than the link's."""
    link_hz = facts.link.packet.chip_rate_hz
    better = facts.better_value("air.chip_rate_hz")
    if not facts.reads and (better is not None or not has_rate(bar, link_hz)):
        rate_hz = bar.rate_hz if better is None else better
        step = f"--set air.chip_rate_hz={rate_hz:g}"
        step += ", or the rate that it is sent with" if better is None else ""
        yield Diagnostic("rate", f"blinks at {_hz(rate_hz)}, the link says {_hz(link_hz)}", step)
    else:
        yield f"{_hz(link_hz)}, as the link says"


def check_preamble(facts: Facts) -> Found:
    """Something that blinks, and of which nothing is read."""
    counts, packet = facts.counts, facts.link.packet
    if facts.surveyed and not facts.reads and facts.duration_us < 2 * packet.packet_us:
        yield Diagnostic(
            "short",
            f"the recording lasts {facts.duration_us / 1e3:.1f} ms, a packet {packet.packet_us / 1e3:.1f} ms",
            "record some packets: the next preamble may come after the end",
        )
    looked_for = "preambles" in counts
    found, regions = counts.get("preambles", counts.get("frames", 0)), counts.get("regions_opened", 0)
    blinking = counts.get("events_in_regions", 0)
    if not found and (blinking >= _MANY_EVENTS or (facts.surveyed and looked_for)):
        code, what, compare = "no-frames", "frame is read", "[framing] with the transmitter's"
        if looked_for:
            code, what = "no-preamble", "preamble is detected"
            compare = "[pilots] with the transmitter's; a panel or leaves behind a bar may mask it"
        ask = "" if facts.surveyed else "; `evlcp diagnose` says what blinks, and how fast"
        yield Diagnostic(
            code,
            f"something blinks, {format_count(blinking, 'event')} in {format_count(regions, 'region')},"
            f" but no {what}",
            f"compare air.chip_rate_hz and {compare}{ask}",
        )
    elif looked_for:
        yield f"{found} detected in {format_count(regions, 'region')}"
    else:
        yield Diagnostic("preamble", "not looked for: the link's framing has none", verdict="skip")


def check_coverage(facts: Facts) -> Found:
    """Links, and most of a recording, without a frame: none of these is a fault of its own."""
    for name, part in (facts.parts or {"": facts}).items():
        if not part.tally.transmitters and facts.counts.get("events", 0) and not facts.surveyed:
            step = "`evlcp diagnose` says what blinks, and what to try"
            yield Diagnostic("nothing-found", "no frame was read", step, link=name, verdict="note")
    tallies, covered_us = facts.tally.transmitters.values(), facts.tally.covered_us
    if tallies and covered_us < (1 - _COVERED) * facts.duration_us:
        before, after = min(one.first_us for one in tallies), max(one.last_us for one in tallies)
        text = (
            f"frames in {in_ms(covered_us)} of {in_ms(facts.duration_us)}: nothing before"
            f" {in_ms(before - facts.first_us)}, nothing after {in_ms(after - facts.first_us)}"
        )
        yield Diagnostic("coverage", text, verdict="note")


def _describe_sources(facts: Facts) -> str:
    many = Counter[str](one.kind for one in facts.sources)
    names = {"code": "source", "lamp": "lamp", "unclear": "unclear source"}
    words = [
        format_count(many[k], name) + " of chips" * (k == "code") for k, name in names.items() if many[k]
    ]
    text = ", ".join(words) or "no source of its own"
    return f"{text}; what shines {_sweeps(facts)}" if facts.speed_px_ms else text


def _sweeps(facts: Facts) -> str:
    return f"sweeps over the image at {facts.speed_px_ms:.1f} px/ms"


def _hz(rate_hz: float) -> str:
    return f"{rate_hz / 1e3:.4g} kHz" if rate_hz >= 1000 else f"{rate_hz:.3g} Hz"
