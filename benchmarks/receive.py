"""The whole receiver, from RAW file to frames.csv, ranging included: events a second, and real time.

    python benchmarks/receive.py [RECORDING ...] [--events 20000000]

Without names, all recordings of `../shared`. Each is received in turn by what `evlcp receive` calls, in
one process, one thread, kernels warm; times are processor times, and the best of the rounds counts. Then the
first is tiled in time to `--events` and received once, beside the plain decoding of the same file (0 leaves
it out). Memory is measured by `memory.py`.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from evt3_decode import tile

from evlcp_sdk.io import open_source, read_events
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.stopwatch import Stopwatch

SHARED = Path(__file__).parents[2] / "shared" / "recordings"
FIRST = "night-50m-30kmh.raw"


def link_of(path: Path) -> Link:
    """Return the configuration that fits a recording's name: its profile, if it says one."""
    profile = next((p for p in ("wh8", "raw8") if path.name.startswith(p)), "wh4x2")
    return load_link(overrides=[f"modulation.id={profile}"])


def receive(path: Path, folder: Path) -> dict[str, float]:
    """Receive a recording; return its times."""
    summary = receive_to_folder(path, folder, link_of(path))
    return summary["processing"] | {"events": summary["recording"]["counts"]["events"]}


def plain_decoding(path: Path) -> float:
    """Processor time, s, to read a file's events and drop them: the file's part of the receiver's time."""
    watch = Stopwatch()
    with open_source(path) as source, watch.running():
        for _ in source.chunks():
            pass
    return watch.processor_s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--events", type=int, default=20_000_000)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    recordings = args.recordings or sorted(SHARED.glob("*.raw"), key=lambda p: (p.name != FIRST, p.name))
    if not recordings:
        sys.exit("no recording named, and ../shared/recordings is not there")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        for path in recordings:
            receive(path, out)
            best = min((receive(path, out) for _ in range(args.rounds)), key=lambda r: r["processor_s"])
            print(
                f"{path.name:32} {best['events_per_s'] / 1e6:6.1f} Mev/s"
                f"  {best['times_real_time']:6.2f} x real time",
                flush=True,
            )
        big = Path(folder) / recordings[0].name
        if args.events:
            tile(read_events(recordings[0]), big, args.events)
            file_s = min(plain_decoding(big) for _ in range(2))
            result = receive(big, out)
            rate = result["events_per_s"] / 1e6
            print(
                f"{big.name} tiled to {result['events'] / 1e6:.0f} Mev: {rate:.1f} Mev/s,"
                f" {result['times_real_time']:.2f} x real time; decoding alone is"
                f" {file_s / result['processor_s']:.0%} of the time"
            )


if __name__ == "__main__":
    main()
