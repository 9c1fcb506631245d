"""Reed-Solomon codes over bytes, to compare with."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm(
        "error-correction",
        "reed-solomon",
        "evlcp_reed_solomon.correction:ReedSolomon",
        1,
        "interleaved RS codes over bytes, erasures by reliability",
    )
