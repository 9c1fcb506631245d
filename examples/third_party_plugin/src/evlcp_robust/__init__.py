"""Ranging and decoding that a few bad pixels cannot sway."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl

__all__ = ["evlcp_algorithms"]


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm(
        "ranging", "median-pairs", "evlcp_robust.ranging:MedianPairs", 1, "median over all pairs of clusters"
    )
    yield Algorithm(
        "decoding", "majority", "evlcp_robust.decoding:Majority", 1, "one vote a cell, odds from the pilots"
    )
