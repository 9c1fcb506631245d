"""Which of two images the receiver takes for the bar: a bar and its image in a window, dimmer and blurred.

Scenes of 60 ms by the simulator, other noise, payload and place each; a scene is wrong if the newest packet
of either image says so. `python benchmarks/window.py`, three minutes of processor time.
"""

import argparse
import itertools
import zlib
from collections import Counter

import numpy as np

import evlcp_sdk as evlcp

LIGHTS = {"night": "night", "day": "drive-30kmh", "sun": "sun"}
DISTANCES_M = (30.0, 50.0, 90.0)
SHARES = (0.1, 0.3, 0.6, 0.9)
BLURS_PX = (0.0, 0.3, 0.5, 1.0, 1.5)


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
    every = parser.parse_args().every
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
