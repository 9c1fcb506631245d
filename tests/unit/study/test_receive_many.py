"""`evlcp receive` over many recordings runs on the executors of campaigns."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.unit.test_signals import start

Evlcp = Callable[..., Any]


def test_processes_give_what_this_one_gives(evlcp: Evlcp, demo_raw: Path, tmp_path: Path) -> None:
    two = [Path(shutil.copy(demo_raw, tmp_path / f"{name}.raw")) for name in "ab"]
    (tmp_path / "bad.raw").write_bytes(b"\x89PNG" + bytes(60))
    done = evlcp("receive", *two, tmp_path / "bad.raw", "-o", tmp_path / "out", "--workers", "2", "--json")
    assert done.code == 3
    assert done.err.startswith(f"evlcp: {tmp_path}/bad.raw: ")
    assert len(done.err.splitlines()) == 1
    told = [json.loads(line) for line in done.out.splitlines()]
    assert sorted(t["status"] for t in told) == ["complete"] * 2 + ["failed"]
    assert evlcp("receive", demo_raw, "-o", tmp_path / "one").code == 0
    expected = (tmp_path / "one" / "frames.csv").read_bytes()
    for path in two:
        assert (tmp_path / "out" / path.stem / "frames.csv").read_bytes() == expected


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
@pytest.mark.parametrize(("number", "tell"), [(signal.SIGINT, os.killpg), (signal.SIGTERM, os.kill)])
def test_ctrl_c_and_its_like_end_all_of_them(
    demo_raw: Path, tmp_path: Path, number: int, tell: Callable[[int, int], None]
) -> None:
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


def test_a_program_that_leaves_its_processes_ends() -> None:
    """When the jobs under way are done; nobody closes the outcomes."""
    code = """import time
from evlcp_sdk.study.jobs import Processes
if __name__ == "__main__":
    outcomes = Processes(2).run(time.sleep, [0.01, 1, 1])
    next(outcomes)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30)
