"""The collection: which tasks are still needed, and the loop that runs them and keeps their results."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from evlcp_sdk.study.campaign.plan import Job, Plan, StopRule
from evlcp_sdk.study.campaign.store import Store
from evlcp_sdk.study.jobs import Executor, Fault
from evlcp_sdk.study.tally import Statistics

__all__ = ["Counted", "Progress", "RunJob", "collect", "progress_of"]

RunJob = Callable[[Job], Sequence[tuple[str, Statistics]]]
"""Runs a job; gives the statistics of each of its tasks."""


@dataclass(frozen=True)
class Progress:
    """How far a collection is.

    Attributes:
        tasks: Tasks that count or may still: all, less those that a stopping rule made needless.
        done: Those of them that are finished.
        points: Points of the plan.
        points_done: Points that need no more tasks.
        bits: Bits that count so far.
        bit_errors: Wrong ones among them.
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
        total: The statistics so far.
        seeds: How many seeds they take.
        complete: No more seeds are needed.
    """

    tasks: Sequence[str]
    rule: StopRule
    results: Mapping[str, Statistics]
    total: Statistics = field(default_factory=Statistics)
    seeds: int = 0
    complete: bool = False

    def __post_init__(self) -> None:
        self.advance()

    def advance(self) -> None:
        """Count what has come since."""
        while not self.complete:
            if self.seeds == len(self.tasks) or self.rule.reached(self.total):
                self.complete = True
            elif (result := self.results.get(self.tasks[self.seeds])) is not None:
                self.total += result
                self.seeds += 1
            else:
                return

    @property
    def recordings(self) -> tuple[Statistics, ...]:
        """What counts of each seed, in order."""
        return tuple(self.results[task] for task in self.tasks[: self.seeds])

    @property
    def done(self) -> int:
        """Tasks that are finished, of those that count or may still."""
        return self.seeds if self.complete else sum(task in self.results for task in self.tasks)


class _Collection:
    """What is known and what is under way."""

    def __init__(self, plan: Plan, results: dict[str, Statistics]) -> None:
        self.faults: list[tuple[Job, Fault]] = []
        self._plan = plan
        self._results = results
        self._begun: set[str] = set()
        self._counted = [Counted(point.tasks, plan.rule, results) for point in plan.points]
        self._shares = [_share(counted) for counted in self._counted]
        self._sums = [sum(column) for column in zip(*self._shares, strict=True)]
        self._points_of: dict[str, list[int]] = {}
        for number, point in enumerate(plan.points):
            for task in point.tasks:
                self._points_of.setdefault(task, []).append(number)

    def needed(self) -> Iterator[Job]:
        """Jobs in order of their seed; each task is looked at again before it is given out."""
        for job in self._plan.jobs:
            tasks = tuple(task for task in job.tasks if self._is_needed(task.id))
            if tasks:
                self._begun.update(task.id for task in tasks)
                yield Job(job.scene, job.seed, tasks, job.environment)

    def _is_needed(self, task: str) -> bool:
        if task in self._results or task in self._begun:
            return False
        return any(not self._counted[number].complete for number in self._points_of[task])

    def take(self, results: Sequence[tuple[str, Statistics]]) -> None:
        self._results.update(results)
        for task, _ in results:
            for number in self._points_of[task]:
                self._counted[number].advance()
                share = _share(self._counted[number])
                changes = zip(self._sums, self._shares[number], share, strict=True)
                self._sums = [total - old + new for total, old, new in changes]
                self._shares[number] = share

    def progress(self) -> Progress:
        tasks, done, points_done, bits, bit_errors = self._sums
        return Progress(tasks, done, len(self._counted), points_done, bits, bit_errors, tuple(self.faults))


def _share(counted: Counted) -> tuple[int, int, int, int, int]:
    """A point's tasks, done ones, whether it is complete, its bits and wrong bits."""
    tally = counted.total.total()
    tasks = counted.seeds if counted.complete else len(counted.tasks)
    return tasks, counted.done, int(counted.complete), tally.bits, tally.bit_errors


def collect(
    plan: Plan,
    store: Store,
    executor: Executor,
    run: RunJob,
    watch: Callable[[Progress], None] = lambda _: None,
) -> Progress:
    """Run what a campaign still needs, and keep every result as it comes.

    Args:
        plan: The campaign.
        store: Where results are kept, and those of earlier runs are found.
        executor: Where jobs run.
        run: What runs a job.
        watch: Gets how far it is, at first and after each job.

    Returns:
        How far it came; its `faults` say which jobs failed. They are tried again by the next run.

    Raises:
        EvlcpError: The store cannot be written, or the executor cannot go on; what was finished is kept.
    """
    store.adopt(plan)
    wanted = {task for point in plan.points for task in point.tasks}
    collection = _Collection(plan, {id: s for id, s in store.results().items() if id in wanted})
    watch(collection.progress())
    for outcome in executor.run(run, collection.needed()):
        if outcome.fault is not None:
            collection.faults.append((outcome.job, outcome.fault))
        else:
            store.put(list(outcome.value or ()))
            collection.take(outcome.value or ())
        watch(collection.progress())
    return collection.progress()


def progress_of(plan: Plan, results: Mapping[str, Statistics]) -> Progress:
    """How far a campaign is with these results."""
    return _Collection(plan, dict(results)).progress()
