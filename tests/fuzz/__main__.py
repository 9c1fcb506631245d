"""Damage files of every kind for as long as wanted: python -m tests.fuzz [--minutes 5] [--seed N] [KIND ...]

What a reader does not refuse in lines is kept in `fuzz-out/`, with its traceback. At the end it says for
every kind how many files were read and refused, and in how many different words: what was reached of its
checks.
"""

import argparse
import random
import re
import resource
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

from evlcp_sdk.errors import EvlcpError
from tests.fuzz.corpus import kinds
from tests.fuzz.mutate import damaged
from tests.fuzz.test_readers import store_of

MOST_S, MOST_MB = 20, 500


def _words(message: str) -> str:
    """A message without its places and values."""
    return " ".join(re.findall(r"\b[a-z]{3,}\b", re.sub(r"'[^']*'|\S*[/\d]\S*", "", message)))


def _expect_little(spent_s: float) -> None:
    """Raise where a file took too long, or this process has ever been too large."""
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if spent_s > MOST_S or peak_mb > MOST_MB:
        raise RuntimeError(
            f"{spent_s:.1f} s, {peak_mb:.0f} MB, expected {MOST_S} s, {MOST_MB} MB at the most"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    args = parser.parse_args()
    rng, kept = random.Random(args.seed), Path("fuzz-out")
    read, refused, faults = Counter[str](), Counter[str](), 0
    words: dict[str, set[str]] = {}
    print(f"seed {args.seed}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        chosen = [k for k in kinds(folder, store_of(folder)) if not args.kinds or k.name in args.kinds]
        end_s = time.monotonic() + 60 * args.minutes
        while time.monotonic() < end_s:
            kind = rng.choice(chosen)
            path, data = folder / kind.name / kind.file, damaged(kind.data, rng)
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(data)
            read[kind.name] += 1
            began_s = time.monotonic()
            try:
                kind.read(path)
                _expect_little(time.monotonic() - began_s)
            except EvlcpError as fault:
                refused[kind.name] += 1
                words.setdefault(kind.name, set()).add(_words(str(fault)))
            except Exception:
                faults += 1
                kept.mkdir(exist_ok=True)
                (kept / f"{args.seed}-{faults}-{kind.file}").write_bytes(data)
                (kept / f"{args.seed}-{faults}.txt").write_text(traceback.format_exc())
    for kind in chosen:
        print(f"{kind.name:14} {read[kind.name]:7} files, {refused[kind.name]:7} refused,", end=" ")
        print(f"in {len(words.get(kind.name, ()))} different words")
    print(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB at the most")
    sys.exit(f"{faults} faults: see {kept}/" if faults else 0)


if __name__ == "__main__":
    main()
