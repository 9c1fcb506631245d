"""Messages as they are, with a check only."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm(
        "error-correction", "none", "evlcp_crc.correction:NoCorrection", 1, "errors are detected only"
    )
