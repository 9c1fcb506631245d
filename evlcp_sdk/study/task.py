"""One job of a campaign: render a scene, receive it with every link, count it against the truth."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.sim import Scene, Simulation, load_scene, truth_of
from evlcp_sdk.sim.world import attitude_log, drop_reported_errors, survey_sites
from evlcp_sdk.study.frames import frames_of
from evlcp_sdk.study.match import check_link
from evlcp_sdk.study.measure import statistics_of, tally_messages, tally_positions
from evlcp_sdk.study.plan import Case, Job, Plan, digest_of, load_plan
from evlcp_sdk.study.tally import Statistics
from evlcp_sdk.values import Packet

_PACKAGES = ("air", "link", "place", "plugin", "rx", "scene", "sim")
_ON_AIR = ("air", "bar", "framing", "pilots", "modulation", "error-correction")
"""Sections of a link that determine what a bar sends, as far as its framing has them."""

_UNUSED = ("position", "camera_sigma")
"""Sections of a link that a receiver does not use."""

_STUDY = ("frames.py", "match.py", "measure.py", "tally.py", "task.py")


def plan_campaign(path: Path | str, overrides: Sequence[str] = ()) -> Plan:
    """Read a campaign file and resolve its scenes and links, with code and versions of this installation.

    Raises:
        ConfigError: All faults of the file, one line each.
    """
    registry = Registry.load()

    def scene_of(base: str | None, settings: Sequence[str]) -> Case:
        if base is None:
            raise ConfigError("base: missing; expected a preset or a scene file")
        scene = load_scene(base, settings, registry)
        # Scenes that differ only in reported values look the same.
        group = digest_of(_scene_identity(drop_reported_errors(scene)))
        return Case(value=scene, identity=_scene_identity(scene), group=group)

    def link_of(base: str | None, settings: Sequence[str]) -> Case:
        link = load_link(base, settings, registry)
        table = {section: dict(keys) for section, keys in link.table.items()}
        revisions = dict(link.revisions)
        identity: dict[str, Any] = {"digest": link.digest, "codebook": link.codebook.digest}
        identity |= {"revisions": revisions, "table": table}
        on_air = ({key: part[key] for key in _ON_AIR if key in part} for part in (table, revisions))
        group = digest_of([*on_air, link.codebook.digest])
        return Case(value=(table, link.digest), identity=json.loads(json.dumps(identity)), group=group)

    return load_plan(path, scene_of, link_of, environment_of(registry), overrides)


def _set_campaign_link(scene: Scene, table: Mapping[str, Any]) -> Scene:
    link = {section: table[section] for section in _ON_AIR if section in table}
    bars = (replace(bar, link=link) if bar.link is None else bar for bar in scene.bars)
    return scene if scene.link is not None else replace(scene, bars=tuple(bars))


def environment_of(registry: Registry) -> dict[str, Any]:
    """The installation as far as it determines a result: versions, and the digest of the code."""
    import evlcp_sdk

    root = Path(evlcp_sdk.__file__).parent
    files = {*root.glob("*.py")} | {root / "study" / name for name in _STUDY}
    files |= {path for name in _PACKAGES for path in (root / name).rglob("*.py")}
    for installed in registry.list_algorithms():
        if installed.distribution == "evlcp-sdk":
            spec = find_spec(installed.algorithm.target.partition(":")[0].partition(".")[0])
            if spec is not None and spec.origin is not None:
                files |= set(Path(spec.origin).parent.rglob("*.py"))
    digest = hashlib.sha256()
    for path in sorted(files, key=lambda p: (p.parent.name, p.name)):
        digest.update(f"{path.parent.name}/{path.name}\0".encode() + path.read_bytes() + b"\0")
    return {"source": digest.hexdigest(), "versions": registry.versions()}


def _scene_identity(scene: Scene) -> Any:
    """The scene as JSON values, with digests of the files it names instead of their paths."""
    table = json.loads(json.dumps(asdict(scene)))
    for section, key in [(table["motion"], "path_file"), *((bar, "chips_file") for bar in table["bars"])]:
        if section[key] is not None:
            try:
                section[key] = hashlib.sha256(Path(section[key]).read_bytes()).hexdigest()
            except OSError as fault:
                raise ConfigError(f"{section[key]}: cannot be read: {fault.strerror}") from fault
    return table


def run_job(job: Job) -> list[tuple[str, Statistics]]:
    """Render the job's scene once, receive it with the link of every task, and count it against the truth.

    A bar without a link of its own sends with that of the tasks, which send the same.

    Raises:
        ConfigError: This installation would not give the result of the task's id, or the scene sends with
            another link than a task receives with.
    """
    registry = Registry.load()
    if environment_of(registry) != job.environment:
        raise ConfigError(
            "code or versions here are not those of the campaign's plan: changed since it began"
            " (run it again), or other than on the machine that asks (install the same)"
        )
    scene = _set_campaign_link(job.scene, job.tasks[0].link[0])
    simulation = Simulation(scene, job.seed, registry=registry)
    truth = truth_of(simulation, registry=registry)
    received: dict[str, tuple[Receiver, list[Packet]]] = {}
    receptions = []
    for task in job.tasks:
        table, digest = task.link
        link = resolve(table, registry)
        if link.digest != digest:
            raise ConfigError(f"link {digest[:12]} resolves to {link.digest[:12]} here")
        check_link(truth, link, "the scene", messages=True)
        world = task.scene.world
        attitude = None if world is None else attitude_log(task.scene, job.seed, simulation.path)
        # Reported sites and positions make no difference to what is received.
        used = {section: dict(keys) for section, keys in link.table.items() if section not in _UNUSED}
        key = digest_of([used, None if world is None else asdict(replace(world, survey_sigma_m=0.0))])
        if key not in received:
            received[key] = Receiver(link, attitude=attitude), []
        receptions.append((task, link, attitude, received[key][1]))
    messages = any(bar.sends_frames and bar.payload != "symbols" for bar in truth.bars)
    total = 0
    for events in simulation.stream():
        total += len(events)
        for receiver, packets in received.values():
            packets += receiver.feed(events)
    for receiver, packets in received.values():
        packets += receiver.close()
    results = []
    for task, link, attitude, packets in receptions:
        others = tally_messages(packets, truth, link.block_coder()) if messages else []
        if scene.world is not None:
            sites = survey_sites(_set_campaign_link(task.scene, task.link[0]), job.seed, registry)
            others += tally_positions(packets, truth, link, attitude, sites)
        counted = statistics_of(frames_of(packets), truth, events=total, packets=len(packets), others=others)
        results.append((task.id, counted))
    return results
