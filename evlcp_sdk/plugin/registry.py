"""The plugin manager: finds plugins by entry point, and algorithms by (role, id)."""

import difflib
import importlib
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points, version
from typing import Any

import pluggy

from evlcp_sdk.errors import PluginError, UnknownAlgorithmError
from evlcp_sdk.plugin import hooks as hookspecs
from evlcp_sdk.plugin.hooks import ENTRY_POINT_GROUP, ROLE_NAMES, Algorithm

__all__ = ["Installed", "Registry", "installed_versions"]


@dataclass(frozen=True)
class Installed:
    """An algorithm and the distribution that brought it."""

    algorithm: Algorithm
    distribution: str
    version: str


class Registry:
    """The installed plugins; made by `Registry.load()`, passed to whoever needs it.

    Args:
        manager: A pluggy manager with its plugins registered.

    Raises:
        PluginError: Two algorithms with one (role, id), a record for an unknown role, or a hook that the
            SDK does not know.
    """

    def __init__(self, manager: pluggy.PluginManager) -> None:
        self.manager = manager
        try:
            manager.check_pending()
        except pluggy.PluginValidationError as fault:
            raise PluginError(f"plugin hook not known to this SDK: {fault}") from fault
        self._installed = _collect(manager)

    @classmethod
    def load(cls, *plugins: object) -> "Registry":
        """Find all installed plugins; `plugins` are objects with hooks to add, e.g. a probe.

        Raises:
            PluginError: A plugin fails to import, or two distributions have entry points of one name.
        """
        _expect_distinct_names()
        manager = pluggy.PluginManager(ENTRY_POINT_GROUP)
        manager.add_hookspecs(hookspecs)
        try:
            manager.load_setuptools_entrypoints(ENTRY_POINT_GROUP)
        except Exception as fault:
            raise PluginError(f"{_failing_plugin()} fails to load: {fault}") from fault
        for plugin in plugins:
            name = getattr(plugin, "__name__", type(plugin).__name__)
            try:
                manager.register(plugin, name=f"{name}-{id(plugin):x}")
            except pluggy.PluginValidationError as fault:
                raise PluginError(f"plugin {name} fails to load: {fault}") from fault
        return cls(manager)

    @property
    def hook(self) -> pluggy.HookRelay:
        """The hooks, to call."""
        return self.manager.hook

    def installed(self, role: str | None = None) -> list[Installed]:
        """The algorithms, by role and id; of one role if given."""
        return [entry for (r, _), entry in sorted(self._installed.items()) if role in (None, r)]

    def find(self, role: str, id: str) -> Installed:
        """The algorithm of a role and id.

        Raises:
            UnknownAlgorithmError: None is installed; the message suggests the nearest name.
        """
        entry = self._installed.get((role, id))
        if entry is not None:
            return entry
        names = [e.algorithm.id for e in self.installed(role)]
        near = difflib.get_close_matches(id, names, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise UnknownAlgorithmError(
            f"no {role} algorithm named '{id}'{hint} (installed: {', '.join(names) or 'none'})"
        )

    def load_class(self, role: str, id: str) -> type[Any]:
        """Import the class of an algorithm.

        Raises:
            UnknownAlgorithmError: None is installed.
            PluginError: Its target cannot be imported, or does not fill the role.
        """
        from evlcp_sdk.plugin.roles import ROLES

        entry = self.find(role, id)
        module, _, name = entry.algorithm.target.partition(":")
        try:
            found: type[Any] = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError) as fault:
            raise PluginError(
                f"{role} algorithm '{id}' of {entry.distribution}: cannot import"
                f" {entry.algorithm.target}: {fault}"
            ) from fault
        if not (isinstance(found, type) and issubclass(found, ROLES[role])):
            raise PluginError(
                f"{role} algorithm '{id}' of {entry.distribution}: {entry.algorithm.target}"
                f" is no {ROLES[role].__name__}"
            )
        return found


def installed_versions(registry: Registry) -> dict[str, str]:
    """Versions of Python, the SDK, what it computes with, and every distribution that brings an algorithm."""
    found = {"python": platform.python_version()}
    found |= {name: version(name) for name in ("evlcp-sdk", "numpy", "scipy", "numba")}
    found |= {entry.distribution: entry.version for entry in registry.installed()}
    return found


def _expect_distinct_names() -> None:
    """Refuse two entry points of one name: the plugin manager would pass over the second in silence."""
    owners: dict[str, str] = {}
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        name = entry.dist.name if entry.dist else "an unknown distribution"
        first = owners.setdefault(entry.name, name)
        if first != name:
            raise PluginError(
                f"two plugins with an entry point named '{entry.name}': one of {first}, one of {name};"
                f" rename or uninstall one"
            )


def _failing_plugin() -> str:
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        try:
            entry.load()
        except Exception:
            return f"plugin {entry.name} of {entry.dist.name if entry.dist else 'an unknown distribution'}"
    return f"a plugin of group '{ENTRY_POINT_GROUP}'"


def _collect(manager: pluggy.PluginManager) -> dict[tuple[str, str], Installed]:
    distributions: dict[int, tuple[str, str]] = {
        id(plugin): (dist.project_name, dist.version) for plugin, dist in manager.list_plugin_distinfo()
    }
    found: dict[tuple[str, str], Installed] = {}
    for impl in manager.hook.evlcp_algorithms.get_hookimpls():
        name, version = distributions.get(id(impl.plugin), (impl.plugin_name, "-"))
        for record in _records(impl.function, name):
            key = (record.role, record.id)
            if record.role not in ROLE_NAMES:
                raise PluginError(
                    f"plugin {name}: algorithm '{record.id}' has role '{record.role}',"
                    f" expected one of {', '.join(ROLE_NAMES)}"
                )
            if key in found:
                raise PluginError(
                    f"two {record.role} algorithms named '{record.id}':"
                    f" one of {found[key].distribution}, one of {name}; uninstall one"
                )
            found[key] = Installed(record, name, version)
    return found


def _records(algorithms: Callable[[], Any], name: str) -> list[Algorithm]:
    try:
        records = list(algorithms())
    except Exception as fault:
        raise PluginError(f"plugin {name}: evlcp_algorithms() fails: {fault}") from fault
    for record in records:
        if not isinstance(record, Algorithm):
            raise PluginError(f"plugin {name}: evlcp_algorithms() gave {record!r}, expected an Algorithm")
    return records
