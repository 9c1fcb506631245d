"""Collection of a campaign's results: the loop that runs needed tasks and keeps their results."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace

from evlcp_sdk.study.jobs import Executor, Fault
from evlcp_sdk.study.plan import Job, Plan, StopRule
from evlcp_sdk.study.store import Store
from evlcp_sdk.study.tally import Statistics, Tally

RunJob = Callable[[Job], Sequence[tuple[str, Statistics]]]
"""Runs a job and returns the statistics of each of its tasks."""


@dataclass(frozen=True)
class Progress:
    """Progress of a collection.

    Attributes:
        tasks: Tasks that count or may still: all but those that a stopping rule made needless.
        done: Those of them that are finished.
        points_done: Points of the plan that need no more tasks.
        bits: Bits that count so far; wrong ones among them: `bit_errors`.
        faults: Jobs that failed, in order.
    """

    tasks: int
    done: int
    points: int
    points_done: int
    bits: int
    bit_errors: int
    faults: tuple[tuple[Job, Fault], ...] = ()


@dataclass
class PointProgress:
    """The seeds of a point that count: in order, up to the one that reaches the stopping rule.

    Results of later seeds, which run out of order, do not count, so that the outcome is the same for any
    number of workers.

    Args:
        tasks: The point's tasks, by seed.
        rule: When it has enough.
        results: Task id to statistics; `advance` takes new ones.

    Attributes:
        tally: The tally so far, of all segments.
        seeds: How many seeds count so far.
        is_complete: No more seeds are needed.
        found: How many of its tasks have results.
    """

    tasks: Sequence[str]
    rule: StopRule
    results: Mapping[str, Statistics]
    tally: Tally = field(default_factory=Tally)
    seeds: int = 0
    is_complete: bool = False
    found: int = 0

    def __post_init__(self) -> None:
        self.advance(sum(task in self.results for task in self.tasks))

    def advance(self, found: int) -> None:
        """Take in so many new results."""
        self.found += found
        while not self.is_complete:
            if self.seeds == len(self.tasks) or self.rule.is_reached(self.tally):
                self.is_complete = True
            elif (result := self.results.get(self.tasks[self.seeds])) is not None:
                self.tally += result.total()
                self.seeds += 1
            else:
                return

    @property
    def recordings(self) -> tuple[Statistics, ...]:
        """Statistics of each seed that counts, in order."""
        return tuple(self.results[task] for task in self.tasks[: self.seeds])

    @property
    def needed(self) -> int:
        """Tasks that count or may still."""
        return self.seeds if self.is_complete else len(self.tasks)

    @property
    def done(self) -> int:
        """Number of finished tasks among these."""
        return self.seeds if self.is_complete else self.found


def collect_results(
    plan: Plan,
    store: Store,
    executor: Executor,
    run: RunJob,
    report_progress: Callable[[Progress], None] = lambda _: None,
) -> Progress:
    """Run the tasks that a campaign still needs, and keep every result as it comes.

    Returns:
        The progress; its `faults` are of jobs that failed, which the next run tries again.

    Raises:
        EvlcpError: The store cannot be written, or the executor cannot go on; what was finished is kept.
    """
    store.save_plan(plan)
    results = store.read_results()
    points = [PointProgress(point.tasks, plan.rule, results) for point in plan.points]
    points_of: dict[str, list[PointProgress]] = {}
    for point in points:
        for task in point.tasks:
            points_of.setdefault(task, []).append(point)
    started: set[str] = set()
    faults: list[tuple[Job, Fault]] = []

    def needed_jobs() -> Iterator[Job]:
        """Jobs in order of their seed; each task is checked again before it is started."""
        for job in plan.jobs:
            tasks = tuple(
                task
                for task in job.tasks
                if task.id not in results
                and task.id not in started
                and not all(point.is_complete for point in points_of[task.id])
            )
            if tasks:
                started.update(task.id for task in tasks)
                yield replace(job, tasks=tasks)

    report_progress(_sum_progress(points, faults))
    with closing(executor.run(run, needed_jobs())) as outcomes:
        for outcome in outcomes:
            if outcome.fault is not None:
                faults.append((outcome.job, outcome.fault))
            else:
                found = list(outcome.value or ())
                store.save_results(found)
                results.update(found)
                for task, _ in found:
                    for point in points_of[task]:
                        point.advance(1)
            report_progress(_sum_progress(points, faults))
    return _sum_progress(points, faults)


def _sum_progress(points: Sequence[PointProgress], faults: Sequence[tuple[Job, Fault]] = ()) -> Progress:
    return Progress(
        tasks=sum(point.needed for point in points),
        done=sum(point.done for point in points),
        points=len(points),
        points_done=sum(point.is_complete for point in points),
        bits=sum(point.tally.bits for point in points),
        bit_errors=sum(point.tally.bit_errors for point in points),
        faults=tuple(faults),
    )


def progress_of(plan: Plan, results: Mapping[str, Statistics]) -> Progress:
    """Progress of a campaign with these results."""
    return _sum_progress([PointProgress(point.tasks, plan.rule, results) for point in plan.points])
