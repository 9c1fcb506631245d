"""Packets of a preamble and frames, each read by the roles of its steps."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm(
        "framing", "packets", "evlcp_packets.framing:Packets", 1, "a preamble and frames, by the other roles"
    )
