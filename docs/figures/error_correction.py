"""Error correction: frame errors, messages taken from noise, time; the figures of docs/error-correction.md.

    python docs/figures/error_correction.py [SECTION ...] [--blocks 10000] [--noise 100000]
        [--figure FILE.png]

Prints Markdown. Channels: binary-input AWGN with true LLRs, and a binary symmetric channel, both named by
the error rate of hard decisions. Intervals are of 95 % (Clopper and Pearson). Random numbers are fixed; only
the times differ from run to run.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from evlcp_polar import _kernels
from evlcp_polar.correction import Polar, discrepancy_limit, list_nodes
from evlcp_reed_solomon.correction import ReedSolomon
from numpy.typing import NDArray
from scipy import stats
from scipy.special import ndtri

from evlcp_sdk.report.colours import TRANSMITTER_COLOURS
from evlcp_sdk.report.drawing import set_heading, style_axes

AIR_S = 346 * 100e-6
"""A packet of the default profile on air."""


def transmit(
    coded: NDArray[np.uint8], error_rate: float, rng: np.random.Generator, soft: bool
) -> NDArray[np.float32]:
    """LLRs of coded bits behind a channel."""
    sign = 1.0 - 2.0 * coded
    if not soft:
        return (sign * np.where(rng.random(len(coded)) < error_rate, -4, 4)).astype(np.float32)
    sigma = -1 / ndtri(error_rate)
    return (2 * (sign + sigma * rng.normal(size=len(coded))) / sigma**2).astype(np.float32)


def draw_blocks(
    code: Any, error_rate: float, soft: bool, blocks: int, seed: int = 0
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float32]]]:
    """Random messages and what is received of them."""
    rng = np.random.default_rng([seed, code.coded_bits])
    for _ in range(blocks):
        message = rng.integers(0, 2, code.message_bits).astype(np.uint8)
        yield message, transmit(code.encode(message), error_rate, rng, soft)


def frame_errors(code: Any, error_rate: float, soft: bool, blocks: int, enough: int = 100) -> tuple[int, int]:
    """Messages lost, of how many; ends when enough are."""
    lost = done = 0
    for message, llr in draw_blocks(code, error_rate, soft, blocks):
        found = code.decode(llr)
        lost += not (found.ok and (found.bits == message).all())
        done += 1
        if lost == enough:
            break
    return lost, done


def share(lost: int, done: int) -> str:
    low, high = stats.binomtest(lost, done).proportion_ci()
    return f"{lost / done:.1e} ({low:.1e} to {high:.1e})" if lost else f"0 (to {high:.1e})"


def heading(*names: str) -> None:
    print("\n| " + " | ".join(names) + " |\n|" + "---|" * len(names))


def row(*cells: object) -> None:
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def curves(blocks: int) -> dict[tuple[int, bool], list[tuple[float, int, int]]]:
    """Frame error rate over raw bit error rate."""
    points = {
        True: (0.04, 0.06, 0.08, 0.09, 0.1, 0.11, 0.12),
        False: (0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08),
    }
    found: dict[tuple[int, bool], list[tuple[float, int, int]]] = {}
    for soft, rates in points.items():
        heading("AWGN, soft" if soft else "BSC, hard", *(f"n = {n}" for n in (256, 640, 960)))
        for rate in rates:
            cells = []
            for n in (256, 640, 960):
                lost, done = frame_errors(Polar().compile(n), rate, soft, blocks)
                found.setdefault((n, soft), []).append((rate, lost, done))
                cells.append(share(lost, done))
            row(rate, *cells)
    return found


def variants(blocks: int) -> None:
    """List sizes and Reed-Solomon, n = 960, soft input."""
    codes = {
        "one path": Polar(list_size=1, max_list_size=1).compile(960),
        "list 8": Polar(list_size=8, max_list_size=8).compile(960),
        "list 32 always": Polar(list_size=32).compile(960),
        "8 to 32": Polar().compile(960),
        "reed-solomon": ReedSolomon().compile(960),
    }
    heading("n = 960, AWGN", *codes)
    for rate in (0.02, 0.04, 0.06, 0.08, 0.1, 0.11):
        cells = []
        for name, code in codes.items():
            most = 300 if name == "reed-solomon" else blocks
            cells.append(share(*frame_errors(code, rate, True, most, 100)))
        row(rate, *cells)


@cache
def tabulate_phi() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Logarithms of a mean LLR, and of phi (Chung et al. 2001) there, by numerical integration."""
    mean = np.geomspace(1e-5, 2000, 400)
    z = np.linspace(-12, 12, 4001)
    weight = stats.norm.pdf(z) * (z[1] - z[0])
    x = mean[:, None] + np.sqrt(2 * mean)[:, None] * z
    # 1 - tanh(x / 2), without the cancellation.
    return np.log(mean), np.log((weight * 2 / (1 + np.exp(np.clip(x, -700, 700)))).sum(1))


def by_approximation(code: Any, error_rate: float) -> Any:
    """The same code, its information bits chosen for the channel and what is shortened."""
    log_mean, log_phi = tabulate_phi()
    n = len(code.information)
    mean = np.full(n, 1e6)
    mean[code.sent] = 2 * ndtri(error_rate) ** 2
    for stage in range(n.bit_length() - 1):
        half = n >> (stage + 1)
        a, b = np.moveaxis(mean.reshape(-1, 2, half), 1, 0)
        p, q = (np.exp(np.interp(np.log(m), log_mean, log_phi)) for m in (a, b))
        worse = np.exp(np.interp(-np.log(p + q - p * q), -log_phi, log_mean))
        worse = np.where(np.maximum(a, b) >= 1e6, np.minimum(a, b), worse)
        mean = np.stack([worse, np.minimum(a + b, 1e6)], 1).reshape(-1)
    mean[np.setdiff1d(np.arange(n), code.sent)] = 0
    information = np.zeros(n, bool)
    information[np.argsort(mean, kind="stable")[-code.information.sum() :]] = True
    return replace(code, information=information)


def orders(blocks: int) -> None:
    """The 5G sequence beside the order of Gaussian approximation."""
    heading("AWGN", "n", "5G sequence", "Gaussian approximation", "inputs that differ")
    for n, rate in ((256, 0.1), (256, 0.11), (640, 0.1), (640, 0.11), (960, 0.11), (960, 0.12)):
        code = Polar().compile(n)
        other = by_approximation(code, rate)
        pair = [share(*frame_errors(c, rate, True, blocks)) for c in (code, other)]
        row(rate, n, *pair, int((code.information & ~other.information).sum()))


def wrong_paths(code: Any, llr: NDArray[np.float32], message: NDArray[np.uint8]) -> int:
    """Wrong codewords that decoding one codeword would hold against the CRC, the search as it is."""
    n, nodes = len(code.information), list_nodes(code.information.tobytes())
    weight = np.abs(llr).astype(float)
    scale = weight.mean()
    limit = discrepancy_limit(weight / scale, code.log_share)
    mother = np.full(n, 4.0 * n, np.float32)
    mother[code.sent] = llr / scale
    right, tried = code.encode(message), set()
    for size in code.list_sizes:
        codewords, metric = np.empty((size, n), np.uint8), np.empty(size)
        most = inf if size == 1 else limit
        found = _kernels.list_decode(mother, nodes, size, most, codewords, metric)
        for path in np.argsort(metric[:found], kind="stable"):
            if metric[path] <= limit:
                if (codewords[path][code.sent] == right).all():
                    return len(tried)
                tried.add(codewords[path].tobytes())
        if limit < 0 or found == 0:
            break
    return len(tried)


def count_undetected(blocks: int) -> None:
    """Messages that were not sent: counted, and expected from the wrong codewords left to the CRC."""
    heading("n", "channel", "blocks", "lost", "taken wrongly", "wrong codewords a block", "expected a block")
    for n in (256, 960):
        code = Polar().compile(n)
        for rate in (0.1, 0.11, 0.12, 0.13, 0.14, 0.5):
            lost = wrong = tried = 0
            some = 0
            noise = np.random.default_rng([1, n])
            for i, (message, llr) in enumerate(draw_blocks(code, min(rate, 0.49), True, blocks)):
                if rate == 0.5:
                    llr = (np.abs(llr) * noise.choice([-1, 1], n)).astype(np.float32)
                found = code.decode(llr)
                right = bool((found.bits == message).all())
                lost += not (found.ok and right)
                wrong += found.ok and not right
                if i % 10 == 0 and rate < 0.5:
                    tried += wrong_paths(code, llr, message)
                    some += 1
            mean = tried / some if some else 0.0
            name = "random signs" if rate == 0.5 else f"AWGN {rate}"
            expected = f"{mean * 2**-24:.1e}" if some else "at most 1e-9"
            row(n, name, blocks, f"{lost / blocks:.1e}", wrong, f"{mean:.1e}" if some else "", expected)


def giving_up(blocks: int) -> None:
    """Messages lost because all paths of a list were implausible and the search ended."""
    heading("n", "channel", "blocks", "lost by ending early")
    for n, soft, rate in (
        *((n, True, rate) for n in (256, 960) for rate in (0.04, 0.06, 0.08, 0.1)),
        *((n, False, rate) for n in (256, 960) for rate in (0.04, 0.06)),
    ):
        hasty, patient = Polar().compile(n), Polar(list_size=32).compile(n)
        cost = 0
        for _, llr in draw_blocks(hasty, rate, soft, blocks):
            cost += not hasty.decode(llr).ok and patient.decode(llr).ok
        row(n, f"{'AWGN' if soft else 'BSC'} {rate}", blocks, share(cost, blocks))


def rates() -> None:
    """Decoding on one core; the best of five rounds of each block."""
    heading("n", "input", "ms a block", "message bits/s", "times the air rate")
    for n in (256, 640, 960, 1280):
        code = Polar().compile(n)
        for name, rate in (("AWGN 0.04", 0.04), ("AWGN 0.11", 0.11), ("random signs", 0.5)):
            noise = np.random.default_rng(0)
            total = []
            for _, llr in draw_blocks(code, min(rate, 0.04) if rate == 0.5 else rate, True, 100):
                if rate == 0.5:
                    llr = (np.abs(llr) * noise.choice([-1, 1], n)).astype(np.float32)
                best = inf
                for _ in range(5):
                    start = time.perf_counter()
                    code.decode(llr)
                    best = min(best, time.perf_counter() - start)
                total.append(best)
            mean = float(np.mean(total))
            air_s = AIR_S * n / 960
            row(n, name, f"{mean * 1e3:.3f}", f"{code.message_bits / mean:.2e}", f"{air_s / mean:.0f}")


def draw(found: dict[tuple[int, bool], list[tuple[float, int, int]]], path: Path) -> None:
    """The curves."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for ax, soft, title in zip(axes, (True, False), ("soft input, AWGN", "hard input, BSC"), strict=True):
        for (n, marker), colour in zip(
            ((256, "o"), (640, "s"), (960, "^")), TRANSMITTER_COLOURS, strict=False
        ):
            points = [p for p in found[n, soft] if p[1]]
            x = [p[0] for p in points]
            y = np.array([lost / done for _, lost, done in points])
            bars = np.array([stats.binomtest(lost, done).proportion_ci() for _, lost, done in points]).T
            style = {"ms": 5, "lw": 1.2, "capsize": 2, "color": colour, "label": f"n = {n}"}
            ax.errorbar(x, y, np.abs(bars - y), fmt=f"{marker}-", **style)
        ax.set(yscale="log", xlabel="bit error rate of hard decisions")
        set_heading(ax, title)
        style_axes(ax)
    axes[0].set_ylabel("frame error rate, with 95 % interval")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", frameon=False, fontsize=9, ncols=3)
    figure.savefig(path, dpi=150)


SECTIONS = ("curves", "variants", "orders", "ending", "rates", "undetected")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sections", nargs="*", help=f"of {', '.join(SECTIONS)}; all without any")
    parser.add_argument("--blocks", type=int, default=10_000)
    parser.add_argument("--noise", type=int, default=100_000)
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    wanted = given.sections or SECTIONS
    if "curves" in wanted:
        found = curves(given.blocks)
        if given.figure:
            draw(found, given.figure)
    if "variants" in wanted:
        variants(min(given.blocks, 3000))
    if "orders" in wanted:
        orders(given.blocks)
    if "ending" in wanted:
        giving_up(given.blocks)
    if "rates" in wanted:
        rates()
    if "undetected" in wanted:
        count_undetected(given.noise)


if __name__ == "__main__":
    main()
