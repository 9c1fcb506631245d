"""Compiled loops of the receiver against twins and closed forms."""

import math

import numpy as np
import pytest
import rx_twins as twins
from numpy.testing import assert_allclose, assert_array_equal

from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.regions import Rhythm
from evlcp_sdk.testing.recordings import merged
from evlcp_sdk.values import Events

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
