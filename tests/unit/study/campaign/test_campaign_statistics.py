"""Statistics add exactly, in any order; their intervals cover."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evlcp_sdk.study.intervals import proportion_interval, rms_interval
from evlcp_sdk.study.tally import Statistics, Tally, segment_of

TALLIES = st.one_of(
    st.just(Tally.sent()),
    st.builds(
        Tally.found,
        st.just(96),
        st.integers(0, 96),
        st.one_of(st.none(), st.floats(-20, 20, allow_nan=False)),
    ),
)
STATISTICS = st.builds(
    Statistics.of,
    st.integers(0, 5),
    st.integers(0, 10**9),
    st.integers(0, 10**7),
    st.integers(0, 3),
    st.lists(st.tuples(st.sampled_from([30, 40, 50]), TALLIES), max_size=12),
)


@given(STATISTICS, STATISTICS, STATISTICS)
def test_sums_do_not_depend_on_order(a: Statistics, b: Statistics, c: Statistics) -> None:
    assert (a + b) + c == a + (b + c) == c + b + a
    assert a + Statistics() == a


@given(STATISTICS)
def test_json_keeps_them(a: Statistics) -> None:
    assert Statistics.from_dict(json.loads(json.dumps(a.to_dict()))) == a


def test_figures_are_those_of_the_errors() -> None:
    errors = np.random.default_rng(1).normal(0.03, 0.4, 500)
    tally = sum((Tally.found(96, 1, float(e)) for e in errors), Tally())
    assert tally.rmse_m == pytest.approx(math.sqrt((errors**2).mean()), abs=1e-6)
    assert tally.bias_m == pytest.approx(errors.mean(), abs=1e-6)
    assert tally.gross_share == (np.abs(errors) >= 0.5).mean()
    assert tally.ber == 1 / 96
    assert sum(n for _, n in tally.histogram) == 500
    assert math.isnan(Tally().rmse_m)
    assert math.isnan(Tally().ber)


def test_errors_at_the_edge_count_and_far_ones_have_a_bin() -> None:
    assert Tally.found(6, 0, -0.5).gross == 1
    assert Tally.found(6, 0, 0.499999).gross == 0
    assert Tally.found(6, 0, 1e4).histogram == ((150, 1),)
    assert Tally.found(6, 0, -1e4).histogram == ((-150, 1),)
    assert segment_of(50.0) == 50


@pytest.mark.parametrize("p", [0.0005, 0.01, 0.3])
def test_proportion_intervals_cover(p: float) -> None:
    rng = np.random.default_rng(2)
    hits = rng.binomial(2000, p, 400)
    inside = [low <= p <= high for low, high in (proportion_interval(int(k), 2000) for k in hits)]
    assert np.mean(inside) >= 0.94
    assert proportion_interval(2000, 2000)[1] == 1.0
    assert proportion_interval(0, 0) == (0.0, 1.0)


def test_rms_intervals_cover() -> None:
    rng = np.random.default_rng(3)
    rms = np.sqrt((rng.normal(0, 0.07, (1000, 40)) ** 2).mean(1))
    inside = [low <= 0.07 <= high for low, high in (rms_interval(float(r), 40) for r in rms)]
    assert 0.93 <= np.mean(inside) <= 0.97
    assert all(math.isnan(v) for v in rms_interval(0.1, 0))


def test_positions_have_quantiles() -> None:
    errors_m = np.random.default_rng(0).exponential(0.1, 999)
    total = sum((Tally.fix(float(e), 3.0) for e in errors_m), Tally(fixes_refused=2))
    assert (total.fixes, total.fixes_refused) == (999, 2)
    assert total.position_rmse_m == pytest.approx(np.sqrt((errors_m**2).mean()), rel=1e-4)
    assert total.position_nees == pytest.approx(3.0)
    for share in (0.5, 0.95):
        # The upper end of the bin that holds it.
        true = np.quantile(errors_m, share, method="higher")
        assert 0 <= total.position_quantile_m(share) - true <= 0.005 + 1e-9
    assert math.isnan(Tally().position_quantile_m(0.5))
    assert Statistics.from_dict(Statistics.of(1, 0, 0, 0, [(40, total)]).to_dict()).total() == total
