"""The collection: which tasks are still needed, and the loop that runs them and keeps their results."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace

from evlcp_sdk.study.jobs import Executor, Fault
from evlcp_sdk.study.plan import Job, Plan, StopRule
from evlcp_sdk.study.store import Store
from evlcp_sdk.study.tally import Statistics, Tally

RunJob = Callable[[Job], Sequence[tuple[str, Statistics]]]
"""Runs a job; gives the statistics of each of its tasks."""


@dataclass(frozen=True)
class Progress:
    """How far a collection is.

    Attributes:
        tasks: Tasks that count or may still: all, less those that a stopping rule made needless.
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
class Counted:
    """What counts of a point: its seeds in order, up to the one that reaches the stopping rule.

    Tasks run out of order and beyond that seed; what those gave does not count, so the answer is the same
    however many workers there were.

    Args:
        tasks: The point's tasks, by seed.
        rule: When it has enough.
        results: Task id to statistics; `advance` looks what has come.

    Attributes:
        tally: The tally so far, of all segments.
        seeds: How many seeds it takes.
        complete: No more seeds are needed.
        found: How many of its tasks have results.
    """

    tasks: Sequence[str]
    rule: StopRule
    results: Mapping[str, Statistics]
    tally: Tally = field(default_factory=Tally)
    seeds: int = 0
    complete: bool = False
    found: int = 0

    def __post_init__(self) -> None:
        self.advance(sum(task in self.results for task in self.tasks))

    def advance(self, found: int) -> None:
        """Count results that have come since, so many of them."""
        self.found += found
        while not self.complete:
            if self.seeds == len(self.tasks) or self.rule.reached(self.tally):
                self.complete = True
            elif (result := self.results.get(self.tasks[self.seeds])) is not None:
                self.tally += result.total()
                self.seeds += 1
            else:
                return

    @property
    def recordings(self) -> tuple[Statistics, ...]:
        """What counts of each seed, in order."""
        return tuple(self.results[task] for task in self.tasks[: self.seeds])

    @property
    def needed(self) -> int:
        """Tasks that count or may still."""
        return self.seeds if self.complete else len(self.tasks)

    @property
    def done(self) -> int:
        """Those of them that are finished."""
        return self.seeds if self.complete else self.found


def collect(
    plan: Plan,
    store: Store,
    executor: Executor,
    run: RunJob,
    watch: Callable[[Progress], None] = lambda _: None,
) -> Progress:
    """Run what a campaign still needs, and keep every result as it comes.

    Returns:
        How far it came; its `faults` say which jobs failed. They are tried again by the next run.

    Raises:
        EvlcpError: The store cannot be written, or the executor cannot go on; what was finished is kept.
    """
    store.adopt(plan)
    results = store.results()
    points = [Counted(point.tasks, plan.rule, results) for point in plan.points]
    points_of: dict[str, list[Counted]] = {}
    for point in points:
        for task in point.tasks:
            points_of.setdefault(task, []).append(point)
    begun: set[str] = set()
    faults: list[tuple[Job, Fault]] = []

    def needed() -> Iterator[Job]:
        """Jobs in order of their seed; each task is looked at again before it is given out."""
        for job in plan.jobs:
            tasks = tuple(
                task
                for task in job.tasks
                if task.id not in results
                and task.id not in begun
                and not all(point.complete for point in points_of[task.id])
            )
            if tasks:
                begun.update(task.id for task in tasks)
                yield replace(job, tasks=tasks)

    watch(_progress(points, faults))
    with closing(executor.run(run, needed())) as outcomes:
        for outcome in outcomes:
            if outcome.fault is not None:
                faults.append((outcome.job, outcome.fault))
            else:
                found = list(outcome.value or ())
                store.put(found)
                results.update(found)
                for task, _ in found:
                    for point in points_of[task]:
                        point.advance(1)
            watch(_progress(points, faults))
    return _progress(points, faults)


def _progress(points: Sequence[Counted], faults: Sequence[tuple[Job, Fault]] = ()) -> Progress:
    return Progress(
        tasks=sum(point.needed for point in points),
        done=sum(point.done for point in points),
        points=len(points),
        points_done=sum(point.complete for point in points),
        bits=sum(point.tally.bits for point in points),
        bit_errors=sum(point.tally.bit_errors for point in points),
        faults=tuple(faults),
    )


def progress_of(plan: Plan, results: Mapping[str, Statistics]) -> Progress:
    """How far a campaign is with these results."""
    return _progress([Counted(point.tasks, plan.rule, results) for point in plan.points])
