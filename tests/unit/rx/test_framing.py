"""Packet grids against a walk through the chips on air; delays by row; sums by chips of what is seen."""

from itertools import takewhile

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from rx_streams import LINK, frames_of, lit, noise_events, receive_cut

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.rx.alignment import polarity_sums
from evlcp_sdk.rx.transmitters import PacketGrid, RowDelay, measure_row_delay
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, merge_events, random_symbols
from evlcp_sdk.values import Events, SyncLock

CHIP_US, ZERO_US = 100.5, 1234.5
FORMATS = [
    PacketFormat(frames=4),
    PacketFormat(frames=5, pilot_every=2),
    PacketFormat(preamble_chips=10, pilot_chips=8, info_chips=32, frames=1),
    PacketFormat(frames=7, pilot_every=64),
]


def on_air(form, packets):
    """(packet, frame, start and end, us) of every frame, chip after chip from `ZERO_US` on."""
    found, chip = [], 0
    for packet in range(packets):
        chip += form.preamble_chips
        for frame in range(form.frames):
            chips = form.info_chips + (form.pilot_chips if frame % form.pilot_every == 0 else 0)
            found.append((packet, frame, ZERO_US + chip * CHIP_US, ZERO_US + (chip + chips) * CHIP_US))
            chip += chips
    return found


def lock_of(form, packet, late_us=0.0, delay_us=-20.0):
    start_us = ZERO_US + packet * form.packet_chips * CHIP_US + late_us
    return SyncLock(start_us, CHIP_US, delay_us, delay_us - 10, 1.0)


def due_until(grid, until_us):
    found = []
    while (due := grid.next_due(until_us)) is not None:
        grid.go_to(due.number + 1)
        found.append(due)
    return found


@pytest.mark.parametrize("form", FORMATS)
@given(st.integers(0, 3), st.floats(0, 40_000), st.floats(0, 60_000))
def test_frames_are_due_as_they_are_on_air(form, heard, earliest_us, until_us):
    grid = PacketGrid(form)
    grid.restart(lock_of(form, heard), earliest_us)
    found = due_until(grid, until_us)
    sent = on_air(form, 60)
    assume(all(abs(f[2] - earliest_us) > 1e-3 and abs(f[3] - until_us) > 1e-3 for f in sent))
    want = list(takewhile(lambda f: f[3] <= until_us, (f for f in sent if f[2] >= earliest_us)))
    for due, (packet, index, *frame_us) in zip(found, want, strict=True):
        packet_us = ZERO_US + packet * form.packet_chips * CHIP_US
        assert (due.packet_us, due.start_us, due.end_us) == pytest.approx((packet_us, *frame_us), abs=1e-6)
        assert due.index == index
        assert due.number == due.packet * form.frames + index
        assert due.has_pilot == (index % form.pilot_every == 0)
        # Every packet has its own number, counted up.
        assert due.packet - found[0].packet == packet - want[0][0]
    assert [d.number for d in found] == list(range(grid.frame - len(found), grid.frame))


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("after", [0, 1])
def test_the_events_after_the_last_edge_are_waited_for(form, after):
    """And the chips after it that are read with it."""
    grid = PacketGrid(form, trailing_chips=after)
    assert grid.next is None
    grid.restart(lock_of(form, 0, delay_us=35.0), ZERO_US)
    _, _, start_us, end_us = on_air(form, 1)[0]
    read_us = end_us + 35 + after * CHIP_US
    assert grid.next_due(read_us - 1) is None
    due = grid.next_due(read_us + 1)
    assert due is grid.next
    assert (due.start_us, due.end_us, due.read_us) == pytest.approx((start_us, end_us + 35, read_us))


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("late_us", [-90.0, 0.0, 90.0, -110.0, 110.0, 1500.0])
def test_a_lock_near_the_grid_moves_it_and_another_begins_anew(form, late_us):
    """A lock off the grid begins another."""
    grid, lock = PacketGrid(form), lock_of(form, 3, late_us)
    assert not grid.accept_lock(lock)
    grid.restart(lock_of(form, 0), ZERO_US)
    done = due_until(grid, on_air(form, 1)[-1][3] + 1)
    before_us = grid.start_us(grid.frame)
    near = abs(late_us) < CHIP_US
    assert grid.accept_lock(lock) == near
    if not near:
        assert grid.start_us(grid.frame) == before_us
        grid.restart(lock, before_us)
    after = due_until(grid, on_air(form, 6)[-1][3])
    sent_us = [f[2] + late_us for f in on_air(form, 7)]
    assert all(min(abs(due.start_us - us) for us in sent_us) < 1e-6 for due in after)
    if near:
        assert after[0].number == done[-1].number + 1
        assert after[0].start_us == pytest.approx(sent_us[form.frames])
    else:
        assert after[0].start_us >= before_us - 1e-6
        assert after[0].packet in (0, 1)


PREAMBLE = LINK.codebook.preamble * 2.0 - 1
BAR, EVENTS = lit(2, cluster_px=12.0)
HEIGHT_PX = 16 * 12.0
# Events of a rising edge come 20 to 44 us late, of a falling one 40 to 64: the windows' middles are there.
BAR_LOCK = SyncLock(BAR.start_us, 100.0, 32.0 - 50.0, 52.0 - 50.0, 0.9)


def read_late(events, row_us, centre_px=BAR.y_px):
    """The events of a bar whose rows are read one after another."""
    t_us = np.rint(events.t_us + row_us * (events.y.astype(float) - centre_px)).astype(np.int64)
    return Events.of(t_us, events.x, events.y, events.p)[np.argsort(t_us, kind="stable")]


def measure(events, height_px=HEIGHT_PX):
    return measure_row_delay(PREAMBLE, BAR_LOCK, [(0, events)], BAR.y_px, height_px)


@pytest.mark.parametrize("row_us", [-0.3, 0.0, 0.1, 0.5])
def test_rows_that_are_read_late(row_us):
    got, sigma = measure(read_late(EVENTS, row_us))
    assert got == pytest.approx(row_us, abs=max(0.01, 3 * sigma))
    assert sigma < 0.01


def test_hidden_rows_and_noise_are_outliers():
    events = read_late(EVENTS, 0.2)
    hidden = (events.y > 300) & (events.y < 350)
    early = (events.y > 400) & (events.y < 425)
    moved = Events.of(events.t_us - 60 * early, events.x, events.y, events.p)[~hidden]
    noisy = merge_events(moved, noise_events(2e6, 90_000))
    assert measure(noisy)[0] == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("events", [Events.empty(), EVENTS[:3], noise_events(1e8, 30_000)])
def test_nothing_to_see_is_nothing_known(events):
    assert np.isnan(measure(events)).all()
    # A small bar has no rows to tell apart.
    assert np.isnan(measure(EVENTS, 20.0)[0])


def test_packets_are_averaged_and_changes_followed():
    rng, known = np.random.default_rng(1), RowDelay()
    for row_us, within in ((0.2, 0.03), (0.1, 0.04)):
        for _ in range(30):
            known = known.update(row_us + rng.normal(0, 0.03), 0.03)
        assert known.row_us == pytest.approx(row_us, abs=within)
        assert known.variance < 0.03**2


@pytest.mark.parametrize("row_us", [-0.25, 0.25])
def test_the_receiver_reads_a_bar_whose_ends_are_a_chip_apart(row_us):
    bar = IdealBar(random_symbols(LINK, 4), cluster_px=26.0, y_px=360.2, shake_px=6)
    events = read_late(ideal_events(LINK, bar, events_per_edge=2), row_us, bar.y_px)
    frames = frames_of(receive_cut(LINK, events)[1])
    assert len(frames) >= 30
    number = np.array([f.t_us - bar.start_us for f in frames]) / 100.0
    packet = (number // LINK.packet.packet_chips).astype(int)
    wrong = bar.symbols[packet, [f.frame for f in frames]] != [f.soft.symbols for f in frames]
    assert wrong.mean() < 0.002


CHIPS, SIZE = 12, (8, 14)
LOCK = SyncLock(packet_t_us=0, chip_us=100.25, delay_on_us=-20.5, delay_off_us=33.75, quality=1)


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
