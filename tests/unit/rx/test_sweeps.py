"""Lines of events that move, drawn from a known place, direction and speed."""

import numpy as np
import pytest

from evlcp_sdk.rx.sweeps import find_sweeps, fit_sweep, with_chips
from evlcp_sdk.values import Events

SIZE = 1280, 720
STEP_US = 1500


def line(speed, *, along=0.0, slope=0.0, upright=True, rhythmic=True, noise=0.1, many=6000, seed=0):
    """Events of a line 120 px long through (600, 300) in the middle of a step that begins at 30 ms, px/us."""
    rng = np.random.default_rng(seed)
    t = rng.integers(0, STEP_US // 100, many) * 100 + rng.integers(20, 60, many)
    t = t if rhythmic else rng.integers(0, STEP_US, many)
    after, place = t - STEP_US / 2, rng.uniform(-60, 60, many)
    across = speed * after + slope * place + rng.normal(0, 1, many)
    length = place + along * after
    x, y = (600 + across, 300 + length) if upright else (600 + length, 300 + across)
    stray = rng.random(many) < noise
    x, y = np.where(stray, rng.uniform(500, 700, many), x), np.where(stray, rng.uniform(200, 400, many), y)
    columns = 30_000 + t, np.rint(x), np.rint(y), rng.integers(0, 2, many)
    return Events.of(*columns)[np.argsort(t, kind="stable")]


BOX = 480, 180, 720, 420


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize(("along", "slope"), [(0.0, 0.0), (0.004, 0.0), (0.0, 0.3), (-0.003, -0.2)])
@pytest.mark.parametrize("speed", [0.0, 0.0025, -0.008])
def test_place_and_speed_of_a_line(speed, along, slope, upright):
    events = line(speed, along=along, slope=slope, upright=upright)
    found = fit_sweep(events, 30_000 + STEP_US / 2, BOX, along)
    x, y, width, height, moves, rows = found
    assert (x, y) == (pytest.approx(600, abs=1.5), pytest.approx(300, abs=1.5))
    across, length = (width, height) if upright else (height, width)
    assert across == pytest.approx(4 + 120 * abs(slope), abs=2.5)
    # As long as it was drawn, and as far as it moved.
    assert 116 <= length <= 122 + abs(along) * STEP_US / 4
    want = speed, along
    assert moves == pytest.approx(want if upright else want[::-1], abs=2e-4)
    assert found.is_fast == (abs(speed) > 0.002)
    if upright:
        lit = np.flatnonzero(rows >= np.median(rows[rows > 0]) / 4)
        assert lit[[0, -1]].tolist() == pytest.approx([240 - 180, 360 - 180], abs=4)


def test_what_lies_on_no_line_is_no_sweep():
    assert fit_sweep(line(0.005, noise=0.6), 30_750, BOX) is None
    assert fit_sweep(line(0.005, many=150), 30_750, BOX) is None
    assert fit_sweep(line(0.005), 30_750, (0, 0, 100, 100)) is None


def test_only_what_comes_with_the_chips_is_a_bar():
    assert with_chips(line(0.005), BOX, 100.0)
    assert not any(with_chips(line(0.005, rhythmic=False, seed=seed), BOX, 100.0) for seed in range(20))
    (found,) = find_sweeps(line(0.005), 30_000, STEP_US, 100.0, [], SIZE)
    assert (found.x_px, found.speed[0]) == (pytest.approx(600, abs=1), pytest.approx(0.005, abs=2e-4))
    assert find_sweeps(line(0.005, rhythmic=False), 30_000, STEP_US, 100.0, [], SIZE) == []
    assert find_sweeps(line(0.001), 30_000, STEP_US, 100.0, [], SIZE) == []
    assert find_sweeps(line(0.005), 30_000, STEP_US, 100.0, [(590, 290, 610, 310)], SIZE) == []
