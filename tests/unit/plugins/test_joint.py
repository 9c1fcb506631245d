"""The joint fit of all boundaries: ideal images at known distances, damaged ones, and known shifts."""

from dataclasses import replace

import numpy as np
import pytest
from evlcp_joint import _kernels
from evlcp_joint.ranging import JointScaleRanging, boundary_profile, find_bar
from numpy.testing import assert_allclose
from scipy.stats import norm

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.scene.bar import BarLayout, LedColumns
from evlcp_sdk.values import FrameView, PresenceMap, SoftSymbols

LINK = load_link()
PILOTS = LINK.codebook.pilot_edges.astype(float)
WORDS = LINK.codebook.codeword_edges.astype(float)
K = 16


def view_of(
    distance_m,
    *,
    shift_px=0.3,
    tilt=0.0,
    blur_px=0.45,
    motion_px=0.0,
    seed=0,
    noise=0.0,
    upside_down=False,
    across=False,
    dark=(),
    wrong=(),
):
    """A frame as the model has it: each row's sums follow the share of each cluster's light in it."""
    rng = np.random.default_rng(seed)
    spacing = LINK.camera.focal_px * 0.06 / distance_m
    step = spacing / np.hypot(1, tilt)
    height, width = 2 * int(step * K / 2 + 8), 2 * int(abs(tilt) * step * K / 2 + 10)
    symbols = rng.integers(0, 64, K)
    codes = np.concatenate([PILOTS, WORDS[symbols]], axis=1)
    codes[list(dark)] = 0
    drift = motion_px * (np.arange(32) / 32 - 0.5)
    moved = np.rint(drift)
    # Of second chips and rows.
    rows = np.arange(height) - (height - 1) / 2 - shift_px - (drift - moved)[1::2, None]
    cdf = norm.cdf((rows[:, :, None] - step * (np.arange(K + 1) - K / 2)) / blur_px)
    level = np.einsum("crk,kc->cr", cdf[:, :, :-1] - cdf[:, :, 1:], codes)
    centre = (width - 1) / 2 + tilt * rows
    inside = np.abs(np.arange(width) - centre[:, :, None]) <= 2
    chips = np.zeros((32, height, width))
    chips[1::2] = np.rint(inside * (3 * level[:, :, None] + noise * rng.normal(size=inside.shape)))
    # Cells of 2 px that a cluster covers.
    row, cell = 2 * np.arange(height // 2)[:, None], np.arange(width // 2)
    middle = (height - 1) / 2 + shift_px + step * (np.arange(K) - (K - 1) / 2)
    column = ((width - 1) / 2 + tilt * (row - (height - 1) / 2)) / 2
    selected = np.abs(row - middle[:, None, None]) <= step / 2 - 1
    selected = selected & (np.abs(cell - np.floor(column)) <= 1)
    selected[list(dark)] = False
    offset = np.stack([np.zeros(32), drift - moved])
    if upside_down:
        chips, selected, offset = chips[:, ::-1], selected[:, ::-1], -offset
    if across:
        chips, selected, offset = chips.transpose(0, 2, 1), selected.transpose(0, 2, 1), offset[::-1]
    reported = symbols.copy()
    reported[list(wrong)] ^= 63
    soft = SoftSymbols(reported, np.zeros((K, 6), np.float32), 1.0)
    return FrameView(chips.astype(np.int16), offset, map_of(selected, chips), soft)


def measure(view, **parameters):
    return JointScaleRanging(**parameters).compile(LINK.camera, LINK.bar, LINK.codebook)(view)


@pytest.mark.parametrize(
    "how",
    [
        {"tilt": 0.1},
        {"tilt": -0.2},
        {"motion_px": 3.0},
        {"upside_down": True},
        {"across": True},
        {"dark": (5,)},
        {"wrong": (2, 9)},
        {"noise": 1.0},
    ],
    ids=str,
)
def test_it_stands_tilt_motion_and_damage(how):
    found = measure(view_of(50.0, **how))
    assert found.distance_m == pytest.approx(50, rel=4e-3)
    assert found.pairs == (13 if "dark" in how else 15)


@pytest.mark.parametrize(("tilt", "read_tilt"), [(0.0, 0.0), (0.008, 0.0), (0.1, 0.1), (-0.2, -0.2)])
@pytest.mark.parametrize("across", [False, True])
def test_its_line_is_that_of_its_cells_and_upright_to_a_pixel(tilt, read_tilt, across):
    _, _, (first, spacing, _, slope, _), seen = find_bar(view_of(50.0, tilt=tilt, across=across), 32)
    # From the first cluster's middle on, and as long as its projection.
    step = LINK.camera.focal_px * 0.06 / 50 / np.hypot(1, tilt)
    assert spacing == pytest.approx(step, rel=0.01)
    assert first == pytest.approx(int(step * K / 2 + 8) - 0.5 + 0.3 - step * (K - 1) / 2, abs=1)
    assert slope == pytest.approx(read_tilt, abs=0.01)
    assert (slope == 0) == (read_tilt == 0)
    assert seen.all()


def test_unknown_symbols_leave_the_pilot_of_their_clusters():
    sigma_m = []
    for seed in range(4, 12):
        view, some = view_of(50.0, noise=0.5, seed=seed), [2, 3, 9]
        unknown, guess = view.soft.symbols.copy(), view.soft.symbols.copy()
        # Guessed at, they would be left out or bend the fit.
        unknown[some], guess[some] = -1, (guess[some] + 1) % 64
        found, guessed = (
            measure(replace(view, soft=replace(view.soft, symbols=symbols))) for symbols in (unknown, guess)
        )
        assert found.distance_m == pytest.approx(50, rel=4e-3)
        assert found.pairs == 15
        sigma_m.append((found.sigma_m, guessed.sigma_m))
    assert np.mean(sigma_m, 0)[0] < np.mean(sigma_m, 0)[1], sigma_m


@pytest.mark.parametrize("shift", [0, 7])
def test_values_that_the_fit_does_not_explain_give_no_distance(shift):
    """Noise with the cells of a bar, and a bar whose cells lie a cluster off."""
    view = view_of(50.0, noise=0.5, seed=4)
    sums = np.roll(view.sums, shift, 1)
    if not shift:
        sums = np.random.default_rng(3).integers(-3, 4, view.sums.shape).astype(np.int16)
    found = measure(replace(view, sums=sums))
    assert np.isnan(found.distance_m)
    assert found.pairs == 0


def test_sigma_is_the_spread():
    errors = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        found = measure(view_of(60.0, noise=1.5, seed=seed, shift_px=rng.uniform(-0.5, 0.5)))
        errors.append((found.distance_m - 60) / found.sigma_m)
    # 60 draws tell a spread to a tenth; the rest is for pixel phases, which repeat.
    assert 0.6 < np.std(errors) < 1.5
    assert abs(np.mean(errors)) < 0.5


def side_by_side(view):
    """The lower half of a bar, moved beside the upper one."""
    _, height, _ = view.sums.shape
    # The row of the middle boundary, in whole cells: what is cut off belongs to no pair of neighbours.
    half = height // 4 * 2
    sums = np.concatenate([view.sums[:, :half], view.sums[:, half : 2 * half]], axis=2)
    whole = view.presence.selected
    selected = np.zeros((K, half // 2, 2 * whole.shape[2]), np.bool_)
    selected[: K // 2, :, : whole.shape[2]] = whole[: K // 2, : half // 2]
    selected[K // 2 :, :, whole.shape[2] :] = whole[K // 2 :, half // 2 : half]
    return replace(view, sums=sums, presence=map_of(selected, sums))


def map_of(selected, sums):
    pixels = np.zeros((K, *sums.shape[1:]), np.float32)
    return PresenceMap(selected.astype(np.float32), 2, selected, pixels)


def test_two_columns_give_the_distance_of_both_and_its_sigma():
    bar = BarLayout(LedColumns(columns=2, rows=48))
    measure = JointScaleRanging().compile(LINK.camera, bar, LINK.codebook)
    errors, sigmas = [], []
    for seed in range(24):
        found = measure(side_by_side(view_of(50.0, noise=1.0, shift_px=0.2 * (seed % 4), seed=seed)))
        assert found.pairs == 14
        errors.append(found.distance_m - 50)
        sigmas.append(found.sigma_m)
    assert abs(np.mean(errors)) < 0.05
    assert 0.5 < np.mean(np.square(errors) / np.square(sigmas)) < 1.8
    one = measure(side_by_side(view_of(50.0, noise=1.0, dark=(8, 9, 10, 11, 12))))
    assert one.pairs == 7
    # What is hidden is left out, a column that shows too little whole.
    assert measure(side_by_side(view_of(50.0, dark=tuple(range(16))))).pairs == 0


def random_codes(seed):
    symbols = np.random.default_rng(seed).integers(0, 64, K)
    return np.concatenate([PILOTS, WORDS[symbols]], axis=1)


STILL, SPACING = np.zeros(32), 8.6
BOUNDARIES = 74.5 + SPACING * (np.arange(1, K) - K / 2)


def fit_of(codes, dim, values, spacing, offset_px=STILL):
    """The fit of a frame's values, of boundaries .45 px wide without tails, and where they lie off it."""
    reported = codes, codes[:, :0].copy(), np.zeros(K, np.int64), np.ones(K, np.bool_)
    fit = np.array([1.005 * spacing, 0.1, 0.0, 0.8, 0.0, 0.0, 0.0])
    (variance, *_), by_boundary = _kernels.fit_bar(
        reported, offset_px, values, boundary_profile(1.0), (0.45, dim), 6, fit
    )
    assert variance > 0
    return fit, by_boundary[:, 1:-1]


def values_of(codes, places, rows):
    """Of each row, about boundaries at these places, .45 px wide: float64 (values, rows)."""
    share = norm.cdf((np.arange(rows)[:, None] - places) / 0.45)
    # In rows: of columns the kernels would be compiled once more, for a third of this file's time.
    return np.ascontiguousarray((codes[0] + share @ np.diff(codes, axis=0)).T)


@pytest.mark.parametrize("dim", [0.05, 0.5, 2.0])
def test_boundaries_stay_where_one_sign_is_missed(dim):
    """Pilots, and symbols, say more steps of one sign at some boundaries."""
    codes = random_codes(3)
    values = 0.6 * values_of(codes, BOUNDARIES, 150)
    values *= np.where(values < 0, dim, 1)
    fit, _ = fit_of(codes, dim, values, SPACING)
    assert fit[0] == pytest.approx(SPACING, rel=2e-5)


def test_boundaries_out_of_line_are_left_out_and_shown():
    """By up to half a pixel: of those farther off, a row's values say no more."""
    codes = random_codes(5)
    shift = np.zeros(K - 1)
    shift[[3, 12]] = 0.5, -0.4
    values = 0.6 * values_of(codes, BOUNDARIES + shift, 150)
    fit, (off, weight, _) = fit_of(codes, 1.0, values, SPACING)
    assert fit[0] == pytest.approx(SPACING, rel=1e-4)
    assert np.flatnonzero(weight == 0).tolist() == [3, 12]
    # As seen against a fit that they bent.
    assert_allclose(off, shift, atol=0.16)


def test_shifts_by_sign_and_by_repeated_values_are_found():
    """Steps up lie 0.08 px lower than steps down, and what repeats a value looks smaller by 0.05 px."""
    codes = random_codes(7)
    values = np.empty((16, 150))
    for i in range(16):
        again = codes[:, i] == codes[:, i - 1] if i else np.zeros(K)
        shift = 0.04 * np.sign(np.diff(codes[:, i])) + 0.05 * np.diff(again.astype(float))
        values[i] = 0.6 * values_of(codes[:, i : i + 1], BOUNDARIES + shift, 150)[0]
    fit, (off, weight, _) = fit_of(codes, 1.0, values, SPACING)
    assert fit[0] == pytest.approx(SPACING, rel=2e-5)
    # The prior takes up to a tenth of them.
    assert_allclose(fit[5:], [0.04, 0.05], rtol=0.12)
    assert (weight > 0).all()
    assert np.abs(off).max() < 0.005
