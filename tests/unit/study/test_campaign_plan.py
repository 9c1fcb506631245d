"""From campaign.toml to points, tasks and jobs."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.study.plan import Case, Plan, StopRule, load_plan, plan_from_dict

TEXT = """
[campaign]
name = "try"
seeds = 3
first_seed = 10
max_errors = 100

[scene]
base = "night.toml"
set = { sensor.noise_ln = 0.02 }

[scene.grid]
speed_kmh = [20, 30]
distance_m = [90.0, 60.0, 30.0]

[link.variants]
"16 clusters" = {}
"two clusters" = { "ranging.clusters" = [1, 14], ranging.drop_extremes = 0 }
"""


def make_case(base: str | None, overrides: Sequence[str]) -> Case:
    if any(o.startswith("wrong=") for o in overrides):
        raise ConfigError("wrong: unknown key\nand more")
    identity = {"base": base and Path(base).name, "set": list(overrides)}
    return Case(value=(base, tuple(overrides)), identity=identity)


def plan_of(tmp_path: Path, text: str = TEXT, overrides: Sequence[str] = (), environment: Any = None) -> Plan:
    path = tmp_path / "c.toml"
    path.write_text(text)
    return load_plan(path, make_case, make_case, environment or {}, overrides)


def test_a_grid_with_variants(tmp_path: Path) -> None:
    plan = plan_of(tmp_path)
    assert (plan.name, plan.rule, plan.seeds) == ("try", StopRule(None, 100), (10, 11, 12))
    assert plan.merge == ("scene.distance_m",)
    assert (len(plan.scenes), len(plan.points), len(plan.jobs)) == (6, 12, 18)
    labels = {"scene.speed_kmh": 20, "scene.distance_m": 60.0, "link.variant": "two clusters"}
    assert plan.points[3].labels == labels
    base, overrides = plan.scenes[1].value
    assert base == str(tmp_path / "night.toml")
    assert overrides == ("sensor.noise_ln=0.02", "speed_kmh=20", "distance_m=60.0")
    assert plan.links[1].value == (None, ("ranging.clusters=[1, 14]", "ranging.drop_extremes=0"))
    # Jobs go seed by seed, and share a scene among links.
    assert [job.seed for job in plan.jobs] == [10] * 6 + [11] * 6 + [12] * 6
    assert all(len(job.tasks) == 2 for job in plan.jobs)
    ids = [task.id for job in plan.jobs for task in job.tasks]
    assert len(set(ids)) == 36
    assert sorted(ids) == sorted(task for point in plan.points for task in point.tasks)


def test_an_id_follows_everything_that_determines_the_result_and_nothing_else(tmp_path: Path) -> None:
    ids = {task for point in plan_of(tmp_path).points for task in point.tasks}

    def shared(text: str = TEXT, overrides: Sequence[str] = (), environment: Any = None) -> int:
        other = plan_of(tmp_path, text, overrides, environment)
        return len(ids & {task for point in other.points for task in point.tasks})

    assert shared() == 36
    assert shared(TEXT.replace("16 clusters", "all")) == 36
    for setting, same in (
        *(("campaign.name=other day", 36), ("campaign.max_bits=5", 36), ("campaign.seeds=5", 36)),
        *(("campaign.first_seed=11", 24), ("scene.sensor.noise_ln=0.03", 0), ("scene.speed_kmh=20", 18)),
    ):
        assert shared(overrides=[setting]) == same, setting
    assert shared(TEXT.replace("[20, 30]", "[30]")) == 18
    assert shared(TEXT.replace("[1, 14]", "[2, 13]")) == 18
    assert shared(environment={"evlcp-sdk": "2"}) == 0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[20, 30]", "20", "c.toml: scene.grid.speed_kmh = 20: expected a list of values"),
        ("[20, 30]", "[20, 20]", "c.toml: scene.grid.speed_kmh: a value stands there twice"),
        ("speed_kmh", "wrong", "c.toml: scene: wrong: unknown key"),
        ("= {}", "= { base = 1 }", "c.toml: link: variants.16 clusters.base = 1: expected the name"),
        ("seeds = 3", 'seeds = 3\nmerge = ["scene.speed"]', "campaign.merge: 'scene.speed' is not varied"),
    ],
)
def test_faults_are_reported_with_their_path(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError) as fault:
        plan_of(tmp_path, TEXT.replace(old, new))
    assert message in str(fault.value)


@pytest.mark.parametrize(
    ("seeds", "grids", "message"),
    [
        (3, {"scene": "abcde"}, "scene: 714924299 cases of grid and variants, expected at most 10000"),
        (1000, {"scene": "a", "link": "b"}, "59 scenes x 59 links x 1000 seeds: 3481000 tasks, expected at"),
    ],
)
def test_a_grid_of_too_many_points_is_refused_at_once(tmp_path, seeds, grids, message) -> None:
    axes = [f"{part}.grid.{axis} = {list(range(59))}" for part, some in grids.items() for axis in some]
    with pytest.raises(ConfigError, match=message):
        plan_of(tmp_path, "\n".join([*axes, f'campaign = {{ name = "x", seeds = {seeds} }}']))


def test_a_kept_plan_is_the_plan(tmp_path: Path) -> None:
    plan = plan_of(tmp_path)
    kept = plan_from_dict(json.loads(json.dumps(plan.to_dict())))
    cases = [tuple(Case(c.labels, identity=c.identity) for c in some) for some in (plan.scenes, plan.links)]
    assert kept == replace(plan, scenes=cases[0], links=cases[1])
    for one, other in zip(kept.points, plan.points, strict=True):
        assert [type(v) for v in one.labels.values()] == [type(v) for v in other.labels.values()]
    with pytest.raises(ValueError, match="not JSON compliant"):
        plan_from_dict(plan.to_dict() | {"environment": {"a": float("inf")}})
