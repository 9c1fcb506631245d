"""The whole receiver on ideal recordings: what it must decode, and what it leaves alone."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from rx_streams import LINK, frame_content, frames_of, lit, noise_events, receive_cut, right_frames

from evlcp_sdk.errors import StreamError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.rx.framing import SkippedFrame
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.rx.regions import BarPlace
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, merge_events, random_symbols
from evlcp_sdk.values import Events, PresenceMap, replace_fields


@pytest.mark.parametrize(
    ("sets", "ppm"),
    [
        ("", -100),
        ("", 100),
        ("modulation.id=wh8", -100),
        ("modulation.id=raw8", 100),
        ("pilots.id=barker13 bar.rows=78 air.frames_per_packet=4", 0),
        ("air.chip_rate_hz=5000", 0),
        ("air.pilot_every=4", 0),
        ("air.pilot_every=64 air.frames_per_packet=8", 0),
        ("air.pilot_every=64 air.frames_per_packet=8 modulation.id=wh8", 0),
        ("air.pilot_every=4 air.frames_per_packet=20 modulation.id=raw8", 0),
    ],
)
def test_every_link_is_read_to_the_last_frame(sets, ppm):
    link = load_link(overrides=sets.split())
    every = link.packet.pilot_every
    # Where pilots are few it moves by a spacing while one of eight frames holds.
    bar, events = lit(5, link=link, ppm=ppm, shake_px=16 if every > 1 else 0)
    _, packets = receive_cut(link, events)
    assert right_frames(packets, bar, link) == 5 * link.packet.frames
    assert [p.packet for p in packets] == [0, 1, 2, 3, 4]
    # Two packets of 2 us jitter tell the rate to 40 ppm, five to 20.
    assert (link.packet.chip_us / packets[-1].chip_us - 1) * 1e6 == pytest.approx(ppm, abs=20)
    for f in frames_of(packets):
        assert np.isnan(f.range.distance_m) == (f.frame % every != 0)


@pytest.mark.parametrize(("every", "start_us", "first"), [(1, -15_000.0, 4), (4, -8_300.0, 4)])
def test_frames_before_the_first_preamble_are_decoded(every, start_us, first):
    """Those that began in the recording, and of few pilots those whose pilot did."""
    link = load_link(overrides=[f"air.pilot_every={every}"])
    bar, events = lit(3, link=link, start_us=start_us)
    _, packets = receive_cut(link, events)
    assert [f.frame for f in packets[0].frames] == list(range(first, 10))
    assert right_frames(packets, bar, link) == 30 - first


def between(events, bar, first, end):
    """Events from one chip after the start of a bar to another."""
    start_us = bar.start_us + 100 * first
    return (events.t_us >= start_us) & (events.t_us < start_us + 100 * (end - first))


def frame_chip(link, packet, frame):
    return packet * link.packet.packet_chips + link.packet.frame_start_chip(frame)


@pytest.mark.parametrize(
    ("every", "first", "end", "given_", "count"),
    [
        # The pilot of frames 4 to 7 alone.
        (4, (4, 0), (4, 16), [0, 1, 2, 3, 8, 9], {"frames_rejected": 4, "frames_dark": 0}),
        (1, (2, 0), (9, 0), [0, 1, 9], {"frames_rejected": 0, "frames_dark": 7}),
    ],
)
def test_a_bar_in_the_dark(every, first, end, given_, count):
    """A dark pilot takes its frames with it; a bar out of sight is not rejected; each says why."""
    link = load_link(overrides=[f"air.pilot_every={every}"])
    bar, events = lit(3, link=link)
    chips = [frame_chip(link, 1, frame) + more for frame, more in (first, end)]
    probe = Probe(list)
    seen = events[~between(events, bar, *chips)]
    receiver, packets = receive_cut(link, seen, hook=Registry.load(probe).hook)
    assert [f.frame for f in packets[1].frames] == given_
    why = next(name for name, many in count.items() if many)
    missing = [n for n in range(10) if n not in given_]
    skipped = [one for one in probe["skipped"] if isinstance(one, SkippedFrame)]
    where = [(one.transmitter, one.packet, one.frame, one.why) for one in skipped]
    assert where == [(0, 1, n, why) for n in missing]
    starts_us = [bar.start_us + 100 * frame_chip(link, 1, n) for n in missing]
    # To a quarter of a chip.
    assert [one.t_us for one in skipped] == pytest.approx(starts_us, abs=25)
    assert right_frames(packets, bar, link) == 20 + len(given_)
    assert {name: receiver.counts[name] for name in count} == count


def flashes(start_us, seed=7):
    """Light that rises twentyfold in 2 ms about the bar: every pixel fires every 200 us."""
    rng = np.random.default_rng(seed)
    x, y = (v.ravel() for v in np.meshgrid(np.arange(350, 450), np.arange(270, 430)))
    t = start_us + (200 * (np.arange(10) + rng.random((x.size, 10)))).astype(np.int64)
    return merge_events(Events.of(t.ravel(), np.repeat(x, 10), np.repeat(y, 10), np.ones(t.size)))


@pytest.mark.parametrize(
    ("drowned", "start_us", "which"),
    [(True, 5000.0, (1, 4)), (False, 5000.0, (1, 4)), (True, -15_000.0, (0, 8))],
)
def test_a_step_of_light_costs_the_frame_that_it_drowns(drowned, start_us, which):
    """The bar has been where its trail lights up, too, and is not dragged back; nor before the first lock."""
    bar, events = lit(4, shake_px=16, start_us=start_us)
    first_us = int(bar.start_us) + 100 * (frame_chip(LINK, *which) + LINK.packet.pilot_chips)
    lost = drowned & (events.t_us > first_us + 200) & (events.t_us < first_us + 1400)
    receiver, packets = receive_cut(LINK, merge_events(events[~lost], flashes(first_us)))
    frames = frames_of(packets)
    assert len(frames) == sum(start_us + 100 * frame_chip(LINK, *divmod(n, 10)) >= 0 for n in range(40))
    for f in frames:
        flooded = drowned and (f.packet, f.frame) == which
        assert (f.soft.symbols == (-1 if flooded else bar.symbols[f.packet, f.frame])).all()
        x, _ = bar.centre(np.array([f.t_us + 850]))
        assert f.x_px == pytest.approx(x[0] - 0.5, abs=1.0)
    assert receiver.counts["frames_flooded"] == int(drowned)


@pytest.mark.parametrize("sooner_us", [30, 60])
def test_events_that_come_sooner_in_brighter_light(sooner_us):
    """From a frame on, well before the next preamble, and half as many."""
    bar = IdealBar(random_symbols(LINK, 3))
    e = ideal_events(LINK, bar, delay_on_us=70.0, delay_off_us=70.0)
    bright = e.t_us >= bar.start_us + 100 * frame_chip(LINK, 1, 3) + 60
    moved = merge_events(Events.of(e.t_us - sooner_us * bright, e.x, e.y, e.p)[~bright | (e.x % 2 == 0)])
    assert right_frames(receive_cut(LINK, moved)[1], bar, late_us=(0, 90)) == 30


def test_a_bar_in_an_image_that_is_one_region():
    link = load_link(overrides=["detection.id=whole", "camera.width=100", "camera.height=200"])
    bar, events = lit(2, link=link, x_px=50.3, y_px=100.7)
    assert right_frames(receive_cut(link, events)[1], bar, link) == 20


def test_a_bar_that_says_nothing_is_no_transmitter():
    """Preambles and pilots show its clusters; the info segments are dark."""
    (bar, events), packet = lit(2), LINK.packet
    dark = np.zeros(len(events), bool)
    for number in range(20):
        # The last edge of the pilot belongs to it.
        chip = frame_chip(LINK, *divmod(number, 10)) + packet.pilot_chips
        dark |= between(events, bar, chip + 1, chip + packet.info_chips)
    receiver, packets = receive_cut(LINK, events[~dark])
    assert packets == []
    assert (receiver.counts["frames_unread"], receiver.counts["frames"]) == (20, 0)


def test_a_frame_that_the_end_cuts_is_not_given():
    """Its last events come late, 20 to 70 us after their edges: the stream must go on for 2.5 chips more.

    One that is decoded before the stream ends there is counted.
    """
    bar, events = lit(2)
    end_us = bar.start_us + 100 * frame_chip(LINK, 1, 5)
    for after_us, found, cut in ((-50, 4, 0), (60, 4, 0), (220, 4, 1), (290, 5, 0), (1000, 5, 0)):
        receiver, packets = receive_cut(LINK, events[events.t_us < end_us + after_us])
        assert [f.frame for f in packets[1].frames] == list(range(found)), after_us
        assert right_frames(packets, bar) == receiver.counts["frames"] == 10 + found
        assert receiver.counts["frames_at_end"] == cut, after_us


@pytest.mark.parametrize(("shake_px", "shake_hz"), [(16, 15), (60, 15), (250, 5)])
def test_a_bar_that_sweeps_from_the_first_frame_on(shake_px, shake_hz):
    """Round in a circle at 1.5, 5.7 and 7.9 px/ms: in any direction, along the bar and across it."""
    bar, events = lit(4, shake_px=shake_px, shake_hz=shake_hz)
    receiver, packets = receive_cut(LINK, events)
    assert right_frames(packets, bar) == 40
    assert receiver.counts["regions_opened"] == 1
    for f in frames_of(packets):
        x, y = bar.centre(np.array([f.t_us + 850]))
        assert (f.x_px, f.y_px) == (pytest.approx(x[0] - 0.5, abs=1.0), pytest.approx(y[0] - 0.5, abs=1.5))


@pytest.mark.parametrize("apart_px", [10, 14])
def test_two_bars_a_few_pixels_apart_are_two(apart_px):
    """Each with a clock and a payload of its own."""
    bars, events = zip(
        lit(3, 1, start_us=0), lit(3, 2, start_us=12_345, x_px=400.3 + apart_px, ppm=40), strict=True
    )
    _, packets = receive_cut(LINK, merge_events(*events))
    for bar in bars:
        mine = [p for p in packets if abs(p.frames[0].x_px - bar.x_px + 0.5) < 1]
        assert len({p.transmitter for p in mine}) == 1
        assert len(frames_of(mine)) >= 28


def test_an_image_of_a_bar_opens_no_further_ones_in_its_step():
    receiver = Receiver(LINK)
    receiver.feed(lit(2)[1][:40_000])
    framer = receiver._receivers[0].framing
    (region,), latest = framer._regions.alive, framer._regions.alive[0].latest
    others = [((latest.x_px + 100 * n, latest.y_px), (4.0, 128.0)) for n in (1, 2)]
    framer._open_other_images(region, BarPlace(latest.t_us, *others[0], others=(others[0],)))
    shown = BarPlace(latest.t_us, *others[1], others=(others[1],))
    for count in (2, 3):
        framer._open_other_images(framer._regions.alive[1], shown)
        assert len(framer._regions.alive) == count
        framer.apply_pending(round(latest.t_us) + 1500)


def test_a_dark_cluster_costs_only_itself():
    """And the distance is that of the spacing."""
    bar, events = lit(2, cluster_px=9.0)
    top = 350.7 - 72 + 5 * 9
    shown = (events.y < np.floor(top)) | (events.y > np.ceil(top + 9))
    for kept, px, rel in ((shown, 5, 5e-3), (shown | True, [], 2e-3)):
        frames = frames_of(receive_cut(LINK, events[kept])[1])
        assert len(frames) == 20
        for f, want in zip(frames, bar.symbols.reshape(-1, 16), strict=True):
            assert np.delete(f.soft.symbols, px).tolist() == np.delete(want, px).tolist()
            true_m = LINK.camera.focal_px * 0.06 / 9
            assert f.range.distance_m == pytest.approx(true_m, rel=rel)
            assert f.range.sigma_m < 0.005 * true_m


def test_a_bar_in_pieces_too_small_to_place_is_put_together():
    """Three pieces of four clusters: each hears the preamble, and none shows so many that they are sure."""
    hidden = [4, 5, 10, 11]
    bar, events = lit(2, 3, start_us=0, cluster_px=12)
    cluster = (events.y - (bar.y_px - 8 * 12)) // 12
    frames = frames_of(receive_cut(LINK, events[~np.isin(cluster, hidden)])[1])
    sent = bar.symbols.reshape(-1, 16).copy()
    sent[:, hidden] = -1
    assert {frame.transmitter for frame in frames} == {0}
    assert len(frames) >= len(sent) - 1
    assert all(frame.soft.symbols.tolist() in sent.tolist() for frame in frames)


def test_a_bar_lost_from_sight_goes_on_as_the_same():
    bar, events = lit(6, ppm=30)
    hidden = (events.t_us >= 80_000) & (events.t_us < 150_000)
    moved = Events.of(events.t_us, events.x + np.where(events.t_us < 150_000, 0, 70), events.y, events.p)
    _, packets = receive_cut(LINK, moved[~hidden])
    assert {p.transmitter for p in packets} == {0}
    # Packets 0 and 1, one frame of 2 that ends as the bar vanishes, 8 of packet 4, and packet 5.
    assert [(p.packet, len(p.frames)) for p in packets] == [(0, 10), (1, 10), (2, 1), (4, 8), (5, 10)]
    assert right_frames(packets, bar) == 39


@pytest.mark.parametrize("at_us", [61_810, 74_000, 88_500, 101_000])
def test_a_transmitter_that_starts_anew_is_another(at_us):
    """In the middle of a packet, with another clock, and again: read from its first whole frame on.

    Also where its frames stand on the old grid for a part of each packet; or from the second, where one that
    was cut short is given until then.
    """
    starts = (5000, -60), (at_us - 13_210, 80), (at_us + 90_000, 0)
    bars, sent = zip(*(lit(6, k, start_us=us, ppm=ppm) for k, (us, ppm) in enumerate(starts)), strict=True)
    begins = 0, at_us, at_us + 100_000, 300_000
    events = merge_events(*(e[slice(*e.t_us.searchsorted(begins[k : k + 2]))] for k, e in enumerate(sent)))
    # The camera is said to lean, which every frame that is read contradicts.
    receiver, packets = receive_cut(LINK, events, attitude=Attitude(6.0, 5.0))
    assert receiver.counts["restarts"] == 2
    assert receiver.counts["frames_rejected"] == 0
    assert receiver.counts["frames_askew"] == receiver.counts["frames"] + receiver.counts["frames_unread"]
    for number, bar in enumerate(bars):
        chip_us = 100 / (1 + bar.ppm * 1e-6)
        starts = bar.start_us + chip_us * np.add.outer(346 * np.arange(6), 26 + 32 * np.arange(10)).ravel()
        whole = (starts >= begins[number]) & (starts + 32 * chip_us < begins[number + 1])
        mine = [p for p in packets if p.transmitter == number]
        frames = [f for f in frames_of(mine) if f.t_us + 3200 < begins[number + 1]]
        assert np.count_nonzero(whole) - 1 <= len(frames) <= np.count_nonzero(whole)
        assert right_frames([replace(p, frames=tuple(f for f in p.frames if f in frames)) for p in mine], bar)
        assert [p.packet for p in mine] == list(range(len(mine)))


STREAM = merge_events(
    lit(3, 3, shake_px=5, ppm=35)[1],
    lit(3, 4, x_px=800, start_us=9000, cluster_px=5)[1],
    noise_events(30_000, 130_000),
)


@pytest.mark.parametrize("t0_us", [-123_457, 16_777_001, 1_700_000_000_123_457])
def test_a_frame_says_the_same_at_any_time_of_the_clock(t0_us):
    _, later = receive_cut(LINK, Events(STREAM.t_us + t0_us, STREAM.x, STREAM.y, STREAM.p))
    for one, other in zip(receive_cut(LINK, STREAM)[1], later, strict=True):
        assert abs(other.t_us - t0_us - one.t_us) <= 0.25
        for a, b in zip(one.frames, other.frames, strict=True):
            times = {name: getattr(b, name) - t0_us for name in ("t_us", "points_t_us")}
            assert times == pytest.approx({name: getattr(a, name) for name in times}, abs=0.25, rel=0)
            assert frame_content(
                replace_fields(b, **{name: getattr(a, name) for name in times})
            ) == frame_content(a)


def test_what_is_dropped_is_counted():
    receiver = Receiver(LINK)
    receiver.feed(Events.of([10, 20, 15, 30], [1, 1280, 1, 1], [1, 1, 1, 720], [0, 1, 0, 1]))
    receiver.feed(Events.of([9, 40], [1, 1], [1, 1], [0, 1]))
    assert receiver.counts["events"] == 6
    assert receiver.counts["dropped_off_sensor"] == 2
    assert receiver.counts["dropped_time_backward"] == 1
    with pytest.raises(StreamError, match="events with polarity 2, expected 0 or 1"):
        receiver.feed(Events.of([50], [1], [1], [2]))
    receiver.close()
    assert receiver.close() == []
    with pytest.raises(StreamError, match="closed"):
        receiver.feed(Events.empty())


@pytest.mark.parametrize("back_us", [100_000, 3_000_000, 10**15])
def test_a_camera_that_restarts_its_clock_is_received_again(back_us):
    bar, late_us = IdealBar(random_symbols(LINK, 2)), 10**12
    parts = [ideal_events(LINK, bar, t0_us=t0_us) for t0_us in (late_us, late_us - back_us)]
    receiver, packets = receive_cut(LINK, Events.concat(parts), [len(parts[0])])
    assert receiver.counts["clock_restarts"] == 1
    assert receiver.counts["dropped_time_backward"] == receiver.counts["dropped_time_doubtful"] == 0
    assert [f.transmitter for f in frames_of(packets)] == [0] * 20 + [1] * 20
    assert right_frames(packets[:2], bar, t0_us=late_us) == 20
    assert right_frames(packets[2:], bar, t0_us=late_us - back_us) == 20


class Probe(defaultdict):
    """Values of the stages that finish."""

    @hookimpl
    def evlcp_stage_finished(self, stage, value, elapsed_s):
        assert elapsed_s >= 0
        self[stage].append(value)


@pytest.mark.parametrize("width_px", [1, 2, 5, 6])
def test_probes_see_every_stage(width_px):
    """A thin bar stands in the middle of a cell."""
    probe = Probe(list)
    receive_cut(LINK, lit(2, width_px=width_px, x_px=400.0)[1], hook=Registry.load(probe).hook)
    assert {len(probe[stage]) for stage in ("frame", "ranging", "decoding", "view")} == {20}
    assert len(probe["synchronization"]) == 2
    assert len(probe["regions"]) >= 40
    assert len(probe["separation"]) >= 20
    for presence in probe["separation"]:
        assert isinstance(presence, PresenceMap)
        # As many cells on its left as on its right.
        assert presence.selected.shape[2] % 2 == 1
        assert width_px > 2 or presence.selected.any((0, 1)).sum() <= 3
