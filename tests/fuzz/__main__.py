"""Damage files of every kind for as long as wanted: python -m tests.fuzz [--minutes 5] [--seed N] [KIND ...]

What a reader does not refuse in lines, or takes too long or too much memory for, is kept in `fuzz-out/`, with
its traceback. At the end it says of every kind how many files were read, and how many refused.
"""

import argparse
import random
import resource
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

from tests.fuzz.corpus import kinds
from tests.fuzz.mutate import damage
from tests.fuzz.test_readers import is_refused, store_of

MAX_S, MAX_MB = 20, 500


def peak_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    args = parser.parse_args()
    rng, kept = random.Random(args.seed), Path("fuzz-out")
    read, bad, faults = Counter[str](), Counter[str](), 0
    print(f"seed {args.seed}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        chosen = [k for k in kinds(folder, store_of(folder)) if not args.kinds or k.name in args.kinds]
        end_s = time.monotonic() + 60 * args.minutes
        while time.monotonic() < end_s:
            kind = rng.choice(chosen)
            data, began_s = damage(kind.data, rng), time.monotonic()
            read[kind.name] += 1
            try:
                (folder / kind.name).mkdir(exist_ok=True)
                bad[kind.name] += is_refused(kind, data, folder / kind.name)
                assert time.monotonic() - began_s < MAX_S, "too long"
                assert peak_mb() < MAX_MB, "too much memory"
            except Exception:
                faults += 1
                kept.mkdir(exist_ok=True)
                (kept / f"{args.seed}-{faults}-{kind.file}").write_bytes(data)
                (kept / f"{args.seed}-{faults}.txt").write_text(traceback.format_exc())
    for kind in chosen:
        print(f"{kind.name:14} {read[kind.name]:7} files, {bad[kind.name]:7} refused")
    print(f"{peak_mb():.0f} MB at the most")
    sys.exit(f"{faults} faults: see {kept}/" if faults else 0)


if __name__ == "__main__":
    main()
