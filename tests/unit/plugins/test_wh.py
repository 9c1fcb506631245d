"""Walsh-Hadamard separation and decoding: against Bayes' rule and brute force; what was sent comes back."""

from dataclasses import replace

import numpy as np
import pytest
from evlcp_wh import _kernels
from evlcp_wh.decoding import MlDecoder, MlSoft, WhTransform
from evlcp_wh.modulation import Raw8, Wh4x2, Wh8
from evlcp_wh.motion_feedback import MotionFeedback, match_shifts
from evlcp_wh.pilots import WhPilots
from evlcp_wh.separation import WhCorrelation
from numpy.testing import assert_allclose, assert_array_equal

from evlcp_sdk.air.codebook import Codebook, chips_of_values
from evlcp_sdk.testing.views import ideal_presence, ideal_sums
from evlcp_sdk.values import PresenceMap


def twin_values_of(sums):
    """b' = the second chip's sign; b'' = minus the first's, where the second is silent."""
    first, second = np.sign(sums[::2].astype(int)), np.sign(sums[1::2].astype(int))
    return np.where(second != 0, second, -first)


def cells_of(sums, grid):
    """Sums of whole grid cells, (chips, rows, columns)."""
    chips, height, width = sums.shape
    rows, columns = height // grid, width // grid
    whole = sums[:, : rows * grid, : columns * grid].astype(int)
    return whole.reshape(chips, rows, grid, columns, grid).sum((2, 4))


def posterior(sums, codes, grid, error, min_values):
    """Bayes' rule, a product of probabilities each cell and cluster; half the prior is on `no cluster`."""
    values = twin_values_of(cells_of(sums, grid))
    out = np.zeros((len(codes), *values.shape[1:]))
    for r, c in np.ndindex(out.shape[1:]):
        seen = [(i, v) for i, v in enumerate(values[:, r, c]) if v]
        if len(seen) < min_values:
            continue
        nothing = 0.5 * 0.5 ** len(seen)
        joint = [np.prod([1 - error if code[i] == v else error for i, v in seen]) for code in codes]
        joint = 0.5 / len(codes) * np.array(joint)
        out[:, r, c] = joint / (joint.sum() + nothing)
    return out


def twin_llr(values, words):
    """Symbols, ln P(bit 0) / P(bit 1), and share of energy explained: nearest words at the mean amplitude.

    The amplitudes are those of the least-squares fit; all clusters have one noise.
    """
    amplitude = np.array([max(w @ v / len(w) for w in words) for v in values])
    cost = np.array([[((v - amplitude.mean() * w) ** 2).sum() for w in words] for v in values])
    kept = (amplitude**2).sum() * words.shape[1]
    rest = sum(
        ((v - a * words[cost[k].argmin()]) ** 2).sum()
        for k, (v, a) in enumerate(zip(values, amplitude, strict=True))
    )
    variance = rest / values.size
    bits = len(words).bit_length() - 1
    out = np.empty((len(values), bits))
    for k, b in np.ndindex(out.shape):
        # Symbols beyond carry no bits.
        zeros = np.array([f"{s:0{bits}b}"[b] == "0" for s in range(2**bits)])
        carrying = cost[k, : 2**bits]
        out[k, b] = (carrying[~zeros].min() - carrying[zeros].min()) / (2 * variance)
    return cost.argmin(1), out, kept / (kept + rest)


def take_back(sums, path):
    reach = np.abs(path).max()
    seam = np.pad(sums, ((0, 0), (reach, reach), (reach, reach)))
    _, height, width = sums.shape
    places = reach + path.repeat(2, 0)
    return np.array([one[y:, x:][:height, :width] for one, (y, x) in zip(seam, places, strict=True)])


PROFILES = {"wh4x2": Wh4x2(), "wh8": Wh8(), "raw8": Raw8()}
SEEDS = range(2)
CLUSTERS = 16
SHAPE = {"cluster_px": 4, "width_px": 4}


CODES = WhPilots().codes(CLUSTERS)[:, 1::2].astype(np.int8) * 2 - 1


def book_of(profile="wh4x2"):
    return Codebook(profile, WhPilots().preamble(), chips_of_values(CODES), PROFILES[profile].codewords())


def image_of(values):
    """Sums of a bar whose clusters fill rows of cells of 4 px with their values (K, n)."""
    chips = 2 * chips_of_values(values).T.astype(np.int16) - 1
    return np.pad(3 * chips.repeat(4, 1)[:, :, None].repeat(4, 2), ((0, 0), (0, 0), (4, 4)))


def random_sums(rng, shape, density=0.5):
    return (rng.integers(-3, 4, shape) * (rng.random(shape) < density)).astype(np.int16)


def presence_of(rng, *shape):
    probability = np.where(rng.random(shape) < 0.3, rng.random(shape), 0).astype(np.float32)
    return PresenceMap(probability, 2, probability > 0.5, np.zeros(0, np.float32))


@pytest.mark.parametrize("shape", [(5, 4), (2, 2), (0, 3), (33, 7)])
@pytest.mark.parametrize("grid", [2, 3])
@pytest.mark.parametrize("density", [0.0, 0.1, 0.7])
def test_presence_is_bayes_rule(shape, grid, density):
    rng = np.random.default_rng(grid)
    sums = random_sums(rng, (16, *shape), density)
    found = WhCorrelation(grid_px=grid).compile(book_of())(sums)
    want = posterior(sums, CODES, grid, 0.1, 4)
    # Ratios below 1e-9 count as nothing, and the result is float32.
    assert_allclose(found.probability, want, rtol=1e-5, atol=2e-9)
    assert found.probability.shape == (CLUSTERS, shape[0] // grid, shape[1] // grid)
    assert_array_equal(found.selected, found.probability >= 0.5)


def bits_of(symbols, bits):
    return np.array([[int(b) for b in f"{s:0{bits}b}"] for s in symbols])


@pytest.mark.parametrize("many", [None, 6, 7])
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("seed", SEEDS)
def test_llr_is_the_brute_force_max_log(profile, seed, many):
    """Of all the profile's symbols, or of so many, of which four carry bits."""
    rng, book = np.random.default_rng(seed), book_of(profile)
    book = replace(book, codewords=book.codewords[:many])
    sums = random_sums(rng, (16, 12, 8))
    presence = presence_of(rng, CLUSTERS, 6, 4)
    presence.probability[:, 0, 0] = 0.7
    # The pilot before the info segment is empty.
    soft = WhTransform().compile(book)(presence, np.concatenate([np.zeros_like(sums), sums]))
    weight = np.where(presence.probability >= 0.01, presence.probability, 0)
    values = np.einsum("krc,irc->ki", weight, cells_of(twin_values_of(sums), 2))
    symbols, llr, quality = twin_llr(values, book.codeword_edges.astype(float))
    assert_array_equal(soft.symbols, symbols)
    assert_allclose(soft.llr, llr, rtol=1e-4, atol=1e-4)
    assert soft.quality == pytest.approx(quality)
    assert soft.quality < 0.99


@pytest.mark.parametrize("profile", PROFILES)
def test_learned_likelihoods_decode_every_symbol_without_negative_events(profile):
    """Silence after a rise says that it was a fall."""
    book = book_of(profile)
    n = len(book.codewords)
    for first in range(0, n, CLUSTERS):
        symbols = np.arange(first, first + CLUSTERS) * 5 % n
        frame = np.concatenate([image_of(CODES), image_of(book.codeword_edges[symbols])])
        # From values to edges: events come where the light changes, not while it stays.
        light = frame > 0
        frame[1:][light[1:] == light[:-1]] = 0
        frame = np.maximum(frame, 0)
        presence = WhCorrelation().compile(book)(frame[:16])
        soft = MlSoft().compile(book)(presence, frame)
        assert_array_equal(soft.symbols, symbols)
        assert_array_equal(soft.llr < 0, bits_of(symbols, book.bits_per_symbol) == 1)
        assert soft.quality > 0.9


def drifting(book, right_down, seed):
    """Symbols, sums and path of a bar that stands still in its pilot and drifts away in its info segment."""
    symbols = np.random.default_rng(seed).integers(len(book.codewords), size=CLUSTERS)
    still = ideal_sums(book, symbols, missing=0.3, seed=seed, **SHAPE)
    share = np.clip((np.arange(16) - 7.5) / 7.5, 0, 1)
    path = np.rint(share[:, None] * np.array(right_down)[::-1]).astype(int)
    return symbols, take_back(still, -path), path


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("right_down", [(0, 3), (-3, 0), (2, -3)])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_drift_within_the_frame_is_found_and_taken_back(profile, right_down, seed):
    book = book_of(profile)
    symbols, sums, path = drifting(book, right_down, seed)
    presence = ideal_presence(CLUSTERS, **SHAPE)
    soft = MotionFeedback().compile(book)(presence, sums)
    assert_array_equal(soft.symbols, symbols)
    assert_array_equal(soft.llr < 0, bits_of(symbols, book.bits_per_symbol) == 1)
    if right_down[1]:
        assert (MlSoft().compile(book)(presence, sums).symbols != symbols).any()
    _, _, *learnt = MlDecoder(book).decode(presence, sums)
    matches = match_shifts(presence, *learnt, 4)
    known = np.concatenate([book.pilot_edges, book.codeword_edges[symbols]], axis=1)
    assert_array_equal(_kernels.find_path(matches, known), path)
    # Blind to what the clusters say, it is found as well.
    assert_array_equal(_kernels.find_path(matches, book.pilot_edges.copy()), path)


@pytest.mark.parametrize("right_down", [(0, -6), (6, 0), (5, -6), (0, 7)])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_bar_that_goes_farther_than_is_searched_is_searched_farther(right_down, seed):
    """At the border the path ends, and what lies beyond is read as the clusters beside."""
    book = book_of()
    symbols, sums, _ = drifting(book, right_down, seed)
    presence = ideal_presence(CLUSTERS, **SHAPE)
    soft = MotionFeedback().compile(book)(presence, sums)
    assert_array_equal(soft.symbols, symbols)
    far = MotionFeedback(reach_px=8).compile(book)(presence, sums)
    assert_array_equal(soft.llr, far.llr)
    if right_down in ((0, 6), (0, -6), (0, 7)):
        near = MotionFeedback(far_px=4).compile(book)(presence, sums)
        assert (near.symbols != symbols).any()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_bar_that_stands_still_is_decoded_as_before(seed):
    book = book_of()
    rng = np.random.default_rng(seed)
    symbols = rng.integers(64, size=CLUSTERS)
    sums = ideal_sums(book, symbols, missing=0.3, seed=seed)
    noise = random_sums(rng, sums.shape, 0.02)
    presence = ideal_presence(CLUSTERS)
    want = MlSoft().compile(book)(presence, sums + noise)
    got = MotionFeedback().compile(book)(presence, sums + noise)
    assert_array_equal(got.symbols, want.symbols)
    assert_array_equal(got.llr, want.llr)
    assert got.quality == want.quality
