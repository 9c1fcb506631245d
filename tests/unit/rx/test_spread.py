"""How light spreads in an image: against brute force, the simulator's scenes, and images of known blur."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import evlcp_sdk as evlcp
from evlcp_sdk.rx.spread import Spread, compare_spreads, model_lengths


def pixel_light(lit, per_px, sigma_px):
    """Light of pixels centred on every sample, of samples that are lit and blurred by a Gaussian."""
    light = gaussian_filter(lit.astype(float), sigma_px * per_px, truncate=6)
    whole = np.cumsum(np.cumsum(np.pad(light, ((1, 0), (1, 0))), 0), 1)
    n = per_px
    return (whole[n:, n:] - whole[:-n, n:] - whole[n:, :-n] + whole[:-n, :-n]) / n**2


@pytest.mark.parametrize("blur_px", [1.0, 1.6])
def test_expected_lengths_against_light_by_brute_force(blur_px):
    """Two clusters sampled 12 times a px, of a blur beside which the lens has little, on a background."""
    spacing, per_px, background = 9.0, 12, 0.3
    sigma = math.hypot(0.42 * 0.26, 0.36, blur_px)
    rows, columns = np.indices((int(3 * spacing * per_px), 24 * per_px)) / per_px
    strip = np.abs(columns - 12) <= 0.083 * spacing / 2
    upper = pixel_light(strip & (rows >= spacing / 2) & (rows < spacing * 1.5), per_px, sigma)
    lower = pixel_light(strip & (rows >= spacing * 1.5) & (rows < spacing * 2.5), per_px, sigma)
    row = (np.arange(len(upper)) + per_px / 2) / per_px
    column = (np.arange(upper.shape[1]) + per_px / 2) / per_px - 12
    # On the axis, and in the middle of a cluster.
    axis = np.abs(column) <= 0.8
    peak = lower[np.abs(row - 2 * spacing).argmin(), np.abs(column).argmin()]
    one, other = (
        upper[:, axis].mean(1) / upper.max(0)[axis].mean(),
        lower[:, axis].mean(1) / lower.max(0)[axis].mean(),
    )
    way = (row >= spacing) & (row < 2 * spacing)
    want = (
        ((other > 0.25 * (one + background))[way].mean() - 0.5) * spacing,
        ((other > 0.25 * background)[way].mean() - 0.5) * spacing,
        (lower[np.abs(row - 2 * spacing).argmin()] > 0.25 * background * peak).sum() / per_px,
    )
    (found,) = model_lengths(spacing, np.array([blur_px]), [background])
    assert found == pytest.approx(want, abs=0.2)


def sharper(one, other):
    return compare_spreads(one, other)[0]


def is_alike(one, other):
    return compare_spreads(one, other)[1]


def answering(lengths, spacing_px=9.0, frames=1):
    """Pixels that answer as if the lengths were these."""
    asked = 10_000
    between = np.zeros((2, 2, 3), np.int64)
    between[:, 1] = asked
    between[:, 0, 2] = asked
    between[:, 0, 1] = asked * np.clip((lengths[:2] / spacing_px + 0.5 - 0.25) / 0.55, 0, 1)
    across = np.full((2, 17), asked)
    beside = np.clip((lengths[2] - 1) / 2 - np.arange(8), 0, 1)
    across[0] = asked * np.concatenate([beside[::-1], [1], beside])
    return Spread(between * frames, across * frames, spacing_px * frames, frames)


def test_lengths_of_answers():
    want = np.array([0.4, 1.6, 4.3])
    for frames in (1, 7):
        assert answering(want, frames=frames).lengths_px() == pytest.approx(want, abs=0.01)
    both = answering(want) + answering(want)
    assert both.frames == 2
    assert both.lengths_px() == pytest.approx(want, abs=0.01)
    # What lies beyond a dark column is another image's.
    beside = answering(want)
    beside.across[0, -2:] = 10_000
    assert beside.lengths_px() == pytest.approx(want, abs=0.01)


def test_what_pixels_do_not_say_is_not_known():
    some = answering(np.array([0.4, 1.6, 4.3]))
    nothing, noise = (replace(some, between=np.full_like(some.between, n)) for n in (0, 5))
    assert nothing.lengths_px() is noise.lengths_px() is compare_spreads(some, nothing) is None
    panel = replace(some, across=np.zeros_like(some.across))
    assert math.isnan(panel.lengths_px()[2])
    assert sharper(panel, panel) == pytest.approx(0)


def dim_background(background, share, blur_px):
    """Background in the light of an image of a share of the light, which blur spreads across the line."""
    return background / share * math.hypot(0.42, blur_px) / 0.42


CASES = product((0.01, 0.03, 0.3), (0.1, 0.3, 0.6, 1.0), (0.0, 0.6, 1.0, 1.5))


@pytest.mark.parametrize(("background", "share", "blur_px"), [c for c in CASES if dim_background(*c) < 2])
def test_the_sharper_and_brighter_one_is_the_bar(background, share, blur_px):
    (bar,) = model_lengths(9.0, np.array([0.0]), [background])
    (image,) = model_lengths(9.0, np.array([blur_px]), [dim_background(background, share, blur_px)])
    odds = [sharper(answering(bar, frames=n), answering(image, frames=n)) for n in (1, 10)]
    assert sharper(answering(image), answering(bar)) == pytest.approx(-odds[0])
    if blur_px or share < 1:
        # Where both are alike in the one, and hardly differ in the other, little is known.
        assert odds[1] > (1.5 if blur_px >= 0.6 or share <= 0.3 else 0)
        assert odds[1] > odds[0] > 0
    else:
        assert odds == pytest.approx([0, 0])


@pytest.mark.parametrize("background", [0.01, 0.03, 0.3])
@pytest.mark.parametrize("farther", [1.0, 1.1, 1.5])
def test_two_bars_are_alike_and_images_are_not(background, farther):
    """Also where one is farther: its strip is narrower, and the light of a pixel less by as much."""
    (bar,) = model_lengths(9.0, np.zeros(1), [background])
    (other,) = model_lengths(9.0 / farther, np.zeros(1), [background * farther])
    assert is_alike(answering(bar, frames=10), answering(other, 9.0 / farther, frames=10)) > 1.5
    assert is_alike(answering(other, 9.0 / farther, 10), answering(bar, frames=10)) > 1.5
    # One of .7 of the light may be dirty, one of a third is a mirror.
    (weaker,) = model_lengths(9.0, np.zeros(1), [background / 0.7])
    assert is_alike(answering(bar, frames=10), answering(weaker, frames=10)) > 0
    for share, blur_px in ((0.33, 0.0), (0.2, 0.0), (1.0, 1.0)):
        (image,) = model_lengths(9.0, np.array([blur_px]), [dim_background(background, share, blur_px)])
        assert is_alike(answering(bar, frames=10), answering(image, frames=10)) < -0.5


def test_a_blurred_image_in_a_window_is_not_the_bar():
    """At 50 m by day: 30 % of the light, blurred by 1 px, wakes more pixels than the bar."""
    scene = [
        "duration_s=0.04",
        "motion.distance_m=50",
        'reflections.kind="window"',
        "reflections.share=0.3",
        "reflections.blur_px=1",
        "reflections.shift_px=[40.0,3.0]",
    ]
    source = evlcp.simulate("drive-30kmh", seed=5, overrides=scene)
    frames = [f for packet in evlcp.receive(source) for f in packet.frames]
    truth = source.truth
    bar_px = np.interp([f.t_us for f in frames], truth.t_us, truth.bars[0].centre_px[:, 0])
    own = np.abs([f.x_px for f in frames] - bar_px) < 20
    assert 8 <= own.sum() <= len(own) - 8
    assert [f.echo_of is None for f in frames] == own.tolist()


def test_what_is_clear_for_long_stays_clear():
    """After minutes the other hypothesis is less likely than the smallest number that is not 0."""
    bar, image = model_lengths(25.0, np.zeros(1), [0.004, 0.3])
    assert 745 < sharper(answering(bar, 25.0, 10_000), answering(image, 25.0, 10_000)) < math.inf
