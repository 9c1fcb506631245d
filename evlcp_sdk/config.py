"""The link: what both ends agree on and how the receiver works, from `link.toml` to checked objects.

One table a role (`[ranging]`: `id = "poc"`, its parameters flat beside it), and `[camera]`, `[bar]`, `[air]`,
`[regions]`, `[messages]` and `[position]`. Every default is written out before anything runs, so that the
resolved table alone reproduces a result. See `docs/configuration.md`.
"""

import difflib
import hashlib
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from evlcp_sdk.codebook import Codebook
from evlcp_sdk.errors import ConfigError, UnknownAlgorithmError
from evlcp_sdk.files import parse_value, read_toml
from evlcp_sdk.frames import PacketFormat
from evlcp_sdk.geometry import BarLayout, CameraModel
from evlcp_sdk.hookspecs import ROLE_NAMES
from evlcp_sdk.messages.coding import BlockCoder, packet_bits
from evlcp_sdk.registry import Registry

__all__ = [
    "DEFAULT_IDS",
    "AirSpec",
    "Link",
    "MessageSpec",
    "RegionSpec",
    "installed_versions",
    "load_link",
    "resolve",
    "to_toml",
]

DEFAULT_IDS = {
    "pilots": "wh",
    "modulation": "wh4x2",
    "synchronization": "barker",
    "separation": "wh-correlation",
    "decoding": "wh-transform",
    "ranging": "poc",
    "tracking": "none",
    "error-correction": "polar",
}
"""The algorithm of each role when the configuration names none."""


@dataclass(frozen=True)
class AirSpec:
    """What is on air: the rate of the chips and the length of a packet."""

    chip_rate_hz: Annotated[float, Field(gt=0, description="Chips sent a second.")] = 10_000.0
    frames_per_packet: Annotated[int, Field(gt=0, description="Frames between two preambles.")] = 10
    pilot_every: Annotated[
        int, Field(gt=0, le=64, description="Frames from one pilot to the next; 1: every frame has one.")
    ] = 1


@dataclass(frozen=True)
class MessageSpec:
    """How messages are read from packets, and whose beacons are believed."""

    decode: Annotated[bool, Field(description="Read messages; without, packets are symbols only.")] = True
    combine_packets: Annotated[
        int,
        Field(ge=0, le=256, description="Undecoded blocks kept to be added to their repetitions; 0: none."),
    ] = 16
    llr_power: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="Power that sizes of LLRs are raised to: decoders are surer than they are right.",
        ),
    ] = 0.5
    max_llr: Annotated[
        float,
        Field(gt=0, le=100, description="Largest LLR after that; no bit is surer than the sync it hangs on."),
    ] = 7.0
    trusted_keys: Annotated[
        tuple[str, ...],
        Field(description="Public Ed25519 keys, 64 hex digits each, whose beacons are verified."),
    ] = ()
    oldest_sequence: Annotated[
        int, Field(ge=0, lt=2**32, description="Sequence below which a signed beacon counts as replayed.")
    ] = 0


@dataclass(frozen=True)
class RegionSpec:
    """How blinking regions are found and followed in the image."""

    block_us: Annotated[
        int, Field(ge=200, le=10_000, description="Time step of the detector; results come once a step.")
    ] = 1500
    min_score: Annotated[
        int,
        Field(ge=2, le=40, description="Score at which a pixel is a candidate: 2 for each run of one chip."),
    ] = 8
    min_runs: Annotated[
        int, Field(ge=1, description="Runs of candidate pixels in a step that a new region needs.")
    ] = 20
    margin_px: Annotated[
        int, Field(ge=2, le=64, description="Seam around a region: how far it may move in a step, and blur.")
    ] = 5
    merge_px: Annotated[
        int, Field(ge=8, le=256, description="Gap below which two blinking areas are one region.")
    ] = 16
    fade_us: Annotated[
        int, Field(ge=1000, description="Time without blinking after which a region is released.")
    ] = 50_000
    positive_only: Annotated[
        bool, Field(description="The camera sends positive events only: tell blinking from their times.")
    ] = False
    min_clusters_share: Annotated[
        float,
        Field(ge=0, le=1, description="Share of the clusters that must be in their place in a frame."),
    ] = 0.5


@dataclass(frozen=True)
class PositionSpec:
    """How positions are computed from the image points of bars at known places."""

    min_points: Annotated[
        int, Field(ge=2, description="Clusters of a bar that must be seen for it to count.")
    ] = 6
    huber_sigmas: Annotated[
        float, Field(gt=0, description="Miss of a point, in its sigmas, beyond which it weighs less.")
    ] = 3.0
    shared_sigma_px: Annotated[
        float,
        Field(
            ge=0, description="Error that a bar's points share: motion inside the pilot, up to half a pixel."
        ),
    ] = 0.1
    pixel_sigma_px: Annotated[
        float,
        Field(
            ge=0,
            description="Error of a point that no averaging over frames removes: where in a pixel it is.",
        ),
    ] = 0.08
    min_view_deg: Annotated[
        float,
        Field(ge=0, lt=90, description="Angle between a bar and the line of sight that a lone bar needs."),
    ] = 10.0
    max_sigma_m: Annotated[
        float, Field(gt=0, description="Largest sigma of a position, in any direction, that is given.")
    ] = 3.0
    max_misfit: Annotated[
        float,
        Field(
            gt=1, description="Mean square of the misses, in sigmas, above which sites and image disagree."
        ),
    ] = 4.0
    beacons: Annotated[
        Literal["none", "verified", "any"],
        Field(
            description="Beacons whose own place is believed where no site has their id;"
            " with none, they do not contradict sites, either."
        ),
    ] = "verified"
    acceleration_m2_s3: Annotated[
        float,
        Field(gt=0, description="Power density of the change of speed: 1 m/s2 that lasts for a second."),
    ] = 1.0
    gate_sigmas: Annotated[
        float, Field(gt=1, description="Sigmas from the prediction beyond which a track leaves a fix out.")
    ] = 5.0


_SPECS: dict[str, type[Any]] = {
    "camera": CameraModel,
    "bar": BarLayout,
    "air": AirSpec,
    "regions": RegionSpec,
    "messages": MessageSpec,
    "position": PositionSpec,
}

_UNITS = {
    "us": "us",
    "ms": "ms",
    "s": "s",
    "hz": "Hz",
    "ppm": "ppm",
    "px": "px",
    "um": "um",
    "mm": "mm",
    "m": "m",
    "deg": "deg",
    "chips": "chips",
}


@dataclass(frozen=True, eq=False)
class Link:
    """A resolved configuration and the objects it describes.

    Attributes:
        camera: The receiving camera.
        bar: The transmitter's LEDs and clusters.
        air: Chip rate and packet length.
        regions: Parameters of the region detector.
        position: Parameters of the positions.
        messages: How messages are read.
        algorithms: Role to algorithm, one of each role.
        revisions: Role to the algorithm's revision.
        codebook: The codes that both ends share.
        packet: Lengths of a packet's parts.
        table: The resolved configuration, every default written out; plain values as in TOML.
        digest: SHA-256 of table, codebook digest and revisions, 64 hex digits.
    """

    camera: CameraModel
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

    def algorithm(self, role: str) -> Any:
        """The algorithm of a role, e.g. `link.algorithm("ranging")`."""
        return self.algorithms[role]

    def block_coder(self) -> BlockCoder:
        """How packets carry blocks of messages.

        Raises:
            ConfigError: A packet is too short for a block.
        """
        code = self.algorithm("error-correction").compile(packet_bits(self.codebook, self.packet))
        return BlockCoder(self.codebook, self.packet, code)


def load_link(
    path: Path | str | None = None, overrides: Sequence[str] = (), registry: Registry | None = None
) -> Link:
    """Read a `link.toml`, apply `role.key=value` overrides, resolve.

    Args:
        path: The file; None for all defaults.
        overrides: What `--set` takes, e.g. `"ranging.id=poc"`; the value is TOML, or else plain text.
        registry: Where algorithms are found; None for all that are installed.

    Raises:
        ConfigError: The file cannot be read, is no TOML, or does not describe a link.

    >>> load_link(overrides=["modulation.id=wh8"]).codebook.bits_per_symbol
    4
    """
    table: dict[str, Any] = {}
    source = ""
    if path is not None:
        source = str(path)
        table = read_toml(path)
    set_here = set()
    for override in overrides:
        section, key, value = _parse_override(override)
        keys = table.setdefault(section, {})
        if not isinstance(keys, dict):
            keys = table[section] = {}
        keys[key] = value
        set_here.add((section, key))
    return resolve(table, registry, source=source, overridden=frozenset(set_here))


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
        registry: Where algorithms are found; None for all that are installed.
        source: What faults name as their place, e.g. the file.
        overridden: (section, key) that came from `--set` instead.

    Raises:
        ConfigError: All faults of the table, one line each.
        UnknownAlgorithmError: The only fault is an id that is not installed.

    >>> resolve({"bar": {"rows": 48}}).codebook.clusters
    8
    """
    registry = Registry.load() if registry is None else registry
    faults: list[str | UnknownAlgorithmError] = []

    def fault(section: str, key: str | None, text: str) -> None:
        where = "--set" if (section, key) in overridden else source
        name = section if key is None else f"{section}.{key}"
        faults.append(f"{where}: {name}{text}" if where else f"{name}{text}")

    known = [*_SPECS, *ROLE_NAMES]
    for section, keys in table.items():
        if section not in known:
            from_set = (
                next((k for k in keys if (section, k) in overridden), None)
                if isinstance(keys, dict)
                else None
            )
            fault(section, from_set, f": unknown table{_nearest(section, known)}")
        elif not isinstance(keys, Mapping):
            fault(section, None, f" = {keys!r}: expected a table")

    built: dict[str, Any] = {}
    resolved: dict[str, dict[str, Any]] = {}
    revisions: dict[str, int] = {}
    for section in known:
        keys = table.get(section, {})
        if not isinstance(keys, Mapping):
            continue
        keys = dict(keys)
        head: dict[str, Any] = {}
        if section in _SPECS:
            cls = _SPECS[section]
        else:
            head["id"] = name = keys.pop("id", DEFAULT_IDS[section])
            if not isinstance(name, str):
                fault(section, "id", f" = {name!r}: expected a string")
                continue
            try:
                revisions[section] = registry.find(section, name).algorithm.revision
            except UnknownAlgorithmError as unknown:
                faults.append(unknown)
                continue
            cls = registry.load_class(section, name)
        try:
            values = _spec_model(cls).model_validate_json(json.dumps(keys, default=str))
            built[section] = cls(**{k: getattr(values, k) for k in type(values).model_fields})
            resolved[section] = head | json.loads(json.dumps(asdict(built[section])))
        except ValidationError as refused:
            names = [f.name for f in fields(cls) if f.init]
            for error in refused.errors():
                key = str(error["loc"][0])
                shown = f" = {_shown(keys[key])}" if key in keys else ""
                if error["type"] == "extra_forbidden":
                    fault(section, key, f"{shown}: unknown key{_nearest(key, names)}")
                else:
                    fault(section, key, f"{shown}: {_expected(error['msg'])}")
        except ConfigError as refused:
            faults.append(f"{source}: {refused}" if source else str(refused))
    if len(faults) == 1 and isinstance(faults[0], UnknownAlgorithmError):
        raise faults[0]
    if faults:
        raise ConfigError("\n".join(str(f) for f in faults))

    bar, air = built["bar"], built["air"]
    pilots, modulation = built["pilots"], built["modulation"]
    codebook = Codebook(
        resolved["modulation"]["id"], pilots.preamble(), pilots.codes(bar.clusters), modulation.codewords()
    )
    return Link(
        camera=built["camera"],
        bar=bar,
        air=air,
        regions=built["regions"],
        position=built["position"],
        messages=built["messages"],
        algorithms={role: built[role] for role in ROLE_NAMES},
        revisions=revisions,
        codebook=codebook,
        packet=PacketFormat.of(codebook, air.frames_per_packet, air.chip_rate_hz, air.pilot_every),
        table=resolved,
        digest=_digest(resolved, codebook, revisions),
    )


def installed_versions(registry: Registry) -> dict[str, str]:
    """Versions of Python, the SDK, what it computes with, and every distribution that brings an algorithm."""
    found = {"python": platform.python_version()}
    found |= {name: version(name) for name in ("evlcp-sdk", "numpy", "scipy", "numba")}
    found |= {entry.distribution: entry.version for entry in registry.installed()}
    return found


def to_toml(link: Link, registry: Registry) -> str:
    """The resolved configuration as TOML, each key with its meaning, unit, bounds and default.

    Loading the text again gives a link with the same digest.
    """
    return "\n".join(_toml_lines(link, registry)).rstrip("\n") + "\n"


def _toml_lines(link: Link, registry: Registry) -> Iterator[str]:
    yield "# EVLCP link: what transmitter and receiver agree on, and how the receiver works."
    yield f"# digest {link.digest}"
    yield f"# codebook {link.codebook.digest}"
    yield ""
    for section, values in link.table.items():
        thing = link.algorithms.get(section) or getattr(link, section)
        schema = _spec_model(type(thing)).model_json_schema()["properties"]
        yield f"# {_first_line(type(thing))}"
        yield f"[{section}]"
        if section in ROLE_NAMES:
            others = [e.algorithm.id for e in registry.installed(section) if e.algorithm.id != values["id"]]
            yield f'id = "{values["id"]}"' + (f"  # or {', '.join(others)}" if others else "")
        for key, value in values.items():
            if key in schema:
                yield f"# {_comment(key, schema[key])}"
                yield f"# {key} =" if value is None else f"{key} = {_toml_value(value)}"
        yield ""


def _comment(key: str, schema: Mapping[str, Any]) -> str:
    unit = _UNITS.get(key.rpartition("_")[2], "") if "_" in key else ""
    bounds = [
        f"{sign} {schema[name]}"
        for name, sign in (
            ("exclusiveMinimum", ">"),
            ("minimum", ">="),
            ("exclusiveMaximum", "<"),
            ("maximum", "<="),
        )
        if name in schema
    ]
    choices = [" | ".join(_toml_value(c) for c in schema["enum"])] if "enum" in schema else []
    value = schema.get("default")
    if value is not None and schema.get("type") == "number":
        value = float(value)
    default = "none" if value is None else _toml_value(value)
    facts = ", ".join([*([unit] if unit else []), *bounds, *choices, f"default {default}"])
    text = str(schema.get("description", "")).strip()
    return f"{text} [{facts}]" if text else f"[{facts}]"


def _first_line(cls: type[Any]) -> str:
    return (cls.__doc__ or cls.__name__).strip().splitlines()[0]


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml_value, value))}]"
    return repr(value)


def _parse_override(text: str) -> tuple[str, str, Any]:
    name, equals, value = text.partition("=")
    section, dot, key = (part.strip() for part in name.partition("."))
    if not (equals and dot and section and key):
        raise ConfigError(f"--set {text}: expected table.key=value, e.g. modulation.id=wh8")
    return section, key, parse_value(value)


def _spec_model(cls: type[Any]) -> type[BaseModel]:
    """A pydantic model of a dataclass's parameters, which stays free of pydantic itself."""
    hints = get_type_hints(cls, include_extras=True)
    parameters: dict[str, Any] = {}
    for f in fields(cls):
        if f.init:
            default = f.default if f.default is not MISSING else ...
            if f.default_factory is not MISSING:
                default = f.default_factory()
            parameters[f.name] = (hints[f.name], default)
    config = ConfigDict(
        extra="forbid", strict=True, allow_inf_nan=False, validate_default=True, protected_namespaces=()
    )
    return create_model(cls.__name__, __config__=config, **parameters)


def _expected(message: str) -> str:
    return message.replace("Input should be", "expected", 1)


def _shown(value: Any) -> str:
    return _toml_value(value) if isinstance(value, bool | int | float | str | list) else str(value)


def _nearest(word: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"{hint} (known: {', '.join(known) or 'none'})"


def _digest(table: Mapping[str, Any], codebook: Codebook, revisions: Mapping[str, int]) -> str:
    content = {"table": table, "codebook": codebook.digest, "revisions": dict(revisions)}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
