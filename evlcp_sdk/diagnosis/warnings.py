"""What looks wrong in a result, in words, each with the next step to try; and what it has none of."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.diagnosis.readout import ReadoutTally
from evlcp_sdk.diagnosis.tallies import RunTally, TransmitterTally
from evlcp_sdk.errors import EvlcpError
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.link.several import alike_links
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.spelling import counted

__all__ = [
    "Diagnostic",
    "LinkPart",
    "Seen",
    "alike_warnings",
    "codewords_never",
    "notes_of",
    "other_codewords",
    "saturation",
    "warnings_of",
    "warnings_of_links",
]

_MOST_IDS = 5
"""Ids that a warning names; how many there are besides, it counts."""

_TOLD_SIGMAS = 3.0
"""Sigmas beyond which what a drive tells is hinted at."""

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

_BY_CHANCE = 1e-6
"""Probability of a finding by chance below which it is stated."""

_SUSPECTS = {
    "focal length": "camera.focal_mm, or give camera_sigma.focal_mm, and the drive shows the right one",
    "heading": "--heading-deg, or that of the attitude file: the camera's, clockwise from north",
    "attitude": "pitch and roll, their signs, and how the camera is mounted",
}
"""What to compare where a part of a position is what the rest contradicts."""


@dataclass(frozen=True)
class Diagnostic:
    """Something that looks wrong, or a plain statement of what there was none of.

    Attributes:
        code: What it is, in a word or two, e.g. `frames-rejected`; the same in every version.
        text: The same in words, with the counts that say so.
        next_step: What to try; empty where there is nothing to do.
        transmitter: Number of the transmitter that it is about; None for all of the recording.
        link: Where there are several links, name of the one that it is about; empty for none of them.

    >>> print(Diagnostic("clock", "its clock is 900 ppm off", "try another rate", 0))
    transmitter 0: its clock is 900 ppm off: try another rate
    """

    code: str
    text: str
    next_step: str = ""
    transmitter: int | None = None
    link: str = ""

    def __str__(self) -> str:
        whose = f"link {self.link}: " if self.link else ""
        whose += "" if self.transmitter is None else f"transmitter {self.transmitter}: "
        return f"{whose}{self.text}" + (f": {self.next_step}" if self.next_step else "")

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON values."""
        found = asdict(self)
        return found if self.link else {key: value for key, value in found.items() if key != "link"}


@dataclass(frozen=True)
class LinkPart:
    """What is known of one of several links.

    Attributes:
        link: The link.
        counts: What it found and dropped.
        reads_messages: Whether messages were looked for.
        others: Codewords of other modulations by id, as in `Seen`.
    """

    link: Link
    counts: Mapping[str, int]
    reads_messages: bool
    others: Callable[[], Mapping[str, NDArray[np.uint8]]] = dict


@dataclass(frozen=True)
class Seen:
    """What is known of a recording beside its transmitters and the receiver's counts.

    Attributes:
        first_us: Its first event, camera clock, us.
        last_us: Its last, us.
        lit_us: Of each transmitter, from when until when frames of it were due and its light was there, by
            number, us.
        readout: Events in each millisecond; None where they were not counted.
        losses: Events and words that the source could not use.
        others: Codewords of other modulations by id, uint8 (symbols, chips); asked where it matters.
        guessed: What the recording does not say and was guessed; empty for nothing.
        step_us: What all its times are multiples of, us; 0 where nobody looked.
        skipped: Silences beside damage that a replay did not wait for, and their time, us.
    """

    first_us: float = math.nan
    last_us: float = math.nan
    lit_us: Mapping[int, tuple[float, float]] | None = None
    readout: ReadoutTally | None = None
    losses: int = 0
    others: Callable[[], Mapping[str, NDArray[np.uint8]]] = dict
    guessed: str = ""
    step_us: int = 0
    skipped: tuple[int, int] = (0, 0)

    @property
    def duration_us(self) -> float:
        """From the first event to the last; 0 where nothing is known of it."""
        length_us = self.last_us - self.first_us
        return length_us if length_us > 0 else 0.0

    @property
    def peak_mev_s(self) -> float:
        """Events a second in the fullest millisecond, in millions; 0 where they were not counted."""
        return self.readout.capped()[1] / 1e3 if self.readout is not None else 0.0


def warnings_of(
    tally: RunTally,
    counts: Mapping[str, int],
    link: Link,
    *,
    seen: Seen | None = None,
    reads_messages: bool = True,
    positions: Mapping[str, Any] | None = None,
) -> list[Diagnostic]:
    """What looks wrong in a result, the recording first, then each transmitter, messages and positions.

    Args:
        tally: Figures of the transmitters; what is said to be a reflection is not doubted.
        counts: The receiver's counts.
        link: The configuration that it ran with.
        seen: What else is known of the recording; None for nothing.
        reads_messages: Whether messages were looked for.
        positions: Figures of the positions, where they were computed.
    """
    seen = Seen() if seen is None else seen
    found = [*saturation(seen), *_coarse_times(seen, [link]), *_dropped(counts, seen)]
    found += [*_frames(counts), *_room(counts)]
    return found + _of_link(tally.transmitters, counts, link, seen, positions, reads_messages=reads_messages)


def warnings_of_links(
    tally: RunTally,
    counts: Mapping[str, int],
    links: Mapping[str, LinkPart],
    *,
    seen: Seen,
    positions: Mapping[str, Any] | None = None,
    placing: str = "",
) -> list[Diagnostic]:
    """What looks wrong in a result of several links: the recording, and then what each link has read.

    Args:
        tally: Figures of the transmitters.
        counts: The receiver's counts, of all links together.
        links: What is known of each link, by name.
        seen: What else is known of the recording.
        positions: Figures of the positions, where they were computed.
        placing: Name of the link that says what is wrong with them.
    """
    found = [*saturation(seen), *_coarse_times(seen, [part.link for part in links.values()])]
    found += [*_dropped(counts, seen), *_room(counts)]
    found += alike_warnings({name: part.link for name, part in links.items()})
    if not tally.transmitters:
        return found + list(_frames(counts))
    for name, part in links.items():
        told = [one for one in _frames(part.counts) if one.code not in ("no-preamble", "no-frames")]
        told += _of_link(
            tally.of_link(name),
            part.counts,
            part.link,
            replace(seen, others=part.others),
            positions if name == placing else None,
            reads_messages=part.reads_messages,
        )
        found += [replace(one, link=name) for one in told]
    return found


def _coarse_times(seen: Seen, links: Sequence[Link]) -> Iterator[Diagnostic]:
    """Times in steps of more than a quarter of a chip: of when a light changed, little is left."""
    chip_us = min(link.packet.chip_us for link in links)
    if seen.step_us > chip_us / 4:
        yield Diagnostic(
            "coarse-times",
            f"times are rounded to {seen.step_us / 1000:g} ms; a chip is {chip_us / 1000:g} ms",
            "export them in whole microseconds, or with six decimals of a second",
        )


def alike_warnings(links: Mapping[str, Link]) -> Iterator[Diagnostic]:
    """Links of which nothing on air tells one from the other, by name: known before anything is read."""
    for one, other in alike_links(links):
        yield Diagnostic(
            "alike-links",
            f"what one of the links '{one}' and '{other}' sends, the other may read: the rates are alike,"
            " and codewords of one are codewords of the other",
            "give the one that is sent with, or let them differ in rate or parity",
        )


def _of_link(
    transmitters: Mapping[int, TransmitterTally],
    counts: Mapping[str, int],
    link: Link,
    seen: Seen,
    positions: Mapping[str, Any] | None,
    *,
    reads_messages: bool,
) -> list[Diagnostic]:
    """What looks wrong in what a link has read."""
    found: list[Diagnostic] = []
    for number, one in sorted(transmitters.items()):
        if one.frames - one.echoes >= _FEW_FRAMES:
            found += _transmitter(number, one, link, counts, seen)
        if one.frames > one.echoes:
            found += _coverage(number, one, link, seen)
        found += _length(number, one, link)
        if positions is None:
            found += _turned(number, one, link)
        found += _unread(number, one)
    if reads_messages:
        found += _blocks(counts)
    if positions is not None:
        found += _positions(positions, link)
    return found


def notes_of(
    tally: RunTally,
    counts: Mapping[str, int],
    *,
    seen: Seen | None = None,
    reads_messages: bool = True,
) -> list[Diagnostic]:
    """Plain statements: reflections, what was guessed or skipped, what had no frames, and no messages.

    Args:
        tally: Figures of the transmitters.
        counts: The receiver's counts.
        seen: What else is known of the recording; None for nothing.
        reads_messages: Whether messages were looked for.
    """
    found = [
        Diagnostic(
            "reflection",
            f"a reflection of transmitter {one.echo_of}, {counted(one.echoes, 'frame')}",
            "",
            number,
        )
        for number, one in sorted(tally.transmitters.items())
        if one.echoes and one.echo_of is not None
    ]
    seen = Seen() if seen is None else seen
    if seen.guessed:
        found.append(
            Diagnostic("guessed", seen.guessed, "where it is wrong, list:PATH?columns=...&unit=... says it")
        )
    silences, silent_us = seen.skipped
    if silences:
        found.append(
            Diagnostic(
                "pace",
                f"{counted(silences, 'silence')} of {silent_us * 1e-6:.1f} s in all, where the recording is"
                " damaged, not waited for",
            )
        )
    if not tally.transmitters and counts.get("events", 0):
        found.append(
            Diagnostic(
                "nothing-found", "no frame was read", "`evlcp diagnose` says what blinks, and what to try"
            )
        )
    if seen.duration_us and tally.transmitters:
        covered_us = tally.covered_us
        if covered_us < (1 - _COVERED) * seen.duration_us:
            first_us = min(one.first_us for one in tally.transmitters.values())
            last_us = max(one.last_us for one in tally.transmitters.values())
            found.append(
                Diagnostic(
                    "coverage",
                    f"frames in {_ms(covered_us)} of {_ms(seen.duration_us)}: nothing before"
                    f" {_ms(first_us - seen.first_us)}, nothing after {_ms(last_us - seen.first_us)}",
                )
            )
    tried = counts.get("blocks_tried", 0)
    if reads_messages and tried and not _read(counts):
        what = f"none of {tried} packets has" if tried > 1 else "the packet does not have"
        found.append(Diagnostic("no-messages", f"no messages: {what} a block that can be read"))
    return found


def other_codewords(link: Link, registry: Registry) -> dict[str, NDArray[np.uint8]]:
    """Codewords of the other modulations that are installed, by id, uint8 (symbols, chips)."""
    found: dict[str, NDArray[np.uint8]] = {}
    if "modulation" not in link.table:
        return found
    for installed in registry.installed("modulation"):
        name = installed.algorithm.id
        if name == link.table["modulation"]["id"]:
            continue
        try:
            other = resolve({**link.table, "modulation": {"id": name}}, registry)
        except EvlcpError:
            continue
        found[name] = other.codebook.codewords
    return found


def _ms(t_us: float) -> str:
    return f"{t_us * 1e-3:.0f} ms" if t_us < 1e7 else f"{t_us * 1e-6:.1f} s"


def _s(number: int) -> str:
    return "s" * (number != 1)


def _apart(positions: Mapping[str, Any]) -> str:
    """By how much GNSS is off bars, if that is known."""
    apart = positions["gnss_apart_m"]
    if apart is None:
        return ""
    east, north, up = (f"{value:+.3g}" for value in apart)
    return f": it is {east} m east, {north} north, {up} up of them"


def _read(counts: Mapping[str, int]) -> int:
    return counts.get("blocks_decoded", 0) + counts.get("blocks_combined", 0)


def _positions(positions: Mapping[str, Any], link: Link) -> Iterator[Diagnostic]:
    satellites = positions["gnss"] + positions["gnss_outside"]
    if not positions["fixes"] + sum(positions["refused"].values()) + satellites:
        return
    exact = positions["bars_exact"]
    unsaid = [f"bars {', '.join(map(str, exact))} (position_sigma_m in site.toml)"] if exact else []
    if not link.camera_sigma.known:
        unsaid.append("the camera ([camera_sigma], which evlcp calibrate prints)")
    if unsaid:
        yield Diagnostic(
            "no-sigma",
            f"positions take as exact what has no sigma: {' and '.join(unsaid)}; their sigmas and protection"
            " levels hold only if it is",
        )
    fits_mm = positions.get("focal_mm_fits")
    lens = (
        ""
        if fits_mm is None
        else f"camera.focal_mm = {link.camera.focal_mm:g}: about {fits_mm:.3g} would fit"
    )
    for name, number in positions["excluded"].items():
        steps = [lens] if lens and name != "focal length" else []
        steps.append(_SUSPECTS.get(name, "its place, angles and length, and their sigmas"))
        yield Diagnostic(
            "excluded",
            f"{number} position{_s(number)} without {name}, which the rest contradicts",
            f"compare {'; or '.join(steps)}",
        )
    yield from _learnt(positions["learnt"], link)
    if number := positions["alarms"].get("contradicted", 0):
        yield Diagnostic(
            "gnss-contradicted",
            f"{number} time{_s(number)} bars and GNSS contradict one another{_apart(positions)}",
            "compare heights (above the ellipsoid), the sigmas of both, position.antenna_m, and both clocks",
        )
    if (number := positions["attitude_missing"]) and not positions["attitude_outside"]:
        tried = positions["fixes"] + sum(positions["refused"].values())
        yield Diagnostic(
            "attitude-missing",
            f"{number} of {tried} positions have no attitude: its file does not reach there, or lacks lines",
            "t_us of its file has to be the camera's clock, us, from before the first bar to after the last",
        )
    if number := positions["attitude_outside"]:
        yield Diagnostic(
            "attitude-outside",
            f"none of the attitude's {number} lines is within the recording's time",
            "t_us of its file has to be the camera's clock, us",
        )
    if (number := positions["gnss_outside"]) and not positions["gnss"]:
        yield Diagnostic(
            "gnss-outside",
            f"none of {number} GNSS fixes is within the recording's time",
            "t_us of their file has to be the camera's clock",
        )
    if number := positions["gnss_without_heading"]:
        yield Diagnostic(
            "gnss-without-heading",
            f"{number} GNSS fix{'es' * (number != 1)} not used, as no heading says where the antenna is"
            " (position.antenna_m)",
            "give an attitude with a heading",
        )
    if (number := positions["refused"].get("no-site", 0)) and not positions["fixes"]:
        heard = sorted(set(positions["heard"].values()))
        ids = f"id{_s(len(heard))} {_some(heard)}" if heard else "no id"
        yield Diagnostic(
            "no-site",
            f"{number} position{_s(number)} refused, as no bar in view stands at a known place;"
            f" received: {ids}",
            "compare transmitter_id in site.toml",
        )
    placed = {*positions["bars"], *positions["sites_contradicted"]}
    strange = sorted({one for n, one in positions["heard"].items() if n not in placed})
    unseen = positions["sites_unseen"]
    if positions["fixes"] and strange and unseen:
        # Either alone is no fault: a bar that is not on the list, a bar of the list that is elsewhere.
        yield Diagnostic(
            "unknown-id",
            f"positions are without id{_s(len(strange))} {_some(strange)}, received and in no site;"
            f" id{_s(len(unseen))} {_some(unseen)} of the sites {'were' if len(unseen) > 1 else 'was'} not",
            "compare transmitter_id in site.toml",
        )
    if number := positions["refused"].get("misfit", 0):
        yield _misfit(number, positions.get("suspects", {}), lens)


def _some(ids: Sequence[int]) -> str:
    """Ids, the first ones by name."""
    more = f" and {len(ids) - _MOST_IDS} more" if len(ids) > _MOST_IDS else ""
    return ", ".join(map(str, ids[:_MOST_IDS])) + more


def _misfit(number: int, suspects: Mapping[str, int], lens: str) -> Diagnostic:
    """Positions refused, with the parts that would each explain most of them."""
    text = f"{number} position{_s(number)} refused, as bars, attitude and camera contradict one another"
    likely = {name: times for name, times in suspects.items() if 2 * times > number}
    steps = {name: _SUSPECTS.get(name, f"place, angles and length of {name}") for name in likely}
    if lens and "focal length" not in likely:
        # One that is far off; what explains all of them at once is the first to compare.
        likely["focal length"] = number + 1
        steps["focal length"] = lens
    if not likely:
        return Diagnostic(
            "misfit",
            text,
            "compare sites, angles and [camera], its focal_mm first, with what is there, and their sigmas",
        )
    names = sorted(likely, key=lambda name: -likely[name])
    return Diagnostic(
        "misfit",
        f"{text}; another {' or another '.join(names)} would explain it",
        f"compare {'; '.join(steps[name] for name in names)}",
    )


def _learnt(rows: Sequence[Mapping[str, Any]], link: Link) -> Iterator[Diagnostic]:
    for row in rows:
        off, sigma, stated = row["correction"], row["sigma"], row["stated_sigma"]
        if not row["determined"]:
            continue
        if abs(off) > _TOLD_SIGMAS * stated:
            yield Diagnostic(
                "learnt",
                f"the drive shows {row['part']}, {row['what']}, {off:+.3g} off what is stated, {stated:.3g}"
                f" (sigma): {abs(off) / stated:.1f} sigmas",
                "compare it with what is there",
            )
        elif row["what"] == "focal_mm" and abs(off) > _TOLD_SIGMAS * sigma:
            yield Diagnostic(
                "focal",
                f"the drive shows a focal length of {link.camera.focal_mm + off:.5g} +- {sigma:.2g} mm, not"
                f" {link.camera.focal_mm:g}",
                "camera.focal_mm and camera_sigma.focal_mm may say so",
            )


def saturation(seen: Seen) -> Iterator[Diagnostic]:
    """A readout that is at its limit."""
    if seen.readout is not None and seen.readout.at_limit:
        share, _ = seen.readout.capped()
        yield Diagnostic(
            "saturated",
            f"{share:.0%} of all milliseconds, {seen.readout.capped_ms}, hold {seen.peak_mev_s:.3g} Mev/s, no"
            " more and no less: the sensor's readout is at its limit, and what is beyond is lost",
            "mask rows and columns beside the bar, close the aperture, or raise the event-rate limit",
        )


def _dropped(counts: Mapping[str, int], seen: Seen) -> Iterator[Diagnostic]:
    """Events that were there and did not count, for other reasons than room."""
    names = [name for name, _ in _NO_ROOM]
    dropped = {n: k for n, k in counts.items() if n.startswith("dropped_") and k and n not in names}
    number = sum(dropped.values()) + seen.losses
    if number >= _DROPPED_LEAST and number > _DROPPED_SHARE * (counts.get("events", 0) + seen.losses):
        kinds = [f"{k} {n.removeprefix('dropped_').replace('_', ' ')}" for n, k in dropped.items()]
        kinds += [f"{seen.losses} in the file"] * (seen.losses > 0)
        yield Diagnostic(
            "dropped",
            f"{number} events or words dropped ({', '.join(kinds)})",
            "losses and counts in summary.json say where and why; `evlcp info` says what is in the recording",
        )


def _frames(counts: Mapping[str, int]) -> Iterator[Diagnostic]:
    blinking = counts.get("events_in_regions", 0)
    if blinking >= _MANY_EVENTS and not counts.get("locks", counts.get("frames", 0)):
        regions = counts.get("regions_opened", 0)
        blinks = f"something blinks, {blinking} events in {regions} region{_s(regions)}"
        if "locks" in counts:
            yield Diagnostic(
                "no-preamble",
                f"{blinks}, but no preamble is detected",
                "compare air.chip_rate_hz and the preamble with the transmitter's; a panel or leaves behind a"
                " bar may mask it; `evlcp diagnose` says what blinks, and how fast",
            )
        else:
            yield Diagnostic(
                "no-frames",
                f"{blinks}, but no frame is read",
                "compare air.chip_rate_hz and [framing] with the transmitter's; `evlcp diagnose` says what"
                " blinks, and how fast",
            )
    if frames := counts.get("frames", 0):
        yield from _signs(counts, blinking, frames)
    rejected, frames = counts.get("frames_rejected", 0), counts.get("frames", 0)
    share = _REJECTED_BESIDE_READ_SHARE if _read(counts) > counts.get("blocks_failed", 0) else _REJECTED_SHARE
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
    askew = counts.get("frames_askew", 0)
    if askew >= _FEW_FRAMES and askew > _ASKEW_SHARE * frames:
        yield Diagnostic(
            "attitude",
            f"{min(askew, frames)} of {frames} frames show bars that do not stand plumb by the camera's"
            " attitude, which does not correct their distances",
            "check pitch and roll, their signs and their sigma",
        )


def _signs(counts: Mapping[str, int], events: int, frames: int) -> Iterator[Diagnostic]:
    """Frames of a light that is the other way round than said, or of which one kind of edges is not seen."""
    # Of several links those that another one fits better may all be among them.
    inverted = counts.get("frames_inverted", 0) - counts.get("frames_of_others", 0)
    if inverted >= _FEW_FRAMES and inverted > _INVERTED_SHARE * frames:
        yield Diagnostic(
            "polarity",
            f"{inverted} of {frames} frames fit only a light that is on where the link says off, and were"
            " read so",
            "compare framing.idle with the transmitter, and the polarities of a list: "
            "list:PATH?inverted=1 turns them",
        )
    on = counts.get("events_in_regions_on")
    if on is None or events < _ONE_SIGN_EVENTS:
        return
    if min(on, events - on) < _ONE_SIGN_SHARE * events:
        sign, other = ("ON", "off") if 2 * on > events else ("OFF", "on")
        yield Diagnostic(
            "one-polarity",
            f"{max(on, events - on)} of {events} events are {sign}: when the light goes {other} is not"
            " seen, so that most of what it says may be read in several ways",
            "give events of both polarities: see the list's column of polarity, or the camera's thresholds",
        )


def _room(counts: Mapping[str, int]) -> Iterator[Diagnostic]:
    """What the receiver had no room for."""
    found = [text.format(n, _s(n)) for name, text in _NO_ROOM if (n := counts.get(name, 0))]
    if found:
        yield Diagnostic(
            "no-room",
            f"more than the receiver holds at a time: {'; '.join(found)}; frames may be missing",
        )


def _transmitter(
    number: int, one: TransmitterTally, link: Link, counts: Mapping[str, int], seen: Seen
) -> Iterator[Diagnostic]:
    ppm = one.clock_ppm()
    # A packet's time may be half a chip off where the light changes.
    unsure_ppm = link.packet.chip_us / 2 / one.steps_us * 1e6 if one.steps_us else math.inf
    if abs(ppm) > _CRYSTALS_PPM + unsure_ppm:
        fits = link.packet.chip_rate_hz * (1 + ppm * 1e-6)
        yield Diagnostic(
            "clock",
            f"its clock is {ppm:+.0f} ppm off the link's, crystals stay within {_CRYSTALS_PPM:.0f}",
            f"air.chip_rate_hz = {fits:.6g} would fit",
            number,
        )
    yield from _codewords(number, one, link, counts, seen)
    yield from _unsure(number, one, link, seen)
    # What was left out for lack of time, of whichever transmitter, says nothing of the bar.
    own = (one.frames - one.echoes) / link.packet.pilot_every - counts.get("frames_not_ranged", 0)
    if (
        "ranging" in link.algorithms
        and link.algorithm("ranging").measures
        and one.ranged < _RANGED_SHARE * own
    ):
        yield Diagnostic(
            "few-distances",
            f"{one.ranged} of {own:.0f} frames have a distance: too few boundaries between clusters are seen,"
            " or their values do not fit the layout",
            "another ranging.id may tolerate it",
            number,
        )
    hidden = [k for k in range(link.codebook.clusters) if one.unseen[k] == one.frames]
    if hidden:
        yield Diagnostic(
            "clusters-hidden",
            f"clusters never seen: {', '.join(map(str, hidden))}",
            "is something before them? if not, compare the link's [bar] and [pilots] with the bar",
            number,
        )
    yield from _size(number, one, link)


def _codewords(
    number: int, one: TransmitterTally, link: Link, counts: Mapping[str, int], seen: Seen
) -> Iterator[Diagnostic]:
    """Codewords that never occur, and the modulation that they are all of."""
    if link.characters_on_air and not one.blocks:
        # Of characters a text has few.
        yield from _turned_bits(number, one, link)
        yield from _one_character(number, one, link)
        return
    never = codewords_never(one, link)
    if not never:
        return
    codewords, occur = link.codebook.carrying, len(one.values)
    tried = counts.get("blocks_tried", 0)
    unread = f", {tried} of {tried} blocks unreadable" if tried and not _read(counts) else ""
    for name, words in seen.others().items():
        inside = _among(link.codebook.codewords, words)
        heard = [s for s in np.flatnonzero(inside).tolist() if one.values[s]]
        share = sum(one.values[s] for s in heard) / one.given
        if len(words) < codewords and share >= _SPLIT and len(heard) > len(words) / 2:
            text = f"only {occur} of {codewords} symbols ever occur"
            if occur > len(words):
                text = f"{share:.0%} of its symbols are {len(heard)} of {codewords}"
            yield Diagnostic(
                "profile",
                f"{text}{unread}",
                f"was this sent with {name}? try --set modulation.id={name}",
                number,
            )
            return
    yield Diagnostic(
        "codewords",
        f"{never} of {codewords} codewords never occur in {one.given} symbols{unread}",
        "data that repeats, or another modulation than modulation.id",
        number,
    )


def _turned_bits(number: int, one: TransmitterTally, link: Link) -> Iterator[Diagnostic]:
    """Characters that are text if their bits come the other way round."""
    each = link.codebook.bits_per_symbol
    text = {*range(0x20, 0x7F), 0x09, 0x0A, 0x0D}
    # Blanks and small letters are most of any text.
    usual = {0x20, *range(0x61, 0x7B)}
    shares = []
    for turned in (False, True):
        codes = {s: int(f"{s:0{each}b}"[::-1], 2) if turned else s for s in one.values}
        shares.append(
            [
                sum(one.values[s] for s, code in codes.items() if code in of) / one.given
                for of in (text, usual)
            ]
        )
    own, other = shares
    if one.given >= _FEW_FRAMES and other[0] > _SPLIT > own[0] + 0.1 and other[1] > own[1]:
        yield Diagnostic(
            "bit-order",
            f"{own[0]:.0%} of its characters are printable, and {other[0]:.0%} if their bits come the other"
            " way round",
            "compare framing.first_bit with the transmitter",
            number,
        )


def _one_character(number: int, one: TransmitterTally, link: Link) -> Iterator[Diagnostic]:
    """Characters that are all the same, as those of a lamp are that blinks once in a character's time."""
    value = max(one.values, key=one.values.__getitem__, default=0)
    if one.given >= _MANY_CHARACTERS and one.values[value] > _ALIKE_SHARE * one.given:
        digits = (link.codebook.bits_per_symbol + 3) // 4
        yield Diagnostic(
            "one-character",
            f"{one.values[value]} of its {one.given} characters are 0x{value:0{digits}x}: a lamp that blinks"
            " once in a character's time reads like that",
            "look where it stands in the picture",
            number,
        )


def _unsure(number: int, one: TransmitterTally, link: Link, seen: Seen) -> Iterator[Diagnostic]:
    """Symbols that are not given, of every cluster, or that are said to be wrong.

    What covers some of a bar is no fault of the link's.
    """
    clusters = [k for k in range(link.codebook.clusters) if one.unseen[k] < one.frames]
    quality = one.quality_sum / one.frames
    if clusters and min(one.unseen[k] for k in clusters) >= _UNSURE_SHARE * one.frames:
        share = sum(one.unseen[k] for k in clusters) / (one.frames * len(clusters))
        text = f"{share:.0%} of its symbols are not sure, of every cluster {_UNSURE_SHARE:.0%} and more"
    elif quality < _LEAST_QUALITY:
        text = f"{1 - quality:.0%} of its frames have a symbol that is wrong, by the receiver's own account"
    else:
        return
    own = link.codebook.codewords
    larger = [
        name for name, words in seen.others().items() if len(words) > len(own) and _among(own, words).all()
    ]
    asked = f"was this sent with {' or '.join(larger)} (modulation.id)? if not, " if larger else ""
    yield Diagnostic(
        "unsure",
        text,
        f"{asked}more light, a sharper image, or another decoding.id; `evlcp diagnose` says what it lacks",
        number,
    )


def _among(words: NDArray[np.uint8], others: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which words are others, too, bool (symbols,); none where they are of another length."""
    if words.shape[1] != others.shape[1]:
        return np.zeros(len(words), np.bool_)
    known = {row.tobytes() for row in np.ascontiguousarray(others)}
    return np.array([row.tobytes() in known for row in np.ascontiguousarray(words)])


def codewords_never(one: TransmitterTally, link: Link) -> int:
    """How many codewords never occur in what a transmitter sent, 0 where that may be chance.

    Packets may repeat one another, so that all of them say no more than one.
    """
    codewords = link.codebook.carrying
    never = codewords - sum(symbol < codewords for symbol in one.values)
    if not one.given or not never:
        return 0
    # Equally likely codewords; the union of all sets of so many bounds the chance that they never occur.
    ways = math.lgamma(codewords + 1) - math.lgamma(never + 1) - math.lgamma(codewords - never + 1)
    given = min(one.given, link.packet.frames * link.codebook.clusters)
    chance = ways + given * math.log1p(-never / codewords)
    return never if chance < math.log(_BY_CHANCE) else 0


def _size(number: int, one: TransmitterTally, link: Link) -> Iterator[Diagnostic]:
    """Distances against those that the bar's length in the picture gives."""
    if one.sized < _FEW_FRAMES:
        return
    centres_m = link.bar.cluster_centres_m()
    reach = math.exp(one.reach_sum / one.sized)
    share = reach / (link.camera.focal_px * math.dist(centres_m[0], centres_m[-1])) - 1
    if abs(share) > _SIZE_OFF:
        yield Diagnostic(
            "size",
            f"its distances are {abs(share):.0%} too {'long' if share > 0 else 'short'} for a bar of"
            f" {link.bar.length_m:g} m that looks as long as this one",
            "try another ranging.id; a bar that leans looks shorter",
            number,
        )


def _turned(number: int, one: TransmitterTally, link: Link) -> Iterator[Diagnostic]:
    """A bar that stands on its head in the picture; where positions are computed, they tell."""
    centres_m = link.bar.cluster_centres_m()
    along, way = np.array(one.along_px), centres_m[-1] - centres_m[0]
    if one.sized >= _FEW_FRAMES and along @ way < -_HEAD_DOWN * math.hypot(*along) * math.hypot(*way):
        yield Diagnostic(
            "turned",
            "its clusters stand the other way round in the picture",
            "is the camera upside down, its picture mirrored, or the bar mounted so? positions have to know",
            number,
        )


def _length(number: int, one: TransmitterTally, link: Link) -> Iterator[Diagnostic]:
    """The bar's length as its own beacon says it."""
    said_m, length_m = one.beacon_m, link.bar.length_m
    if not math.isnan(said_m) and abs(said_m / length_m - 1) > _LENGTH_OFF:
        how = f"{abs(length_m / said_m - 1):.0%} too {'long' if length_m > said_m else 'short'}"
        yield Diagnostic(
            "bar-length",
            f"its beacon says that the bar is {said_m:.3f} m long, the link {length_m:.3f}: its distances are"
            f" {how} if the beacon is right",
            "compare the link's [bar] with the transmitter's",
            number,
        )


def _coverage(number: int, one: TransmitterTally, link: Link, seen: Seen) -> Iterator[Diagnostic]:
    """Light that is there before the first frame or after the last one."""
    lit = (seen.lit_us or {}).get(number)
    if lit is None or not seen.duration_us:
        return
    least_us = max(
        _LIT_SHARE * seen.duration_us, _LIT_PACKETS * link.packet.packet_chips * link.packet.chip_us
    )
    at = [_ms(t_us - seen.first_us) for t_us in (one.first_us, lit[0], one.last_us, lit[1])]
    said = []
    if one.first_us - lit[0] > least_us:
        said.append(f"nothing before {at[0]}, though its light is there from {at[1]} on")
    if lit[1] - one.last_us > least_us:
        said.append(f"nothing after {at[2]}, though its light is there until {at[3]}")
    if said:
        yield Diagnostic(
            "coverage",
            "; ".join(said),
            "compare air.chip_rate_hz and air.frames_per_packet with the transmitter's, or try --link auto",
            number,
        )


def _blocks(counts: Mapping[str, int]) -> Iterator[Diagnostic]:
    tried, read = counts.get("blocks_tried", 0), _read(counts)
    if other := counts.get("blocks_other_codebook", 0):
        yield Diagnostic(
            "other-codebook",
            f"{other} packet{_s(other)} sent with another codebook",
            "compare both ends' `evlcp config`",
        )
    alike = counts.get("blocks_alike", 0)
    if not read and alike >= _ALIKE:
        yield Diagnostic(
            "blocks-unread",
            f"none of {tried} packets has a block that can be read, though {alike} of them repeat others",
            "another error correction than error-correction.id, or frames taken from another place in the"
            " packet than they were sent in; if no messages are sent, say messages.decode = false",
        )


def _unread(number: int, one: TransmitterTally) -> Iterator[Diagnostic]:
    """Packets without a block of a transmitter that sends some; another one may send none at all."""
    failed = one.packets - one.blocks
    if one.blocks and failed >= _FEW_FRAMES and failed > _FAILED_SHARE * one.packets:
        yield Diagnostic(
            "blocks-failed",
            f"{failed} of {one.packets} packets cannot be read",
            "more light, a nearer or a better focused bar, or an error correction of a lower rate",
            number,
        )
