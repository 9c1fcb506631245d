"""Messages and blocks to packets and back: what is put on air is read, and whatever is lost is no block."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from evlcp_sdk.air.blocks import HEADER_BYTES, Kind, Message, split
from evlcp_sdk.air.frames import bits_of_symbols
from evlcp_sdk.air.signing import TrustedKey, TrustedKeys, make_key
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.blocks import BlockCoder, interleaver
from evlcp_sdk.link.compose import compose, messages_of, packets_of
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.scene.sites import BarSite

LINKS = [
    (),
    ("modulation.id=wh8",),
    ("modulation.id=raw8",),
    ("air.frames_per_packet=7",),
    ("air.frames_per_packet=24",),
    ("air.pilot_every=4", "air.frames_per_packet=16"),
    ("bar.rows=48",),
    ("error-correction.id=none",),
    ("error-correction.id=reed-solomon",),
]


def coder_of(*overrides: str) -> BlockCoder:
    return load_link(overrides=list(overrides)).block_coder()


def noisy(air: np.ndarray, ber: float, rng: np.random.Generator) -> np.ndarray:
    """LLRs of bits that went through Gaussian noise of this bit error rate."""
    sigma = 1 / norm.isf(ber)
    return (2 * (1 - 2.0 * air + rng.normal(0, sigma, air.size)) / sigma**2).astype(np.float32)


@pytest.mark.parametrize("overrides", LINKS)
def test_every_profile_and_length_carries_blocks(overrides: tuple[str, ...]) -> None:
    link = load_link(overrides=list(overrides))
    coder, rng = link.block_coder(), np.random.default_rng(1)
    for _ in range(5):
        block = rng.bytes(coder.block_bytes)
        symbols = coder.symbols(block)
        assert symbols.shape == (link.packet.frames, link.codebook.clusters)
        assert symbols.min() >= 0
        assert symbols.max() < len(link.codebook.codewords)
        air = bits_of_symbols(symbols, link.codebook.bits_per_symbol)
        assert coder.block((4 - 8.0 * air).astype(np.float32)) == block


def test_a_packet_too_short_is_told() -> None:
    told = (
        "3 frames has 288 bits on air and carries 15 bytes, expected at least 18; raise air.frames_per_packet"
    )
    with pytest.raises(ConfigError, match=told):
        coder_of("air.frames_per_packet=3")
    with pytest.raises(ConfigError, match="a block of 6 bits, expected at least 64"):
        coder_of("air.frames_per_packet=1", "bar.rows=6")


def test_the_interleaver_is_a_permutation_that_spreads() -> None:
    for bits in (60, 640, 672, 960, 1280):
        assert sorted(interleaver(bits)) == list(range(bits))
    # Frames and clusters of the default packet: each takes its share of every eighth of the code, as a random
    # draw would, to four standard deviations of the hypergeometric distribution.
    place = np.empty(960, int)
    place[interleaver(960)] = np.arange(960)
    air = place.reshape(10, 16, 6)
    for taken in [*air, *air.transpose(1, 0, 2)]:
        counts = np.bincount(taken.ravel() // 120, minlength=8)
        share = taken.size / 8
        spread = np.sqrt(share * 7 / 8 * (960 - taken.size) / 959)
        assert np.abs(counts - share).max() < 4 * spread


@pytest.mark.parametrize("overrides", [(), ("error-correction.id=none",)])
def test_constant_bytes_do_not_make_constant_symbols(overrides: tuple[str, ...]) -> None:
    coder = coder_of(*overrides)
    for byte in (0x00, 0xFF, 0x55):
        payload = bytes([byte]) * (coder.block_bytes - HEADER_BYTES)
        message = Message(Kind.DATA, 0, 0, payload)
        symbols = coder.symbols(next(split(message, coder.digest, coder.block_bytes)).pack(coder.block_bytes))
        # 160 symbols of 64: 2.5 each. No symbol stays on its cluster: a line at the frame rate in the light.
        assert np.bincount(symbols.ravel(), minlength=64).max() < 16
        assert (symbols[1:] == symbols[:-1]).mean() < 0.1


LOST = [np.s_[:, cluster] for cluster in (0, 7, 15)] + [np.s_[first : first + 3] for first in (0, 3, 7)]


@pytest.mark.parametrize("lost", LOST, ids=str)
def test_a_dark_cluster_or_lost_frames_break_nothing(lost: Any) -> None:
    coder, rng = coder_of(), np.random.default_rng(1)
    for _ in range(10):
        block = rng.bytes(coder.block_bytes)
        llr = noisy(coder.air_bits(block), 0.01, rng).reshape(10, 16, 6)
        llr[lost] = 0
        assert coder.block(llr.ravel()) == block


def test_silence_and_noise_are_no_block() -> None:
    coder, rng = coder_of(), np.random.default_rng(0)
    assert coder.block(np.zeros(960, np.float32)) is None
    few = np.zeros(960, np.float32)
    few[:400] = 5
    assert coder.block(few) is None
    for _ in range(100):
        assert coder.block(rng.normal(0, 3, 960).astype(np.float32)) is None


def test_another_link_reads_no_block_or_another_digest() -> None:
    def digest(link: Link) -> bytes:
        return link.block_coder().digest

    assert digest(load_link()) != digest(load_link(overrides=["modulation.id=wh8"]))
    assert digest(load_link()) == digest(load_link(overrides=["air.frames_per_packet=12"]))
    assert digest(load_link()) == bytes.fromhex(load_link().codebook.digest)[:4]


SITE = BarSite(7, 35.0, 137.0, 50.0)


@pytest.mark.skipif(find_spec("cryptography") is None, reason="needs the extra sign")
def test_a_beacon_is_signed_with_the_key(tmp_path: Path) -> None:
    link = load_link()
    public = make_key(tmp_path / "private.pem")
    beacon, signature = messages_of(
        link, beacon=SITE, user=b"lane 2", key=tmp_path / "private.pem", sequence=3
    )
    assert (beacon.kind, signature.kind, beacon.transmitter_id) == (Kind.BEACON, Kind.SIGNATURE, 7)
    digest = link.block_coder().digest
    assert TrustedKeys([TrustedKey(public)]).check(beacon, digest, signature) is True
    other = messages_of(link, beacon=SITE, user=b"lane 3", sequence=3)[0]
    assert TrustedKeys([TrustedKey(public)]).check(other, digest, signature) is False
    symbols = compose(link, beacon=SITE, user=b"lane 2", key=tmp_path / "private.pem", sequence=3, repeat=2)
    np.testing.assert_array_equal(symbols, packets_of([beacon, signature], link.block_coder(), 2))


def test_a_text_that_is_not_utf8_is_one_line() -> None:
    with pytest.raises(ConfigError, match="text: character 2 is not UTF-8"):
        compose(text="a\udcff")
