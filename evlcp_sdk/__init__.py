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
    from evlcp_sdk.air.beacons import Beacon as Beacon
    from evlcp_sdk.air.blocks import BlockError as BlockError, Message as Message
    from evlcp_sdk.air.codebook import Codebook as Codebook
    from evlcp_sdk.air.frames import PacketFormat as PacketFormat
    from evlcp_sdk.air.kinds import MessageKind as MessageKind
    from evlcp_sdk.diagnosis.diagnose import diagnose as diagnose
    from evlcp_sdk.errors import (
        ConfigError as ConfigError,
        EvlcpError as EvlcpError,
        InputError as InputError,
        InterruptedRunError as InterruptedRunError,
        OutputError as OutputError,
        PluginError as PluginError,
        PluginWarning as PluginWarning,
        RawFormatError as RawFormatError,
        StreamError as StreamError,
        UnknownAlgorithmError as UnknownAlgorithmError,
        UnpluggedError as UnpluggedError,
        WorkerError as WorkerError,
    )
    from evlcp_sdk.io.open import open_source, read_events as read_events, write_events as write_events
    from evlcp_sdk.io.replay import ReplaySource as ReplaySource
    from evlcp_sdk.link.compose import compose as compose
    from evlcp_sdk.link.resolve import Link as Link, load_link as load_link
    from evlcp_sdk.place.gnss import GnssLog as GnssLog
    from evlcp_sdk.place.navigator import Place as Place, PositionPlan as PositionPlan, Settled as Settled
    from evlcp_sdk.plugin.hooks import Algorithm as Algorithm, SinkRecord as SinkRecord, hookimpl as hookimpl
    from evlcp_sdk.plugin.registry import Registry as Registry
    from evlcp_sdk.plugin.roles import (
        Code as Code,
        Corrected as Corrected,
        Decode as Decode,
        Decoding as Decoding,
        Deframer as Deframer,
        Detection as Detection,
        Detector as Detector,
        ErrorCorrection as ErrorCorrection,
        Filter as Filter,
        Framing as Framing,
        Measure as Measure,
        Modulation as Modulation,
        Pilots as Pilots,
        Ranging as Ranging,
        Separate as Separate,
        Separation as Separation,
        Synchronization as Synchronization,
        Synchronizer as Synchronizer,
        Tracker as Tracker,
        Tracking as Tracking,
    )
    from evlcp_sdk.plugin.source import EventSource as EventSource, Loss as Loss
    from evlcp_sdk.results.columns import frames_table as frames_table
    from evlcp_sdk.results.folder import ResultFolder as ResultFolder
    from evlcp_sdk.results.sink import Run as Run, Sink as Sink
    from evlcp_sdk.run import (
        Reception as Reception,
        receive as receive,
        receive_to_folder as receive_to_folder,
    )
    from evlcp_sdk.rx.receiver import Receiver as Receiver
    from evlcp_sdk.scene.attitude import Attitude as Attitude, AttitudeLog as AttitudeLog
    from evlcp_sdk.scene.bar import (
        BarLayout as BarLayout,
        LedColumns as LedColumns,
        LedGrid as LedGrid,
        LedRing as LedRing,
        LedTable as LedTable,
    )
    from evlcp_sdk.scene.camera import CameraModel as CameraModel
    from evlcp_sdk.scene.sites import BarSite as BarSite, load_sites as load_sites
    from evlcp_sdk.simulated import SimulatedSource as SimulatedSource, simulate as simulate
    from evlcp_sdk.values import (
        Alternative as Alternative,
        Curvature as Curvature,
        DecodedFrame as DecodedFrame,
        Events as Events,
        FailedBar as FailedBar,
        Fix as Fix,
        Frame as Frame,
        FrameView as FrameView,
        Packet as Packet,
        PresenceMap as PresenceMap,
        Range as Range,
        ReceivedMessage as ReceivedMessage,
        Region as Region,
        SoftSymbols as SoftSymbols,
        SyncLock as SyncLock,
        Triggers as Triggers,
    )

    open = open_source

_HOMES = {
    "air.beacons": "Beacon",
    "air.blocks": "BlockError Message",
    "air.codebook": "Codebook",
    "air.frames": "PacketFormat",
    "air.kinds": "MessageKind",
    "diagnosis.diagnose": "diagnose",
    "errors": (
        "ConfigError EvlcpError InputError InterruptedRunError OutputError PluginError PluginWarning "
        "RawFormatError StreamError UnknownAlgorithmError UnpluggedError WorkerError"
    ),
    "io.open": "open_source read_events write_events",
    "io.replay": "ReplaySource",
    "link.compose": "compose",
    "link.resolve": "Link load_link",
    "place.gnss": "GnssLog",
    "place.navigator": "Place PositionPlan Settled",
    "plugin.hooks": "Algorithm SinkRecord hookimpl",
    "plugin.registry": "Registry",
    "plugin.source": "EventSource Loss",
    "plugin.roles": (
        "Code Corrected Decode Decoding Deframer Detection Detector ErrorCorrection Filter Framing "
        "Measure Modulation Pilots Ranging Separate Separation Synchronization Synchronizer Tracker "
        "Tracking"
    ),
    "results.folder": "ResultFolder",
    "results.sink": "Run Sink",
    "results.columns": "frames_table",
    "run": "Reception receive receive_to_folder",
    "rx.receiver": "Receiver",
    "scene.attitude": "Attitude AttitudeLog",
    "scene.bar": "BarLayout LedColumns LedGrid LedRing LedTable",
    "scene.camera": "CameraModel",
    "scene.sites": "BarSite load_sites",
    "simulated": "SimulatedSource simulate",
    "values": (
        "Alternative Curvature Events FailedBar Fix Frame FrameView DecodedFrame Packet PresenceMap Range "
        "ReceivedMessage Region SoftSymbols SyncLock Triggers"
    ),
}
"""Where each name lives; it is imported when it is first used, so that the package itself takes no time."""

_RENAMED = {"open": "open_source"}

__all__ = sorted({*" ".join(_HOMES.values()).split(), *_RENAMED} - {*_RENAMED.values()})


if not TYPE_CHECKING:  # or else a misspelt name would pass for one that is found here

    def __getattr__(name):
        if name in __all__:
            from importlib import import_module

            wanted = _RENAMED.get(name, name)
            for module, names in _HOMES.items():
                if wanted in names.split():
                    found = globals()[name] = getattr(import_module(f"{__name__}.{module}"), wanted)
                    return found
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
