"""What plugins bring besides algorithms: output formats by name, kinds of messages by number."""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from evlcp_sdk.air.kinds import BUILT_IN_KINDS, MessageKind
from evlcp_sdk.errors import ConfigError, PluginError
from evlcp_sdk.plugin.hooks import SinkRecord
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.spelling import nearest

__all__ = ["InstalledSink", "choose_sinks", "installed_sinks", "message_kinds"]

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
        except Exception as fault:
            raise PluginError(f"{self}: cannot import {record.target}: {fault}") from fault
        if not isinstance(found, type):
            raise PluginError(f"{self}: {record.target} is not a class")
        return found


def installed_sinks(registry: Registry) -> dict[str, InstalledSink]:
    """The output formats by name.

    Raises:
        PluginError: Two have one name, or leave one file.
    """
    found: dict[str, InstalledSink] = {}
    writers: dict[str, InstalledSink] = {}
    for plugin, records in registry.ask("evlcp_sinks"):
        owner, _ = registry.owner(plugin)
        if not _all_are(SinkRecord, records):
            registry.leave_out(plugin, "evlcp_sinks() gave something else than records of SinkRecord")
            continue
        for record in records:
            sink = InstalledSink(record, owner)
            if (other := found.setdefault(record.name, sink)) is not sink:
                raise PluginError(
                    f"two sinks named '{record.name}': one of {other.distribution}, one of {owner};"
                    " uninstall one"
                )
            for name in record.files:
                if (other := writers.setdefault(name, sink)) is not sink:
                    raise PluginError(f"{name} is a file of the {other} and of the {sink}; uninstall one")
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

    Raises:
        PluginError: Two have one number or name, or the number is not one of the format's four bits.
    """
    found = dict(BUILT_IN_KINDS)
    owners = {kind.number: "evlcp-sdk" for kind in found.values()}
    for plugin, kinds in registry.ask("evlcp_message_kinds"):
        owner, _ = registry.owner(plugin)
        if not _all_are(MessageKind, kinds):
            registry.leave_out(plugin, "evlcp_message_kinds() gave something else than MessageKinds")
            continue
        for kind in kinds:
            who = f"message kind '{kind.name}' of {owner}"
            if not (isinstance(kind.number, int) and 1 <= kind.number <= _MOST_KIND):
                raise PluginError(f"{who}: number = {kind.number!r}, expected 5 to {_MOST_KIND}")
            if kind.name == "packet":
                raise PluginError(f"{who}: its name is that of a packet's line; choose another")
            for other in found.values():
                if kind.number == other.number or kind.name == other.name:
                    raise PluginError(
                        f"{who}: number {kind.number} or its name is that of '{other.name}' of"
                        f" {owners[other.number]}; the SDK's are 1 to 4; uninstall one"
                    )
            found[kind.number] = kind
            owners[kind.number] = owner
    return found


def _all_are(kind: type[Any], found: Any) -> bool:
    return isinstance(found, list | tuple) and all(isinstance(one, kind) for one in found)
