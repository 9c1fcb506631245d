"""Laws of framing and of detection: both keep state, and both may leave their work to the receiver."""

import pickle
from dataclasses import replace
from typing import Any

import numpy as np

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.testing.exercises import compiled_subject, heard_of, link_of, link_of_one_cluster
from evlcp_sdk.testing.law import Law, Subject, expect
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, random_symbols
from evlcp_sdk.testing.trees import difference
from evlcp_sdk.values import Events, Heard, Region

__all__ = ["DETECTION", "FRAMING"]

_PACKETS = 4
_STEP_US = 1500
_FLUSH_US = 100_000
_SAME = 1e-9
_NEAR_CHIPS = 0.75
_MOST_BYTES = 1 << 22
"""What a state may take, pickled, however long the stream is."""


def _recording(link: Link, packets: int = _PACKETS, seed: int = 0) -> tuple[IdealBar, Events]:
    bar = IdealBar(random_symbols(link, packets, seed))
    return bar, ideal_events(link, bar, missing=0.0)


def _times(events: Events) -> list[int]:
    last = int(events.t_us[-1]) + 1
    return [*range(_STEP_US, last + _STEP_US, _STEP_US), last + _FLUSH_US]


def reads_clean(subject: Subject) -> None:
    """Hold the law."""
    link, deframer = link_of(subject), compiled_subject(subject)
    if deframer is None:
        return
    bar, events = _recording(link)
    heard = heard_of(deframer, events, _times(events))
    sent = bar.symbols.reshape(-1, link.codebook.clusters)
    # The first packet begins with the recording: its first frame may be cut.
    expect(len(heard) >= len(sent) - 1, f"{len(sent)} frames, or all but the first; got {len(heard)}")
    chip_us = link.packet.chip_us
    for one in heard:
        at = (one.t_us - bar.start_us) / chip_us
        packet, chip = divmod(at + _NEAR_CHIPS, link.packet.packet_chips)
        starts = [link.packet.frame_start_chip(frame) for frame in range(link.packet.frames)]
        frame = int(np.abs(np.array(starts) + _NEAR_CHIPS - chip).argmin())
        off = abs(chip - _NEAR_CHIPS - starts[frame])
        expect(off <= _NEAR_CHIPS, f"frames where they were sent, got one {off:.2f} chips off")
        expect(frame == one.frame, f"number {frame} of the frame at {one.t_us:.0f} us, got {one.frame}")
        said = bar.symbols[int(packet), frame]
        expect(
            np.array_equal(one.soft.symbols, said),
            f"symbols {said.tolist()}, got {one.soft.symbols.tolist()}",
        )


def any_split(subject: Subject) -> None:
    """Hold the law."""
    link, deframer = link_of(subject), compiled_subject(subject)
    if deframer is None:
        return
    _, events = _recording(link)
    wanted = heard_of(deframer, events, _times(events))
    last = int(events.t_us[-1]) + 1
    rng = np.random.default_rng(0)
    cuts = {
        "all at once": [last + _FLUSH_US],
        "at random": [*np.sort(rng.integers(1, last, 200)).tolist(), last + _FLUSH_US],
    }
    for how, until_us in cuts.items():
        differs = difference(heard_of(deframer, events, until_us), wanted, _SAME, "frames")
        expect(differs is None, f"the same frames from events fed {how} as every {_STEP_US} us; {differs}")


def state_kept(subject: Subject) -> None:
    """Hold the law."""
    link, deframer = link_of(subject), compiled_subject(subject)
    if deframer is None:
        return
    _, events = _recording(link)
    half = len(events) // 2
    middle, end = int(events.t_us[half]), int(events.t_us[-1]) + _FLUSH_US
    state, _ = deframer.step(deframer.init(), events[:half], middle)

    def rest() -> list[Heard]:
        then, heard = deframer.step(state, events[half:], end)
        counts = deframer.counts(then)
        expect(all(isinstance(n, int) for n in counts.values()), f"counts of whole numbers, got {counts}")
        return [*heard, *deframer.close(then)[1]]

    first = rest()
    differs = difference(rest(), first, name="frames")
    expect(differs is None, f"a step not to change the state it is given: the same frames again; {differs}")
    state = pickle.loads(pickle.dumps(state))
    differs = difference(rest(), first, name="frames")
    expect(differs is None, f"the same frames from a pickled state; {differs}")


def bounded(subject: Subject) -> None:
    """Hold the law."""
    link, deframer = link_of(subject), compiled_subject(subject)
    if deframer is None:
        return
    rng = np.random.default_rng(0)
    state, now_us = deframer.init(), 0
    packet_us = link.packet.packet_chips * link.packet.chip_us
    step_us = max(_STEP_US, round(packet_us / 4))
    for _ in range(40):
        n = 500
        t_us = np.sort(rng.integers(now_us, now_us + step_us, n))
        now_us += step_us
        noise = Events.of(t_us, np.zeros(n), np.zeros(n), rng.integers(0, 2, n))
        state, _ = deframer.step(state, noise, now_us)
    size = len(pickle.dumps(state))
    expect(
        size <= _MOST_BYTES, f"a state of at most {_MOST_BYTES} bytes after ten packets of noise, got {size}"
    )


def _detected(detector: Any, events: Events, keep: Any = None) -> list[list[Region]]:
    """The regions of each step of a recording."""
    state = detector.init()
    found = []
    for start_us in range(0, int(events.t_us[-1]), _STEP_US):
        a, b = np.searchsorted(events.t_us, (start_us, start_us + _STEP_US))
        if keep is not None:
            state = keep(state, start_us)
        state, regions = detector.step(state, start_us, events[a:b])
        found.append(regions)
    return found


def _seen(subject: Subject) -> tuple[Any, Events]:
    """A detector, and a recording in which it finds something, if any: of a bar, or else of one light."""
    link, detector = link_of(subject), compiled_subject(subject)
    _, events = _recording(link, 2)
    if detector is not None and subject.link is None and not any(_detected(detector, events)):
        # One that looks for single lights sees none in a bar.
        one = replace(subject, link=link_of_one_cluster())
        return compiled_subject(one), _recording(link_of(one), 2)[1]
    return detector, events


def regions_shapes(subject: Subject) -> None:
    """Hold the law."""
    detector, events = _seen(subject)
    if detector is None:
        return
    found = _detected(detector, events)
    for regions in found:
        ids = [region.id for region in regions]
        expect(len(set(ids)) == len(ids), f"regions of different ids, got {ids}")
        for region in regions:
            values = region.x_px, region.y_px, region.width_px, region.height_px
            expect(np.isfinite(values).all(), f"finite places and sizes, got {region}")
    expect(any(found), "a region in a recording of a bar, or of one light; got none")


def detection_state_kept(subject: Subject) -> None:
    """Hold the law."""
    detector, events = _seen(subject)
    if detector is None:
        return

    def branch(state: Any, start_us: int) -> Any:
        # A branch that is given up, and a state that was away.
        detector.step(state, start_us, events[:50])
        return pickle.loads(pickle.dumps(state))

    differs = difference(_detected(detector, events, branch), _detected(detector, events), name="regions")
    expect(differs is None, f"branches and pickling not to change what follows; {differs}")


FRAMING = (
    Law("clean", "no error in the events of an ideal sensor, every frame in its place", reads_clean),
    Law("any-split", "any split of the events gives the same frames", any_split),
    Law("state-kept", "a step leaves the state it is given, which can be pickled", state_kept),
    Law("bounded", "a state of bounded size, however long the stream is", bounded),
)
"""Laws of framing."""

DETECTION = (
    Law(
        "shapes",
        "regions of finite places and sizes, each of another id; one where a bar is, or a light",
        regions_shapes,
    ),
    Law("state-kept", "a step leaves the state it is given, which can be pickled", detection_state_kept),
)
"""Laws of detection."""
