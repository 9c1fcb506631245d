"""How long after a frame's last chip its result comes: p50, p99 and maximum, in simulated time.

python benchmarks/latency.py                            one bar at 50 m and two at 60 and 75 m, of ../shared
python benchmarks/latency.py --recording REC.raw --slice-us 500

A busy machine cannot keep a pace, so nothing is paced. A slice of the recording arrives when its time on
the recording's clock is over, waits until the slices before it are done, and takes as much time as
`Receiver.feed` takes of the processor. The parts of a frame's delay:

  gather   from its last chip (by its own `t_us`) until the slice with its last events is there
  queue    until the slices before that are done
  compute  until the receiver gives the frame, inside of `feed`
  total    all three

`gather` is the floor: by how much events are late, half a chip that the receiver waits, and the rest of the
slice. Frames of the first 100 ms, whose events were kept until the first lock, are a row of their own. On a
busy machine the same work takes more of the processor's time, as caches are shared.
"""

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evlcp_sdk.io import read_events
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.values import Events, Frame

SHARED = Path(__file__).parents[2] / "shared" / "recordings"
NAMES = "night-50m-30kmh.raw", "two-bars-60m-75m.raw"
START_US = 100_000


@dataclass(frozen=True)
class Delay:
    """When a frame came: start of the frame on the recording's clock, us; its delays, ms."""

    t_us: float
    gather_ms: float
    queue_ms: float
    compute_ms: float


def delays_of(events: Events, link: Link, slice_us: int) -> tuple[list[Delay], float, float]:
    """Feed a recording slice by slice: each frame's delay; the longest `feed`, ms; and its time in all, s."""
    found: list[Delay] = []
    arrived_s = began_s = clock_s = free_s = longest_s = total_s = 0.0

    def record_delay(frame: Frame) -> None:
        computed_s = time.process_time() - clock_s
        packet = link.packet
        chips = packet.frame_chips if packet.has_pilot(frame.frame) else packet.info_chips
        last_s = (frame.t_us + chips * packet.chip_us) * 1e-6
        parts_s = arrived_s - last_s, began_s - arrived_s, computed_s
        found.append(Delay(frame.t_us, *(part_s * 1e3 for part_s in parts_s)))

    receiver = Receiver(link, on_frame=record_delay)
    ends_us = np.arange(int(events.t_us[0]) + slice_us, int(events.t_us[-1]), slice_us)
    begin = 0
    for end_us, end in zip(ends_us.tolist(), np.searchsorted(events.t_us, ends_us).tolist(), strict=True):
        arrived_s = end_us * 1e-6
        began_s = max(arrived_s, free_s)
        piece, begin = events[begin:end], end
        clock_s = time.process_time()
        receiver.feed(piece)
        took_s = time.process_time() - clock_s
        free_s = began_s + took_s
        longest_s, total_s = max(longest_s, took_s), total_s + took_s
    return found, longest_s * 1e3, total_s


def row_of(name: str, delays: list[Delay]) -> str:
    """Quantiles of some frames' delays, as a line."""
    parts = np.array([(d.gather_ms, d.queue_ms, d.compute_ms) for d in delays]).reshape(-1, 3)
    columns = [*parts.T, parts.sum(1)]
    cells = ["/".join(f"{v:.2f}" for v in np.quantile(c, (0.5, 0.99, 1.0))) for c in columns if len(c)]
    return f"  {name:12} {len(delays):5d}  " + "".join(f"{cell:>20}" for cell in cells)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--recording", type=Path, action="append")
    options.add_argument("--slice-us", type=int, default=1000)
    options.add_argument("--rounds", type=int, default=3)
    given = options.parse_args()
    link = load_link()
    for path in given.recording or [SHARED / name for name in NAMES]:
        if not path.exists():
            sys.exit(f"{path} is not there: name a recording")
        events = read_events(path)
        delays_of(events, link, given.slice_us)  # kernels are loaded by this
        rounds = [delays_of(events, link, given.slice_us) for _ in range(given.rounds)]
        delays = [delay for found, _, _ in rounds for delay in found]
        start_us = int(events.t_us[0]) + START_US
        long_s = int(events.t_us[-1] - events.t_us[0]) * 1e-6
        print(
            f"{path.name}: slices of {given.slice_us} us, the longest takes"
            f" {min(longest for _, longest, _ in rounds):.1f} ms;"
            f" {long_s / min(total for _, _, total in rounds):.2f} times real time"
        )
        print(
            f"  {'ms':12} {'frames':>6} "
            + "".join(f"{n:>20}" for n in ("gather", "queue", "compute", "total"))
        )
        print(row_of("after 100 ms", [d for d in delays if d.t_us >= start_us]))
        print(row_of("before", [d for d in delays if d.t_us < start_us]), flush=True)


if __name__ == "__main__":
    main()
