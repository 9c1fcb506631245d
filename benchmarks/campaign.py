"""What a campaign costs beside its tasks: tasks a second of the machinery alone, by executor.

    python benchmarks/campaign.py [TASKS]

The tasks do nothing, so a figure is the price of planning, handing over, keeping each result on the disk and
counting it. A real task takes about a second.
"""

import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from evlcp_sdk.study.campaign.collect import collect
from evlcp_sdk.study.campaign.plan import Case, Job, make_plan
from evlcp_sdk.study.campaign.store import Store
from evlcp_sdk.study.jobs import Executor, Inline, Processes
from evlcp_sdk.study.tally import Statistics, Tally

NOTHING = Statistics.of([(10 * n, Tally.distance(0.01 * n)) for n in range(3, 10)], tasks=1)


def run(job: Job) -> Sequence[tuple[str, Statistics]]:
    return [(task.id, NOTHING) for task in job.tasks]


def measure(executor: Executor, tasks: int, folder: Path) -> tuple[float, float]:
    """Tasks a second of a new campaign, and of one that finds every result."""
    scenes = [Case((("n", n),), n, n) for n in range(tasks // 10)]
    plan = make_plan("bench", scenes, [Case((), 0, 0)], range(10))
    rates = []
    with Store(folder / f"{type(executor).__name__}.sqlite", create=True) as store:
        for _ in range(2):
            began = time.perf_counter()
            progress = collect(plan, store, executor, run)
            rates.append(progress.done / (time.perf_counter() - began))
    return rates[0], rates[1]


def main() -> None:
    tasks = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    with tempfile.TemporaryDirectory() as folder:
        for executor in (Inline(), Processes(2)):
            new, again = measure(executor, tasks, Path(folder))
            name = type(executor).__name__
            print(f"{name:<10} {tasks} tasks: {new:8.0f} a second, found again: {again:8.0f} a second")


if __name__ == "__main__":
    main()
