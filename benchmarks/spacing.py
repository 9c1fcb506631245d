"""Distances where clusters are a whole number of pixels apart, and where they are not.

    python benchmarks/spacing.py [--drives 4] [--spacings 5.5 5.75 ...]

Drives of 60 ms at 4 m/s by the simulator, in the shade, received by the default link, which is told that the
bar is level, so that a lean has no part in it. `still` is without vibration, `shaking` with 0.06 rad/s. RMSE
are in mm at 50 m: scaled by the distance squared, as the bound goes. The last two columns are the Cramer-Rao
bound of a frame by boundaries of 0.25 px and noise of 0.3 full values, over where the bar lies on the pixels:
its root mean square and its largest. Half a minute of processor time.
"""

import argparse
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.sim import Simulation, resolve_scene, truth_of
from evlcp_sdk.study.bound import cramer_rao_sigma_m
from evlcp_sdk.study.frames import frames_of
from evlcp_sdk.study.match import match

LINK = load_link()
SPACING_PX_M = LINK.camera.focal_px * LINK.bar.column_pitch_m
"""Distance between clusters in the image, px, times the distance of the bar, m."""

SPACINGS_PX = (5.5, 5.75, 5.9, 6.0, 6.1, 6.25, 6.9, 7.0, 7.1, 7.5, 8.0, 8.25, 8.75, 9.0, 9.25)
VIBRATIONS_RAD_S = (0.0, 0.06)
BLUR_PX, NOISE, PHASES = 0.25, 0.3, 10
DURATION_S, SPEED_M_S = 0.06, 4.0


def errors(distance_m: float, vib_rate_rad_s: float, seed: int) -> NDArray[np.float64]:
    """Error and sigma of each distance of a drive, m, (n, 2)."""
    table: dict[str, Any] = {
        "duration_s": DURATION_S,
        # The spacing is met in the drive's middle.
        "motion": {
            "distance_m": distance_m + SPEED_M_S * DURATION_S / 2,
            "speed_mps": SPEED_M_S,
            "vib_rate_rad_s": vib_rate_rad_s,
        },
        "background": {"light_w_m2": 0.3, "texture": 0.3},
        "sensor": {"jitter_us": 4.0, "refr_us": 20.0},
        "bars": [{"x_m": 0.3 + 0.1 * seed, "y_m": 0.0137 * seed}],
    }
    simulation = Simulation(resolve_scene(table), seed)
    receiver = Receiver(LINK, attitude=Attitude(0.0, 0.0, gravity_sigma_deg=0.02))
    packets = [packet for events in simulation.stream() for packet in receiver.feed(events)]
    matched = match(frames_of(packets + receiver.close()), truth_of(simulation))
    (sent,), (pairs,) = matched.bars, matched.pairs
    found = [(frame.distance_m - sent.distance_m[n], frame.sigma_m) for frame, n in pairs]
    return np.array([one for one in found if math.isfinite(one[0])]).reshape(-1, 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--drives", type=int, default=4)
    parser.add_argument("--spacings", type=float, nargs="+", default=SPACINGS_PX, metavar="PX")
    args = parser.parse_args()
    print("| px | m | still: RMSE, mm at 50 m | NEES | shaking: RMSE, mm at 50 m | NEES | bound | largest |")
    print("|---|---|---|---|---|---|---|---|")
    for spacing_px in args.spacings:
        distance_m = SPACING_PX_M / spacing_px
        mm = 1e3 * (50 / distance_m) ** 2
        cells = []
        for rate in VIBRATIONS_RAD_S:
            found = np.concatenate([errors(distance_m, rate, seed) for seed in range(args.drives)])
            cells.append(f"{mm * math.sqrt(float(np.mean(found[:, 0] ** 2))):.0f}")
            cells.append(f"{np.mean((found[:, 0] / found[:, 1]) ** 2):.2f}")
        scene = LINK.camera, LINK.bar, LINK.codebook, distance_m, range(LINK.bar.clusters)
        bounds = [
            mm * cramer_rao_sigma_m(*scene, blur_px=BLUR_PX, noise=NOISE, shift_px=i / PHASES)
            for i in range(PHASES)
        ]
        cells += [f"{math.sqrt(np.mean(np.square(bounds))):.0f}", f"{max(bounds):.0f}"]
        print(f"| {spacing_px:g} | {distance_m:.1f} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
