"""What a second core could be worth to one receiver: four bars at 60 m, by what the work is.

    python benchmarks/cores.py [--bars 4] [--seconds .4] [--paper] [--rounds 5]

The bars are simulated beside each other and received from memory on one core, by the default link. One
receiver works on one core; the table says what its time goes to, and what two could make of that at the most:

  every event   clock and rhythm: the whole stream, whoever asks
  selecting     the events of each region
  following     where each region is
  hearing       each region's preambles
  looking       each frame held still, its clusters found: sets its region right, and thus the next step
  reading       symbols, distance, points and filter of each frame: nothing of it steers regions
  the rest      order, echoes, packets, and the interpreter between

  regions apart, by steps    each core has half of the regions, does all of `every event` and `the rest`,
                             and waits for the other at each time step's end: a region's place shapes others
  regions apart, no waiting  the same, as if no region ever shaped another
  reading handed on          the second core reads what the first has looked at
  all but the rest halved    each piece of work above the rest takes half, however that were done
  both cores at once         two processes that each receive all: what this machine leaves of two (machine.py)

What is exchanged costs nothing in these, and selecting and following are halved though each core would have
to look at every event: no program gets there. Times are processor times, the least of the rounds; the last
row is by the wall clock and means something on an idle machine only.
"""

import argparse
import statistics
import time
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from machine import two_to_one
from road import Clock

from evlcp_sdk.clock import CameraClock
from evlcp_sdk.io import DEFAULT_MAX_EVENTS
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.rx import detection
from evlcp_sdk.rx.framing import PacketFraming
from evlcp_sdk.rx.listener import LinkListener
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.rx.rhythm import Rhythm
from evlcp_sdk.simulated import simulate
from evlcp_sdk.values import Events

PAPER = "ranging.id=poc", "decoding.id=wh-transform"
COMMON = "every event", "the rest"
EVEN = "selecting", "following"
OWN = "hearing", "looking", "reading"
PARTS: Mapping[str, tuple[tuple[Any, str], ...]] = {
    "every event": ((CameraClock, "take"), (Rhythm, "step")),
    "selecting": ((Rhythm, "select"), (detection, "select")),
    "following": tuple((detection.RegionFollower, name) for name in ("step", "_boxes", "_glance")),
    "hearing": ((PacketFraming, "_hear"),),
    "looking": ((PacketFraming, "_look"),),
    "reading": ((PacketFraming, "_decode"),),
}

Step = Counter[tuple[str, int]]
"""Seconds of a time step by (kind of work, number of the region or -1)."""


def measured(link: Link, events: Events) -> list[Step]:
    """What each time step of a receiver's time went to."""
    clock = Clock(PARTS, ("the rest", -1), _whose)
    steps: list[Step] = []
    step = LinkListener.step

    def counted(*given: Any) -> Any:
        found = step(*given)
        clock.turn()
        steps.append(clock.spent_s)
        clock.spent_s = Counter()
        return found

    with clock.running():
        LinkListener.step = counted  # type: ignore[method-assign]
        try:
            received(link, events)
        finally:
            LinkListener.step = step  # type: ignore[method-assign]
    return steps


def _whose(kind: str, given: tuple[Any, ...]) -> tuple[str, int]:
    """Of a region, where a call is given one."""
    region = getattr(given[1], "region", given[1]) if kind in OWN else None
    return kind, -1 if region is None else region.id


def bars_beside(many: int, seconds: float) -> Events:
    """The events of some bars 60 m ahead, 8 m from the first to the last."""
    across_m = np.linspace(-4, 4, many) if many > 1 else [-2.0]
    bars = [{"x_m": float(x), "y_m": -0.3, "seed": i + 1} for i, x in enumerate(across_m)]
    motion = {"distance_m": 60.0, "speed_mps": 10.0}
    scene = {"name": "beside", "duration_s": seconds, "motion": motion, "bars": bars}
    return Events.concat(list(simulate(scene, seed=1).chunks()))


def received(link: Link, events: Events) -> tuple[float, int]:
    """Processor time, s, to receive events; frames."""
    receiver, begin_s = Receiver(link), time.process_time()
    for first in range(0, len(events), DEFAULT_MAX_EVENTS):
        receiver.feed(events[first : first + DEFAULT_MAX_EVENTS])
    receiver.close()
    return time.process_time() - begin_s, receiver.counts["frames"]


def split_s(steps: list[Step]) -> tuple[float, float]:
    """What two cores need for measured steps with half of the regions each, s: waiting by steps, or not."""
    waits_s, common_s, own_s = 0.0, 0.0, np.zeros(2)
    for step in steps:
        shared_s = sum(s for (kind, _), s in step.items() if kind in COMMON)
        shared_s += sum(s for (kind, _), s in step.items() if kind in EVEN) / 2
        cores_s = np.zeros(2)
        for (kind, region), spent_s in step.items():
            if kind in OWN:
                cores_s[region % 2] += spent_s
        waits_s += shared_s + float(cores_s.max())
        common_s += shared_s
        own_s += cores_s
    return waits_s, common_s + float(own_s.max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--bars", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=0.4)
    parser.add_argument("--paper", action="store_true", help="the paper's ranging and decoding")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    link, events = load_link(overrides=PAPER if args.paper else ()), bars_beside(args.bars, args.seconds)
    long_s = int(events.t_us[-1] - events.t_us[0]) * 1e-6
    received(link, events)
    plain_s, frames = min(received(link, events) for _ in range(args.rounds))
    steps = min(
        (measured(link, events) for _ in range(args.rounds)),
        key=lambda steps: sum(step.total() for step in steps),
    )
    whole_s = sum(step.total() for step in steps)
    print(
        f"{args.bars} bars at 60 m, {len(events) / long_s / 1e6:.1f} Mev/s, {frames} frames:"
        f" one core {long_s / plain_s:.2f} x real time ({whole_s / plain_s:.2f} times as long while measured)"
    )
    for kind in ("every event", *EVEN, *OWN, "the rest"):
        spent_s = sum(s for step in steps for (of, _), s in step.items() if of == kind)
        print(f"  {kind:14} {spent_s / whole_s:6.1%}")
    waits_s, free_s = split_s(steps)
    reading_s, rest_s = (
        sum(s for step in steps for (of, _), s in step.items() if of == kind)
        for kind in ("reading", "the rest")
    )
    ideal = {
        "regions apart, by steps": waits_s,
        "regions apart, no waiting": free_s,
        "reading handed on": max(whole_s - reading_s, reading_s),
        "all but the rest halved": (whole_s + rest_s) / 2,
    }
    print("two cores to one, at the most:")
    for name, spent_s in ideal.items():
        ratio = whole_s / spent_s
        print(f"  {name:26} {ratio:5.2f}: {ratio * long_s / plain_s:.2f} x real time")
    at_once = statistics.median(two_to_one(lambda: received(link, events), args.rounds))
    print(f"  {'both cores at once':26} {at_once:5.2f}")


if __name__ == "__main__":
    main()
