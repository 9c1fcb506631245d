"""Ideal recordings for tests, under short names."""

from evlcp_sdk.testing.recordings import IdealBar as Bar
from evlcp_sdk.testing.recordings import ideal_events as events_of
from evlcp_sdk.testing.recordings import lamp_events as lamp
from evlcp_sdk.testing.recordings import merged, random_symbols
from evlcp_sdk.testing.recordings import noise_events as noise

__all__ = ["Bar", "events_of", "lamp", "merged", "noise", "random_symbols"]
