"""Codes of any chips: separation and decoding by their edges, and modulations that are no pair codes."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm(
        "pilots", "wh-dimmed", "evlcp_edges.dimmed:DimmedPilots", 1, "WH pilots, lit a part of the time"
    )
    yield Algorithm(
        "modulation", "wh4x2-dimmed", "evlcp_edges.dimmed:DimmedWh4x2", 1, "wh4x2, lit a part of the time"
    )
    yield Algorithm(
        "modulation", "ppm", "evlcp_edges.modulation:Ppm", 1, "pulse position: one chip of n is lit"
    )
    yield Algorithm(
        "modulation",
        "nrz",
        "evlcp_edges.modulation:Nrz",
        1,
        "balanced words without return to zero, as of 8b/10b",
    )
    yield Algorithm(
        "separation", "edges", "evlcp_edges.separation:EdgeSeparation", 1, "any pilots, by their edges"
    )
    yield Algorithm(
        "decoding", "edges", "evlcp_edges.decoding:EdgeDecoding", 1, "any codewords, by likelihoods of edges"
    )
