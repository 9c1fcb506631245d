"""Ranging by one fit of scale and position over all boundaries between neighbouring clusters."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm(
        "ranging", "joint-scale", "evlcp_joint.ranging:JointScaleRanging", 2, "one fit over all boundaries"
    )
