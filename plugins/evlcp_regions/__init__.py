"""Detection of transmitters in the image: by the rhythm of the chips, as single spots, or the whole of it."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    path = "evlcp_regions.detection"
    yield Algorithm("detection", "rhythm", f"{path}:Rhythmic", 1, "what blinks in the rhythm of the chips")
    yield Algorithm(
        "detection",
        "spots",
        "evlcp_regions.spots:Spots",
        1,
        "single lights that go on and off, followed in a shaking image",
    )
    yield Algorithm("detection", "whole", f"{path}:Whole", 1, "the whole image is one region")
