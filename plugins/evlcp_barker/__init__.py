"""Barker codes: packet synchronization, and pilots from shifted Barker-13 words."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm(
        "synchronization",
        "barker",
        "evlcp_barker.synchronization:BarkerSync",
        3,
        "sliding preamble correlation",
    )
    yield Algorithm("pilots", "barker13", "evlcp_barker.pilots:Barker13Pilots", 1, "shifted Barker-13 words")
