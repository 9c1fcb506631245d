"""Chip-aligned polarity sums: the laws of the public function."""

import numpy as np
import pytest
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


def plain_sums(events, start_on_us, start_off_us, chip_us, shift_x, shift_y, shape):
    sums = np.zeros(shape, np.int16)
    start = np.where(events.p > 0, start_on_us, start_off_us)
    chip = np.floor((events.t_us - start) / chip_us).astype(int)
    inside = (chip >= 0) & (chip < shape[0])
    chip, events = chip[inside], events[inside]
    u, v = events.x.astype(int) - shift_x[chip], events.y.astype(int) - shift_y[chip]
    seen = (u >= 0) & (u < shape[2]) & (v >= 0) & (v < shape[1])
    np.add.at(sums, (chip[seen], v[seen], u[seen]), np.where(events.p[seen] > 0, 1, -1))
    return sums


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
    want = plain_sums(events, 1000 - 20.5, 1000 + 33.75, LOCK.chip_us, *shifts, shape)
    assert_array_equal(sums, want)
    assert sums.dtype == np.int16


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


def test_no_events_are_no_sums():
    for pieces in ([], [Events.empty()], [Events.empty(), one(10**9, 1), one(10**9, 0)]):
        sums, offset = polarity_sums(pieces, LOCK, 1000.0, STILL, SIZE)
        assert sums.shape == (CHIPS, SIZE[1], SIZE[0])
        assert offset.shape == (2, CHIPS)
        assert not sums.any()
