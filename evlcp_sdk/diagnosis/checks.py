"""The stages that light passes on its way to a message, each passed or failed with the count that says so."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from evlcp_sdk.diagnosis.light import LightSource
from evlcp_sdk.diagnosis.probe import SURE, Trial
from evlcp_sdk.diagnosis.tallies import RunTally
from evlcp_sdk.diagnosis.warnings import Seen, codewords_never, saturation
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.spelling import counted

__all__ = ["Check", "Facts", "checks_of"]

Verdict = Literal["pass", "doubt", "fail", "skip"]
"""Of a stage: passed; passed, but near its limit; failed; not reached."""

FEW_NEGATIVE = 0.1
"""Share of negative events below which they are missing: as much light goes as comes."""

BLIND_CHIPS = 1.1
"""Time from event to event of a pixel, in chips, above which edges one chip apart are lost."""

SMALLEST_PX, SMALL_PX = 1.5, 2.5
"""Pixels a cluster below which clusters cannot be told apart, and below which errors are to be expected: two
sampled points a cluster are the least, and the pixels between two clusters show both."""

SMEARED_CLUSTERS, SHARP_PX = 2.0, 5.0
"""Width of a source, in clusters, above which the light of each covers its neighbours on both sides, and up
to how many px wide a column of LEDs in focus may look."""

RARE_CHIPS, WEAK = 5.0, 0.35
"""Median time between rises, in chips, and mean of the comb, beyond both of which light is too weak: a code
rises every 2.7 chips, and jitter of 20 us leaves .45 of the mean at 10 kHz."""

ROW_US, SLOW_SHARE = 0.2, 0.7
"""What an IMX636 takes to read a row, by its latency against the lit area, and the share of a chip above
which reading a bar's rows, one after another, mixes its edges with the next chip's."""

ACCEPTED_SHARE = 0.8
"""Share of the frames due that are accepted, below which something is wrong with all of them."""

NEAR_RATE = 0.8
"""Share of its largest mean that a source has at the link's rate if that is its rate, or a multiple."""

_FEW = 4
"""Frames of which nothing is said."""

_UNSEEN_SHARE = 0.05
"""Share of unseen clusters of which something is said."""

_MIN_RISES, _LEAST_RATE, _SLENDER = 500, 0.25, 4.0
"""The same for light that is not read beside a bar that is; the least share of the link's rate that it has;
how many times longer than wide it is. Leaves and edges that pass look like a code of some hundred chips a
second, a lamp whose periods are missed like one of some thousand."""

_GLOW_PX = 32
"""Gap up to which light beside a bar is its own."""

_SOME = 0.02
"""Share of all events below which what blinks is not worth a word where nothing sends chips."""

_MIN_CODE = 1000
"""Rises from which a source may be a bar: one of 20 x 3 px has them in 5 ms; leaves and edges that pass have
some hundred."""

_MOST = 0.6
"""Share of the frames that a recording has room for, from which a bar is read whatever happens beside it."""

_BLURRED_SHARE = 0.2
"""Width of what flickers, as a share of its length, above which its light is too weak for being spread."""

_SAME_RATE = 0.03
"""How far two rates may be apart and be one."""

_BESIDE = 0.1
"""Events of a source, of those of the largest, below which it is the halo of a lamp rather than a bar."""

_ASIDE_M = 1e-9
"""Way from a bar's first cluster to its last, in one direction, below which there is none."""

_EDGE_PX = 8
"""Seam of the picture: a source that comes so near may go on outside."""


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


@dataclass(frozen=True)
class Facts:
    """What is known of a recording.

    Attributes:
        link: The link that it was received with.
        events: How many there are.
        seen: Its length, and the events of each millisecond.
        sources: What blinks, by events.
        restless: Box of where far more happens than elsewhere, px; None for nowhere.
        counts: The receiver's counts.
        tally: Its figures.
        losses: What the reader skipped, in words.
        trials: Links that were tried, the one given first.
    """

    link: Link
    events: int
    seen: Seen
    sources: Sequence[LightSource]
    restless: tuple[int, int, int, int] | None
    counts: Mapping[str, int]
    tally: RunTally
    losses: Sequence[str] = ()
    trials: Sequence[Trial] = ()

    @property
    def bar(self) -> LightSource | None:
        """The source that is most likely to be a bar of the link, by its rhythm; None where there is none."""
        rate = self.link.packet.chip_rate_hz
        large = [one for one in self.sources if one.rises >= _MIN_CODE]
        fit = [one for one in large if one.kind != "lamp" and _has_rate(one, rate)]
        codes = [one for one in large if one.kind == "code"]
        # Frames that are accepted are of a bar, however regular its light looks.
        first = next(iter(fit or codes or (large if self.heard else [])), None)
        if first is None or self.reads or first.events >= _BESIDE * self.sources[0].events:
            return first
        return None

    @property
    def at_edge(self) -> bool:
        """Whether the bar's source touches the edge of the picture."""
        if self.bar is None:
            return False
        left, top, right, bottom = self.bar.box_px
        width, height = self.link.camera.width, self.link.camera.height
        return min(left, top) < _EDGE_PX or right > width - _EDGE_PX or bottom > height - _EDGE_PX

    @property
    def reads(self) -> bool:
        """Whether most frames are accepted."""
        frames, rejected = self.counts["frames"], self.counts.get("frames_rejected", 0)
        if frames >= _FEW and frames >= ACCEPTED_SHARE * (frames + rejected):
            return True
        # What is no bar may lose its frames elsewhere in the picture.
        form = self.link.packet
        sent = form.frames / (form.packet_chips * form.chip_us * 1e-6) * self.seen.duration_us * 1e-6
        return any(
            one.frames >= max(_FEW, ACCEPTED_SHARE * (one.last_frame - one.first_frame + 1), _MOST * sent)
            for one in self.tally.own
        )

    @property
    def heard(self) -> bool:
        """Whether some frames are accepted: more than chance gives."""
        return self.counts["frames"] >= _FEW

    @property
    def sure(self) -> bool:
        """Whether most frames are accepted, and their symbols are sure."""
        return self.reads and self.tally.quality >= SURE

    @property
    def better(self) -> Trial | None:
        """Another link that fits, the best of those tried."""
        fit = [trial for trial in self.trials if trial.changes and trial.fits and trial.quality >= SURE]
        return max(fit, key=lambda one: one.rank, default=None)

    @property
    def cluster_px(self) -> float:
        """From cluster to cluster, px: in frames that are read, else by the bar's source; NaN without one."""
        read = [one for one in self.tally.own if one.sized]
        if read:
            one = max(read, key=lambda tally: tally.sized)
            return math.hypot(*one.along_px) / one.sized / self.steps_along
        if self.bar is None:
            return math.nan
        # A source shows the clusters at the ends whole.
        return max(self.bar.wide_px, self.bar.high_px) / (self.steps_along + 1)

    @property
    def steps_along(self) -> float:
        """How many steps from cluster to neighbour it is from the link's first to its last."""
        centres_m = self.link.bar.cluster_centres_m()
        if len(centres_m) < 2:
            return 1.0
        step_m = min(math.dist(centres_m[0], other) for other in centres_m[1:])
        return math.dist(centres_m[0], centres_m[-1]) / step_m

    @property
    def order(self) -> tuple[int, int]:
        """1 where columns, and rows, of clusters grow as in the bar, -1 where they fall, 0 unknown."""
        centres_m = self.link.bar.cluster_centres_m()
        way_m = centres_m[-1] - centres_m[0]
        along_px = np.sum([one.along_px for one in self.tally.own], 0) if self.tally.own else np.zeros(2)
        right, down = np.sign(along_px * np.where(np.abs(way_m) > _ASIDE_M, way_m, 0.0)).astype(int).tolist()
        return right, down

    @property
    def across_px(self) -> float:
        """Its extent across that, px."""
        if self.bar is None:
            return math.nan
        return min(self.bar.wide_px, self.bar.high_px)


def _has_rate(source: LightSource, rate_hz: float) -> bool:
    return source.strength_at(rate_hz) >= NEAR_RATE * source.strength


def checks_of(facts: Facts) -> list[Check]:
    """All stages, in the order in which light passes them.

    Those behind one that fails are skipped.
    """
    found: list[Check] = []
    for stage, judge in _STAGES:
        failed = bool(found) and "fail" in (one.verdict for one in found)
        found.append(Check(stage, "skip", stage, "not reached") if failed else judge(facts))
    return found


def _events(facts: Facts) -> Check:
    if not facts.events:
        return Check(
            "events", "fail", "empty", "no events", "record again: `evlcp info` says what is in the file"
        )
    said = f"{facts.events:,} events in {facts.seen.duration_us * 1e-6:.3f} s"
    if facts.losses:
        return Check(
            "events",
            "doubt",
            "damaged",
            f"{said}; lost: {'; '.join(facts.losses)}",
            "copy or record it again; what is left was read",
        )
    return Check("events", "pass", "events", said)


def _readout(facts: Facts) -> Check:
    for full in saturation(facts.seen):
        verdict: Verdict = "doubt" if facts.reads else "fail"
        return Check("readout", verdict, full.code, full.text, full.next_step)
    return Check("readout", "pass", "readout", f"at most {facts.seen.peak_mev_s:.3g} Mev/s, not at a limit")


def _light(facts: Facts) -> Check:
    width, height = facts.link.camera.width, facts.link.camera.height
    focal = facts.link.camera.focal_px
    view = (
        f"the picture is {2 * math.degrees(math.atan(width / 2 / focal)):.1f} by"
        f" {2 * math.degrees(math.atan(height / 2 / focal)):.1f} degrees, {50 * width / focal:.1f} by"
        f" {50 * height / focal:.1f} m at 50 m"
    )
    if facts.reads:
        return _unread(facts) or Check("light", "pass", "light", _sources_said(facts))
    if not facts.sources:
        return _without_rhythm(facts, view)
    bar = facts.bar
    if bar is None or _is_lamp(bar, facts):
        lamps = [one for one in facts.sources if one.kind == "lamp"]
        rates = ", ".join(_hz(one.rate_hz) for one in lamps[:4])
        if lamps:
            return Check(
                "light",
                "fail",
                "lamp",
                f"{counted(len(lamps), 'lamp')} blinking ({rates}{', ...' if len(lamps) > 4 else ''}),"
                " nothing sends chips",
                f"is a bar in the picture ({view}), and on (`evlcp board status`)?",
            )
        first = facts.sources[0]
        if first.kind != "code" and first.events < _SOME * facts.events:
            return _without_rhythm(facts, view)
        said = f"{_sources_said(facts)}, but too rarely to recognise a code"
        long_px, wide_px = max(first.wide_px, first.high_px), min(first.wide_px, first.high_px)
        if wide_px > _BLURRED_SHARE * long_px:
            said = f"{said}: {wide_px:.0f} px wide, {long_px:.0f} px long, its light is spread"
            return Check("light", "fail", "defocus", said, _SHARPER)
        return Check("light", "fail", "dim", said, _BRIGHTER)
    return Check("light", "pass", "light", _sources_said(facts))


def _unread(facts: Facts) -> Check | None:
    """Light of a code where no frame is read, beside one that is; None where there is none."""
    link_hz = facts.link.packet.chip_rate_hz
    # The centre of a bar that has an end out of the picture may lie outside it, too.
    last = (facts.link.camera.width - 1, facts.link.camera.height - 1)
    places = [
        tuple(float(min(max(at, 0.0), most)) for at, most in zip(one.last_px, last, strict=True))
        for one in facts.tally.transmitters.values()
    ]
    read = [one.box_px for one in facts.sources if any(_gap_px(one.box_px, (*at, *at)) <= 0 for at in places)]
    for source in facts.sources:
        left, top, right, bottom = source.box_px
        code = source.kind == "code" and source.rises >= _MIN_RISES
        same = _has_rate(source, link_hz)
        long_px, wide_px = sorted((source.wide_px, source.high_px), reverse=True)
        likely = source.rate_hz >= _LEAST_RATE * link_hz and long_px >= _SLENDER * wide_px
        if not code or not (same or likely):
            continue
        # A bar's own glow may stand a little apart.
        if any(_gap_px(source.box_px, other) < _GLOW_PX for other in read):
            continue
        return Check(
            "light",
            "doubt",
            "unread",
            f"{_sources_said(facts)}; no frame is read of the one in columns {left} to {right}, rows {top} to"
            f" {bottom}, {_hz(link_hz if same else source.rate_hz)}",
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
    if facts.heard or _has_rate(source, facts.link.packet.chip_rate_hz) or facts.better is not None:
        return False
    lamps = [one.rate_hz for one in facts.sources if one.kind == "lamp"]
    same = (abs(times * source.rate_hz / rate - 1) < _SAME_RATE for rate in lamps for times in (0.5, 1, 2))
    return facts.sources[0].kind == "lamp" or any(same)


def _without_rhythm(facts: Facts, view: str) -> Check:
    """What is said where nothing blinks that is worth a word."""
    if facts.restless is not None:
        left, top, right, bottom = facts.restless
        return Check(
            "light",
            "fail",
            "dim",
            f"something flickers in columns {left} to {right}, rows {top} to {bottom}, without any rhythm:"
            " light that is too weak for its chips, or something that moves",
            _BRIGHTER,
        )
    return Check(
        "light",
        "fail",
        "dark",
        "nothing blinks: no rhythm between 60 Hz and 25 kHz anywhere",
        f"is a bar in the picture ({view}), and on (`evlcp board status`)? One that is too weak, too far"
        " or behind a strong blur shows no rhythm, either",
    )


_SHARPER = "focus the lens, clean it and the window; a smaller aperture is sharper"

_BRIGHTER = (
    "more light: nearer, a wider aperture, brighter LEDs, or a more sensitive sensor (lower bias_diff_on and"
    " bias_diff_off, faster pixels by bias_fo)"
)


def _polarity(facts: Facts) -> Check:
    bar = facts.bar
    if bar is None:
        return Check("polarity", "skip", "polarity", "not reached")
    said = f"{bar.negative_share:.0%} of the bar's events are negative"
    for few, name, bias in (
        (bar.negative_share, "negative", "off"),
        (1 - bar.negative_share, "positive", "on"),
    ):
        if few < FEW_NEGATIVE:
            return Check(
                "polarity",
                "doubt" if facts.reads else "fail",
                f"no-{name}",
                f"only {few:.0%} of the bar's events are {name}",
                f"{'no' if few < 0.02 else 'few'} {name} events: set bias_diff_{bias} so that there are more",
            )
    return Check("polarity", "pass", "polarity", said)


def _pixels(facts: Facts) -> Check:
    bar = facts.bar
    if bar is None:
        return Check("pixels", "skip", "pixels", "not reached")
    chips = bar.blind_us * 1e-6 * facts.link.packet.chip_rate_hz
    if chips > BLIND_CHIPS:
        return Check(
            "pixels",
            "doubt" if facts.reads else "fail",
            "refractory",
            f"a pixel is silent for {bar.blind_us:.0f} us after an event, {chips:.1f} chips: edges that come"
            " sooner are lost",
            "a shorter refractory time (bias_refr), or a lower air.chip_rate_hz at both ends",
        )
    return Check(
        "pixels",
        "pass",
        "pixels",
        f"pixels answer again within {bar.blind_us:.0f} us" if bar.blind_us else "pixels answer at once",
    )


def _brightness(facts: Facts) -> Check:
    bar = facts.bar
    if bar is None:
        return Check("brightness", "skip", "brightness", "not reached")
    chips = bar.typical_us * 1e-6 * facts.link.packet.chip_rate_hz
    said = f"a pixel of it rises every {chips:.1f} chips"
    if not facts.reads and chips > RARE_CHIPS and bar.strength < WEAK:
        return Check(
            "brightness", "fail", "dim", f"{said}, and late by many microseconds: it is too weak", _BRIGHTER
        )
    return Check("brightness", "pass", "brightness", said)


def _rate(facts: Facts) -> Check:
    bar, link = facts.bar, facts.link.packet.chip_rate_hz
    if bar is None:
        return Check("chip rate", "skip", "chip rate", "not reached")
    better = dict(facts.better.changes).get("air.chip_rate_hz") if facts.better is not None else None
    if not facts.reads and (better is not None or not _has_rate(bar, link)):
        rate = bar.rate_hz if better is None else better
        return Check(
            "chip rate",
            "fail",
            "rate",
            f"blinks at {_hz(rate)}, the link says {_hz(link)}",
            f"--set air.chip_rate_hz={rate:g}"
            + ("" if better is not None else ", or the rate that it is sent with"),
        )
    return Check("chip rate", "pass", "chip rate", f"{_hz(link)}, as the link says")


def _size(facts: Facts) -> Check:
    px = facts.cluster_px
    if not px > 0:
        return Check("size", "skip", "size", "not reached")
    said = f"{px:.1f} px a cluster"
    if px >= (SMALL_PX if facts.reads else SMALLEST_PX):
        return _readout_of_rows(facts) or Check("size", "pass", "size", said)
    far_m = facts.link.camera.focal_px * facts.link.bar.length_m / (px * (facts.steps_along + 1))
    return Check(
        "size",
        "doubt" if facts.reads else "fail",
        "far",
        f"{said}, as of a bar {far_m:.0f} m away",
        f"{said}: nearer, or a longer lens" + ("" if facts.reads else " (or fewer, larger clusters)"),
    )


def _readout_of_rows(facts: Facts) -> Check | None:
    """A bar of more rows than are read in a chip; None where it is not, or is read all the same."""
    chip_us = facts.link.packet.chip_us
    rows = 0.0 if facts.bar is None else facts.bar.high_px
    if facts.sure or facts.better is not None or rows * ROW_US < SLOW_SHARE * chip_us:
        return None
    return Check(
        "size",
        "doubt" if facts.reads else "fail",
        "near",
        f"{rows:.0f} rows high: a sensor that reads a row in {ROW_US:g} us takes {rows * ROW_US:.0f} us for"
        f" them, a chip lasts {chip_us:.0f}",
        "further away, a shorter lens, the camera turned by 90 degrees, so that the bar lies along rows, or a"
        " lower air.chip_rate_hz at both ends",
    )


def _focus(facts: Facts) -> Check:
    bar, px = facts.bar, facts.cluster_px
    if bar is None or not px > 0:
        return Check("focus", "skip", "focus", "not reached")
    said = f"{facts.across_px:.0f} px across, {px:.1f} px a cluster along it"
    if not facts.sure and facts.across_px > max(SMEARED_CLUSTERS * px, SHARP_PX):
        return Check(
            "focus",
            "doubt" if facts.reads else "fail",
            "defocus",
            f"{said}: the light of each cluster covers its neighbours, or the layout is another one",
            f"{_SHARPER}; if the picture is sharp, compare [bar] with the transmitter's: `evlcp config` at"
            " both ends",
        )
    return Check("focus", "pass", "focus", said)


def _preamble(facts: Facts) -> Check:
    if "preambles" not in facts.counts:
        return Check("preamble", "skip", "preamble", "not looked for: the link's framing has none")
    heard, regions = facts.counts["preambles"], facts.counts["regions_opened"]
    packet_us = facts.link.packet.packet_chips * facts.link.packet.chip_us
    if not facts.reads and facts.seen.duration_us < 2 * packet_us:
        return Check(
            "preamble",
            "fail",
            "short",
            f"the recording lasts {facts.seen.duration_us * 1e-3:.1f} ms, a packet {packet_us * 1e-3:.1f} ms",
            "record some packets: the next preamble may come after the end",
        )
    if not heard:
        return Check(
            "preamble",
            "fail",
            "no-preamble",
            f"none detected in {regions} region{'s' * (regions != 1)}",
            "compare pilots.id, its parameters and air.chip_rate_hz with the transmitter's: `evlcp config` at"
            " both ends",
        )
    return Check(
        "preamble", "pass", "preamble", f"{heard} detected in {regions} region{'s' * (regions != 1)}"
    )


def _frames(facts: Facts) -> Check:
    frames, rejected = facts.counts["frames"], facts.counts.get("frames_rejected", 0)
    said = f"{frames} of {frames + rejected} accepted"
    if facts.reads and facts.at_edge and (unseen := _unseen_share(facts)) > _UNSEEN_SHARE:
        return Check(
            "frames",
            "doubt",
            "outside",
            f"{said}, {unseen:.0%} of their clusters unseen; the source touches the picture's edge",
            "turn the camera so that the whole bar is in the picture",
        )
    if facts.reads:
        return Check("frames", "pass", "frames", said)
    better = facts.better
    changes = dict(better.changes) if better is not None else {}
    if better is not None and "air.frames_per_packet" in changes:
        return Check(
            "frames",
            "fail",
            "frames-per-packet",
            f"{said}; with {changes['air.frames_per_packet']} frames a packet {better.frames} of"
            f" {better.frames + better.rejected}",
            better.options(),
        )
    if better is not None:
        return Check(
            "frames", "fail", "link", f"{said}; another link reads {better.frames}", better.options()
        )
    if facts.at_edge:
        return Check(
            "frames",
            "fail",
            "outside",
            f"{said}; the source touches the picture's edge",
            "turn the camera so that the whole bar is in the picture",
        )
    return Check(
        "frames",
        "fail",
        "frames",
        f"{said}: the clusters do not stand where the link's bar has them",
        "compare [bar] and [pilots] with the transmitter's: `evlcp config` at both ends",
    )


def _unseen_share(facts: Facts) -> float:
    given, erased = sum(one.given for one in facts.tally.own), sum(one.erased for one in facts.tally.own)
    return erased / max(given + erased, 1)


def _orientation(facts: Facts) -> Check:
    right, down = facts.order
    if -1 not in facts.order:
        return Check("orientation", "pass", "orientation", "clusters stand as in the link's bar")
    # Of a column, left and right are not seen.
    how = "mirrored" if right * down == -1 else "upside down"
    return Check(
        "orientation",
        "doubt",
        how.replace(" ", "-"),
        f"the bar is {how} in the picture; its symbols and distances are right, positions are not",
        "turn the camera, or flip rows where it is read"
        + ("" if right else " (a column does not say whether left and right are mirrored, too)"),
    )


def _codewords(facts: Facts) -> Check:
    many = facts.link.codebook.carrying
    never = max((codewords_never(one, facts.link) for one in facts.tally.own), default=0)
    frames, quality = sum(one.frames for one in facts.tally.own), facts.tally.quality
    if not never and quality >= SURE:
        return Check("codewords", "pass", "codewords", f"all of {many} that should occur do")
    better = facts.better
    name = dict(better.changes).get("modulation.id") if better is not None else None
    unsure = f"mean quality of {frames} frames {quality:.2f}: their symbols are not sure"
    if not never and name is None and (facts.trials or facts.at_edge):
        return Check("codewords", "doubt", "noisy", unsure, _BRIGHTER)
    return Check(
        "codewords",
        "fail",
        "profile",
        f"only {many - never} of {many} symbols ever occur" if never else unsure,
        f"was this sent with {name}? try {better.options()}"
        if better is not None and name is not None
        else "data that repeats, or another modulation.id than the transmitter's",
    )


def _messages(facts: Facts) -> Check:
    tried = facts.counts.get("blocks_tried", 0)
    read = facts.counts.get("blocks_decoded", 0) + facts.counts.get("blocks_combined", 0)
    if not tried:
        return Check("messages", "skip", "messages", "not looked for")
    said = f"{read} of {tried} packets carry a block that can be read"
    if read:
        return Check("messages", "pass", "messages", said)
    return Check(
        "messages",
        "skip",
        "no-messages",
        said,
        "right for symbols without messages; else compare error-correction.id with the transmitter's",
    )


_STAGES: tuple[tuple[str, Callable[[Facts], Check]], ...] = (
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
"""Name and judge, in the order in which light passes them."""


def _sources_said(facts: Facts) -> str:
    by = {kind: sum(one.kind == kind for one in facts.sources) for kind in ("code", "lamp", "unclear")}
    said = {
        "code": f"{counted(by['code'], 'source')} of chips",
        "lamp": counted(by["lamp"], "lamp"),
        "unclear": counted(by["unclear"], "unclear source"),
    }
    return ", ".join(words for kind, words in said.items() if by[kind]) or "no source of its own"


def _hz(rate_hz: float) -> str:
    return f"{rate_hz / 1e3:.4g} kHz" if rate_hz >= 1000 else f"{rate_hz:.3g} Hz"
