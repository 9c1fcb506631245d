"""The delay by row, on bars whose rows come late by as much as is known."""

import numpy as np
import pytest
import rx_twins as twins
from numpy.testing import assert_array_equal
from rx_streams import LINK, frames_of, received

from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.framing import RowDelay, measure_row_delay
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, merged, noise_events, random_symbols
from evlcp_sdk.values import Events, SyncLock

CHIPS = LINK.codebook.preamble * 2.0 - 1
BAR = IdealBar(random_symbols(LINK, 2), cluster_px=12.0)
HEIGHT_PX = 16 * 12.0
# Events of a rising edge come 20 to 44 us late, of a falling one 40 to 64: the windows' middles are there.
LOCK = SyncLock(BAR.start_us, 100.0, 32.0 - 50.0, 52.0 - 50.0, 0.9)
EVENTS = ideal_events(LINK, BAR)


def read_late(events, row_us, centre_px=BAR.y_px):
    """The events of a bar whose rows are read one after another."""
    t_us = np.rint(events.t_us + row_us * (events.y.astype(float) - centre_px)).astype(np.int64)
    order = np.argsort(t_us, kind="stable")
    return Events.of(t_us[order], events.x[order], events.y[order], events.p[order])


def measured(events, height_px=HEIGHT_PX):
    return measure_row_delay(CHIPS, LOCK, [(0, events)], BAR.y_px, height_px)


@pytest.mark.parametrize("row_us", [-0.3, 0.0, 0.1, 0.5])
def test_rows_that_are_read_late(row_us):
    got, sigma = measured(read_late(EVENTS, row_us))
    assert got == pytest.approx(row_us, abs=max(0.01, 3 * sigma))
    assert sigma < 0.01


def test_one_polarity_is_enough():
    events = read_late(EVENTS, 0.2)
    assert measured(events[events.p == 1])[0] == pytest.approx(0.2, abs=0.01)
    few = events[(events.p == 1) | (np.random.default_rng(0).random(len(events)) < 0.05)]
    assert measured(few)[0] == pytest.approx(0.2, abs=0.01)


def test_hidden_rows_and_noise_are_outliers():
    events = read_late(EVENTS, 0.2)
    hidden = (events.y > 300) & (events.y < 350)
    early = (events.y > 400) & (events.y < 425)
    moved = Events.of(events.t_us - 60 * early, events.x, events.y, events.p)[~hidden]
    noisy = merged(moved, noise_events(2e6, 90_000))
    assert measured(noisy)[0] == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("events", [Events.empty(), EVENTS[:3], noise_events(1e8, 30_000)])
def test_nothing_to_see_is_nothing_known(events):
    assert np.isnan(measured(events)).all()
    # A small bar has no rows to tell apart.
    assert np.isnan(measured(EVENTS, 20.0)[0])


def test_packets_are_averaged_and_changes_followed():
    rng = np.random.default_rng(1)
    known = RowDelay()
    for _ in range(30):
        known = known.measured(0.2 + rng.normal(0, 0.03), 0.03)
    assert known.row_us == pytest.approx(0.2, abs=0.03)
    assert known.variance < 0.03**2
    for _ in range(30):
        known = known.measured(0.1 + rng.normal(0, 0.03), 0.03)
    assert known.row_us == pytest.approx(0.1, abs=0.04)


@pytest.mark.parametrize("seed", range(3))
def test_counts_of_blocks(seed):
    rng = np.random.default_rng(seed)
    n = 3000
    t = np.sort(rng.integers(0, 3000, n))
    y, p = rng.integers(80, 200, n).astype(np.uint16), rng.integers(0, 2, n).astype(np.uint8)
    start, counts = np.array([310.3, 420.7]), np.zeros((2, 9, 130))
    _kernels.count_rows(t, y, p, start, 10.1, 90.5, 8.3, counts)
    assert_array_equal(counts, twins.count_rows(t, y, p, start, 10.1, 90.5, 8.3, counts.shape))
    assert counts.sum() > 100


@pytest.mark.parametrize("row_us", [-0.25, 0.25])
def test_the_receiver_reads_a_bar_whose_ends_are_a_chip_apart(row_us):
    bar = IdealBar(random_symbols(LINK, 4), cluster_px=26.0, y_px=360.2, shake_px=6)
    events = read_late(ideal_events(LINK, bar, events_per_edge=2), row_us, bar.y_px)
    frames = frames_of(received(LINK, events)[1])
    assert len(frames) >= 30
    number = np.array([f.t_us - bar.start_us for f in frames]) / 100.0
    packet = (number // LINK.packet.packet_chips).astype(int)
    wrong = bar.symbols[packet, [f.frame for f in frames]] != [f.soft.symbols for f in frames]
    assert wrong.mean() < 0.002
