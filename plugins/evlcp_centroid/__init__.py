"""Ranging by the centres of gravity of the clusters, the simple way, to compare with; and none."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm("ranging", "centroid", "evlcp_centroid.ranging:CentroidRanging", 2, "centres of gravity")
    yield Algorithm("ranging", "none", "evlcp_centroid.ranging:NoRanging", 1, "no distance, of any layout")
