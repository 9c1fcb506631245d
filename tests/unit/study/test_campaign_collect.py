"""Jobs: the answer is the same whoever runs them, here or on a Dask cluster, and who dies; `receive` too."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from evlcp_sdk.errors import ConfigError, EvlcpError, InputError, OutputError
from evlcp_sdk.study.collect import PointProgress, Progress, collect_results
from evlcp_sdk.study.jobs import DaskCluster, Executor, Inline, Processes
from evlcp_sdk.study.plan import StopRule
from evlcp_sdk.study.store import Store
from evlcp_sdk.study.tally import Statistics
from tests.conftest import ROOT
from tests.unit.study.fake import fake_plan, run_fake
from tests.unit.test_signals import start


def collect_plan(plan, path, executor=None, watch=lambda _: None) -> tuple[Progress, list[Statistics]]:
    """How a collection ended, and what counts of each point in its store."""
    with Store(path, create=True) as store:
        progress = collect_results(plan, store, executor or Inline(), run_fake, watch)
        results = store.read_results()
    points = [PointProgress(point.tasks, plan.rule, results) for point in plan.points]
    return progress, [sum(point.recordings, Statistics()) for point in points]


@pytest.mark.parametrize("rule", [StopRule(), StopRule(max_bits=9000, max_errors=60)])
def test_the_number_of_workers_changes_nothing(tmp_path: Path, rule: StopRule) -> None:
    plan = fake_plan(seeds=8, rule=rule)
    one, expected = collect_plan(plan, tmp_path / "one.sqlite")
    many, totals = collect_plan(plan, tmp_path / "many.sqlite", Processes(3))
    assert totals == expected
    assert one == many
    assert one.done == one.tasks
    assert (one.points, one.points_done) == (10, 10)
    if rule == StopRule():
        assert one.tasks == 80
        assert all(total.tasks == 8 for total in totals)
        assert one.bits == sum(t.total().bits for t in totals)
        assert one.bit_errors == sum(t.total().bit_errors for t in totals)
    else:
        assert one.tasks < 80
        assert max(t.tasks for t in totals) > min(t.tasks for t in totals)


def test_a_finished_campaign_runs_nothing_and_a_grown_one_the_rest(tmp_path: Path) -> None:
    ran: list[str] = []

    def run(job: object) -> list[tuple[str, Statistics]]:
        results = run_fake(job)
        ran.extend(task for task, _ in results)
        return results

    with Store(tmp_path / "a.sqlite", create=True) as store:
        collect_results(fake_plan(), store, Inline(), run)
        assert len(ran) == 40
        with pytest.raises(ConfigError, match="holds the campaign 'fake', not 'other'"):
            store.save_plan(replace(fake_plan(), name="other"))
        collect_results(fake_plan(), store, Inline(), run)
        assert len(ran) == 40
        collect_results(fake_plan(scenes=6, seeds=5), store, Inline(), run)
    assert len(ran) == len(set(ran)) == 60
    # A rule that is tightened counts less of what is there.
    plan = fake_plan(rule=StopRule(max_bits=2500))
    assert collect_plan(plan, tmp_path / "a.sqlite")[1] == collect_plan(plan, tmp_path / "b.sqlite")[1]


@pytest.mark.parametrize("executor", [Inline(), Processes(2)], ids=["inline", "processes"])
def test_a_job_that_fails_does_not_stop_the_others(tmp_path: Path, executor: Executor) -> None:
    progress, totals = collect_plan(fake_plan(fails=1, breaks=3), tmp_path / "a.sqlite", executor)
    messages = {job.scene["n"]: fault.message for job, fault in progress.faults}
    assert messages.keys() == {1, 3}
    assert messages[1] == "this scene cannot be rendered"
    fault = "a fault of evlcp itself, not of what you gave: ValueError: a fault in a plugin"
    assert messages[3].startswith(fault)
    assert len(messages[3].splitlines()) == 1
    assert progress.done == 24
    assert [t.tasks for t in totals] == [4, 4, 0, 0, 4, 4, 0, 0, 4, 4]


def test_a_worker_that_dies_is_replaced_and_a_job_that_kills_them_given_up(tmp_path: Path) -> None:
    plan = fake_plan(scenes=3, seeds=1, dies=1, dies_once=str(tmp_path / "mark"))
    progress, totals = collect_plan(plan, tmp_path / "a.sqlite", Processes(2))
    ((job, fault),) = progress.faults
    assert (job.scene["n"], fault.message) == (1, "its process died 3 times")
    expected = collect_plan(fake_plan(scenes=3, seeds=1), tmp_path / "b.sqlite")[1]
    assert totals == [*expected[:2], Statistics(), Statistics(), *expected[4:]]


def begin(store: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "tests.unit.study.fake", store]
    return subprocess.Popen(command, cwd=ROOT, start_new_session=True)


def count_kept(store: Path) -> int:
    if not store.exists():
        return 0
    try:
        with Store(store) as file:
            return len(file.read_results())
    except InputError:
        return 0


def wait_for(count: Callable[[], int], more_than: int) -> int:
    until = time.monotonic() + 30
    while (n := count()) <= more_than and time.monotonic() < until:
        time.sleep(0.02)
    return n


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's /proc to find the workers")
def test_killed_it_ends_as_if_never(tmp_path: Path) -> None:
    """64 tasks: the scheduler is killed in the middle, its workers end, and nothing finished is lost."""
    store, plan = tmp_path / "killed.sqlite", fake_plan(8, 2, 4)
    process = begin(store)
    try:
        before = wait_for(lambda: count_kept(store), 10)
        workers = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    finally:
        process.kill()
        process.wait()
    for worker in workers:
        wait_for(lambda w=worker: int(not Path(f"/proc/{w}").exists()), 0)
        assert not Path(f"/proc/{worker}/exe").exists(), "a worker outlives its scheduler"
    assert 10 < before <= count_kept(store) < 64
    assert len(workers) >= 2
    assert begin(store).wait(60) == 0
    assert count_kept(store) == 64
    assert collect_plan(plan, store) == collect_plan(plan, tmp_path / "whole.sqlite")


def test_what_is_no_store_or_cannot_be_opened_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    for content in (b"not a database at all, but long enough to be looked at" * 20, b"\x89PNG"):
        path.write_bytes(content)
        for create in (True, False):
            with pytest.raises(InputError, match=r"a\.sqlite: "):
                Store(path, create=create)
        assert path.read_bytes() == content
    with pytest.raises(InputError, match="no results file there"):
        Store(tmp_path / "none.sqlite")
    with pytest.raises(OutputError, match=r"a\.sqlite: cannot be written: unable to open"):
        Store(tmp_path / "no" / "such" / "a.sqlite", create=True)
    new = Store(tmp_path / "new.sqlite", create=True)
    with new, pytest.raises(InputError, match="no campaign has started"):
        new.read_plan()


class Cluster:
    """A scheduler and its workers, each a process."""

    def __init__(self, folder: Path) -> None:
        self.folder, file = folder, folder / "scheduler.json"
        self.processes: list[subprocess.Popen[bytes]] = []
        self._start("scheduler", "--port", "0", "--no-show", "--scheduler-file", file)
        # The file is there before what it says is.
        wait_for(lambda: file.stat().st_size if file.exists() else 0, 0)
        self.address: str = json.loads(file.read_text())["address"]

    def _start(self, what: str, *options: str | Path) -> None:
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--host", "127.0.0.1"]
        env = os.environ | {"HOME": str(self.folder), "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "3s"}
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen([*command, "--no-dashboard", *options], cwd=ROOT, env=env, **quiet)
        self.processes.append(process)

    def add_worker(self) -> None:
        space = ("--local-directory", self.folder)
        self._start("worker", self.address, "--nthreads", "1", "--no-nanny", *space)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    made = Cluster(tmp_path)
    yield made
    for process in reversed(made.processes):
        process.kill()
        process.wait()


def test_workers_may_die_and_come(cluster: Cluster, tmp_path: Path) -> None:
    """64 tasks; one of two workers is killed in the middle, and another comes."""
    plan = fake_plan(8, 2, 4, seconds=0.02)
    for _ in range(2):
        cluster.add_worker()

    def watch(progress: Progress) -> None:
        if progress.done >= 10 and len(cluster.processes) == 3:
            cluster.processes[1].kill()
            cluster.add_worker()

    progress, totals = collect_plan(plan, tmp_path / "a.sqlite", DaskCluster(cluster.address), watch)
    assert len(cluster.processes) == 4
    assert (progress.faults, progress.done) == ((), 64)
    assert totals == collect_plan(fake_plan(8, 2, 4), tmp_path / "b.sqlite")[1]


def test_a_scheduler_that_dies_keeps_what_was_finished(cluster: Cluster, tmp_path: Path) -> None:
    plan = fake_plan(25, 2, 4, seconds=0.02)
    cluster.add_worker()

    def watch(progress: Progress) -> None:
        if progress.done == 40:
            cluster.processes[0].kill()

    with pytest.raises(EvlcpError, match="scheduler is gone; what was finished is kept") as caught:
        collect_plan(plan, tmp_path / "a.sqlite", DaskCluster(cluster.address), watch)
    assert len(str(caught.value).splitlines()) == 1
    assert count_kept(tmp_path / "a.sqlite") >= 40


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense", "tcp://127.0.0.1", "nonsense://x:1"])
def test_where_no_scheduler_answers(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client of an address that cannot be one would take 20 s to close."""
    distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")
    monkeypatch.setattr("evlcp_sdk.study.jobs._CONNECT_S", 0.5)
    if not address.endswith(":9"):
        monkeypatch.setattr(distributed, "Client", lambda *_, **__: pytest.fail("a client was started"))
    with pytest.raises(ConfigError, match=f"^--dask {address}: no Dask scheduler answers there$"):
        DaskCluster(address)


def test_without_dask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match="pip install 'evlcp-sdk\\[cluster\\]'"):
        DaskCluster("tcp://127.0.0.1:9")


def test_processes_give_what_this_one_gives(evlcp, demo_raw: Path, tmp_path: Path) -> None:
    two = [Path(shutil.copy(demo_raw, tmp_path / f"{name}.raw")) for name in "ab"]
    (tmp_path / "bad.raw").write_bytes(b"\x89PNG" + bytes(60))
    done = evlcp("receive", *two, tmp_path / "bad.raw", "-o", tmp_path / "out", "--workers", "2", "--json")
    assert done.code == 3
    assert done.err.startswith(f"evlcp: {tmp_path}/bad.raw: ")
    assert len(done.err.splitlines()) == 1
    reported = [json.loads(line) for line in done.out.splitlines()]
    assert sorted(t["status"] for t in reported) == ["complete"] * 2 + ["failed"]
    assert evlcp("receive", demo_raw, "-o", tmp_path / "one").code == 0
    expected = (tmp_path / "one" / "frames.csv").read_bytes()
    for path in two:
        assert (tmp_path / "out" / path.stem / "frames.csv").read_bytes() == expected


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
@pytest.mark.parametrize(("number", "tell"), [(signal.SIGINT, os.killpg), (signal.SIGTERM, os.kill)])
def test_ctrl_c_and_its_like_end_all_of_them(demo_raw, tmp_path, number, tell) -> None:
    """A terminal's Ctrl-C reaches workers, too: what they decoded is written, and nothing is begun."""
    many = [tmp_path / f"r{n}.raw" for n in range(40)]
    for path in many:
        path.symlink_to(demo_raw)
    out = tmp_path / "out"
    process = start("receive", *many, "-o", out, "--workers", "2", alone=True)
    until = time.monotonic() + 60
    while len(list(out.glob("*/summary.json"))) < 2 and time.monotonic() < until:
        time.sleep(0.02)
    tell(process.pid, number)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err.startswith("evlcp: interrupted; what was decoded until then is in ")
    assert len(err.splitlines()) == 1
    folders = list(out.iterdir())
    assert 2 <= len(folders) < 40
    for folder in folders:
        assert {p.name for p in folder.iterdir()} == {"frames.csv", "packets.jsonl", "summary.json"}
