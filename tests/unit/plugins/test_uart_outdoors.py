"""Lists of events of one LED outdoors, by a simulator of their pixels."""

import numpy as np
import pytest

from tests.models.outdoor_led import Pixels, measure, seen


@pytest.mark.parametrize(
    ("scene", "raw"),
    # What others' receivers got wrong outdoors. With so few characters a plain one's share is known to a
    # factor of some three.
    [("504 near", 0.0), ("504 far", 0.0017), ("3125 near", 0.014), ("3125 far", 0.094)],
)
def test_half_of_a_plain_receivers_errors_or_one_in_a_thousand(scene: str, raw: float) -> None:
    rates = [measure(scene, seed, 200) for seed in (1, 2)]
    assert np.mean([one.plain for one in rates]) >= max(raw / 4, 1e-3)
    wrong = [one.ours - one.lost * 3.5 / (7 * 200) for one in rates]
    assert np.mean(wrong) <= max(raw / 2, 1e-3)
    # Of the last character nobody knows, without noise behind it, whether it was cut.
    assert sum(one.lost for one in rates) <= len(rates)
    assert sum(one.of_nobody for one in rates) == 0


def test_pixels_see_edges_late_and_more_of_a_stronger_light() -> None:
    light = [(1000.0 + 2000 * k, bool(k % 2)) for k in range(200)]
    many = []
    for contrast in (1.0, 8.0):
        # Slow pixels that are hardly blind, so that an edge is seen in steps.
        pixels = Pixels((contrast,) * 5, lag_us=150.0, refractory_us=3.0, noise_hz=0.0, missing=(0.0, 0.0))
        t_us, p = seen(np.random.default_rng(0), light, 402_000.0, pixels)
        assert (np.diff(t_us) >= 0).all()
        after = (t_us - 1000) % 2000
        # Half of them come within twice the lag, and hardly any when the next edge is near.
        assert np.median(after) < 300
        assert np.mean(after > 1200) < 0.01
        # Even edges are falls, and only OFF events follow them.
        assert (((t_us - 1000) // 2000 % 2) == p).all()
        many.append(len(t_us))
    # An edge is ln(2), three thresholds, or ln(9), ten; the last step is hardly ever reached.
    assert 5 * 200 * 1.5 < many[0] < 5 * 200 * 3.2
    assert 2.5 * many[0] < many[1] < 5 * 200 * 10.5
