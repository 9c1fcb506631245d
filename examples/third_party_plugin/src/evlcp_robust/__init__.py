"""Ranging and decoding that a few bad pixels cannot sway, a modulation of no pair code, and a framing."""

from collections.abc import Iterator

import evlcp_sdk as evlcp

__all__ = ["evlcp_algorithms"]


@evlcp.hookimpl
def evlcp_algorithms() -> Iterator[evlcp.Algorithm]:
    """The algorithms of this package."""
    yield evlcp.Algorithm(
        "ranging", "median-pairs", "evlcp_robust.ranging:MedianPairs", 1, "median over all pairs of clusters"
    )
    yield evlcp.Algorithm(
        "decoding", "majority", "evlcp_robust.decoding:Majority", 1, "one vote a cell, odds from the pilots"
    )
    yield evlcp.Algorithm(
        "modulation", "rz", "evlcp_robust.modulation:ReturnToZero", 1, "return to zero: a pulse for a one"
    )
    yield evlcp.Algorithm(
        "framing", "flash-position", "evlcp_robust.framing:FlashPosition", 1, "one flash a frame, of one LED"
    )
