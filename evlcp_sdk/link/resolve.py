"""The link: what both ends agree on and how the receiver works, from `link.toml` to checked objects.

It has a table for each role (`[ranging]`: `id = "joint-scale"`, with its parameters), and `[camera]`,
`[camera_sigma]`, `[bar]`, `[air]`, `[regions]`, `[messages]` and `[position]`. Every default is written out
before anything runs, so that the resolved table alone reproduces a result. See `docs/configuration.md`.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, overload

from evlcp_sdk.air.codebook import Codebook, find_unpaired_codes
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.air.kinds import BUILT_IN_KINDS, MessageKind
from evlcp_sdk.errors import ConfigError, UnknownAlgorithmError, blame, name_place
from evlcp_sdk.formatting import add_check_hint, format_value, suggest
from evlcp_sdk.link.blocks import BlockCoder, packet_bits
from evlcp_sdk.link.sections import AirSpec, MessageSpec, PositionSpec, RegionSpec
from evlcp_sdk.plugin.records import find_message_kinds
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import (
    ROLES,
    STEPS,
    Decoding,
    Detection,
    ErrorCorrection,
    Framing,
    Modulation,
    Pilots,
    Ranging,
    Separation,
    Synchronization,
    Tracking,
)
from evlcp_sdk.scene.bar import BarLayout, read_leds
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.specs import SpecError, build_spec, parse_value, read_toml

_SPECS: dict[str, type[Any]] = {
    "camera": CameraModel,
    "camera_sigma": CameraSigma,
    "bar": BarLayout,
    "air": AirSpec,
    "regions": RegionSpec,
    "messages": MessageSpec,
    "position": PositionSpec,
}


@dataclass(frozen=True, eq=False)
class Link:
    """A resolved configuration and the objects it describes.

    Attributes:
        camera: The receiving camera.
        camera_sigma: How precisely it is known.
        bar: The transmitter's LEDs and clusters.
        air: Chip rate and packet length.
        regions: Parameters of the region detector.
        position: Parameters of the positions.
        messages: How messages are read.
        algorithms: Role to algorithm, for all roles but those that are no step of its framing.
        revisions: Role to the algorithm's revision.
        codebook: The codes that both ends share.
        packet: Lengths of a packet's parts.
        table: The resolved configuration, every default written out; plain values as in TOML.
        digest: SHA-256 of table, codebook digest and revisions, 64 hex digits.
        kinds: The installed kinds of messages, by number.
        name: Its name among several links: its file's without `.toml`; empty without a file.
        built_in: Roles whose algorithm comes with the SDK, so that tests alone check what it gives.

    Two links are equal when their digests are.
    """

    camera: CameraModel
    camera_sigma: CameraSigma
    bar: BarLayout
    air: AirSpec
    regions: RegionSpec
    messages: MessageSpec
    position: PositionSpec
    algorithms: Mapping[str, Any]
    revisions: Mapping[str, int]
    codebook: Codebook
    packet: PacketFormat
    table: Mapping[str, Mapping[str, Any]]
    digest: str
    kinds: Mapping[int, MessageKind] = field(default_factory=lambda: BUILT_IN_KINDS)
    name: str = ""
    built_in: frozenset[str] = frozenset()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Link) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self) -> str:
        book, packet = self.codebook, self.packet
        codes = f"{book.profile}, {book.clusters} clusters, {packet.frames} frames a packet"
        return f"Link({codes}, {self.air.chip_rate_hz:g} chips/s, digest {self.digest[:12]})"

    @property
    def characters_on_air(self) -> bool:
        """Whether a symbol is the code of a character; its framing determines it."""
        framing = self.algorithms.get("framing")
        return framing is not None and bool(framing.characters_on_air)

    @overload
    def algorithm(self, role: Literal["detection"]) -> Detection: ...
    @overload
    def algorithm(self, role: Literal["framing"]) -> Framing: ...
    @overload
    def algorithm(self, role: Literal["pilots"]) -> Pilots: ...
    @overload
    def algorithm(self, role: Literal["modulation"]) -> Modulation: ...
    @overload
    def algorithm(self, role: Literal["synchronization"]) -> Synchronization: ...
    @overload
    def algorithm(self, role: Literal["separation"]) -> Separation: ...
    @overload
    def algorithm(self, role: Literal["decoding"]) -> Decoding: ...
    @overload
    def algorithm(self, role: Literal["ranging"]) -> Ranging: ...
    @overload
    def algorithm(self, role: Literal["tracking"]) -> Tracking: ...
    @overload
    def algorithm(self, role: Literal["error-correction"]) -> ErrorCorrection: ...
    @overload
    def algorithm(self, role: str) -> Any: ...
    def algorithm(self, role: str) -> Any:
        """The algorithm of a role, e.g. `link.algorithm("ranging")`.

        Raises:
            ConfigError: There is no such role, or it is no step of the link's framing.
        """
        if role not in ROLES:
            raise ConfigError(f"no role named '{role}'{suggest(role, list(ROLES))}")
        if role in STEPS and role not in self.algorithms:
            raise ConfigError(f"{role}{_describe_unused_role(self.table['framing']['id'])}")
        return self.algorithms[role]

    def with_algorithm(self, role: str, algorithm: Any, *, id: str | None = None) -> "Link":
        """The same link with another algorithm, installed or not.

        Args:
            role: The role that it fills.
            algorithm: The algorithm, with its parameters.
            id: Its name in the table and in messages; None for the name of its class.

        Raises:
            ConfigError: There is no such role, or the pilots have fewer codes than the bar has clusters.

        >>> link = load_link()
        >>> link.with_algorithm("ranging", link.algorithm("ranging"), id="mine").table["ranging"]["id"]
        'mine'
        """
        # Raises if it is no step of the link's framing.
        self.algorithm(role)
        parts = self._objects_by_section() | {role: algorithm}
        described = is_dataclass(algorithm) and not isinstance(algorithm, type)
        parameters = asdict(algorithm) if described else {}
        keys = {"id": id or type(algorithm).__name__} | json.loads(json.dumps(parameters, default=str))
        table, revisions = {**self.table, role: keys}, {**self.revisions, role: 0}
        if role == "framing":
            unused = STEPS - algorithm.roles
            if missing := sorted(STEPS - unused - set(parts)):
                raise ConfigError(
                    f"framing '{keys['id']}' needs {', '.join(missing)}, which the link has not"
                )
            parts, table, revisions = (
                {name: value for name, value in each.items() if name not in unused}
                for each in (parts, table, revisions)
            )
        return _assemble_link(parts, table, revisions, self.kinds, self.built_in - {role}, self.name)

    def with_air(self, **changes: Any) -> "Link":
        """The same link with other values in `[air]`, e.g. `link.with_air(pilot_every=4)`.

        Raises:
            ConfigError: A value is wrong.
        """
        with name_place("air."):
            air = build_spec(AirSpec, asdict(self.air) | changes)
        parts, table = self._objects_by_section() | {"air": air}, {**self.table, "air": asdict(air)}
        return _assemble_link(parts, table, self.revisions, self.kinds, self.built_in, self.name)

    def block_coder(self) -> BlockCoder:
        """The coder of messages' blocks in packets.

        Raises:
            ConfigError: A packet is too short for a block.
            PluginError: The error correction fails; so do the coder's methods.
        """
        name_faults = partial(_name_faults, "error-correction", self.table)
        with name_faults():
            code = self.algorithm("error-correction").compile(packet_bits(self.codebook, self.packet))
            return BlockCoder(self.codebook, self.packet, code, name_faults)

    def _objects_by_section(self) -> dict[str, Any]:
        return {section: getattr(self, section) for section in _SPECS} | dict(self.algorithms)


def load_link(
    path: Path | str | None = None, overrides: Sequence[str] = (), registry: Registry | None = None
) -> Link:
    """Read a `link.toml`, apply `role.key=value` overrides, resolve.

    Args:
        path: The file; None for all defaults.
        overrides: What `--set` takes, e.g. `"ranging.id=poc"`; the value is TOML, or else plain text.
        registry: The algorithms; None for all that are installed.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or does not describe a link.

    >>> load_link(overrides=["modulation.id=wh8"]).codebook.bits_per_symbol
    4
    """
    table: dict[str, Any] = {}
    source = ""
    if path is not None:
        source = str(path)
        table = load_led_file(read_toml(path), Path(path).parent, f"{source}: ")
    overridden = set()
    for override in [overrides] if isinstance(overrides, str) else overrides:
        section, key, value = _parse_override(override)
        keys = table.setdefault(section, {})
        # What the file has instead of a table is refused below.
        if isinstance(keys, dict):
            keys[key] = value
            if (section, key) == ("bar", "leds_file"):
                keys.pop("leds", None)
        overridden.add((section, key))
    link = resolve(table, registry, source=source, overridden=frozenset(overridden))
    return replace(link, name=Path(source).stem)


def resolve(
    table: Mapping[str, Any],
    registry: Registry | None = None,
    *,
    source: str = "",
    overridden: frozenset[tuple[str, str]] = frozenset(),
) -> Link:
    """Check a configuration table, write out every default, build what it describes.

    Args:
        table: Section to keys, as read from TOML; may be empty.
        registry: The algorithms; None for all that are installed.
        source: Name of the table in errors, e.g. the file.
        overridden: Each (section, key) that came from `--set`.

    Raises:
        ConfigError: All faults of the table, one line each.
        UnknownAlgorithmError: The only fault is an id that is not installed.

    >>> resolve({"bar": {"rows": 48}}).codebook.clusters
    8
    """
    registry = Registry.load() if registry is None else registry
    led_source = "--set" if ("bar", "leds_file") in overridden else source
    table = load_led_file(table, prefix=f"{led_source}: " if led_source else "")
    resolver = _Resolver(table, registry, source, overridden)
    resolver.check_sections()
    # The framing determines the other roles and the default detection.
    for section in sorted(_SECTIONS, key=lambda name: (name in ROLES, name != "framing")):
        resolver.resolve_section(section)
    faults = resolver.faults
    if len(faults) == 1 and isinstance(faults[0], UnknownAlgorithmError):
        raise faults[0]
    if faults:
        raise ConfigError("\n".join(str(f) for f in faults))
    resolved = {section: resolver.resolved[section] for section in _SECTIONS if section in resolver.resolved}
    kinds, built_in = find_message_kinds(registry), frozenset(resolver.built_in)
    return _assemble_link(resolver.built, resolved, resolver.revisions, kinds, built_in)


_SECTIONS = [*_SPECS, *ROLES]
"""Names of a link's tables."""


class _Resolver:
    """Checks the tables of a link one by one, and collects their faults.

    Attributes:
        faults: The faults found.
        built: The object that each section describes.
        resolved: Each section with all its defaults, plain values.
        revisions: Of the algorithms, by role.
        built_in: Roles whose algorithm comes with the SDK.
    """

    def __init__(
        self,
        table: Mapping[str, Any],
        registry: Registry,
        source: str,
        overridden: frozenset[tuple[str, str]],
    ) -> None:
        self._table, self._registry = table, registry
        self._source, self._overridden = source, overridden
        self._unpaired_codes: frozenset[str] = frozenset()
        self.faults: list[str | UnknownAlgorithmError] = []
        self.built: dict[str, Any] = {}
        self.resolved: dict[str, dict[str, Any]] = {}
        self.revisions: dict[str, int] = {}
        self.built_in: set[str] = set()

    def check_sections(self) -> None:
        """Find unknown sections, and those that are not tables."""
        for section, keys in self._table.items():
            if section not in _SECTIONS:
                self._add_fault(
                    section,
                    self._find_overridden_key(section),
                    f": unknown table{suggest(section, _SECTIONS)}",
                )
            elif not isinstance(keys, Mapping):
                self._add_fault(section, None, f" = {keys!r}: expected a table")

    def resolve_section(self, section: str) -> None:
        """Build the object that a section describes, and write its defaults out."""
        keys, framing = self._table.get(section, {}), self.built.get("framing")
        if not isinstance(keys, Mapping):
            return
        if section in STEPS and framing is not None and section not in framing.roles:
            if section in self._table:
                self._add_fault(
                    section,
                    self._find_overridden_key(section),
                    _describe_unused_role(self.resolved["framing"]["id"]),
                )
            return
        try:
            plain = self._build_section(section, dict(keys))
        except SpecError as fault:
            for path, text in fault.faults:
                self._add_fault(section, path[0], "".join(f".{part}" for part in path[1:]) + text)
        except ConfigError as fault:
            self.faults.append(f"{self._source}: {fault}" if self._source else str(fault))
        else:
            if plain is not None:
                self.resolved[section] = json.loads(json.dumps(plain))
            if section == "modulation":
                self._unpaired_codes = _list_unpaired_codes(self.built)

    def _build_section(self, section: str, keys: dict[str, Any]) -> dict[str, Any] | None:
        """Build the object that a section describes; return all its keys, None for an unknown algorithm."""
        if section == "bar":
            bar = self.built[section] = BarLayout.of_table(keys)
            return bar.to_table()
        if section in _SPECS:
            # A test checks our own defaults, so that they need no model here.
            self.built[section] = build_spec(_SPECS[section], keys) if keys else _SPECS[section]()
            return asdict(self.built[section])
        name = keys.pop("id", self._default_id(section))
        if not isinstance(name, str):
            self._add_fault(section, "id", f" = {name!r}: expected a string")
            return None
        try:
            installed = self._registry.find(section, name)
        except UnknownAlgorithmError as unknown:
            named = self._source and (section, "id") not in self._overridden
            self.faults.append(UnknownAlgorithmError(f"{self._source}: {unknown}") if named else unknown)
            return None
        self.revisions[section] = installed.algorithm.revision
        cls, ours = self._registry.load_class(section, name), installed.distribution == "evlcp-sdk"
        if ours:
            self.built_in.add(section)
        with _name_faults(section, {section: {"id": name}}):
            self.built[section] = build_spec(cls, keys) if keys or not ours else cls()
            return {"id": name} | asdict(self.built[section])

    def _default_id(self, role: str) -> str:
        framing = self.built.get("framing")
        if role == "detection" and framing is not None and framing.detection:
            return str(framing.detection)
        return ROLES[role].default_for(self.built.get("bar"), self._unpaired_codes)

    def _find_overridden_key(self, section: str) -> str | None:
        """The first key of a section that came from `--set`; None for none."""
        keys = self._table[section]
        if not isinstance(keys, Mapping):
            return None
        return next((key for key in keys if (section, key) in self._overridden), None)

    def _add_fault(self, section: str, key: str | None, text: str) -> None:
        where = "--set" if (section, key) in self._overridden else self._source
        name = section if key is None else f"{section}.{key}"
        self.faults.append(f"{where}: {name}{text}" if where else f"{name}{text}")


def load_led_file(table: Mapping[str, Any], folder: Path = Path(), prefix: str = "") -> dict[str, Any]:
    """A copy of a link's table with the LEDs of the CSV file, in a folder, that its `[bar]` names.

    Raises:
        ConfigError: The file cannot be read or does not describe LEDs, or the table has LEDs, too.
    """
    loaded, bar = dict(table), table.get("bar")
    if not isinstance(bar, Mapping) or "leds_file" not in bar:
        return loaded
    keys = dict(bar)
    name = keys.pop("leds_file")
    if not isinstance(name, str):
        raise ConfigError(f"{prefix}bar.leds_file = {format_value(name)}: expected the name of a CSV file")
    if "leds" in keys:
        raise ConfigError(f"{prefix}bar.leds_file = {format_value(name)}: expected it, or bar.leds, not both")
    with name_place(f"{prefix}bar.leds_file: "):
        keys["leds"] = read_leds(folder / name)
    loaded["bar"] = {"shape": "table", **keys}
    return loaded


def _assemble_link(
    parts: Mapping[str, Any],
    table: Mapping[str, Mapping[str, Any]],
    revisions: Mapping[str, int],
    kinds: Mapping[int, MessageKind],
    built_in: frozenset[str],
    name: str = "",
) -> Link:
    bar, air = parts["bar"], parts["air"]
    with _name_faults("framing", table):
        codebook = parts["framing"].codebook(bar.clusters)
        if codebook is not None or not {"pilots", "modulation"} <= parts.keys():
            if not isinstance(codebook, Codebook):
                raise TypeError(f"gave {type(codebook).__name__} at codebook(), expected a Codebook")
            if codebook.clusters != bar.clusters:
                raise ValueError(f"gave codes of {codebook.clusters} clusters, expected {bar.clusters}")
    if codebook is None:
        codebook = _codes_of_roles(parts, table)
    content = {"table": table, "codebook": codebook.digest, "revisions": dict(revisions)}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return Link(
        **{section: parts[section] for section in _SPECS},
        algorithms={role: parts[role] for role in ROLES if role in parts},
        revisions=revisions,
        codebook=codebook,
        packet=PacketFormat.of(codebook, air.frames_per_packet, air.chip_rate_hz, air.pilot_every),
        table=table,
        digest=hashlib.sha256(text.encode()).hexdigest(),
        kinds=kinds,
        name=name,
        built_in=built_in,
    )


def _codes_of_roles(parts: Mapping[str, Any], table: Mapping[str, Mapping[str, Any]]) -> Codebook:
    pilots, modulation, clusters = parts["pilots"], parts["modulation"], parts["bar"].clusters
    with _name_faults("pilots", table):
        preamble, codes = pilots.preamble(), pilots.codes(clusters)
        if len(codes) != clusters:
            raise ValueError(f"gave {len(codes)} codes, expected {clusters}")
    with _name_faults("modulation", table):
        codewords = modulation.codewords()
    try:
        return Codebook(table["modulation"]["id"], preamble, codes, codewords)
    except ConfigError as fault:
        role = "modulation" if str(fault).startswith("codebook codewords") else "pilots"
        id = table[role]["id"]
        raise ConfigError(add_check_hint(f"{role} algorithm '{id}': {fault}", role, id)) from fault


def _describe_unused_role(framing: str) -> str:
    return f": no step of framing '{framing}', which has its own; leave it out"


def _list_unpaired_codes(built: Mapping[str, Any]) -> frozenset[str]:
    """Names of the codes that are not pair codes, as far as they are known and valid."""
    if {"bar", "pilots", "modulation"} <= set(built):
        # Their faults are reported where the codebook is made.
        with suppress(Exception, SystemExit):
            pilots = built["pilots"]
            codes = pilots.codes(built["bar"].clusters), built["modulation"].codewords()
            return find_unpaired_codes(pilots.preamble(), *codes)
    return frozenset()


def _name_faults(role: str, table: Mapping[str, Mapping[str, Any]]) -> AbstractContextManager[None]:
    """Turn what an algorithm raises within into a `PluginError` that names it."""
    id = table[role]["id"]
    return blame(f"{role} algorithm '{id}'", add_check_hint("", role, id))


def _parse_override(text: str) -> tuple[str, str, Any]:
    name, equals, value = text.partition("=")
    section, dot, key = (part.strip() for part in name.partition("."))
    if not (equals and dot and section and key):
        raise ConfigError(f"--set {text}: expected table.key=value, e.g. modulation.id=wh8")
    return section, key, parse_value(value)
