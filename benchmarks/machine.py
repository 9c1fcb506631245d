"""What two cores of this machine are worth, whatever the program: the limit of all that works on two.

    python benchmarks/machine.py [--rounds 15]

Two processes do the same plain work, alone and at once. Twice as much in the same time is 2.00; where both
cores are threads of one core, they share what adds and multiplies, and vectors of numbers, which fill that
alone, come to 1.0 to 1.2. A chain of integers, each of which waits for the one before, leaves most free.

Medians of the rounds, and least and most; they mean something on an idle machine only.
"""

import argparse
import multiprocessing
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numba import njit

Work = Callable[[], object]


@njit
def chain(steps: int) -> int:
    """A random number from each before (xorshift)."""
    state = np.uint64(88172645463325252)
    for _ in range(steps):
        state ^= state << np.uint64(13)
        state ^= state >> np.uint64(7)
        state ^= state << np.uint64(17)
    return state


@njit
def vectors(values: np.ndarray, times: int) -> None:
    """One product and sum for each value, several side by side."""
    for _ in range(times):
        for i in range(values.size):
            values[i] = values[i] * np.float32(0.999) + np.float32(0.5)


@njit
def scattered(values: np.ndarray, places: np.ndarray, times: int) -> int:
    """Sum of values at random places."""
    total = 0
    for _ in range(times):
        for i in range(places.size):
            total += values[places[i]]
    return total


def kinds_of_work() -> Mapping[str, Work]:
    """Plain work by its name, a tenth to a third of a second each."""
    rng = np.random.default_rng(0)
    near, far = np.ones(4096, np.float32), np.ones(1 << 24, np.float32)
    pixels, places = np.ones(1280 * 720, np.uint8), rng.integers(0, 1280 * 720, 1 << 16)
    return {
        "a chain of integers": lambda: chain(100_000_000),
        "vectors in the nearest cache": lambda: vectors(near, 600_000),
        "vectors in memory": lambda: vectors(far, 30),
        "bytes of pixels, here and there": lambda: scattered(pixels, places, 3000),
    }


def _works(work: Work, rounds: int, gate: Any) -> None:
    work()
    gate.wait()
    for _ in range(rounds):
        work()
    gate.wait()


def at_once_s(work: Work, cores: int, rounds: int) -> float:
    """Wall time, s, in which each of some processes does the work once."""
    context = multiprocessing.get_context("fork")
    gate = context.Barrier(cores + 1)
    workers = [context.Process(target=_works, args=(work, rounds, gate)) for _ in range(cores)]
    for worker in workers:
        worker.start()
    gate.wait()
    begin_s = time.perf_counter()
    gate.wait()
    spent_s = time.perf_counter() - begin_s
    for worker in workers:
        worker.join()
    return spent_s / rounds


def two_to_one(work: Work, rounds: int) -> list[float]:
    """How much two cores do in the time of one, in each of some rounds."""
    return sorted(2 * at_once_s(work, 1, 1) / at_once_s(work, 2, 1) for _ in range(rounds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    args = parser.parse_args()
    for name, work in kinds_of_work().items():
        work()
        ratios = two_to_one(work, args.rounds)
        middle = statistics.median(ratios)
        print(f"{name:32} {middle:5.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})", flush=True)


if __name__ == "__main__":
    main()
