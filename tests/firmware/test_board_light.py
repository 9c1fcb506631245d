"""Limits of light on what is sent: refused before, dark in time; against a count of all stretches."""

import numpy as np
import pytest
from board_lines import LINK, board_on, some_bank, state_of
from hypothesis import given, settings, strategies as st

from evlcp_sdk.errors import ConfigError
from firmware_host.board.bank import Bank
from firmware_host.board.board import Settings, provision
from firmware_host.emulators.simulated import SimulatedBoard
from firmware_host.errors import RefusedError
from firmware_host.protocol.generated.requests import BoardFault, State, Status

BURST = 64
FRAMES = 4
CHIPS = 26 + 32 * FRAMES
GOOD = some_bank(2)


def bank_of_rows(rows):
    return Bank.of_chips(rows, LINK.with_air(frames_per_packet=FRAMES))


def limits(board):
    """The current, its limit and the duty's."""
    status = board.status()
    return status.level_ma, status.level_limit_ma, status.duty_limit


ONES = bank_of_rows(np.ones((CHIPS, 96), np.uint8))


def excess(rows, duty):
    """The chips that a LED is on beyond its share, the worst LED's and stretch's that ends with each chip."""
    sums = np.vstack([np.zeros((1, 96)), np.cumsum(rows - duty, axis=0)])
    return (sums - np.minimum.accumulate(sums, axis=0)).max(1)[1:]


def test_all_ones_at_full_current_are_refused(device, board):
    assert (board.info.level_max_ma, board.info.mean_max_ma, board.info.burst_chips) == (60, 30, BURST)
    provision(board, GOOD, Settings(level_ma=60))
    assert board.status().duty == 500
    with pytest.raises(RefusedError, match=r"TOO_BRIGHT.*500 of 1000 chips.*lower the level") as refused:
        board.program(ONES)
    assert (refused.value.status, refused.value.detail) == (Status.TOO_BRIGHT, 500)
    device.run(100_000)
    assert board.is_active_bank(GOOD, board.status())
    assert board.status().state == State.PLAYING
    # what is too bright for 60 mA is not for 30, and the current stays below that then
    provision(board, ONES, Settings(level_ma=30))
    with pytest.raises(RefusedError, match="TOO_BRIGHT"):
        board.set_level(31)
    device.run(100_000)
    assert state_of(board) == (State.PLAYING, 0)
    assert (board.status().level_ma, board.status().duty) == (30, 1000)
    # and back in one go, although 60 mA are too much for what plays
    provision(board, GOOD, Settings(level_ma=60))
    assert board.status().level_ma == 60


def test_limits_hold_at_once_and_outlive_a_reset_by_save(device, board):
    provision(board, GOOD, Settings(level_ma=40, start=False))
    board.set_limits(GOOD, level_ma=25, duty=0.5)
    assert limits(board) == (25, 25, 500)
    with pytest.raises(RefusedError, match="nearest value the board can take is 25"):
        board.set_level(26)
    board.set_limits(GOOD)  # nothing said, nothing changed
    board.save(autostart=True)
    device.reset()
    board = board_on(device)
    assert limits(board) == (25, 25, 500)
    # a limit below what plays: refused by host and board, with both numbers, and it plays on
    message = r"a LED on for 0\.5 of the time, the duty limit is 0\.4: .* at least 0\.5"
    with pytest.raises(RefusedError, match=message):
        board.set_limits(GOOD, duty=0.4)
    with pytest.raises(RefusedError, match=r"TOO_BRIGHT.*400 of 1000 chips"):
        board._configure(GOOD, 20, 400)
    device.run(200_000)
    assert state_of(board) == (State.PLAYING, 0)
    assert limits(board) == (25, 25, 500)
    with pytest.raises(RefusedError, match="nearest value the board can take is 60"):
        board.set_limits(GOOD, level_ma=61)
    with pytest.raises(ConfigError, match="duty_limit = 0: expected"):
        Settings(duty_limit=0)


def test_a_duty_limit_fits_what_is_programmed_with_it(device, board):
    rows = np.zeros((CHIPS, 96), np.uint8)
    rows[::5] = 1
    dim = bank_of_rows(rows)
    assert (GOOD.duty, dim.duty) == (500, int(np.ceil(1000 * rows.mean(0).max())))
    provision(board, GOOD, Settings())
    for _ in range(2):  # there already, or another one as bright
        with pytest.raises(RefusedError, match=r"this payload has a LED on for 0\.5 of the time") as refused:
            provision(board, GOOD, Settings(duty_limit=0.3))
        assert (refused.value.status, refused.value.exit_code) == (Status.TOO_BRIGHT, 5)
        device.run(50_000)
        assert state_of(board) == (State.PLAYING, 0)
        assert board.status().duty_limit == 1000
    # what plays is too bright for the limit, what comes is not: first the one, then the other
    provision(board, dim, Settings(duty_limit=0.3))
    device.run(100_000)
    assert state_of(board) == (State.PLAYING, 0)
    assert (board.status().duty, board.status().duty_limit) == (dim.duty, 300)
    with pytest.raises(RefusedError, match=r"TOO_BRIGHT.*300 of 1000 chips"):
        board.program(GOOD)
    # limits by which a bank is refused do not stay
    provision(board, dim, Settings(duty_limit=1.0, level_ma=60))
    with pytest.raises(RefusedError, match=r"TOO_BRIGHT.*545 of 1000 chips"):
        provision(board, ONES, Settings(level_limit_ma=55))
    assert limits(board) == (60, 60, 1000)
    assert board.is_active_bank(dim, board.status())
    assert board.status().state == State.PLAYING


@st.composite
def streams(draw):
    """Chips of which some LEDs are on in runs, a current, and a limit of duty."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    share, run = draw(st.floats(0.05, 1.0)), draw(st.integers(1, 2 * CHIPS))
    n = draw(st.integers(1, 3)) * CHIPS
    # Of few LEDs one may be on for long at once, and for its share of the time in all.
    lit = rng.random(96) < draw(st.sampled_from([0.03, 0.03, 1.0]))
    steps = (rng.random((n // run + 2, 96)) < share) & lit
    rows = np.repeat(steps, run, axis=0)[:n].astype(np.uint8)
    return rows, draw(st.integers(10, 60)), draw(st.sampled_from([0.1, 0.25, 0.4, 0.5, 0.75, 1.0]))


@settings(max_examples=60, deadline=None)
@given(streams(), st.lists(st.integers(1, 2000), max_size=4))
def test_no_stretch_of_what_is_sent_is_beyond_the_limits(stream, stops):
    rows, level_ma, limit = stream
    device = SimulatedBoard()
    board = board_on(device)
    bank = bank_of_rows(rows)
    board.set_level(level_ma)
    board.set_limits(bank, duty=limit)
    duty = min(limit, (30_000 // level_ma) / 1000) if level_ma > 30 else limit
    mean = rows.mean(0).max()
    if mean > duty + 1e-9:
        with pytest.raises(RefusedError, match="TOO_BRIGHT"):
            board.program(bank)
        return
    board.program(bank)
    assert board.status().duty == np.ceil(1000 * mean - 1e-9)

    device.take_led_record()
    sent, ended = [np.zeros((0, 96), np.uint8)], 0
    for n, chips in enumerate([*stops, 3000]):
        board.start()
        device.run(100 * chips)
        faults = board.status().faults
        board.blank()
        record = device.take_led_record().select_chips()
        part = record.chips(None)
        # the first row beyond the limits is the one that was not shown
        endless = np.resize(rows, (len(part) + 1, 96))
        assert (part == endless[:-1]).all()
        assert faults in (0, BoardFault.OVER_LIMIT)
        if n == 0 and faults:
            assert excess(endless, duty)[-1] > BURST - 1e-6
        if len(part):
            dark = (int(record.ticks[0]) - ended) // 1000 if ended else 0
            sent += [np.zeros((dark, 96), np.uint8), part]
            ended = int(record.ticks[-1])
    # over BLANK and START as well; dark time is counted to the millisecond
    everything = np.vstack(sent)
    assert not len(everything) or excess(everything, duty).max() <= BURST + 10 * (len(stops) > 0)


def test_the_led_test_keeps_to_the_mean_current(device, board):
    board.set_level(60)
    board.test_leds(3, 4, 50)
    assert (device.bench.level_ma, board.status().level_ma) == (30, 60)
    device.run(60_000)
    assert device.bench.level_ma == 30
    device.run(60_000)
    assert board.status().state == State.DARK
    assert device.bench.level_ma == 60
