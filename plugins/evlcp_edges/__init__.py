"""Codes of any chips: separation and decoding by their edges, and modulations that are no pair codes."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    for role, id, target, summary in (
        ("pilots", "wh-dimmed", "dimmed:DimmedPilots", "WH pilots, lit a part of the time"),
        ("modulation", "wh4x2-dimmed", "dimmed:DimmedWh4x2", "wh4x2, lit a part of the time"),
        ("modulation", "ppm", "modulation:Ppm", "pulse position: one chip of n is lit"),
        ("modulation", "nrz", "modulation:Nrz", "balanced words without return to zero, as of 8b/10b"),
        ("separation", "edges", "separation:EdgeSeparation", "any pilots, by their edges"),
        ("decoding", "edges", "decoding:EdgeDecoding", "any codewords, by likelihoods of edges"),
    ):
        yield Algorithm(role, id, f"evlcp_edges.{target}", 1, summary)
