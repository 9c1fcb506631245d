"""Statistics add exactly, in any order; intervals over recordings cover where errors come in bursts."""

import json
import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.stats import binomtest, t

from evlcp_sdk.study.intervals import FEWEST_RECORDINGS, measure_figure, ratio_interval
from evlcp_sdk.study.tally import Statistics, Tally, segment_of

TALLIES = st.one_of(
    st.just(Tally(frames_sent=1)),
    st.builds(Tally, frames_found=st.just(1), bits=st.just(96), bit_errors=st.integers(0, 96)),
    st.builds(Tally.of_distance, st.floats(-20, 20), st.one_of(st.just(math.nan), st.floats(0, 2))),
    st.builds(Tally.of_fix, st.floats(0, 20), st.floats(0, 1e15)),
)
STATISTICS = st.builds(
    Statistics.of,
    st.lists(st.tuples(st.sampled_from([30, 40, 50]), TALLIES), max_size=12),
    tasks=st.integers(0, 5),
    events=st.integers(0, 10**9),
    rows=st.integers(0, 10**7),
    sigma_squares_nm2=st.integers(0, 10**20),
)


@given(STATISTICS, STATISTICS, STATISTICS)
def test_sums_do_not_depend_on_order_and_json_keeps_them(a: Statistics, b: Statistics, c: Statistics) -> None:
    assert (a + b) + c == a + (b + c) == c + b + a
    assert a + Statistics() == a
    assert Statistics.from_dict(json.loads(json.dumps(a.to_dict()))) == a


def test_figures_are_those_of_the_errors() -> None:
    errors = np.random.default_rng(1).normal(0.03, 0.4, 500)
    tally = sum((Tally.of_distance(float(e), 0.4) for e in errors), Tally())
    assert tally.rmse_m == pytest.approx(math.sqrt((errors**2).mean()), abs=1e-9)
    assert tally.bias_m == pytest.approx(errors.mean(), abs=1e-9)
    assert tally.worst_m == pytest.approx(abs(errors).max(), abs=1e-9)
    assert tally.nees == pytest.approx(((errors / 0.4) ** 2).mean(), abs=1e-6)
    assert tally.gross_share == (np.abs(errors) >= 0.5).mean()
    assert sum(tally.histogram.values()) == 500
    assert math.isnan(Tally().rmse_m)
    for name in ("ber", "erased_share", "claimed_share", "bias_m", "worst_m", "nees", "filtered_rmse_m"):
        assert math.isnan(getattr(Tally(), name)), name
    some = Tally(bits=96, bit_errors=3, visible=20, erased=4, hidden=8, claimed=2)
    assert (some.ber, some.erased_share, some.claimed_share) == (3 / 96, 0.2, 0.25)
    # Errors at the edge count, and far ones have a bin.
    assert [Tally.of_distance(error_m).gross for error_m in (-0.5, 0.499999)] == [1, 0]
    assert [Tally.of_distance(error_m).histogram for error_m in (1e4, -1e4)] == [{150: 1}, {-150: 1}]
    assert segment_of(50.0) == 50
    # A sigma of 0 is wrong beyond all measure, none counts not at all.
    assert Tally.of_distance(0.1, 0.0).nees == 1e12
    assert Tally.of_distance(0.1).with_sigma == 0


def test_positions_have_quantiles() -> None:
    errors_m = np.random.default_rng(0).exponential(0.1, 999)
    total = sum((Tally.of_fix(float(e), 3.0) for e in errors_m), Tally(fixes_refused=2))
    assert (total.fixes, total.fixes_refused) == (999, 2)
    assert total.position_rmse_m == pytest.approx(np.sqrt((errors_m**2).mean()), rel=1e-4)
    assert total.position_nees == pytest.approx(3.0)
    for share in (0.5, 0.95):
        # The upper end of the bin that holds it.
        true = np.quantile(errors_m, share, method="higher")
        assert 0 <= total.position_quantile_m(share) - true <= 0.005 + 1e-9
    assert math.isnan(Tally().position_quantile_m(0.5))
    assert Statistics.from_dict(Statistics.of([(40, total)], tasks=1).to_dict()).total() == total


def test_what_is_silent_and_not_covered_is_counted() -> None:
    kinds = {14.1: "", 14.2: "", 1.0: "protected beyond"}
    kinds |= {98.0: "protected", 99.0: "protected beyond excluded"}
    fixes = (Tally.of_fix(0.1, nees, **dict.fromkeys(kind.split(), True)) for nees, kind in kinds.items())
    total = sum(fixes, Tally(fixes_refused=9))
    assert (total.fixes, total.fixes_silent, total.fixes_uncovered) == (5, 3, 2)
    assert (total.fixes_excluded, total.fixes_protected, total.fixes_beyond) == (1, 3, 2)
    assert total.kept_share == 1.0
    assert (total + Tally(fixes_refused=5, fixes_contradicted=5)).kept_share == 0.5


def test_a_track_has_errors_as_filtered_and_as_smoothed() -> None:
    total = Tally.of_track_point(0.3, 4.0, 0.1, 2.0) + Tally.of_track_point(0.4, 2.0, 0.1, 4.0)
    assert total.track_rmse_m == pytest.approx(math.sqrt((0.09 + 0.16) / 2))
    assert (total.track_nees, total.smoothed_nees) == pytest.approx((3.0, 3.0))
    assert total.smoothed_rmse_m == pytest.approx(0.1)
    assert math.isnan(Tally().track_nees)


BITS = 6000


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
    naive = [binomtest(int(k), total).proportion_ci() for k in errors.sum(1)]
    assert np.mean([low <= 0.01 <= high for low, high in naive]) < 0.35


def test_the_interval_of_a_root_mean_square_is_the_root_of_the_ratios() -> None:
    squares = [v * 10**20 for v in (4, 9, 30, 8, 5)]
    found = measure_figure([Tally(ranged=60, squares_nm2=v) for v in squares], "rmse_m")
    ends = 1e-9 * np.sqrt(ratio_interval(squares, [60] * 5))
    assert (found.low, found.high) == pytest.approx(tuple(ends))
    assert found.high > 1


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


def test_few_recordings_have_a_range_and_one_has_nothing() -> None:
    # Draws of nearly equal recordings do not make it endless.
    low, high = ratio_interval([40, 41, 40, 41, 900], [6000] * 5)
    assert 0 < low < 1062 / 30_000 < high < 100 * 1062 / 30_000
    some = [Tally(bits=1000, bit_errors=k, frames_found=10) for k in (10, 20, 60)]
    few = measure_figure(some, "ber")
    assert (few.value, few.low, few.high, few.recordings) == (0.03, 0.01, 0.06, 3)
    assert few.interval(".2f") == "(0.01, 0.06)"
    alone = measure_figure(some[:1], "ber")
    assert math.isnan(alone.low)
    assert alone.interval(".2f") == ""
    # A recording without data is none.
    assert measure_figure([*some, Tally()], "ber") == few
    assert measure_figure([], "rmse_m").count == 0
    assert math.isnan(measure_figure([Tally()], "gross_share").value)
    enough = measure_figure(some * 2, "ber")
    assert enough.low < 0.03 < enough.high
    assert enough.interval(".2f").startswith("[")


def test_without_errors_there_is_a_limit_by_frames() -> None:
    none = measure_figure([Tally(bits=960, frames_found=10)] * 8, "ber")
    assert (none.value, none.low, none.is_zero) == (0, 0, True)
    assert none.high == binomtest(0, 80).proportion_ci().high
    all_found = measure_figure([Tally(frames_sent=10, frames_found=10)] * 8, "found_share")
    assert (all_found.value, all_found.high) == (1, 1)
    assert all_found.low == binomtest(80, 80).proportion_ci().low


def test_a_share_near_one_is_bounded_by_one() -> None:
    names = ("frames_sent", "frames_found", "messages_sent", "messages_found")
    some = [Tally(**dict(zip(names, 2 * (100, 100 - k), strict=True))) for k in (0, 0, 1, 0, 9, 0)]
    found, lost = measure_figure(some, "found_share"), measure_figure(some, "lost_share")
    assert 0 < found.low < found.value < found.high <= 1
    assert lost.value == pytest.approx(1 - found.value)
    assert (lost.low, lost.high) == pytest.approx((1 - found.high, 1 - found.low))
