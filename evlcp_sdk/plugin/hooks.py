"""The hooks by which packages extend the SDK, and the records of algorithms and output formats.

A package registers by an entry point in the group `evlcp`, a module with functions marked `@hookimpl`.
See `docs/hooks.md` for a complete example of each hook.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pluggy

if TYPE_CHECKING:
    from pathlib import Path

    import typer

    from evlcp_sdk.air.kinds import MessageKind
    from evlcp_sdk.files import Outputs
    from evlcp_sdk.plugin.source import EventSource
    from evlcp_sdk.plugin.writer import EventWriter

ENTRY_POINT_GROUP = "evlcp"
"""Entry-point group, and pluggy project name."""

hookspec = pluggy.HookspecMarker(ENTRY_POINT_GROUP)
hookimpl = pluggy.HookimplMarker(ENTRY_POINT_GROUP)


@dataclass(frozen=True)
class Algorithm:
    """Where one algorithm is, without importing it.

    Attributes:
        role: The role it fills, a name of `plugin.roles.ROLES`.
        id: The name by which a configuration selects it.
        target: `module:Class` of its description.
        revision: Raised whenever its results may change; part of every result's digest.
        summary: One line for `evlcp plugins`.
    """

    role: str
    id: str
    target: str
    revision: int
    summary: str


@dataclass(frozen=True)
class SinkRecord:
    """Where one output format is, without importing it.

    Attributes:
        name: The name by which `evlcp receive --sink` requests it.
        target: `module:Class` of its sink, a class derived from `results.sink.Sink`.
        files: Names of the files that it may leave in the result's folder.
        summary: One line for help and messages.
        default: Whether it is written without a request.
        positions: Whether it is written only if positions are computed.
        packages: Modules that must be installed for it.
        extra: The extra that installs them with `pip install`.
    """

    name: str
    target: str
    files: tuple[str, ...]
    summary: str
    default: bool = False
    positions: bool = False
    packages: tuple[str, ...] = ()
    extra: str = ""


@hookspec
def evlcp_algorithms() -> Iterable[Algorithm]:  # type: ignore[empty-body]
    """Yield a record for each algorithm the package brings; import no kernel here."""


@hookspec
def evlcp_sinks() -> Iterable[SinkRecord]:  # type: ignore[empty-body]
    """Yield a record for each output format the package brings; import no format's library here."""


@hookspec
def evlcp_message_kinds() -> Iterable["MessageKind"]:  # type: ignore[empty-body]
    """Yield each kind of message that the package brings; import nothing heavy for it."""


@hookspec(firstresult=True)
def evlcp_open_events(url: str) -> "EventSource | None":
    """Open `url` as an event source, or return None to leave it to others.

    Asked before the built-in readers, so that a package can bring a camera or a file format.
    """


@hookspec(firstresult=True)
def evlcp_open_writer(
    path: "Path", width: int | None, height: int | None, format: str, outputs: "Outputs | None"
) -> "EventWriter | None":
    """Create a recording to write in a format that the SDK does not know, or return None to leave it.

    Args:
        path: The file.
        width: Columns of the sensor, or None.
        height: Its rows, or None.
        format: Name of the requested format; empty: that of the file's suffix.
        outputs: As of `evlcp_sdk.io.open_writer`.
    """


@hookspec
def evlcp_stage_finished(stage: str, value: Any, elapsed_s: float) -> None:
    """Watch the receiver: called once after each stage, never once an event.

    Args:
        stage: `regions`, `synchronization`, `separation`, `decoding`, `view`, `ranging`, `frame`,
            `skipped` or `message`.
        value: What the stage produced.
        elapsed_s: How long it took, s.
    """


@hookspec
def evlcp_register_commands(app: "typer.Typer") -> None:
    """Add commands to the `evlcp` command line; import only what the command needs, inside it."""
