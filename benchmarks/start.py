"""Processor time before there is something to see: version, help, the first event, `receive`; Linux.

    python benchmarks/start.py [--rounds 3] [--warm]

Each command runs in a process of its own, and all its children count, orphans, too. Bytecode is kept, as that
of an installed package is; an interpreter that does nothing stands beside. Warm: the kernels are kept by an
earlier run. Cold: none are; tried once, as it takes long; `--warm` leaves it out. The first event: a
recording that has no other, and its result. Printed are the least time and the median. Numba and NumPy
import what they find of coverage, cffi, PyYAML and charset-normalizer: without, a start takes .06 s less.
"""

import argparse
import ctypes
import os
import resource
import sys
import tempfile
from pathlib import Path
from statistics import median

from evlcp_sdk.io import write_events
from evlcp_sdk.values import Events

ROOT = Path(__file__).parents[1]
RECORDING = ROOT / "examples" / "recordings" / "night-50m-30kmh-cut.raw"
PR_SET_CHILD_SUBREAPER = 36


def spent_s(cache: Path, *arguments: str) -> float:
    """Processor time of a command and of all its children, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    code = "from evlcp_sdk.cli.main import main; main()" if arguments else "pass"
    environment = os.environ | {
        "PYTHONPATH": f"{ROOT}:{ROOT / 'plugins'}",
        "PYTHONDONTWRITEBYTECODE": "",
        "PYTHONPYCACHEPREFIX": str(cache / "bytecode"),
        "NUMBA_CACHE_DIR": str(cache),
    }
    silence = os.open(os.devnull, os.O_RDWR)
    command = [sys.executable, "-P", "-c", code, *arguments]
    files = [(os.POSIX_SPAWN_DUP2, silence, 1), (os.POSIX_SPAWN_DUP2, silence, 2)]
    first = os.posix_spawn(command[0], command, environment, file_actions=files)
    os.close(silence)
    while True:
        try:
            child, status = os.wait()
        except ChildProcessError:
            break
        if child == first and status:
            sys.exit(f"{' '.join(arguments)} ends with {os.waitstatus_to_exitcode(status)}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description="Processor time of a start")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--warm", action="store_true")
    options = parser.parse_args()
    # Whoever compiles for a command that has ended is waited for, too.
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_events(folder / "first.raw", Events.of([0], [640], [360], [1]), 1280, 720)
        receive = ("receive", str(RECORDING), "-o", str(folder / "out"))
        ways = {
            "receive, cold": receive,
            "receive": receive,
            "first event": ("receive", str(folder / "first.raw"), "-o", str(folder / "out")),
            "--version": ("--version",),
            "--help": ("--help",),
            "nothing": (),
        }
        for way, arguments in ways.items():
            cold = way.endswith("cold")
            if cold and options.warm:
                continue
            if not cold:
                # Leaves its bytecode, and kernels.
                spent_s(folder, *arguments)
            spent = [spent_s(folder, *arguments) for _ in range(1 if cold else options.rounds)]
            print(f"{way:<14}  least {min(spent):.3f} s  median {median(spent):.3f} s", flush=True)


if __name__ == "__main__":
    main()
