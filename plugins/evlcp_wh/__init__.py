"""Walsh-Hadamard codes: pilots, symbol profiles, separation of clusters, decoding (arXiv 2510.17203)."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    for role, id, target, revision, summary in (
        ("pilots", "wh", "pilots:WhPilots", 1, "WH rows and inverted WH rows"),
        ("modulation", "wh4x2", "modulation:Wh4x2", 1, "6 bits a symbol: two words of H4"),
        ("modulation", "wh8", "modulation:Wh8", 1, "4 bits a symbol: one word of H8"),
        ("modulation", "raw8", "modulation:Raw8", 1, "8 bits a symbol: eight plain values"),
        ("separation", "wh-correlation", "separation:WhCorrelation", 2, "pilot correlation in grids"),
        ("decoding", "wh-transform", "decoding:WhTransform", 1, "presence-weighted WH transform"),
        ("decoding", "ml-soft", "decoding:MlSoft", 1, "likelihoods learned from the pilots"),
        (
            "decoding",
            "motion-feedback",
            "motion_feedback:MotionFeedback",
            2,
            "ml-soft again after the motion is known",
        ),
    ):
        yield Algorithm(role, id, f"evlcp_wh.{target}", revision, summary)
