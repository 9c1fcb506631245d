"""Messages to the packets that a transmitter plays."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Message, split
from evlcp_sdk.link.blocks import BlockCoder
from evlcp_sdk.scene.sites import BarSite

__all__ = ["beacon_of_site", "packets_of"]


def packets_of(messages: Iterable[Message], coder: BlockCoder, repeat: int = 1) -> NDArray[np.int64]:
    """Symbols of the packets that carry messages, one after another, int64 (packets, frames, clusters).

    Args:
        messages: The messages, in the order in which they are sent.
        coder: How packets carry blocks.
        repeat: How many times in a row each packet is sent.
    """
    blocks = [
        block.pack(coder.block_bytes)
        for message in messages
        for block in split(message, coder.digest, coder.block_bytes)
    ]
    return np.repeat(np.stack([coder.symbols(block) for block in blocks]), repeat, axis=0)


def beacon_of_site(site: BarSite, user: bytes = b"") -> Beacon:
    """What a bar's beacon says.

    Args:
        site: Where the bar stands.
        user: The user's own bytes.
    """
    return Beacon(
        site.latitude_deg,
        site.longitude_deg,
        site.height_m,
        site.heading_deg,
        site.tilt_deg,
        site.length_m,
        user,
    )
