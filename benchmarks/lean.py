"""What a bar's lean against the sensor does to distances: bounds, and what the receiver makes of it.

    python benchmarks/lean.py [--seeds 4] [--duration 0.5] [--bounds | --level | --prior]

The first table is of closed forms and bounds (`evlcp_sdk.study.bound`), which take no receiver; with
`--bounds` it is all. The second has drives of the simulator by a camera that is level or pitched up by 4
degrees, the bar in the middle of its image or 200 px above it at first, vibration and all, received by the
default link without an attitude and with what an IMU says, whose sigma is 0.1 degrees, and which is off from
the bar by one sigma of both, to either side by turns. Five minutes of processor time.

`--level` prints how far off the distances of level bars are on average, by short drives whose distances are
spread over a tenth, so that the bar's ends fall on any part of a pixel; and the same at 50 m by cameras that
stand or go elsewhere, without row time, and with hardly blind pixels: two minutes.

`--prior` prints what sigmas can be worth by an ideal receiver that no attitude tells anything: its frames'
distances and leans are as good as the bounds allow, and it weighs them by Bayes' rule. A camera may lean as
the receiver expects it, but for the share of cameras that do, which is varied. Recordings of 0.18 s, level
ones and ones of 3 to 5 degrees; a few seconds.
"""

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.ranges import _LEANING_DEG, _LEVEL_DEG
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.lean import BarSight, foreshortening
from evlcp_sdk.sim import Simulation, Truth, resolve_scene, truth_of
from evlcp_sdk.sim.world import attitude_log
from evlcp_sdk.study.bound import cramer_rao_sigma_m, lean_sigma_deg
from evlcp_sdk.values import Packet

LINK = load_link()
DISTANCES_M = (15, 30, 45, 60, 80, 90)
SCENES = ((0.0, 0.0), (4.0, 0.0), (4.0, -200.0))
BLUR_PX, NOISE = 0.45, 0.3
SIGMA_DEG = 0.1
EARLY_S = 0.1
LEVEL_DRIVES, LEVEL_S = 24, 0.06
LEVEL_CASES: Sequence[tuple[float, str, Mapping[str, Mapping[str, float]]]] = (
    (30, "", {}),
    (50, "", {}),
    (80, "", {}),
    (50, "20 m/s", {"motion": {"speed_mps": 20.0}}),
    (50, "standing", {"motion": {"speed_mps": 0.0}}),
    (50, "backwards, 20 m/s", {"motion": {"speed_mps": -20.0}}),
    (50, "no row time", {"sensor": {"t_row_us": 0.0}}),
    (50, "blind for 1 us", {"sensor": {"refr_us": 1.0}}),
    (50, "blind for 20 us", {"sensor": {"refr_us": 20.0}}),
)
SHARES, IDEAL_FRAMES, IDEAL_DRIVES = (0.1, 0.3, 0.5, 0.7), 56, 1000


def bounds() -> None:
    print("| m | a frame's distance, m | its lean, deg | 4 deg in the middle, m | 200 px above, m | frames |")
    print("|---|---|---|---|---|---|")
    sine = math.sin(math.radians(4))
    middle, above = (BarSight(row / LINK.camera.focal_px) for row in (0.0, -200.0))
    for distance_m in DISTANCES_M:
        scene = LINK.camera, LINK.bar, LINK.codebook, float(distance_m), range(LINK.bar.clusters)
        distance = cramer_rao_sigma_m(*scene, blur_px=BLUR_PX, noise=NOISE)
        lean = lean_sigma_deg(*scene, blur_px=BLUR_PX, noise=NOISE)
        off = [distance_m * (1 / foreshortening(np.array([sine]), s)[0] - 1) for s in (middle, above)]
        # What the lean, told by n frames, adds at 4 degrees is then no more than the frame's own sigma.
        frames = (distance_m * sine * math.radians(lean) / distance) ** 2
        print(f"| {distance_m} | {distance:.4f} | {lean:.1f} | {off[0]:.3f} | {off[1]:.3f} | {frames:.0f} |")


def drive(
    distance_m: float,
    pitch_deg: float,
    row_px: float,
    seed: int,
    duration_s: float,
    more: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
) -> dict[str, NDArray[np.float64]]:
    """Time, error and sigma of each distance, float64 (n, 3): without an attitude, and with one."""
    # Attitude and bar are off to opposite sides: by one sigma of both together.
    off_deg = math.copysign(SIGMA_DEG / math.sqrt(2), seed % 2 - 0.5)
    up = math.radians(pitch_deg) - math.atan(row_px / LINK.camera.focal_px)
    scene = resolve_scene(
        {
            "duration_s": duration_s,
            "motion": {"distance_m": float(distance_m), "pitch_deg": pitch_deg, **more.get("motion", {})},
            "sensor": more.get("sensor", {}),
            "background": {"light_w_m2": 0.3},
            "world": {"latitude_deg": 35.0, "gravity_sigma_deg": 0.0, "attitude": "gravity"},
            "bars": [{"x_m": -0.8, "y_m": -distance_m * math.tan(up), "tilt_deg": off_deg}],
        }
    )
    simulation = Simulation(scene, seed)
    truth, true = truth_of(simulation), attitude_log(scene, seed, simulation.path)
    assert true is not None
    log = replace(
        true, pitch_deg=true.pitch_deg - off_deg, gravity_sigma_deg=np.full(len(true.t_us), SIGMA_DEG)
    )
    receivers = {"without": Receiver(LINK), "with": Receiver(LINK, attitude=log)}
    packets: dict[str, list[Packet]] = {name: [] for name in receivers}
    for events in simulation.stream():
        for name, receiver in receivers.items():
            packets[name] += receiver.feed(events)
    return {name: errors(packets[name] + receiver.close(), truth) for name, receiver in receivers.items()}


def errors(packets: Sequence[Packet], truth: Truth) -> NDArray[np.float64]:
    found = []
    for packet in packets:
        for frame in packet.frames if packet.echo_of is None else ():
            if math.isfinite(frame.range.distance_m):
                true_m = np.interp(frame.points_t_us - truth.t0_us, truth.t_us, truth.bars[0].distance_m)
                error_m = frame.range.distance_m - float(true_m)
                found.append((frame.t_us - truth.t0_us, error_m, frame.range.sigma_m))
    return np.array(found)


def level() -> None:
    """Mean errors of level bars, in millionths of the distance, with the standard error over drives."""
    print("| m | | without an attitude | with one | drives | frames |")
    print("|---|---|---|---|---|---|")
    for distance_m, name, more in LEVEL_CASES:
        spread = distance_m * np.linspace(0.95, 1.05, LEVEL_DRIVES)
        drives = [drive(d, 0.0, 0.0, seed, LEVEL_S, more) for seed, d in enumerate(spread.tolist())]
        cells = []
        for told in ("without", "with"):
            off = np.array([x[told][:, 1].mean() / d * 1e6 for x, d in zip(drives, spread, strict=True)])
            cells.append(f"{off.mean():+.0f} +- {off.std(ddof=1) / math.sqrt(len(off)):.0f}")
        frames = sum(len(x["with"]) for x in drives)
        print(f"| {distance_m} | {name} | {cells[0]} | {cells[1]} | {len(drives)} | {frames} |", flush=True)


def ideal(
    distance_m: float, share: float, lean_deg: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """NEES of each recording by an ideal receiver, and the RMSE, in sigmas of a frame that needs no lean.

    Args:
        distance_m: In all of them.
        share: Of the cameras, as the receiver expects, that lean by anything.
        lean_deg: How the bar leans in each recording, (n,).
    """
    scene = LINK.camera, LINK.bar, LINK.codebook, distance_m, range(LINK.bar.clusters)
    sigma_m = cramer_rao_sigma_m(*scene, blur_px=BLUR_PX, noise=NOISE)
    frame_deg = lean_sigma_deg(*scene, blur_px=BLUR_PX, noise=NOISE)
    rng = np.random.default_rng(0)
    frames = np.arange(1, IDEAL_FRAMES + 1)
    grid_deg = np.arange(-_LEANING_DEG + 0.05, _LEANING_DEG, 0.1)
    length = np.cos(np.radians(grid_deg))
    bell = np.exp(-0.5 * (grid_deg / _LEVEL_DEG) ** 2) / (_LEVEL_DEG * math.sqrt(2 * math.pi))
    before = (1 - share) * bell + share / (2 * _LEANING_DEG)
    squares, nees = 0.0, []
    for true_deg in lean_deg:
        # The mean of all frames so far is all that they say of the lean.
        seen_deg = true_deg + np.cumsum(rng.normal(0, frame_deg, IDEAL_FRAMES)) / frames
        off = (grid_deg - seen_deg[:, None]) / (frame_deg / np.sqrt(frames))[:, None]
        chance = before * np.exp(-0.5 * off**2)
        chance /= chance.sum(1, keepdims=True)
        mean = chance @ length
        variance = sigma_m**2 + distance_m**2 * (chance @ length**2 - mean**2)
        error_m = distance_m * (mean / math.cos(math.radians(true_deg)) - 1)
        error_m += rng.normal(0, sigma_m, IDEAL_FRAMES)
        nees.append(np.mean(error_m**2 / variance))
        squares += np.mean(error_m**2)
    return np.array(nees), math.sqrt(squares / len(lean_deg)) / sigma_m


def prior() -> None:
    """What each share of leaning cameras that is expected makes of level bars and of those that lean."""
    print("| m | " + " | ".join(f"{share:g}: level, pitched, cost" for share in SHARES) + " |")
    print("|---" * (1 + len(SHARES)) + "|")
    leaning_deg = np.random.default_rng(1).uniform(3, 5, IDEAL_DRIVES)
    for distance_m in (15.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0):
        cells = []
        for share in SHARES:
            level, rmse = ideal(distance_m, share, np.zeros(IDEAL_DRIVES))
            pitched, _ = ideal(distance_m, share, leaning_deg)
            fine = np.mean((pitched >= 0.5) & (pitched <= 2))
            cells.append(f"{level.mean():.2f}, {pitched.mean():.1f} ({fine:.0%}), {rmse - 1:+.0%}")
        print(f"| {distance_m:g} | " + " | ".join(cells) + " |", flush=True)


def nees(found: NDArray[np.float64]) -> str:
    return f"{np.mean((found[:, 1] / found[:, 2]) ** 2):.2f}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--duration", type=float, default=0.5)
    parser.add_argument("--bounds", action="store_true")
    parser.add_argument("--level", action="store_true")
    parser.add_argument("--prior", action="store_true")
    args = parser.parse_args()
    if args.prior:
        prior()
        return
    if args.level:
        level()
        return
    bounds()
    if args.bounds:
        return
    print("\n| pitch | row | m | without: RMSE m | NEES: first 0.1 s | then | with: RMSE m | NEES | frames |")
    print("|---|---|---|---|---|---|---|---|---|")
    for pitch_deg, row_px in SCENES:
        for distance_m in (30, 45, 60, 80):
            drives: list[dict[str, Any]] = [
                drive(distance_m, pitch_deg, row_px, seed, args.duration) for seed in range(1, args.seeds + 1)
            ]
            plain, told = (np.concatenate([d[name] for d in drives]) for name in ("without", "with"))
            early = plain[:, 0] < EARLY_S * 1e6
            rmse = [math.sqrt(float(np.mean(x[:, 1] ** 2))) for x in (plain, told)]
            print(
                f"| {pitch_deg:g} | {row_px:+g} | {distance_m} | {rmse[0]:.3f} | {nees(plain[early])}"
                f" | {nees(plain[~early])} | {rmse[1]:.3f} | {nees(told)} | {len(told)} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
