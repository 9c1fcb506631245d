"""Codes of any chips: their words, and separation by edges against Bayes' rule."""

import itertools

import numpy as np
import pytest
from evlcp_edges.decoding import EdgeDecoding
from evlcp_edges.dimmed import DimmedPilots, DimmedWh4x2, pulse_chips
from evlcp_edges.modulation import Nrz, Ppm
from evlcp_edges.separation import EdgeSeparation
from evlcp_wh.modulation import Wh4x2

from evlcp_sdk.air.codebook import Codebook, chips_of_values
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.testing.views import ideal_presence, ideal_sums

PREAMBLE = [0, 1, 0, 0, 1, 1]
PILOTS = np.array([[0, 1, 1, 0, 0, 1, 0], [1, 1, 0, 0, 1, 0, 1], [0, 0, 1, 0, 1, 1, 0]])


def test_nrz_words_are_balanced_and_have_short_runs():
    def longest_run(word):
        return max(len(list(group)) for _, group in itertools.groupby(word))

    words = [tuple(word) for word in Nrz().codewords().tolist()]
    assert len(words) == 256
    assert all(longest_run(word) <= 4 and len(word) == 10 and 4 <= sum(word) <= 6 for word in words)
    # All that are fully balanced come first.
    every = itertools.product((0, 1), repeat=10)
    balanced = {word for word in every if sum(word) == 5 and longest_run(word) <= 4}
    assert set(words[: len(balanced)]) == balanced
    too_many = r"modulation.bits = 9: expected at most 7, as \d+ words of 10 chips"
    with pytest.raises(ConfigError, match=too_many):
        Nrz(bits=9, disparity=0, longest_run=4).codewords()


def test_a_pulse_is_one_chip_of_its_time():
    words = Ppm(positions=3, pulses=2).codewords()
    assert words.shape == (9, 6)
    assert (words.reshape(9, 2, 3).sum(-1) == 1).all()
    assert words[5].tolist() == [0, 1, 0, 0, 0, 1]
    assert Codebook("ppm", np.array(PREAMBLE), PILOTS, words).bits_per_symbol == 3
    with pytest.raises(ConfigError, match=r"4\^8 symbols, expected 4096 at most"):
        Ppm(pulses=8)


@pytest.mark.parametrize("slots", [4, 8])
def test_dimmed_codes_are_lit_once_a_value(slots):
    pilots, words = DimmedPilots(slots), DimmedWh4x2(slots).codewords()
    for chips in (pilots.preamble(), pilots.codes(16), words):
        values = chips.reshape(*chips.shape[:-1], -1, slots)
        assert (values.sum(-1) == 1).all()
        assert not values[..., 0].any()
    pairs = 2 * Wh4x2().codewords()[:, 1::2].astype(int) - 1
    assert pulse_chips(pairs, slots).tolist() == words.tolist()
    assert pulse_chips([1, -1, -1], 2).tolist() == chips_of_values([1, -1, -1]).tolist()


@pytest.mark.parametrize("seed", range(2))
def test_presence_is_bayes_rule_over_edges(seed):
    rng = np.random.default_rng(seed)
    book = Codebook("x", np.array(PREAMBLE), PILOTS, Ppm(4, 1).codewords())
    sums = rng.integers(-2, 3, (7, 9, 8)).astype(np.int16)
    error, least = 0.2, 3
    found = EdgeSeparation(edge_error=error, min_answers=least).compile(book)(sums)
    # Of the second chip on, in cells of 2 px.
    signs = np.sign(sums[1:, :8].reshape(6, 4, 2, 4, 2).sum((2, 4)))
    edges = np.diff(PILOTS, axis=1)[:, :, None, None]
    answered = (edges != 0) & (signs != 0)
    likely = np.where(answered, np.where(signs == edges, 2 * (1 - error), 2 * error), 1).prod(1)
    want = np.where(np.abs(signs).sum(0) < least, 0, likely / (3 + likely.sum(0)))
    np.testing.assert_allclose(found.probability, want, rtol=1e-5)
    assert (found.selected == (found.probability >= 0.5)).all()


@pytest.mark.parametrize("last", [0, 1])
def test_the_last_chip_is_read_by_the_edge_that_ends_it(last):
    book = Codebook("x", np.array(PREAMBLE), PILOTS, np.array([[0, 1, 0, 0], [0, 1, 0, 1]]))
    sums = ideal_sums(book, [last] * 3, after=[1 - last] * 3, missing=0.5)
    # Nothing is seen of the last chip itself.
    sums[10] = 0
    unknown, after = (np.full(3, value, np.int8) for value in (-1, 1 - last))
    soft = EdgeDecoding().compile(book)(ideal_presence(3), sums, unknown, after)
    assert soft.symbols.tolist() == [last] * 3
    assert (np.abs(soft.llr) > 15).all()
    blind = EdgeDecoding().compile(book)(ideal_presence(3), sums, unknown, unknown)
    assert blind.symbols.tolist() == [0] * 3
