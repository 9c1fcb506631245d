"""Ranging by phase-only correlation between the pixel maps of clusters (arXiv 2510.17203)."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm(
        "ranging", "poc", "evlcp_poc.ranging:PocRanging", 3, "phase-only correlation of cluster pairs"
    )
