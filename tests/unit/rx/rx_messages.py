"""What tests of messages share: packets that carry blocks, and an operator who signs."""

from functools import cache
from math import nan

import numpy as np
import pytest
from scipy.stats import norm

from evlcp_sdk.air import signing
from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Kind, Message, split
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.values import Frame, Packet, Range, SoftSymbols

CODER = load_link().block_coder()
PLACE = Beacon(35.1, 136.9, 52.0, 10.0, 0.0, 0.96, b"lane 2")


def packet_of(llr, number, transmitter=0, lost=()):
    """A packet whose frames have these LLRs, float (960,); lost frames are missing."""
    frames = tuple(
        Frame(
            *(transmitter, number, f, 34600.0 * number + 3200.0 * f),
            soft=SoftSymbols(np.zeros(16, np.int64), part.astype(np.float32), 1.0),
            range=Range(nan, nan, 0),
            filtered=None,
            x_px=0.0,
            y_px=0.0,
        )
        for f, part in enumerate(llr.reshape(10, 16, 6))
        if f not in set(lost)
    )
    return Packet(transmitter, number, 34600.0 * number, 100.0, frames, 10)


def noisy(block, ber, rng):
    sigma = 1 / norm.isf(ber)
    air = CODER.air_bits(block)
    return 2 * (1 - 2.0 * air + rng.normal(0, sigma, air.size)) / sigma**2


def blocks_of(*messages, digest=CODER.digest):
    return [b.pack(CODER.block_bytes) for m in messages for b in split(m, digest, CODER.block_bytes)]


class Operator:
    """A key and what it signs."""

    def __init__(self):
        pytest.importorskip("cryptography", reason="the extra sign is not installed")
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        self._key = Ed25519PrivateKey.generate()
        self.public = signing.public_key(self._key)
        self.trusted = (signing.TrustedKey(self.public),)

    def sign(self, message):
        return signing.sign(message, CODER.digest, self._key)

    def beacon(self, sequence, place=PLACE, transmitter_id=7):
        """A beacon and its signature."""
        message = Message(Kind.BEACON, transmitter_id, sequence, place.pack())
        return [message, self.sign(message)]


@cache
def operator():
    return Operator()
