"""Real time: delays of a paced replay, and whether an hour of it, looped, keeps memory, delays and frames.

python benchmarks/live.py                               one minute, at the recording's pace
python benchmarks/live.py --for-s 3600 --every-s 60     an hour, its clock going on; a line a minute
python benchmarks/live.py --for-s 3600 --speed 4        the same in a quarter of the time
python benchmarks/live.py --recording REC.raw --waiting-ms 1000
python benchmarks/live.py --out FOLDER                  writes a result, too

A line has the memory in use and at its most, and the delays of the frames since the line before. The last
frames of a pass wait for the dark time behind it. Where nothing was lost, each pass of the loop has all
frames, by their symbols, that the recording has by itself; the command ends with 1 where it has not.
"""

import argparse
import math
import resource
import sys
import threading
import time
from collections import Counter
from pathlib import Path

from evlcp_sdk.io.replay import SEAM_US
from evlcp_sdk.live import Budget, DelayTally, LiveStatus, Outlet
from evlcp_sdk.run import live, receive
from evlcp_sdk.values import Frame

SHIPPED = Path(__file__).parents[1] / "examples" / "recordings" / "night-50m-30kmh-cut.raw"


def memory_mb() -> float:
    """Memory of this process in use, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


class Passes:
    """Frames of each pass of a loop, by their symbols, beside those of the recording by itself.

    Attributes:
        begun: Passes of which there was a frame.
        missing: Frames of the recording that a pass had not.
        more: Frames of a pass that the recording by itself has not: where its end cuts one.
    """

    def __init__(self, recording: Path) -> None:
        with receive(recording) as reception:
            self.alone = Counter(map(_key, reception.frames()))
        self.begun = self.missing = self.more = 0
        self._seen: Counter[bytes] = Counter()
        self._last_us = -math.inf

    def add(self, frame: Frame) -> None:
        """Take a frame; the dark time between two passes is longer than any other without frames."""
        if frame.t_us > self._last_us + 0.8 * SEAM_US:
            self.end()
            self.begun += 1
        self._last_us = max(self._last_us, frame.t_us)
        self._seen[_key(frame)] += 1

    def end(self) -> None:
        """End a pass."""
        if self.begun:
            self.missing += (self.alone - self._seen).total()
            self.more += (self._seen - self.alone).total()
        self._seen.clear()


def _key(frame: Frame) -> bytes:
    return frame.soft.symbols.tobytes()


def watch(outlet: Outlet, every_s: float, passes: Passes) -> None:
    """Print how it goes, now and then."""
    mine = outlet.subscribe({"frame", "status"}, most=100_000)
    columns = ("elapsed s", "memory MB", "most MB", "waits ms", "frames", "p50 ms", "p90 ms", "p99 ms")
    print(" ".join(f"{name:>9}" for name in (*columns, "max ms", "shed", "lost", "missing")))
    next_s, tally, frames, most_mb = every_s, DelayTally(), 0, 0.0
    while not mine.ended:
        for news in mine.take(timeout_s=1.0):
            if news.kind == "frame":
                frames += 1
                passes.add(news.value)
                if news.late_ms is not None:
                    tally.add(news.late_ms)
                continue
            status: LiveStatus = news.value
            most_mb = max(most_mb, memory_mb())
            if status.elapsed_s < next_s:
                continue
            next_s += every_s
            lost = mine.dropped + sum(loss.count for loss in status.losses.values())
            delays_ms = [*(tally.quantile_ms(share) for share in (0.5, 0.9, 0.99)), tally.max_ms]
            row = [f"{one:9.1f}" for one in (memory_mb(), most_mb, status.waiting_ms)] + [f"{frames:9d}"]
            row += [f"{one:9.2f}" for one in delays_ms]
            row += [f"{many:9d}" for many in (sum(status.shed.values()), lost, passes.missing)]
            print(f"{status.elapsed_s:9.0f}", *row, flush=True)
            tally, most_mb = DelayTally(), 0.0
    passes.end()


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--recording", type=Path, default=SHIPPED)
    options.add_argument("--for-s", type=float, default=60.0, help="of the recording's time")
    options.add_argument("--speed", type=float, default=1.0)
    options.add_argument("--waiting-ms", type=float, default=20.0, help="before something is shed")
    options.add_argument("--every-s", type=float, default=None, help="between two lines")
    options.add_argument("--out", type=Path, default=None, help="a folder for a result")
    given = options.parse_args()
    passes = Passes(given.recording)
    outlet = Outlet()
    every_s = given.every_s or max(given.for_s / given.speed / 20, 1.0)
    watcher = threading.Thread(target=watch, args=(outlet, every_s, passes))
    watcher.start()
    url = f"replay:{given.recording}?loop=1&for_s={given.for_s:g}&speed={given.speed:g}"
    budget = Budget(waiting_ms=given.waiting_ms, most_ms=10 * given.waiting_ms)
    began_s = time.monotonic()
    summary = live(url, given.out, outlet=outlet, budget=budget)
    watcher.join()
    print(f"{time.monotonic() - began_s:.0f} s, {summary['processing']['processor_s']:.0f} s of a processor")
    for stage, tally in summary["live"]["delays"].items():
        print(f"{stage:8} p50 {tally['p50_ms']} ms, p99 {tally['p99_ms']} ms, max {tally['max_ms']} ms")
    print(f"shed {summary['live']['shed']}")
    counts = summary["counts"]
    print(f"{counts['frames']} frames, {counts['frames_rejected']} rejected, {counts['packets']} packets")
    each = passes.alone.total()
    print(f"{passes.begun} passes of {each} frames: {passes.missing} missing, {passes.more} more")
    print(f"{summary['processing']['times_real_time']} times real time")
    sys.exit(passes.missing > 0)


if __name__ == "__main__":
    main()
