"""The plan of a campaign: from `campaign.toml` to points, tasks and jobs.

A point is one scene with one link; its tasks are its seeds. A task's id is the SHA-256 of everything that
determines its result, so that a result is found again from any file. A job is done by one worker: a scene,
rendered once, and all links that receive this rendering.
"""

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from evlcp_sdk.errors import ConfigError, name_place
from evlcp_sdk.formatting import to_toml_value
from evlcp_sdk.specs import build_spec, parse_value, read_toml
from evlcp_sdk.study.tally import Tally


@dataclass(frozen=True)
class StopRule:
    """When a point needs no more seeds; None for never.

    Attributes:
        max_bits: Bits received.
        max_errors: Wrong bits received.
    """

    max_bits: Annotated[int | None, Field(ge=0, lt=2**63)] = None
    max_errors: Annotated[int | None, Field(ge=0, lt=2**63)] = None

    def is_reached(self, tally: Tally) -> bool:
        """Whether this is enough.

        >>> StopRule(max_errors=0).is_reached(Tally())
        True
        """
        enough_bits = self.max_bits is not None and tally.bits >= self.max_bits
        return enough_bits or (self.max_errors is not None and tally.bit_errors >= self.max_errors)


@dataclass(frozen=True)
class Case:
    """A scene or a link of the grid.

    Attributes:
        labels: Its values of everything that the campaign varies.
        value: What a worker needs of it; can be pickled, and is not stored.
        identity: Everything about it that determines a result, as JSON values.
        group: Scenes with the same group look the same and share a rendering, None: no two of them; links
            with the same group send the same.
    """

    labels: dict[str, Any] = field(default_factory=dict)
    value: Any = None
    identity: Any = None
    group: Any = None

    def to_dict(self) -> dict[str, Any]:
        """Its stored part, as for JSON."""
        return {"labels": self.labels, "identity": self.identity}


@dataclass(frozen=True)
class Task:
    """One seed of one point: its id, and the values of its scene and link."""

    id: str
    scene: Any
    link: Any


@dataclass(frozen=True)
class Job:
    """A scene, the first of those that look the same, with a seed, and the tasks that receive it."""

    scene: Any
    seed: int
    tasks: tuple[Task, ...]
    environment: Mapping[str, Any]


@dataclass(frozen=True)
class Point:
    """One scene with one link, and the ids of its tasks, by seed.

    Keys of its labels start with `scene.` or `link.`.
    """

    labels: dict[str, Any]
    scene: Case
    link: Case
    tasks: tuple[str, ...]


@dataclass(frozen=True)
class Plan:
    """A whole campaign: every scene with every link and every seed.

    Attributes:
        rule: When a point needs no more seeds.
        merge: Labels over which a report adds points up.
        environment: Code and versions that the results come from.
    """

    name: Annotated[str, Field(max_length=200)]
    scenes: tuple[Case, ...]
    links: tuple[Case, ...]
    seeds: Annotated[tuple[Annotated[int, Field(ge=0, lt=2**63)], ...], Field(min_length=1)]
    rule: StopRule = StopRule()
    merge: tuple[str, ...] = ()
    environment: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def points(self) -> tuple[Point, ...]:
        """Every scene with every link."""
        points = []
        for scene, link in itertools.product(self.scenes, self.links):
            labels = {f"scene.{key}": value for key, value in scene.labels.items()}
            labels |= {f"link.{key}": value for key, value in link.labels.items()}
            known = {"scene": scene.identity, "link": link.identity, "environment": self.environment}
            tasks = tuple(digest_of(known | {"seed": seed}) for seed in self.seeds)
            points.append(Point(labels, scene, link, tasks))
        return tuple(points)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all its tasks, 64 hex digits."""
        return digest_of([point.tasks for point in self.points])

    @cached_property
    def jobs(self) -> tuple[Job, ...]:
        """All jobs: the first seed of every rendering, then the second, and so on."""
        groups: dict[Any, list[Point]] = {}
        for number, point in enumerate(self.points):
            own_group = ("", number // len(self.links))
            group = own_group if point.scene.group is None else point.scene.group
            groups.setdefault((group, point.link.group), []).append(point)
        jobs = []
        for (n, seed), points in itertools.product(enumerate(self.seeds), groups.values()):
            # Scenes or links that differ in name only are one task.
            tasks = {p.tasks[n]: Task(p.tasks[n], p.scene.value, p.link.value) for p in points}
            jobs.append(Job(points[0].scene.value, seed, tuple(tasks.values()), self.environment))
        return tuple(jobs)

    def to_dict(self) -> dict[str, Any]:
        """Its stored part, as for JSON."""
        cases = {key: [case.to_dict() for case in getattr(self, key)] for key in ("scenes", "links")}
        return {f.name: getattr(self, f.name) for f in fields(self)} | {"rule": asdict(self.rule)} | cases


def plan_from_dict(table: Any) -> Plan:
    """A plan from `Plan.to_dict`, also by way of JSON; without values, so that its jobs cannot be run.

    Raises:
        ConfigError: It is something else.
    """
    if not isinstance(table, dict):
        raise ConfigError("expected a table")
    # Refuses numbers that are not finite.
    digest_of(table)
    return build_spec(Plan, table)


def digest_of(value: Any) -> str:
    """SHA-256 of JSON values, whatever the order of keys, 64 hex digits.

    >>> digest_of({"a": 1, "b": 2}) == digest_of({"b": 2, "a": 1})
    True
    """
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class _Campaign:
    # Words of letters, digits, dots and dashes: files are named by it.
    name: Annotated[str, Field(pattern=r"^[\w.-]+( [\w.-]+)*$", max_length=200)]
    seeds: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    first_seed: Annotated[int, Field(ge=0, lt=2**62)] = 0
    max_bits: Annotated[int | None, Field(ge=1)] = None
    max_errors: Annotated[int | None, Field(ge=1)] = None
    merge: tuple[str, ...] | None = None


@dataclass(frozen=True)
class _Grid:
    base: str | None = None
    set: dict[str, Any] = field(default_factory=dict)
    grid: dict[str, Any] = field(default_factory=dict)
    variants: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class _File:
    campaign: _Campaign
    scene: _Grid = _Grid()
    link: _Grid = _Grid()


_MAX_CASES = 10_000
_MAX_TASKS = 1_000_000
"""A task takes a second or more; a larger campaign would end in weeks."""

MakeCase = Callable[[str | None, Sequence[str]], Case]
"""Makes a case, without labels, of a base and overrides."""


def load_plan(
    path: Path | str,
    scene_of: MakeCase,
    link_of: MakeCase,
    environment: Mapping[str, Any],
    overrides: Sequence[str] = (),
) -> Plan:
    """Read a campaign file, make its scenes and links, and lay out its points.

    `environment` is part of every task's id; `overrides` are as of `--set`, e.g. `"campaign.seeds=2"`: the
    value is TOML, or else plain text.

    Raises:
        ConfigError: All faults of the file, one line each.
    """
    table = read_toml(path)
    for override in overrides:
        _apply_override(table, override)
    with name_place(f"{path}: "):
        file = build_spec(_File, table)
    folder = Path(path).parent
    faults: list[str] = []
    scenes = _make_cases("scene", file.scene, folder, scene_of, faults, path)
    links = _make_cases("link", file.link, folder, link_of, faults, path)
    varied = {f"scene.{key}" for scene in scenes for key in scene.labels}
    varied |= {f"link.{key}" for link in links for key in link.labels}
    merge = file.campaign.merge
    if merge is None:
        merge = tuple(sorted(key for key in varied if key.endswith("distance_m")))
    for key in merge:
        if key not in varied:
            known = ", ".join(sorted(varied)) or "nothing"
            faults.append(f"{path}: campaign.merge: '{key}' is not varied (varied: {known})")
    if faults:
        raise ConfigError("\n".join(dict.fromkeys(faults)))
    campaign = file.campaign
    tasks = len(scenes) * len(links) * campaign.seeds
    if tasks > _MAX_TASKS:
        raise ConfigError(
            f"{path}: {len(scenes)} scenes x {len(links)} links x {campaign.seeds} seeds: {tasks} tasks,"
            f" expected at most {_MAX_TASKS}"
        )
    return Plan(
        campaign.name,
        tuple(scenes),
        tuple(links),
        tuple(range(campaign.first_seed, campaign.first_seed + campaign.seeds)),
        StopRule(campaign.max_bits, campaign.max_errors),
        merge,
        dict(environment),
    )


def _apply_override(table: dict[str, Any], text: str) -> None:
    name, equals, value = text.partition("=")
    section, dot, key = (part.strip() for part in name.partition("."))
    if not (equals and dot and key) or section not in ("campaign", "scene", "link"):
        raise ConfigError(f"--set {text}: expected campaign.KEY=, scene.KEY= or link.KEY=VALUE")
    parsed = parse_value(value)
    keys = table.setdefault(section, {})
    if section != "campaign" and isinstance(keys, dict):
        for name in ("grid", "set"):
            if isinstance(inner := keys.get(name, {}), dict):
                keys[name] = {k: v for k, v in _flatten(inner).items() if k != key}
        keys = keys["set"]
    if isinstance(keys, dict):
        keys[key] = parsed


def _make_cases(
    kind: str, grid: _Grid, folder: Path, make: MakeCase, faults: list[str], path: Path | str
) -> list[Case]:
    fixed = _flatten(grid.set)
    axes = _flatten(grid.grid)
    for key, values in axes.items():
        if not isinstance(values, list) or not values:
            faults.append(f"{path}: {kind}.grid.{key} = {values!r}: expected a list of values")
        elif len({repr(v) for v in values}) < len(values):
            faults.append(f"{path}: {kind}.grid.{key}: a value stands there twice")
    count = math.prod(len(values) for values in axes.values() if isinstance(values, list))
    count *= max(len(grid.variants), 1)
    if count > _MAX_CASES:
        faults.append(f"{path}: {kind}: {count} cases of grid and variants, expected at most {_MAX_CASES}")
    if faults:
        return []
    cases = []
    for name, variant in (grid.variants or {"": {}}).items():
        variant = _flatten(variant)
        case_base = variant.pop("base", grid.base)
        for values in itertools.product(*axes.values()):
            chosen = dict(zip(axes, values, strict=True))
            settings = fixed | chosen | variant
            for key in (key for key in settings if key.endswith("link")):
                settings[key] = _resolve_file(settings[key], folder.resolve())
            overrides = [f"{key}={to_toml_value(value)}" for key, value in settings.items()]
            try:
                if not isinstance(case_base, str | None):
                    raise ConfigError(f"variants.{name}.base = {case_base!r}: expected the name of a file")
                case = make(_resolve_file(case_base, folder), overrides)
            except ConfigError as fault:
                faults.extend(f"{path}: {kind}: {line}" for line in str(fault).splitlines())
                continue
            cases.append(replace(case, labels=({"variant": name} if grid.variants else {}) | chosen))
    return cases


def _flatten(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested tables: `{"a": {"b": 1}}` and `{"a.b": 1}` both become `{"a.b": 1}`."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat


def _resolve_file(base: Any, folder: Path) -> Any:
    """Resolve the path of a file against the campaign's folder; a preset has no suffix."""
    return str(folder / base) if isinstance(base, str) and base.endswith(".toml") else base
