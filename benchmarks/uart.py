"""Bits of one LED by the framing `uart`: how many are wrong, by rate and distance.

    python benchmarks/uart.py [--rates 500 3125 10000] [--at 30 100] [--bits 10000] [--preset night]
        [--scene TABLE.KEY=VALUE ...] [--set TABLE.KEY=VALUE ...] [--seed 1]

One LED, 7 data bits, even parity, two stop bits, 100 characters a packet, is simulated in front of a camera
that shakes as on a car, and received by the link alone. Wrong bits are those of the characters that were
found in their place; a lost character counts half its bits as wrong in the rate. `1 - quality` is the mean of
what characters say of themselves: the share of wrong ones, where that is true.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import evlcp_sdk as evlcp
from evlcp_sdk.run import receive
from evlcp_sdk.sim import load_scene
from evlcp_sdk.sim.truth import read_truth
from evlcp_sdk.specs import parse_value
from evlcp_sdk.study.frames import row_of_frame
from evlcp_sdk.study.match import match

SETTINGS = [
    "bar.rows=1",
    "bar.columns=1",
    "bar.cluster_rows=1",
    "bar.cluster_columns=1",
    "air.frames_per_packet=100",
    "framing.id=uart",
    "framing.data_bits=7",
    "framing.parity=even",
    "framing.stop_bits=2",
]
HEAD = (
    "| bit/s | m | characters | lost | of nobody | wrong bits | bit error rate | wrong characters "
    "| 1 - quality | s CPU |"
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rates", type=float, nargs="+", default=[500.0, 3125.0, 10_000.0], metavar="BIT/S")
    parser.add_argument("--at", type=float, nargs="+", default=[30.0, 100.0], metavar="M")
    parser.add_argument("--bits", type=int, default=10_000, help="Bits on air, pauses included.")
    parser.add_argument("--preset", default="night")
    parser.add_argument("--scene", nargs="+", default=[], metavar="TABLE.KEY=VALUE", help="Of the scene.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--set", nargs="+", default=[], metavar="TABLE.KEY=VALUE", help="Of the link.")
    args = parser.parse_args()
    print(HEAD)
    print("|" + "---|" * (HEAD.count("|") - 1))
    for rate in args.rates:
        for distance_m in args.at:
            with tempfile.TemporaryDirectory() as folder:
                print(row(args, rate, distance_m, Path(folder)), flush=True)


def row(args: argparse.Namespace, rate: float, distance_m: float, folder: Path) -> str:
    """A line of the table."""
    sets = [*SETTINGS, f"air.chip_rate_hz={rate}", *args.set]
    link = evlcp.load_link(overrides=sets)
    settings: dict[str, Any] = {
        "duration_s": args.bits / rate,
        "motion.distance_m": distance_m,
        "motion.speed_mps": 0.0,
    } | {key: parse_value(value) for key, _, value in (text.partition("=") for text in args.scene)}
    path = folder / "uart.raw"
    evlcp.simulate(load_scene(args.preset, settings, link=link), args.seed).save(path)
    begun = time.process_time()
    with receive(path, [link]) as packets:
        heard = [frame for packet in packets for frame in packet.frames]
    spent = time.process_time() - begun
    found = match([row_of_frame(frame) for frame in heard], read_truth(path.with_suffix(".truth.json")))
    sent, pairs = found.bars[0].symbols[:, 0], found.pairs[0]
    wrong = [(frame.symbols[0] ^ int(sent[number])).bit_count() for frame, number in pairs]
    lost, bits = len(sent) - len(pairs), link.codebook.bits_per_symbol
    rate_of_errors = (sum(wrong) + lost * bits / 2) / (len(sent) * bits)
    doubt = 1 - np.mean([frame.soft.quality for frame in heard]) if heard else np.nan
    characters = sum(n > 0 for n in wrong) / max(len(pairs), 1)
    return (
        f"| {rate:g} | {distance_m:g} | {len(sent)} | {lost} | {found.unmatched} "
        f"| {sum(wrong)} of {len(pairs) * bits} | {rate_of_errors:.2g} | {characters:.2g} "
        f"| {doubt:.2g} | {spent:.0f} |"
    )


if __name__ == "__main__":
    main()
