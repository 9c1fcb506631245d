"""Walsh-Hadamard codes: pilots, symbol profiles, separation of clusters, decoding (arXiv 2510.17203)."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm("pilots", "wh", "evlcp_wh.pilots:WhPilots", 1, "WH rows and inverted WH rows")
    for name, cls, what in (
        ("wh4x2", "Wh4x2", "6 bits a symbol: two words of H4"),
        ("wh8", "Wh8", "4 bits a symbol: one word of H8"),
        ("raw8", "Raw8", "8 bits a symbol: eight plain values"),
    ):
        yield Algorithm("modulation", name, f"evlcp_wh.modulation:{cls}", 1, what)
    yield Algorithm(
        "separation", "wh-correlation", "evlcp_wh.separation:WhCorrelation", 2, "pilot correlation in grids"
    )
    yield Algorithm(
        "decoding", "wh-transform", "evlcp_wh.decoding:WhTransform", 1, "presence-weighted WH transform"
    )
    yield Algorithm(
        "decoding", "ml-soft", "evlcp_wh.decoding:MlSoft", 1, "likelihoods learned from the pilots"
    )
    yield Algorithm(
        "decoding",
        "motion-feedback",
        "evlcp_wh.motion_feedback:MotionFeedback",
        2,
        "ml-soft again after the motion is known",
    )
