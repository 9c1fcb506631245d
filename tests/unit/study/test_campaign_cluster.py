"""A Dask cluster gives what local processes give, also while its workers die."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from evlcp_sdk.errors import ConfigError, EvlcpError
from evlcp_sdk.study.collect import Progress, collect
from evlcp_sdk.study.jobs import DaskCluster, Inline
from evlcp_sdk.study.store import Store
from tests.conftest import ROOT
from tests.unit.study.fake import fake_plan, run_fake

QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


class Cluster:
    """A scheduler and its workers, each a process."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "scheduler.json"
        self.processes: list[subprocess.Popen[bytes]] = []
        options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show"]
        self._start("distributed.cli.dask_scheduler", *options, "--scheduler-file", self.file)
        until = time.monotonic() + 30
        # The file is there before what it says is.
        while not (self.file.exists() and self.file.stat().st_size) and time.monotonic() < until:
            time.sleep(0.05)
        self.address: str = json.loads(self.file.read_text())["address"]

    def _start(self, module: str, *options: str | Path) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", module, *map(str, options)]
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env=os.environ | {"HOME": str(self.folder), "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "3s"},
            **QUIET,
        )  # type: ignore[call-overload]
        self.processes.append(process)
        return process  # type: ignore[no-any-return]

    def add_worker(self) -> subprocess.Popen[bytes]:
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"]
        space = ["--local-directory", self.folder]
        return self._start("distributed.cli.dask_worker", self.address, *options, *space)

    def end(self) -> None:
        for process in reversed(self.processes):
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    made = Cluster(tmp_path)
    yield made
    made.end()


def test_workers_may_die_and_come(cluster: Cluster, tmp_path: Path) -> None:
    """64 tasks; one of two workers is killed in the middle, and another comes."""
    plan = fake_plan(8, 2, 4, seconds=0.02)
    workers = [cluster.add_worker() for _ in range(2)]

    def watch(progress: Progress) -> None:
        if progress.done >= 10 and workers:
            workers.pop().kill()
            workers.clear()
            cluster.add_worker()

    with Store(tmp_path / "dask.sqlite", create=True) as store:
        progress = collect(plan, store, DaskCluster(cluster.address), run_fake, watch)
        found = store.results()
    assert not workers
    assert progress.faults == ()
    assert progress.done == 64
    with Store(tmp_path / "inline.sqlite", create=True) as store:
        collect(fake_plan(8, 2, 4), store, Inline(), run_fake)
        assert store.results() == found


def test_a_scheduler_that_dies_keeps_what_was_finished(cluster: Cluster, tmp_path: Path) -> None:
    cluster.add_worker()
    plan = fake_plan(25, 2, 4, seconds=0.02)

    def watch(progress: Progress) -> None:
        if progress.done == 40:
            cluster.processes[0].kill()

    with Store(tmp_path / "a.sqlite", create=True) as store:
        with pytest.raises(EvlcpError, match="scheduler is gone; what was finished is kept") as told:
            collect(plan, store, DaskCluster(cluster.address), run_fake, watch)
        assert len(str(told.value).splitlines()) == 1
        assert len(store.results()) >= 40


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
