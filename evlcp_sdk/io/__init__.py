"""Recordings and cameras in and out: EVT2 and EVT3 RAW files, tables, and other formats through `faery`."""

from evlcp_sdk.io.files import open_events, read_events
from evlcp_sdk.io.raw import RawSource
from evlcp_sdk.io.sources import EventSource, Loss

__all__ = ["EventSource", "Loss", "RawSource", "open_events", "read_events"]
