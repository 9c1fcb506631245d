"""How sure soft bits are, and how often they are right: simulated drives with bursts of errors.

    python benchmarks/llr.py [--seeds N]

Prints for each decoder, by the size of the log-likelihood ratio, how many bits there were, the share that
was wrong, and the LLR that this share stands for, beside the square root of the size, which
`messages.llr_power` = 0.5 makes of it.
"""

import argparse
import math
from itertools import pairwise
from typing import Any

import numpy as np

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.sim import load_scene, simulate, truth_of
from evlcp_sdk.values import Frame

SCENES = (
    ("drive-30kmh", 45.0),
    ("drive-30kmh", 95.0),
    ("drive-40kmh", 85.0),
    ("tunnel", 120.0),
    ("sun", 60.0),
)
# The sensor of examples/campaigns/paper.toml, shaken twice as much: bits must be wrong to be counted.
HARD = {
    "duration_s": 0.3,
    "motion.vib_rate_rad_s": 0.12,
    "sensor.refr_us": 100.0,
    "sensor.p_off_miss": 0.5,
    "sensor.p_on_miss": 0.2,
    "lens.halo": 0.03,
}
EDGES = (0, 1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 80, math.inf)
MATCH_US = 800.0


def bits_of(frames: list[Frame], known: dict[str, Any], m: int) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of the LLRs of all bits whose frame was sent, and which bits are wrong."""
    bar, t0_us = known["bars"][0], known["scene"]["t0_us"]
    rate_hz = 1e4 * (1 + bar["ppm"] * 1e-6)
    starts, sent = [], []
    for p, packet in enumerate(bar["symbols"]):
        for f, symbols in enumerate(packet):
            chip = p * bar["packet_chips"] + 26 + 32 * f
            starts.append((chip - bar["start_chip"]) / rate_hz * 1e6 + t0_us)
            sent.append(symbols)
    sizes, wrong = [], []
    for frame in frames:
        nearest = int(np.argmin(np.abs(np.array(starts) - frame.t_us)))
        if abs(starts[nearest] - frame.t_us) < MATCH_US:
            bits = (np.array(sent[nearest])[:, None] >> np.arange(m - 1, -1, -1)) & 1
            sizes.append(np.abs(frame.soft.llr).ravel())
            wrong.append(((frame.soft.llr < 0) != bits).ravel())
    return np.concatenate(sizes), np.concatenate(wrong)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=2)
    seeds = parser.parse_args().seeds
    decoders = ("wh-transform", "ml-soft", "motion-feedback")
    links = [load_link(overrides=[f"decoding.id={d}", "messages.decode=false"]) for d in decoders]
    found: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in links]
    for preset, distance_m in SCENES:
        for seed in range(seeds):
            scene = load_scene(preset, HARD | {"motion.distance_m": distance_m})
            known = truth_of(scene, seed).to_table()
            receivers = [Receiver(link) for link in links]
            frames: list[list[Frame]] = [[] for _ in links]
            for events in simulate(scene, seed):
                for receiver, mine in zip(receivers, frames, strict=True):
                    mine += [f for p in receiver.feed(events) for f in p.frames]
            for receiver, mine, bits in zip(receivers, frames, found, strict=True):
                mine += [f for p in receiver.close() for f in p.frames]
                bits.append(bits_of(mine, known, links[0].codebook.bits_per_symbol))
    for decoder, bits in zip(decoders, found, strict=True):
        size = np.concatenate([s for s, _ in bits])
        wrong = np.concatenate([w for _, w in bits])
        print(f"{decoder}: {size.size} bits, {wrong.mean():.4f} wrong")
        print("     LLR             bits     wrong   worth   square root")
        for low, high in pairwise(EDGES):
            here = (size >= low) & (size < high)
            if not here.any():
                continue
            share = wrong[here].mean()
            worth = f"{math.log((1 - share) / share):6.2f}" if share else "     -"
            root = np.sqrt(size[here]).mean()
            print(f"{low:5g} to {high:<5g}  {here.sum():9}  {share:8.5f}  {worth}  {root:6.2f}")


if __name__ == "__main__":
    main()
