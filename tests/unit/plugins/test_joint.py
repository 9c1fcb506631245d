"""The joint fit of all boundaries: kernels against twins, ideal images at known distances, damaged ones."""

from dataclasses import replace

import numpy as np
import pytest
from evlcp_joint import _kernels
from evlcp_joint.ranging import JointScaleRanging, profile
from numpy.testing import assert_allclose
from scipy.stats import norm, theilslopes

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.scene.bar import BarLayout, LedColumns
from evlcp_sdk.study.bound import bar_bound
from evlcp_sdk.values import FrameView, PresenceMap, Range, SoftSymbols

LINK = load_link()
PILOTS = LINK.codebook.pilot_edges.astype(float)
WORDS = LINK.codebook.codeword_edges.astype(float)
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
    sigma_m = []
    for seed in range(4, 12):
        view = view_of(50.0, noise=0.5, seed=seed)
        symbols = view.soft.symbols.copy()
        symbols[[2, 3, 9]] = -1
        soft = SoftSymbols(symbols, view.soft.llr, 1.0)
        found = measured(FrameView(view.sums, view.offset_px, view.presence, soft))
        assert found.distance_m == pytest.approx(50, rel=4e-3)
        assert found.pairs == 15
        # Guessed at, they would be left out or bend the fit.
        symbols[[2, 3, 9]] = (view.soft.symbols[[2, 3, 9]] + 1) % 64
        guessed = measured(FrameView(view.sums, view.offset_px, view.presence, soft))
        sigma_m.append((found.sigma_m, guessed.sigma_m))
    assert np.mean(sigma_m, 0)[0] < np.mean(sigma_m, 0)[1], sigma_m


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


def side_by_side(view: FrameView) -> FrameView:
    """The lower half of a bar, moved beside the upper one."""
    _, height, _ = view.sums.shape
    # The row of the middle boundary, in whole cells: what is cut off belongs to no pair of neighbours.
    half = height // 4 * 2

    def moved(image: np.ndarray, rows: int) -> np.ndarray:
        return np.concatenate([image[:, :rows], image[:, rows : 2 * rows]], axis=2)

    seen, dark = view.presence, np.zeros((K // 2, half // 2, view.sums.shape[2] // 2), np.bool_)
    upper = np.concatenate([seen.selected[: K // 2, : half // 2], dark], axis=2)
    lower = np.concatenate([dark, seen.selected[K // 2 :, half // 2 : half]], axis=2)
    selected = np.concatenate([upper, lower])
    sums = moved(view.sums, half)
    pixels = np.zeros((K, *sums.shape[1:]), np.float32)
    presence = PresenceMap(selected.astype(np.float32), 2, selected, pixels)
    return replace(view, sums=sums, presence=presence)


def test_two_columns_give_the_distance_of_both_and_its_sigma() -> None:
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


BLUR, SHARE = 0.2, 0.4


def test_profile_is_a_mixture_of_normal_distributions() -> None:
    table = profile(SHARE)
    z = np.linspace(0, _kernels.REACH, table.shape[1])
    assert_allclose(table[0], 2 * (SHARE * norm.cdf(z) + (1 - SHARE) * norm.cdf(z / 3)) - 1, atol=1e-12)
    assert_allclose(table[1], 2 * (SHARE * norm.pdf(z) + (1 - SHARE) * norm.pdf(z / 3) / 3), atol=1e-12)


PRIOR = np.array(_kernels.PRIOR)
DIM = 0.6
"""How large negative values are, as a share of the positive ones."""


class Twin:
    """Values about boundaries, fitted: each boundary by itself, with the profile from SciPy."""

    def __init__(self, seed: int, rows: int = 90) -> None:
        rng = np.random.default_rng(seed)
        self.codes = rng.choice([-1.0, 1.0], (K, 6))
        # Four values of a pilot, two of each cluster's own word.
        read, seen = rng.random((2, K)) > 0.05
        self.said = self.codes[:, :4].copy(), self.codes[:, 4:].copy(), np.where(read, np.arange(K), -1), seen
        shown = np.repeat(np.stack([seen, seen & read], 1), [4, 2], axis=1)
        self.known = np.zeros((K + 1, 6), np.bool_)
        self.known[1:-1] = shown[1:] & shown[:-1]
        self.offset_px, self.when = rng.uniform(-0.6, 0.6, 12), (np.arange(6) + 0.5) / 6 - 0.5
        first, second = self.offset_px.reshape(6, 2).T
        # Half a chip before the second one's middle, but for the whole pixels that images are moved by.
        self.offset = second - (second - first - np.rint(second - first)) / 2
        self.fit = np.array([5.3, 0.2, 0.1, 0.7, 0.2, 0.07, -0.03])
        self.rows = rows
        reach = _kernels.REACH * BLUR * np.exp(0.2)
        self.reach = min(reach, 5.3 / 2)
        self.seen = 0.7 * rng.choice([-1.0, 1.0], (6, rows)) + rng.normal(0, 0.5, (6, rows))
        self.motion, self.lens = np.stack([self.offset, self.when]), (BLUR, DIM)
        self.profile = profile(SHARE)

    def steps(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        reach = _kernels.REACH * BLUR * np.exp(0.2)
        return _kernels.list_steps(self.codes, self.known, self.motion, reach, self.fit, seen)

    def place(self, fit: np.ndarray, b: int, i: int) -> float:
        middle = (self.rows - 1) / 2 + self.offset[i] + fit[1] + fit[2] * self.when[i]
        up = np.sign(self.codes[b, i] - self.codes[b - 1, i])
        repeats = self.codes[b - 1 : b + 1, i] == self.codes[b - 1 : b + 1, i - 1] if i else np.zeros(2)
        return float(middle + fit[0] * (b - K / 2) + up * fit[5] + (repeats * [-1, 1]).sum() * fit[6])

    def cells(self, fit: np.ndarray) -> np.ndarray:
        """Boundary, value, row and expected value of each cell."""
        out = []
        for b in range(1, K):
            for i in range(6):
                if self.known[b, i] and self.codes[b, i] != self.codes[b - 1, i]:
                    # Rows stay those of the fit that they were found for.
                    at = self.place(self.fit * [1, 1, 1, 1, 1, 0, 0], b, i)
                    for v in range(self.rows):
                        if at - self.reach <= v < at + self.reach:
                            z = (v - self.place(fit, b, i)) / (BLUR * np.exp(fit[4]))
                            share = SHARE * norm.cdf(z) + (1 - SHARE) * norm.cdf(z / 3)
                            value = self.codes[b - 1, i] * (1 - share) + self.codes[b, i] * share
                            out.append((b, i, v, fit[3] * value * (DIM if value < 0 else 1)))
        return np.array(out)

    def slopes(self) -> np.ndarray:
        """By differences, float64 (7, cells)."""
        step = 1e-5 * np.eye(7)
        return np.array(
            [(self.cells(self.fit + s)[:, 3] - self.cells(self.fit - s)[:, 3]) / 2e-5 for s in step]
        )


@pytest.mark.parametrize("seed", range(3))
def test_normal_equations_are_huber_s(seed: int) -> None:
    twin = Twin(seed)
    b, i, v = twin.cells(twin.fit)[:, :3].astype(int).T
    assert len(b) > 100
    r = twin.seen[i, v] - twin.cells(twin.fit)[:, 3]
    j = twin.slopes()
    w = np.minimum(1, 0.5 / np.abs(r))
    normal, right = np.empty((7, 7)), np.empty(7)
    steps = twin.steps(twin.seen)
    cost = _kernels.equations(*steps, twin.profile, twin.lens, twin.fit, normal, right)
    prior = np.diag(PRIOR)
    # The profile is of straight pieces.
    assert_allclose(normal, (j * w) @ j.T + prior, rtol=1e-3, atol=0.05)
    assert_allclose(right, (j * w) @ r - prior @ twin.fit, rtol=1e-3, atol=0.02)
    want = np.where(np.abs(r) <= 0.5, r**2 / 2, 0.5 * (np.abs(r) - 0.25)).sum()
    assert cost == pytest.approx(want + PRIOR @ twin.fit**2 / 2, rel=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_leftovers_are_by_boundary_value_and_row(seed: int) -> None:
    twin = Twin(seed)
    b, i, v = twin.cells(twin.fit)[:, :3].astype(int).T
    r = twin.seen[i, v] - twin.cells(twin.fit)[:, 3]
    j, clipped = twin.slopes(), np.clip(r, -0.5, 0.5)
    by_boundary, by_value, scores = np.empty((3, K + 1)), np.empty((2, 6)), np.empty((90, 7))
    noise, spent, squares = _kernels.leftovers(
        *twin.steps(twin.seen), twin.profile, twin.lens, twin.fit, by_boundary, by_value, scores
    )
    assert noise == pytest.approx((clipped**2).mean(), rel=1e-4)
    assert spent == pytest.approx((r**2).sum(), rel=1e-4)
    assert squares == pytest.approx((twin.seen[i, v] ** 2).sum())
    turns = np.array([np.sin(2 * np.pi * twin.place(twin.fit, *at)) for at in zip(b, i, strict=True)])
    for n in np.unique(b):
        own = b == n
        assert by_boundary[2, n] == pytest.approx(np.average(turns[own], weights=j[1, own] ** 2), abs=2e-3)
    for got, which in ((by_boundary, b), (by_value, i)):
        for n in range(got.shape[1]):
            own = which == n
            information = (j[1, own] ** 2).sum()
            assert got[1, n] == pytest.approx(information, rel=1e-3, abs=1e-9)
            if information:
                assert got[0, n] == pytest.approx((j[1, own] @ clipped[own]) / information, abs=1e-3)
    want = np.array([(j[:, v == n] * clipped[v == n]).sum(1) for n in range(90)])
    assert_allclose(scores, want, atol=5e-3)


@pytest.mark.parametrize("spacing", [0.9, -0.9])
def test_rows_are_weighed_by_the_light_between_a_bars_ends(spacing: float) -> None:
    rng = np.random.default_rng(3)
    sums = rng.integers(-6, 7, (8, 20, 15)).astype(np.int16)
    line = np.array([3.4 if spacing > 0 else 16.9, spacing, 5.0, 0.2, 1.7])
    ends = np.sort(line[0] + spacing * np.array([-0.5, K - 0.5]))
    out = np.empty((4, 20))
    _kernels.read_rows(sums, line, K, out)
    middle = np.rint(5 + 0.2 * np.arange(20)).astype(int)
    columns = middle[:, None] + np.arange(-2, 3)
    inside = columns < 15
    beside = sums[1::2, np.arange(20)[:, None], np.minimum(columns, 14)] * inside
    clipped = np.clip(beside / 3.0, -1, 1)
    light = np.abs(clipped[:, int(ends[0]) : int(ends[1]) + 1]).sum((0, 1))
    weight = np.maximum(light - 0.3 * light.max(), 0) * inside
    assert_allclose(out, (clipped * weight).sum(2) / weight.sum(1))


def test_cells_out_of_place_do_not_count() -> None:
    """A dimmer image beside the bar, cells of a cluster elsewhere, and strays."""
    selected = np.random.default_rng(6).random((K, 60, 30)) < 0.001
    for k in range(K):
        selected[k, 4 + 3 * k : 7 + 3 * k, 10:12] = True
        selected[k, 4 + 3 * k : 6 + 3 * k, 22] = k % 2 == 0
    selected[3, 50:53, 10:12] = True
    middles, line, seen = np.empty((K, 2)), np.empty(5), np.empty(K, np.bool_)
    assert not _kernels.find_middles(selected, middles)
    assert _kernels.find_line(selected, 2, middles, line, seen)
    assert seen.all()
    assert_allclose(middles, np.stack([5 + 3 * np.arange(K), np.full(K, 10.5)], 1), atol=0.4)
    # In pixels, of which a cell has two: where it begins, spacing, column, tilt, half the width.
    assert_allclose(line, [10.5, 6, 21.5, 0, 2], atol=0.05)
    selected[2:] = False
    _kernels.find_middles(selected, middles)
    assert not _kernels.find_line(selected, 2, middles, line, seen)


def test_the_line_is_theil_sen() -> None:
    rng = np.random.default_rng(7)
    rows = 2.5 * np.arange(12.0) + 1 + rng.normal(0, 0.1, 12)
    rows[3] = 90.0
    middles = np.stack([rows, 0.1 * rows + rng.normal(0, 0.1, 12)], 1)
    middles[5] = np.nan
    line = np.empty(4)
    assert _kernels.fit_line(middles, line)
    seen = np.flatnonzero(np.isfinite(middles[:, 0]))
    for at, x, y in ((0, seen, middles[seen, 0]), (2, middles[seen, 0], middles[seen, 1])):
        assert line[at + 1] == pytest.approx(theilslopes(y, x)[0])
        assert line[at] == pytest.approx(np.median(y - line[at + 1] * x))
    middles[2:] = np.nan
    assert not _kernels.fit_line(middles, line)


def own_motion(shift: np.ndarray, information: np.ndarray, when: np.ndarray) -> np.ndarray:
    """What is left of a weighted straight line, shrunk by the share of its variance that is not noise."""
    weight = np.maximum(information, 1e-12)
    left = shift - np.polyval(np.polyfit(when, shift, 1, w=np.sqrt(weight)), when)
    variance = (weight @ left**2 - (len(shift) - 2)) / weight.sum()
    return left * variance / (variance + 1 / weight) if variance > 0 else 0 * left


@pytest.mark.parametrize("size", [0.0, 0.1, 1.0])
def test_motion_stands_out_of_the_noise_or_is_none(size: float) -> None:
    rng = np.random.default_rng(9)
    when, information = np.linspace(-0.5, 0.5, 16), rng.uniform(20, 200, 16)
    shift = 0.3 * when + size * np.sin(9 * when) + rng.normal(0, 1, 16) / np.sqrt(information)
    out = np.empty(16)
    _kernels.own_motion(shift, information, when, out)
    assert_allclose(out, own_motion(shift, information, when), rtol=1e-6, atol=1e-9)
    assert size < 1 or np.abs(out).max() > 0.5


def test_the_variance_is_the_mean_of_the_rows_and_of_the_boundaries() -> None:
    """The sandwich estimator of rows as observations, and the slope of a weighted line of boundaries."""
    rng = np.random.default_rng(5)
    (off, weight, wave), scores, root = (
        rng.random((3, K + 1)),
        rng.normal(size=(30, 7)),
        rng.normal(size=(7, 7)),
    )
    weight[[0, 4]] = scores[5] = 0
    variance, many, wider_px = _kernels.assess_fit(np.stack([off, weight, wave]), scores, root @ root.T)
    place, used = np.arange(K + 1.0), weight > 0
    by_rows = ((scores @ np.linalg.inv(root @ root.T)[0]) ** 2).sum() * 29 / (29 - 7)
    spread = (weight * (place - np.average(place, weights=weight)) ** 2).sum()
    by_boundaries = (weight * off**2).sum() / (many - 2) / spread
    assert variance == pytest.approx((by_rows + by_boundaries) / 2)
    assert (many, wider_px) == (
        15,
        pytest.approx(np.polyfit(place[used], wave[used], 1, w=weight[used] ** 0.5)[0]),
    )


@pytest.mark.parametrize("spacing", [5.3, -5.3])
def test_how_dim_negative_values_are(spacing: float) -> None:
    rng = np.random.default_rng(4)
    seen, rows = rng.random(K) > 0.2, 90
    sums = rng.choice([-3, -1, 0, 1, 2], (32, rows, 15), p=[0.1, 0.1, 0.3, 0.2, 0.3]).astype(np.int16)
    place = np.array([4.0 if spacing > 0 else 85.0, spacing, 7.0, 0.01, 2.4])
    answers: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for k in np.flatnonzero(seen):
        for v in range(rows):
            if abs(v - place[0] - k * spacing) <= abs(spacing) / 4:
                middle = round(7 + 0.01 * v)
                of = sums[1:16:2, v, middle - 2 : middle + 3]
                for up in (True, False):
                    mine = of[(PILOTS[k] > 0) == up]
                    answers[up].append((mine > 0 if up else mine < 0).ravel())
    shares = {up: np.concatenate(of).mean() for up, of in answers.items()}
    pilots = PILOTS.astype(np.float64)
    assert _kernels.measure_dim(sums, pilots, seen, place) == pytest.approx(shares[False] / shares[True])
    assert _kernels.measure_dim(-np.abs(sums), pilots, seen, place) == 1.0


def random_codes(rng):
    return np.concatenate([PILOTS, WORDS[rng.integers(0, 64, K)]], axis=1)


STILL = np.zeros(32)


def fit_of(codes, dim, values, spacing, offset_px=STILL):
    """The fit of a frame's values, of boundaries .45 px wide without tails, and where they lie off it."""
    said = codes, codes[:, :0].copy(), np.zeros(K, np.int64), np.ones(K, np.bool_)
    fit = np.array([1.005 * spacing, 0.1, 0.0, 0.8, 0.0, 0.0, 0.0])
    (variance, *_), by_boundary = _kernels.fit_bar(said, offset_px, values, profile(1.0), (0.45, dim), 6, fit)
    assert variance > 0
    return fit, by_boundary[:, 1:-1]


def values_of(codes, places, rows):
    """Of each row, about boundaries at these places, .45 px wide: float64 (values, rows)."""
    share = norm.cdf((np.arange(rows)[:, None] - places) / 0.45)
    # In rows: of columns the kernels would be compiled once more, for a third of this file's time.
    return np.ascontiguousarray((codes[0] + share @ np.diff(codes, axis=0)).T)


@pytest.mark.parametrize("dim", [0.05, 0.5, 2.0])
def test_boundaries_stay_where_one_sign_is_missed(dim: float) -> None:
    """Pilots, and symbols, say more steps of one sign at some boundaries."""
    codes, spacing = random_codes(np.random.default_rng(3)), 8.6
    values = 0.6 * values_of(codes, 74.5 + spacing * (np.arange(1, K) - K / 2), 150)
    values *= np.where(values < 0, dim, 1)
    fit, _ = fit_of(codes, dim, values, spacing)
    assert fit[0] == pytest.approx(spacing, rel=2e-5)


def test_boundaries_out_of_line_are_left_out_and_shown() -> None:
    """By up to half a pixel: of those farther off, a row's values say no more."""
    codes, spacing = random_codes(np.random.default_rng(5)), 8.6
    shift = np.zeros(K - 1)
    shift[[3, 12]] = 0.5, -0.4
    values = 0.6 * values_of(codes, 74.5 + spacing * (np.arange(1, K) - K / 2) + shift, 150)
    fit, (off, weight, _) = fit_of(codes, 1.0, values, spacing)
    assert fit[0] == pytest.approx(spacing, rel=1e-4)
    assert np.flatnonzero(weight == 0).tolist() == [3, 12]
    # As seen against a fit that they bent.
    assert_allclose(off, shift, atol=0.16)


def test_shifts_by_sign_and_by_repeated_values_are_found() -> None:
    """Steps up lie 0.08 px lower than steps down, and what repeats a value looks smaller by 0.05 px."""
    codes, spacing = random_codes(np.random.default_rng(7)), 8.6
    boundaries, values = 74.5 + spacing * (np.arange(1, K) - K / 2), np.empty((16, 150))
    for i in range(16):
        again = codes[:, i] == codes[:, i - 1] if i else np.zeros(K)
        shift = 0.04 * np.sign(np.diff(codes[:, i])) + 0.05 * np.diff(again.astype(float))
        values[i] = 0.6 * values_of(codes[:, i : i + 1], boundaries + shift, 150)[0]
    fit, (off, weight, _) = fit_of(codes, 1.0, values, spacing)
    assert fit[0] == pytest.approx(spacing, rel=2e-5)
    # The prior takes up to a tenth of them.
    assert_allclose(fit[5:], [0.04, 0.05], rtol=0.12)
    assert (weight > 0).all()
    assert np.abs(off).max() < 0.005


def test_a_value_is_read_half_a_chip_before_its_second_chips_middle() -> None:
    """Also where the image, held still by whole pixels, jumps between its chips."""
    codes, spacing = random_codes(np.random.default_rng(7)), 8.6
    place, values = 0.34 * (np.arange(32) + 0.5), np.empty((16, 150))
    for i in range(16):
        seen = 0.34 * (2 * i + 1) - np.rint(place[2 * i + 1])
        boundaries = 74.5 + seen + spacing * (np.arange(1, K) - K / 2)
        values[i] = 0.6 * values_of(codes[:, i : i + 1], boundaries, 150)[0]
    fit, _ = fit_of(codes, 1.0, values, spacing, place - np.rint(place))
    # Spacing, place and drift.
    assert_allclose(fit[:3], [spacing, 0, 0], atol=1e-5)


def test_a_wave_of_the_pixels_shows_in_the_boundaries() -> None:
    """Boundaries seem off by 0.02 px times the sine of their place on the pixels."""
    codes, spacing, b = random_codes(np.random.default_rng(8)), 8 + 1 / 15, np.arange(1, K) - K / 2
    places = 74.7 + spacing * b
    seem = places + 0.02 * np.sin(2 * np.pi * places)
    fit, (off, weight, wave) = fit_of(codes, 1.0, 0.6 * values_of(codes, seem, 150), spacing)
    assert_allclose(wave, np.sin(2 * np.pi * places), atol=0.2)
    # What a straight line through the wave does not take up is left, and that it takes up is the spacing's.
    terms = np.stack([np.ones(K - 1), b], 1)
    line = np.linalg.lstsq(terms * np.sqrt(weight)[:, None], wave * np.sqrt(weight))[0]
    # The fit takes some of it for what its own wave makes of boundaries that are half a pixel wide.
    assert_allclose(off, 0.02 * (wave - terms @ line), atol=0.005)
    assert np.corrcoef(off, wave - terms @ line)[0, 1] > 0.98
    assert fit[0] - spacing == pytest.approx(0.02 * line[1], rel=0.25)


def noisy_fit(distance_m: float, noise: float, seed: int) -> tuple[float, np.ndarray]:
    """The fit's distance for a frame made of the model plus Gaussian noise, and the symbols."""
    rng = np.random.default_rng(seed)
    symbols = rng.integers(0, 64, K)
    codes = np.concatenate([PILOTS, WORDS[symbols]], axis=1)
    spacing = LINK.camera.focal_px * 0.06 / distance_m
    rows = 2 * int(spacing * 8 + 4)
    ideal = 0.8 * values_of(codes, (rows - 1) / 2 + spacing * (np.arange(1, K) - K / 2), rows)
    # With the profile of the bound: a normal distribution.
    fit, _ = fit_of(codes, 1.0, ideal + rng.normal(0, noise / np.sqrt(5), ideal.shape), spacing)
    return LINK.camera.focal_px * 0.06 / fit[0], symbols


def test_the_fit_reaches_the_cramer_rao_bound() -> None:
    noise, errors, bounds = 0.4, [], []
    for seed in range(80):
        distance_m, symbols = noisy_fit(55.0, noise, seed)
        errors.append(distance_m - 55)
        bounds.append(bar_bound(LINK, 55.0, symbols, blur_px=0.45, noise=noise))
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(bounds)))
    # The error of 80 draws is known to 8 %: three of these.
    assert 0.76 < ratio < 1.24
