"""Real time: delays of a paced replay, and whether an hour of it, looped, keeps memory, delays and frames.

python benchmarks/live.py                               one minute, at the recording's pace
python benchmarks/live.py --for-s 3600                  an hour, its clock going on
python benchmarks/live.py --for-s 3600 --speed 4        the same in a quarter of the time
python benchmarks/live.py --recording REC.raw --waiting-ms 1000
"""

import argparse
import resource
import threading
from pathlib import Path

from evlcp_sdk.live import Budget, LiveStatus, Outlet
from evlcp_sdk.run import live

SHIPPED = Path(__file__).parents[1] / "examples" / "recordings" / "night-50m-30kmh-cut.raw"


def memory_mb() -> float:
    """Memory of this process in use, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def watch(outlet: Outlet, every_s: float) -> None:
    """Print how it goes, now and then."""
    mine = outlet.subscribe({"status"}, most=10_000)
    print(" elapsed s   memory MB   waits ms   frames   p50 ms   p99 ms   shed")
    next_s = 0.0
    while not mine.ended:
        for news in mine.take(timeout_s=1.0):
            status: LiveStatus = news.value
            if status.elapsed_s < next_s:
                continue
            next_s = status.elapsed_s + every_s
            total = status.delays["total"]
            p50, p99 = (f"{total[name] or 0:8.2f}" for name in ("p50_ms", "p99_ms"))
            print(
                f"{status.elapsed_s:10.0f} {memory_mb():11.0f} {status.waiting_ms:10.1f}"
                f" {status.counts.get('frames', 0):8d} {p50} {p99} {sum(status.shed.values()):6d}",
                flush=True,
            )


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--recording", type=Path, default=SHIPPED)
    options.add_argument("--for-s", type=float, default=60.0, help="of the recording's time")
    options.add_argument("--speed", type=float, default=1.0)
    options.add_argument("--waiting-ms", type=float, default=20.0, help="before something is shed")
    options.add_argument("--every-s", type=float, default=None, help="between two lines")
    given = options.parse_args()
    outlet = Outlet()
    every_s = given.every_s or max(given.for_s / given.speed / 20, 1.0)
    watcher = threading.Thread(target=watch, args=(outlet, every_s))
    watcher.start()
    url = f"replay:{given.recording}?loop=1&for_s={given.for_s:g}&speed={given.speed:g}"
    budget = Budget(waiting_ms=given.waiting_ms, most_ms=10 * given.waiting_ms)
    summary = live(url, outlet=outlet, budget=budget)
    watcher.join()
    for stage, tally in summary["live"]["delays"].items():
        print(f"{stage:8} p50 {tally['p50_ms']} ms, p99 {tally['p99_ms']} ms, max {tally['max_ms']} ms")
    print(f"shed {summary['live']['shed']}")
    counts = summary["counts"]
    print(f"{counts['frames']} frames, {counts['frames_rejected']} rejected, {counts['packets']} packets")
    print(f"{summary['processing']['times_real_time']} times real time")


if __name__ == "__main__":
    main()
