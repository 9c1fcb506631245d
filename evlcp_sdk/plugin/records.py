"""Records of plugins besides algorithms: output formats by name, kinds of messages by number."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from evlcp_sdk.air.kinds import BUILT_IN_KINDS, MessageKind
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.formatting import suggest
from evlcp_sdk.plugin.hooks import SinkRecord
from evlcp_sdk.plugin.registry import Owner, Registry, find_text_fault, import_class

SUMMARY = "summary.json"
"""File of every result that no sink may write."""

_LARGEST_KIND = 15


@dataclass(frozen=True)
class InstalledSink:
    """An output format and the distribution that brought it."""

    record: SinkRecord
    distribution: str

    def __str__(self) -> str:
        return f"sink '{self.record.name}' of {self.distribution}"

    def load_class(self) -> type[Any]:
        """Import its class.

        Raises:
            ConfigError: A package that it needs is not installed.
            PluginError: It cannot be imported.
        """
        record = self.record
        # The parent of a dotted name, as that would be imported to find it.
        if missing := [name for name in record.packages if find_spec(name.partition(".")[0]) is None]:
            how = f"the extra: pip install '{record.extra}'" if record.extra else ", ".join(missing)
            raise ConfigError(f"{self} needs {how}, or leave --sink {record.name} out")
        return import_class(str(self), record.target)


def find_sinks(registry: Registry) -> dict[str, InstalledSink]:
    """The output formats by name.

    A plugin whose format is invalid, or has the name or a file of another one, is left out.
    """
    found = registry.collect("evlcp_sinks", SinkRecord, _sink_fault)
    return {record.name: InstalledSink(record, owner) for record, (owner, _) in found}


def choose_sinks(registry: Registry, names: Sequence[str], *, positions: bool) -> list[InstalledSink]:
    """The output formats of a run with or without positions: the default ones and those requested by name.

    Raises:
        ConfigError: There is no such format, or it needs positions and none are computed.
    """
    sinks = find_sinks(registry)
    for name in names:
        if name not in sinks:
            raise ConfigError(f"no sink named '{name}'{suggest(name, sorted(sinks), 'installed')}")
        if sinks[name].record.positions and not positions:
            raise ConfigError(f"sink '{name}' needs --sites: it writes positions")
    return [
        sink
        for name, sink in sinks.items()
        if name in names or (sink.record.default and (positions or not sink.record.positions))
    ]


def find_message_kinds(registry: Registry) -> dict[int, MessageKind]:
    """The kinds of messages by number.

    A plugin whose kind is invalid, or has the number or name of another one, is left out.
    """
    own = [(kind, ("evlcp-sdk", "")) for kind in BUILT_IN_KINDS.values()]
    found = registry.collect("evlcp_message_kinds", MessageKind, _kind_fault, own)
    return {kind.number: kind for kind, _ in found}


def _sink_fault(record: SinkRecord, others: Sequence[tuple[SinkRecord, Owner]]) -> str | None:
    """The fault of a sink's record, or its conflict with another one; None if there is none."""
    if fault := find_text_fault(record, f"sink {record.name!r}", "name", "target", "summary"):
        return fault
    files: Any = record.files
    if not isinstance(files, tuple | list) or not all(
        isinstance(name, str) and name not in ("", ".", "..") and not set(name) & {"/", "\\", "\0"}
        for name in files
    ):
        return f"sink '{record.name}': files = {files!r}, expected names of files in the result's folder"
    packages: Any = record.packages
    if not isinstance(packages, tuple | list) or not all(isinstance(name, str) and name for name in packages):
        return f"sink '{record.name}': packages = {packages!r}, expected names of modules"
    if SUMMARY in record.files:
        return f"sink '{record.name}': {SUMMARY} is the summary's file"
    for other, (owner, _) in others:
        if record.name == other.name:
            return f"sink '{record.name}': {owner} has one of this name"
        if shared := [name for name in record.files if name in other.files]:
            return f"sink '{record.name}': {shared[0]} is a file of the {InstalledSink(other, owner)}, too"
    return None


def _kind_fault(kind: MessageKind, others: Sequence[tuple[MessageKind, Owner]]) -> str | None:
    """The fault of a kind of messages, or its conflict with another one; None if there is none."""
    # A class may lack them.
    number, name = getattr(kind, "number", None), getattr(kind, "name", None)
    who = f"message kind {name!r}"
    if fault := find_text_fault(kind, who, "name"):
        return fault
    if not (isinstance(number, int) and 1 <= number <= _LARGEST_KIND):
        return f"{who}: number = {number!r}, expected 7 to {_LARGEST_KIND}"
    if name == "packet":
        return f"{who}: its name is that of a packet's line; choose another"
    for other, (owner, _) in others:
        if number == other.number or name == other.name:
            return (
                f"{who}: number {number} or its name is that of '{other.name}' of {owner};"
                " the SDK's are 1 to 6"
            )
    return None
