"""Lists of events of one LED outdoors, by a simulator of their pixels."""

import numpy as np
import pytest

from tests.models.outdoor_led import measure


@pytest.mark.parametrize(
    ("scene", "raw"),
    # What others' receivers got wrong outdoors. With so few characters a plain one's share is known to a
    # factor of some three.
    [("504 far", 0.0017), ("3125 near", 0.014), ("3125 far", 0.094)],
)
def test_half_of_a_plain_receivers_errors_or_one_in_a_thousand(scene: str, raw: float) -> None:
    rates = [measure(scene, seed, 200) for seed in (1, 2)]
    assert np.mean([one.plain for one in rates]) >= max(raw / 4, 1e-3)
    wrong = [one.ours - one.lost * 3.5 / (7 * 200) for one in rates]
    assert np.mean(wrong) <= max(raw / 2, 1e-3)
    # Of the last character nobody knows, without noise behind it, whether it was cut.
    assert sum(one.lost for one in rates) <= len(rates)
    assert sum(one.of_nobody for one in rates) == 0
