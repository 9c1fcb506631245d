"""Codes of any chips: their words, and separation and decoding by edges against plain twins and in scenes."""

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
from evlcp_sdk.values import PresenceMap

PREAMBLE = [0, 1, 0, 0, 1, 1]
PILOTS = np.array([[0, 1, 1, 0, 0, 1, 0], [1, 1, 0, 0, 1, 0, 1], [0, 0, 1, 0, 1, 1, 0]])


def test_nrz_words_are_balanced_and_have_short_runs() -> None:
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


def test_a_pulse_is_one_chip_of_its_time() -> None:
    words = Ppm(positions=3, pulses=2).codewords()
    assert words.shape == (9, 6)
    assert (words.reshape(9, 2, 3).sum(-1) == 1).all()
    assert words[5].tolist() == [0, 1, 0, 0, 0, 1]
    assert Codebook("ppm", np.array(PREAMBLE), PILOTS, words).bits_per_symbol == 3
    with pytest.raises(ConfigError, match=r"4\^8 symbols, expected 4096 at most"):
        Ppm(pulses=8)


@pytest.mark.parametrize("slots", [4, 8])
def test_dimmed_codes_are_lit_once_a_value(slots: int) -> None:
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
def test_presence_is_bayes_rule_over_edges(seed: int) -> None:
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


KEYS = ["".join(key) for many in (2, 3) for key in itertools.product("01", repeat=many)]
"""What was sent in a chip and in the one or two before."""


def spelled(word: list[int], chip: int, before: int, after: int) -> str:
    """The chip of a word and the two before it as far as they are known, "" where no edge is: "01", "101"."""
    sent = ["?" if c < 0 else str(c) for c in (-1, before, *word, after)]
    last = "".join(sent[chip : chip + 3])
    return "" if "?" in last[1:] else last.lstrip("?")


def logs_of(counts: dict[str, np.ndarray], counted: float) -> dict[str, np.ndarray]:
    """Log-likelihood of each sum behind each two and three chips, of histograms of these."""
    everything = sum(counts[key] for key in KEYS if len(key) == 2)
    prior, alike, found = 9 / everything.sum(), everything / everything.sum(), {}
    for key in KEYS:
        more = counts[key] + (counted * found[key[1:]] if len(key) == 3 else 0)
        found[key] = more / more.sum() if more.sum() else alike
    return {key: np.log((share + prior) / (1 + 5 * prior)) for key, share in found.items()}


@pytest.mark.parametrize("seed", range(2))
def test_decoding_is_the_likeliest_word_as_pilots_and_the_others_teach(seed: int) -> None:
    rng = np.random.default_rng(seed)
    words = Ppm(4, 1).codewords()
    book = Codebook("x", np.array(PREAMBLE), PILOTS, words)
    symbols, before, after = rng.integers(0, 4, 3), [1, 0, -1], [0, -1, 1]
    sums = ideal_sums(book, symbols, after=np.maximum(after, 0), missing=0.3, seed=seed)
    sums += rng.integers(-1, 2, sums.shape).astype(np.int16)
    # Of some too little is seen to teach others.
    sums[7:, 17:] = rng.integers(-1, 2, sums[7:, 17:].shape)
    shown = ideal_presence(3)
    presence = PresenceMap(0.9 * shown.probability, shown.grid_px, shown.selected, shown.pixels)
    decode = EdgeDecoding(max_events=2, pair_count=40, independent_pixels=0.07).compile(book)
    soft = decode(presence, sums, np.array(before, np.int8), np.array(after, np.int8))

    mine = presence.probability.repeat(2, 1).repeat(2, 2) > 0.5
    seen = [np.clip(sums[:, : one.shape[0], : one.shape[1]], -2, 2)[:, one] + 2 for one in mine]

    def sent(k: int, word: int) -> list[str]:
        return [spelled(words[word].tolist(), chip, before[k], after[k]) for chip in range(5)]

    def taught(k: int, keys: list[str]) -> dict[str, np.ndarray]:
        """Histograms of a cluster's pixels by what was sent in its chips."""
        found = {key: np.zeros(5) for key in KEYS}
        for key, numbers in zip(keys, seen[k], strict=False):
            for one in {key, key[-2:]} - {""}:
                found[one] += 0.9 * np.bincount(numbers, minlength=5)
        return found

    def fits(k: int, *parts: dict[str, np.ndarray]) -> np.ndarray:
        logs = logs_of({key: sum(part[key] for part in parts) for key in KEYS}, 40)
        terms = [
            [logs[key][seen[k][7 + chip]].sum() if key else 0 for chip, key in enumerate(sent(k, word))]
            for word in range(4)
        ]
        return 0.07 * 0.9 * np.sum(terms, 1)

    pilots = [
        taught(k, [spelled(code, c, -1, -1) for c in range(7)]) for k, code in enumerate(PILOTS.tolist())
    ]
    first = np.array([fits(k, *pilots) for k in range(3)])
    sure = np.ptp(np.sort(first)[:, -2:], axis=1) >= 5
    assert 0 < sure.sum() < 3
    own = [taught(k, [""] * 7 + sent(k, int(first[k].argmax())) if sure[k] else []) for k in range(3)]
    for k in range(3):
        fit = fits(k, *pilots, *(one for other, one in enumerate(own) if other != k))
        assert soft.symbols[k] == fit.argmax()
        best = [max(fit[:2]) - max(fit[2:]), max(fit[0], fit[2]) - max(fit[1], fit[3])]
        np.testing.assert_allclose(soft.llr[k], best, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("last", [0, 1])
def test_the_last_chip_is_read_by_the_edge_that_ends_it(last: int) -> None:
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
def test_other_codes_at_50_m_at_night(name: str) -> None:
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
