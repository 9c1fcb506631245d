"""Packet grids against a walk through the chips on air."""

import math
from itertools import takewhile

import pytest
from hypothesis import assume, given, strategies as st

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.rx.grid import DueFrame, PacketGrid
from evlcp_sdk.values import SyncLock

CHIP_US, ZERO_US = 100.5, 1234.5
FORMATS = [
    PacketFormat(frames=4),
    PacketFormat(frames=5, pilot_every=2),
    PacketFormat(preamble_chips=10, pilot_chips=8, info_chips=32, frames=1),
    PacketFormat(frames=7, pilot_every=64),
]


def on_air(form: PacketFormat, packets: int) -> list[tuple[int, int, float, float]]:
    """(packet, frame, start and end, us) of every frame, chip after chip from `ZERO_US` on."""
    found, chip = [], 0
    for packet in range(packets):
        chip += form.preamble_chips
        for frame in range(form.frames):
            chips = form.info_chips + (form.pilot_chips if frame % form.pilot_every == 0 else 0)
            found.append((packet, frame, ZERO_US + chip * CHIP_US, ZERO_US + (chip + chips) * CHIP_US))
            chip += chips
    return found


def lock_of(form: PacketFormat, packet: int, late_us: float = 0.0, delay_us: float = -20.0) -> SyncLock:
    start_us = ZERO_US + packet * form.packet_chips * CHIP_US + late_us
    return SyncLock(start_us, CHIP_US, delay_us, delay_us - 10, 1.0)


def due_until(grid: PacketGrid, until_us: float) -> list[DueFrame]:
    found = []
    while (due := grid.due(until_us)) is not None:
        found.append(due)
        grid.frame += 1
    return found


@pytest.mark.parametrize("form", FORMATS)
@given(st.integers(0, 3), st.floats(0, 40_000), st.floats(0, 60_000))
def test_frames_are_due_as_they_are_on_air(
    form: PacketFormat, heard: int, earliest_us: float, until_us: float
) -> None:
    grid = PacketGrid(form)
    grid.restart(lock_of(form, heard), earliest_us)
    found = due_until(grid, until_us)
    sent = on_air(form, 60)
    assume(all(abs(f[2] - earliest_us) > 1e-3 and abs(f[3] - until_us) > 1e-3 for f in sent))
    want = list(takewhile(lambda f: f[3] <= until_us, (f for f in sent if f[2] >= earliest_us)))
    assert [d.index for d in found] == [f[1] for f in want]
    assert [d.start_us for d in found] == pytest.approx([f[2] for f in want], abs=1e-6)
    assert [d.end_us for d in found] == pytest.approx([f[3] for f in want], abs=1e-6)
    assert [d.number for d in found] == list(range(grid.frame - len(found), grid.frame))
    for due, (packet, index, _, _) in zip(found, want, strict=True):
        packet_us = ZERO_US + packet * form.packet_chips * CHIP_US
        assert due.packet_us == pytest.approx(packet_us, abs=1e-6)
        assert due.number == due.packet * form.frames + index
        assert due.has_pilot == (index % form.pilot_every == 0)
    # Every packet has its own number, counted up.
    assert [d.packet - found[0].packet for d in found] == [f[0] - want[0][0] for f in want]


@pytest.mark.parametrize("form", FORMATS)
def test_the_events_after_the_last_edge_are_waited_for(form: PacketFormat) -> None:
    grid = PacketGrid(form)
    grid.restart(lock_of(form, 0, delay_us=35.0), ZERO_US)
    end_us = on_air(form, 1)[0][3]
    assert grid.due(end_us + 34) is None
    due = grid.due(end_us + 36)
    assert due is not None
    assert due.end_us == pytest.approx(end_us + 35)


@pytest.mark.parametrize("form", FORMATS)
def test_a_frame_is_read_with_the_chip_after_it(form: PacketFormat) -> None:
    plain, longer = PacketGrid(form), PacketGrid(form, chips_after=1)
    for grid in (plain, longer):
        grid.restart(lock_of(form, 0, delay_us=35.0), ZERO_US)
    due = plain.due(math.inf)
    assert due is not None
    assert (plain.due_us, longer.due_us) == pytest.approx((due.end_us, due.end_us + CHIP_US))
    assert longer.due(due.end_us + CHIP_US - 1) is None
    late = longer.due(due.end_us + CHIP_US + 1)
    assert late is not None
    assert (late.start_us, late.end_us, late.chips) == (due.start_us, due.end_us, due.chips)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("late_us", [-90.0, 0.0, 90.0])
def test_a_lock_near_the_grid_moves_it_and_keeps_the_numbers(form: PacketFormat, late_us: float) -> None:
    grid = PacketGrid(form)
    grid.restart(lock_of(form, 0), ZERO_US)
    done = due_until(grid, on_air(form, 1)[-1][3] + 1)
    assert grid.follow(lock_of(form, 3, late_us))
    due = grid.due(math.inf)
    assert due is not None
    assert due.number == done[-1].number + 1
    assert due.start_us == pytest.approx(on_air(form, 2)[form.frames][2] + late_us)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("late_us", [-110.0, 110.0, 1500.0])
def test_a_lock_off_the_grid_begins_another_under_new_numbers(form: PacketFormat, late_us: float) -> None:
    grid = PacketGrid(form)
    assert not grid.follow(lock_of(form, 0))
    grid.restart(lock_of(form, 0), ZERO_US)
    done = due_until(grid, on_air(form, 1)[-1][3] + 1)
    before = grid.start_us(grid.frame)
    lock = lock_of(form, 3, late_us)
    assert not grid.follow(lock)
    assert grid.start_us(grid.frame) == before
    grid.restart(lock, 0.0)
    after = due_until(grid, on_air(form, 6)[-1][3])
    assert after[0].start_us >= before - 1e-6
    assert after[0].packet > done[-1].packet
    want = [f[2] + late_us for f in on_air(form, 7)]
    assert all(min(abs(d.start_us - w) for w in want) < 1e-6 for d in after)


def test_without_a_lock_nothing_is_due() -> None:
    assert PacketGrid(FORMATS[0]).due(math.inf) is None
