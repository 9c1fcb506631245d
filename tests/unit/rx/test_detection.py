"""Finding and following blinking regions."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.link.sections import RegionSpec
from evlcp_sdk.rx.detection import RegionFollower, _clear, _cut_off
from evlcp_sdk.rx.followed import Followed
from evlcp_sdk.rx.places import Places
from evlcp_sdk.rx.rhythm import Rhythm
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.testing.recordings import (
    IdealBar,
    ideal_events,
    lamp_events,
    merged,
    noise_events,
    random_symbols,
)
from evlcp_sdk.values import Events, Region

LINK = load_link()
SPEC = RegionSpec(step_us=1000)
STEP_US = SPEC.step_us


def follower() -> RegionFollower:
    return RegionFollower(SPEC, CameraModel(), LINK.packet.chip_us)


def steps(events: Events, until_us: int) -> Iterable[tuple[int, Events]]:
    bounds = np.searchsorted(events.t_us, np.arange(0, until_us + 1, STEP_US))
    return ((n * STEP_US, events[a:b]) for n, (a, b) in enumerate(pairwise(bounds)))


def followed(events: Events, until_us: int) -> dict[int, list[Followed]]:
    """The regions of each step, by its start."""
    regions = follower()
    return {start: regions.step(start, part) for start, part in steps(events, until_us)}


def test_a_bar_is_found_within_three_steps_and_measured() -> None:
    bar = IdealBar(random_symbols(LINK, 1), start_us=3000)
    by_step = followed(ideal_events(LINK, bar), 30_000)
    first = next(start for start, found in by_step.items() if found)
    assert first <= 3000 + 3 * STEP_US
    (region,) = by_step[29_000]
    assert region.latest.x_px == pytest.approx(bar.x_px - 0.5, abs=0.6)
    assert region.latest.y_px == pytest.approx(bar.y_px - 0.5, abs=0.6)
    assert region.latest.height_px == pytest.approx(128, abs=1.5)
    assert region.latest.width_px == bar.width_px


def test_events_from_before_it_was_found_are_kept() -> None:
    bar = IdealBar(random_symbols(LINK, 1), start_us=3000)
    events = ideal_events(LINK, bar)
    by_step = followed(events, 20_000)
    (region,) = by_step[19_000]
    kept = sum(len(e) for _, e in region.pieces)
    # But for pixels that blink like a lamp for some steps: the chips of one cluster or another repeat.
    assert kept > 0.9 * np.searchsorted(events.t_us, 20_000)
    assert min(e.t_us[0] for _, e in region.pieces if len(e)) < 3300


@pytest.mark.parametrize(("shake_px", "shake_hz"), [(16, 15), (4, 60)])
def test_a_shaking_bar_is_followed(shake_px: float, shake_hz: float) -> None:
    """1.5 px/ms is the most that the paper has seen."""
    bar = IdealBar(random_symbols(LINK, 3), shake_px=shake_px, shake_hz=shake_hz, start_us=0)
    by_step = followed(ideal_events(LINK, bar), 100_000)
    assert {t.id for found in by_step.values() for t in found} == {0}
    (region,) = by_step[99_000]
    at = np.arange(5000.0, 99_000.0, 500.0)
    (x, y), (true_x, true_y) = region.positions.at(at), bar.centre(at)
    assert np.sqrt(np.mean((x - true_x + 0.5) ** 2)) < 0.6
    assert np.sqrt(np.mean((y - true_y + 0.5) ** 2)) < 0.8


@pytest.mark.parametrize("way", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_bar_that_leaves_the_image_fast_is_let_go(way: tuple[int, int]) -> None:
    """The filter's prediction runs on off the sensor until the region is released."""
    link = load_link(overrides=["tracking.id=kalman"])
    regions = RegionFollower(
        SPEC, CameraModel(), LINK.packet.chip_us, link.algorithm("tracking").compile().position
    )
    events = ideal_events(LINK, IdealBar(random_symbols(LINK, 3), start_us=0))
    gone_us = 15_000
    moved_px = np.rint(9e-3 * np.maximum(events.t_us - gone_us, 0)).astype(np.int64)
    x = events.x.astype(np.int64) + way[0] * moved_px + {1: 800, 0: 0, -1: -350}[way[0]]
    y = events.y.astype(np.int64) + way[1] * moved_px
    seen = (x >= 0) & (x < 1280) & (y >= 0) & (y < 720)
    kept = Events.of(events.t_us[seen], x[seen], y[seen], events.p[seen])
    assert kept.t_us[-1] < 90_000
    seen = [region for start, part in steps(kept, 160_000) for region in regions.step(start, part)]
    assert {region.id for region in seen} >= {0}
    assert not regions.alive
    assert all(region.released for region in seen)


def test_a_region_goes_straight_on_for_two_steps() -> None:
    positions = [Region(0, 1000.0 * n, 50 + n**2, 80 - 2 * n, 4, 100) for n in range(4)]
    region = Followed(0, Places(positions), 0)
    x, y = region.positions.at(np.array([-9e9, -1000, 0, 500, 3000, 4000, 5000, 9e9]))
    assert x == pytest.approx([48, 49, 50, 50.5, 59, 64, 69, 69])
    assert y == pytest.approx([84, 82, 80, 79, 74, 72, 70, 70])
    alone = Places(positions[:1])
    assert alone.at(np.array([-5e3, 7e3]))[0] == pytest.approx([50, 50])


@pytest.mark.parametrize("end", ["top", "bottom"])
def test_an_end_that_is_dark_for_a_while_is_still_there(end: str) -> None:
    bar = IdealBar(random_symbols(LINK, 2), start_us=0)
    events = ideal_events(LINK, bar)
    dark = (events.t_us >= 30_000) & (events.t_us < 33_000)
    dark &= events.y < 309 if end == "top" else events.y >= 411
    by_step = followed(events[~dark], 60_000)
    (region,) = by_step[59_000]
    for at in region.positions:
        if at.t_us > 10_000:
            assert at.y_px == pytest.approx(bar.y_px - 0.5, abs=1)
            assert at.height_px == pytest.approx(128, abs=2)


def test_pixels_awake_beyond_an_end_do_not_move_a_region() -> None:
    bar = IdealBar(random_symbols(LINK, 2), start_us=0)
    events = ideal_events(LINK, bar)
    copies = events[(events.y == 290) & (events.x == 400) & (events.t_us >= 30_000)]
    copies = copies[copies.t_us < 34_000]
    stray = Events.of(copies.t_us, copies.x, copies.y - 8, copies.p)
    by_step = followed(merged(events, stray), 60_000)
    (region,) = by_step[59_000]
    for at in region.positions:
        if at.t_us > 10_000:
            assert at.y_px == pytest.approx(bar.y_px - 0.5, abs=1)


def test_where_a_little_too_much_was_seen_a_region_stays_on_its_way() -> None:
    """A height that is off by a little more than is allowed for says nearly as much of the place."""
    seen = [Region(0, 1000.0 * n, 50, 400 + 3 * n, 4, 158 + n) for n in range(5)]
    rows = [at.y_px for at in Places(seen).moved(0, 0, 1, (4, 150), row_px=390, most_px=10)]
    # 158 to 160 are trusted; 161 may be half a pixel off, and 162 a whole one.
    assert rows == pytest.approx([401, 404, 407, 409.5, 412])
    # What is twice as high may be anywhere in it.
    twice = [Region(0, 1000.0 * n, 50, 400 + 3 * n, 4, 300) for n in range(5)]
    rows = [at.y_px for at in Places(twice).moved(0, 0, 1, (4, 150), row_px=390, most_px=10)]
    assert rows == [390] * 5


@pytest.mark.parametrize("shows_again", [False, True])
def test_a_bar_with_a_hidden_end_is_not_drawn_to_leaves_beyond_the_other(shows_again: bool) -> None:
    bar = IdealBar(random_symbols(LINK, 2), start_us=0)
    events = ideal_events(LINK, bar)
    # Its lower quarter is hidden, for a while or all the time; one pixel in four above it blinks, too.
    hidden = (events.y >= 392) & (events.t_us < (30_000 if shows_again else 60_000))
    leaf = events[(events.x == 399) & (events.y < 306) & (events.t_us >= 15_000)]
    leaves = Events.of(leaf.t_us, leaf.x, leaf.y - 9, leaf.p)
    regions = RegionFollower(SPEC, CameraModel(), LINK.packet.chip_us)
    for start, part in steps(merged(events[~hidden], leaves), 60_000):
        regions.step(start, part)
        if start == 12_000:
            (region,) = regions.alive
            centre_px, lit_px = (bar.x_px - 0.5, bar.y_px - 0.5), (-64.0, 32.0)
            regions.shape(region, region.latest.t_us, centre_px, (4.0, 128.0), lit_px)
        elif start > 12_000:
            assert region.latest.y_px == pytest.approx(bar.y_px - 0.5, abs=1.5), start


def test_two_bars_are_two_regions() -> None:
    one, two = IdealBar(random_symbols(LINK, 1)), IdealBar(random_symbols(LINK, 1), x_px=450, start_us=5300)
    by_step = followed(merged(ideal_events(LINK, one), ideal_events(LINK, two)), 30_000)
    assert sorted(round(t.latest.x_px) for t in by_step[29_000]) == [400, 450]


def test_a_bar_in_two_pieces_is_one_region() -> None:
    bar = IdealBar(random_symbols(LINK, 1))
    events = ideal_events(LINK, bar)
    middle = (events.y >= 345) & (events.y < 349)
    by_step = followed(events[~middle], 30_000)
    (region,) = by_step[29_000]
    assert region.latest.height_px == pytest.approx(128, abs=1.5)


def test_what_fades_is_released() -> None:
    bar = IdealBar(random_symbols(LINK, 1), start_us=0)
    ends = 34_600
    regions = follower()
    events = ideal_events(LINK, bar)
    alive = {
        start: [not t.released for t in regions.step(start, part)]
        for start, part in steps(events, ends + SPEC.fade_us + 5000)
    }
    (gone,) = [start for start, found in alive.items() if found == [False]]
    assert gone == pytest.approx(ends + SPEC.fade_us, abs=2 * STEP_US)
    assert alive[gone + STEP_US] == []


@pytest.mark.parametrize("hz", [100, 300, 1000, 2000, 4000])
@pytest.mark.parametrize("duty", [0.05, 0.2, 0.5])
def test_lamps_and_noise_are_no_regions(hz: float, duty: float) -> None:
    by_step = followed(
        merged(lamp_events(300, 300, 20, hz, 60_000, duty=duty), noise_events(500_000, 60_000)), 60_000
    )
    assert not any(by_step.values())


@pytest.mark.parametrize("later_us", range(0, STEP_US, 125))
def test_a_lamp_of_two_chips_is_no_region(later_us: int) -> None:
    """Wherever in a step its pixels are known as a lamp's, having been candidates in the step before."""
    lamp = lamp_events(300, 300, 20, 1e6 / (2 * LINK.packet.chip_us), 30_000)
    lamp = Events.of(lamp.t_us + later_us, lamp.x, lamp.y, lamp.p)
    assert not any(followed(lamp, 29_000).values())


def test_a_moving_edge_is_no_region() -> None:
    """A bright post that crosses the image at 3 px/ms: each pixel sees it come and go once."""
    column, row = np.meshgrid(np.arange(100, 400), np.arange(100, 500))
    comes, goes = (column - 100) * 333, (column - 100) * 333 + 3000
    t = np.concatenate([comes.ravel() + d for d in (0, 20, 40)] + [goes.ravel() + d for d in (0, 20, 40)])
    order = np.argsort(t, kind="stable")
    events = Events.of(
        t[order],
        np.tile(column.ravel(), 6)[order],
        np.tile(row.ravel(), 6)[order],
        np.repeat([1, 0], 3 * column.size)[order],
    )
    assert not any(followed(events, 100_000).values())


def test_what_a_bar_has_left_is_no_region() -> None:
    """Where a bar was, its veil lets each pixel rise with a chip now and then, not twice within 12 chips."""
    bar = IdealBar(random_symbols(LINK, 1), start_us=0, width_px=12)
    seen = ideal_events(LINK, bar)
    seen = seen[seen.t_us < 30_000]
    left = np.unique(np.stack([seen.x, seen.y]), axis=1)
    rng = np.random.default_rng(0)
    first = 1400 * rng.integers(0, 7, left.shape[1]) + 100 * rng.integers(0, 2, left.shape[1])
    t = 90_000 + first + 1400 * 7 * np.arange(6)[:, None]
    order = np.argsort(t, axis=None, kind="stable")
    x, y = (np.broadcast_to(v, t.shape).ravel()[order] for v in left)
    trail = Events.of(t.ravel()[order], x, y, np.ones(t.size))
    # As many candidates in a step as a region needs, time after time.
    assert np.bincount((trail.t_us - 90_000) // 1400).min() > 5 * 20
    by_step = followed(merged(seen, trail), 150_000)
    assert {region.id for found in by_step.values() for region in found} == {0}
    assert not by_step[149_000]


@pytest.mark.parametrize("merge_px", [8, 15, 16, 32])
def test_bars_farther_apart_than_the_gap_are_two_regions_for_every_gap(merge_px: int) -> None:
    one, two = IdealBar(random_symbols(LINK, 1)), IdealBar(random_symbols(LINK, 1), x_px=500, start_us=5300)
    events = merged(ideal_events(LINK, one), ideal_events(LINK, two))
    regions = RegionFollower(replace(SPEC, merge_px=merge_px), CameraModel(), LINK.packet.chip_us)
    for start, part in steps(events, 30_000):
        found = regions.step(start, part)
    assert sorted(round(t.latest.x_px) for t in found) == [400, 500]


def test_a_bar_is_found_before_a_panel_of_4_khz() -> None:
    """Its rises come two and a half chips apart: it belongs to no region, and does not widen the bar's."""
    bar = IdealBar(random_symbols(LINK, 1), start_us=0)
    panel = lamp_events(385, 340, 30, 4000.0, 30_000, duty=0.5)
    beside = (panel.x < 396) | (panel.x > 406)
    (region,) = followed(merged(ideal_events(LINK, bar), panel[beside]), 30_000)[29_000]
    assert region.latest.width_px <= bar.width_px + 2
    assert region.latest.height_px == pytest.approx(128, abs=1.5)


@pytest.mark.parametrize("jitter_us", [8, 16])
@pytest.mark.parametrize("hz", [2700, 3600, 4400])
def test_a_lamp_near_whole_chips_is_known_by_its_steady_time(hz: int, jitter_us: int) -> None:
    """Its rises come 3.7, 2.8 or 2.3 chips apart: with a pixel's jitter, on the chips most of the time.

    With a readout that many pixels wait for, the number of whole chips changes, too.
    """
    period_us, rng = 1e6 / hz, np.random.default_rng(hz)
    column, row = (v.ravel() for v in np.meshgrid(np.arange(300, 320), np.arange(200, 220)))
    t = np.arange(100, 40_000, period_us)[:, None] + rng.normal(
        0, jitter_us, (int(np.ceil(39_900 / period_us)), 400)
    )
    order = np.argsort(t, axis=None, kind="stable")
    x, y = (np.broadcast_to(v, t.shape).ravel()[order] for v in (column, row))
    events = Events.of(np.sort(t.ravel()).astype(np.int64), x, y, np.ones(t.size))
    rhythm = Rhythm(1280, 720, LINK.packet.chip_us, SPEC.min_score)
    for start, part in steps(events, 40_000):
        rhythm.step(start, part, np.zeros((180, 320), np.int32), 2)
        if start >= 20_000:
            assert len(rhythm.of(part)) < 0.15 * len(part)


@pytest.mark.parametrize("jitter_us", [3, 10])
def test_a_code_is_hardly_taken_for_a_lamp(jitter_us: int) -> None:
    """Of a pixel of each cluster, in a hundred packets: those of the steadiest pilot most."""
    rng, packet, codebook = np.random.default_rng(jitter_us), LINK.packet, LINK.codebook
    size = (packet.frames, codebook.clusters)
    chips = np.concatenate(
        [
            packet_chips(rng.integers(0, len(codebook.codewords), size), codebook, packet.pilot_every)
            for _ in range(100)
        ]
    ).astype(int)
    chip, cluster = np.nonzero(np.diff(chips, axis=0, prepend=0) == 1)
    t = 1000 + chip * packet.chip_us + rng.normal(0, jitter_us, len(chip))
    order = np.argsort(t, kind="stable")
    rises = Events.of(t[order].astype(np.int64), cluster[order], np.full(len(t), 3), np.ones(len(t)))
    rhythm = Rhythm(1280, 720, packet.chip_us, SPEC.min_score)
    kept = np.zeros(codebook.clusters, int)
    for start, part in steps(rises, int(t.max())):
        rhythm.step(start, part, np.zeros((180, 320), np.int32), 2)
        kept += np.bincount(rhythm.of(part).x, minlength=len(kept))
    lost = 1 - kept / np.bincount(cluster)
    assert lost.mean() < 0.02
    assert lost.max() < 0.15


def test_a_region_takes_its_bars_size_and_gathers_its_events() -> None:
    """Only the upper half is lit at first; the events of the whole come back from the image's."""
    bar = IdealBar(random_symbols(LINK, 2), start_us=0)
    events = ideal_events(LINK, bar)
    half = (events.y < 345) | (events.t_us >= 20_000)
    regions = RegionFollower(SPEC, CameraModel(), LINK.packet.chip_us, keep_us=50_000)
    for start, part in steps(events[half], 25_000):
        regions.step(start, part)
    region = regions.alive[0]
    before = sum(len(e) for _, e in region.pieces)
    assert regions.shape(region, 24_000.0, (bar.x_px - 0.5, bar.y_px - 0.5), (4.0, 128.0)) == np.inf
    x, y = region.positions.at(np.array([24_000.0]))
    assert (x[0], y[0]) == pytest.approx((bar.x_px - 0.5, bar.y_px - 0.5))
    old = list(region.pieces)
    regions.gather(region, 18_000.5, 21_000)
    for (start, now), (_, then) in zip(region.pieces, old, strict=True):
        assert (now is not then) == (start < 21_000 and start + 1_000 > 18_000.5)
    regions.gather(region)
    since_us = region.pieces[0][0]
    kept = events[half]
    within = (kept.t_us >= since_us) & (kept.t_us < 25_000)
    assert sum(len(e) for _, e in region.pieces) == int(within.sum())
    assert sum(len(e) for _, e in region.pieces) >= before
    assert regions.shape(region, 24_000.0, (bar.x_px - 0.4, bar.y_px - 0.5), (4.0, 128.2)) == 0
    off_px = regions.shape(region, 24_000.0, (bar.x_px + 0.5, bar.y_px - 0.5), (4.0, 131.0))
    assert off_px == pytest.approx(3)


def test_another_image_moves_with_its_bar() -> None:
    bar = IdealBar(random_symbols(LINK, 2), start_us=0, shake_px=4, shake_hz=20)
    regions = RegionFollower(SPEC, CameraModel(), LINK.packet.chip_us, keep_us=50_000)
    for start, part in steps(ideal_events(LINK, bar), 25_000):
        regions.step(start, part)
    (region,) = regions.alive
    (x,), (y,) = region.positions.at(np.array([24_000.0]))
    other = regions.beside(region, 24_000.0, (float(x) + 60, float(y) + 10), (4.0, 128.0))
    at = np.arange(5000.0, 24_000.0, 500.0)
    assert np.ptp(
        np.array(other.positions.at(at)) - np.array(region.positions.at(at)), axis=1
    ) == pytest.approx([0, 0], abs=1e-9)
    assert other in regions.alive
    assert other.covers(24_000.0, (float(x) + 60, float(y) + 10))
    assert not other.covers(24_000.0, (float(x), float(y)))
    assert not region.holds(other, 24_000.0, 3.0)
    assert not region.holds(other, 24_000.0, 59.0)
    assert region.holds(other, 24_000.0, 61.0)
    regions.drop(other)
    assert regions.alive == [region]


def test_what_frames_have_shown_to_be_two_stays_two() -> None:
    """A bar over its image, found as one: a jolt brings one region over the other; a pole hides the bar."""
    bar = IdealBar(random_symbols(LINK, 2), start_us=0)
    image = replace(bar, y_px=bar.y_px + 138)
    own, other = ideal_events(LINK, bar), ideal_events(LINK, image, seed=2)
    hidden = (own.t_us >= 30_000) & (own.t_us < 50_000)
    spec, size = replace(SPEC, fade_us=10_000), (4.0, 128.0)
    regions = RegionFollower(spec, CameraModel(), LINK.packet.chip_us)
    for start, part in steps(merged(own[~hidden], other), 60_000):
        regions.step(start, part)
        now = {one.id: one for one in regions.alive}
        if start == 10_000:
            (whole,) = regions.alive
            assert whole.latest.height_px > 250
            t_us = whole.latest.t_us
            regions.shape(whole, t_us, (image.x_px - 0.5, image.y_px - 0.5), size)
            beside = regions.beside(whole, t_us, (bar.x_px - 0.5, bar.y_px - 0.5), size)
        elif start == 20_000:
            whole.positions = Places(replace(p, y_px=p.y_px - 30) for p in whole.positions)
        elif start == 25_000:
            # The next frame shows where it is.
            assert set(now) == {whole.id, beside.id}
            regions.shape(whole, whole.latest.t_us, (image.x_px - 0.5, image.y_px - 0.5), size)
        elif start == 45_000:
            assert set(now) == {whole.id}
    # What is seen where it was is no halo: it is found again.
    assert whole.id in now
    assert len(now) == 2
    assert [round(one.latest.y_px) for one in regions.alive] == pytest.approx([488, 350], abs=2)


def test_a_region_does_not_go_on_to_the_bar_below() -> None:
    """Four dark rows are between them, and the region seems to move there by 7 px a step."""
    bar = IdealBar(random_symbols(LINK, 2), start_us=0)
    below = replace(bar, y_px=bar.y_px + 132)
    size = (4.0, 128.0)
    regions = RegionFollower(SPEC, CameraModel(), LINK.packet.chip_us)
    events = merged(ideal_events(LINK, bar), ideal_events(LINK, below, seed=2))
    for start, part in steps(events, 40_000):
        regions.step(start, part)
        if start == 10_000:
            (own,) = regions.alive
            t_us = own.latest.t_us
            regions.shape(own, t_us, (bar.x_px - 0.5, bar.y_px - 0.5), size)
            other = regions.beside(own, t_us, (below.x_px - 0.5, below.y_px - 0.5), size)
            own.positions = Places(
                replace(p, y_px=p.y_px + 7 * k) for k, p in enumerate(own.positions, 1 - len(own.positions))
            )
        elif start > 10_000:
            assert own.latest.y_px == pytest.approx(bar.y_px - 0.5, abs=1)
            assert other.latest.y_px == pytest.approx(below.y_px - 0.5, abs=1)


@pytest.mark.parametrize(
    ("others", "left"),
    [
        ([], (0, 0, 30, 100)),
        ([(5, 96, 25, 200)], (0, 0, 30, 96)),
        ([(5, -90, 25, 3)], (0, 3, 30, 100)),
        ([(27, 20, 50, 300)], (0, 0, 27, 100)),
        ([(-9, 20, 4, 300), (5, 97, 25, 200)], (4, 0, 30, 97)),
        # Where it strayed to; over the middle; beside it for all of its height; and out of reach.
        ([(5, 80, 25, 200)], (0, 0, 30, 80)),
        ([(5, 45, 25, 200)], (0, 0, 30, 100)),
        ([(18, -60, 40, 200)], (0, 0, 18, 100)),
        ([(5, 105, 25, 200)], (0, 0, 30, 100)),
    ],
)
def test_what_other_bars_cut_off(others: list[tuple[int, int, int, int]], left: tuple[int, ...]) -> None:
    """Of a box with a seam of 5 px around a bar."""
    assert _cut_off((0, 0, 30, 100), (5, 5, 25, 95), others) == left


def test_a_region_that_strayed_did_so_since_the_frame_before() -> None:
    t_us = np.arange(6) * 1000.0
    places = Places([Region(0, t, 10.0, 50.0, 4.0, 9.0) for t in t_us])
    moved = list(places.moved(0, 2.0, -8.0, (4.0, 9.0), grown_us=(1000.0, 3000.0)))
    assert [p.x_px for p in moved] == [10, 10, 11, 12, 12, 12]
    assert [p.y_px for p in moved] == [50, 50, 46, 42, 42, 42]


def test_of_two_regions_that_follow_the_same_the_older_stays() -> None:
    bar = IdealBar(random_symbols(LINK, 2), start_us=0)
    regions, centre, size = follower(), (bar.x_px - 0.5, bar.y_px - 0.5), (4.0, 128.0)
    for start, part in steps(ideal_events(LINK, bar), 15_000):
        regions.step(start, part)
        if start == 10_000:
            (first,) = regions.alive
            regions.shape(first, first.latest.t_us, centre, size)
            regions.beside(first, first.latest.t_us, (centre[0], centre[1] + 3), size)
    assert regions.alive == [first]


def test_parts_of_a_bar_that_hear_the_same_become_one_region() -> None:
    """The middle is dark for longer than parts are joined over."""
    bar = IdealBar(random_symbols(LINK, 2), start_us=0)
    events = ideal_events(LINK, bar)
    events = events[np.abs(events.y - bar.y_px) > 12]
    regions = RegionFollower(SPEC, CameraModel(), LINK.packet.chip_us, keep_us=50_000)
    for start, part in steps(events, 25_000):
        regions.step(start, part)
    upper, lower = sorted(regions.alive, key=lambda r: r.latest.y_px)
    regions.unite(lower, upper)
    assert regions.alive == [lower]
    assert upper.released
    (x,), (y,) = lower.positions.at(np.array([24_000.0]))
    assert (x, y) == pytest.approx((bar.x_px - 0.5, bar.y_px - 0.5), abs=1.5)
    assert lower.latest.height_px == pytest.approx(128, abs=4)
    since_us = lower.pieces[0][0]
    within = (events.t_us >= since_us + 6000) & (events.t_us < 25_000)
    kept = sum(int((e.t_us >= since_us + 6000).sum()) for _, e in lower.pieces)
    # Pixels that blink like a lamp just now are left out of all steps: one cluster of sixteen or two.
    assert kept > 0.85 * within.sum()


@pytest.mark.parametrize(
    ("others", "clear"),
    [
        ([], (0, 0, 20, 100)),
        ([(30, 0, 40, 100)], (0, 0, 20, 100)),
        ([(15, 0, 40, 100)], (0, 0, 15, 100)),
        ([(0, -50, 20, 10)], (0, 10, 20, 100)),
        ([(15, 0, 40, 100), (0, 90, 20, 200)], (0, 0, 15, 90)),
        ([(-5, -5, 25, 105)], (0, 0, 0, 0)),
    ],
)
def test_the_part_of_a_box_that_is_clear_of_others(
    others: list[tuple[int, int, int, int]], clear: tuple[int, int, int, int]
) -> None:
    assert _clear((0, 0, 20, 100), others) == clear
