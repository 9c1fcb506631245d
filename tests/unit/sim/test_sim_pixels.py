"""Pixels and readout against brute force, closed forms and the sensor model's table."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.stats import binomtest, chisquare, kstest, norm

from evlcp_sdk.sim import Scene, SensorSpec, _kernels
from evlcp_sdk.sim.simulation import pack_requests, seed_key, tabulate_quantiles
from evlcp_sdk.values import Events
from tests.models import pixels as model
from tests.models.pixels import pixel_events, serve_requests, words_of
from tests.unit.sim.scenes import every

SENSOR = SensorSpec()
IDEAL = replace(SENSOR, noise_ln=0.0, th_spread=0.0, p_on_miss=0.0, p_off_miss=0.0)
# Asks for its event when its signal crosses a threshold.
AT_ONCE = replace(IDEAL, dly_on_us=0.0, dly_off_us=0.0)
PIECES = st.lists(st.tuples(st.integers(500, 3000), st.floats(0.02, 60.0)), min_size=2, max_size=6)


@settings(max_examples=5)
@given(PIECES, st.floats(3.0, 40.0))
def test_crossings_are_those_of_brute_force_at_10_ns(pieces, refractory) -> None:
    sensor = replace(AT_ONCE, refr_us=refractory)
    lengths, light = np.array(pieces).T
    edges = np.cumsum(lengths) - lengths  # in 10 ns, so that no step has two lights
    end = lengths.sum() / 100

    def light_at(t_us: float) -> float:
        return float(light[np.searchsorted(edges, t_us * 100 + 0.25, side="right") - 1])

    stepped = model.crossing_by_steps(sensor, light_at, 0.0, end)
    exact = pixel_events(sensor, edges / 100, light, end)
    # The last moment of a run and a signal that just touches a threshold may fall on either side.
    both = min(len(stepped), len(exact.request_us))
    assert max(len(stepped), len(exact.request_us)) - both <= 1
    assert [on for _, on in stepped[:both]] == exact.on[:both].tolist()
    np.testing.assert_allclose([t for t, _ in stepped[:both]], exact.request_us[:both], atol=0.02)


@pytest.mark.parametrize("tau_us", [2.0, 12.0])
def test_a_source_follower_is_that_of_brute_force(tau_us: float) -> None:
    sensor = replace(AT_ONCE, tau_sf_us=tau_us, refr_us=20.0)
    light = np.array([0.05, 51.0, 0.05, 3.0, 51.0, 0.05, 1.0])
    edges = np.arange(7) * 100.0
    stepped = model.crossing_by_steps(sensor, lambda t: float(light[int(t // 100)]), 0.0, 700.0)
    exact = pixel_events(sensor, edges, light, 700.0)
    assert [on for _, on in stepped] == exact.on.tolist()
    np.testing.assert_allclose([t for t, _ in stepped], exact.request_us, atol=0.2)
    # It smears a steep rise over more than a refractory time: more than one event.
    assert exact.on[exact.request_us < 200].sum() > (tau_us > 5)
    without = pixel_events(replace(sensor, tau_sf_us=0.0), edges, light, 700.0)
    hardly = pixel_events(replace(sensor, tau_sf_us=1e-3), edges, light, 700.0)
    np.testing.assert_allclose(hardly.request_us, without.request_us, atol=0.05)


@pytest.mark.parametrize(("light", "measured"), model.MEASURED_LATENCY.items())
def test_latency_is_the_measured_one_within_15_percent(light: float, measured: tuple[float, float]) -> None:
    assert model.latency_us(SENSOR, light, SENSOR.dark_w_m2) == pytest.approx(measured, rel=0.15)


@pytest.mark.parametrize("rising", [True, False])
@pytest.mark.parametrize("contrast", [0.2, 0.5, 1.0, 2.3, 4.5])
def test_a_slow_edge_gives_an_event_a_threshold(contrast: float, rising: bool) -> None:
    assert model.events_per_edge(IDEAL, contrast, rising=rising) == math.floor(contrast / IDEAL.th_on)


def test_nothing_below_the_threshold_and_the_s_curve_at_it() -> None:
    sensor = replace(SENSOR, p_on_miss=0.0)
    pixels = 4000
    sigma = math.hypot(sensor.noise_ln, sensor.th_spread * sensor.th_on)
    contrast = sensor.th_on + sigma * np.array([-1.5, -0.5, 0.0, 0.5, 1.5])
    shares = model.step_response(sensor, contrast, pixels=pixels)
    for share, p in zip(shares, norm.cdf((contrast - sensor.th_on) / sigma), strict=True):
        interval = binomtest(round(share * pixels), pixels).proportion_ci(0.999)
        assert interval.low <= p <= interval.high
    assert model.step_response(sensor, sensor.th_on - 6.5 * sigma, pixels=pixels) == 0
    assert model.step_response(IDEAL, IDEAL.th_on + np.array([-1e-6, 1e-6]), pixels=3).tolist() == [0, 1]


@pytest.mark.parametrize("tau_us", [0.0, 5.0])
def test_pixels_do_not_depend_on_those_beside_them(tau_us: float) -> None:
    rng = np.random.default_rng(2)
    edges, light = np.arange(40) * 100.0, rng.uniform(0.02, 50.0, 40)
    sensor = replace(SENSOR, tau_sf_us=tau_us, jitter_us=2.0)
    together = pixel_events(sensor, edges, light, 4e3, pixels=_kernels.LANES + 3)
    for pixels in (1, 5, _kernels.LANES):
        fewer = pixel_events(sensor, edges, light, 4e3, pixels=pixels)
        n = len(fewer.pixel)
        assert n == np.searchsorted(together.pixel, pixels)
        for a, b in zip(vars(together).values(), vars(fewer).values(), strict=True):
            assert np.array_equal(a[:n], b)


def test_missing_events_are_missing_in_the_share_asked_for() -> None:
    edges = np.arange(4000) * 400.0
    light = np.where(np.arange(4000) % 2, 20.0, 5.0)
    full = pixel_events(replace(SENSOR, p_on_miss=0.0, p_off_miss=0.0), edges, light, 1.6e6)
    some = pixel_events(SENSOR, edges, light, 1.6e6)
    for on, p in ((True, SENSOR.p_on_miss), (False, SENSOR.p_off_miss)):
        sent, all_ = int((some.on == on).sum()), int((full.on == on).sum())
        interval = binomtest(all_ - sent, all_).proportion_ci(0.999)
        assert interval.low <= p <= interval.high


def background_only(**sensor: float) -> Events:
    noisy = replace(SENSOR, t_row_us=0.0, cap_mev_s=0.0, **sensor)
    return every(Scene(duration_s=1.0, bars=(), sensor=noisy))


def test_background_activity_is_poisson() -> None:
    events = background_only(noise_hz=0.1, hot_share=0.0)
    expected = 2 * 0.1 * 1280 * 720
    assert abs(len(events) - expected) < 4 * math.sqrt(expected)
    assert abs(int(events.p.sum()) - len(events) / 2) < 4 * math.sqrt(len(events) / 4)
    counts = np.histogram(events.t_us, 500, (0, 1e6))[0]
    exact = events.t_us + np.random.default_rng(0).random(len(events))
    gaps = np.diff(np.sort(exact))
    assert kstest(gaps, "expon", args=(0, 1e6 / expected)).pvalue > 1e-3
    assert counts.var(ddof=1) / counts.mean() == pytest.approx(1, abs=0.3)
    tiles = np.histogram2d(events.x, events.y, (16, 9), ((0, 1280), (0, 720)))[0]
    assert chisquare(tiles.ravel()).pvalue > 1e-3


def test_hot_pixels_fire_at_their_rate() -> None:
    events = background_only(noise_hz=0.0, hot_share=1e-4, hot_hz=100.0)
    counts = np.bincount(events.y.astype(int) * 1280 + events.x)
    counts = counts[counts > 0]
    assert 50 < len(counts) < 140
    assert counts.mean() == pytest.approx(100, rel=0.05)


@pytest.mark.parametrize("side", [32, 128, 256])
def test_latency_grows_with_the_lit_area(side: int) -> None:
    found = model.latency_with_readout_us(SENSOR, 0.277, side)
    assert found == pytest.approx(model.MEASURED_AREA[side], rel=0.1)


def test_columns_of_the_widest_sensor_are_distinguished() -> None:
    words = words_of(np.full(4, 10.0), [719, 718, 718, 719], [8191, 0, 4096, 1])
    events, *_ = serve_requests(words, 720, 1.0)
    assert events.x.tolist() == [0, 4096, 1, 8191]
    assert events.y.tolist() == [718, 718, 719, 719]


def test_more_than_the_event_rate_limit_is_dropped() -> None:
    t = np.sort(np.random.default_rng(0).uniform(0, 1000, 5000))
    words = words_of(t, np.arange(5000) % 700, np.arange(5000) // 700)
    events, dropped, *_ = serve_requests(words, 720, 0.0, limit=(300, 200))
    assert len(events) + dropped == 5000
    assert np.bincount(events.t_us // 200).max() == 300
    assert dropped == 5000 - 5 * 300


def test_a_pixel_is_blind_after_an_event_in_any_block() -> None:
    rng = np.random.default_rng(2)
    t = np.sort(rng.uniform(0, 8000, 4000))
    row, column = rng.integers(0, 5, 4000) * 200, rng.integers(0, 5, 4000) * 200
    code = ((row << _kernels.COLUMN_BITS | column) << 1).astype(np.int32)
    blind, kept = np.zeros(1024**2), []
    for begin in (0.0, 4000.0):
        within = (t >= begin) & (t < begin + 4000.0)
        words = pack_requests(t[within], code[within], begin)
        left = words[: _kernels.drop_blind_requests(words, begin, blind, 1024, 30.0)]
        times = begin + (left >> _kernels.CODE_BITS) / _kernels.TICKS
        kept += np.stack([left & ((1 << _kernels.CODE_BITS) - 1), times], 1).tolist()
    last: dict[int, float] = {}
    expected = []
    for when, what in zip(t.tolist(), code.tolist(), strict=True):
        if when >= last.get(what, -1e9) + 30.0:
            last[what] = when
            expected.append((what, when))
    assert 2000 < len(kept) < 3900
    np.testing.assert_allclose(kept, expected, rtol=0, atol=1e-6)


def test_random_numbers_are_those_of_a_normal_distribution() -> None:
    table, draws = tabulate_quantiles(), [(k, d) for k in range(200) for d in range(50)]
    numbers, again = ([_kernels.hash_normal(seed_key(3), *one, 0, table) for one in draws] for _ in range(2))
    assert kstest(numbers, "norm").pvalue > 1e-3
    assert numbers == again
