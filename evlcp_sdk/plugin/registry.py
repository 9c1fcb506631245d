"""The plugin manager: finds plugins by entry point, and algorithms by (role, id).

A plugin that fails is left out with all its hooks, and shown: as a `PluginWarning` when that is found, by
`Registry.broken`, and in the message to whoever asks for an algorithm that may be its own. All others go on.
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
from evlcp_sdk.plugin import hooks as hookspecs
from evlcp_sdk.plugin.hooks import ENTRY_POINT_GROUP, Algorithm
from evlcp_sdk.plugin.roles import ROLES
from evlcp_sdk.suggestions import suggest

T = TypeVar("T")
Owner = tuple[str, str]
"""Name and version of a distribution."""
FaultOf = Callable[[T, Sequence[tuple[T, Owner]]], str | None]
"""What is wrong with something beside others, each with its distribution; None where nothing is."""


@dataclass(frozen=True)
class Installed:
    """An algorithm and the distribution that brought it."""

    algorithm: Algorithm
    distribution: str
    version: str


@dataclass(frozen=True)
class Broken:
    """A plugin that is left out.

    Attributes:
        plugin: Its name, that of its entry point.
        distribution: What brought it, with its version.
        reason: What is wrong, in one line.
        algorithms: (role, id) of its algorithms, as far as it could be asked.
    """

    plugin: str
    distribution: str
    reason: str
    algorithms: frozenset[tuple[str, str]] = frozenset()

    def __str__(self) -> str:
        owner = f" of {self.distribution}" if self.distribution else ""
        return f"plugin {self.plugin}{owner} is broken and left out: {self.reason}"


@lru_cache(maxsize=1)
def _found(find: Callable[..., Iterable[EntryPoint]], folders: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """The plugins installed in `folders`, found once: a file of every package is read for them."""
    del folders
    return tuple(find(group=ENTRY_POINT_GROUP))


@lru_cache
def _name_and_version(owner: Distribution) -> tuple[str, str]:
    """Of a distribution: each parses all its metadata, and one brings many plugins."""
    return owner.name, owner.version


class Registry:
    """The installed plugins; made by `Registry.load()`, passed to whoever needs it.

    Algorithms are collected when the first is asked for.

    Args:
        plugins: Objects with hooks, e.g. a probe.

    Raises:
        PluginError: Such an object has a hook that the SDK does not have.
    """

    def __init__(self, *plugins: object) -> None:
        self._manager = pluggy.PluginManager(ENTRY_POINT_GROUP)
        self._manager.add_hookspecs(hookspecs)
        self._owners: dict[str, Distribution | None] = {}
        self._broken: list[Broken] = []
        self._collected: dict[tuple[str, str], list[Installed]] | None = None
        for plugin in plugins:
            self._add(plugin)

    @classmethod
    def load(cls, *plugins: object) -> "Registry":
        """Find all installed plugins; `plugins` are objects with hooks to add, e.g. a probe.

        What is installed is read once in a process, and again when `sys.path` has changed.

        Raises:
            PluginError: Such an object has a hook that the SDK does not have.
        """
        registry = cls(*plugins)
        for entry in _found(entry_points, tuple(sys.path)):
            registry._load(entry)
        return registry

    @property
    def hook(self) -> pluggy.HookRelay:
        """The hooks, to call."""
        return self._manager.hook

    @property
    def broken(self) -> tuple[Broken, ...]:
        """The plugins that are left out: those that failed so far."""
        return tuple(self._broken)

    def plugins(self, hook: str) -> list[str]:
        """Names of the plugins that have a hook."""
        return [impl.plugin_name for impl in getattr(self.hook, hook).get_hookimpls()]

    def ask(self, hook: str, *, only: str | None = None, **given: Any) -> list[tuple[str, Any]]:
        """Call a hook of every plugin: (name of the plugin, what it gave), what it yielded as a list.

        A plugin that fails is left out from then on, with all its hooks.

        Args:
            hook: Name of the hook.
            only: The only plugin to ask; None for all.
            given: The hook's arguments.
        """
        answers = []
        for impl in list(getattr(self.hook, hook).get_hookimpls()):
            if only not in (None, impl.plugin_name):
                continue
            try:
                answer = impl.function(*(given[name] for name in impl.argnames))
                if isinstance(answer, Iterator):
                    answer = list(answer)
            except (Exception, SystemExit) as fault:
                self.leave_out(impl.plugin_name, f"{hook}() fails: {_line(fault)}")
                continue
            answers.append((impl.plugin_name, answer))
        return answers

    def collect(
        self, hook: str, wanted: type[Any], fault_of: FaultOf[T], own: Sequence[tuple[T, Owner]] = ()
    ) -> list[tuple[T, Owner]]:
        """What plugins give at a hook, each with its distribution, behind what is there already.

        The SDK's come first: where two clash, the other one's plugin is left out, with all that it gives.

        Args:
            hook: The hook.
            wanted: What they are to give.
            fault_of: What is wrong with one beside those before it; None where nothing is.
            own: What is there already.
        """
        found = list(own)
        answers = [(*answer, self.owner(answer[0])) for answer in self.ask(hook)]
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
    def joined(self, *plugins: object) -> Iterator[None]:
        """Have objects with hooks join for a while, e.g. a run's sinks that watch the receiver.

        Raises:
            PluginError: One has a hook that the SDK does not have.
        """
        names: list[str] = []
        try:
            for plugin in plugins:
                names.append(self._add(plugin))
            yield
        finally:
            for name in names:
                if self._manager.has_plugin(name):
                    self._manager.unregister(name=name)
                self._owners.pop(name, None)

    def leave_out(self, plugin: str, reason: str) -> None:
        """Leave out a plugin whose answer to a hook cannot be used.

        Args:
            plugin: Its name, as `ask` gave it.
            reason: What is wrong, in one line.
        """
        found = self._manager.unregister(name=plugin)
        self._note(plugin, reason, _known(found))

    def installed(self, role: str | None = None) -> list[Installed]:
        """The algorithms, by role and id; of one role if given. Two of one role and id are both there."""
        found = sorted(self._algorithms().items())
        return [entry for (r, _), entries in found if role in (None, r) for entry in entries]

    def find(self, role: str, id: str) -> Installed:
        """The algorithm of a role and id.

        Raises:
            UnknownAlgorithmError: None is installed; the message suggests the nearest name.
            PluginError: Two are, or it is one of a broken plugin.
        """
        entries = self._algorithms().get((role, id), [])
        if len(entries) == 1:
            return entries[0]
        if entries:
            owners = ", ".join(f"one of {entry.distribution}" for entry in entries)
            raise PluginError(f"two {role} algorithms named '{id}': {owners}; uninstall one")
        for broken in self._broken:
            if (role, id) in broken.algorithms:
                raise PluginError(f"{role} algorithm '{id}': {broken}")
        names = [e.algorithm.id for e in self.installed(role)]
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
        """Versions of Python, the SDK, what it computes with, and all distributions that bring algorithms."""
        found = {"python": platform.python_version()}
        found |= {name: version(name) for name in ("evlcp-sdk", "numpy", "scipy", "numba")}
        found |= {entry.distribution: entry.version for entry in self.installed()}
        return found

    def owner(self, plugin: str) -> tuple[str, str]:
        """Name and version of the distribution that brought a plugin; of one without, its name and "-"."""
        found = self._owners.get(plugin)
        return (plugin, "-") if found is None else _name_and_version(found)

    def _add(self, plugin: object) -> str:
        """Have an object with hooks join; the name that it has from then on."""
        kind = getattr(plugin, "__name__", type(plugin).__name__)
        name = f"{kind}-{id(plugin):x}"
        if (fault := self._join(plugin, name, None)) is not None:
            raise PluginError(f"plugin {kind}: {fault}")
        return name

    def _load(self, entry: EntryPoint) -> None:
        name = entry.name
        if name in self._owners:
            # Another distribution's entry point has the same name.
            name = f"{entry.name} ({entry.value})"
        try:
            plugin = entry.load()
        except (Exception, SystemExit) as fault:
            self._owners[name] = entry.dist
            self._note(name, f"cannot be imported: {_line(fault)}", frozenset())
            return
        fault_text = self._join(plugin, name, entry.dist)
        if fault_text is not None:
            self._note(name, fault_text, _known(plugin))

    def _join(self, plugin: object, name: str, owner: Distribution | None) -> str | None:
        """Register a plugin; what is wrong with its hooks, if anything is."""
        self._owners[name] = owner
        try:
            self._manager.register(plugin, name=name)
        except pluggy.PluginValidationError as fault:
            # Those of its hooks that came before the wrong one are in.
            self._manager.unregister(name=name)
            return " ".join(str(fault.args[0]).split())
        except ValueError:
            return "it is registered twice"
        for hook in self._manager.get_hookcallers(plugin) or []:
            if not hook.has_spec():
                self._manager.unregister(name=name)
                return f"has the hook '{hook.name}', which this SDK does not have"
        return None

    def _note(self, name: str, reason: str, algorithms: frozenset[tuple[str, str]]) -> None:
        owner = self._owners.get(name)
        distribution = "" if owner is None else " ".join(_name_and_version(owner))
        broken = Broken(name, distribution, reason, algorithms)
        self._broken.append(broken)
        # Not imported at start-up, as it takes long and is needed only here.
        import multiprocessing

        # Worker processes would only say it again.
        if multiprocessing.parent_process() is None:
            warnings.warn(str(broken), PluginWarning, stacklevel=2)

    def _algorithms(self) -> dict[tuple[str, str], list[Installed]]:
        if self._collected is None:
            self._collected = {}
            for record, owner in self.collect("evlcp_algorithms", Algorithm, _algorithm_fault):
                self._collected.setdefault((record.role, record.id), []).append(Installed(record, *owner))
        return self._collected


def load_class(one: Installed) -> type[Any]:
    """Import the class of an algorithm.

    Raises:
        PluginError: Its target cannot be imported, or does not fill the role.
    """
    role = one.algorithm.role
    who = f"{role} algorithm '{one.algorithm.id}' of {one.distribution}"
    return load_target(who, one.algorithm.target, ROLES[role].abstract)


def load_target(who: str, target: str, kind: type[Any] = object) -> type[Any]:
    """Import the class that a record names as `module:Class`, of a kind.

    Raises:
        PluginError: It cannot be imported, or is none; the message begins with who has it.
    """
    module, _, name = target.partition(":")
    try:
        found: type[Any] = getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as fault:
        raise PluginError(f"{who}: cannot import {target}: {_line(fault)}") from fault
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise PluginError(f"{who}: {target} is not a {'class' if kind is object else kind.__name__}")
    return found


def _line(fault: BaseException) -> str:
    """An exception in one line."""
    text = " ".join(str(fault).split())
    return f"{type(fault).__name__}: {text}" if text else type(fault).__name__


def _algorithm_fault(record: Algorithm, _others: object) -> str | None:
    """What is wrong with an algorithm that a plugin brings."""
    if record.role in ROLES:
        return None
    return f"algorithm '{record.id}' has role '{record.role}', expected one of {', '.join(ROLES)}"


def _known(plugin: Any) -> frozenset[tuple[str, str]]:
    """The algorithms of a broken plugin, as far as it can be asked."""
    try:
        records = list(plugin.evlcp_algorithms())
    except Exception:
        return frozenset()
    return frozenset((r.role, r.id) for r in records if isinstance(r, Algorithm))
