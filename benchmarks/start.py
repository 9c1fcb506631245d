"""Processor time before there is something to see: version, help, a warm and a cold `receive`; Linux.

    python benchmarks/start.py [--beside CHECKOUT] [--rounds 3]

Each command runs in a process of its own, and all its children count, orphans, too. Bytecode is kept, as that
of an installed package is; an interpreter that does nothing stands beside. Warm: the kernels are kept by an
earlier run. Cold: none are; tried once a checkout, as it takes long. Beside another checkout, both
run in turn, each by the interpreter of its own `.venv` if it has one, and the ratio of the least times is
printed.
"""

import argparse
import ctypes
import os
import resource
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
RECORDING = ROOT / "examples" / "recordings" / "night-50m-30kmh-cut.raw"
PR_SET_CHILD_SUBREAPER = 36


def spent_s(checkout: Path, cache: Path, *arguments: str) -> float:
    """Processor time of a command of a checkout and of all its children, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    code = "from evlcp_sdk.cli.main import main; main()" if arguments else "pass"
    environment = os.environ | {
        "PYTHONPATH": f"{checkout}:{checkout / 'plugins'}",
        "PYTHONDONTWRITEBYTECODE": "",
        "PYTHONPYCACHEPREFIX": str(cache / "bytecode"),
        "NUMBA_CACHE_DIR": str(cache),
    }
    silence = os.open(os.devnull, os.O_RDWR)
    own = checkout / ".venv" / "bin" / "python"
    command = [str(own) if own.exists() else sys.executable, "-P", "-c", code, *arguments]
    files = [(os.POSIX_SPAWN_DUP2, silence, 1), (os.POSIX_SPAWN_DUP2, silence, 2)]
    first = os.posix_spawn(command[0], command, environment, file_actions=files)
    os.close(silence)
    while True:
        try:
            child, status = os.wait()
        except ChildProcessError:
            break
        if child == first and status:
            sys.exit(f"{checkout}: {' '.join(arguments)} ends with {os.waitstatus_to_exitcode(status)}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description="Processor time of a start")
    parser.add_argument("--beside", type=Path, default=None)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    # Whoever compiles for a command that has ended is waited for, too.
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    checkouts = [ROOT] + ([options.beside.resolve()] if options.beside else [])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        receive = ("receive", str(RECORDING), "-o", str(folder / "out"))
        ways = {
            "receive, cold": receive,
            "receive": receive,
            "--version": ("--version",),
            "--help": ("--help",),
            "nothing": (),
        }
        for way, arguments in ways.items():
            least = [float("inf")] * len(checkouts)
            if not way.startswith("receive"):
                # Leaves its bytecode.
                for k, checkout in enumerate(checkouts):
                    spent_s(checkout, folder / str(k), *arguments)
            for _ in range(1 if way.endswith("cold") else options.rounds):
                for k, checkout in enumerate(checkouts):
                    least[k] = min(least[k], spent_s(checkout, folder / str(k), *arguments))
            beside = f"  beside {least[1]:.2f} s: {least[1] / least[0]:.2f} times" if options.beside else ""
            print(f"{way:<14} {least[0]:6.2f} s{beside}", flush=True)


if __name__ == "__main__":
    main()
