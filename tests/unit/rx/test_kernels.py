"""Compiled loops of the receiver against what is written out by hand."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from evlcp_sdk import _kernels as shared_kernels
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.rhythm import BlinkDetector
from evlcp_sdk.values import Events

WIDTH, HEIGHT = 24, 16
SEEDS = range(5)


def states(rose_us, time, score, same=0):
    """Pixels of these last rises, us, numbers of the times before, scores, and how often the same again."""
    clock = np.asarray(rose_us) % _kernels.CLOCK_TICKS << _kernels.CLOCK_BIT
    again = np.asarray(same) << _kernels.REPEATS_BIT
    return (clock | again | np.asarray(time) << _kernels.TIME_BIT | score).astype(np.uint32)


def rhythm_of(pixels, chip_us=100.0, min_score=8):
    rhythm = BlinkDetector(WIDTH, HEIGHT, chip_us, min_score)
    rhythm._pixels, rhythm._now = pixels, 0
    return rhythm


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
    start_us, pixels = 5_000_000_000_000, np.zeros((HEIGHT, WIDTH), np.uint32)
    for chips, score in ((2, 2), (4.2, 2), (5, 1), (7, -2), (7.5, -3), (12, 1), (14, -1)):
        rhythm = rhythm_of(pixels, chip_us)
        rhythm._now = start_us >> rhythm._shift
        pixels[:] = states(rhythm._now, 9, 10)
        rise = Events.of([start_us + round(chips * chip_us)], [3], [2], [1])
        rhythm.step(start_us, rise, np.zeros((4, 6), np.int16), 2)
        assert pixels[2, 3] & _kernels.SCORE_MASK == 10 + score, chips


def test_a_bar_is_measured_beside_light_that_is_everywhere():
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


@pytest.mark.parametrize("n", [0, 1, 500])
def test_events_in_boxes(n):
    rng = np.random.default_rng(n)
    score, same = rng.integers(0, 41, (HEIGHT, WIDTH)), rng.integers(0, 32)
    times = 1000 + rng.integers(0, 4, n).cumsum()
    events = Events.of(times, *(rng.integers(0, most, n) for most in (WIDTH, HEIGHT, 2)))
    in_rhythm = ((score >= 20) & (same < 14))[events.y, events.x]
    rhythm = rhythm_of(states(np.zeros(score.shape, int), 0, score, same), min_score=20)
    boxes = [(0, 0, WIDTH, HEIGHT), (0, 0, 1, 1), (3, 2, 17, 9), (10, 5, WIDTH, HEIGHT), (4, 4, 4, 9)]
    # One by one, some that overlap, and more than one pass takes.
    for given in [*([box] for box in boxes), boxes, [*boxes, *boxes]]:
        rhythmic = (rng.random(len(given)) < 0.5).tolist()
        taken = rhythm.select(events, given, rhythmic)
        for got, box, filtered in zip(taken, given, rhythmic, strict=True):
            left, top, right, bottom = box
            want = events[in_rhythm] if filtered else events
            want = want[(want.x >= left) & (want.x < right) & (want.y >= top) & (want.y < bottom)]
            for name in ("t_us", "x", "y", "p"):
                assert_array_equal(getattr(got, name), getattr(want, name))


@pytest.mark.parametrize("seed", SEEDS)
def test_boundaries_are_where_lines_balance(seed):
    """Each line's light is shared out as a boundary between two centres cuts it, however bright it is."""
    rng = np.random.default_rng(seed)
    start, end, share = *rng.permutation([rng.uniform(0, 4), rng.uniform(7, 11)]), rng.uniform(0.2, 0.8)
    at, bright = start + share * (end - start), rng.uniform(0.5, 2, 12)
    mine = bright * np.clip((at - np.arange(12)) * np.sign(end - start) + 0.5, 0, 1)
    assert _kernels.find_boundary(mine, bright - mine, start, end) == pytest.approx(share)
    # Most of the lines are dark, or beyond the image; a reflection beside a bar brings two centres together.
    dark = np.where(abs(np.arange(12) - at) < 1, mine, 0)
    assert np.isnan(_kernels.find_boundary(dark, dark, start, end))
    assert np.isnan(_kernels.find_boundary(mine, bright - mine, 9.0, 20.0))
    assert all(np.isnan(_kernels.find_boundary(mine, mine, 4.0, 4.0 + apart)) for apart in (0.0, 0.5, -0.9))


@pytest.mark.parametrize("turn", [1j, 1.0, np.exp(1.2j), np.exp(0.5j)])
def test_the_middle_across_a_line_of_light_and_its_profile(turn):
    """A bell of light about the line through (11.3, 7.8), which edges switch; looked at from beside it."""
    edges, found = np.array([1, -1, 0, 1]), np.zeros(WIDTH)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    light = 2000 * np.exp(-((((columns - 11.3 + 1j * (rows - 7.8)) * np.conj(turn)).imag / 1.5) ** 2) / 2)
    sums = np.concatenate([np.full((1, HEIGHT, WIDTH), 99), edges[:, None, None] * light]).astype(np.int16)
    off = _kernels.find_offset_across(sums, edges, 11.0, 7.5, complex(turn), 5.0, 6.0, found)
    assert off == pytest.approx((complex(0.3, 0.3) * np.conj(turn)).imag, abs=0.02)
    near = abs(((columns - 11.0 + 1j * (rows - 7.5)) * np.conj(turn)).real) <= 5
    # Steps up and steps down say it once each.
    summed = (2 * light * near).sum(0 if abs(turn.imag) >= abs(turn.real) else 1)
    assert_allclose(found[: len(summed)], summed, rtol=2e-3, atol=30)


def test_flanks_are_as_wide_as_they_are():
    """In the mean over places within pixels; above seven tenths of the most they are not counted."""
    columns, widths = np.arange(20), (1.0, 2.0, 3.5)
    for width in widths:
        found = [
            _kernels.flank_width_px(np.clip((5 - abs(columns - 9 - place)) / width + 0.5, 0, 1))
            for place in np.linspace(0, 1, 200, endpoint=False)
        ]
        assert np.mean(found) == pytest.approx(0.7 * width, rel=1e-3)
    assert math.isnan(_kernels.flank_width_px(np.zeros(5)))


@pytest.mark.parametrize("n", [1, 2, 3, 8, 63, 64])
def test_the_median_is_that_of_numpy(n):
    rng = np.random.default_rng(n)
    spread, alike = rng.normal(size=80), rng.integers(0, 4, 80).astype(float)
    for values in (spread, alike, np.sort(spread), np.sort(alike)[::-1].copy(), np.ones(80)):
        before = values.copy()
        assert shared_kernels.median(values, n) == np.median(values[:n])
        assert (values == before).all()
