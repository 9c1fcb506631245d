"""The whole receiver on ideal recordings: what it must decode, and the laws it keeps."""

import tracemalloc
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

from evlcp_sdk.errors import StreamError
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
from evlcp_sdk.testing.recordings import (
    IdealBar,
    ideal_events,
    lamp_events,
    merged,
    noise_events,
    random_symbols,
)
from evlcp_sdk.values import Events, Frame, Packet, PresenceMap

LINK = load_link()


def received(link: Link, events: Events, pieces: Iterator[slice] | None = None) -> list[Packet]:
    receiver = Receiver(link)
    packets: list[Packet] = []
    for piece in pieces or [slice(None)]:
        packets += receiver.feed(events[piece])
    return packets + receiver.close()


def rows(packets: list[Packet]) -> list[tuple[Any, ...]]:
    """Everything that the receiver says, to the last bit."""
    return [
        (
            *(f.transmitter, f.packet, f.frame, f.t_us, f.x_px, f.y_px, repr(f.range), p.t_us, p.chip_us),
            *(tuple(f.soft.symbols.tolist()), f.soft.llr.tobytes(), f.soft.quality),
        )
        for p in packets
        for f in p.frames
    ]


def check_symbols(packets: list[Packet], bar: IdealBar, link: Link, *, t0_us: int = 0) -> int:
    """Compare every frame with the sent one that began at its time; return how many."""
    chip_us = link.packet.chip_us / (1 + bar.ppm * 1e-6)
    frames = [f for p in packets for f in p.frames]
    starts = np.array([link.packet.frame_start_chip(index) for index in range(link.packet.frames)])
    for f in frames:
        chip = (f.t_us - t0_us - bar.start_us) / chip_us
        packet = int((chip - 13) // link.packet.packet_chips)
        index = int(np.abs(chip - packet * link.packet.packet_chips - starts).argmin())
        late_us = f.t_us - t0_us - bar.start_us
        late_us -= (packet * link.packet.packet_chips + starts[index]) * chip_us
        assert 0 < late_us < 60, "the first event of an edge comes 20 us late"
        assert f.soft.symbols.tolist() == bar.symbols[packet, index].tolist()
    return len(frames)


@pytest.mark.parametrize("profile", ["wh4x2", "wh8", "raw8"])
@pytest.mark.parametrize("ppm", [-100, 0, 100])
def test_every_profile_with_both_clocks_off(profile: str, ppm: float) -> None:
    link = load_link(overrides=[f"modulation.id={profile}"])
    bar = IdealBar(random_symbols(link, 5), ppm=ppm)
    packets = received(link, ideal_events(link, bar))
    assert check_symbols(packets, bar, link) == 50
    assert [p.packet for p in packets] == [0, 1, 2, 3, 4]
    # Two packets of 2 us jitter tell the rate to 40 ppm, five to 20.
    assert (link.packet.chip_us / packets[-1].chip_us - 1) * 1e6 == pytest.approx(ppm, abs=20)


@pytest.mark.parametrize("profile", ["wh4x2", "wh8", "raw8"])
@pytest.mark.parametrize(("frames", "every"), [(10, 4), (20, 4), (8, 64)])
def test_pilots_in_some_frames_only(profile: str, frames: int, every: int) -> None:
    air = [f"air.frames_per_packet={frames}", f"air.pilot_every={every}"]
    link = load_link(overrides=[f"modulation.id={profile}", *air])
    # It moves by a spacing while a pilot of eight frames holds.
    bar = IdealBar(random_symbols(link, 3), shake_px=16, shake_hz=10)
    packets = received(link, ideal_events(link, bar))
    assert check_symbols(packets, bar, link) == 3 * frames
    for f in (f for p in packets for f in p.frames):
        assert np.isnan(f.range.distance_m) == (f.frame % every != 0)


def test_frames_without_their_pilot_are_rejected() -> None:
    link = load_link(overrides=["air.pilot_every=4"])
    bar = IdealBar(random_symbols(link, 3), start_us=-8_300.0)
    # Frame 2 began before the recording, and so did the pilot of frame 3.
    packets = received(link, ideal_events(link, bar))
    assert [f.frame for f in packets[0].frames] == [4, 5, 6, 7, 8, 9]
    assert check_symbols(packets, bar, link) == 26


def test_a_pilot_in_the_dark_takes_its_frames_with_it() -> None:
    link = load_link(overrides=["air.pilot_every=4"])
    bar = IdealBar(random_symbols(link, 3))
    events = ideal_events(link, bar)
    begin_us = bar.start_us + 100 * (link.packet.packet_chips + link.packet.frame_start_chip(4))
    dark = (events.t_us >= begin_us) & (events.t_us < begin_us + 1600)
    receiver = Receiver(link)
    packets = receiver.feed(events[~dark]) + receiver.close()
    assert [f.frame for f in packets[1].frames] == [0, 1, 2, 3, 8, 9]
    assert check_symbols(packets, bar, link) == 26
    assert receiver.counts["frames_rejected"] == 4


def test_a_bar_out_of_sight_is_not_rejected() -> None:
    bar = IdealBar(random_symbols(LINK, 2))
    events = ideal_events(LINK, bar)
    begin_us, end_us = (
        bar.start_us + 100 * (LINK.packet.packet_chips + LINK.packet.frame_start_chip(f)) for f in (2, 9)
    )
    dark = (events.t_us >= begin_us) & (events.t_us < end_us)
    receiver = Receiver(LINK)
    packets = receiver.feed(events[~dark]) + receiver.close()
    assert [f.frame for f in packets[1].frames] == [0, 1, 9]
    assert (receiver.counts["frames_dark"], receiver.counts["frames_rejected"]) == (7, 0)


def test_a_bar_that_says_nothing_is_no_transmitter() -> None:
    """Preambles and pilots show its clusters; the info segments are dark."""
    bar = IdealBar(random_symbols(LINK, 2))
    events = ideal_events(LINK, bar)
    dark = np.zeros(len(events), bool)
    for packet in range(2):
        for frame in range(LINK.packet.frames):
            chip = packet * LINK.packet.packet_chips + LINK.packet.frame_start_chip(frame)
            # The last edge of the pilot belongs to it.
            begin_us = bar.start_us + 100 * (chip + LINK.packet.pilot_chips + 1)
            dark |= (events.t_us >= begin_us) & (events.t_us < begin_us + 100 * (LINK.packet.info_chips - 1))
    receiver = Receiver(LINK)
    assert receiver.feed(events[~dark]) + receiver.close() == []
    assert (receiver.counts["frames_unread"], receiver.counts["frames"]) == (20, 0)


def test_distance_is_that_of_the_spacing() -> None:
    bar = IdealBar(random_symbols(LINK, 3), cluster_px=9.0)
    ranges = [f.range for p in received(LINK, ideal_events(LINK, bar)) for f in p.frames]
    want = LINK.camera.focal_px * 0.06 / 9.0
    # Whole pixels, still bar: every cluster's map is the same, so the shift is exact.
    assert_allclose([r.distance_m for r in ranges], want, rtol=2e-3)
    assert all(r.sigma_m < 0.005 * want for r in ranges)


def test_frames_before_the_first_preamble_are_decoded() -> None:
    bar = IdealBar(random_symbols(LINK, 3), start_us=-15_000.0)
    packets = received(LINK, ideal_events(LINK, bar))
    # Of the packet that began before the recording, the frames from chip 154 = 26 + 4 * 32 on.
    assert [f.frame for f in packets[0].frames] == [4, 5, 6, 7, 8, 9]
    assert check_symbols(packets, bar, LINK) == 26


def test_a_frame_that_the_end_cuts_is_not_given() -> None:
    """Its last events come late, 20 to 70 us after their edges: the stream must go on for 2.5 chips more.

    One that is decoded before the stream ends there is counted.
    """
    bar = IdealBar(random_symbols(LINK, 2))
    events = ideal_events(LINK, bar)
    start = LINK.packet.packet_chips + LINK.packet.frame_start_chip(5)
    end_us = bar.start_us + 100 * start
    for after_us, found, cut in ((-50, 4, 0), (60, 4, 0), (220, 4, 1), (290, 5, 0), (1000, 5, 0)):
        receiver = Receiver(LINK)
        packets = receiver.feed(events[events.t_us < end_us + after_us]) + receiver.close()
        assert [f.frame for f in packets[1].frames] == list(range(found)), after_us
        assert check_symbols(packets, bar, LINK) == receiver.counts["frames"] == 10 + found
        assert receiver.counts["frames_at_end"] == cut, after_us


def test_the_centre_is_followed() -> None:
    # 16 px at 15 Hz: up to 1.5 px/ms.
    bar = IdealBar(random_symbols(LINK, 4), shake_px=16, shake_hz=15)
    packets = received(LINK, ideal_events(LINK, bar))
    assert check_symbols(packets, bar, LINK) == 40
    for f in (f for p in packets for f in p.frames):
        x, y = bar.centre(np.array([f.t_us + 850]))
        assert f.x_px == pytest.approx(x[0] - 0.5, abs=1.0)
        assert f.y_px == pytest.approx(y[0] - 0.5, abs=1.5)


def test_two_bars_and_lamps() -> None:
    one = IdealBar(random_symbols(LINK, 4, 1), ppm=40)
    two = IdealBar(random_symbols(LINK, 4, 2), x_px=900, y_px=250, cluster_px=5, ppm=-25, start_us=11_234)
    lamps = [
        lamp_events(600, 300, 12, hz, 150_000, duty=duty)
        for hz, duty in ((100, 0.5), (1000, 0.2), (2000, 0.5))
    ]
    events = merged(ideal_events(LINK, one), ideal_events(LINK, two), *lamps, noise_events(50_000, 150_000))
    packets = received(LINK, events)
    by_number = [[p for p in packets if p.frames[0].transmitter == n] for n in (0, 1)]
    assert check_symbols(by_number[0], one, LINK) == 40
    assert check_symbols(by_number[1], two, LINK) == 40
    assert len(packets) == 8


@pytest.mark.parametrize("hz", [100, 120, 400, 1000, 2000])
@pytest.mark.parametrize("duty", [0.1, 0.5])
def test_a_lamp_is_no_transmitter(hz: float, duty: float) -> None:
    receiver = Receiver(LINK)
    assert (
        receiver.feed(
            merged(lamp_events(500, 300, 15, hz, 120_000, duty=duty), noise_events(200_000, 120_000))
        )
        == []
    )
    assert receiver.close() == []
    assert receiver.counts["regions_opened"] == 0


def test_random_blinking_at_the_chip_rate_is_no_transmitter() -> None:
    rng = np.random.default_rng(5)
    chips = np.repeat(rng.integers(0, 2, (1500, 1)), 64 * 4, axis=1)
    edges = np.diff(chips, axis=0, prepend=0)
    when, pixel = np.nonzero(edges)
    t = when * 100 + rng.integers(20, 60, len(when))
    first = np.argsort(t, kind="stable")
    columns = t, 300 + pixel % 4, 200 + pixel // 4, edges[when, pixel] > 0
    assert received(LINK, Events.of(*(c[first] for c in columns))) == []


def test_a_dark_cluster_costs_only_itself() -> None:
    bar = IdealBar(random_symbols(LINK, 2))
    events = ideal_events(LINK, bar)
    top = 350.7 - 64 + 5 * 8
    lit = (events.y < np.floor(top)) | (events.y > np.ceil(top + 8))
    frames = [f for p in received(LINK, events[lit]) for f in p.frames]
    assert len(frames) == 20
    for f, want in zip(frames, bar.symbols.reshape(-1, 16), strict=True):
        assert np.delete(f.soft.symbols, 5).tolist() == np.delete(want, 5).tolist()
        assert f.range.distance_m == pytest.approx(LINK.camera.focal_px * 0.06 / 8, rel=5e-3)


def test_a_bar_lost_from_sight_goes_on_as_the_same() -> None:
    bar = IdealBar(random_symbols(LINK, 6), ppm=30)
    events = ideal_events(LINK, bar)
    hidden = (events.t_us >= 80_000) & (events.t_us < 150_000)
    moved = Events.of(events.t_us, events.x + np.where(events.t_us < 150_000, 0, 70), events.y, events.p)
    packets = received(LINK, moved[~hidden])
    assert {f.transmitter for p in packets for f in p.frames} == {0}
    numbers = [p.packet for p in packets]
    assert numbers == sorted(set(numbers))
    assert numbers[0] == 0
    assert numbers[-1] == 5
    # Packets 0 and 1, one frame of 2 that ends as the bar vanishes, 8 of packet 4, and packet 5.
    assert check_symbols(packets, bar, LINK) == 20 + 1 + 8 + 10


def test_a_transmitter_that_starts_anew_is_followed() -> None:
    before, after = (
        IdealBar(random_symbols(LINK, 3, 1)),
        IdealBar(random_symbols(LINK, 5, 2), start_us=127_777),
    )
    events = merged(ideal_events(LINK, before), ideal_events(LINK, after))
    packets = received(LINK, events)
    # One preamble off the old grid may be chance; the second one is believed.
    late = [p for p in packets if p.t_us > after.start_us + 30_000]
    assert check_symbols(late, after, LINK) == 40
    numbers = [p.packet for p in packets]
    assert numbers == sorted(set(numbers)), "no packet number twice"


STREAM = merged(
    ideal_events(LINK, IdealBar(random_symbols(LINK, 3, 3), shake_px=5, ppm=35), seed=3),
    ideal_events(LINK, IdealBar(random_symbols(LINK, 3, 4), x_px=800, start_us=9000, cluster_px=5), seed=4),
    noise_events(30_000, 130_000),
)
WHOLE = rows(received(LINK, STREAM))


@settings(max_examples=12)
@given(st.lists(st.integers(0, len(STREAM)), max_size=40))
def test_any_split_gives_the_same(cuts: list[int]) -> None:
    bounds = sorted({0, len(STREAM), *cuts})
    assert rows(received(LINK, STREAM, (slice(a, b) for a, b in pairwise(bounds)))) == WHOLE


def test_any_split_gives_the_same_with_few_pilots() -> None:
    link = load_link(overrides=["air.pilot_every=4"])
    events = ideal_events(link, IdealBar(random_symbols(link, 3), shake_px=5))
    whole = rows(received(link, events))
    assert len(whole) == 30
    cuts = np.random.default_rng(0).integers(0, len(events), 60)
    bounds = sorted({0, len(events), *cuts.tolist()})
    assert rows(received(link, events, (slice(a, b) for a, b in pairwise(bounds)))) == whole


@pytest.mark.parametrize("later", [0, 4, 11])
def test_any_split_gives_the_same_where_two_regions_grow_together(later: int) -> None:
    still = ideal_events(LINK, IdealBar(random_symbols(LINK, 3, 1)))
    other = ideal_events(LINK, IdealBar(random_symbols(LINK, 3, 2), x_px=440, start_us=8000 + 500 * later))
    nearer = np.minimum(other.t_us // 1500, 40)
    events = merged(still, Events.of(other.t_us, other.x - nearer, other.y, other.p))
    whole = Receiver(LINK)
    packets = whole.feed(events) + whole.close()
    assert whole.counts["regions_opened"] == 2
    assert whole.counts["regions_released"] >= 1
    assert rows(received(LINK, events, (slice(a, a + 60) for a in range(0, len(events), 60)))) == rows(
        packets
    )


@pytest.mark.parametrize("size", [1000, 4096, 65_536])
def test_even_pieces_give_the_same(size: int) -> None:
    pieces = (slice(a, a + size) for a in range(0, len(STREAM), size))
    assert rows(received(LINK, STREAM, pieces)) == WHOLE
    assert len(WHOLE) == 60


def turned(
    attitude: Attitude | AttitudeLog | None, size: int | None = None, link: Link = LINK
) -> tuple[list[Frame], dict[str, int]]:
    """Frames of the stream by a camera that is turned so, in pieces of a size, and the receiver's counts."""
    receiver, size = Receiver(link, attitude=attitude), size or len(STREAM)
    packets = [p for a in range(0, len(STREAM), size) for p in receiver.feed(STREAM[a : a + size])]
    return [f for p in packets + receiver.close() for f in p.frames], receiver.counts


def test_an_attitude_makes_distances_shorter_by_what_the_bar_leans() -> None:
    # These images have no bend, which `joint-scale` would see.
    poc = load_link(overrides=["ranging.id=poc"])
    pitched, counts = turned(Attitude(6.0, 0.0), link=poc)
    level, _ = turned(Attitude(0.0, 0.0), link=poc)
    assert counts["frames_askew"] == 0
    assert len(pitched) == len(level) == 60
    for a, b in zip(pitched, level, strict=True):
        # A pinhole's, of a bar that is seen some rows below the middle of the image.
        below = (a.y_px - LINK.camera.height / 2) / LINK.camera.focal_px
        length = np.cos(np.radians(6)) + below * np.sin(np.radians(6))
        assert a.range.distance_m / b.range.distance_m == pytest.approx(length, abs=1e-4)
        assert a.range.sigma_m > b.range.sigma_m


def test_an_attitude_that_the_image_contradicts_counts_as_none() -> None:
    rolled, counts = turned(Attitude(6.0, 5.0))
    assert counts["frames_askew"] == len(rolled)
    assert [f.range for f in rolled] == [f.range for f in turned(None)[0]]


def test_any_split_gives_the_same_with_an_attitude_that_changes() -> None:
    """A log that ends in the middle of the stream."""
    t_us = np.linspace(0, 50_000, 50)
    pitch_deg = 3 * np.sin(t_us / 15_000)
    log = AttitudeLog(t_us, pitch_deg, 0 * t_us, None, np.full(50, 0.2), np.full(50, 0.5))
    whole = [(f.t_us, f.range) for f in turned(log)[0]]
    for size in (700, 9000):
        assert [(f.t_us, f.range) for f in turned(log, size)[0]] == whole
    assert sum(t > 50_000 for t, _ in whole) > 20
    assert [r for _, r in whole] != [f.range for f in turned(None)[0]]


def test_the_clock_may_begin_anywhere() -> None:
    later = Events.of(STREAM.t_us + 16_777_000, STREAM.x, STREAM.y, STREAM.p)
    shifted = rows(received(LINK, later))
    assert [r[9] for r in shifted] == [r[9] for r in WHOLE]
    assert_allclose([r[3] - 16_777_000 for r in shifted], [r[3] for r in WHOLE], atol=10)


def test_what_is_dropped_is_counted() -> None:
    receiver = Receiver(LINK)
    receiver.feed(Events.of([10, 20, 15, 30], [1, 1280, 1, 1], [1, 1, 1, 720], [0, 1, 0, 1]))
    receiver.feed(Events.of([9, 40], [1, 1], [1, 1], [0, 1]))
    assert receiver.counts["events"] == 6
    assert receiver.counts["dropped_off_sensor"] == 2
    assert receiver.counts["dropped_time_backward"] == 1
    receiver.close()
    with pytest.raises(StreamError, match="closed"):
        receiver.feed(Events.empty())


def test_a_long_gap_costs_nothing() -> None:
    bar = IdealBar(random_symbols(LINK, 2))
    first = ideal_events(LINK, bar)
    hour = 3_600_000_000
    packets = received(LINK, Events.concat([first, ideal_events(LINK, bar, t0_us=hour)]))
    assert [f.transmitter for p in packets for f in p.frames] == [0] * 20 + [1] * 20
    assert check_symbols(packets[2:], bar, LINK, t0_us=hour) == 20


def test_a_leap_of_a_month_in_one_piece_takes_no_memory() -> None:
    bar = IdealBar(random_symbols(LINK, 2))
    one = ideal_events(LINK, bar)
    month = 30 * 86_400_000_000
    whole = Events.concat([one, ideal_events(LINK, bar, t0_us=month)])
    tracemalloc.start()
    packets = received(LINK, whole)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert check_symbols(packets[2:], bar, LINK, t0_us=month) == 20
    assert peak < 100e6


@pytest.mark.parametrize("back_us", [100_000, 3_000_000, 10**15])
def test_a_camera_that_restarts_its_clock_is_heard_again(back_us: int) -> None:
    bar = IdealBar(random_symbols(LINK, 2))
    late_us = 10**12
    receiver = Receiver(LINK)
    packets = receiver.feed(ideal_events(LINK, bar, t0_us=late_us))
    packets += receiver.feed(ideal_events(LINK, bar, t0_us=late_us - back_us)) + receiver.close()
    assert receiver.counts["clock_restarts"] == 1
    assert receiver.counts["dropped_time_backward"] == receiver.counts["dropped_time_doubtful"] == 0
    assert [f.transmitter for p in packets for f in p.frames] == [0] * 20 + [1] * 20
    assert check_symbols(packets[:2], bar, LINK, t0_us=late_us) == 20
    assert check_symbols(packets[2:], bar, LINK, t0_us=late_us - back_us) == 20


@pytest.mark.parametrize("t0_us", [-123_457, 16_777_001, 1_700_000_000_123_457])
def test_a_frame_says_the_same_at_any_time_of_the_clock(t0_us: int) -> None:
    later = received(LINK, Events(STREAM.t_us + t0_us, STREAM.x, STREAM.y, STREAM.p))
    for one, other in zip(received(LINK, STREAM), later, strict=True):
        assert abs(other.t_us - t0_us - one.t_us) <= 0.25
        for a, b in zip(one.frames, other.frames, strict=True):
            assert (a.transmitter, a.range, a.filtered, a.x_px) == (
                b.transmitter,
                b.range,
                b.filtered,
                b.x_px,
            )
            assert_allclose(b.points_px, a.points_px, rtol=0)
            assert abs(b.t_us - t0_us - a.t_us) <= 0.25
            assert abs(b.points_t_us - t0_us - a.points_t_us) <= 0.25


def test_memory_does_not_grow() -> None:
    receiver = Receiver(LINK)
    bar = IdealBar(random_symbols(LINK, 2), cluster_px=4, width_px=2)
    period = 2 * LINK.packet.packet_chips * 100
    for n in range(12):
        receiver.feed(ideal_events(LINK, bar, t0_us=n * period))
    (region,) = receiver._receivers[0]._regions.alive
    assert len(region.pieces) < 10
    assert len(region.positions) < 50


def test_probes_see_every_stage() -> None:
    class Probe:
        def __init__(self) -> None:
            self.seen: dict[str, int] = {}

        @hookimpl
        def evlcp_stage_finished(self, stage: str, value: object, elapsed_s: float) -> None:
            assert value is not None
            assert elapsed_s >= 0
            self.seen[stage] = self.seen.get(stage, 0) + 1

    probe = Probe()
    receiver = Receiver(LINK, Registry.load(probe).hook)
    receiver.feed(ideal_events(LINK, IdealBar(random_symbols(LINK, 2))))
    receiver.close()
    assert probe.seen["frame"] == probe.seen["ranging"] == probe.seen["decoding"] == probe.seen["view"] == 20
    assert probe.seen["synchronization"] == 2
    assert probe.seen["separation"] >= 20
    assert probe.seen["regions"] >= 40


@pytest.mark.parametrize("width_px", [1, 2, 3, 4, 5, 6])
def test_a_thin_bar_stands_in_the_middle_of_a_cell(width_px: int) -> None:
    seen: list[PresenceMap] = []

    class Probe:
        @hookimpl
        def evlcp_stage_finished(self, stage: str, value: object, elapsed_s: float) -> None:
            if isinstance(value, PresenceMap):
                seen.append(value)

    receiver = Receiver(LINK, Registry.load(Probe()).hook)
    receiver.feed(ideal_events(LINK, IdealBar(random_symbols(LINK, 2), width_px=width_px, x_px=400.0)))
    receiver.close()
    assert len(seen) >= 20
    for presence in seen:
        columns = presence.selected.shape[2]
        # As many cells on its left as on its right.
        assert columns % 2 == 1
        if width_px <= 2:
            assert presence.selected.any((0, 1)).sum() <= 3


def test_other_codes_work() -> None:
    link = load_link(overrides=["pilots.id=barker13", "bar.rows=78", "air.frames_per_packet=4"])
    assert link.packet.frame_chips == 26 + 16
    bar = IdealBar(random_symbols(link, 4))
    packets = received(link, ideal_events(link, bar))
    got = [f.soft.symbols.tolist() for p in packets for f in p.frames]
    assert got == bar.symbols.reshape(-1, 13).tolist()


def test_another_chip_rate_works() -> None:
    link = load_link(overrides=["air.chip_rate_hz=5000"])
    bar = IdealBar(random_symbols(link, 3))
    assert check_symbols(received(link, ideal_events(link, bar)), bar, link) == 30


def test_a_bar_in_pieces_too_small_to_place_is_put_together() -> None:
    """Three pieces of four clusters: each hears the preamble, and none shows so many that they are sure."""
    symbols = random_symbols(LINK, 2, seed=3)
    bar = IdealBar(symbols, start_us=0, cluster_px=12)
    events = ideal_events(LINK, bar)
    cluster = (events.y - (bar.y_px - 8 * 12)) // 12
    events = events[~np.isin(cluster, [4, 5, 10, 11])]
    receiver = Receiver(LINK)
    packets = receiver.feed(events) + receiver.close()
    frames = [frame for packet in packets for frame in packet.frames]
    assert {frame.transmitter for frame in frames} == {0}
    seen = np.delete(np.arange(16), [4, 5, 10, 11])
    sent = symbols.reshape(-1, 16)
    assert len(frames) >= len(sent) - 1
    for frame in frames:
        assert any(frame.soft.symbols[seen].tolist() == row[seen].tolist() for row in sent)
        assert (frame.soft.symbols[[4, 5, 10, 11]] == -1).all()


@pytest.mark.parametrize("apart_px", [10, 14])
def test_two_bars_a_few_pixels_apart_are_two(apart_px: int) -> None:
    """Each with a clock and a payload of its own."""
    one = IdealBar(random_symbols(LINK, 3, seed=1), start_us=0)
    two = IdealBar(random_symbols(LINK, 3, seed=2), start_us=12_345, x_px=one.x_px + apart_px, ppm=40)
    receiver = Receiver(LINK)
    packets = receiver.feed(merged(ideal_events(LINK, one), ideal_events(LINK, two))) + receiver.close()
    by_bar = {packet.transmitter: [] for packet in packets}
    for packet in packets:
        by_bar[packet.transmitter] += packet.frames
    places = sorted((frames[0].x_px, len(frames)) for frames in by_bar.values())
    assert [x for x, _ in places] == pytest.approx([one.x_px - 0.5, two.x_px - 0.5], abs=1)
    assert min(n for _, n in places) >= 28
