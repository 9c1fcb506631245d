"""Chip-aligned polarity sums: the laws of the public function."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import rx_twins as twins
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from evlcp_sdk.rx.alignment import polarity_sums
from evlcp_sdk.values import Events, SyncLock

CHIPS, SIZE = 12, (8, 14)
LOCK = SyncLock(packet_t_us=0, chip_us=100.25, delay_on_us=-20.5, delay_off_us=33.75, quality=1)
STILL = np.repeat([[103.5], [206.5]], CHIPS, axis=1)


def stream(seed, n=4000):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(900, 2500, n))
    return Events.of(t, rng.integers(98, 110, n), rng.integers(198, 216, n), rng.integers(0, 2, n))


def one(t_us, p, x=103, y=206):
    return Events.of([t_us], [x], [y], [p])


@pytest.mark.parametrize("seed", range(4))
def test_a_moving_bar_is_held_in_the_middle(seed):
    rng = np.random.default_rng(seed)
    centre = np.array([[104], [207]]) + rng.uniform(-5, 5, (2, CHIPS))
    events = stream(seed)
    sums, offset = polarity_sums([events], LOCK, 1000.0, centre, SIZE)
    assert np.abs(offset).max() <= 0.5
    # Column 0 of the image is this column of the sensor.
    left, top = (c - o - (n - 1) / 2 for c, o, n in zip(centre, offset, SIZE, strict=True))
    assert_allclose(np.rint([left, top]), [left, top], atol=1e-9)
    shape = (CHIPS, SIZE[1], SIZE[0])
    shifts = (np.rint(s).astype(int) for s in (left, top))
    want = twins.polarity_sums(events, 1000 - 20.5, 1000 + 33.75, LOCK.chip_us, *shifts, shape)
    assert_array_equal(sums, want)
    assert sums.dtype == np.int16


def test_a_blob_that_moves_stays_where_it_is():
    x = 50 + 3 * np.arange(CHIPS)
    t = 1000 + 100 * np.arange(CHIPS) + 50
    lock = SyncLock(0, 100.0, 0.0, 0.0, 1)
    sums, offset = polarity_sums(
        [Events.of(t, x + 2, x - 3, x > 0)], lock, 1000.0, np.stack([x, x]) + 0.5, SIZE
    )
    # The middle of the image is between its pixels 3 and 4, 6 and 7.
    assert_array_equal(np.argwhere(sums), [[c, 6 - 3, 3 + 2] for c in range(CHIPS)])
    assert_array_equal(offset, np.zeros((2, CHIPS)))


@settings(max_examples=40)
@given(st.lists(st.integers(0, 4000), max_size=12))
def test_any_split_of_the_stream_gives_the_same(cuts):
    events = stream(0)
    whole, _ = polarity_sums([events], LOCK, 1000.0, STILL, SIZE)
    bounds = [0, *sorted(cuts), len(events)]
    pieces = [events[a:b] for a, b in pairwise(bounds)]
    assert_array_equal(polarity_sums(iter(pieces), LOCK, 1000.0, STILL, SIZE)[0], whole)


@pytest.mark.parametrize(("p", "delay_us"), [(1, -20.5), (0, 33.75)])
def test_each_polarity_has_its_own_first_and_last_chip(p, delay_us):
    first = 1000 + delay_us
    end = first + CHIPS * LOCK.chip_us
    for t, chip in [
        (np.ceil(first) - 1, None),
        (np.ceil(first), 0),
        (np.ceil(end) - 1, CHIPS - 1),
        (np.ceil(end), None),
    ]:
        sums, _ = polarity_sums([one(int(t), p)], LOCK, 1000.0, STILL, SIZE)
        want = [] if chip is None else [[chip, 6, 3]]
        assert np.argwhere(sums).tolist() == want, f"event at {t}"
        assert sums.sum() == (0 if chip is None else 2 * p - 1)


@pytest.mark.parametrize("row_us", [-2.0, 2.0])
def test_rows_further_down_are_read_later(row_us):
    lock = replace(LOCK, row_us=row_us)
    for y in (200, 206, 213):
        edge = 1000 + LOCK.delay_on_us + row_us * (y - 206.5) + 3 * LOCK.chip_us
        for t, chip in [(np.ceil(edge) - 1, 2), (np.ceil(edge), 3)]:
            sums, _ = polarity_sums([one(int(t), 1, y=y)], lock, 1000.0, STILL, SIZE)
            assert np.argwhere(sums).tolist() == [[chip, y - 200, 3]]


@pytest.mark.parametrize(
    ("x", "y", "inside"),
    [(100, 200, 1), (107, 213, 1), (99, 205, 0), (108, 205, 0), (103, 199, 0), (103, 214, 0)],
)
def test_events_beyond_the_image_are_left_out(x, y, inside):
    assert polarity_sums([one(1200, 1, x, y)], LOCK, 1000.0, STILL, SIZE)[0].sum() == inside


def test_no_events_are_no_sums():
    for pieces in ([], [Events.empty()], [Events.empty(), one(10**9, 1), one(10**9, 0)]):
        sums, offset = polarity_sums(pieces, LOCK, 1000.0, STILL, SIZE)
        assert sums.shape == (CHIPS, SIZE[1], SIZE[0])
        assert offset.shape == (2, CHIPS)
        assert not sums.any()


def test_strided_and_read_only_events_are_taken():
    events = stream(1)
    columns = [np.repeat(c, 3) for c in (events.t_us, events.x, events.y, events.p)]
    for c in columns:
        c.setflags(write=False)
    want, _ = polarity_sums([events], LOCK, 1000.0, STILL, SIZE)
    got, _ = polarity_sums([Events(*columns)[::3]], LOCK, 1000.0, STILL, SIZE)
    assert_array_equal(got, want)
