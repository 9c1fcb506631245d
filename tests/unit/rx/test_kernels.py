"""The receiver's compiled loops against their twins."""

import math
from itertools import product

import numpy as np
import pytest
import rx_twins as twins
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from evlcp_sdk.air.codebook import chips_of_values
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.placement import _WIDEST_PX, Layout, Placement, masked
from evlcp_sdk.rx.regions import Rhythm
from evlcp_sdk.testing.recordings import merged
from evlcp_sdk.values import Events, PresenceMap

WIDTH, HEIGHT = 24, 16
SEEDS = range(5)
CHIP_US = 100.0


def random_events(rng, n, step_us=3, width=WIDTH, height=HEIGHT):
    """Events in order; many share their time."""
    t = 1000 + rng.integers(0, step_us + 1, n).cumsum()
    return Events.of(t, rng.integers(0, width, n), rng.integers(0, height, n), rng.integers(0, 2, n))


def frozen(events, step=1):
    """The same events as read-only columns; `step` > 1: not contiguous in memory."""
    columns = [np.repeat(c, step)[::step] for c in (events.t_us, events.x, events.y, events.p)]
    for column in columns:
        column.setflags(write=False)
    return Events(*columns)


LOW = (1 << _kernels.CLOCK_AT) - 1


def states(rose_us, time, score, same=0):
    """Pixels of these last rises, us, numbers of the times before, scores, and how often the same again."""
    clock = np.asarray(rose_us) % _kernels.CLOCK_ROUND << _kernels.CLOCK_AT
    again = np.asarray(same) << _kernels.SAME_AT
    return (clock | again | np.asarray(time) << _kernels.TIME_AT | score).astype(np.uint32)


def rhythm_of(pixels, chip_us=CHIP_US, min_score=8):
    rhythm = Rhythm(WIDTH, HEIGHT, chip_us, min_score)
    rhythm._pixels, rhythm._seen = pixels, 0
    return rhythm


def scored(events, pixels, min_score=8, cell_shift=2):
    hits = np.zeros((HEIGHT >> cell_shift, WIDTH >> cell_shift), np.int16)
    assert rhythm_of(pixels, min_score=min_score).step(0, events, hits, cell_shift) == hits.sum()
    return hits


@pytest.mark.parametrize("freeze", [1, 2])
@pytest.mark.parametrize("seed", SEEDS)
def test_scores_of_pixels(seed, freeze):
    rng = np.random.default_rng(seed)
    # Few pixels and many events, so that scores reach both of their ends.
    events = random_events(rng, 4000, step_us=[3, 8, 20][seed % 3], width=6, height=4)
    # Three in four of them in the rhythm of the chips.
    t_us = np.where(rng.random(len(events)) < 0.75, (events.t_us / 100).round() * 100, events.t_us)
    events = merged(Events.of(t_us, events.x, events.y, events.p))
    start_us = -(2**16)
    pixels = states(np.full((HEIGHT, WIDTH), start_us), 0, 0)
    start = (np.full(pixels.shape, start_us), *np.zeros((3, *pixels.shape), int))
    hits = scored(frozen(events, freeze), pixels)
    rows = zip(*(c.tolist() for c in (events.t_us, events.x, events.y, events.p)), strict=True)
    (rose, time, same, score), want = twins.score_rises(rows, pixels.shape, start, CHIP_US, 8, 2)
    assert_array_equal(pixels, states(rose, time, score, same))
    assert {tuple(c): hits[tuple(c)] for c in np.argwhere(hits).tolist()} == want
    assert 0 <= score.min() < score.max() <= 40


@pytest.mark.parametrize("before", [0, 2**15 - 9])
def test_hits_of_a_cell_stop_at_what_they_hold(before):
    hits, pixels = np.full((4, 6), before, np.int16), states(np.full((HEIGHT, WIDTH), -200), 3, 20)
    v, u = np.indices((4, 4)).reshape(2, -1)
    rises = Events.of(np.zeros(16), u, v, np.ones(16))
    assert rhythm_of(pixels).step(0, rises, hits, 2) == 16
    assert hits[0, 0] == min(before + 16, 2**15 - 1)
    assert (hits.ravel()[1:] == before).all()


@pytest.mark.parametrize("chip_us", [50.0, 100.0, 333.3, 1e5, 2e6])
def test_times_count_alike_at_every_chip_rate(chip_us):
    """A clock of ticks longer than a microsecond serves slow chips."""
    for chips, score in ((2, 2), (4.2, 2), (5, 1), (7, -2), (7.5, -3), (12, 1), (14, -1)):
        pixels = np.zeros((HEIGHT, WIDTH), np.uint32)
        rhythm = rhythm_of(pixels, chip_us)
        start_us = 5_000_000_000_000
        pixels[:] = states(start_us >> rhythm._shift, 9, 10)
        rhythm._seen = start_us >> rhythm._shift
        rise = Events.of([start_us + round(chips * chip_us)], [3], [2], [1])
        rhythm.step(start_us, rise, np.zeros((4, 6), np.int16), 2)
        assert pixels[2, 3] & _kernels.SCORES == 10 + score, chips


@pytest.mark.parametrize("gap_us", [1500, 12_000, 35_000, 131_072, 10**10])
def test_no_rise_grows_young(gap_us):
    """The clock goes round in 2^17 us, while a pixel's age never goes below a quarter of that again."""
    rng = np.random.default_rng(0)
    rhythm = Rhythm(WIDTH, HEIGHT, CHIP_US, 8)
    hits, events = np.zeros((4, 6), np.int16), random_events(rng, 500)
    rhythm.step(1000, events, hits, 2)
    low = rhythm._pixels & LOW
    rose = np.full((HEIGHT, WIDTH), -(2**40))
    for t, u, v, p in zip(*(c.tolist() for c in (events.t_us, events.x, events.y, events.p)), strict=True):
        if p and t - rose[v, u] >= 150:
            rose[v, u] = t
    for now in range(3000, 3000 + max(6 * gap_us, 10**6), gap_us):
        rhythm.step(now, Events.empty(), hits, 2)
        age = (now - (rhythm._pixels >> _kernels.CLOCK_AT).astype(int)) % _kernels.CLOCK_ROUND
        true = now - rose
        assert_array_equal(age[true < 2**15], true[true < 2**15])
        assert (age[true >= 2**15] >= 2**15).all()
        assert_array_equal(rhythm._pixels & LOW, low)


@pytest.mark.parametrize("seed", SEEDS)
def test_old_rises(seed):
    rng = np.random.default_rng(seed)
    now, rose = 5_000_000, 5_000_000 - rng.integers(0, 2**17, (HEIGHT, WIDTH))
    time, score = rng.integers(0, 16, rose.shape), rng.integers(0, 41, rose.shape)
    same = rng.integers(0, 32, rose.shape)
    pixels = states(rose, time, score, same)
    # Rows 10 to 15, and 0 to 4.
    none, tables = Events.empty(), rhythm_of(pixels)._tables
    columns, hits = (none.t_us, none.x, none.y, none.p), np.zeros((4, 6), np.int16)
    old = 10, 11, now, 3000, 4000
    _kernels.score_rises(columns, pixels, hits, tables.kinds, tables.lows, (150, 8, 7), (0, 2), old)
    looked_at = np.isin(np.arange(HEIGHT), [*range(10, 16), *range(5)])
    old = (now - rose >= 3000) & looked_at[:, None]
    assert_array_equal(pixels, states(np.where(old, now - 4000, rose), time, score, same))
    events = random_events(rng, 300)
    rhythmic = rhythm_of(pixels, min_score=20).of(events)
    expected = events[((score >= 20) & (same < 14))[events.y, events.x]]
    assert_array_equal(rhythmic.t_us, expected.t_us)
    assert_array_equal(rhythmic.x, expected.x)


def test_a_bar_is_measured_beside_light_that_is_everywhere() -> None:
    """A lit row across the image is a halo's; the bar's last row has half of its pixels awake."""
    blinks, rose = np.zeros((HEIGHT, WIDTH), bool), np.full((HEIGHT, WIDTH), 1000)
    blinks[4:12, 9:13] = blinks[12, 9:11] = blinks[1] = True
    # Of the left seam's pixels in every second row, six of sixteen rose long ago.
    rose[2:8, :2] = 500
    rhythm, rows = rhythm_of(states(rose, 0, np.where(blinks, 5, 3)), min_score=10), np.empty(HEIGHT, int)
    column = (9 * 9 + 9 * 10 + 8 * 11 + 8 * 12) / 34
    found = rhythm.measure((0, 0, WIDTH, HEIGHT), 1100, 200, 3.0, rows, None)
    assert found == pytest.approx((40, column, 0, 23, 1, 12.5, 10 / 16))
    assert rows.tolist() == [0, 6, 0, 0, *[4] * 8, 2, 0, 0, 0]
    # A full row holds the mean of all.
    found = rhythm.measure((5, 3, 20, 14), 1100, 200, np.inf, rows[:11], None)
    assert found == pytest.approx((34, column, 9, 12, 4, 12 + 2 / (34 / 9), 1))
    assert rhythm.measure((10, 7, 11, 8), 1100, 200, 2.0, rows[:1], None) == (1, 10, 10, 10, 7, 8, 1)
    for box, end_us in (((0, 13, 9, 16), 1100), ((0, 0, WIDTH, HEIGHT), 1300)):
        assert rhythm.measure(box, end_us, 200, 2.0, rows[: box[3] - box[1]], None)[:6] == (0,) * 6


def test_strips_are_measured_whatever_each_has_awake():
    """Where one of two lamps has a fifth of its pixels awake, the mean column is five columns off."""
    blinks = np.zeros((HEIGHT, WIDTH), bool)
    blinks[3:13, 4:7], blinks[4:14:5, 16:19] = True, True
    blinks[8, 8] = True  # of neither, but near one
    pixels = states(np.full(blinks.shape, 1000), 0, np.where(blinks, 5, 3))
    box, rows = (0, 0, WIDTH, HEIGHT), np.empty(HEIGHT, np.int64)
    # Expected so far off that no column is within a pixel of its strip.
    strips = 15.3, 3.0, np.array([[-6, 1.5], [6, 1.5]])
    rhythm = rhythm_of(pixels, min_score=10)
    many, column, first, last, upper, lower, _ = rhythm.measure(box, 1100, 200, np.inf, rows, strips)
    assert (many, first, last) == (36, 4, 18)
    assert column == pytest.approx(11)
    assert rows[8] == 3
    assert (upper, lower) == pytest.approx((3 + 1 / 6, 13 - 1 / 6))  # 36 pixels in ten rows
    assert abs(rhythm.measure(box, 1100, 200, np.inf, rows, None)[1] - 11) > 3
    # Of two strips that meet, what is near both is the first's: of six columns five, in the end.
    pixels[:] = states(1000, 0, np.where(abs(np.arange(WIDTH) - 11.5) < 3, 5, 3))
    strips = 11.5, 2.0, np.array([[-1.5, 1.5], [1.5, 1.5]])
    many, column, *_ = rhythm.measure(box, 1100, 200, np.inf, rows, strips)
    assert (many, column) == (6 * HEIGHT, pytest.approx(12.5))


@pytest.mark.parametrize("n", [0, 1, 500])
def test_events_in_boxes(n):
    rng = np.random.default_rng(n)
    events, score, same = random_events(rng, n), rng.integers(0, 41, (HEIGHT, WIDTH)), rng.integers(0, 32)
    in_rhythm = ((score >= 20) & (same < 14))[events.y, events.x]
    rhythm = rhythm_of(states(np.zeros(score.shape, int), 0, score, same), min_score=20)
    boxes = [(0, 0, WIDTH, HEIGHT), (0, 0, 1, 1), (3, 2, 17, 9), (10, 5, WIDTH, HEIGHT), (4, 4, 4, 9)]
    # One by one, some that overlap, and more than one pass takes.
    for given in [*([box] for box in boxes), boxes, [*boxes, *boxes]]:
        rhythmic = (rng.random(len(given)) < 0.5).tolist()
        taken = rhythm.select(events, given, rhythmic)
        for got, box, filtered in zip(taken, given, rhythmic, strict=True):
            want = twins.select_box(events[in_rhythm] if filtered else events, box)
            for name in ("t_us", "x", "y", "p"):
                assert_array_equal(getattr(got, name), getattr(want, name))


@pytest.mark.parametrize("freeze", [1, 2])
@pytest.mark.parametrize("seed", SEEDS)
def test_polarity_sums(seed, freeze):
    rng = np.random.default_rng(seed)
    events = random_events(rng, 3000)
    # Eighths of us are exact in binary, and no event is at a chip's very end, where rounding would decide.
    start_on, start_off = 1000 + rng.integers(0, 8 * 400, 2) / 8 + 1 / 16
    chip_us = rng.integers(8 * 60, 8 * 140) / 8
    row_us, row_px = rng.integers(-3 * 8, 3 * 8) / 8, float(rng.integers(0, 12))
    shape = (24, 9, 7)
    moving = rng.integers(-3, 12, (2, shape[0])).astype(float)
    still = np.repeat(moving[:, :1], shape[0], axis=1)
    jolted = np.where(np.arange(shape[0]) < 12, still, moving[:, -1:])
    sums, offset = np.zeros(shape, np.int16), np.empty((2, shape[0]))
    e = frozen(events, freeze)
    for row, shifts in product((0.0, row_us), (moving, still, jolted)):
        sums[:] = 0
        columns, off = (e.t_us, e.x, e.y, e.p), rng.integers(-3, 4, (2, shape[0])) / 8
        centre = shifts + off + np.array([[(shape[2] - 1) / 2], [(shape[1] - 1) / 2]])
        _kernels.add_polarity(columns, (start_on, start_off), chip_us, (row, row_px), centre, offset, sums)
        assert_array_equal(offset, off)
        want = twins.polarity_sums(
            events, start_on, start_off, chip_us, *shifts.astype(int), shape, row, row_px
        )
        assert_array_equal(sums, want)
        assert sums.any()


@pytest.mark.parametrize("grid", [1, 3])
@pytest.mark.parametrize("clusters", [1, 2, 5, 16])
@pytest.mark.parametrize("seed", SEEDS)
def test_connected_cells_of_each_cluster(seed, clusters, grid):
    rng = np.random.default_rng(seed)
    selected = rng.random((clusters, 11, 5)) < 0.3
    selected[rng.integers(clusters)] = False
    at, cluster, cells = _kernels.blobs(selected, grid)
    want = sorted(twins.blobs(selected), key=lambda blob: -blob[2])
    assert_allclose(at, [w[0] * grid + (grid - 1) / 2 * (1 + 1j) for w in want], rtol=1e-12)
    assert cluster.tolist() == [w[1] for w in want]
    assert cells.tolist() == [w[2] for w in want]


@pytest.mark.parametrize("shape", [(90, 160), (7, 5), (1, 1), (1, 12)])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_rectangles_around_connected_cells(seed, share, shape):
    rng = np.random.default_rng(seed)
    hits = (rng.integers(1, 9, shape) * (rng.random(shape) < share)).astype(np.int16)
    most = (shape[0] + 1) // 2 * ((shape[1] + 1) // 2)
    boxes, total = np.empty((most, 4), np.int64), np.empty(most, np.int64)
    n = _kernels.areas(hits > 0, hits, boxes, total)
    want_boxes, want_total = twins.areas(hits)
    assert boxes[:n].tolist() == [list(box) for box in want_boxes]
    assert total[:n].tolist() == want_total


def some_blobs(rng, clusters):
    """Blobs of a layout in its place, of which some are strays."""
    layout = rng.normal(0, 0.01, clusters) + 0.06j * np.arange(clusters)
    s, shift = rng.uniform(10, 200) * np.exp(1j * rng.uniform(0, 2 * np.pi)), rng.normal(0, 50) + 20j
    n = 3 * clusters
    cluster = np.concatenate([np.arange(clusters), rng.integers(0, clusters, n - clusters)])
    at = s * layout[cluster] + shift + rng.normal(0, 0.3, (n, 2)) @ [1, 1j]
    at[clusters:] += rng.normal(0, 30, (n - clusters, 2)) @ [1, 1j]
    return layout, s, shift, at, cluster, rng.integers(1, 9, n)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("clusters", [2, 3, 8, 16])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_similarity_that_most_cells_are_for(seed, clusters, known):
    layout, s, shift, at, cluster, cells = some_blobs(np.random.default_rng(seed), clusters)
    scale = 1.01 * s if known else 0j
    got = _kernels.best_similarity((at, cluster, cells), len(at), layout, 0.06, 1.0, 1.0, scale)
    assert got[0] == pytest.approx(twins.score(at, cluster, cells, layout, *got[1:], abs(got[1]) * 0.03 + 1))
    assert got[0] == pytest.approx(
        twins.best_similarity(at, cluster, cells, len(at), layout, 0.06, 1.0, 1.0, scale)
    )
    refined = _kernels.refined_similarity((at, cluster, cells), layout, 0.06, 1.0, scale, s, shift)
    want = twins.refined_similarity(at, cluster, cells, layout, 0.06, 1.0, scale, s, shift)
    assert_allclose(refined, want, rtol=1e-9)


@pytest.mark.parametrize("grid", [1, 2, 3])
@pytest.mark.parametrize("line", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_mask_is_the_layout_s_footprint(seed, line, grid):
    rng = np.random.default_rng(seed)
    unit, spacing = np.exp(1j * rng.uniform(0, 2 * np.pi)), rng.uniform(1.5, 9)
    shape = (5, 40 // grid, 30 // grid)
    layout = Layout(np.arange(5) - rng.uniform(1, 3) + 0j, 1.0, line, 1 + 0j)
    seen = rng.random(5) < 0.8
    seen[2] = True
    placement = Placement(unit * spacing, 15.3 + 20.2j, False, seen, 5.0, 0.0)
    places = placement.places(layout)
    probability, pixels = rng.random(shape).astype(np.float32), rng.random((5, 40, 30)).astype(np.float32)
    selected = rng.random(shape) < 0.5
    found = masked(PresenceMap(probability, grid, selected, pixels), layout, placement)
    across = spacing
    if line:
        bins = math.ceil(spacing + _WIDEST_PX)
        hits, cells = twins.across_profile(probability, seen, places, unit, spacing, grid, bins)
        profile = twins.core_profile(hits, cells, 0.5)
        across = len(profile)
        want = twins.line_prior(shape, places, unit, spacing, grid, profile)
    else:
        want = twins.block_prior(shape, places, unit, spacing, grid)
    assert_allclose(found.prior, want, rtol=1e-4, atol=1e-5)
    assert_array_equal(found.probability, np.where(found.prior > 0, probability, 0))
    assert_array_equal(found.selected, selected & (found.prior > 0))
    assert_allclose(found.pixels, twins.copy_near(pixels, places, unit, spacing, across))


@pytest.mark.parametrize("seed", SEEDS)
def test_the_mean_length_of_a_leaning_bar(seed):
    rng = np.random.default_rng(seed)
    sine, likely, along, across = np.sin(rng.uniform(-0.1, 0.1, 50)), rng.random(50), -0.04, 0.05
    for seen, chance in (
        (0.03, likely * stats.norm.pdf(sine, 0.03, 0.02)),
        (math.nan, likely),
        # What no lean explains says nothing.
        (9.0, likely),
    ):
        length = np.sqrt(1 - sine**2 * (1 + across**2)) + along * sine
        mean = np.average(length, weights=chance)
        spread = np.average((length - mean) ** 2, weights=chance)
        found = _kernels.mean_length(sine, likely, seen, 0.02 if seen != 9 else 0.01, along, across)
        assert found == pytest.approx((mean, spread), rel=1e-6)


@pytest.mark.parametrize(("grid", "every"), [(1, 2), (2, 2), (2, 1)])
@pytest.mark.parametrize("seed", SEEDS)
def test_light_in_step_with_the_pilot(seed, grid, every):
    rng = np.random.default_rng(seed)
    codes = rng.choice([-1, 1], (5, 8)) if every == 2 else rng.integers(-1, 2, (5, 15))
    sums = rng.integers(-2, 3, (16, 12, 9)).astype(np.int16)
    prior = np.where(rng.random((5, 12 // grid, 9 // grid)) < 0.3, rng.random(), 0).astype(np.float32)
    prior[2] = 0
    out, seen, lit = np.empty(5), rng.random(5) < 0.7, np.empty(5, np.bool_)
    assert not _kernels.pilot_light(sums, codes, every, prior, grid, seen, 0.75, (out, lit))
    usual = np.median(out[seen]) if seen.any() else 0.0
    assert_array_equal(lit, out >= max(0.75 * usual, 1e-9))
    assert_allclose(out, twins.pilot_light(sums, codes, every, prior, grid), rtol=1e-6, atol=1e-9)
    assert out[2] == 0


@pytest.mark.parametrize(("turn", "every"), [(1j, 2), (1, 2), (np.exp(1.4j), 2), (1j, 1)])
@pytest.mark.parametrize("seed", SEEDS)
def test_answers_between_and_across_clusters(seed, turn, every):
    rng = np.random.default_rng(seed)
    chips = chips_of_values(rng.choice([-1, 1], (4, 8))) if every == 2 else rng.integers(0, 2, (4, 16))
    codes = chips.astype(np.int64)
    sums = rng.integers(-2, 3, (16, 26, 24)).astype(np.int16)
    # One cluster lies beyond the image.
    places = 11.3 + 9.1j + turn * np.array([-4.2, 0.9, 6.1, 17.0])
    seen, pairs = np.array([True, seed != SEEDS[0], True, True]), np.array([[0, 1], [1, 0], [1, 2], [2, 3]])
    between, across = np.zeros((2, 2, 3), int), np.zeros((2, 11), int)
    _kernels.spread_between(sums, codes, places, seen, pairs, (0.8, 0.2, 0.75), between)
    assert_array_equal(between, twins.spread_between(sums, codes, places, seen, pairs, 0.8, 0.2, 0.75))
    _kernels.spread_across(sums, codes, every, places, seen, turn, 1.3, across)
    assert_array_equal(across, twins.spread_across(sums, codes, every, places, seen, turn, 1.3, 5))


@pytest.mark.parametrize("seed", SEEDS)
def test_boundaries_are_where_lines_balance(seed) -> None:
    """Each line's light is shared out as a boundary between two centres cuts it, however bright it is."""
    rng = np.random.default_rng(seed)
    start, end, share = *rng.permutation([rng.uniform(0, 4), rng.uniform(7, 11)]), rng.uniform(0.2, 0.8)
    at, bright = start + share * (end - start), rng.uniform(0.5, 2, 12)
    mine = bright * np.clip((at - np.arange(12)) * np.sign(end - start) + 0.5, 0, 1)
    assert _kernels.boundary_between(mine, bright - mine, start, end) == pytest.approx(share)
    # Most of the lines are dark, or beyond the image; a reflection beside a bar brings two centres together.
    dark = np.where(abs(np.arange(12) - at) < 1, mine, 0)
    assert np.isnan(_kernels.boundary_between(dark, dark, start, end))
    assert np.isnan(_kernels.boundary_between(mine, bright - mine, 9.0, 20.0))
    assert all(
        np.isnan(_kernels.boundary_between(mine, mine, 4.0, 4.0 + apart)) for apart in (0.0, 0.5, -0.9)
    )


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("turn", [1j, -1j, 1.0, np.exp(1.2j), -np.exp(0.5j)])
def test_light_along_a_way(seed, turn) -> None:
    rng = np.random.default_rng(seed)
    code = rng.choice([-1, 0, 1], 7)
    code[0] = 1
    heard = rng.integers(-4, 8, (8, HEIGHT, WIDTH)).astype(np.int16)
    heard[1:] *= code[:, None, None].astype(np.int16)
    given = heard, code, 2, complex(11.2, 7.6), complex(turn), 6.3, 3.7
    found = np.full(HEIGHT if abs(np.imag(turn)) >= abs(np.real(turn)) else WIDTH, np.nan)
    assert _kernels.light_along(*given, found)
    assert_allclose(found, twins.light_along(*given), atol=1e-9)
    dark = np.broadcast_to(-code[:, None, None], (7, HEIGHT, WIDTH)).astype(np.int16)
    assert not _kernels.light_along(np.concatenate([heard[:1], dark]), *given[1:], found)


@pytest.mark.parametrize("grid", [1, 2])
@pytest.mark.parametrize("seed", SEEDS)
def test_events_in_pilot_and_info(seed, grid):
    rng = np.random.default_rng(seed)
    sums = (rng.integers(-2, 3, (20, 11, 9)) * (rng.random((20, 11, 9)) < 0.4)).astype(np.int16)
    weight = rng.random((3, 11 // grid, 9 // grid)).astype(np.float32)
    seen, out = np.array([True, True, False]), np.empty(3, np.bool_)
    weight[:, :, : grid // 2 + 1] = 0
    sums[12:] *= rng.random((8, 11, 9)) < 0.25
    got = _kernels.still_lit(sums, weight, grid, 12, 0.25, seen, out)
    over, *want = twins.info_activity(sums, weight, grid, 12, 0.25)
    assert_array_equal(out, seen & (over > 0))
    assert_allclose(got, want, rtol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 0.3, 20.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_llrs_are_scaled_to_tell_the_truth(seed, scale):
    rng = np.random.default_rng(seed)
    llr = (scale * rng.normal(0.5, 1, (6, 4))).astype(np.float32)
    read, seen = rng.integers(-1, 16, 6), rng.random(6) < 0.8
    symbols, scaled = np.empty_like(read), np.empty_like(llr)
    quality = _kernels.calibrate_llr(read, llr, seen, (12.0, 6.0, 0.5), (0.6, 1.7), symbols, scaled)
    want_symbols, want, want_quality = twins.calibrate_llr(read, llr, seen, 12.0, 6.0, 0.5, 0.6, 1.7)
    assert_array_equal(symbols, want_symbols)
    assert_allclose(scaled, want, rtol=1e-5)
    assert quality == pytest.approx(want_quality, rel=1e-5)


@pytest.mark.parametrize("n", [1, 2, 3, 60])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_newest_value_by_all(seed, n):
    rng = np.random.default_rng(seed)
    past = np.stack([np.sort(rng.uniform(0, 0.3, n)), rng.normal(50, 1, n), rng.uniform(1e-4, 1e-2, n)], 1)
    past[:, 1] += rng.choice([0, 5], n, p=[0.9, 0.1])
    got = _kernels.newest_on_parabola(past, 20.0**-2, 3.0**-2, 8.0, 16.0)
    assert_allclose(got, twins.newest_on_parabola(past, 20.0**-2, 3.0**-2, 8.0, 16.0), rtol=1e-7)


@pytest.mark.parametrize("n", [6, 8, 15])
@pytest.mark.parametrize("seed", SEEDS)
def test_bend_of_boundaries(seed, n):
    rng = np.random.default_rng(seed)
    place, weight = np.arange(n) - (n - 1) / 2, rng.uniform(50, 100, n)
    off = 0.01 * place**2 + 0.3 - 0.02 * place + rng.normal(0, 0.1, n)
    if n > 8:
        weight[3] = 1.0
    wave = np.sin(7 * place)
    sums = np.stack([weight, weight * (off + 0.2 * wave), weight * wave])
    for height in ((0.0, 0.0), (0.2, 0.01)):
        got = _kernels.bend_of(place, sums, 0.1, *height)
        assert_allclose(got, twins.bend_of(place, sums, 0.1, *height), rtol=1e-6)
    assert np.isnan(_kernels.bend_of(place[:5], sums[:, :5], 0.1, 0.0, 0.0)).all()


@pytest.mark.parametrize("n", [4, 8, 15])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_wave_in_boundaries(seed, n):
    rng = np.random.default_rng(seed)
    place, weight = np.arange(n) - (n - 1) / 2, rng.uniform(50, 100, n)
    if n > 8:
        weight[3] = 1.0
    off, wave = rng.normal(0, 1, (2, n))
    out = np.array([1.0, 2.0, 3.0, 4.0])
    sums = np.stack([weight, weight * off, weight * wave])
    total, before, seen = sums + rng.uniform(1, 2, (3, n)), rng.normal(0, 1, n), np.empty(n)
    before[0] = np.nan
    got = _kernels.wave_of(place, sums, 0.1, out, (total, before), seen)
    assert_allclose(got, twins.scatter_of(off, weight, 0.1, total, before), rtol=1e-9)
    assert_allclose(seen, np.where(weight > 1, off, np.nan))
    assert_allclose(out - [1, 2, 3, 4], twins.wave_of(place, off, weight, wave, 0.1), rtol=1e-6)
    few = sums[:, :3], total[:, :3]
    got = _kernels.wave_of(place[:3], few[0], 0.1, kept := out.copy(), (few[1], np.empty(0)), seen)
    assert_allclose(got, twins.scatter_of(off[:3], weight[:3], 0.1, few[1], ()), rtol=1e-9)
    assert_allclose(kept, out)


@pytest.mark.parametrize("grid", [1, 2, 3])
@pytest.mark.parametrize("seed", SEEDS)
def test_cells_beside_a_line(seed, grid):
    rng = np.random.default_rng(seed)
    selected = rng.random((4, 9, 7)) < 0.1
    on, turn = complex(*rng.uniform(0, 9, 2)), np.exp(1j * rng.uniform(0, 6))
    assert _kernels.farthest_off(selected, grid, on, turn) == pytest.approx(
        twins.farthest_off(selected, grid, on, turn)
    )
    assert _kernels.farthest_off(np.zeros_like(selected), grid, on, turn) == 0


@pytest.mark.parametrize("clusters", [2, 8])
@pytest.mark.parametrize("seed", SEEDS)
def test_cells_in_and_out_of_place(seed, clusters):
    rng = np.random.default_rng(seed)
    layout, s, shift, at, cluster, cells = some_blobs(rng, clusters)
    places, gap = s * layout + shift, abs(s) * 0.06
    seen = np.empty(clusters, np.bool_)
    found = _kernels.cells_by_place(at, cluster, cells, places, gap / 2 + 1, gap / 2, seen)
    right, wrong = twins.cells_by_place(at, cluster, cells, places, gap / 2 + 1, gap / 2)
    assert_array_equal(seen, right > wrong)
    left = np.abs(at[:, None] - places).min(1) > gap / 2 + 1
    assert found == (np.count_nonzero(right + wrong), seen.sum(), right[seen].sum(), cells[left].sum())


@pytest.mark.parametrize("box", [(0, 0, 24, 16), (3, 5, 9, 6), (4, 4, 8, 8), (20, 8, 40, 30)])
def test_cells_that_boxes_touch_are_cleared(box):
    hits = np.random.default_rng(0).integers(1, 9, (4, 6)).astype(np.int16)
    left, top, right, bottom = box
    v, u = np.mgrid[:4, :6]
    inside = (4 * v < bottom) & (4 * v + 4 > top) & (4 * u < right) & (4 * u + 4 > left)
    inside |= (u == 5) & (v == 0)
    had, want = int(hits[inside].sum()), np.where(inside, 0, hits)
    assert _kernels.clear_cells(hits, np.array([box, (20, 0, 21, 1)]), 2) == had
    assert_array_equal(hits, want)


@pytest.mark.parametrize("n", [1, 2, 5])
@pytest.mark.parametrize("seed", SEEDS)
def test_places_are_interpolated_and_go_straight_on(seed, n):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.choice(1000, n, replace=False)).astype(float)
    places = np.concatenate([t[None], rng.uniform(0, 700, (4, n))])
    asked = np.sort(np.concatenate([rng.uniform(-3000, 4000, 20), t]))
    if seed % 2:
        rng.shuffle(asked)
    centre = np.empty((2, len(asked)))
    _kernels.places_at((asked - 40) / 4, 40.0, 4.0, places, 2, centre)
    way = places[:3]
    if n > 1:
        before, after = way[:, 0] - 2 * (way[:, 1] - way[:, 0]), way[:, -1] + 2 * (way[:, -1] - way[:, -2])
        way = np.column_stack([before, way, after])
    for axis in range(2):
        assert_allclose(centre[axis], np.interp(asked, way[0], way[axis + 1]), rtol=1e-12)


def test_rows_that_are_not_dark():
    image = np.zeros((7, 5), np.float32)
    assert _kernels.rows_of(image) == (0, 0)
    image[2, 4] = image[5, 0] = 0.5
    assert _kernels.rows_of(image) == (2, 6)


@pytest.mark.parametrize("turn", [1j, 1.0, np.exp(1.2j), np.exp(0.5j)])
def test_the_middle_across_a_line_of_light_and_its_profile(turn) -> None:
    """A bell of light about the line through (11.3, 7.8), which edges switch; looked at from beside it."""
    edges, found = np.array([1, -1, 0, 1]), np.zeros(WIDTH)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    light = 2000 * np.exp(-((((columns - 11.3 + 1j * (rows - 7.8)) * np.conj(turn)).imag / 1.5) ** 2) / 2)
    heard = np.concatenate([np.full((1, HEIGHT, WIDTH), 99), edges[:, None, None] * light]).astype(np.int16)
    off = _kernels.middle_across(heard, edges, 11.0, 7.5, complex(turn), 5.0, 6.0, found)
    assert off == pytest.approx((complex(0.3, 0.3) * np.conj(turn)).imag, abs=0.02)
    near = abs(((columns - 11.0 + 1j * (rows - 7.5)) * np.conj(turn)).real) <= 5
    # Steps up and steps down say it once each.
    summed = (2 * light * near).sum(0 if abs(turn.imag) >= abs(turn.real) else 1)
    assert_allclose(found[: len(summed)], summed, rtol=2e-3, atol=30)


def test_flanks_are_as_wide_as_they_are() -> None:
    """In the mean over places within pixels; above seven tenths of the most they are not counted."""
    columns, widths = np.arange(20), (1.0, 2.0, 3.5)
    for width in widths:
        found = [
            _kernels.flank_px(np.clip((5 - abs(columns - 9 - place)) / width + 0.5, 0, 1))
            for place in np.linspace(0, 1, 200, endpoint=False)
        ]
        assert np.mean(found) == pytest.approx(0.7 * width, rel=1e-3)
    assert math.isnan(_kernels.flank_px(np.zeros(5)))
