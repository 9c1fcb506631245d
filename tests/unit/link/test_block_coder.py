"""Blocks to packets and back: what is put on air is read, by links of every kind."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.air.frames import bits_of_symbols
from evlcp_sdk.errors import PluginError
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


@pytest.mark.parametrize("overrides", LINKS)
def test_every_profile_and_length_carries_blocks(overrides: tuple[str, ...]) -> None:
    link = load_link(overrides=list(overrides))
    coder, rng = link.block_coder(), np.random.default_rng(1)
    for _ in range(5):
        block = rng.bytes(coder.block_bytes)
        symbols = coder.encode_symbols(block)
        assert symbols.shape == (link.packet.frames, link.codebook.clusters)
        assert symbols.min() >= 0
        assert symbols.max() < len(link.codebook.codewords)
        air = bits_of_symbols(symbols, link.codebook.bits_per_symbol)
        assert coder.decode_block((4 - 8.0 * air).astype(np.float32)) == block


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ({"message_bits": "8"}, r"TypeError: gave SimpleNamespace with message_bits = '8'"),
        (
            {"encode": lambda bits: bits},
            r"ValueError: gave no 960 bits of 0 and 1 at encode\(\); try: evlcp check",
        ),
        ({"encode": lambda bits: {}["boom"]}, r"KeyError: 'boom' \(test_block_coder.py, line "),
    ],
)
def test_an_error_correction_that_fails_to_encode_is_named(broken: dict[str, Any], message: str) -> None:
    code = SimpleNamespace(**({"message_bits": 400} | broken))
    link = load_link().with_algorithm(
        "error-correction", SimpleNamespace(compile=lambda bits: code), id="mine"
    )
    with pytest.raises(PluginError, match=f"^error-correction algorithm 'mine': {message}"):
        compose(link, text="a")
