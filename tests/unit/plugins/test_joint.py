"""The joint fit of all boundaries: kernels against twins, ideal images at known distances, damaged ones."""

import numpy as np
import pytest
from evlcp_joint import _kernels
from evlcp_joint.ranging import JointScaleRanging
from numpy.testing import assert_allclose
from scipy.stats import norm

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
    found = measured(view_of(distance_m, shift_px=shift_px))
    # Whole events of three at most, and no noise to smooth them, leave some tenths of a pixel a boundary.
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


@pytest.mark.parametrize("seed", range(3))
def test_model_is_the_normal_distribution_and_its_slopes_are_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    codes = rng.choice([-1, 1], (K, 4))
    seen = rng.random(K) > 0.1
    offset, when = rng.uniform(-0.5, 0.5, 4), np.linspace(-0.5, 0.5, 4)
    fit = np.array([7.3, 0.4, 0.3, 0.8])

    def value_of(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, slope = np.empty((4, 130)), np.empty((4, 4, 130))
        _kernels.model(codes, seen, offset, when, 0.5, at, value, slope)
        return value, slope

    value, slope = value_of(fit)
    rows = np.arange(130) - 64.5
    for i in range(4):
        at = rows - offset[i] - fit[1] - fit[2] * when[i]
        cdf = norm.cdf((at[:, None] - fit[0] * (np.arange(1, K) - K / 2)) / 0.5)
        want = fit[3] * (codes[0, i] + cdf @ np.diff(codes[:, i]))
        counts = ~np.isnan(value[i])
        assert counts.sum() > 60
        # Further boundaries are left out: seven spacings of blur away.
        assert_allclose(value[i, counts], want[counts], atol=1e-9)
    for a in range(4):
        step = np.zeros(4)
        step[a] = 1e-6
        up, down = value_of(fit + step)[0], value_of(fit - step)[0]
        both = ~np.isnan(up) & ~np.isnan(down)
        assert_allclose(slope[a][both], ((up - down) / 2e-6)[both], atol=1e-5)


def test_row_values_are_clipped_means() -> None:
    rng = np.random.default_rng(1)
    sums = rng.integers(-6, 7, (8, 20, 15)).astype(np.int16)
    line = np.array([5.0, 0.2])
    out = np.empty((4, 20))
    _kernels.row_values(sums, line, 2.0, 3.0, out)
    for v in range(20):
        middle = 5 + 0.2 * v
        columns = [u for u in range(15) if abs(u - middle) <= 2.0]
        want = np.clip(sums[1::2, v][:, columns] / 3.0, -1, 1).mean(1)
        assert_allclose(out[:, v], want)


def test_normal_equations_are_huber_s() -> None:
    rng = np.random.default_rng(2)
    seen, value = rng.normal(size=(3, 12)), rng.normal(size=(3, 12))
    value[1, 4] = np.nan
    slope = rng.normal(size=(4, 3, 12))
    normal, right, meat = np.empty((4, 4)), np.empty(4), np.empty((4, 4))
    cost = _kernels.step_of(seen, value, slope, 0.5, normal, right)
    rows = _kernels.row_scores(seen, value, slope, 0.5, meat)
    good = ~np.isnan(value)
    r = (seen - value)[good]
    J = slope[:, good]
    w = np.minimum(1, 0.5 / np.abs(r))
    assert_allclose(normal, (J * w) @ J.T)
    assert_allclose(right, (J * w) @ r)
    assert cost == pytest.approx(np.where(np.abs(r) <= 0.5, r**2 / 2, 0.5 * (np.abs(r) - 0.25)).sum())
    clipped = np.where(good, np.clip(seen - value, -0.5, 0.5), 0)
    scores = (slope * clipped).sum(1)
    assert_allclose(meat, scores @ scores.T)
    assert rows == 12


def noisy_fit(distance_m: float, noise: float, seed: int) -> tuple[float, np.ndarray]:
    """The fit's distance for a frame made of the model plus Gaussian noise, and the symbols."""
    rng = np.random.default_rng(seed)
    symbols = rng.integers(0, 64, K)
    codes = np.concatenate([PILOTS, WORDS[symbols]], axis=1).astype(np.int64)
    spacing = LINK.camera.focal_px * 0.06 / distance_m
    rows = 2 * int(spacing * 8 + 4)
    fit = np.array([spacing, 0.0, 0.0, 0.8])
    value, slope = np.empty((16, rows)), np.empty((4, 16, rows))
    seen, when = np.ones(K, bool), np.arange(16) / 16 - 0.5
    _kernels.model(codes, seen, np.zeros(16), when, 0.45, fit, value, slope)
    seen_values = np.nan_to_num(value) + rng.normal(0, noise / np.sqrt(5), value.shape)
    start = fit * [1.005, 1, 1, 1] + [0, 0.1, 0, 0]
    found = JointScaleRanging(huber=9.0)._fit(codes, seen, np.zeros(16), seen_values, start)
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
