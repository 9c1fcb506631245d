"""Recordings and cameras in and out: RAW files, tables and streams; plugins bring others."""

from evlcp_sdk.io.open import open_source, open_writer, read_events, write_events
from evlcp_sdk.io.raw import RawHeader, RawSource, RawWriter
from evlcp_sdk.io.replay import LoopSource, ReplaySource
from evlcp_sdk.io.streams import StreamSource
from evlcp_sdk.io.tables import CsvWriter, NpzWriter
from evlcp_sdk.plugin.source import DEFAULT_MAX_EVENTS, EventSource, Loss
from evlcp_sdk.plugin.writer import EventWriter

__all__ = [
    "DEFAULT_MAX_EVENTS",
    "CsvWriter",
    "EventSource",
    "EventWriter",
    "LoopSource",
    "Loss",
    "NpzWriter",
    "RawHeader",
    "RawSource",
    "RawWriter",
    "ReplaySource",
    "StreamSource",
    "open_source",
    "open_writer",
    "read_events",
    "write_events",
]
