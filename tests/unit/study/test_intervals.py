"""Intervals over recordings: they cover where errors come in bursts, and say so where there are too few."""

import math
from itertools import product

import numpy as np
import pytest
from scipy.stats import binomtest, chi2, t

from evlcp_sdk.study.intervals import (
    FEWEST_RECORDINGS,
    measure,
    ratio_interval,
)
from evlcp_sdk.study.tally import Tally

BITS, FRAMES = 6000, 60


@pytest.mark.parametrize("recordings", [FEWEST_RECORDINGS, 8, 24])
def test_intervals_of_bursts_cover(recordings: int) -> None:
    """The error rate is another one in each recording, as vibration has it: log-normal."""
    rng = np.random.default_rng(5)
    rate = 0.01 * np.exp(rng.normal(-0.5, 1.0, (200, recordings)))
    errors = rng.binomial(BITS, np.minimum(rate, 1))
    wholes = np.full(recordings, BITS)
    inside = [low <= 0.01 <= high for low, high in (ratio_interval(some, wholes) for some in errors)]
    assert 0.89 <= np.mean(inside) <= 0.98
    # Errors taken as independent say far too much.
    total = recordings * BITS
    naive = [
        low <= 0.01 <= high for low, high in (binomtest(int(k), total).proportion_ci() for k in errors.sum(1))
    ]
    assert np.mean(naive) < 0.35


@pytest.mark.parametrize("recordings", [FEWEST_RECORDINGS, 8, 24])
def test_intervals_of_correlated_distance_errors_cover(recordings: int) -> None:
    """Distance errors that follow the vibration: a Markov chain, each recording with its own scale."""
    rng = np.random.default_rng(6)
    kept = 0.8
    steps = rng.normal(0, math.sqrt(1 - kept**2), (150, recordings, FRAMES))
    steps[..., 0] = rng.normal(0, 1, (150, recordings))
    for i in range(1, FRAMES):
        steps[..., i] += kept * steps[..., i - 1]
    errors = 0.1 * steps * np.exp(rng.normal(-0.16, 0.4, (150, recordings, 1)))
    squares = np.round((errors**2).sum(2) * 1e12).astype(np.int64)
    inside, naive = [], []
    for some in squares.tolist():
        rmse = measure([Tally(ranged=FRAMES, squares_nm2=v * 10**6) for v in some], "rmse_m")
        inside.append(rmse.low <= 0.1 <= rmse.high)
        low, high = rmse.value * np.sqrt(rmse.count / chi2.ppf([0.975, 0.025], rmse.count))
        naive.append(low <= 0.1 <= high)
    assert 0.89 <= np.mean(inside) <= 0.99
    assert np.mean(naive) < 0.6


def test_the_draws_are_those_of_every_possible_sample() -> None:
    """Of three recordings there are 27 samples: quantiles of all of them, one by one."""
    parts, wholes = np.array([4, 9, 30]), np.array([100, 120, 90])

    def log_and_error(sample: tuple[int, ...]) -> tuple[float, float]:
        a, b = parts[list(sample)], wholes[list(sample)]
        ratio = a.sum() / b.sum()
        spread = math.sqrt(((a - ratio * b) ** 2).sum() * 3 / 2) / b.sum()
        return math.log(ratio), spread / ratio

    centre, error = log_and_error((0, 1, 2))
    every = [log_and_error(s) for s in product(range(3), repeat=3)]
    away = np.sort([(log - centre) / e for log, e in every if e > 0])
    low, high = ratio_interval(parts, wholes, confidence=0.2)
    down, up = np.quantile(away, [0.6, 0.4]) * [1, -1]
    least = t.ppf(0.6, 2)
    down, up = (min(max(end, least), 2 * least) for end in (down, up))
    assert math.log(low) == pytest.approx(centre - down * error, abs=0.05)
    assert math.log(high) == pytest.approx(centre + up * error, abs=0.05)


def test_draws_of_nearly_equal_recordings_do_not_make_it_endless() -> None:
    low, high = ratio_interval([40, 41, 40, 41, 900], [6000] * 5)
    assert 0 < low < 1062 / 30_000 < high < 100 * 1062 / 30_000


def test_few_recordings_have_a_range_and_one_has_nothing() -> None:
    some = [Tally(bits=1000, bit_errors=k, frames_found=10) for k in (10, 20, 60)]
    few = measure(some, "ber")
    assert (few.value, few.low, few.high, few.recordings) == (0.03, 0.01, 0.06, 3)
    assert few.interval(".2f") == "(0.01, 0.06)"
    (alone,) = (measure(some[:1], "ber"),)
    assert math.isnan(alone.low)
    assert alone.interval(".2f") == ""
    enough = measure(some * 2, "ber")
    assert enough.low < 0.03 < enough.high
    assert enough.interval(".2f").startswith("[")


def test_a_recording_without_data_is_none() -> None:
    some = [Tally(bits=1000, bit_errors=k, frames_found=10) for k in (10, 20, 60, 5)]
    assert measure([*some, Tally()], "ber") == measure(some, "ber")
    assert measure([], "rmse_m").count == 0
    assert math.isnan(measure([Tally()], "gross_share").value)


def test_without_errors_there_is_a_limit_by_frames() -> None:
    none = measure([Tally(bits=960, frames_found=10)] * 8, "ber")
    assert (none.value, none.low, none.none) == (0, 0, True)
    assert none.high == binomtest(0, 80).proportion_ci().high
    all_found = measure([Tally(frames_sent=10, frames_found=10)] * 8, "found_share")
    assert (all_found.value, all_found.high) == (1, 1)
    assert all_found.low == binomtest(80, 80).proportion_ci().low


def test_a_share_near_one_is_bounded_by_one() -> None:
    found = measure([Tally(frames_sent=100, frames_found=100 - k) for k in (0, 0, 1, 0, 9, 0)], "found_share")
    assert 0 < found.low < found.value < found.high <= 1
    lost = measure(
        [Tally(messages_sent=100, messages_found=100 - k) for k in (0, 0, 1, 0, 9, 0)], "lost_share"
    )
    assert lost.value == pytest.approx(1 - found.value)
    assert (lost.low, lost.high) == pytest.approx((1 - found.high, 1 - found.low))
