"""The Cramer-Rao bounds: their laws, closed forms, and statistics from frames that follow the models."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.study.bound import bar_bound, frame_bound
from evlcp_sdk.values import FrameView, PresenceMap, SoftSymbols

LINK = load_link()
K, COLUMNS, FULL = 16, 4, 300.0


def bound(**how: float) -> float:
    given = {"distance_m": 50.0, "blur_px": 0.45, "noise": 0.3} | how
    return bar_bound(LINK, symbols=np.arange(K), **given)


def test_the_bound_follows_noise_and_distance() -> None:
    assert bound(noise=0.6) == pytest.approx(2 * bound())
    assert bound(columns=20.0) == pytest.approx(bound() / 2)
    # A boundary is as sure at any distance: the error grows with its square.
    assert bound(distance_m=100.0) == pytest.approx(4 * bound(), rel=0.2)
    for name in ("noise", "distance_m", "blur_px"):
        given: dict[str, float] = {"distance_m": 50.0, "blur_px": 0.4, "noise": 0.1, name: -1}
        with pytest.raises(ConfigError, match=f"{name} = -1"):
            bar_bound(LINK, symbols=range(K), **given)


@pytest.mark.parametrize("blur_px", [0.6, 0.9])
def test_the_bound_is_that_of_boundaries_by_themselves(blur_px: float) -> None:
    """Spacing is the first of parameters that move boundaries, beside place and drift.

    Where blur smooths the pixel grid, a boundary with a step of 2 has the information
    sum of (2 gain pdf)^2 = 2 gain^2 / (sqrt(pi) blur) a column and value, wherever it lies.
    """
    codes = np.concatenate([LINK.codebook.pilot_edges, LINK.codebook.codeword_edges[np.arange(K)]], axis=1)
    each = 0.8**2 * np.diff(codes.astype(float), axis=0) ** 2 / (2 * np.sqrt(np.pi) * blur_px) * 5 / 0.3**2
    apart, when = np.arange(1, K)[:, None] - K / 2, np.arange(codes.shape[1]) / codes.shape[1] - 0.5
    slopes = np.stack(np.broadcast_arrays(apart, 1.0, when))
    information = np.einsum("aki,bki,ki->ab", slopes, slopes, each)
    spacing_px = LINK.camera.focal_px * 0.06 / 50
    want = 50 / spacing_px * np.sqrt(np.linalg.inv(information)[0, 0])
    assert bound(blur_px=blur_px) == pytest.approx(want, rel=0.02)


def view_of(
    distance_m: float, noise: float, rng: np.random.Generator, *,
    blur_px: float = 0.45, upside_down: bool = False, across: bool = False, dark: tuple[int, ...] = (),
    moves_px: float = 0.0, by_sign_px: float = 0.0, noisier: float = 1.0,
) -> FrameView:  # fmt: skip
    """A frame of a bar of `COLUMNS` pixels: the model's values and Gaussian noise, `FULL` events a value."""
    spacing, symbols = LINK.camera.focal_px * 0.06 / distance_m, rng.integers(0, 64, K)
    height, width = 2 * int(spacing * K / 2 + 8), 20
    book = LINK.codebook
    codes = np.concatenate([book.pilot_edges, book.codeword_edges[symbols]], axis=1).astype(float)
    codes[list(dark)] = 0
    shift = rng.uniform(-0.5, 0.5)
    rows = np.arange(height) - (height - 1) / 2 - shift
    # Steps from each cluster to the next, (K + 1, values); before the first and after the last is nothing.
    steps = np.diff(codes, axis=0, prepend=0, append=0)
    moved = moves_px * rng.normal(size=codes.shape[1]) if moves_px else 0.0
    at = spacing * (np.arange(K + 1) - K / 2)[:, None] + by_sign_px * np.sign(steps) + moved
    beyond = (rows - at[..., None]) / blur_px
    level = 0.5 * (steps[..., None] * norm.cdf(beyond)).sum(0)
    stepping = (steps[..., None] * (np.abs(beyond) < 2.5)).any(0)
    sums, bar = np.zeros((32, height, width)), slice(width // 2 - COLUMNS // 2, width // 2 + COLUMNS // 2)
    spread = noise * np.where(stepping, 1.0, noisier)[:, :, None]
    sums[1::2, :, bar] = level[:, :, None] + spread * rng.normal(size=(16, height, COLUMNS))
    selected = np.zeros((K, height // 2, width // 2), bool)
    pixels = np.zeros((K, height, width), np.float32)
    for k in set(range(K)) - set(dark):
        near = np.abs(rows - spacing * (k - (K - 1) / 2)) < spacing / 2
        pixels[k, near, bar] = 1
        middles = (rows[::2] + rows[1::2]) / 2
        cells = np.abs(middles - spacing * (k - (K - 1) / 2)) < spacing / 2
        selected[k, cells, bar.start // 2 : bar.stop // 2] = True
    if upside_down:
        sums, selected, pixels = sums[:, ::-1], selected[:, ::-1], pixels[:, ::-1]
    if across:
        sums, selected, pixels = (a.transpose(0, 2, 1) for a in (sums, selected, pixels))
    presence = PresenceMap(selected.astype(np.float32), 2, selected, pixels)
    soft = SoftSymbols(symbols, np.zeros((K, 6), np.float32), 1.0)
    return FrameView(np.rint(FULL * sums).astype(np.int16), np.zeros((2, 32)), presence, soft)


FRAMES: list[tuple[float, dict[str, float]]] = [
    *((distance_m, {"blur_px": blur_px}) for distance_m in (40.0, 80.0) for blur_px in (0.45, 0.6)),
    # What says nothing of the boundaries is no noise of theirs.
    *((60.0, {"moves_px": 0.15}), (60.0, {"by_sign_px": 0.08}), (60.0, {"noisier": 2.0})),
]


@pytest.mark.parametrize(("distance_m", "how"), FRAMES, ids=str)
def test_statistics_come_from_the_frames(distance_m: float, how: dict[str, float]) -> None:
    rng, measure = np.random.default_rng(0), frame_bound(LINK, full_events=FULL)
    given = {"blur_px": how.get("blur_px", 0.45), "noise": 0.1, "columns": COLUMNS, "gain": 0.5}
    views = [view_of(distance_m, 0.1, rng, **how) for _ in range(40)]
    found = [measure(view) for view in views]
    wanted = np.mean([bar_bound(LINK, distance_m, view.soft.symbols, **given) for view in views])
    assert np.mean([one.sigma_m for one in found]) == pytest.approx(wanted, rel=0.05)
    if "blur_px" in how:
        # 40 errors tell a spread to 11 %: three of these.
        assert np.std([one.distance_m for one in found]) == pytest.approx(wanted, rel=0.33)


@pytest.mark.parametrize("how", [{"upside_down": True}, {"across": True}, {"dark": (5,)}], ids=str)
def test_any_way_that_a_bar_lies(how: dict[str, bool]) -> None:
    measure = frame_bound(LINK, full_events=FULL)
    plain = measure(view_of(50.0, 0.1, np.random.default_rng(1)))
    found = measure(view_of(50.0, 0.1, np.random.default_rng(1), **how))
    assert found.distance_m == pytest.approx(50, abs=4 * plain.sigma_m)
    assert found.pairs == (13 if "dark" in how else 15)
    assert found.sigma_m == pytest.approx(plain.sigma_m, rel=0.2)


def test_frames_that_show_no_boundary_have_no_bound() -> None:
    measure = frame_bound(LINK)
    rng = np.random.default_rng(2)
    assert np.isnan(measure(view_of(50.0, 0.1, rng, dark=tuple(range(0, 16, 2)))).sigma_m)
    view = view_of(50.0, 0.1, rng)
    assert np.isnan(measure(replace(view, sums=np.zeros_like(view.sums))).sigma_m)


def test_other_layouts_than_one_even_column_have_none() -> None:
    panel = load_link(
        overrides=["bar.rows=16", "bar.columns=16", "bar.cluster_rows=4", "bar.cluster_columns=4"]
    )
    with pytest.raises(ConfigError, match="one even column of two"):
        bar_bound(panel, 50.0, range(16), blur_px=0.4, noise=0.1)
    for link in (panel, load_link(overrides=["bar.rows=12"])):
        with pytest.raises(ConfigError, match="needs one even column of three"):
            frame_bound(link)
