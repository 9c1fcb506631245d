"""Runs a command again and again, in forks, each with a fault of the disk: for `test_fault_injection.py`."""

import ctypes
import gc
import io
import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import typer
from matplotlib.figure import Figure

import evlcp_sdk.report.figures
import evlcp_sdk.run
import evlcp_sdk.study.task as task
from evlcp_sdk.cli.main import main
from evlcp_sdk.errors import EvlcpError, InputError
from evlcp_sdk.files import STAGE_PREFIX, read_json
from evlcp_sdk.io.open import write_events
from evlcp_sdk.results.folder import check_result_file, read_summary
from evlcp_sdk.study.collect import collect_results
from evlcp_sdk.study.jobs import Inline
from evlcp_sdk.study.store import Store
from evlcp_sdk.values import Events, Packet
from tests.unit.study.fake import fake_plan, run_fake

HOW = ("fails", "dies", "stays full")
ALL = "EVLCP_ALL_FAULTS" in os.environ

SHIM = ctypes.CDLL(os.environ.get("LD_PRELOAD"))


@dataclass(frozen=True)
class Ended:
    """How a command ended: `code` is None where it was killed."""

    code: int | None
    err: str = ""
    calls: tuple[str, ...] = ()


def warm(*arguments):
    """Run a command in this process, so that forks have all imports."""
    sys.argv = ["evlcp", *arguments]
    with redirect_stdout(io.StringIO()), suppress(SystemExit):
        main()


def run(arguments, folder, at=-1, how="fails"):
    """Run a command in a fork; its call number `at` below the folder fails."""
    inlet, outlet = os.pipe()
    # A fork that looks through all that was there before copies it, page by page.
    gc.freeze()
    pid = os.fork()
    if not pid:
        code = 70
        try:
            sys.argv = ["evlcp", *arguments]
            sys.stdout, sys.stderr = io.StringIO(), io.StringIO()
            SHIM.faults_arm(os.fsencode(folder), ctypes.c_long(at), HOW.index(how))
            try:
                main()
            except SystemExit as end:
                code = end.code
            SHIM.faults_calls.restype = ctypes.c_char_p
            calls = SHIM.faults_calls().decode().split()
            os.write(outlet, json.dumps([code or 0, sys.stderr.getvalue(), calls]).encode())
        finally:
            os._exit(0)
    os.close(outlet)
    with os.fdopen(inlet, "rb") as file:
        reported = file.read()
    _, status = os.waitpid(pid, 0)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL:
        return Ended(None)
    code, err, calls = json.loads(reported)
    return Ended(code, err, tuple(calls))


def held(folder):
    """What a folder holds, by name, without what differs from run to run."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            continue
        found[path.name] = path.read_bytes()
        if path.name == "summary.json":
            table = json.loads(found[path.name])
            table.pop("processing", None)
            found[path.name] = json.dumps(table).encode()
    return found


def faults_of(calls, every=1):
    """How and where a call fails, in words: one in `every`, one way each in turn, or all in all ways."""
    faults = [(how, at) for at in range(len(calls)) for how in (HOW if ALL else (HOW[at % len(HOW)],))]
    for how, at in faults[:: 1 if ALL else every]:
        yield how, at, f"{how} at {at} ({calls[at]})"


def is_told(ended):
    """A command that could not write says so in one line, unless it was killed."""
    line = ended.err.count("\n") == 1 and ": cannot be written: " in ended.err
    return ended.code in (None, 0) or (ended.code == 1 and line)


@dataclass
class Trial:
    """A command over what an earlier one left.

    Attributes:
        old: Arguments of the earlier one, `OUT` for the folder.
        new: Those of the one that meets faults.
        seal: The file that is there only with all the others.
        check: Raises where the folder is not what a reader takes.
        stale: Files of still earlier runs.
        every: Of so many faults one is tried.
    """

    old: tuple[str, ...]
    new: tuple[str, ...]
    seal: str
    check: Callable[[Path], None] = lambda _: None
    stale: tuple[str, ...] = ()
    every: int = 1

    def faults(self, work):
        """What is wrong after each fault: a result that is not whole and true, nor flagged; and all calls."""
        before, out = work / "before", work / "out"
        before.mkdir()
        old, new = (tuple(a.replace("OUT", str(out)) for a in one) for one in (self.old, self.new))
        warm(*(a.replace("OUT", str(before)) for a in self.old))
        shutil.rmtree(before)
        out.mkdir()
        assert run(old, out).code == 0
        for name in self.stale:
            (out / name).write_text("of an earlier run")
        shutil.copytree(out, before)
        ended = run(new, out)
        assert ended.code == 0, ended
        whole, wrong = (held(before), held(out)), []
        for how, at, words in faults_of(ended.calls, self.every):
            shutil.rmtree(out)
            shutil.copytree(before, out)
            met = run(new, out, at, how)
            wrong += [f"{words}, {met}: {text}" for text in self._wrong(met, out, *whole)]
        return wrong, ended.calls

    def _wrong(self, ended, out, old, new):
        found = held(out)
        if ended.code == 0 and found != new:
            yield "says that it is done, and is not"
        if not is_told(ended):
            yield "expected one line and exit code 1"
        if ended.code and any(p.name.startswith(STAGE_PREFIX) for p in out.iterdir()):
            yield "leaves hidden files"
        if found in (old, new):
            try:
                self.check(out)
            except InputError as fault:
                yield f"a whole result is refused: {fault}"
        elif self.seal in found:
            try:
                read_json(out / self.seal)
            except InputError as fault:
                if "unfinished" in str(fault):
                    return
            yield f"torn: {sorted(found)}"


def check_result(folder):
    summary = read_summary(folder)
    for name in summary["files"]:
        check_result_file(folder, name, summary)


class StandIn:
    """A receiver that has decoded already."""

    packets: tuple[Packet, ...] = ()

    def __init__(self, *_):
        self.counts = {}
        self.lit_us = {}
        self.link_counts = {}

    def feed(self, _events):
        return []

    def close(self):
        return list(self.packets)


def receive(work, demo, *more):
    """Two recordings, one after the other, into one folder."""
    with evlcp_sdk.run.receive(demo) as packets:
        StandIn.packets = (next(packets),)
        StandIn.counts = packets.counts
    counts = packets.counts

    def stand_in(*_, **_more):
        made = StandIn()
        made.counts = counts
        if "two.raw" not in sys.argv[2]:
            made.packets = ()
        return made

    evlcp_sdk.run.Receiver = stand_in
    events = Events.of(np.arange(50, dtype=np.int64), *(np.zeros((3, 50), np.int64)))
    for name in ("one.raw", "two.raw"):
        write_events(work / name, events, 1280, 720)
    arguments = [("receive", str(work / name), "-o", "OUT", *more) for name in ("one.raw", "two.raw")]
    stale = () if "--parquet" in more else ("frames.parquet",)
    return Trial(*arguments, "summary.json", check_result, stale)


def sinks(work, demo):
    """The same with every format that one may ask for; pictures of one colour, drawn at once."""
    picture = Figure(figsize=(0.1, 0.1))
    for name in ("draw_regions", "draw_presence", "draw_plots"):
        setattr(evlcp_sdk.report.figures, name, lambda *_: picture)
    site = work / "site.toml"
    place = "latitude_deg = 35.0\nlongitude_deg = 137.0\nheight_m = 2.0\nheading_deg = 0.0\n"
    site.write_text(f"[[bar]]\ntransmitter_id = 0\n{place}")
    trial = receive(work, demo, "--parquet", "--mcap", "--figures", "--report", "--sites", str(site))
    trial.every = 4
    return trial


def simulate(_work, _demo):
    """A recording and its truth over another one's."""
    short = ("--set", "duration_s=0.001", "--set", "camera.width=200", "--set", "camera.height=100")
    arguments = [("simulate", "--preset", "night", "-o", "OUT/a.raw", *short, "--seed", n) for n in "12"]
    return Trial(*arguments, "a.truth.json")


def sweep(work):
    """A campaign that meets a fault is whole after the same command once more; what was kept is true."""
    plan = fake_plan(2, 1, 1)
    task.plan_campaign = lambda *_: plan
    task.run_job = run_fake
    out = work / "out"
    arguments = ("sweep", "campaign.toml", "-o", str(out / "r.sqlite"), "--workers", "0")

    def fresh(at=-1, how="fails"):
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        return run(arguments, out, at, how)

    def collected(path):
        with Store(path, create=True) as store:
            collect_results(plan, store, Inline(), run_fake)
            return store.read_results()

    def kept():
        try:
            with Store(out / "r.sqlite") as store:
                return store.read_results()
        except InputError:
            return {}  # nothing was kept yet, which is said

    whole = collected(work / "whole.sqlite")
    out.mkdir()
    warm(*arguments)
    calls = fresh().calls
    assert kept() == whole
    faults = []
    for how, at, words in faults_of(calls):
        ended = fresh(at, how)
        if not is_told(ended):
            faults.append(f"{words}, {ended}: expected one line and exit code 1")
        if not kept().items() <= whole.items() or (ended.code == 0 and kept() != whole):
            faults.append(f"{words}, {ended}: what is kept is not true")
        try:
            again = collected(out / "r.sqlite")
        except EvlcpError as fault:
            again = fault
        if again != whole:
            faults.append(f"{words}, {ended}: the same command gives {again}")
    return faults, calls


def tell(name, work, demo):
    # Looked up once for all forks.
    typer.main.get_params_from_function = cache(typer.main.get_params_from_function)
    trials = {"receive": receive, "sinks": sinks, "simulate": simulate}
    faults, calls = sweep(work) if name == "sweep" else trials[name](work, demo).faults(work)
    print(json.dumps({"faults": faults, "calls": calls}))


if __name__ == "__main__":
    tell(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
