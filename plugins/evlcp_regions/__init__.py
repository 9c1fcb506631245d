"""Detection of transmitters in the image: by the rhythm of the chips, as single spots, or the whole of it."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    for id, target, summary in (
        ("rhythm", "detection:Rhythmic", "what blinks in the rhythm of the chips"),
        ("spots", "spots:Spots", "single lights that go on and off, followed in a shaking image"),
        ("whole", "detection:Whole", "the whole image is one region"),
    ):
        yield Algorithm("detection", id, f"evlcp_regions.{target}", 1, summary)
