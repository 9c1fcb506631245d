"""Statistics add exactly, in any order; their intervals cover."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.study.tally import Statistics, Tally, segment_of

TALLIES = st.one_of(
    st.just(Tally(frames_sent=1)),
    st.builds(Tally, frames_found=st.just(1), bits=st.just(96), bit_errors=st.integers(0, 96)),
    st.builds(Tally.distance, st.floats(-20, 20), st.one_of(st.just(math.nan), st.floats(0, 2))),
    st.builds(Tally.fix, st.floats(0, 20), st.floats(0, 1e15)),
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
def test_sums_do_not_depend_on_order(a: Statistics, b: Statistics, c: Statistics) -> None:
    assert (a + b) + c == a + (b + c) == c + b + a
    assert a + Statistics() == a


@given(STATISTICS)
def test_json_keeps_them(a: Statistics) -> None:
    assert Statistics.from_dict(json.loads(json.dumps(a.to_dict()))) == a


def test_figures_are_those_of_the_errors() -> None:
    errors = np.random.default_rng(1).normal(0.03, 0.4, 500)
    tally = sum((Tally.distance(float(e), 0.4) for e in errors), Tally())
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
    # A sigma of 0 is wrong beyond all measure, none counts not at all.
    assert Tally.distance(0.1, 0.0).nees == 1e12
    assert Tally.distance(0.1).with_sigma == 0


def test_errors_at_the_edge_count_and_far_ones_have_a_bin() -> None:
    assert Tally.distance(-0.5).gross == 1
    assert Tally.distance(0.499999).gross == 0
    assert Tally.distance(1e4).histogram == {150: 1}
    assert Tally.distance(-1e4).histogram == {-150: 1}
    assert segment_of(50.0) == 50


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
    assert Statistics.from_dict(Statistics.of([(40, total)], tasks=1).to_dict()).total() == total


def test_what_is_silent_and_not_covered_is_counted() -> None:
    flags = [
        (14.1, {}),
        (14.2, {}),
        (99.0, {"protected": True}),
        (99.0, {"protected": True, "beyond": True, "excluded": True}),
        (1.0, {"protected": True, "beyond": True}),
    ]
    total = sum((Tally.fix(0.1, nees, **kinds) for nees, kinds in flags), Tally(fixes_refused=9))
    assert (total.fixes, total.fixes_silent, total.fixes_uncovered) == (5, 3, 2)
    assert (total.fixes_excluded, total.fixes_protected, total.fixes_beyond) == (1, 3, 2)
    assert total.kept_share == 1.0
    assert (total + Tally(fixes_refused=5, fixes_contradicted=5)).kept_share == 0.5
    table = Statistics.of([(40, total)]).to_dict()
    table["segments"][40]["fixes_uncovered"] = 4
    with pytest.raises(ConfigError, match="fixes_uncovered: more than fixes_silent"):
        Statistics.from_dict(table)


def test_a_track_has_errors_as_filtered_and_as_smoothed() -> None:
    total = Tally.tracked(0.3, 4.0, 0.1, 2.0) + Tally.tracked(0.4, 2.0, 0.1, 4.0)
    assert total.track_rmse_m == pytest.approx(math.sqrt((0.09 + 0.16) / 2))
    assert (total.track_nees, total.smoothed_nees) == pytest.approx((3.0, 3.0))
    assert total.smoothed_rmse_m == pytest.approx(0.1)
    assert math.isnan(Tally().track_nees)
