"""Visible-light communication and positioning with event cameras: the public face of the SDK.

`import evlcp_sdk as evlcp` is all that a program needs; what it does not use is not imported.

```
for packet in evlcp.receive("REC.raw"):
    for frame in packet.frames:
        print(frame.t_us, frame.soft.symbols, frame.range.distance_m)
```
"""

TYPE_CHECKING = False  # typing itself would take longer to import than all that follows

if TYPE_CHECKING:
    from evlcp_sdk.air.beacons import Beacon
    from evlcp_sdk.air.blocks import BlockError, Message
    from evlcp_sdk.air.codebook import Codebook
    from evlcp_sdk.air.frames import PacketFormat
    from evlcp_sdk.air.kinds import MessageKind
    from evlcp_sdk.errors import (
        CodebookMismatchError,
        ConfigError,
        EvlcpError,
        InputError,
        InterruptedRunError,
        OutputError,
        PluginError,
        PluginWarning,
        RawFormatError,
        StreamError,
        UnknownAlgorithmError,
        UnpluggedError,
    )
    from evlcp_sdk.io.open import open_source as open
    from evlcp_sdk.io.open import read_events, write_events
    from evlcp_sdk.io.replay import ReplaySource
    from evlcp_sdk.link.compose import compose
    from evlcp_sdk.link.resolve import Link, load_link
    from evlcp_sdk.place.gnss import GnssLog
    from evlcp_sdk.place.navigator import Place, PositionPlan, Settled
    from evlcp_sdk.plugin.hooks import Algorithm, SinkRecord, hookimpl
    from evlcp_sdk.plugin.registry import Registry
    from evlcp_sdk.plugin.roles import (
        Code,
        Corrected,
        Decode,
        Decoding,
        Deframer,
        Detection,
        Detector,
        ErrorCorrection,
        Filter,
        Framing,
        Measure,
        Modulation,
        Pilots,
        Ranging,
        Separate,
        Separation,
        Synchronization,
        Synchronizer,
        Tracker,
        Tracking,
    )
    from evlcp_sdk.plugin.source import EventSource, Loss
    from evlcp_sdk.results.folder import ResultFolder
    from evlcp_sdk.results.sink import Run, Sink
    from evlcp_sdk.results.tables import frames_table
    from evlcp_sdk.run import Reception, diagnose, receive, receive_to_folder
    from evlcp_sdk.rx.receiver import Receiver
    from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
    from evlcp_sdk.scene.bar import BarLayout, LedColumns, LedGrid, LedRing, LedTable
    from evlcp_sdk.scene.camera import CameraModel
    from evlcp_sdk.scene.sites import BarSite, load_sites
    from evlcp_sdk.simulated import SimulatedSource, simulate
    from evlcp_sdk.values import (
        Alternative,
        Bend,
        DecodedFrame,
        Events,
        FailedBar,
        Fix,
        Frame,
        FrameView,
        Packet,
        PresenceMap,
        Range,
        ReceivedMessage,
        Region,
        SoftSymbols,
        SyncLock,
        Triggers,
    )

__all__ = [
    "Algorithm",
    "Alternative",
    "Attitude",
    "AttitudeLog",
    "BarLayout",
    "BarSite",
    "Beacon",
    "Bend",
    "BlockError",
    "CameraModel",
    "Code",
    "Codebook",
    "CodebookMismatchError",
    "ConfigError",
    "Corrected",
    "Decode",
    "DecodedFrame",
    "Decoding",
    "Deframer",
    "Detection",
    "Detector",
    "ErrorCorrection",
    "EventSource",
    "Events",
    "EvlcpError",
    "FailedBar",
    "Filter",
    "Fix",
    "Frame",
    "FrameView",
    "Framing",
    "GnssLog",
    "InputError",
    "InterruptedRunError",
    "LedColumns",
    "LedGrid",
    "LedRing",
    "LedTable",
    "Link",
    "Loss",
    "Measure",
    "Message",
    "MessageKind",
    "Modulation",
    "OutputError",
    "Packet",
    "PacketFormat",
    "Pilots",
    "Place",
    "PluginError",
    "PluginWarning",
    "PositionPlan",
    "PresenceMap",
    "Range",
    "Ranging",
    "RawFormatError",
    "ReceivedMessage",
    "Receiver",
    "Reception",
    "Region",
    "Registry",
    "ReplaySource",
    "ResultFolder",
    "Run",
    "Separate",
    "Separation",
    "Settled",
    "SimulatedSource",
    "Sink",
    "SinkRecord",
    "SoftSymbols",
    "StreamError",
    "SyncLock",
    "Synchronization",
    "Synchronizer",
    "Tracker",
    "Tracking",
    "Triggers",
    "UnknownAlgorithmError",
    "UnpluggedError",
    "compose",
    "diagnose",
    "frames_table",
    "hookimpl",
    "load_link",
    "load_sites",
    "open",
    "read_events",
    "receive",
    "receive_to_folder",
    "simulate",
    "write_events",
]

_HOMES = {
    "air.beacons": ("Beacon",),
    "air.blocks": ("BlockError", "Message"),
    "air.codebook": ("Codebook",),
    "air.frames": ("PacketFormat",),
    "air.kinds": ("MessageKind",),
    "errors": (
        "CodebookMismatchError",
        "ConfigError",
        "EvlcpError",
        "InputError",
        "InterruptedRunError",
        "OutputError",
        "PluginError",
        "PluginWarning",
        "RawFormatError",
        "StreamError",
        "UnknownAlgorithmError",
        "UnpluggedError",
    ),
    "io.open": ("open_source", "read_events", "write_events"),
    "io.replay": ("ReplaySource",),
    "link.compose": ("compose",),
    "link.resolve": ("Link", "load_link"),
    "place.gnss": ("GnssLog",),
    "place.navigator": ("Place", "PositionPlan", "Settled"),
    "plugin.hooks": ("Algorithm", "SinkRecord", "hookimpl"),
    "plugin.registry": ("Registry",),
    "plugin.source": ("EventSource", "Loss"),
    "plugin.roles": (
        "Code",
        "Corrected",
        "Decode",
        "Decoding",
        "Deframer",
        "Detection",
        "Detector",
        "ErrorCorrection",
        "Filter",
        "Framing",
        "Measure",
        "Modulation",
        "Pilots",
        "Ranging",
        "Separate",
        "Separation",
        "Synchronization",
        "Synchronizer",
        "Tracker",
        "Tracking",
    ),
    "results.folder": ("ResultFolder",),
    "results.sink": ("Run", "Sink"),
    "results.tables": ("frames_table",),
    "run": ("Reception", "diagnose", "receive", "receive_to_folder"),
    "rx.receiver": ("Receiver",),
    "scene.attitude": ("Attitude", "AttitudeLog"),
    "scene.bar": ("BarLayout", "LedColumns", "LedGrid", "LedRing", "LedTable"),
    "scene.camera": ("CameraModel",),
    "scene.sites": ("BarSite", "load_sites"),
    "simulated": ("SimulatedSource", "simulate"),
    "values": (
        "Alternative",
        "Bend",
        "Events",
        "FailedBar",
        "Fix",
        "Frame",
        "FrameView",
        "DecodedFrame",
        "Packet",
        "PresenceMap",
        "Range",
        "ReceivedMessage",
        "Region",
        "SoftSymbols",
        "SyncLock",
        "Triggers",
    ),
}
"""Where each name lives; it is imported when it is first used, so that the package itself takes no time."""

_RENAMED = {"open": "open_source"}


if not TYPE_CHECKING:  # or else a misspelt name would pass for one that is found here

    def __getattr__(name):
        if name in __all__:
            from importlib import import_module

            wanted = _RENAMED.get(name, name)
            for module, names in _HOMES.items():
                if wanted in names:
                    found = globals()[name] = getattr(import_module(f"{__name__}.{module}"), wanted)
                    return found
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
