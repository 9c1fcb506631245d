"""The joint fit of all boundaries: kernels against twins, ideal images at known distances, damaged ones."""

import numpy as np
import pytest
from evlcp_joint import _kernels
from evlcp_joint.ranging import JointScaleRanging
from numpy.testing import assert_allclose
from scipy.stats import norm, theilslopes

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.study.bound import cramer_rao_sigma_m
from evlcp_sdk.values import FrameView, PresenceMap, Range, SoftSymbols

LINK = load_link()
PILOTS = LINK.codebook.pilots.astype(float)
WORDS = LINK.codebook.codewords.astype(float)
K = 16


def view_of(
    distance_m: float,
    *,
    shift_px: float = 0.3,
    tilt: float = 0.0,
    blur_px: float = 0.45,
    motion_px: float = 0.0,
    seed: int = 0,
    noise: float = 0.0,
    upside_down: bool = False,
    across: bool = False,
    dark: tuple[int, ...] = (),
    wrong: tuple[int, ...] = (),
) -> FrameView:
    """A frame as the model has it: each row's sums follow the share of each cluster's light in it."""
    rng = np.random.default_rng(seed)
    spacing = LINK.camera.focal_px * 0.06 / distance_m
    step = spacing / np.hypot(1, tilt)
    height, width = 2 * int(step * K / 2 + 8), 2 * int(abs(tilt) * step * K / 2 + 10)
    symbols = rng.integers(0, 64, K)
    codes = np.concatenate([PILOTS, WORDS[symbols]], axis=1)
    codes[list(dark)] = 0
    chips = np.zeros((32, height, width))
    drift = motion_px * (np.arange(32) / 32 - 0.5)
    moved = np.rint(drift)
    for c in range(1, 32, 2):
        rows = np.arange(height) - (height - 1) / 2 - shift_px - (drift[c] - moved[c])
        edges = step * (np.arange(K + 1) - K / 2)
        cdf = norm.cdf((rows[:, None] - edges) / blur_px)
        share = cdf[:, :-1] - cdf[:, 1:]
        level = share @ codes[:, c // 2]
        centre = (width - 1) / 2 + tilt * rows
        inside = np.abs(np.arange(width) - centre[:, None]) <= 2
        chips[c] = np.where(inside, 3 * level[:, None], 0) + noise * rng.normal(size=(height, width)) * inside
    chips = np.rint(chips)
    middle = (height - 1) / 2 + shift_px + step * (np.arange(K) - (K - 1) / 2)
    selected = np.zeros((K, height // 2, width // 2), bool)
    for k in set(range(K)) - set(dark):
        top, bottom = (middle[k] - step / 2 + 1) / 2, (middle[k] + step / 2 - 1) / 2
        for r in range(int(np.ceil(top)), int(bottom) + 1):
            column = ((width - 1) / 2 + tilt * (2 * r - (height - 1) / 2)) / 2
            selected[k, r, int(column - 1) : int(column + 1) + 1] = True
    offset = np.stack([np.zeros(32), drift - moved])
    if upside_down:
        chips, selected, offset = chips[:, ::-1], selected[:, ::-1], -offset
    if across:
        chips, selected, offset = chips.transpose(0, 2, 1), selected.transpose(0, 2, 1), offset[::-1]
    said = symbols.copy()
    said[list(wrong)] ^= 63
    presence = PresenceMap(
        selected.astype(np.float32), 2, selected, np.zeros((K, *chips.shape[1:]), np.float32)
    )
    soft = SoftSymbols(said, np.zeros((K, 6), np.float32), 1.0)
    return FrameView(chips.astype(np.int16), offset, presence, soft)


def measured(view: FrameView, **parameters: float) -> Range:
    return JointScaleRanging(**parameters).compile(LINK.camera, LINK.bar, LINK.codebook)(view)


@pytest.mark.parametrize("distance_m", [30.0, 41.7, 50.0, 66.6, 80.0, 100.0])
@pytest.mark.parametrize("shift_px", [-0.4, 0.0, 0.25])
def test_ideal_images_give_their_distance(distance_m: float, shift_px: float) -> None:
    # A little noise, as without it whole events of three at most put all pixels of a row into one step.
    found = measured(view_of(distance_m, shift_px=shift_px, noise=0.5))
    assert found.distance_m == pytest.approx(distance_m, rel=3e-3)
    assert found.sigma_m < 4e-3 * distance_m
    assert found.pairs == 15


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
def test_it_stands_tilt_motion_and_damage(how: dict[str, float]) -> None:
    found = measured(view_of(50.0, **how))
    assert found.distance_m == pytest.approx(50, rel=4e-3)
    assert found.pairs == (13 if "dark" in how else 15)


def test_unknown_symbols_leave_the_pilot_of_their_clusters() -> None:
    view = view_of(50.0, noise=0.5, seed=4)
    symbols = view.soft.symbols.copy()
    symbols[[2, 3, 9]] = -1
    soft = SoftSymbols(symbols, view.soft.llr, 1.0)
    found = measured(FrameView(view.sums, view.offset_px, view.presence, soft))
    assert found.distance_m == pytest.approx(50, rel=4e-3)
    assert found.pairs == 15
    # Guessed at, they would be left out or bend the fit.
    symbols[[2, 3, 9]] = (view.soft.symbols[[2, 3, 9]] + 1) % 64
    guessed = measured(FrameView(view.sums, view.offset_px, view.presence, soft))
    assert found.sigma_m < guessed.sigma_m


def test_a_reflection_beside_the_bar_does_not_matter() -> None:
    view = view_of(50.0, noise=0.5, seed=4)
    beside = np.pad(view.sums, ((0, 0), (0, 0), (0, 24)))
    dim = np.random.default_rng(1).random(view.sums.shape) < 0.4
    beside[:, :, 24:] += view.sums * dim
    cells = view.presence.selected
    selected = np.pad(cells, ((0, 0), (0, 0), (0, 12)))
    selected[:, :, 12:] |= cells & (np.random.default_rng(2).random(cells.shape) < 0.6)
    presence = PresenceMap(
        selected.astype(np.float32), 2, selected, np.zeros((K, *beside.shape[1:]), np.float32)
    )
    found = measured(FrameView(beside, view.offset_px, presence, view.soft))
    alone = measured(view)
    assert found.distance_m == pytest.approx(alone.distance_m, abs=0.3 * alone.sigma_m)
    assert found.pairs == 15


@pytest.mark.parametrize("shift", [0, 7])
def test_values_that_the_fit_does_not_explain_give_no_distance(shift: int) -> None:
    """Noise with the cells of a bar, and a bar whose cells lie a cluster off."""
    view = view_of(50.0, noise=0.5, seed=4)
    sums = np.roll(view.sums, shift, 1)
    if not shift:
        sums = np.random.default_rng(3).integers(-3, 4, view.sums.shape).astype(np.int16)
    found = measured(FrameView(sums, view.offset_px, view.presence, view.soft))
    assert np.isnan(found.distance_m)
    assert found.pairs == 0


def test_whole_pixels_between_a_value_s_chips_do_not_move_the_bar() -> None:
    """A bar that moves on by whole pixels, held still chip by chip: its values know of none of it."""
    still, moving = view_of(50.0, noise=0.5, seed=4), view_of(50.0, noise=0.5, seed=4)
    speed = 0.17
    place = speed * (np.arange(32) + 0.5)
    # A value's events show the bar half a chip before its second chip's middle.
    shown = np.rint(speed * np.arange(32) - np.rint(place)).astype(int)
    sums = np.stack([np.roll(s, by, 0) for s, by in zip(moving.sums, shown, strict=True)])
    offset = np.stack([np.zeros(32), place - np.rint(place)])
    found = measured(FrameView(sums, offset, moving.presence, moving.soft))
    want = measured(still)
    # The image moves by whole pixels only, which leaves a uniform error of a pixel.
    assert found.distance_m == pytest.approx(want.distance_m, abs=0.05)


def test_sigma_is_the_spread() -> None:
    errors = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        found = measured(view_of(60.0, noise=1.5, seed=seed, shift_px=rng.uniform(-0.5, 0.5)))
        errors.append((found.distance_m - 60) / found.sigma_m)
    # 60 draws tell a spread to a tenth; the rest is for pixel phases, which repeat.
    assert 0.6 < np.std(errors) < 1.5
    assert abs(np.mean(errors)) < 0.5


def test_too_few_clusters_give_no_distance() -> None:
    found = measured(view_of(50.0, dark=tuple(range(0, 16, 2))))
    assert np.isnan(found.distance_m)
    assert found.pairs == 0


def test_panels_are_refused() -> None:
    panel = BarLayout(rows=16, columns=16, cluster_rows=4, cluster_columns=4)
    with pytest.raises(ConfigError, match="one column"):
        JointScaleRanging().compile(CameraModel(), panel, LINK.codebook)


PROFILE = (0.2, 0.6, 0.4)


def profile_of(z: np.ndarray, width: float) -> np.ndarray:
    """The twin of a boundary's profile."""
    core, tail, share = PROFILE[0] * np.exp(width), PROFILE[1] * np.exp(width), PROFILE[2]
    return share * norm.cdf(z / core) + (1 - share) * norm.cdf(z / tail)


def model_of(
    fit: np.ndarray, codes: np.ndarray, known: np.ndarray, offset: np.ndarray, when: np.ndarray, rows: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    values = codes.shape[1]
    value, slope = np.empty((values, rows)), np.empty((5, values, rows))
    nearest = np.empty((values, rows), np.int64)
    _kernels.model(codes, known, offset, when, PROFILE, fit, value, slope, nearest)
    return value, slope, nearest


@pytest.mark.parametrize("seed", range(3))
def test_model_is_the_profile_and_its_slopes_are_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    codes = rng.choice([-1, 1], (K, 4))
    known = rng.random((K + 1, 4)) > 0.1
    offset, when = rng.uniform(-0.5, 0.5, 4), np.linspace(-0.5, 0.5, 4)
    fit = np.array([7.3, 0.4, 0.3, 0.8, 0.1])
    value, slope, nearest = model_of(fit, codes, known, offset, when, 130)
    rows = np.arange(130) - 64.5

    def wanted(fit: np.ndarray) -> np.ndarray:
        """Every boundary's profile at every row, (4, 130)."""
        at = rows - offset[:, None] - fit[1] - fit[2] * when[:, None]
        share = profile_of(at[..., None] - fit[0] * (np.arange(1, K) - K / 2), fit[4])
        return fit[3] * (codes[0, :, None] + np.einsum("ivb,bi->iv", share, np.diff(codes, axis=0)))

    want, counts = wanted(fit), ~np.isnan(value)
    # The tails end at four of their sigmas.
    assert_allclose(value[counts], want[counts], atol=2e-4)
    assert np.array_equal(nearest >= 0, counts)
    at = rows - offset[:, None] - fit[1] - fit[2] * when[:, None]
    place = np.rint(at / fit[0] + K / 2).astype(int)
    assert np.array_equal(nearest[counts], place[counts])
    inside = (place >= 1) & (place <= K - 1)
    assert np.array_equal(counts, inside & known[np.clip(place, 0, K), np.arange(4)[:, None]])
    assert (counts.sum(1) > 60).all()
    for a in range(5):
        step = np.zeros(5)
        step[a] = 1e-6
        differences = (wanted(fit + step) - wanted(fit - step)) / 2e-6
        # A tail that is cut off at four of its sigmas has this slope there, by the place of the outermost.
        assert_allclose(slope[a][counts], differences[counts], atol=1e-2 if a == 0 else 2e-3)


def test_column_light_is_the_mean_size_beside_the_line() -> None:
    rng = np.random.default_rng(3)
    sums = rng.integers(-6, 7, (8, 20, 15)).astype(np.int16)
    line = np.array([5.0, 0.2])
    out = np.empty(9)
    _kernels.column_light(sums, line, 3, 16, 3.0, out)
    want = np.zeros(9)
    for v in range(3, 17):
        middle = int(np.rint(5 + 0.2 * v))
        for off in range(-4, 5):
            if 0 <= middle + off < 15:
                want[4 + off] += np.minimum(np.abs(sums[1::2, v, middle + off]) / 3.0, 1).sum()
    assert_allclose(out, want / (14 * 4))


def test_row_values_are_clipped_weighted_means() -> None:
    rng = np.random.default_rng(1)
    sums = rng.integers(-6, 7, (8, 20, 15)).astype(np.int16)
    line = np.array([5.0, 0.2])
    weight = np.array([0.1, 0.5, 1.0, 0.6, 0.0])
    out = np.empty((4, 20))
    _kernels.row_values(sums, line, weight, 3.0, out)
    for v in range(20):
        columns = int(np.rint(5 + 0.2 * v)) + np.arange(-2, 3)
        inside = (columns >= 0) & (columns < 15)
        clipped = np.clip(sums[1::2, v][:, columns[inside]] / 3.0, -1, 1)
        assert_allclose(out[:, v], np.average(clipped, axis=1, weights=weight[inside]))


def test_the_profile_from_tables_is_the_profile_to_a_millionth() -> None:
    for z in np.linspace(-12, 12, 999):
        share, slope = _kernels._across(z, 0.45, 1.35, 0.8)
        assert share == pytest.approx(0.8 * norm.cdf(z / 0.45) + 0.2 * norm.cdf(z / 1.35), abs=2e-6)
        assert slope == pytest.approx(
            0.8 / 0.45 * norm.pdf(z / 0.45) + 0.2 / 1.35 * norm.pdf(z / 1.35), abs=2e-6
        )


@pytest.mark.parametrize("seed", range(3))
def test_normal_equations_scores_and_shifts_are_huber_s(seed: int) -> None:
    rng = np.random.default_rng(seed)
    codes = rng.choice([-1, 1], (K, 6))
    known = rng.random((K + 1, 6)) > 0.1
    offset, when = rng.uniform(-0.5, 0.5, 6), np.linspace(-0.5, 0.5, 6)
    fit = np.array([6.1, 0.2, 0.1, 0.7, 0.2])
    value, slope, nearest = model_of(fit, codes, known, offset, when, 90)
    seen = np.nan_to_num(value) + rng.normal(0, 0.5, value.shape)
    normal, right, meat = np.empty((5, 5)), np.empty(5), np.empty((5, 5))
    cost = _kernels.equations(codes, known, offset, when, PROFILE, 0.5, 2.0, seen, fit, normal, right)
    good = ~np.isnan(value)
    r = (seen - value)[good]
    j = slope[:, good]
    w = np.minimum(1, 0.5 / np.abs(r))
    prior = np.diag([0, 0, 0, 0, 2.0])
    # The profile comes from tables that are good to a millionth, and this is a sum over hundreds of rows.
    assert_allclose(normal, (j * w) @ j.T + prior, rtol=1e-5, atol=2e-4)
    assert_allclose(right, (j * w) @ r - prior @ fit, rtol=1e-5, atol=2e-4)
    want = np.where(np.abs(r) <= 0.5, r**2 / 2, 0.5 * (np.abs(r) - 0.25)).sum()
    assert cost == pytest.approx(want + 2.0 * fit[4] ** 2 / 2, rel=1e-5)
    rows = _kernels.row_scores(seen, value, slope, 0.5, meat)
    clipped = np.where(good, np.clip(seen - value, -0.5, 0.5), 0)
    scores = (slope * clipped).sum(1)
    assert_allclose(meat, scores @ scores.T)
    assert rows == good.any(0).sum()
    by_boundary, by_value = np.empty((2, K + 1)), np.empty((2, 6))
    noise = _kernels.shifts(seen, value, slope, nearest, 0.5, by_boundary, by_value)
    assert noise == pytest.approx(np.square(clipped[good]).mean())
    for got, which in ((by_boundary, nearest), (by_value, np.indices(nearest.shape)[0])):
        for n in range(got.shape[1]):
            own = good & (which == n)
            information = np.square(slope[1][own]).sum()
            assert got[1, n] == pytest.approx(information)
            if information:
                assert got[0, n] == pytest.approx((slope[1] * clipped)[own].sum() / information)


def test_solve_leaves_no_score() -> None:
    rng = np.random.default_rng(5)
    codes = rng.choice([-1, 1], (K, 16))
    known = np.ones((K + 1, 16), np.bool_)
    offset, when = rng.uniform(-0.5, 0.5, 16), (np.arange(16) + 0.5) / 16 - 0.5
    truth = np.array([7.31, 0.3, 0.4, 0.7, 0.1])
    seen = np.nan_to_num(model_of(truth, codes, known, offset, when, 124)[0])
    seen += rng.normal(0, 0.3, seen.shape)
    fit, normal = truth * [1.004, 1, 1, 1, 0], np.empty((5, 5))
    assert _kernels.solve(codes, known, offset, when, PROFILE, 0.5, 2.0, seen, 50, 1e-12, fit, normal)

    value, slope, _ = model_of(fit, codes, known, offset, when, 124)
    good = ~np.isnan(value)
    left = np.clip(seen - value, -0.5, 0.5)[good]
    score = slope[:, good] @ left - 2.0 * fit * [0, 0, 0, 0, 1]
    # No score is left: a thousandth of a standard deviation of each.
    assert (np.abs(score) < 1e-3 * np.sqrt(np.diag(normal))).all()
    sigma = np.sqrt(np.diag(np.linalg.inv(normal))) * 0.3
    assert (np.abs(fit - truth) < 4 * sigma).all()


def test_cells_out_of_place_do_not_count() -> None:
    rng = np.random.default_rng(6)
    selected = np.zeros((K, 60, 30), np.bool_)
    for k in range(K):
        selected[k, 4 + 3 * k : 7 + 3 * k, 10:12] = True
    # A dimmer image beside it, and strays.
    for k in range(0, K, 2):
        selected[k, 4 + 3 * k : 6 + 3 * k, 22] = True
    selected[3, 50:53, 10:12] = True
    selected |= rng.random(selected.shape) < 0.001
    medians = np.empty((K, 2))
    _kernels.cell_medians(selected, medians)
    for k in range(K):
        rows, columns = np.nonzero(selected[k])
        # Within the half cell that the bins leave.
        assert abs(medians[k, 0] - np.median(rows)) <= 1
        assert abs(medians[k, 1] - np.median(columns)) <= 1
    line = (5.0, 3.0, 10.5, 0.0)
    across, found = np.empty(5, np.int64), np.empty((K, 2))
    _kernels.cells_in_place(selected, line, 2.5, across, found)
    counts = np.zeros(5, np.int64)
    for k in range(K):
        rows, columns = np.nonzero(selected[k])
        off = np.rint(columns - 10.5).astype(int)
        near = (np.abs(rows - 5 - 3 * k) <= 2.5) & (np.abs(off) <= 2)
        counts += np.bincount(off[near] + 2, minlength=5)
        assert_allclose(found[k], [rows[near].mean(), columns[near].mean()])
    assert np.array_equal(across, counts)


def test_straight_is_theil_sen() -> None:
    rng = np.random.default_rng(7)
    x = np.arange(12.0)
    y = 2.5 * x + 1 + rng.normal(0, 0.1, 12)
    y[3] = 90.0
    slope, left = _kernels.straight(x, y)
    assert slope == pytest.approx(theilslopes(y, x)[0])
    assert left == pytest.approx(np.median(y - slope * x))


def noisy_fit(distance_m: float, noise: float, seed: int) -> tuple[float, np.ndarray]:
    """The fit's distance for a frame made of the model plus Gaussian noise, and the symbols."""
    rng = np.random.default_rng(seed)
    symbols = rng.integers(0, 64, K)
    codes = np.concatenate([PILOTS, WORDS[symbols]], axis=1).astype(np.int64)
    spacing = LINK.camera.focal_px * 0.06 / distance_m
    rows = 2 * int(spacing * 8 + 4)
    at = np.arange(rows) - (rows - 1) / 2
    share = norm.cdf((at[:, None] - spacing * (np.arange(1, K) - K / 2)) / 0.45)
    ideal = 0.8 * (codes[0] + share @ np.diff(codes, axis=0)).T
    values = ideal + rng.normal(0, noise / np.sqrt(5), ideal.shape)
    start = np.array([1.005 * spacing, 0.1, 0.0, 0.8, 0.0])
    known = np.ones((K + 1, 16), np.bool_)
    known[[0, K]] = False
    # With the profile of the bound: a normal distribution.
    joint = JointScaleRanging(huber=9.0, blur_px=0.45, core_share=1.0)
    found = joint._fit(codes, known, np.zeros(16), values, start, 6)
    assert found is not None
    return LINK.camera.focal_px * 0.06 / found[0][0], symbols


def test_the_fit_reaches_the_cramer_rao_bound() -> None:
    noise, errors, bounds = 0.4, [], []
    for seed in range(80):
        distance_m, symbols = noisy_fit(55.0, noise, seed)
        errors.append(distance_m - 55)
        bounds.append(
            cramer_rao_sigma_m(LINK.camera, LINK.bar, LINK.codebook, 55.0, symbols, blur_px=0.45, noise=noise)
        )
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(bounds)))
    # The error of 80 draws is known to 8 %: three of these.
    assert 0.76 < ratio < 1.24
