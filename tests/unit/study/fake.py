"""A campaign without light: tasks that cost little, fail and die as told."""

import os
import random
import signal
import sys
import time
from pathlib import Path
from typing import Any

from evlcp_sdk.errors import EvlcpError
from evlcp_sdk.study.collect import collect_results
from evlcp_sdk.study.jobs import Processes
from evlcp_sdk.study.plan import Case, Job, Plan, StopRule
from evlcp_sdk.study.store import Store
from evlcp_sdk.study.tally import Statistics, Tally


def fake_plan(scenes=5, links=2, seeds=4, rule=None, **scene: Any) -> Plan:
    """Scenes of growing difficulty; `scene` says what else their tasks do."""
    return Plan(
        "fake",
        tuple(Case({"distance_m": 30.0 + 10 * n}, {"n": n, **scene}, {"n": n}) for n in range(scenes)),
        tuple(Case({"variant": f"link {n}"}, n, n) for n in range(links)),
        tuple(range(seeds)),
        rule=rule or StopRule(),
        environment={"code": "fake"},
    )


def run_fake(job: Job) -> list[tuple[str, Statistics]]:
    """Statistics that follow from scene, link and seed alone, after a while."""
    scene = job.scene
    time.sleep(scene.get("seconds", 0.0))
    mark = scene.get("dies_once")
    if mark is not None and not Path(f"{mark}-{scene['n']}-{job.seed}").exists():
        Path(f"{mark}-{scene['n']}-{job.seed}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if scene.get("dies") == scene["n"]:
        os.kill(os.getpid(), signal.SIGKILL)
    if scene.get("fails") == scene["n"]:
        raise EvlcpError("this scene cannot be rendered")
    if scene.get("breaks") == scene["n"]:
        raise ValueError("a fault in a plugin")
    return [(task.id, fake_statistics(scene["n"], task.link, job.seed)) for task in job.tasks]


def fake_statistics(scene: int, link: int, seed: int) -> Statistics:
    rng = random.Random(f"{scene} {link} {seed}")
    tallies = []
    for _ in range(20):
        begin = 30 + 10 * scene
        tallies.append((begin, Tally(frames_sent=1)))
        if rng.random() < 0.95:
            errors = sum(rng.random() < 0.01 * (scene + 1) for _ in range(96))
            error_m = rng.gauss(0, 0.05 * (scene + 1) * (link + 1))
            tallies.append((begin, Tally(frames_found=1, bits=96, bit_errors=errors)))
            tallies.append((begin, Tally.of_distance(error_m, 0.05)))
    counts = {"tasks": 1, "events": rng.randrange(10_000), "duration_us": 100_000, "packets": 2, "rows": 20}
    return Statistics.of(tallies, **counts)


if __name__ == "__main__":
    # The process that the kill tests kill.
    with Store(Path(sys.argv[1]), create=True) as file:
        collect_results(fake_plan(8, 2, 4, seconds=0.02), file, Processes(2), run_fake)
