"""Finding and following blinking regions; lines of events that move, drawn from a known place and speed."""

from dataclasses import replace

import numpy as np
import pytest
from rx_streams import LINK, lamp_events, lit, noise_events, steps

from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.link.sections import RegionSpec
from evlcp_sdk.rx.boxes import cut_neighbours, subtract_boxes
from evlcp_sdk.rx.regions import BarPlace, RegionTrack, RhythmTracker
from evlcp_sdk.rx.rhythm import BlinkDetector
from evlcp_sdk.rx.sweeps import find_sweeps, fit_sweep, has_chip_rhythm
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.testing.recordings import ideal_events, merge_events, random_symbols
from evlcp_sdk.values import Events

SPEC = RegionSpec(step_us=1000)
STEP_US = SPEC.step_us
BAR, BAR_EVENTS = lit(2, start_us=0)
CENTRE, SIZE = (BAR.x_px - 0.5, BAR.y_px - 0.5), (4.0, 128.0)


def make_tracker(spec=SPEC, **options):
    return RhythmTracker(spec, CameraModel(), LINK.packet.chip_us, **options)


def step_regions(regions, events, until_us):
    """The regions of each step, after its start, us."""
    return ((start, regions.step(start, part)) for start, part in steps(events, until_us))


def follow(events, until_us, spec=SPEC):
    return dict(step_regions(make_tracker(spec), events, until_us))


def raise_events(events, by_px):
    return Events.of(events.t_us, events.x, events.y - by_px, events.p)


def in_order(t, x, y, p):
    return Events.of(t, x, y, p)[np.argsort(t, kind="stable")]


def test_a_bar_is_found_within_three_steps_and_measured():
    """The events from before it was found are kept."""
    bar, events = lit(2, start_us=3000)
    by_step = follow(events, 20_000)
    assert next(start for start, found in by_step.items() if found) <= 3000 + 3 * STEP_US
    (region,) = by_step[19_000]
    assert (region.latest.x_px, region.latest.y_px) == pytest.approx(CENTRE, abs=0.6)
    assert region.latest.height_px == pytest.approx(128, abs=1.5)
    assert region.latest.width_px == bar.width_px
    kept = sum(len(e) for _, e in region.pieces)
    # But for pixels that blink like a lamp for some steps: the chips of one cluster or another repeat.
    assert kept > 0.9 * np.searchsorted(events.t_us, 20_000)
    assert min(e.t_us[0] for _, e in region.pieces if len(e)) < 3300


@pytest.mark.parametrize(("shake_px", "shake_hz"), [(16, 15), (4, 60)])
def test_a_shaking_bar_is_followed(shake_px, shake_hz):
    """1.5 px/ms is the most that the paper has seen."""
    bar, events = lit(3, shake_px=shake_px, shake_hz=shake_hz, start_us=0)
    by_step = follow(events, 100_000)
    assert {t.id for found in by_step.values() for t in found} == {0}
    (region,) = by_step[99_000]
    at = np.arange(5000.0, 99_000.0, 500.0)
    (x, y), (true_x, true_y) = region.track.centres_at(at), bar.centre(at)
    assert np.sqrt(np.mean((x - true_x + 0.5) ** 2)) < 0.6
    assert np.sqrt(np.mean((y - true_y + 0.5) ** 2)) < 0.8


@pytest.mark.parametrize("way", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_bar_that_leaves_the_image_fast_is_let_go(way):
    """The filter's prediction runs on off the sensor until the region is released."""
    kalman = load_link(overrides=["tracking.id=kalman"]).algorithm("tracking").compile()
    regions = make_tracker(centre_filter=kalman.position)
    moved_px = np.rint(9e-3 * np.maximum(BAR_EVENTS.t_us - 15_000, 0)).astype(np.int64)
    x = BAR_EVENTS.x + way[0] * moved_px + {1: 800, 0: 0, -1: -350}[way[0]]
    y = BAR_EVENTS.y + way[1] * moved_px
    on = (x >= 0) & (x < 1280) & (y >= 0) & (y < 720)
    seen = Events.of(*(column[on] for column in (BAR_EVENTS.t_us, x, y, BAR_EVENTS.p)))
    found = [region for _, some in step_regions(regions, seen, 160_000) for region in some]
    assert found
    assert all(region.released for region in found)
    assert not regions.alive


def test_a_bar_at_the_edge_is_sought_on_the_sensor(monkeypatch):
    """Its light and a faint halo to the left: half of their width to the right of the mean is off it."""
    boxes, measure = [], BlinkDetector.measure
    monkeypatch.setattr(
        BlinkDetector, "measure", lambda self, box, *a: boxes.append(box) or measure(self, box, *a)
    )
    x, halo = BAR_EVENTS.x.astype(np.int64) + 1279 - BAR_EVENTS.x.max(), BAR_EVENTS.y % 16 == 0
    left = [
        in_order(BAR_EVENTS.t_us[halo], x[halo] - by, BAR_EVENTS.y[halo], BAR_EVENTS.p[halo]) for by in (4, 8)
    ]
    bar = Events.of(BAR_EVENTS.t_us, x, BAR_EVENTS.y, BAR_EVENTS.p)
    assert follow(merge_events(bar, *left), 10_000)[9000]
    assert max(box[2] for box in boxes) == 1280


@pytest.mark.parametrize("shows_again", [False, True])
def test_a_bar_with_a_hidden_end_is_not_drawn_to_leaves_beyond_the_other(shows_again):
    """Its lower quarter is hidden, for a while or all the time; one pixel in four above it blinks, too."""
    hidden = (BAR_EVENTS.y >= 392) & (BAR_EVENTS.t_us < (30_000 if shows_again else 60_000))
    leaf = BAR_EVENTS[(BAR_EVENTS.x == 399) & (BAR_EVENTS.y < 306) & (BAR_EVENTS.t_us >= 15_000)]
    regions, events = make_tracker(), merge_events(BAR_EVENTS[~hidden], raise_events(leaf, 9))
    for start, found in step_regions(regions, events, 60_000):
        if start == 12_000:
            (region,) = found
            regions.correct_region(region, BarPlace(region.latest.t_us, CENTRE, SIZE, (-64.0, 32.0)))
        elif start > 12_000:
            assert region.latest.y_px == pytest.approx(CENTRE[1], abs=1.5), start


@pytest.mark.parametrize("merge_px", [8, 15, 16, 32])
def test_bars_farther_apart_than_the_gap_are_two_regions_for_every_gap(merge_px):
    events = merge_events(BAR_EVENTS, ideal_events(LINK, replace(BAR, x_px=500, start_us=5300)))
    found = follow(events, 30_000, replace(SPEC, merge_px=merge_px))[29_000]
    assert sorted(round(t.latest.x_px) for t in found) == [400, 500]


def test_what_fades_is_released():
    ends = 34_600
    seen = step_regions(make_tracker(), BAR_EVENTS[BAR_EVENTS.t_us < ends], ends + SPEC.fade_us + 5000)
    alive = {start: [not one.released for one in found] for start, found in seen}
    (gone,) = [start for start, found in alive.items() if found == [False]]
    assert gone == pytest.approx(ends + SPEC.fade_us, abs=2 * STEP_US)
    assert alive[gone + STEP_US] == []


@pytest.mark.parametrize(
    ("hz", "duty"), [(100, 0.05), (120, 0.1), (300, 0.5), (1000, 0.2), (2000, 0.05), (2000, 0.5), (5000, 0.5)]
)
def test_lamps_and_noise_are_no_regions(hz, duty):
    lamp = lamp_events(300, 300, 20, hz, 60_000, duty=duty)
    assert not any(follow(merge_events(lamp, noise_events(500_000, 60_000)), 60_000).values())


def test_a_moving_edge_is_no_region():
    """A bright post that crosses the image at 3 px/ms: each pixel sees it come and go once."""
    late_us = [0, 20, 40, 3000, 3020, 3040]
    column, row, late_us = np.meshgrid(np.arange(100, 400), np.arange(100, 500), late_us)
    columns = (column - 100) * 333 + late_us, column, row, late_us < 3000
    assert not any(follow(in_order(*map(np.ravel, columns)), 100_000).values())


@pytest.mark.parametrize("jitter_us", [8, 16])
@pytest.mark.parametrize("hz", [2700, 3600, 4400])
def test_a_lamp_near_whole_chips_is_known_by_its_steady_time(hz, jitter_us):
    """Its rises come 3.7, 2.8 or 2.3 chips apart: with a pixel's jitter, on the chips most of the time.

    With a readout that many pixels wait for, the number of whole chips changes, too.
    """
    at, column, row = np.meshgrid(np.arange(100, 40_000, 1e6 / hz), np.arange(300, 320), np.arange(200, 220))
    t = (at + np.random.default_rng(hz).normal(0, jitter_us, at.shape)).astype(np.int64)
    events = in_order(*map(np.ravel, (t, column, row, t > 0)))
    for start, expected, part in in_rhythm(events, 40_000):
        assert start < 20_000 or len(expected) < 0.15 * len(part)


@pytest.mark.parametrize("jitter_us", [3, 10])
def test_a_code_is_hardly_taken_for_a_lamp(jitter_us):
    """Of a pixel of each cluster, in a hundred packets: those of the steadiest pilot most."""
    rng, packet, codebook = np.random.default_rng(jitter_us), LINK.packet, LINK.codebook
    sent = random_symbols(LINK, 100, jitter_us)
    chips = np.concatenate([packet_chips(symbols, codebook, packet.pilot_every) for symbols in sent])
    chip, cluster = np.nonzero(np.diff(chips.astype(int), axis=0, prepend=0) == 1)
    t = (1000 + chip * packet.chip_us + rng.normal(0, jitter_us, len(chip))).astype(np.int64)
    rises = in_order(t, cluster, np.full(len(t), 3), np.ones(len(t)))
    columns = np.concatenate([some.x for _, some, _ in in_rhythm(rises, int(t.max()))])
    lost = 1 - np.bincount(columns, minlength=codebook.clusters) / np.bincount(cluster)
    assert lost.mean() < 0.02
    assert lost.max() < 0.15


def in_rhythm(events, until_us):
    """Of each step its start, us, the events of pixels in the rhythm of the chips, and all."""
    rhythm = BlinkDetector(1280, 720, LINK.packet.chip_us, SPEC.min_score)
    for start, part in steps(events, until_us):
        rhythm.step(start, part, np.zeros((180, 320), np.int16), 2)
        yield start, rhythm.select_rhythmic(part), part


def test_a_region_takes_its_bars_size_and_gathers_its_events():
    """Only the upper half is lit at first; the events of the whole come back from the image's."""
    kept = BAR_EVENTS[(BAR_EVENTS.y < 345) | (BAR_EVENTS.t_us >= 20_000)]
    regions = make_tracker(keep_us=50_000)
    *_, (_, (region, *_)) = step_regions(regions, kept, 25_000)
    before = sum(len(e) for _, e in region.pieces)
    assert regions.correct_region(region, BarPlace(24_000.0, CENTRE, SIZE)) == np.inf
    assert region.track.centre_at(24_000.0) == pytest.approx(CENTRE)
    old = list(region.pieces)
    regions.gather_events(region, 18_000.5, 21_000)
    for (start, now), (_, then) in zip(region.pieces, old, strict=True):
        assert (now is not then) == (start < 21_000 and start + 1_000 > 18_000.5)
    regions.gather_events(region)
    within = (kept.t_us >= region.pieces[0][0]) & (kept.t_us < 25_000)
    assert sum(len(e) for _, e in region.pieces) == int(within.sum()) >= before
    x, y = CENTRE
    assert regions.correct_region(region, BarPlace(24_000.0, (x + 0.1, y), (4.0, 128.2))) == 0
    assert regions.correct_region(region, BarPlace(24_000.0, (x + 1, y), (4.0, 131.0))) == pytest.approx(3)


def test_a_region_does_not_go_on_to_the_bar_below():
    """Four dark rows are between them, and the region seems to move there by 7 px a step."""
    below = CENTRE[0], CENTRE[1] + 132
    regions = make_tracker()
    events = merge_events(BAR_EVENTS, ideal_events(LINK, replace(BAR, y_px=BAR.y_px + 132), seed=2))
    for start, found in step_regions(regions, events, 40_000):
        if start == 10_000:
            (own,) = found
            t_us = own.latest.t_us
            regions.correct_region(own, BarPlace(t_us, CENTRE, SIZE))
            other = regions.open_duplicate(own, BarPlace(t_us, below, SIZE))
            before = own.track.previous
            own.track = RegionTrack([replace(before, y_px=before.y_px - 7), own.latest])
        elif start > 10_000:
            assert own.latest.y_px == pytest.approx(CENTRE[1], abs=1)
            assert other.latest.y_px == pytest.approx(below[1], abs=1)


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
def test_what_other_bars_cut_off(others, left):
    """Of a box with a seam of 5 px around a bar."""
    assert cut_neighbours((0, 0, 30, 100), (5, 5, 25, 95), others) == left


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
def test_the_part_of_a_box_that_is_clear_of_others(others, clear):
    assert subtract_boxes((0, 0, 20, 100), others) == clear


def test_of_two_regions_that_follow_the_same_the_older_stays():
    regions = make_tracker()
    for start, found in step_regions(regions, BAR_EVENTS, 15_000):
        if start == 10_000:
            (first,) = found
            regions.correct_region(first, BarPlace(first.latest.t_us, CENTRE, SIZE))
            regions.open_duplicate(first, BarPlace(first.latest.t_us, (CENTRE[0], CENTRE[1] + 3), SIZE))
    assert regions.alive == [first]


IMAGE_PX = 1280, 720
SWEEP_US = 1500


def line(speed, *, along=0.0, slope=0.0, upright=True, rhythmic=True, noise=0.1, many=6000, seed=0):
    """Events of a line 120 px long through (600, 300) in the middle of a step that begins at 30 ms, px/us."""
    rng = np.random.default_rng(seed)
    t = rng.integers(0, SWEEP_US // 100, many) * 100 + rng.integers(20, 60, many)
    t = t if rhythmic else rng.integers(0, SWEEP_US, many)
    after, place = t - SWEEP_US / 2, rng.uniform(-60, 60, many)
    across = speed * after + slope * place + rng.normal(0, 1, many)
    length = place + along * after
    x, y = (600 + across, 300 + length) if upright else (600 + length, 300 + across)
    stray = rng.random(many) < noise
    x, y = np.where(stray, rng.uniform(500, 700, many), x), np.where(stray, rng.uniform(200, 400, many), y)
    columns = 30_000 + t, np.rint(x), np.rint(y), rng.integers(0, 2, many)
    return Events.of(*columns)[np.argsort(t, kind="stable")]


BOX = 480, 180, 720, 420


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize(("along", "slope"), [(0.0, 0.0), (0.004, 0.0), (0.0, 0.3), (-0.003, -0.2)])
@pytest.mark.parametrize("speed", [0.0, 0.0025, -0.008])
def test_place_and_speed_of_a_line(speed, along, slope, upright):
    events = line(speed, along=along, slope=slope, upright=upright)
    found = fit_sweep(events, 30_000 + SWEEP_US / 2, BOX, along)
    x, y, width, height, moves, rows = found
    assert (x, y) == (pytest.approx(600, abs=1.5), pytest.approx(300, abs=1.5))
    across, length = (width, height) if upright else (height, width)
    assert across == pytest.approx(4 + 120 * abs(slope), abs=2.5)
    # As long as it was drawn, and as far as it moved.
    assert 116 <= length <= 122 + abs(along) * SWEEP_US / 4
    want = speed, along
    assert moves == pytest.approx(want if upright else want[::-1], abs=2e-4)
    assert found.is_fast == (abs(speed) > 0.002)
    if upright:
        lit = np.flatnonzero(rows >= np.median(rows[rows > 0]) / 4)
        assert lit[[0, -1]].tolist() == pytest.approx([240 - 180, 360 - 180], abs=4)


def test_what_lies_on_no_line_is_no_sweep():
    assert fit_sweep(line(0.005, noise=0.6), 30_750, BOX) is None
    assert fit_sweep(line(0.005, many=150), 30_750, BOX) is None
    assert fit_sweep(line(0.005), 30_750, (0, 0, 100, 100)) is None


def test_only_what_comes_with_the_chips_is_a_bar():
    assert has_chip_rhythm(line(0.005), BOX, 100.0)
    assert not any(has_chip_rhythm(line(0.005, rhythmic=False, seed=seed), BOX, 100.0) for seed in range(20))
    (found,) = find_sweeps(line(0.005), 30_000, SWEEP_US, 100.0, [], IMAGE_PX)
    assert found.x_px == pytest.approx(600, abs=1)
    assert found.velocity_px_us == (pytest.approx(0.005, abs=2e-4), 0)
    assert find_sweeps(line(0.005, rhythmic=False), 30_000, SWEEP_US, 100.0, [], IMAGE_PX) == []
    assert find_sweeps(line(0.001), 30_000, SWEEP_US, 100.0, [], IMAGE_PX) == []
    assert find_sweeps(line(0.005), 30_000, SWEEP_US, 100.0, [(590, 290, 610, 310)], IMAGE_PX) == []
