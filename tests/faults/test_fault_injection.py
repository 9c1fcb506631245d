"""Each write, rename and fsync fails once, or is died in: results are whole and true, or flagged.

`EVLCP_ALL_FAULTS=1` tries every fault at every call, which takes minutes.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent

needs_compiler = pytest.mark.skipif(
    not sys.platform.startswith("linux") or shutil.which("cc") is None, reason="needs Linux and a C compiler"
)


@pytest.fixture(scope="module")
def shim(tmp_path_factory):
    path = tmp_path_factory.mktemp("shim") / "shim.so"
    command = ["cc", "-O1", "-Wall", "-Werror", "-shared", "-fPIC", "-o", path, HERE / "shim.c", "-ldl"]
    subprocess.run(command, check=True)
    return path


@needs_compiler
@pytest.mark.parametrize("command", ["receive", "sinks", "simulate", "sweep"])
def test_a_disk_that_fails_once(command, shim, tmp_path, demo_raw):
    if command == "sinks":
        pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
        pytest.importorskip("mcap", reason="the extra mcap is not installed")
    done = subprocess.run(
        [sys.executable, "-m", "tests.faults.commands", command, tmp_path, demo_raw],
        cwd=HERE.parents[1],
        env=os.environ | {"LD_PRELOAD": str(shim)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["faults"] == []
    assert {"write", "fsync", "unlink" if command == "sweep" else "rename"} <= set(result["calls"])
    assert len(result["calls"]) > 10
