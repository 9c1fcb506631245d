"""Tracking of distance and image position over time, by Kalman filters; and none."""

from collections.abc import Iterator

from evlcp_sdk.plugin.hooks import Algorithm, hookimpl


@hookimpl
def evlcp_algorithms() -> Iterator[Algorithm]:
    """The algorithms of this package."""
    yield Algorithm("tracking", "none", "evlcp_kalman.tracking:NoTracking", 1, "each frame by itself")
    yield Algorithm(
        "tracking", "kalman", "evlcp_kalman.tracking:KalmanTracking", 2, "constant-velocity Kalman filters"
    )
