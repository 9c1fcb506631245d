"""Barker codes and packet synchronization, on events whose timing is known."""

import numpy as np
import pytest
from evlcp_barker import _kernels
from evlcp_barker.bound import due_chips, guard_chips, least_correlation, preamble_share
from evlcp_barker.synchronization import BarkerSync
from evlcp_wh.modulation import Wh4x2
from evlcp_wh.pilots import WhPilots
from numpy.testing import assert_allclose

from evlcp_sdk.air.codebook import BARKER13, Codebook, chips_of_values
from evlcp_sdk.air.frames import PacketFormat, packet_chips

CHIP_US, START_US = 100.0, 5000.0


def correlate(counts, chips, due, steps, min_events, lags):
    """The windows of each lag laid out as a table of chips."""
    rho = np.zeros(lags)
    for lag in range(lags):
        window = counts[:, lag : lag + steps * len(chips)].reshape(2, len(chips), steps).sum(2)
        signed, seen = window[1] - window[0], window.sum()
        fit = np.where(due, signed * chips, np.minimum(signed * chips, 0)).sum()
        if seen >= min_events and fit > 0:
            rho[lag] = min(fit / seen, fit / np.linalg.norm(signed) / np.sqrt(due.sum()))
    return rho


def events_of(chips, rng, start_us=START_US, *, ppm=0.0, delay_us=(20.0, 45.0), missing_off=0.0):
    """(times, polarities) of clusters that blink as `chips` (n, K): each edge sends two late events."""
    edges = np.diff(chips.astype(int), axis=0, prepend=0)
    when, cluster = (np.repeat(v, 2) for v in np.nonzero(edges))
    p = (edges[when, cluster] > 0).astype(np.uint8)
    late = np.where(p, *delay_us) + 12 * (np.arange(len(when)) % 2) + rng.normal(0, 4.0, len(when))
    t = np.floor(start_us + when * CHIP_US * (1 + ppm * 1e-6) + late).astype(np.int64)
    keep = (p > 0) | (rng.random(len(t)) >= missing_off)
    order = np.argsort(t[keep], kind="stable")
    return t[keep][order], p[keep][order]


def answers_of(chips, slow):
    """Negative and positive events by chip, (2, n), of clusters that blink as `chips` (n, K), by plain loops.

    A pixel answers an edge by ln((k + 2) / (k + 1)) events in the k-th chip behind it, or at once.
    """
    counts = np.zeros((2, len(chips)))
    for lit in chips.T:
        k = 0
        for n, on in enumerate(lit):
            k = 0 if n == 0 or on != lit[n - 1] else k + 1
            counts[on, n] += np.log((k + 2) / (k + 1)) if slow else float(k == 0)
    return counts


CLUSTERS, FRAMES = 16, 10


def book_of(preamble, clusters=CLUSTERS):
    return Codebook("own", preamble, WhPilots().codes(clusters), Wh4x2().codewords())


BOOK = book_of(WhPilots().preamble())
FORMAT = PacketFormat.of(BOOK, FRAMES)
PERIOD_US = FORMAT.packet_chips * CHIP_US


def packets_of(rng, n, book=BOOK, frames=FRAMES):
    """Chips of packets with random symbols, (chips, K)."""
    symbols = rng.integers(0, book.data_symbols, (n, frames, book.clusters))
    return np.concatenate([packet_chips(s, book) for s in symbols])


def locks_of(t_us, p, sync=None, step_us=1000):
    """Locks, and the state at the end, by steps."""
    sync, locks, begin = sync or BarkerSync().compile(BOOK, FORMAT), [], 0
    state = sync.init()
    for until in range(0, int(t_us[-1]) + 9000, step_us):
        end = int(np.searchsorted(t_us, until))
        state, found = sync.step(state, t_us[begin:end], p[begin:end], until)
        locks += found
        begin = end
    return locks, state


def numbers(locks):
    """Which packet each lock is, as a real number: whole where it is right."""
    return np.array([(lock.packet_t_us - START_US) / PERIOD_US for lock in locks])


@pytest.mark.parametrize(("steps", "min_events", "share"), [(4, 0, 1), (10, 0, 1), (10, 520, 1), (4, 0, 0.7)])
@pytest.mark.parametrize("seed", range(4))
def test_correlation(seed, steps, min_events, share):
    rng = np.random.default_rng(seed)
    due = rng.random(26) < share
    chips = 2.0 * chips_of_values(BARKER13) - 1
    counts = rng.poisson(rng.choice([0.1, 1, 3], (1, 90 * steps)), (2, 90 * steps)).astype(float)
    at = 20 * steps + seed
    counts[1, at : at + steps * 26] += 2 * np.repeat(chips > 0, steps)
    lags = counts.shape[1] - 26 * steps + 1
    rho = np.empty(lags)
    _kernels.correlate(counts, chips, due, steps, min_events, rho)
    want = correlate(counts, chips, due, steps, min_events, lags)
    assert_allclose(rho, want, rtol=1e-12, atol=1e-12)
    assert abs(int(rho.argmax()) - at) <= 1


@pytest.mark.parametrize("memory", [8, 60, 1000])
@pytest.mark.parametrize("seed", range(3))
def test_peaks(seed, memory):
    """Against running means over lists; equal neighbours, both ends, and too little known before are met."""
    rng = np.random.default_rng(seed)
    span, guard, first, past = 12, 3, 5, (0.01, 6)
    rho = np.round(np.maximum(rng.normal(0, 0.3, 90), 0), 1)
    counts = rng.poisson(0.4, (2, len(rho) + span)).astype(float)
    power, known, want = *past, []
    for lag in range(first, len(rho) - guard):
        if rho[lag] > 0:
            known = min(known + 1, memory)
            power += (rho[lag] ** 2 - power) / known
        square = power if 2 * known >= memory else np.inf
        square = max(square, 1 / max(counts[:, lag : lag + span].sum(), 1))
        near = rho[max(lag - guard, 0) : lag + guard + 1]
        if rho[lag] >= max(min(2 * square**0.5, 0.5), 0.25) and near.argmax() == min(lag, guard):
            want.append(lag)
    peaks = np.empty(len(rho) - guard - first, np.int64)
    found = _kernels.find_peaks(rho, counts, span, first, guard, (*past, memory), (2.0, 0.5), peaks)
    assert want
    assert peaks[: found[2]].tolist() == want
    assert_allclose(found[:2], (power, known), rtol=1e-12)


SLOW = {f"chips of {n}": np.repeat(chips_of_values(BARKER13), n) for n in (2, 3, 4)}
OWN = SLOW | {
    "return to zero": np.stack([chips_of_values(BARKER13)[1::2], np.zeros(13, np.uint8)], 1).ravel(),
    "pulses of three": np.array([*map(int, "001001010100001100100010010001100010001")], np.uint8),
    "without return": np.array([*map(int, "1111100110100100001010111011000")], np.uint8),
}


@pytest.mark.parametrize("clusters", [1, 4, CLUSTERS])
@pytest.mark.parametrize("name", OWN)
def test_a_preamble_passes_and_other_codes_do_not(name, clusters):
    """Both as bad as can be: the preamble on slow pixels, the others on pixels that answer at once."""
    book = book_of(OWN[name], clusters)
    rng = np.random.default_rng(7)
    chips = packets_of(rng, 8 if clusters > 1 else 40, book)
    packet = PacketFormat.of(book, FRAMES).packet_chips
    signs, due = 2.0 * book.preamble - 1, due_chips(book.preamble)
    least = least_correlation(book, FRAMES, 1)
    reached = {}
    for answers in ("slow", "quick"):
        counts = answers_of(chips, answers == "slow")
        rho = correlate(counts, signs, due, 1, 0, counts.shape[1] - len(signs) + 1)
        at = np.arange(len(rho)) % packet
        own = np.minimum(at, packet - at)
        reached[answers] = rho[own == 0].min(), (rho[own > 3] > least).mean()
    assert least < 0.75 * reached["slow"][0]
    # A lone cluster may say what is all but the preamble: then poor ones must still pass.
    most = pytest.approx(0.7 * preamble_share(book.preamble))
    assert max(share for _, share in reached.values()) < 1e-3 or (clusters == 1 and least == most)
    if name in SLOW:
        assert least == pytest.approx(0.5 * preamble_share(book.preamble))


@pytest.mark.parametrize("name", OWN)
def test_shifts_of_a_preamble_are_within_its_guard(name):
    code = OWN[name]
    dark = np.zeros(len(code) - 1, np.uint8)
    counts = answers_of(np.concatenate([[0], code, dark, [0]])[:, None], slow=False)[:, 1 : len(code) + 1]
    counts = np.pad(counts, [(0, 0), (len(code), len(code))])
    lags = 2 * len(code) + 1
    rho = correlate(counts, 2.0 * code - 1, due_chips(code), 1, 0, lags)
    least = 0.5 * preamble_share(code)
    guard = guard_chips(code, least)
    away = np.abs(np.arange(lags) - len(code))
    assert rho[away > guard].max() < least
    assert guard == 3 or (rho[away == guard] >= least).any()


def test_a_preamble_of_sparse_pulses_is_one_lock_a_packet():
    """Its shifts, and what agrees with it less than it does itself, are none."""
    code = np.array([*map(int, "100110000100000110100100011")], np.uint8)
    slots = np.eye(10, dtype=np.uint8)[::2]
    places = np.array([[(a + n * b + n * n * b) % 5 for n in range(6)] for b in range(3) for a in range(4)])
    words = slots[np.stack(np.meshgrid(range(5), range(5), indexing="ij"), -1).reshape(-1, 2)]
    book = Codebook("sparse", code, slots[places].reshape(12, -1), words.reshape(25, -1))
    packet = PacketFormat.of(book, 7)
    rng = np.random.default_rng(0)
    events = events_of(packets_of(rng, 4, book, 7), rng)
    locks, _ = locks_of(*events, BarkerSync().compile(book, packet))
    apart = packet.packet_chips * CHIP_US
    assert_allclose([lock.packet_t_us for lock in locks], START_US + apart * np.arange(4), atol=50)


@pytest.mark.parametrize(("ppm", "delay_us"), [(-50, (20, 45)), (0, (45, 20)), (50, (60, 10))])
def test_packet_start_clock_and_delays(ppm, delay_us):
    rng = np.random.default_rng(ppm + 50)
    events = events_of(packets_of(rng, 12), rng, ppm=ppm, delay_us=delay_us, missing_off=0.2)
    locks, _ = locks_of(*events)
    assert len(locks) == 12
    start = START_US + delay_us[0] + PERIOD_US * (1 + ppm * 1e-6) * np.arange(12)
    early = start - [lock.packet_t_us for lock in locks]
    # The earliest events of an edge come 1 to 2 sigma (4 us each) before the mean of its first.
    assert 3 <= early.min() <= early.max() <= 9
    # Eight packets, each known to 1 us, give 4 ppm (sigma); the first lock has the nominal rate.
    error_ppm = 1e6 * (np.array([lock.chip_us for lock in locks]) / CHIP_US - 1) - ppm
    assert np.abs(error_ppm[7:]).max() < 10
    assert abs(error_ppm[0] + ppm) < 1e-6
    for lock in locks:
        assert lock.delay_off_us - lock.delay_on_us == pytest.approx(delay_us[1] - delay_us[0], abs=3)
        # The window of a chip that holds all events of an edge: they last from -1 to 28 us after the first.
        assert -100 + 28 - 5 < lock.delay_on_us < 5
        assert 0.8 < lock.quality <= 1


def test_a_lock_does_not_wait_for_the_next_packet():
    rng, sync = np.random.default_rng(3), BarkerSync().compile(BOOK, FORMAT)
    t, p = events_of(packets_of(rng, 4), rng, ppm=30, missing_off=0.2)
    # The preamble, the guard of the peak behind it, and one step.
    until_us = int(START_US + (26 + 3 + 2) * CHIP_US)
    _, locks = sync.step(sync.init(), t[t < until_us], p[t < until_us], until_us)
    assert len(locks) == 1


@pytest.mark.parametrize("events", [50, 5000])
def test_a_flash_is_no_preamble(events):
    rng = np.random.default_rng(1)
    t = np.sort(rng.integers(20_000, 20_100, events))
    t = np.concatenate([[0], t, t + 300, [90_000]])
    assert locks_of(t, np.ones(len(t), np.uint8))[0] == []


def test_the_lock_is_kept_across_missing_preambles():
    rng = np.random.default_rng(5)
    t, p = events_of(packets_of(rng, 14), rng, ppm=-40)
    number = (t - START_US) / PERIOD_US
    hidden = (number > 4.9) & (number < 9.5)
    locks, state = locks_of(t[~hidden], p[~hidden])
    assert_allclose(numbers(locks), [0, 1, 2, 3, 4, 10, 11, 12, 13], atol=2e-3)
    assert state.clock.packet == 13
    # Times known to 1 us, 0.3 s apart.
    assert locks[-1].chip_us == pytest.approx(CHIP_US * (1 - 40e-6), rel=6e-6)


@pytest.mark.parametrize("jump_us", [1_234, 17_300, -9_000])
@pytest.mark.parametrize("alike", [False, True])
def test_the_second_preamble_after_a_jump_is_believed(jump_us, alike):
    rng = np.random.default_rng(7)
    before, chips = events_of(packets_of(rng, 4), rng), packets_of(rng, 5)
    # Data of the first packet may look like a preamble, too, as those of a single cluster can.
    chips[200:226] = chips[:26] if alike else chips[200:226]
    after = events_of(chips, rng, START_US + 5 * PERIOD_US + jump_us)
    locks, state = locks_of(*(np.concatenate(c) for c in zip(before, after, strict=True)))
    want = np.r_[0:4, 6:10] + np.r_[np.zeros(4), np.full(4, jump_us / PERIOD_US)]
    assert_allclose(numbers(locks), want, atol=2e-3)
    assert state.clock.packet == 4
    assert state.strays == ()


@pytest.mark.parametrize(("ppm", "by_us"), [(-60, 30), (0, 15), (60, 50)])
@pytest.mark.parametrize("packets", [(1.9, 3.9), (3.9, 4.9), (4.9, 20)])
def test_latency_is_no_clock(ppm, by_us, packets):
    rng = np.random.default_rng(9)
    t, p = events_of(packets_of(rng, 12), rng, ppm=ppm, missing_off=0.2)
    number = (t - START_US) / PERIOD_US
    late = t + by_us * ((number > packets[0]) & (number < packets[1]))
    order = np.argsort(late, kind="stable")
    locks, state = locks_of(late[order], p[order])
    assert len(locks) == 12
    assert state.clock.packet == 11
    # What is heard late is read late: both polarities, at once.
    steady, _ = locks_of(t, p)
    for k, (lock, usual) in enumerate(zip(locks, steady, strict=True)):
        dark = packets[0] < k < packets[1]
        for which in ("delay_on_us", "delay_off_us"):
            window, before = (v.packet_t_us + getattr(v, which) for v in (lock, usual))
            assert window - before == pytest.approx(by_us if dark else 0, abs=4)
        # A jump of 50 us from one packet to the next looks like 1445 ppm.
        assert abs(lock.chip_us / usual.chip_us - 1) < 50e-6


@pytest.mark.parametrize("tolerance_ppm", [20.0, 100.0])
@pytest.mark.parametrize("ppm", [-400, 400])
def test_the_clock_tolerance_is_a_bound(ppm, tolerance_ppm):
    rng = np.random.default_rng(11)
    t, p = events_of(packets_of(rng, 10), rng, ppm=ppm)
    locks, _ = locks_of(t, p, BarkerSync(clock_tolerance_ppm=tolerance_ppm).compile(BOOK, FORMAT))
    rates = 1e6 * (np.array([lock.chip_us for lock in locks]) / CHIP_US - 1)
    assert np.abs(rates).max() <= tolerance_ppm + 1e-6
    # The packets are heard where they are all the same.
    late = [lock.packet_t_us - START_US - k * PERIOD_US * (1 + ppm * 1e-6) for k, lock in enumerate(locks)]
    assert np.ptp(late) < 8
