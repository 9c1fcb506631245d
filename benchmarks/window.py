"""Which of two images the receiver takes for the bar: a bar and its image in a window, dimmer and blurred.

    python benchmarks/window.py [--every N | --bound]

Scenes of 60 ms by the simulator, other noise, payload and place each; a scene is wrong if the newest packet
of either image says so. Three minutes of processor time.

`--bound` takes no receiver: how many of these scenes would be wrong if the three lengths that tell the images
apart (`evlcp_sdk.rx.spread`) had no error but that of so many frames, for who knows lens, background, share
and blur, and for who knows the lens alone, as the receiver does.
"""

import argparse
import itertools
import math
import zlib
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

import evlcp_sdk as evlcp
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.spread import Spread, expected_lengths, length_errors, sharper

LIGHTS = {"night": "night", "day": "drive-30kmh", "sun": "sun"}
DISTANCES_M = (30.0, 50.0, 90.0)
SHARES = (0.1, 0.3, 0.6, 0.9)
BLURS_PX = (0.0, 0.3, 0.5, 1.0, 1.5)
BACKGROUNDS = np.geomspace(0.004, 1.0, 8)
FRAMES = (15, 300)
DRAWS = 20


@dataclass(frozen=True, eq=False)
class Told(Spread):
    """Lengths as they are drawn."""

    px: Any = None

    def lengths(self) -> Any:
        """As drawn."""
        return self.px


def bound(share: float, blur_px: float, frames: int, rng: np.random.Generator) -> tuple[float, float]:
    """Share of scenes that are wrong: for who knows all but which is which, and for who knows the lens."""
    camera, told, blind = load_link().camera, [], []
    for distance_m in DISTANCES_M:
        spacing_px = 0.06 * camera.focal_px / distance_m
        bars = expected_lengths(spacing_px, np.zeros(1), BACKGROUNDS)
        images = expected_lengths(spacing_px, np.array([blur_px]), BACKGROUNDS / share)
        error = length_errors(frames)
        told += norm.sf(np.sqrt((((bars - images) / error) ** 2).sum(1) / 2)).tolist()
        for bar, image in zip(bars, images, strict=True):
            for _ in range(DRAWS):
                seen = [v + error * rng.standard_normal(3) for v in (bar, image)]
                one, other = (Told(None, None, spacing_px * frames, frames, v) for v in seen)  # type: ignore[arg-type]
                odds = sharper(one, other)
                blind.append(math.nan if odds is None else float(odds < 0))
    return float(np.mean(told)), float(np.nanmean(blind))


def print_bounds() -> None:
    """Print the shares of scenes that are wrong, by light and blur of the image."""
    rng = np.random.default_rng(0)
    print(
        "| light | blur, px | " + " | ".join(f"told all, {n} frames | the lens alone" for n in FRAMES) + " |"
    )
    print("|---|---|" + "---|---|" * len(FRAMES))
    for share, blur_px in itertools.product(SHARES, BLURS_PX):
        cells = [f"{v:.1%}" for n in FRAMES for v in bound(share, blur_px, n, rng)]
        print(f"| {share:.0%} | {blur_px} | " + " | ".join(cells) + " |")


def judged(light: str, distance_m: float, share: float, blur_px: float) -> bool | None:
    """Whether the newest packets of both images say which is the bar; None where only one is seen."""
    seed = zlib.crc32(repr((light, distance_m, share, blur_px)).encode()) % 10_000
    rng = np.random.default_rng(seed)
    right, down = float(rng.choice([-1, 1]) * rng.uniform(20, 50)), float(rng.uniform(-6, 6))
    scene = [
        "duration_s=0.06",
        f"motion.distance_m={distance_m}",
        'reflections.kind="window"',
        f"reflections.share={share}",
        f"reflections.blur_px={blur_px}",
        f"reflections.shift_px=[{right},{down}]",
    ]
    source = evlcp.simulate(LIGHTS[light], seed=seed, overrides=scene)
    newest = {}
    for packet in evlcp.receive(source):
        frame = packet.frames[-1]
        bar_px = np.interp(frame.t_us, source.truth.t_us, source.truth.bars[0].centre_px[:, 0])
        newest[bool(abs(frame.x_px - bar_px) < abs(right) / 2)] = frame.echo_of is None
    return None if len(newest) < 2 else newest[True] and not newest[False]


def main() -> None:
    """Print how many scenes are wrong, by light, share and blur."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=1, help="only every n-th scene")
    parser.add_argument("--bound", action="store_true", help="what could be told, without a receiver")
    args = parser.parse_args()
    if args.bound:
        print_bounds()
        return
    every = args.every
    scenes, wrong = Counter[str](), Counter[str]()
    for light, distance_m, share, blur_px in list(itertools.product(LIGHTS, DISTANCES_M, SHARES, BLURS_PX))[
        ::every
    ]:
        right = judged(light, distance_m, share, blur_px)
        if right is None:
            continue
        for key in ("all", light, f"{share:.0%} of the light", f"{blur_px} px of blur"):
            scenes[key] += 1
            wrong[key] += not right
    print("| scenes | of them | the image is taken for the bar |\n|---|---|---|")
    for key, many in scenes.items():
        print(f"| {key} | {many} | {wrong[key]} |")


if __name__ == "__main__":
    main()
