"""The plugin manager: finds plugins by entry point, and algorithms by (role, id).

A plugin that fails is left out with all its hooks and reported: by a `PluginWarning` at once, by
`Registry.broken`, and in the error for an algorithm that it may have. All others stay.
"""

import importlib
import platform
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import Distribution, EntryPoint, entry_points, version
from typing import Any, TypeVar

import pluggy

from evlcp_sdk.errors import PluginError, PluginWarning, UnknownAlgorithmError
from evlcp_sdk.formatting import suggest
from evlcp_sdk.plugin import hooks as hookspecs
from evlcp_sdk.plugin.hooks import ENTRY_POINT_GROUP, Algorithm
from evlcp_sdk.plugin.roles import ROLES

T = TypeVar("T")
Owner = tuple[str, str]
"""Name and version of a distribution."""
FaultOf = Callable[[T, Sequence[tuple[T, Owner]]], str | None]
"""The fault of an object beside others, each with its distribution; None if it has none."""


@dataclass(frozen=True)
class InstalledAlgorithm:
    """An algorithm and the distribution that brought it."""

    algorithm: Algorithm
    distribution: str
    version: str


@dataclass(frozen=True)
class BrokenPlugin:
    """A plugin that is left out.

    Attributes:
        plugin: Its name, that of its entry point.
        distribution: Its distribution, with the version.
        reason: Its fault, in one line.
        algorithms: (role, id) of its algorithms, if it lists them.
    """

    plugin: str
    distribution: str
    reason: str
    algorithms: frozenset[tuple[str, str]] = frozenset()

    def __str__(self) -> str:
        owner = f" of {self.distribution}" if self.distribution else ""
        return f"plugin {self.plugin}{owner} is broken and left out: {self.reason}"


_HOOKS = {name for name in vars(hookspecs) if name.startswith("evlcp_")}


@lru_cache(maxsize=1)
def _find_entry_points(
    find: Callable[..., Iterable[EntryPoint]], folders: tuple[str, ...]
) -> tuple[EntryPoint, ...]:
    """The plugins installed in `folders`, cached, as finding them reads a file of every package."""
    del folders
    return tuple(find(group=ENTRY_POINT_GROUP))


@lru_cache
def _name_and_version(owner: Distribution) -> tuple[str, str]:
    """A distribution's name and version, cached, as each parses all its metadata."""
    return owner.name, owner.version


class Registry:
    """The installed plugins, as `Registry.load()` finds them.

    Algorithms are collected at the first request for one.

    Args:
        plugins: Objects with hooks, e.g. a probe.

    Raises:
        PluginError: Such an object has no hook, or an unknown one.
    """

    def __init__(self, *plugins: object) -> None:
        self._manager = pluggy.PluginManager(ENTRY_POINT_GROUP)
        self._manager.add_hookspecs(hookspecs)
        self._owners: dict[str, Distribution | None] = {}
        self._broken: list[BrokenPlugin] = []
        self._collected: dict[tuple[str, str], list[InstalledAlgorithm]] | None = None
        for plugin in plugins:
            self._add_plugin(plugin)
            if not self._manager.get_hookcallers(plugin):
                raise PluginError(f"plugin {plugin!r}: expected an object with a method marked @hookimpl")

    @classmethod
    def load(cls, *plugins: object) -> "Registry":
        """Find all installed plugins, and add objects with hooks, e.g. a probe.

        Installed packages are read once in a process, and again when `sys.path` has changed.

        Raises:
            PluginError: Such an object has no hook, or an unknown one.
        """
        registry = cls(*plugins)
        for entry in _find_entry_points(entry_points, tuple(sys.path)):
            registry._load_entry_point(entry)
        return registry

    @property
    def hook(self) -> pluggy.HookRelay:
        """The hooks, to call."""
        return self._manager.hook

    @property
    def broken(self) -> tuple[BrokenPlugin, ...]:
        """The plugins that are left out: those that failed so far."""
        return tuple(self._broken)

    def plugins_with_hook(self, hook: str) -> list[str]:
        """Names of the plugins that have a hook."""
        return [impl.plugin_name for impl in getattr(self.hook, hook).get_hookimpls()]

    def call_hook(self, hook: str, *, only: str | None = None, **arguments: Any) -> list[tuple[str, Any]]:
        """Call a hook of every plugin, or of `only` one; return pairs of its name and answer.

        An iterator's answer is a list. A plugin that fails is left out from then on, with all its hooks.
        """
        answers = []
        for impl in list(getattr(self.hook, hook).get_hookimpls()):
            if only not in (None, impl.plugin_name):
                continue
            try:
                answer = impl.function(*(arguments[name] for name in impl.argnames))
                if isinstance(answer, Iterator):
                    answer = list(answer)
            except (Exception, SystemExit) as fault:
                self.leave_out(impl.plugin_name, f"{hook}() fails: {_describe_fault(fault)}")
                continue
            answers.append((impl.plugin_name, answer))
        return answers

    def collect(
        self, hook: str, wanted: type[Any], fault_of: FaultOf[T], own: Sequence[tuple[T, Owner]] = ()
    ) -> list[tuple[T, Owner]]:
        """The objects from all plugins' hook, each with its distribution, after those that exist already.

        The SDK's come first: if two clash, the other one's plugin is left out, with all its objects.

        Args:
            hook: The hook.
            wanted: Type of the objects.
            fault_of: Gives the fault of an object beside those before it; None if it has none.
            own: Objects that exist already.
        """
        found = list(own)
        answers = [(*answer, self.distribution_of(answer[0])) for answer in self.call_hook(hook)]
        for plugin, given, owner in sorted(answers, key=lambda answer: answer[2][0] != "evlcp-sdk"):
            more, fault = list(found), None
            if not (isinstance(given, list | tuple) and all(isinstance(one, wanted) for one in given)):
                given, fault = (), f"{hook}() gave something else than {wanted.__name__}s"
            for one in given:
                fault = fault or fault_of(one, more)
                more.append((one, owner))
            if fault is None:
                found = more
            else:
                self.leave_out(plugin, fault)
        return found

    @contextmanager
    def add_temporarily(self, *plugins: object) -> Iterator[None]:
        """Add objects with hooks in a `with` block, e.g. a run's sinks that watch the receiver.

        Raises:
            PluginError: One has an unknown hook.
        """
        names: list[str] = []
        try:
            for plugin in plugins:
                names.append(self._add_plugin(plugin))
            yield
        finally:
            for name in names:
                if self._manager.has_plugin(name):
                    self._manager.unregister(name=name)
                self._owners.pop(name, None)

    def leave_out(self, plugin: str, reason: str) -> None:
        """Leave out a plugin, by its name, whose answer to a hook is of no use, for a reason in one line."""
        self._record_broken(plugin, reason, _algorithms_of(self._manager.unregister(name=plugin)))

    def list_algorithms(self, role: str | None = None) -> list[InstalledAlgorithm]:
        """The algorithms of all roles or of one, sorted by role and id; duplicates are listed, too."""
        found = sorted(self._collect_algorithms().items())
        return [entry for (r, _), entries in found if role in (None, r) for entry in entries]

    def find(self, role: str, id: str) -> InstalledAlgorithm:
        """The algorithm of a role and id.

        Raises:
            UnknownAlgorithmError: None is installed; the message suggests the nearest name.
            PluginError: Two are, or its plugin is broken.
        """
        entries = self._collect_algorithms().get((role, id), [])
        if len(entries) == 1:
            return entries[0]
        if entries:
            owners = ", ".join(f"one of {entry.distribution}" for entry in entries)
            raise PluginError(f"two {role} algorithms named '{id}': {owners}; uninstall one")
        for broken in self._broken:
            if (role, id) in broken.algorithms:
                raise PluginError(f"{role} algorithm '{id}': {broken}")
        names = [e.algorithm.id for e in self.list_algorithms(role)]
        lost = "".join(f"; {broken}" for broken in self._broken if not broken.algorithms)
        raise UnknownAlgorithmError(
            f"no {role} algorithm named '{id}'{suggest(id, names, 'installed')}{lost}"
        )

    def load_class(self, role: str, id: str) -> type[Any]:
        """Import the class of an algorithm.

        Raises:
            UnknownAlgorithmError: None is installed.
            PluginError: Its target cannot be imported, or does not fill the role; or as `find`.
        """
        return load_class(self.find(role, id))

    def versions(self) -> dict[str, str]:
        """Versions of Python, the SDK, its numerical packages, and all distributions with algorithms."""
        found = {"python": platform.python_version()}
        found |= {name: version(name) for name in ("evlcp-sdk", "numpy", "scipy", "numba")}
        found |= {entry.distribution: entry.version for entry in self.list_algorithms()}
        return found

    def distribution_of(self, plugin: str) -> tuple[str, str]:
        """Name and version of a plugin's distribution; for one without, its name and "-"."""
        found = self._owners.get(plugin)
        return (plugin, "-") if found is None else _name_and_version(found)

    def _add_plugin(self, plugin: object) -> str:
        kind = getattr(plugin, "__name__", type(plugin).__name__)
        name = f"{kind}-{id(plugin):x}"
        if (fault := self._register(plugin, name, None)) is not None:
            raise PluginError(f"plugin {kind}: {fault}")
        return name

    def _load_entry_point(self, entry: EntryPoint) -> None:
        name = entry.name
        if name in self._owners:
            # Another distribution's entry point has the same name.
            name = f"{entry.name} ({entry.value})"
        try:
            plugin = entry.load()
        except (Exception, SystemExit) as fault:
            self._owners[name] = entry.dist
            self._record_broken(name, f"cannot be imported: {_describe_fault(fault)}", frozenset())
            return
        fault_text = self._register(plugin, name, entry.dist)
        if fault_text is not None:
            self._record_broken(name, fault_text, _algorithms_of(plugin))

    def _register(self, plugin: object, name: str, owner: Distribution | None) -> str | None:
        """Register a plugin; return the fault of its hooks, if any."""
        self._owners[name] = owner
        try:
            self._manager.register(plugin, name=name)
        except pluggy.PluginValidationError as fault:
            # Its hooks before the wrong one are registered.
            self._manager.unregister(name=name)
            return " ".join(str(fault.args[0]).split())
        except ValueError:
            return "it is registered twice"
        hooks = {hook.name for hook in self._manager.get_hookcallers(plugin) or ()}
        unknown = [f"has the hook '{hook}', which this SDK does not have" for hook in sorted(hooks - _HOOKS)]
        unmarked = [
            f"{hook} is not marked with @hookimpl" for hook in sorted(_HOOKS - hooks) if hasattr(plugin, hook)
        ]
        if faults := unknown + unmarked:
            self._manager.unregister(name=name)
            return faults[0]
        return None

    def _record_broken(self, name: str, reason: str, algorithms: frozenset[tuple[str, str]]) -> None:
        owner = self._owners.get(name)
        distribution = "" if owner is None else " ".join(_name_and_version(owner))
        broken = BrokenPlugin(name, distribution, reason, algorithms)
        self._broken.append(broken)
        # Not imported at start-up, as it takes long and is needed only here.
        import multiprocessing

        # Worker processes would only repeat it.
        if multiprocessing.parent_process() is None:
            warnings.warn(str(broken), PluginWarning, stacklevel=2)

    def _collect_algorithms(self) -> dict[tuple[str, str], list[InstalledAlgorithm]]:
        if self._collected is None:
            self._collected = {}
            for record, owner in self.collect("evlcp_algorithms", Algorithm, _algorithm_fault):
                self._collected.setdefault((record.role, record.id), []).append(
                    InstalledAlgorithm(record, *owner)
                )
        return self._collected


def load_class(installed: InstalledAlgorithm) -> type[Any]:
    """Import the class of an algorithm.

    Raises:
        PluginError: Its target cannot be imported, or does not fill the role.
    """
    role = installed.algorithm.role
    who = f"{role} algorithm '{installed.algorithm.id}' of {installed.distribution}"
    return import_class(who, installed.algorithm.target, ROLES[role].abstract)


def import_class(who: str, target: str, kind: type[Any] = object) -> type[Any]:
    """Import the class `module:Class`, a subclass of `kind`.

    Raises:
        PluginError: It cannot be imported, or is no such class; the message begins with `who`.
    """
    module, _, name = target.partition(":")
    try:
        found: type[Any] = getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as fault:
        raise PluginError(f"{who}: cannot import {target}: {_describe_fault(fault)}") from fault
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise PluginError(f"{who}: {target} is not a {'class' if kind is object else kind.__name__}")
    return found


def _describe_fault(fault: BaseException) -> str:
    text = " ".join(str(fault).split())
    return f"{type(fault).__name__}: {text}" if text else type(fault).__name__


def find_text_fault(record: object, who: str, *keys: str) -> str | None:
    """The first key of a record whose value is no text, as a fault; None if there is none."""
    for key in keys:
        value = getattr(record, key, None)
        if not (isinstance(value, str) and value):
            return f"{who}: {key} = {value!r}, expected text"
    return None


def _algorithm_fault(record: Algorithm, _others: object) -> str | None:
    who = f"algorithm {record.id!r}"
    if fault := find_text_fault(record, who, "id", "role", "target"):
        return fault
    if record.role not in ROLES:
        return f"{who} has role '{record.role}', expected one of {', '.join(ROLES)}"
    revision: object = record.revision
    return None if isinstance(revision, int) else f"{who}: revision = {revision!r}, expected a whole number"


def _algorithms_of(plugin: Any) -> frozenset[tuple[str, str]]:
    """(role, id) of a broken plugin's algorithms, if it lists them."""
    try:
        return frozenset((r.role, r.id) for r in plugin.evlcp_algorithms() if isinstance(r, Algorithm))
    except Exception:
        return frozenset()
