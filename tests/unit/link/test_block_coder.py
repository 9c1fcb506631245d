"""Messages and blocks to packets and back: what is put on air is read, and whatever is lost is no block."""

from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from evlcp_sdk.air.frames import bits_of_symbols
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.blocks import BlockCoder
from evlcp_sdk.link.compose import compose
from evlcp_sdk.link.resolve import load_link

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


def test_a_text_that_is_not_utf8_is_one_line() -> None:
    with pytest.raises(ConfigError, match="text: character 2 is not UTF-8"):
        compose(text="a\udcff")
