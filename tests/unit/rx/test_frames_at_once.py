"""Frames told as soon as they are decoded: those of the packets, whatever pieces the stream comes in."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
from hypothesis import given, settings, strategies as st

from evlcp_sdk.files import shipped
from evlcp_sdk.io import read_events
from evlcp_sdk.link.resolve import Link, load_link, resolve
from evlcp_sdk.rx.detection import RegionFollower
from evlcp_sdk.rx.multi import EarlyFrames
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.rx.rhythm import Rhythm
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, merged, noise_events, random_symbols
from evlcp_sdk.values import Events, Frame, Packet, changed

LINK = load_link()
BAR = IdealBar(random_symbols(LINK, 3), ppm=50, shake_px=6, shake_hz=12)
OTHER = IdealBar(random_symbols(LINK, 3, seed=1), x_px=900.7, y_px=300.2, start_us=19_350)
BOTH = merged(ideal_events(LINK, BAR), ideal_events(LINK, OTHER), noise_events(120_000, 200_000))


def told(
    events: Events, cuts: list[int], link: Link | list[Link] = LINK
) -> tuple[list[tuple[Frame, int]], list[Packet]]:
    """Frames as they are told, each with how many events were fed by then; and the packets."""
    frames: list[tuple[Frame, int]] = []
    fed = 0
    receiver = Receiver(link, on_frame=lambda frame: frames.append((frame, fed)))
    packets: list[Packet] = []
    for begin, fed in pairwise([0, *cuts, len(events)]):
        packets += receiver.feed(events[begin:fed])
    return frames, packets + receiver.close()


def said(frame: Frame) -> tuple[object, ...]:
    """All of a frame, to the last bit."""
    soft = frame.soft
    return (
        *(frame.transmitter, frame.packet, frame.frame, frame.t_us, frame.x_px, frame.y_px, frame.link),
        *(soft.symbols.tobytes(), soft.llr.tobytes(), soft.quality, repr(frame.range), repr(frame.filtered)),
        *(frame.points_px.tobytes(), frame.points_sigma_px.tobytes(), frame.points_t_us, frame.echo_of),
    )


WHOLE = [said(frame) for frame, _ in told(BOTH, [])[0]]


def test_the_frames_that_are_told_are_those_of_the_packets() -> None:
    frames, packets = told(BOTH, [])
    assert len(frames) == 60
    in_packets = {said(frame) for packet in packets for frame in packet.frames}
    assert in_packets == {said(frame) for frame, _ in frames}
    assert len(in_packets) == 60


def test_a_transmitter_s_frames_are_told_in_order() -> None:
    frames, _ = told(BOTH, [])
    for number in (0, 1):
        numbers = [(f.packet, f.frame) for f, _ in frames if f.transmitter == number]
        assert numbers == sorted(numbers)
        assert len(set(numbers)) == 30


@settings(max_examples=5, deadline=None)
@given(st.lists(st.integers(0, len(BOTH)), max_size=30))
def test_any_split_tells_the_same_frames(cuts: list[int]) -> None:
    assert [said(frame) for frame, _ in told(BOTH, sorted(cuts))[0]] == WHOLE


def test_slices_tell_the_same_frames_as_soon_as_their_light_is_there() -> None:
    """A frame comes with the slice that holds the time at which its last events are there, and no later."""
    slice_us = 250
    cuts = np.searchsorted(BOTH.t_us, np.arange(0, int(BOTH.t_us[-1]), slice_us))
    frames, _ = told(BOTH, cuts.tolist())
    assert [said(frame) for frame, _ in frames] == WHOLE
    late_us = []
    for frame, fed in frames:
        last_us = frame.t_us + LINK.packet.frame_chips * LINK.packet.chip_us
        late_us.append(float(BOTH.t_us[fed - 1]) - last_us)
    # Those before the first lock have been there for long. Events are 20 to 30 us late; it waits half a chip.
    after = [late for late, (frame, _) in zip(late_us, frames, strict=True) if frame.packet > 0]
    assert len(after) >= 36
    assert min(after) > 0
    assert max(after) < 100 + slice_us


def test_frames_from_before_the_first_lock_come_a_few_a_step() -> None:
    """Each step gives one frame that ends in it and two older ones, until none is left."""
    bar = IdealBar(random_symbols(LINK, 2), start_us=-5_000)
    events = ideal_events(LINK, bar)
    cuts = np.searchsorted(events.t_us, np.arange(0, int(events.t_us[-1]), LINK.regions.step_us))
    frames, packets = told(events, cuts.tolist())
    a_slice = list(Counter(fed for _, fed in frames).values())
    assert a_slice[:3] == [3, 3, 3]
    # A slice may hold the end of one step and what is due in the next.
    assert max(a_slice[3:]) <= 2
    assert [f.frame for f, _ in frames] == [*range(1, 10), *range(10)]
    assert [said(frame) for frame, _ in frames] == [said(f) for packet in packets for f in packet.frames]


def test_a_part_of_a_step_leaves_no_trace_in_the_rhythm() -> None:
    one, two = (Rhythm(1280, 720, 100.0, 8) for _ in range(2))
    hits = np.zeros((2, 180, 320), np.int32)
    bounds = np.searchsorted(BOTH.t_us, np.arange(0, 60_000, 1500))
    for step, (a, b) in enumerate(pairwise(bounds.tolist())):
        events = BOTH[a:b]
        for part in (len(events) // 3, len(events) // 2):
            two.step(1500 * step, events[:part], hits[1], 2)
        assert one.step(1500 * step, events, hits[0], 2) == two.step(1500 * step, events, hits[1], 2)
        assert (hits[0] == hits[1]).all()
        hits[:] = 0
    assert (one._pixels == two._pixels).all()


def test_a_look_ahead_leaves_no_trace_in_the_regions() -> None:
    """Regions that are shown parts of each step go on as those that are not."""
    camera, spec = CameraModel(), LINK.regions
    one, two = (RegionFollower(spec, camera, LINK.packet.chip_us) for _ in range(2))
    bounds = np.searchsorted(BOTH.t_us, np.arange(0, 60_000, spec.step_us))
    ahead = 0
    for step, (a, b) in enumerate(pairwise(bounds.tolist())):
        start_us, events = step * spec.step_us, BOTH[a:b]
        for until_us in (start_us + 400, start_us + 1300):
            part = events[: np.searchsorted(events.t_us, until_us)]
            places = [len(region.positions) for region in two.alive]
            with two.ahead(start_us, until_us, part, {region.id for region in two.alive}):
                for region, before in zip(two.alive, places, strict=True):
                    # Soon after the start of a step its beginning says nothing new of the place.
                    ahead += (moved := len(region.positions) - before)
                    assert moved <= (until_us == start_us + 1300)
                    assert region.pieces[-1][0] == start_us
                    assert region.pieces[-1][1].t_us.max(initial=0) < until_us
        found = one.step(start_us, events), two.step(start_us, events)
        for mine, other in zip(*found, strict=True):
            assert [vars(p) for p in mine.positions] == [vars(p) for p in other.positions]
            assert mine.latest == other.latest
            assert mine.heights == other.heights
            assert mine.held_bytes == other.held_bytes
            assert [(t, e.t_us.tolist()) for t, e in mine.pieces] == [
                (t, e.t_us.tolist()) for t, e in other.pieces
            ]
    assert ahead > 40


def test_of_several_links_a_frame_comes_at_once_where_its_transmitter_holds_its_place() -> None:
    bar = replace(resolve({}), name="bar")
    wh8 = replace(resolve({"modulation": {"id": "wh8"}}), name="wh8")
    left = ideal_events(bar, IdealBar(random_symbols(bar, 7), 300.3))
    right = ideal_events(wh8, IdealBar(random_symbols(wh8, 7), 800.7), seed=1)
    events, slice_us = merged(left, right), 250
    cuts = np.searchsorted(events.t_us, np.arange(0, int(events.t_us[-1]), slice_us))
    frames, packets = told(events, cuts.tolist(), [bar, wh8])
    given = {said(frame) for packet in packets for frame in packet.frames}
    assert {frame.link for frame, _ in frames} == {"bar", "wh8"}
    assert {said(frame) for frame, _ in frames} == given
    assert len(frames) == len(given) == 140
    late_us: dict[int, float] = {}
    for frame, fed in frames:
        late = float(events.t_us[fed - 1]) - frame.t_us - LINK.packet.frame_chips * LINK.packet.chip_us
        late_us[frame.packet] = max(late, late_us.get(frame.packet, 0.0))
    numbers = {f.transmitter for f, _ in frames}
    assert len(numbers) == 2
    for number in numbers:
        order = [(f.packet, f.frame) for f, _ in frames if f.transmitter == number]
        assert order == sorted(order)
    # The first packets wait for their judgement, the last ones for nothing.
    assert late_us[0] > 60_000
    assert late_us[4] < 100 + slice_us
    assert late_us[5] < 100 + slice_us
    assert [said(frame) for frame, _ in told(events, [], [bar, wh8])[0]] == [said(f) for f, _ in frames]


def packet_of(number: int, frames: int) -> Packet:
    """A packet of transmitter 5."""
    one = told(BOTH, [])[1][0].frames[0]
    mine = tuple(changed(one, transmitter=5, packet=number, frame=n) for n in range(frames))
    return Packet(5, number, 0.0, 100.0, mine, frames)


def test_frames_that_another_link_takes_are_counted_where_they_were_told() -> None:
    heard: list[tuple[int, int]] = []
    early = EarlyFrames(lambda frame: heard.append((frame.packet, frame.frame)))
    one, two, three = (packet_of(number, 2) for number in range(3))
    for frame in (*one.frames, *two.frames):
        early.decoded(frame, owns=False)
    assert heard == []
    early.refused(one)
    early.decoded(three.frames[0], owns=False)
    early.given(two, owns=True)
    assert heard == [(1, 0), (1, 1), (2, 0)]
    early.decoded(three.frames[1], owns=True)
    assert heard == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert early.withdrawn == 0
    early.refused(three)
    assert (len(heard), early.withdrawn) == (4, 2)


def test_a_recording_s_frames_are_those_of_its_packets() -> None:
    events = read_events(shipped("recordings", "night-50m-30kmh-cut.raw"))
    cuts = np.searchsorted(events.t_us, np.arange(events.t_us[0] + 1000, events.t_us[-1], 1000))
    frames, packets = told(events, cuts.tolist())
    assert len(frames) >= 20
    assert [said(frame) for frame, _ in frames] == [said(f) for packet in packets for f in packet.frames]
    assert [said(frame) for frame, _ in frames] == [said(frame) for frame, _ in told(events, [])[0]]


def test_frames_without_a_pilot_are_told_at_once() -> None:
    link = load_link(overrides=["air.pilot_every=4"])
    events = ideal_events(link, IdealBar(random_symbols(link, 3)))
    cuts = np.searchsorted(events.t_us, np.arange(0, int(events.t_us[-1]), 250))
    frames, packets = told(events, cuts.tolist(), link)
    assert [said(frame) for frame, _ in frames] == [said(f) for packet in packets for f in packet.frames]
    assert len(frames) == 30
