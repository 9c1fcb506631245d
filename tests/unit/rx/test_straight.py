"""Boundaries that no straight bar explains: against drawn errors, and the formula of a drop."""

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.rx.straight import straighten

PLACES = np.arange(1.0, 16) - 8
NOISE_PX = 0.06
SPACING_PX = 9.0

Floats = NDArray[np.float64]


def drops(rng):
    """How one to three drops on or beside a bar, a tenth to a third of it wide, bend it along itself, px."""
    along_px, off = PLACES * SPACING_PX, np.zeros(15)
    for _ in range(rng.integers(1, 4)):
        radius = rng.uniform(15, 45)
        at = (along_px - rng.uniform(-72 - radius, 72 + radius)) / radius
        away = np.hypot(at, rng.uniform(-1, 1))
        off += rng.choice([-1, 1]) * rng.uniform(0.5, 6) * at * np.exp((1 - away**2) / 2)
    return off


def dark(rng):
    """A quarter of the boundaries off by up to a LED, as those beside them are dark."""
    return np.asarray((rng.random(15) < 0.25) * rng.choice([-1, 1], 15) * rng.uniform(0.3, 1.5, 15))


def seen(error_px, rng):
    """What a scale through boundaries with such errors is too short by, px, and what they say of it."""
    off = error_px + NOISE_PX * rng.standard_normal(15)
    slope, mean = np.polyfit(PLACES, off, 1)
    # A lean's parabola, as large as it may be, is none of theirs.
    return -slope, straighten(PLACES, off - slope * PLACES - mean + 0.01 * (PLACES**2 - 56 / 3), 0.1, 0.01)


def judged(errors_of, rng):
    """Errors of scales, those of the straight bars' spacing, px, and squares of those by their variance."""
    found = [(px, one) for px, one in (seen(errors_of(rng), rng) for _ in range(400)) if one is not None]
    return np.array([(px, px - one.slope, (px - one.slope) ** 2 / one.variance) for px, one in found]).T


def test_noise_and_a_lean_bend_nothing():
    rng = np.random.default_rng(1)
    assert [seen(np.zeros(15), rng)[1] for _ in range(1000)] == 1000 * [None]
    # Of boundaries that scatter as much as is expected, 1 of 700.
    off = np.array(
        [0.1 * (px - np.polyval(np.polyfit(PLACES, px, 1), PLACES)) for px in rng.standard_normal((3000, 15))]
    )
    assert sum(straighten(PLACES, px, 0.1, 0.0) is not None for px in off) < 15
    assert straighten(PLACES[:5], 9 * off[0, :5], 0.1, 0.0) is None


def test_dark_leds_are_told_from_a_straight_bar():
    """Most boundaries agree: the error is a third of that of a scale through all, and its sigma is true."""
    rng = np.random.default_rng(2)
    before, after, squares = judged(dark, rng)
    assert len(before) > 300
    assert np.median(np.abs(after)) < 0.35 * np.median(np.abs(before))
    assert np.sqrt(np.mean(after**2)) < 0.65 * np.sqrt(np.mean(before**2))
    assert 0.2 < squares.mean() < 1.2
    off = np.zeros(15)
    off[[2, 9]] = 0.8, -1.0
    told = seen(off, rng)[1]
    assert not told.together
    assert np.flatnonzero(np.abs(told.rest_px) > 0.4).tolist() == [2, 9]


def test_what_drops_add_to_a_scale_is_in_the_sigma():
    """Most of it is seen by how neighbours err, but a drop over half of a bar hardly bends it."""
    rng = np.random.default_rng(3)
    before, after, squares = np.abs(judged(drops, rng))
    assert len(before) > 350
    assert np.sqrt(np.mean(after**2)) < 0.8 * np.sqrt(np.mean(before**2))
    assert np.median(after) < 0.7 * np.median(before)
    # A few hundred times as much where 1 in 200 looks like dark LEDs.
    assert 0.3 < np.minimum(squares, 9).mean() < 1.5
    assert np.mean(squares > 3) < 0.1
