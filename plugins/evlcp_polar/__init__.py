"""CRC-aided polar codes with successive-cancellation list decoding."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm(
        "error-correction", "polar", "evlcp_polar.correction:Polar", 1, "CRC-aided polar code, list decoding"
    )
