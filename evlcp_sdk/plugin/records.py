"""What plugins bring besides algorithms: output formats by name, kinds of messages by number."""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from evlcp_sdk.air.kinds import BUILT_IN_KINDS, MessageKind
from evlcp_sdk.errors import ConfigError, PluginError
from evlcp_sdk.plugin.hooks import SinkRecord
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.spelling import nearest

SUMMARY = "summary.json"
"""What every result has: no sink writes it."""

_MOST_KIND = 15


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
        if missing := [name for name in record.packages if find_spec(name) is None]:
            how = f"the extra: pip install '{record.extra}'" if record.extra else ", ".join(missing)
            raise ConfigError(f"{self} needs {how}, or leave --sink {record.name} out")
        module, _, name = record.target.partition(":")
        try:
            found = getattr(importlib.import_module(module), name)
        except (Exception, SystemExit) as fault:
            raise PluginError(f"{self}: cannot import {record.target}: {fault}") from fault
        if not isinstance(found, type):
            raise PluginError(f"{self}: {record.target} is not a class")
        return found


def installed_sinks(registry: Registry) -> dict[str, InstalledSink]:
    """The output formats by name.

    A plugin with a format that cannot be used, or of a name or a file that another one has, is left out.
    """
    found: dict[str, InstalledSink] = {}
    writers: dict[str, InstalledSink] = {}
    for plugin, records in _ask(registry, "evlcp_sinks"):
        if not _all_are(SinkRecord, records):
            registry.leave_out(plugin, "evlcp_sinks() gave something else than records of SinkRecord")
            continue
        sinks, files = dict(found), dict(writers)
        fault = None
        for record in records:
            sink = InstalledSink(record, registry.owner(plugin)[0])
            fault = fault or _record_fault(record) or _clash(sink, sinks, files)
            if fault is None:
                sinks[record.name] = sink
                files |= dict.fromkeys(record.files, sink)
        if fault is not None:
            registry.leave_out(plugin, fault)
            continue
        found, writers = sinks, files
    return found


def choose_sinks(registry: Registry, names: Sequence[str], *, positions: bool) -> list[InstalledSink]:
    """The output formats of a run: the default ones and those asked for.

    Args:
        registry: The plugins.
        names: What is asked for.
        positions: Positions are computed.

    Raises:
        ConfigError: There is no such format, or it needs positions and none are computed.
    """
    sinks = installed_sinks(registry)
    for name in names:
        if name not in sinks:
            raise ConfigError(f"no sink named '{name}'{nearest(name, sorted(sinks), 'installed')}")
        if sinks[name].record.positions and not positions:
            raise ConfigError(f"sink '{name}' needs --sites: it writes positions")
    return [
        sink
        for name, sink in sinks.items()
        if name in names or (sink.record.default and (positions or not sink.record.positions))
    ]


def message_kinds(registry: Registry) -> dict[int, MessageKind]:
    """The kinds of messages by number.

    A plugin with a kind that cannot be used, or of a number or a name that another one has, is left out.
    """
    found = dict(BUILT_IN_KINDS)
    owners = dict.fromkeys(found, "evlcp-sdk")
    for plugin, kinds in _ask(registry, "evlcp_message_kinds"):
        if not _all_are(MessageKind, kinds):
            registry.leave_out(plugin, "evlcp_message_kinds() gave something else than MessageKinds")
            continue
        more = dict(found)
        fault = None
        for kind in kinds:
            fault = fault or _kind_fault(kind, more, owners)
            if fault is None:
                more[kind.number] = kind
                owners[kind.number] = registry.owner(plugin)[0]
        if fault is not None:
            registry.leave_out(plugin, fault)
            continue
        found = more
    return found


def _ask(registry: Registry, hook: str) -> list[tuple[str, Any]]:
    """The answers to a hook, those of the SDK first: where two clash, the other one is left out."""
    answers = registry.ask(hook)
    return sorted(answers, key=lambda answer: registry.owner(answer[0])[0] != "evlcp-sdk")


def _record_fault(record: SinkRecord) -> str | None:
    """What is wrong with the record of a sink."""
    for key in ("name", "target", "summary"):
        value = getattr(record, key)
        if not (isinstance(value, str) and value):
            return f"sink {record.name!r}: {key} = {value!r}, expected text"
    if not (isinstance(record.files, tuple | list) and all(_is_file_name(name) for name in record.files)):
        return (
            f"sink '{record.name}': files = {record.files!r}, expected names of files in the result's folder"
        )
    return None


def _is_file_name(name: Any) -> bool:
    return isinstance(name, str) and name not in ("", ".", "..") and not set(name) & {"/", "\\", "\0"}


def _clash(
    sink: InstalledSink, sinks: Mapping[str, InstalledSink], writers: Mapping[str, InstalledSink]
) -> str | None:
    """With what a sink clashes."""
    record = sink.record
    if record.name in sinks:
        return f"sink '{record.name}': {sinks[record.name].distribution} has one of this name"
    for name in record.files:
        if name == SUMMARY:
            return f"sink '{record.name}': {name} is the summary's file"
        if name in writers:
            return f"sink '{record.name}': {name} is a file of the {writers[name]}, too"
    return None


def _kind_fault(kind: MessageKind, kinds: Mapping[int, MessageKind], owners: Mapping[int, str]) -> str | None:
    """What is wrong with a kind of messages, or with what it clashes."""
    # A class that does not set them passes for a kind.
    number, name = getattr(kind, "number", None), getattr(kind, "name", None)
    who = f"message kind {name!r}"
    if not (isinstance(name, str) and name):
        return f"{who}: name = {name!r}, expected text"
    if not (isinstance(number, int) and 1 <= number <= _MOST_KIND):
        return f"{who}: number = {number!r}, expected 7 to {_MOST_KIND}"
    if name == "packet":
        return f"{who}: its name is that of a packet's line; choose another"
    for other in kinds.values():
        if number == other.number or name == other.name:
            return (
                f"{who}: number {number} or its name is that of '{other.name}' of {owners[other.number]};"
                " the SDK's are 1 to 6"
            )
    return None


def _all_are(kind: type[Any], found: Any) -> bool:
    return isinstance(found, list | tuple) and all(isinstance(one, kind) for one in found)
