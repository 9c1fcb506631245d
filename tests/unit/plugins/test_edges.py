"""Codes of any chips: their words, and separation by edges against Bayes' rule, and decoding in scenes."""

import itertools

import numpy as np
import pytest
from evlcp_edges.decoding import EdgeDecoding
from evlcp_edges.dimmed import DimmedPilots, DimmedWh4x2, dimmed_chips
from evlcp_edges.modulation import Nrz, Ppm
from evlcp_edges.separation import EdgeSeparation
from evlcp_wh.modulation import Wh4x2

from evlcp_sdk.air.codebook import Codebook, chips_of_values
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.simulated import simulate
from evlcp_sdk.study.frames import frames_of
from evlcp_sdk.study.match import match
from evlcp_sdk.testing.views import ideal_presence, ideal_sums

PREAMBLE = [0, 1, 0, 0, 1, 1]
PILOTS = np.array([[0, 1, 1, 0, 0, 1, 0], [1, 1, 0, 0, 1, 0, 1], [0, 0, 1, 0, 1, 1, 0]])


def test_nrz_words_are_balanced_and_have_short_runs():
    words = Nrz().codewords()
    assert words.shape == (256, 10)
    for word in words.tolist():
        runs = [len(list(group)) for _, group in itertools.groupby(word)]
        assert max(runs) <= 4
        assert abs(2 * sum(word) - 10) <= 2
    # All that are fully balanced come first.
    balanced = [
        word
        for word in itertools.product((0, 1), repeat=10)
        if sum(word) == 5 and max(len(list(g)) for _, g in itertools.groupby(word)) <= 4
    ]
    assert {tuple(word) for word in words[: len(balanced)].tolist()} == set(balanced)
    with pytest.raises(
        ConfigError, match=r"modulation.bits = 9: expected at most 7, as \d+ words of 10 chips"
    ):
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
    for chips in (
        DimmedPilots(slots).preamble(),
        DimmedPilots(slots).codes(16),
        DimmedWh4x2(slots).codewords(),
    ):
        values = chips.reshape(*chips.shape[:-1], -1, slots)
        assert (values.sum(-1) == 1).all()
        assert not values[..., 0].any()
    pairs = 2 * Wh4x2().codewords()[:, 1::2].astype(int) - 1
    assert dimmed_chips(pairs, slots).tolist() == DimmedWh4x2(slots).codewords().tolist()
    assert dimmed_chips([1, -1, -1], 2).tolist() == chips_of_values([1, -1, -1]).tolist()


@pytest.mark.parametrize("seed", range(2))
def test_presence_is_bayes_rule_over_edges(seed):
    rng = np.random.default_rng(seed)
    book = Codebook("x", np.array(PREAMBLE), PILOTS, Ppm(4, 1).codewords())
    sums = rng.integers(-2, 3, (7, 9, 8)).astype(np.int16)
    error, least = 0.2, 3
    found = EdgeSeparation(edge_error=error, min_answers=least).compile(book)(sums)
    assert found.probability.shape == (3, 4, 4)
    for r, c in np.ndindex(4, 4):
        cell = [int(sums[chip, 2 * r : 2 * r + 2, 2 * c : 2 * c + 2].sum()) for chip in range(7)]
        signs = [(v > 0) - (v < 0) for v in cell]
        likely = []
        for code in PILOTS.tolist():
            chance = 1.0
            for chip in range(1, 7):
                edge = code[chip] - code[chip - 1]
                if edge and signs[chip]:
                    chance *= 2 * ((1 - error) if signs[chip] == edge else error)
            likely.append(chance)
        want = [v / (3 + sum(likely)) for v in likely]
        if sum(map(abs, signs[1:])) < least:
            want = [0.0] * 3
        np.testing.assert_allclose(found.probability[:, r, c], want, rtol=1e-5)
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


SCENES = {
    "ppm": ("modulation.id=ppm", "modulation.pulses=2"),
    "nrz, few pilots": ("modulation.id=nrz", "modulation.bits=6", "air.pilot_every=4"),
}


@pytest.mark.parametrize("name", SCENES)
def test_other_codes_at_50_m_at_night(name):
    link = load_link(overrides=SCENES[name])
    assert (link.table["separation"]["id"], link.table["decoding"]["id"]) == ("edges", "edges")
    source = simulate("night", seed=1, link=link, overrides=["duration_s=0.09", "motion.distance_m=50"])
    receiver = Receiver(link)
    with source:
        packets = [packet for events in source.chunks() for packet in receiver.feed(events)]
    packets += receiver.close()
    matched = match(frames_of(packets), source.truth)
    (sent,), (pairs,) = matched.bars, matched.pairs
    most_lost = 2 * (link.packet.pilot_every - 1)
    assert (matched.unmatched, receiver.counts["frames_rejected"] <= most_lost) == (0, True)
    assert 10 <= len(sent.start_us) - most_lost <= len(pairs)
    read = np.array([frame.symbols for frame, _ in pairs])
    true = sent.symbols[[number for _, number in pairs]]
    # Between pilots the bar's motion is known less well.
    assert ((read != true) & (read >= 0)).mean() <= (0.02 if link.packet.pilot_every > 1 else 0)
    assert (read >= 0).mean() >= 0.98
