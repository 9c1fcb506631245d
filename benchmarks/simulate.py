"""The simulator: events a second of one core, beside simulators that step through time.

    python benchmarks/simulate.py [--seconds 0.25] [--rounds 3] [--memory 60]

Whole scenes, kernels warm, one thread, processor time, the best of the rounds: a bar at 30, 50 and 90 m,
rendered to sorted events; beside it how much longer one thread takes than two, by the clock, the quickest of
rounds in turn. Then the same pixels' worth of work
three ways, in events a second: the closed form; a compiled loop that steps one pixel through the same light
by 1 us and by 10 ns (what it takes to be as exact); and whole frames in NumPy, all pixels of the sensor, 1 us
a step. `--memory` renders a drive of so many seconds and prints the peak of the resident memory.
"""

import argparse
import math
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit

from evlcp_sdk.sim import SensorSpec, Simulation, load_scene
from evlcp_sdk.sim.simulation import pack_sensor

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.models.pixels import pixel_events


def best(work: Callable[[], int], rounds: int) -> float:
    """Events a second of the quickest round's processor time, in millions."""
    rates = []
    for _ in range(rounds):
        began = time.process_time()
        events = work()
        rates.append(events / (time.process_time() - began) / 1e6)
    return max(rates)


def scene_rate(distance_m: float, seconds: float, rounds: int) -> tuple[float, float]:
    """Events a second of processor time in millions; the time of one thread in times of two's."""
    scene = load_scene(
        "drive-30kmh",
        {"motion.distance_m": distance_m, "duration_s": seconds, "background.light_w_m2": 0.05},
    )

    def render(threads: int = 1) -> int:
        return sum(map(len, Simulation(scene, threads=threads).stream()))

    def took(threads: int) -> float:
        began = time.perf_counter()
        render(threads)
        return time.perf_counter() - began

    # Not the median of ratios: on a machine with other work that is 1, whatever threads could do.
    one, two = zip(*[(took(1), took(2)) for _ in range(rounds)], strict=True)
    ratio = min(one) / min(two)
    return best(render, rounds), ratio


@njit
def step_pixel(light: np.ndarray, piece_us: float, step_us: float, sensor: np.ndarray) -> int:
    """Events of one noiseless pixel, its receptor advanced and compared step by step."""
    u = 1 / light[0]
    reference = u
    low, high = math.exp(-sensor[9]), math.exp(sensor[10])
    blind = 0
    steps = round(piece_us / step_us)
    blind_steps = round(sensor[1] / step_us)
    n = 0
    for i in range(light.size):
        rest = 1 / light[i]
        kept = math.exp(-light[i] / sensor[0] * step_us)
        for _ in range(steps):
            u = rest + (u - rest) * kept
            if blind > 0:
                blind -= 1
                if blind == 0:
                    reference = u
            elif u <= reference * low or u >= reference * high:
                n += 1
                blind = blind_steps
    return n


def frame_steps(sensor: np.ndarray, steps: int = 20) -> int:
    """Events of a bar's 700 pixels when whole frames are stepped by 1 us."""
    light = np.full((720, 1280), 0.05)
    u = 1 / light
    reference = u.copy()
    n = 0
    for i in range(steps):
        light[300:440, 400:405] = 51.0 if i % 10 < 5 else 0.05
        u = 1 / light + (u - 1 / light) * np.exp(-light / sensor[0])
        fired = np.abs(np.log(u / reference)) > sensor[9]
        reference[fired] = u[fired]
        n += int(fired.sum())
    return n


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=0.25)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--memory", type=float, default=0.0)
    args = parser.parse_args()
    for _ in Simulation(load_scene("drive-30kmh", ["duration_s=0.004"])).stream():
        pass
    for distance_m in (30.0, 50.0, 90.0):
        rate, ratio = scene_rate(distance_m, args.seconds, args.rounds)
        print(
            f"scene at {distance_m:.0f} m, one core       {rate:8.2f} Mev/s, two threads {ratio:.2f} times"
            " as quick",
            flush=True,
        )

    spec = SensorSpec(noise_ln=0.0, th_spread=0.0, p_on_miss=0.0, p_off_miss=0.0)
    sensor = pack_sensor(spec)
    bits = np.random.default_rng(0).integers(0, 2, 2000)
    light = np.where(np.stack([1 - bits, bits], 1).ravel(), 51.0, 0.05)
    edges = np.arange(light.size) * 100.0

    def closed_form() -> int:
        return len(pixel_events(spec, edges, light, light.size * 100.0, pixels=2000).on)

    closed_form()
    print(f"pixels, closed form           {best(closed_form, args.rounds):8.2f} Mev/s")
    for step_us, repeat in ((1.0, 20), (0.01, 1)):
        step_pixel(light[:2], 100.0, step_us, sensor)
        rate = best(
            lambda s=step_us, r=repeat: sum(step_pixel(light, 100.0, s, sensor) for _ in range(r)),
            args.rounds,
        )
        print(f"pixels, steps of {step_us:4g} us      {rate:8.3f} Mev/s")
    print(f"frames, steps of 1 us, NumPy  {best(lambda: frame_steps(sensor), 1):8.4f} Mev/s")

    if args.memory:
        drive = {"motion.distance_m": 8.333 * args.memory + 30, "duration_s": args.memory}
        began = time.perf_counter()
        events = sum(map(len, Simulation(load_scene("drive-30kmh", drive)).stream()))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        elapsed = time.perf_counter() - began
        print(f"{args.memory:g} s of driving: {events / 1e6:.0f} Mev in {elapsed:.0f} s, peak {peak:.0f} MB")


if __name__ == "__main__":
    main()
