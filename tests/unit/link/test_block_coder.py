"""Messages and blocks to packets and back: what is put on air is read, and whatever is lost is no block."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from evlcp_sdk.air.blocks import Kind
from evlcp_sdk.air.frames import bits_of_symbols
from evlcp_sdk.air.signing import TrustedKey, TrustedKeys, make_key
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.blocks import BlockCoder
from evlcp_sdk.link.compose import compose, messages_of, packets_of
from evlcp_sdk.link.resolve import load_link
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
