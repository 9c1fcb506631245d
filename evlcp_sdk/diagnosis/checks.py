"""The stages that light passes on its way to a message, each passed or failed with the count that says so."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from evlcp_sdk.diagnosis.facts import Diagnostic, Facts, has_rate
from evlcp_sdk.diagnosis.light import LightSource
from evlcp_sdk.diagnosis.tallies import SURE, count_missing_codewords
from evlcp_sdk.diagnosis.warnings import check_saturation
from evlcp_sdk.spelling import counted

Verdict = Literal["pass", "doubt", "fail", "skip"]
"""Of a stage: passed; passed, but near its limit; failed; not reached."""

Found = Diagnostic | str | None
"""What a stage finds: something wrong, or the count by which it is passed; None where it is not reached."""

_VERDICTS: dict[str, Verdict] = {
    "damaged": "doubt",
    "empty": "fail",
    "no-preamble": "fail",
    "profile": "fail",
    "preamble": "skip",
    "messages": "skip",
    "no-messages": "skip",
}
"""Of what is wrong, or is not looked for, whether frames are read or not."""

_FEW_NEGATIVE = 0.1
"""Share of negative events below which they are missing: as much light goes as comes."""

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

_UNSEEN_SHARE = 0.05
"""Share of unseen clusters of which more is stated."""

_MIN_RISES, _LEAST_RATE, _SLENDER = 500, 0.25, 4.0
"""The same for light that is not read beside a bar that is; the least share of the link's rate that it has;
how many times longer than wide it is. Leaves and edges that pass look like a code of some hundred chips a
second, a lamp whose periods are missed like one of some thousand."""

_GLOW_PX = 32
"""Gap up to which light beside a bar is its own."""

_SOME = 0.02
"""Share of all events below which what blinks is not worth a word where nothing sends chips."""

_BLURRED_SHARE = 0.2
"""Width of what flickers, as a share of its length, above which its light is too weak for being spread."""

_SAME_RATE = 0.03
"""How far two rates may be apart and be one."""


@dataclass(frozen=True)
class Check:
    """A stage, and what became of it.

    Attributes:
        stage: Its name.
        verdict: `pass`, `doubt`, `fail`, or `skip` where it was not reached.
        code: What is wrong, in one word, e.g. `defocus`; the stage's name where nothing is.
        said: The count that says so.
        next_step: What to try; empty where nothing is wrong.
    """

    stage: str
    verdict: Verdict
    code: str
    said: str
    next_step: str = ""


def checks_of(facts: Facts) -> list[Check]:
    """All stages, in the order in which light passes them.

    Those behind one that fails are skipped. What is wrong where frames are read all the same is a doubt.
    """
    checks: list[Check] = []
    for stage, find in _STAGES:
        found = None if any(one.verdict == "fail" for one in checks) else find(facts)
        if isinstance(found, Diagnostic):
            verdict = _VERDICTS.get(found.code, "doubt" if facts.reads else "fail")
            checks.append(Check(stage, verdict, found.code, found.text, found.next_step))
        else:
            checks.append(Check(stage, "skip" if found is None else "pass", stage, found or "not reached"))
    return checks


def _events(facts: Facts) -> Found:
    if not facts.events:
        return Diagnostic("empty", "no events", "record again: `evlcp info` says what is in the file")
    text = f"{facts.events:,} events in {facts.duration_us * 1e-6:.3f} s"
    if facts.losses:
        lost = f"{text}; lost: {'; '.join(facts.losses)}"
        return Diagnostic("damaged", lost, "copy or record it again; what is left was read")
    return text


def _readout(facts: Facts) -> Found:
    passed = f"at most {facts.peak_mev_s:.3g} Mev/s, not at a limit"
    return next(check_saturation(facts), passed)


def _light(facts: Facts) -> Found:
    if facts.reads:
        return _unread(facts) or _describe_sources(facts)
    if not facts.sources:
        return _without_rhythm(facts)
    if facts.bar is not None and not _is_lamp(facts.bar, facts):
        return _describe_sources(facts)
    lamps = [one for one in facts.sources if one.kind == "lamp"]
    if lamps:
        rates = ", ".join([_hz(one.rate_hz) for one in lamps[:4]] + ["..."] * (len(lamps) > 4))
        return Diagnostic(
            "lamp",
            f"{counted(len(lamps), 'lamp')} blinking ({rates}), nothing sends chips",
            f"is a bar in the picture ({_view(facts)}), and on (`evlcp board status`)?",
        )
    first = facts.sources[0]
    if first.kind != "code" and first.events < _SOME * facts.events:
        return _without_rhythm(facts)
    text = f"{_describe_sources(facts)}, but too rarely to recognise a code"
    long_px, wide_px = max(first.wide_px, first.high_px), min(first.wide_px, first.high_px)
    if wide_px > _BLURRED_SHARE * long_px:
        text = f"{text}: {wide_px:.0f} px wide, {long_px:.0f} px long, its light is spread"
        return Diagnostic("defocus", text, _SHARPER)
    return Diagnostic("dim", text, _BRIGHTER)


def _view(facts: Facts) -> str:
    """How much the camera sees."""
    width, height, focal = facts.link.camera.width, facts.link.camera.height, facts.link.camera.focal_px
    return (
        f"the picture is {2 * math.degrees(math.atan(width / 2 / focal)):.1f} by"
        f" {2 * math.degrees(math.atan(height / 2 / focal)):.1f} degrees, {50 * width / focal:.1f} by"
        f" {50 * height / focal:.1f} m at 50 m"
    )


def _unread(facts: Facts) -> Diagnostic | None:
    """Light of a code where no frame is read, beside one that is; None where there is none."""
    link_hz, camera = facts.link.packet.chip_rate_hz, facts.link.camera
    # The centre of a bar that has an end out of the picture may lie outside it, too.
    places = [
        (min(max(x, 0.0), camera.width - 1.0), min(max(y, 0.0), camera.height - 1.0))
        for x, y in (one.last_px for one in facts.tally.transmitters.values())
    ]
    read = [one.box_px for one in facts.sources if any(_gap_px(one.box_px, (*at, *at)) <= 0 for at in places)]
    for source in facts.sources:
        same = has_rate(source, link_hz)
        long_px, wide_px = sorted((source.wide_px, source.high_px), reverse=True)
        likely = source.rate_hz >= _LEAST_RATE * link_hz and long_px >= _SLENDER * wide_px
        if source.kind != "code" or source.rises < _MIN_RISES or not (same or likely):
            continue
        # A bar's own glow may stand a little apart.
        if any(_gap_px(source.box_px, other) < _GLOW_PX for other in read):
            continue
        left, top, right, bottom = source.box_px
        return Diagnostic(
            "unread",
            f"{_describe_sources(facts)}; no frame is read of the one in columns {left} to {right}, rows"
            f" {top} to {bottom}, {_hz(link_hz if same else source.rate_hz)}",
            f"another bar? {_BRIGHTER}"
            if same
            else "another bar, of another rate? try it with --set air.chip_rate_hz="
            f"{float(f'{source.rate_hz:.2g}'):g}; or light that is too weak for its chips",
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
            _BRIGHTER,
        )
    return Diagnostic(
        "dark",
        "nothing blinks: no rhythm between 60 Hz and 25 kHz anywhere",
        f"is a bar in the picture ({_view(facts)}), and on (`evlcp board status`)? One that is too weak, too"
        " far or behind a strong blur shows no rhythm, either",
    )


_SHARPER = "focus the lens, clean it and the window; a smaller aperture is sharper"

_BRIGHTER = (
    "more light: nearer, a wider aperture, brighter LEDs, or a more sensitive sensor (lower bias_diff_on and"
    " bias_diff_off, faster pixels by bias_fo)"
)


def _polarity(facts: Facts) -> Found:
    if facts.bar is None:
        return None
    negative = facts.bar.negative_share
    for few, name, bias in ((negative, "negative", "off"), (1 - negative, "positive", "on")):
        if few < _FEW_NEGATIVE:
            return Diagnostic(
                f"no-{name}",
                f"only {few:.0%} of the bar's events are {name}",
                f"{'no' if few < 0.02 else 'few'} {name} events: set bias_diff_{bias} so that there are more",
            )
    return f"{negative:.0%} of the bar's events are negative"


def _pixels(facts: Facts) -> Found:
    if facts.bar is None:
        return None
    blind_us = facts.bar.blind_us
    chips = blind_us * 1e-6 * facts.link.packet.chip_rate_hz
    if chips > _BLIND_CHIPS:
        return Diagnostic(
            "refractory",
            f"a pixel is silent for {blind_us:.0f} us after an event, {chips:.1f} chips: edges that come"
            " sooner are lost",
            "a shorter refractory time (bias_refr), or a lower air.chip_rate_hz at both ends",
        )
    return f"pixels answer again within {blind_us:.0f} us" if blind_us else "pixels answer at once"


def _size(facts: Facts) -> Found:
    px = facts.cluster_px
    if not px > 0:
        return None
    text = f"{px:.1f} px a cluster"
    if px >= (_SMALL_PX if facts.reads else _SMALLEST_PX):
        return _rows(facts) or text
    far_m = facts.link.camera.focal_px * facts.link.bar.length_m / (px * (facts.steps_along + 1))
    return Diagnostic(
        "far",
        f"{text}, as of a bar {far_m:.0f} m away",
        f"{text}: nearer, or a longer lens" + ("" if facts.reads else " (or fewer, larger clusters)"),
    )


def _rows(facts: Facts) -> Diagnostic | None:
    """A bar of more rows than are read in a chip; None where it is not, or is read all the same."""
    chip_us = facts.link.packet.chip_us
    rows = 0.0 if facts.bar is None else facts.bar.high_px
    if facts.sure or facts.better is not None or rows * _ROW_US < _SLOW_SHARE * chip_us:
        return None
    return Diagnostic(
        "near",
        f"{rows:.0f} rows high: a sensor that reads a row in {_ROW_US:g} us takes {rows * _ROW_US:.0f} us for"
        f" them, a chip lasts {chip_us:.0f}",
        "further away, a shorter lens, the camera turned by 90 degrees, so that the bar lies along rows, or a"
        " lower air.chip_rate_hz at both ends",
    )


def _focus(facts: Facts) -> Found:
    bar, px = facts.bar, facts.cluster_px
    if bar is None or not px > 0:
        return None
    across_px = min(bar.wide_px, bar.high_px)
    text = f"{across_px:.0f} px across, {px:.1f} px a cluster along it"
    if not facts.sure and across_px > max(_SMEARED_CLUSTERS * px, _SHARP_PX):
        return Diagnostic(
            "defocus",
            f"{text}: the light of each cluster covers its neighbours, or the layout is another one",
            f"{_SHARPER}; if the picture is sharp, compare [bar] with the transmitter's: `evlcp config` at"
            " both ends",
        )
    return text


def _brightness(facts: Facts) -> Found:
    bar = facts.bar
    if bar is None:
        return None
    chips = bar.typical_us * 1e-6 * facts.link.packet.chip_rate_hz
    text = f"a pixel of it rises every {chips:.1f} chips"
    if not facts.reads and chips > _RARE_CHIPS and bar.strength < _WEAK:
        return Diagnostic("dim", f"{text}, and late by many microseconds: it is too weak", _BRIGHTER)
    return text


def _rate(facts: Facts) -> Found:
    bar, link = facts.bar, facts.link.packet.chip_rate_hz
    if bar is None:
        return None
    better = dict(facts.better.changes).get("air.chip_rate_hz") if facts.better is not None else None
    if not facts.reads and (better is not None or not has_rate(bar, link)):
        rate = bar.rate_hz if better is None else better
        return Diagnostic(
            "rate",
            f"blinks at {_hz(rate)}, the link says {_hz(link)}",
            f"--set air.chip_rate_hz={rate:g}"
            + ("" if better is not None else ", or the rate that it is sent with"),
        )
    return f"{_hz(link)}, as the link says"


def _preamble(facts: Facts) -> Found:
    if "preambles" not in facts.counts:
        return Diagnostic("preamble", "not looked for: the link's framing has none")
    packet_us = facts.link.packet.packet_chips * facts.link.packet.chip_us
    if not facts.reads and facts.duration_us < 2 * packet_us:
        return Diagnostic(
            "short",
            f"the recording lasts {facts.duration_us * 1e-3:.1f} ms, a packet {packet_us * 1e-3:.1f} ms",
            "record some packets: the next preamble may come after the end",
        )
    preambles, regions = facts.counts["preambles"], facts.counts["regions_opened"]
    where = f"detected in {regions} region{'s' * (regions != 1)}"
    if not preambles:
        return Diagnostic(
            "no-preamble",
            f"none {where}",
            "compare pilots.id, its parameters and air.chip_rate_hz with the transmitter's: `evlcp config` at"
            " both ends",
        )
    return f"{preambles} {where}"


def _frames(facts: Facts) -> Found:
    frames, due = facts.counts["frames"], facts.counts["frames"] + facts.counts.get("frames_rejected", 0)
    text, better = f"{frames} of {due} accepted", facts.better
    turn = "turn the camera so that the whole bar is in the picture"
    if facts.reads:
        given, erased = (sum(getattr(one, name) for one in facts.tally.own) for name in ("given", "erased"))
        unseen = erased / max(given + erased, 1)
        if not facts.at_edge or unseen <= _UNSEEN_SHARE:
            return text
        where = "of their clusters unseen; the source touches the picture's edge"
        return Diagnostic("outside", f"{text}, {unseen:.0%} {where}", turn)
    if better is not None:
        each = dict(better.changes).get("air.frames_per_packet")
        if each is None:
            return Diagnostic("link", f"{text}; another link reads {better.frames}", better.options())
        of = better.frames + better.rejected
        text += f"; with {each} frames a packet {better.frames} of {of}"
        return Diagnostic("frames-per-packet", text, better.options())
    if facts.at_edge:
        return Diagnostic("outside", f"{text}; the source touches the picture's edge", turn)
    return Diagnostic(
        "frames",
        f"{text}: the clusters do not stand where the link's bar has them",
        "compare [bar] and [pilots] with the transmitter's: `evlcp config` at both ends",
    )


def _orientation(facts: Facts) -> Found:
    right, down = facts.order
    if -1 not in facts.order:
        return "clusters stand as in the link's bar"
    # Of a column, left and right are not seen.
    how = "mirrored" if right * down == -1 else "upside down"
    return Diagnostic(
        how.replace(" ", "-"),
        f"the bar is {how} in the picture; its symbols and distances are right, positions are not",
        "turn the camera, or flip rows where it is read"
        + ("" if right else " (a column does not say whether left and right are mirrored, too)"),
    )


def _codewords(facts: Facts) -> Found:
    many, own, quality = facts.link.codebook.carrying, facts.tally.own, facts.tally.quality
    never = max((count_missing_codewords(one, facts.link) for one in own), default=0)
    if not never and quality >= SURE:
        return f"all of {many} that should occur do"
    better = facts.better
    name = dict(better.changes).get("modulation.id") if better is not None else None
    frames = sum(one.frames for one in own)
    unsure = f"mean quality of {frames} frames {quality:.2f}: their symbols are not sure"
    if not never and name is None and (facts.trials or facts.at_edge):
        return Diagnostic("noisy", unsure, _BRIGHTER)
    return Diagnostic(
        "profile",
        f"only {many - never} of {many} symbols ever occur" if never else unsure,
        f"was this sent with {name}? try {better.options()}"
        if better is not None and name is not None
        else "data that repeats, or another modulation.id than the transmitter's",
    )


def _messages(facts: Facts) -> Found:
    tried = facts.counts.get("blocks_tried", 0)
    if not tried:
        return Diagnostic("messages", "not looked for")
    text = f"{facts.blocks_read} of {tried} packets carry a block that can be read"
    if facts.blocks_read:
        return text
    step = "right for symbols without messages; else compare error-correction.id with the transmitter's"
    return Diagnostic("no-messages", text, step)


_STAGES: tuple[tuple[str, Callable[[Facts], Found]], ...] = (
    ("events", _events),
    ("readout", _readout),
    ("light", _light),
    ("polarity", _polarity),
    ("pixels", _pixels),
    ("size", _size),
    ("focus", _focus),
    ("brightness", _brightness),
    ("chip rate", _rate),
    ("preamble", _preamble),
    ("frames", _frames),
    ("orientation", _orientation),
    ("codewords", _codewords),
    ("messages", _messages),
)
"""Name and check, in the order in which light passes them."""


def _describe_sources(facts: Facts) -> str:
    by = {kind: sum(one.kind == kind for one in facts.sources) for kind in ("code", "lamp", "unclear")}
    words = {
        "code": f"{counted(by['code'], 'source')} of chips",
        "lamp": counted(by["lamp"], "lamp"),
        "unclear": counted(by["unclear"], "unclear source"),
    }
    return ", ".join(text for kind, text in words.items() if by[kind]) or "no source of its own"


def _hz(rate_hz: float) -> str:
    return f"{rate_hz / 1e3:.4g} kHz" if rate_hz >= 1000 else f"{rate_hz:.3g} Hz"
