"""Messages lost, and messages read wrong.

    python benchmarks/messages.py noise [--packets 100000] [--seed 0]
    python benchmarks/messages.py recordings FOLDER [--packets 50]

`noise` sends random blocks through noise of every strength on the soft bits, whole, with lost frames or a
dark cluster, and twice with the soft bits added, and noise alone; it counts what is read and what is read
wrong.
`recordings` renders the scene of each `*.truth.json` of a folder again, with a message of random data in each
packet instead of its symbols.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import norm

from evlcp_sdk.air.blocks import HEADER_BYTES, Block, BlockError, Kind
from evlcp_sdk.link.blocks import BlockCoder
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.sim import scene_of_truth, simulate, truth_of
from evlcp_sdk.sim.scene import links_of
from evlcp_sdk.study.measure import message_tallies
from evlcp_sdk.study.tally import Tally

DARK_W_M2 = 1e-6
BERS = (0.01, 0.03, 0.05, 0.07, 0.09, 0.11, 0.13, 0.16, 0.2, 0.25, 0.3, 0.4)


def channels(coder: BlockCoder, frames: int) -> Iterator[tuple[str, float, np.ndarray, int]]:
    """Name, bit error rate of what arrives, which bits do, bool (frames, clusters, bits), and how often."""
    book = coder.codebook
    shape = (frames, book.clusters, book.bits_per_symbol)
    whole = np.ones(shape, bool)
    dark, lost = whole.copy(), whole.copy()
    dark[:, 5] = False
    lost[3:6] = False
    for ber in BERS:
        yield "whole", ber, whole, 1
        yield "one cluster dark", ber, dark, 1
        yield "three frames lost", ber, lost, 1
        yield "two packets added", ber, whole, 2


def read(coder: BlockCoder, llr: np.ndarray) -> tuple[bytes | None, bool]:
    """The bytes that pass the code's check, and whether they are a block of this codebook."""
    content = coder.block(llr.ravel().astype(np.float32))
    if content is None:
        return None, False
    try:
        return content, Block.unpack(content).codebook == coder.digest
    except BlockError:
        return content, False


def noise(packets: int, seed: int) -> None:
    link = load_link()
    coder, rng = link.block_coder(), np.random.default_rng(seed)
    cases = list(channels(coder, link.packet.frames))
    each = -(-packets // (len(cases) + 1))
    wrong_words = wrong_blocks = 0
    print(f"{each} packets a line        BER  soft bits     read    wrong")
    for name, ber, heard, times in cases:
        sigma, good, wrong = 1 / norm.isf(ber), 0, 0
        for _ in range(each):
            part = rng.bytes(coder.block_bytes - HEADER_BYTES)
            sent = Block(Kind.DATA, 7, int(rng.integers(2**32)), 0, len(part), coder.digest, part)
            content = sent.pack(coder.block_bytes)
            value = times * (1 - 2.0 * coder.air_bits(content))
            value += rng.normal(0, sigma * np.sqrt(times), coder.bits)
            got, is_block = read(coder, (2 * value / sigma**2).reshape(heard.shape) * heard)
            good += got == content
            wrong_words += got is not None and got != content
            wrong += is_block and got != content
        wrong_blocks += wrong
        print(f"{name:20} {ber:13.2f} {heard.mean():9.0%} {good / each:9.4f} {wrong:7}", flush=True)
    passed = 0
    for _ in range(each):
        got, is_block = read(coder, rng.normal(0, 3, coder.bits))
        wrong_words += got is not None
        passed += is_block
    wrong_blocks += passed
    print(f"{'noise alone':20} {'':13} {1:9.0%} {'-':>9} {passed:7}")
    total = each * (len(cases) + 1)
    print(f"{wrong_blocks} of {total} packets read wrong; {wrong_words} passed the code's own check alone")


def recordings(folder: Path, packets: int) -> None:
    for path in sorted(folder.glob("*.truth.json")):
        scene = scene_of_truth(json.loads(path.read_text()))
        bars = [b for b in scene.bars if b.led_w_m2 is None or b.led_w_m2 > DARK_W_M2]
        if not bars:
            continue
        bars = [replace(b, symbols=None, payload="data", start_chip=None) for b in bars]
        scene = replace(scene, bars=tuple(bars))
        link = links_of(scene)[0]
        coder, total, seed, began = link.block_coder(), Tally(), 0, time.perf_counter()
        while total.messages_sent < packets:
            truth, receiver = truth_of(scene, seed), Receiver(link)
            found = [p for events in simulate(scene, seed) for p in receiver.feed(events)] + receiver.close()
            total += Tally.together(tally for _, tally in message_tallies(found, truth, coder))
            seed += 1
        name = path.name.removesuffix(".truth.json")
        lost = total.messages_sent - total.messages_found
        took = f"{seed} scenes, {time.perf_counter() - began:.0f} s"
        print(
            f"{name:28} {lost} of {total.messages_sent} lost, {total.messages_wrong} wrong ({took})",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("noise")
    one.add_argument("--packets", type=int, default=100_000)
    one.add_argument("--seed", type=int, default=0)
    two = commands.add_parser("recordings")
    two.add_argument("folder", type=Path)
    two.add_argument("--packets", type=int, default=50, help="at least, of each recording")
    given = parser.parse_args()
    if given.command == "noise":
        noise(given.packets, given.seed)
    elif not given.folder.is_dir():
        sys.exit(f"{given.folder}: no folder")
    else:
        recordings(given.folder, given.packets)


if __name__ == "__main__":
    main()
