"""How the command line ends when it is not the command that decides: stdout, Ctrl-C, faults of ours."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import evlcp_sdk.io.describe

Evlcp = Callable[..., Any]
Shell = Callable[[str], subprocess.CompletedProcess[str]]
MAIN = "from evlcp_sdk.cli.main import main; main()"
EVLCP = f"{sys.executable} -c '{MAIN}'"
SAYS_WHEN_READY = """
import sys
from evlcp_sdk.cli.main import main

class Ready:
    def find_spec(self, name, *_):
        # What main imports first, once it can be interrupted.
        if name == "evlcp_sdk.signals":
            sys.stderr.write("ready")
            sys.stderr.flush()

sys.meta_path.insert(0, Ready())
main()
"""


@pytest.fixture(params=["buffered", "unbuffered"])
def shell(request: pytest.FixtureRequest) -> Shell:
    """Run a command line, whose output is kept until it ends, as a login has it, or is written at once."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    own |= {"PYTHONUNBUFFERED": "1"} if request.param == "unbuffered" else {}
    return lambda line: subprocess.run(
        ["bash", "-c", line], env=own, capture_output=True, text=True, check=False
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("arguments", ["plugins", "--version", "receive {demo} --json-lines -"])
def test_a_full_stdout_is_one_line(arguments: str, demo_raw: Path, shell: Shell) -> None:
    done = shell(f"{EVLCP} {arguments.format(demo=demo_raw)} > /dev/full")
    assert done.stderr == "evlcp: standard output: No space left on device\n"
    assert done.returncode == 1
    done = shell(f"{EVLCP} {arguments.format(demo=demo_raw)} >&-")
    assert (done.returncode, done.stderr.splitlines()[-1]) == (1, "evlcp: standard output: it is closed")


def test_a_recording_on_stdout_is_nothing_else(demo_raw: Path, shell: Shell) -> None:
    done = shell(f"{EVLCP} convert {demo_raw} -o /dev/stdout --format EVT3 | {EVLCP} info - --json")
    assert done.stderr == "evlcp: /dev/stdout: 764,142 events, 0 triggers\n"
    assert json.loads(done.stdout)["losses"] == {}


def test_a_reader_who_leaves_is_no_fault(shell: Shell) -> None:
    done = shell(f"{EVLCP} plugins --json | true; exit ${{PIPESTATUS[0]}}")
    assert done.stderr == ""
    assert done.returncode in (0, 1)


def test_a_reader_of_lines_who_leaves_ends_the_run(demo_raw: Path, shell: Shell) -> None:
    """What comes in by a pipe goes out by another, whose reader takes one line."""
    done = shell(f"cat {demo_raw} | {EVLCP} receive - --json-lines - | head -n 1; exit ${{PIPESTATUS[1]}}")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["line"] == "frame"


def test_ctrl_c_during_imports_is_one_line(demo_raw: Path) -> None:
    for pause_s in (0.01, 0.03, 0.06, 0.1):
        process = subprocess.Popen(
            [sys.executable, "-c", SAYS_WHEN_READY, "info", demo_raw],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stderr is not None
        assert process.stderr.read(5) == "ready"
        time.sleep(pause_s)
        process.send_signal(signal.SIGINT)
        reported = process.stderr.read()
        process.stderr.close()
        assert reported == "evlcp: interrupted\n"
        assert process.wait() == 130


@pytest.mark.parametrize(
    ("fault", "code", "message"),
    [
        (
            KeyError("no\nsuch key"),
            70,
            "evlcp: a fault of evlcp itself, not of what you gave: KeyError: |; please report the command|"
            "evlcp-sdk |cli/info.py:|test_ends.py:",
        ),
        (MemoryError("Unable to allocate 1 GiB"), 1, "evlcp: not enough memory: Unable to allocate 1 GiB\n"),
    ],
)
def test_a_fault_of_ours_says_what_to_report_and_too_little_memory_is_none(
    evlcp: Evlcp, monkeypatch: pytest.MonkeyPatch, demo_raw: Path, fault: Exception, code: int, message: str
) -> None:
    def broken(*_: object) -> None:
        raise fault

    monkeypatch.setattr(evlcp_sdk.io.describe, "describe_source", broken)
    done = evlcp("info", demo_raw)
    first, *parts = message.split("|")
    assert done.code == code
    assert done.err.startswith(first)
    assert all(part in done.err for part in parts)
    assert done.err.count("\n") == 1


def test_the_entry_point_can_be_interrupted_from_the_start() -> None:
    """What it imports before it can catch an interrupt is next to nothing."""
    code = "import sys; import evlcp_sdk.cli.main; print(*sys.modules)"
    reported = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert {name.removeprefix("evlcp_sdk") for name in reported.split() if name.startswith("evlcp")} == {
        *("", ".cli", ".cli.main", ".cli._stderr", ".formatting")
    }
    assert not {"typer", "rich", "typing", "pathlib", "logging"} & set(reported.split())


def test_without_a_home_libraries_say_nothing() -> None:
    code = f"import sys; sys.argv = ['evlcp', '--help']\ntry: {MAIN}\nexcept SystemExit: pass\n"
    code += "import matplotlib; matplotlib.get_cachedir()"
    nowhere = dict.fromkeys(("HOME", "MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"), "/dev/null/none")
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ | nowhere
    )
    assert done.stderr == ""
