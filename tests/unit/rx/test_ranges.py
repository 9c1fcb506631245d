"""Distances together: drives with errors drawn as the sigmas say, or bent as no straight bar is."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from evlcp_sdk.rx.distortion import fit_straight
from evlcp_sdk.rx.ranges import RangeCorrector, RangeState
from evlcp_sdk.scene.tilt import LineOfSight
from evlcp_sdk.values import Curvature, Range

CHIP_US = 100.0
FRAME_US = 3200.0
PLACES = np.arange(1.0, 16) - 8
SPACING_M = 0.06
FOCAL_PX = 7200.0
AHEAD = LineOfSight()


def boundaries(tilt_deg, distance_m, noise_px, rng):
    """Boundaries of a tilted bar, where a pinhole sees them: by perspective, not by a parabola."""
    sine, cosine = math.sin(math.radians(tilt_deg)), math.cos(math.radians(tilt_deg))
    along = PLACES * SPACING_M
    seen_px = FOCAL_PX * along * cosine / (distance_m - along * sine)
    spacing_px = FOCAL_PX * SPACING_M * cosine / distance_m
    off_px = seen_px - spacing_px * PLACES + noise_px * rng.standard_normal(len(PLACES))
    one_px = spacing_px * SPACING_M / distance_m
    return Curvature(PLACES, off_px / one_px, np.full(len(PLACES), one_px**2))


def drive(frames, sigma_m, noise_px, seed, *, given_m=None, start_m=50.0, speed_m_s=-10.0, **how):
    """Errors and sigmas, float64 (frames, 2), of a drive whose distances err by `sigma_m`, as given."""
    rng, late_chips, tilt_deg = np.random.default_rng(seed), 8.0, how.get("tilt_deg", 0.0)
    true_m = start_m + speed_m_s * FRAME_US * 1e-6 * np.arange(frames)
    late_m = true_m + speed_m_s * late_chips * CHIP_US * 1e-6
    seen_m = late_m / math.cos(math.radians(tilt_deg)) + sigma_m * rng.standard_normal(frames)
    bends = [boundaries(tilt_deg, m, noise_px, rng) for m in true_m.tolist()]
    given = zip(seen_m.tolist(), bends, strict=True)
    measured = (Range(m, given_m or sigma_m, 15, late_chips, bend) for m, bend in given)
    _, found = remembered_lengths(measured, how.get("sight", AHEAD))
    assert {one.pairs for one in found} == {15}
    return np.stack([[one.distance_m for one in found] - true_m, [one.sigma_m for one in found]], axis=1)


def remembered_lengths(measured, sight=AHEAD):
    """What is remembered after frames with these distances, and the distances as they should be."""
    corrector, state, out = RangeCorrector(), RangeState(), []
    for i, one in enumerate(measured):
        state, found = corrector.step(state, i * FRAME_US, CHIP_US, one, sight)
        out.append(found)
    return state, out


def nees(errors):
    return float(np.mean((errors[:, 0] / errors[:, 1]) ** 2))


def test_without_a_distance_nothing_changes():
    corrector, state = RangeCorrector(), RangeState()
    for measured in (Range(math.nan, math.nan, 0), Range(50.0, math.nan, 3), Range(0.0, 0.0, 3)):
        assert corrector.step(state, 0.0, CHIP_US, measured, AHEAD) == (state, measured)


def foreshortening(along=0.0, about_deg=0.0, sigma_deg=0.7, share=0.1):
    """Mean and standard deviation of the foreshortening over what is likely of a tilt, by quadrature."""
    sigma, most, about = math.radians(sigma_deg), math.radians(5), math.radians(about_deg)

    def mean_of(value):
        def weighed(a):
            chance = (1 - share) * norm.pdf(a, 0, sigma) + share / (2 * most)
            return chance * value(math.cos(about + a) + along * math.sin(about + a))

        return float(quad(weighed, -most, most, points=[-3 * sigma, 0, 3 * sigma], epsabs=1e-13)[0])

    mean = mean_of(lambda length: length)
    return mean, math.sqrt(mean_of(lambda length: (length - mean) ** 2))


@pytest.mark.parametrize("tilt_deg", [None, -4.0, 0.0, 12.0])
@pytest.mark.parametrize("along", [0.0, 0.05, -0.05])
def test_a_first_distance_stays_but_for_the_tilt_that_is_known_or_likely(along, tilt_deg):
    """A bar 360 px off the middle looks shorter or longer by a twentieth of its tilt."""
    sight, likely = LineOfSight(along), ()
    if tilt_deg is not None:
        sight = LineOfSight(along, tilt_sine=math.sin(math.radians(tilt_deg)), tilt_sigma=math.radians(0.3))
        likely = tilt_deg, 0.3, 6e-5
    _, (found,) = remembered_lengths([Range(50.0, 0.02, 15)], sight)
    mean, spread = foreshortening(along, *likely)
    assert found.distance_m == pytest.approx(50 * mean, abs=1e-3 if likely else 2e-4)
    assert found.sigma_m == pytest.approx(math.hypot(0.02 * mean, 50 * spread), rel=0.03 if likely else 0.02)


def test_distances_are_brought_to_the_pilot():
    """A frame is read in 3.2 ms, in whose second half a car at 30 m/s is nearer by 24 mm."""
    errors = drive(60, 0.002, 0.01, 1, speed_m_s=-30.0)
    assert abs(errors[20:, 0].mean()) < 0.005
    # The first frame knows no speed, and says so.
    assert abs(errors[0, 0]) < 3 * errors[0, 1]
    assert errors[0, 1] > 0.015


@pytest.mark.parametrize("truth", [0.6, 1.0, 3.0])
def test_sigmas_become_true(truth):
    """Errors of three times the sigma that the ranging says, or of little more than half."""
    errors = np.concatenate([drive(90, 0.05 * truth, 0.01, seed, given_m=0.05)[20:] for seed in range(12)])
    # 840 errors; the sigmas of a drive are known from its frames alone.
    assert 0.75 < nees(errors) < 1.35


@pytest.mark.parametrize(
    ("tilt_deg", "known_deg"), [(-5.0, None), (-3.0, None), (0.0, None), (4.0, None), (6.0, 4.0)]
)
def test_a_tilt_is_found_in_the_curvature(tilt_deg, known_deg):
    """Also by how much it differs from what an attitude gives, to 2 degrees."""
    sight = AHEAD
    if known_deg is not None:
        sight = LineOfSight(tilt_sine=math.sin(math.radians(known_deg)), tilt_sigma=math.radians(2))
    how = {"start_m": 42.0, "tilt_deg": tilt_deg, "sight": sight}
    errors = np.stack([drive(60, 0.015, 0.04, seed, **how) for seed in range(8)])
    # A frame shows a tilt to 2.5 degrees here: the first ten cannot tell a tilt from none.
    assert 0.5 < nees(errors[:, 10:].reshape(-1, 2)) < 2
    # What is left of 1 - cos(tilt), up to 0.16 m.
    assert abs(errors[:, -1, 0].mean()) < 0.02


def test_a_distance_keeps_nothing_of_old_curvatures_and_distances():
    rng = np.random.default_rng(5)
    measured = [Range(45.1, 0.01, 15, 8.0, boundaries(4.0, 45.0, 0.04, rng)) for _ in range(400)]
    state, _ = remembered_lengths(measured)
    weight = measured[-1].curvature.weight
    assert len(state.past) <= 0.3 / (FRAME_US * 1e-6) + 1
    assert state.boundary_sums[0].max() < 1.01 * weight.max() / (1 - math.exp(-FRAME_US * 1e-6))
    new, _ = RangeCorrector().step(state, 400 * FRAME_US + 20e6, CHIP_US, measured[-1], AHEAD)
    assert len(new.past) == 1
    assert new.boundary_sums[0] == pytest.approx(weight)


def frame_of(seem_px, true_m, sigma_m, **more):
    """A frame as a ranging gives it that fits a straight scale to boundaries where they seem to lie."""
    slope, mean = np.polyfit(PLACES, seem_px, 1)
    one_px = FOCAL_PX * (SPACING_M / true_m) ** 2
    bend = Curvature(PLACES, (seem_px - slope * PLACES - mean) / one_px, np.full(15, one_px**2), **more)
    return Range(FOCAL_PX * SPACING_M / slope, sigma_m, 15, 8.0, bend)


def biased(spacings_px, height_px, rng, standing_px=0.0):
    """Error and sigma of the last of some distances, and what it was before.

    Of frames of a level bar whose boundaries have a pixel-phase bias, and are off alike in all frames.
    """
    start, frames = rng.uniform(), []
    standing_px = standing_px * rng.standard_normal(15)
    for spacing_px in spacings_px.tolist():
        true_m = FOCAL_PX * SPACING_M / spacing_px
        bias = np.sin(2 * np.pi * (start + spacing_px * PLACES))
        seem_px = spacing_px * PLACES + height_px * bias + standing_px + 0.02 * rng.standard_normal(15)
        bias_m = -true_m * np.polyfit(PLACES, bias, 1)[0] / spacing_px
        bias /= spacing_px * SPACING_M / true_m
        frames.append(
            frame_of(seem_px, true_m, 0.02 / 16.7 / spacing_px * true_m, phase_bias=bias, phase_bias_m=bias_m)
        )
    found = remembered_lengths(frames)[1][-1]
    return found.distance_m - true_m, found.sigma_m, frames[-1].distance_m - true_m, frames[-1].sigma_m


def test_a_pixel_phase_bias_is_estimated_and_removed():
    """At a spacing of 8 px and a fifteenth a bias looks like a tilt, and the same in every frame."""
    # Farther away boundaries lie in many ways on the pixels; then the car stands.
    spacings_px = np.minimum(7.6 + 0.02 * np.arange(60), 8 + 1 / 15)
    rng = np.random.default_rng(9)
    error, sigma, raw, _ = np.array([biased(spacings_px, 0.1, rng) for _ in range(20)]).T
    assert np.sqrt((raw**2).mean()) > 0.05
    assert np.sqrt((error**2).mean()) < 0.6 * np.sqrt((raw**2).mean())
    assert np.mean((error / sigma) ** 2) < 1.5


def test_what_is_not_known_of_the_bias_is_in_the_sigma():
    """A camera that stands: all frames err alike, and their scatter says nothing of it."""
    rng, still_px = np.random.default_rng(10), np.full(60, 8 + 1 / 15)
    found = [biased(still_px, height_px, rng) for height_px in rng.normal(0, 0.07, 40)]
    error, sigma, raw, raw_sigma = np.array(found).T
    assert np.mean((error / sigma) ** 2) < 2
    # A ranging alone says less than a third of it.
    assert np.mean((raw / raw_sigma) ** 2) > 10


def test_what_stands_is_no_evidence_of_a_bias():
    """A camera that stands shows other errors of its boundaries alike in all frames, too."""
    rng, still_px = np.random.default_rng(11), np.full(60, 8 + 1 / 30)
    error, _, raw, _ = np.array([biased(still_px, 0.0, rng, standing_px=0.05) for _ in range(40)]).T
    # Frame by frame, they would seem to prove a bias that more than doubles the error.
    assert np.sqrt((error**2).mean()) < 1.4 * np.sqrt((raw**2).mean())


def curved_frames(frames, off_px, rng):
    """Frames of a bar 45 m away whose boundaries seem to lie off by so much, (15,): a scale through all."""
    spacing_px = FOCAL_PX * SPACING_M / 45
    seem_px = spacing_px * PLACES + off_px + 0.04 * rng.standard_normal((frames, 15))
    more = {"spacing_px": spacing_px, "unit_px": spacing_px * SPACING_M / 45}
    return [frame_of(one, 45.0, 0.01, **more) for one in seem_px]


@pytest.mark.parametrize("height_px", [1.0, 0.2])
def test_what_bends_an_image_does_not_average_away(height_px):
    """A drop over the bar's lower half: all frames err alike, and each shows it, or some together."""
    rng, at = np.random.default_rng(12), PLACES / 4 - 1
    off_px = height_px * at * np.exp((1 - at**2) / 2)
    measured = curved_frames(60, off_px, rng)
    raw = np.array([one.distance_m - 45 for one in measured])
    _, found = remembered_lengths(measured)
    error = np.array([one.distance_m - 45 for one in found])
    # No tilt is seen in it, and the curvature is not taken for more than it is.
    assert np.abs(error)[-20:].max() < np.abs(raw)[-20:].max() + 0.02
    for one in found[-20:]:
        assert one.standing_m > 0.4 * abs(raw.mean())
        assert one.sigma_m > one.standing_m
        assert one.distortion_px is not None
    straight = remembered_lengths(curved_frames(60, 0 * PLACES, rng))[1]
    assert all(one.standing_m == 0 and one.distortion_px is None for one in straight)
    # Some time after it is gone, nothing is left of it.
    _, again = remembered_lengths(measured + curved_frames(1500, 0 * PLACES, rng))
    assert again[-1].sigma_m == pytest.approx(straight[-1].sigma_m, rel=0.3)


def test_clusters_with_dark_leds_are_taken_out_and_shown():
    off_px = np.zeros(15)
    off_px[[1, 2, 8, 13]] = -0.7, -1.4, 0.7, 0.7
    measured = curved_frames(20, off_px, np.random.default_rng(13))
    _, found = remembered_lengths(measured)
    assert min(abs(one.distance_m - 45) for one in measured) > 0.2
    error = np.array([(one.distance_m - 45, one.sigma_m) for one in found])
    assert np.abs(error[:, 0]).max() < 0.1
    assert nees(error) < 1
    for one in found:
        assert np.flatnonzero(np.abs(one.distortion_px) > 0.3).tolist() == [1, 2, 8, 13]
    # What the ranging left out itself is shown, and changes nothing.
    bend = measured[0].curvature
    alone = Curvature(
        PLACES, np.eye(15)[3], np.where(PLACES[3] == PLACES, 0, bend.weight), None, 0.0, 9.6, 0.5
    )
    _, (one,) = remembered_lengths([Range(45.0, 0.01, 14, 8.0, alone)])
    assert one.distortion_px == pytest.approx(0.5 * np.eye(15)[3])
    assert one.standing_m == 0


NOISE_PX = 0.06
SPACING_PX = 9.0


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
    return (rng.random(15) < 0.25) * rng.choice([-1, 1], 15) * rng.uniform(0.3, 1.5, 15)


def scale_errors(error_px, rng):
    """What a scale through boundaries with such errors is too short by, px, and what they say of it."""
    off = error_px + NOISE_PX * rng.standard_normal(15)
    slope, mean = np.polyfit(PLACES, off, 1)
    # A tilt's parabola, as large as it may be, is none of theirs.
    return -slope, fit_straight(PLACES, off - slope * PLACES - mean + 0.01 * (PLACES**2 - 56 / 3), 0.1, 0.01)


def error_statistics(errors_of, rng):
    """Errors of scales, those of the straight bars' spacing, px, and squares of those by their variance."""
    found = [
        (px, one) for px, one in (scale_errors(errors_of(rng), rng) for _ in range(400)) if one is not None
    ]
    return np.array([(px, px - one.slope, (px - one.slope) ** 2 / one.variance) for px, one in found]).T


def test_dark_leds_are_separated_from_a_straight_bar():
    """Most boundaries agree: the error is a third of that of a scale through all, and its sigma is true."""
    rng = np.random.default_rng(2)
    before, after, squares = error_statistics(dark, rng)
    assert len(before) > 300
    assert np.median(np.abs(after)) < 0.35 * np.median(np.abs(before))
    assert np.sqrt(np.mean(after**2)) < 0.65 * np.sqrt(np.mean(before**2))
    assert 0.2 < squares.mean() < 1.2


def test_what_drops_add_to_a_scale_is_in_the_sigma():
    """Most of it is seen by how neighbours err, but a drop over half of a bar hardly bends it."""
    rng = np.random.default_rng(3)
    before, after, squares = np.abs(error_statistics(drops, rng))
    assert len(before) > 350
    assert np.sqrt(np.mean(after**2)) < 0.8 * np.sqrt(np.mean(before**2))
    assert np.median(after) < 0.7 * np.median(before)
    # A few hundred times as much where 1 in 200 looks like dark LEDs.
    assert 0.3 < np.minimum(squares, 9).mean() < 1.5
    assert np.mean(squares > 3) < 0.1
