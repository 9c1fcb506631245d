"""The codebook against the worked values of the air interface, and its C form."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from evlcp_edges.dimmed import DimmedPilots, DimmedWh4x2
from evlcp_edges.modulation import Nrz, Ppm
from evlcp_wh.modulation import Raw8, Wh4x2, Wh8
from evlcp_wh.pilots import WhPilots

from evlcp_sdk.air.codebook import Codebook, chips_of_values, hadamard, word_of_chips
from evlcp_sdk.air.frames import (
    PacketFormat,
    bits_of_symbols,
    chips_after_frame,
    packet_chips,
    symbols_of_bits,
)
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Modulation

VECTORS = json.loads((Path(__file__).parents[2] / "vectors" / "air-vectors.json").read_text())
PROFILES: dict[str, Modulation] = {"wh4x2": Wh4x2(), "wh8": Wh8(), "raw8": Raw8()}


def book_of(profile: str) -> Codebook:
    pilots = WhPilots()
    return Codebook(profile, pilots.preamble(), pilots.codes(16), PROFILES[profile].codewords())


@pytest.mark.parametrize("profile", PROFILES)
def test_words_are_the_vectors(profile: str) -> None:
    book = book_of(profile)
    assert [f"{word_of_chips(code):04x}" for code in book.pilots] == VECTORS["pilot_words"]
    assert [f"{word_of_chips(code):04x}" for code in book.codewords] == VECTORS["info_words"][profile]
    assert "".join(map(str, book.preamble)) == VECTORS["preamble_chips"]
    assert book.preamble.tolist() == chips_of_values(VECTORS["barker13"]).tolist()
    assert (book.to_dict()["air_interface"], book.to_dict()["preamble"]) == (1, VECTORS["barker13"])


def test_packet_is_the_vector() -> None:
    want = VECTORS["example_packet"]
    book = book_of(want["profile"])
    chips = packet_chips(want["symbols"], book)
    assert len(chips) == PacketFormat.of(book, want["frames"]).packet_chips
    rate_bit_s = PacketFormat.of(book, 10).gross_bit_s(book.bits_per_symbol, 16)
    assert rate_bit_s == pytest.approx(27_746, abs=0.5)
    assert ["".join(map(str, row)) for row in chips] == [f"{int(m, 16):016b}" for m in want["cluster_masks"]]
    bits = bits_of_symbols(want["symbols"], book.bits_per_symbol)
    assert "".join(map(str, bits)) == want["bits"]
    assert symbols_of_bits(bits, book.bits_per_symbol, 16).tolist() == want["symbols"]


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize(("frames", "every"), [(10, 1), (10, 4), (8, 4), (9, 4), (3, 5)])
def test_a_sparse_packet_is_the_full_one_without_some_pilots(profile: str, frames: int, every: int) -> None:
    book = book_of(profile)
    symbols = np.random.default_rng(frames).integers(0, len(book.codewords), (frames, 16))
    full = packet_chips(symbols, book)
    form = PacketFormat.of(book, frames, pilot_every=every)
    bare = [f for f in range(frames) if f % every]
    dropped = [26 + 32 * f + chip for f in bare for chip in range(16)]
    kept = np.delete(full, dropped, axis=0)
    assert packet_chips(symbols, book, every).tolist() == kept.tolist()
    assert form.packet_chips == len(kept)
    for f in range(frames):
        assert form.has_pilot(f) == (f not in bare)
        begin = form.frame_start_chip(f)
        at = 26 + 32 * f + (0 if form.has_pilot(f) else 16)
        assert kept[begin : begin + 16].tolist() == full[at : at + 16].tolist()


@pytest.mark.parametrize(("frames", "every"), [(10, 1), (10, 4), (9, 4), (1, 1)])
@pytest.mark.parametrize("preamble", [[0, 1, 1], [1, 1, 0]])
@pytest.mark.parametrize("first", [[0, 1], [0, 0]])
def test_what_follows_a_frame_is_what_is_on_air(frames, every, preamble, first) -> None:
    words = np.array([[first[0], 1, 0], [first[1], 0, 1]])
    book = Codebook("x", np.array(preamble), np.array([[1, 0, 1], [0, 1, 1]]), words)
    form = PacketFormat.of(book, frames, pilot_every=every)
    rng = np.random.default_rng(frames)
    packets = [packet_chips(rng.integers(0, 2, (frames, 2)), book, every) for _ in range(20)]
    # The last packet is followed by dark.
    chips = np.concatenate([*packets, np.zeros((1, 2), np.uint8)])
    starts = np.arange(20)[:, None] * form.packet_chips
    for frame in range(frames):
        behind = chips[starts + form.frame_start_chip(frame + 1)].reshape(20, 2).astype(np.int8)
        alike = (behind == behind[0]).all(0)
        assert chips_after_frame(book, form, frame).tolist() == np.where(alike, behind[0], -1).tolist()


CHIPS = Codebook("ppm", np.array([0, 1, 1]), np.array([[0, 1, 0], [1, 0, 0]]), np.eye(3, 4, dtype=int))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Codebook.of_values("x", hadamard(2)[0], np.ones((2, 8), np.int8), hadamard(8)),
         "pilots: rows 0 and 1 are equal"),
        (lambda: Codebook.of_values("x", np.zeros(13, np.int8), hadamard(8), hadamard(8)),
         "preamble: expected values of -1 and"),
        (lambda: Codebook("x", np.array([-1, 1]), CHIPS.pilots, CHIPS.codewords),
         "preamble: expected a 1-D array of chips 0 and 1; values of -1"),
        (lambda: Codebook("x", CHIPS.preamble, CHIPS.pilots, np.array([[1, 1, 1], [0, 1, 0], [0, 0, 0]])),
         "codewords: rows 0 and 2 have the same edges"),
        (lambda: Codebook("x", CHIPS.preamble, [CHIPS.preamble], CHIPS.codewords),
         "pilots: that of the only cluster is the preamble"),
        (lambda: CHIPS.require_pairs("decoding", "a", "b"),
         r"decoding 'a' reads pair codes.*the preamble are others; try"),
        (lambda: packet_chips([[0] * 15], book_of("wh4x2")), r"expected \(frames, 16 clusters\)"),
        (lambda: packet_chips([[0] * 15 + [64]], book_of("wh4x2")),
         "symbol 64 at frame 0, cluster 15: expected 0 to 63"),
        (lambda: packet_chips([[0.5] * 16], book_of("wh4x2")), "expected integers"),
    ],
)  # fmt: skip
def test_what_is_no_code_or_symbol_is_named(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()


def test_codes_of_any_chips() -> None:
    assert not CHIPS.is_pair_coded
    assert (CHIPS.bits_per_symbol, CHIPS.data_symbols, CHIPS.edge_spacing_chips) == (1, 2, 1)
    assert CHIPS.pilot_edges.tolist() == [[1, -1], [-1, 0]]
    assert CHIPS.to_dict()["codewords"] == ["1000", "0100", "0010"]
    form = PacketFormat.of(CHIPS, 3)
    assert (form.preamble_chips, form.pilot_chips, form.info_chips) == (3, 3, 4)
    chips = packet_chips([[2, 0]], CHIPS)
    assert "".join(map(str, chips[:, 0])) == "0110100010"
    assert "".join(map(str, chips[:, 1])) == "0111001000"


@pytest.mark.parametrize(
    ("pilots", "words"),
    [(WhPilots(), Wh4x2()), (WhPilots(), Ppm(4, 3)), (WhPilots(), Nrz()), (DimmedPilots(), DimmedWh4x2())],
    ids=["pairs", "ppm", "nrz", "dimmed"],
)
def test_the_longest_time_between_rises(pilots: WhPilots | DimmedPilots, words: Modulation) -> None:
    book = Codebook("x", pilots.preamble(), pilots.codes(16), words.codewords())
    # Every codeword behind every other, in all of 16 clusters, with a pilot now and then.
    n = len(book.codewords)
    pairs = np.stack([np.arange(n).repeat(n), np.tile(np.arange(n), n)], 1).ravel()
    chips = packet_chips(np.tile(pairs[:, None], 16), book, pilot_every=64).astype(np.int8)
    gaps = [np.diff(np.flatnonzero(np.diff(chips[:, k]) > 0)).max() for k in range(16)]
    assert book.longest_gap_chips == max(gaps)
    assert book.is_pair_coded == isinstance(words, Wh4x2)


def test_c_table_holds_the_words() -> None:
    book = book_of("wh4x2")
    text = book.to_c()
    words = re.findall(r"0x([0-9a-f]{4})u", text)
    assert words == VECTORS["pilot_words"] + VECTORS["info_words"]["wh4x2"]
    assert f"{int(VECTORS['preamble_chips'], 2):08x}" in text
