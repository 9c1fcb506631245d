"""Is `quality` true? Of frames with quality q, about 1 - q should have a wrong bit, whatever the decoding.

    python benchmarks/quality.py [--seeds 1] [--jobs 2] [--campaign examples/campaigns/road.toml]

Every scene of a campaign is simulated and received with each decoding. Frames of all of them together are put
into bins by their quality; a bin shows how many frames it has, what share of them should be wrong by it (the
mean of 1 - q), and what share is, with an interval of 95 % that is bootstrapped over recordings. Where the
latter is more than twice the former, or less than half of it, and chance would seldom (1 in 20) take one
within these bounds so far out, there is a star. Below is how many symbols are wrong in a frame that has a
wrong one.
"""

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.stats import binom

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.sim import Scene
from evlcp_sdk.simulated import simulate
from evlcp_sdk.study.frames import frames_of
from evlcp_sdk.study.match import match_frames
from evlcp_sdk.study.task import plan_campaign

CAMPAIGN = Path(__file__).parents[1] / "examples" / "campaigns" / "road.toml"
DECODINGS = ("motion-feedback", "ml-soft", "wh-transform")
EDGES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 0.99, 0.999, 1.0)
BINS = (*pairwise(EDGES), (0.0, 1.0))
ROUNDS = 1000
_SELDOM = 0.05

Qualities = dict[str, list[tuple[float, int]]]


def frame_qualities(scene: Scene, seed: int) -> Qualities:
    """Quality of each frame of a simulated scene, and how many of its symbols are wrong, by decoding."""
    with simulate(scene, seed) as source:
        events, _ = source.read()
    found: Qualities = {}
    for decoding in DECODINGS:
        link = load_link(overrides=[f"decoding.id={decoding}"])
        receiver = Receiver(link)
        packets = receiver.feed(events) + receiver.close()
        rows = frames_of(packets)
        frames = (frame for packet in packets for frame in packet.frames)
        quality = {id(row): frame.soft.quality for row, frame in zip(rows, frames, strict=True)}
        matched, own = match_frames(rows, source.truth), found.setdefault(decoding, [])
        for sent, pairs in zip(matched.bars, matched.pairs, strict=True):
            for row, number in pairs:
                symbols = np.array(row.symbols)
                counts = (symbols >= 0) & ~(sent.cut[number] & ~sent.hidden[number])
                own.append((quality[id(row)], int((symbols != sent.symbols[number])[counts].sum())))
    return found


def rows(recordings: list[list[tuple[float, int]]]) -> Iterator[list[str]]:
    """Three cells a bin, and those of all."""
    rng = np.random.default_rng(0)
    parts = [np.array(part, float).reshape(-1, 2) for part in recordings]
    for low, high in BINS:
        kept = [p[(p[:, 0] >= low) & ((p[:, 0] < high) | (high == 1))] for p in parts]
        n = np.array([len(p) for p in kept])
        if not n.sum():
            yield ["0", "-", "-"]
            continue
        expected_errors, wrong = np.array([[(1 - p[:, 0]).sum(), (p[:, 1] > 0).sum()] for p in kept]).T
        drawn = rng.integers(0, len(kept), (ROUNDS, len(kept)))
        share = wrong[drawn].sum(1) / np.maximum(n[drawn].sum(1), 1)
        least, most = np.quantile(share, [0.025, 0.975])
        expected, true = expected_errors.sum() / n.sum(), wrong.sum() / n.sum()
        star = "*" if _is_off(int(wrong.sum()), int(n.sum()), expected) else ""
        yield [str(n.sum()), f"{expected:.2g}", f"{true:.2g}{star} ({least:.2g} to {most:.2g})"]


def _is_off(wrong: int, frames: int, expected: float) -> bool:
    """Whether so many wrong frames are neither within a factor of 2 of what is expected, nor chance."""
    few = binom.cdf(wrong, frames, expected / 2) < _SELDOM
    many = binom.sf(wrong - 1, frames, min(2 * expected, 1.0)) < _SELDOM
    return bool(few or many)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--campaign", type=Path, default=CAMPAIGN)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    scenes = [case.value for case in plan_campaign(args.campaign).scenes]
    work = [(scene, seed) for scene in scenes for seed in range(1, args.seeds + 1)]
    with ProcessPoolExecutor(args.jobs) as pool:
        found = list(pool.map(frame_qualities, *zip(*work, strict=True)))
    print("| quality |" + "".join(f" {decoding}: frames | by it | wrong |" for decoding in DECODINGS))
    print("|---|" + "---|---|---|" * len(DECODINGS))
    tables = zip(*(rows([part[decoding] for part in found]) for decoding in DECODINGS), strict=True)
    for (low, high), cells in zip(BINS, tables, strict=True):
        name = "all" if (low, high) == (0.0, 1.0) else f"{low:g} to {high:g}"
        print(f"| {name} | " + " | ".join(cell for part in cells for cell in part) + " |")
    together = []
    for decoding in DECODINGS:
        wrong = [many for part in found for _, many in part[decoding] if many]
        together.append(f"{decoding} {np.mean(wrong):.1f}" if wrong else f"{decoding} -")
    print(f"\nwrong symbols in a frame that has any: {', '.join(together)}")


if __name__ == "__main__":
    main()
