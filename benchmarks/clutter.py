"""What noise and lamps in view cost the receiver, as ratios of its processor time without them.

    python benchmarks/clutter.py [RECORDING] [--rounds 5]

To a recording, `../shared/recordings/night-50m-30kmh.raw` without a name, are added: 10 million events a
second all over the image; eight lamps of 12 x 12 px that blink with a period of two chips; and such lamps at
the chip rate with nothing to say, each chip a coin toss. The stream is received from memory, scenes in turn,
and the best of the rounds counts. Regions are those beyond the recording's own.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from evlcp_sdk.io import read_events
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.values import Events

SHARED = Path(__file__).parents[2] / "shared" / "recordings"
PIECE = 1 << 16
LAMPS, SIDE_PX, CHIP_US = 8, 12, 100
NOISE_PER_S = 10_000_000


def merged(one: Events, other: Events) -> Events:
    """The events of both, in order."""
    both = Events.concat([one, other])
    return both[np.argsort(both.t_us, kind="stable")]


def noise(like: Events, rng: np.random.Generator) -> Events:
    """Events all over the image, for as long as others."""
    first, last = int(like.t_us[0]), int(like.t_us[-1])
    n = round((last - first) * 1e-6 * NOISE_PER_S)
    t_us = np.sort(rng.integers(first, last + 1, n))
    return Events.of(t_us, rng.integers(0, 1280, n), rng.integers(0, 720, n), rng.integers(0, 2, n))


def lamps(like: Events, rng: np.random.Generator, *, steady: bool) -> Events:
    """Lamps in the upper part of the image that blink by a period of two chips, or by coin tosses."""
    first, last = int(like.t_us[0]), int(like.t_us[-1])
    chips = (last - first) // CHIP_US
    v, u = np.indices((SIDE_PX, SIDE_PX)).reshape(2, -1)
    parts = []
    for k in range(LAMPS):
        light = np.arange(chips) % 2 if steady else rng.integers(0, 2, chips)
        edges = np.flatnonzero(np.diff(light)) + 1
        t_us = first + edges[:, None] * CHIP_US + rng.integers(0, 25, (len(edges), u.size))
        shape = t_us.shape
        parts.append(
            Events.of(
                t_us.ravel(),
                np.broadcast_to(100 + 140 * k + u, shape).ravel(),
                np.broadcast_to(40 + v, shape).ravel(),
                np.broadcast_to(light[edges][:, None], shape).ravel(),
            )
        )
    every = Events.concat(parts)
    every = every[np.argsort(every.t_us, kind="stable")]
    return every[every.t_us <= last]


def received_s(link: Link, events: Events) -> tuple[float, dict[str, int]]:
    """Processor time, s, to receive events, and what was counted."""
    receiver, begin_s = Receiver(link), time.process_time()
    for first in range(0, len(events), PIECE):
        receiver.feed(events[first : first + PIECE])
    receiver.close()
    return time.process_time() - begin_s, receiver.counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recording", nargs="?", type=Path, default=SHARED / "night-50m-30kmh.raw")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    link, rng = load_link(), np.random.default_rng(0)
    plain = read_events(args.recording)
    scenes = {
        "as it is": plain,
        "10 Mev/s of noise": merged(plain, noise(plain, rng)),
        "8 lamps, steady": merged(plain, lamps(plain, rng, steady=True)),
        "8 lamps, random chips": merged(plain, lamps(plain, rng, steady=False)),
    }
    best: dict[str, tuple[float, dict[str, int]]] = {}
    for _ in range(args.rounds + 1):
        for name, events in scenes.items():
            found = received_s(link, events)
            best[name] = min(best.get(name, found), found, key=lambda one: one[0])
    spent_s, own = best["as it is"]
    for name, (time_s, counts) in best.items():
        print(
            f"{name:24} {time_s:6.3f} s, {time_s / spent_s:5.2f} times;"
            f" {counts['regions_opened'] - own['regions_opened']:+d} regions, {counts['frames']} frames"
        )


if __name__ == "__main__":
    main()
