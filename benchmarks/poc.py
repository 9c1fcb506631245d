"""Shifts between cluster maps: time and error of `poc` and of scikit-image, on the same windows, in one run.

    pip install --group bench
    python benchmarks/poc.py [RECORDING] [--frames 20] [--rounds 20]

Real windows: the maps of each frame are caught at the hook from the recording that comes with the package (or
another with its truth beside it), cut as `poc` cuts them; the true shift of a pair follows from the true
distance. Ideal windows: blurred boxes of the same size at known sub-pixel shifts, in noise. Both go through
`poc` with its two bands, all pairs of a frame at once, and pair by pair through scikit-image's
`phase_cross_correlation` with upsample_factor=100: with its phases, as `poc`, and without normalization.

Times are processor times of one thread, kernels warm, the median over the frames; error is that of the shift
along the bar, px.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from evlcp_poc import _kernels
from evlcp_poc.correlation import (
    blob_band,
    blob_size,
    cut_maps,
    full_band,
    pair_shifts,
    phase_only_correlation,
)
from evlcp_poc.ranging import PocRanging, cut_size
from numpy.typing import NDArray
from scipy.special import ndtr
from skimage.registration import phase_cross_correlation

from evlcp_sdk.io import open_source
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.sim import read_truth, truth_path
from evlcp_sdk.values import FrameView, PresenceMap, SoftSymbols

SHIPPED = Path(__file__).parents[1] / "examples" / "recordings" / "night-50m-30kmh-cut.raw"
SAMPLES, IDEAL_NOISE = 2, 0.15
Shifts = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of one frame, float32 (n, height, width), the pairs of them, and their true shifts, px."""

    cuts: NDArray[np.float32]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    true_px: Shifts
    reach: int


class Catch:
    """Keeps the presence of each decoded frame, and when it began."""

    def __init__(self) -> None:
        self.frames: list[tuple[float, PresenceMap]] = []
        self._presence: PresenceMap | None = None

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: object) -> None:
        """See the hook."""
        if isinstance(value, PresenceMap):
            self._presence = value
        elif stage == "frame" and self._presence is not None:
            self.frames.append((value.t_us, self._presence))  # type: ignore[attr-defined]


def caught(path: Path, link: Link) -> list[tuple[PresenceMap, float]]:
    """Presence and true distance of each frame of a recording of one bar."""
    catch = Catch()
    receiver = Receiver(link, Registry.load(catch).hook)
    with open_source(path) as source:
        for events in source.chunks():
            receiver.feed(events)
    receiver.close()
    truth = read_truth(truth_path(path))
    t_us, true_m = truth.t_us + truth.t0_us, truth.bars[0].distance_m
    return [(presence, float(np.interp(begin + 800, t_us, true_m))) for begin, presence in catch.frames]


def windows_of(presence: PresenceMap, distance_m: float, link: Link) -> Windows:
    """All pairs of a frame's clusters, but the outermost, cut as `poc` does."""
    used = np.arange(1, link.bar.clusters - 1)
    maps = presence.pixels[used]
    middle = np.empty((len(used), 2), np.int64)
    _kernels.find_middles(maps, 4, middle)
    spacing_px = link.camera.focal_px * float(np.diff(link.bar.cluster_centres_m()[:2, 1])[0]) / distance_m
    height = cut_size(2 * spacing_px + 8)
    width = min(height, cut_size(maps.shape[2]))
    cuts = cut_maps(maps, middle, height, width)
    first, second = np.triu_indices(len(used), 1)
    true_px = spacing_px * (second - first) - (middle[second, 0] - middle[first, 0])
    return Windows(cuts, first, second, true_px, max(int(spacing_px / 2), 2))


def ideal(like: Windows, blob: tuple[float, float], rng: np.random.Generator) -> Windows:
    """Blurred boxes of a blob's size at random sub-pixel places, in noise; as many, in windows as large."""
    n, height, width = like.cuts.shape
    places = rng.uniform(-1, 1, (n, 2))

    def profile(length: int, size: float, at: Shifts) -> Shifts:
        edge = np.arange(length) - length // 2 - at[:, None]
        return ndtr((edge + size / 2) / 0.45) - ndtr((edge - size / 2) / 0.45)

    down, across = profile(height, blob[0], places[:, 0]), profile(width, blob[1], places[:, 1])
    cuts = down[:, :, None] * across[:, None, :] + rng.normal(0, IDEAL_NOISE, like.cuts.shape)
    true_px = places[like.second, 0] - places[like.first, 0]
    return Windows(cuts.astype(np.float32), like.first, like.second, true_px, like.reach)


def poc(w: Windows, band: str) -> Shifts:
    """Shifts of all pairs, down, px."""
    most = full_band(*w.cuts.shape[1:]) if band == "full" else blob_band(w.cuts)
    correlation = phase_only_correlation(w.cuts, w.first, w.second, most)
    return pair_shifts(correlation, most, w.reach, SAMPLES)[:, 0]


def scikit_image(w: Windows, normalization: str | None) -> Shifts:
    """The same, pair by pair; its sign says how to move the second back onto the first."""
    return np.array(
        [
            -phase_cross_correlation(w.cuts[i], w.cuts[j], upsample_factor=100, normalization=normalization)[
                0
            ][0]
            for i, j in zip(w.first, w.second, strict=True)
        ]
    )


METHODS: dict[str, Callable[[Windows], Shifts]] = {
    "poc, band full": lambda w: poc(w, "full"),
    "poc, band blob": lambda w: poc(w, "blob"),
    "scikit-image, phase": lambda w: scikit_image(w, "phase"),
    "scikit-image, none": lambda w: scikit_image(w, None),
}


def compared(title: str, frames: list[Windows], rounds: int) -> None:
    """Print a row a method: its time and error, and how it stands to both of scikit-image."""
    pairs = len(frames[0].first)
    print(f"\n{title}: {len(frames)} frames, {pairs} pairs each, windows {frames[0].cuts.shape[1:]} px")
    print(
        f"{'':22}{'us/pair':>9}{'RMSE, px':>10}{'median':>8}{'> 1 px':>8}   time and RMSE over scikit-image"
    )
    found: dict[str, tuple[float, float]] = {}
    for name, method in reversed(METHODS.items()):
        method(frames[0])
        repeat = rounds if name.startswith("poc") else 1
        times, errors = [], []
        for w in frames:
            began = time.thread_time()
            for _ in range(repeat):
                shifts = method(w)
            times.append((time.thread_time() - began) / repeat / pairs * 1e6)
            errors.append(shifts - w.true_px)
        off = np.abs(np.concatenate(errors))
        found[name] = us, rmse = float(np.median(times)), float(np.sqrt((off**2).mean()))
        ratios = []
        for other, (other_us, other_rmse) in found.items():
            if name.startswith("poc") and other.startswith("scikit"):
                word = other.split(", ")[1]
                ratios.append(f"{word} {other_us / us:.0f} x faster, error x {rmse / other_rmse:.2f}")
        gross = (off > 1).mean()
        told = f"{us:9.2f}{rmse:10.4f}{np.median(off):8.4f}{gross:8.1%}   {'; '.join(ratios)}"
        print(f"{name:22}{told.rstrip()}")


def frame_time(views: list[FrameView], ranging: PocRanging, link: Link, rounds: int) -> float:
    """Processor time of one frame's distance, all pairs, ms."""
    measure = ranging.compile(link.camera, link.bar, link.codebook)
    measure(views[0])
    times = []
    for view in views:
        began = time.thread_time()
        for _ in range(rounds):
            measure(view)
        times.append((time.thread_time() - began) / rounds * 1e3)
    return float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recording", nargs="?", type=Path, default=SHIPPED)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=20)
    args = parser.parse_args()
    if "OPENBLAS_NUM_THREADS" not in os.environ:
        # The library reads it when it is loaded: begin anew.
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | {"OPENBLAS_NUM_THREADS": "1"})
    link = load_link()
    frames = caught(args.recording, link)[: args.frames]
    if not frames:
        sys.exit(f"{args.recording}: no frame")
    nothing = np.zeros((0, 0, 0), np.int16)
    silent = SoftSymbols(np.zeros(0, np.int64), np.zeros((0, 0), np.float32), 0.0)
    views = [FrameView(nothing, np.zeros((2, 0)), presence, silent) for presence, _ in frames]
    print(f"{args.recording.name}: all pairs of one frame, distance included (limit 1 ms)")
    for band in ("full", "blob"):
        for name, ranging, pairs in (
            ("as configured by default", PocRanging(band=band), 28),  # type: ignore[arg-type]
            ("every pair of 16", PocRanging(band=band, skip_outer=0, min_spacing=0.0), 120),  # type: ignore[arg-type]
        ):
            ms = frame_time(views, ranging, link, args.rounds)
            print(f"  band {band}, {name:26}{pairs:4} pairs {ms:7.3f} ms")
    real = [windows_of(presence, distance_m, link) for presence, distance_m in frames]
    compared("real windows", real, args.rounds)
    down, across = np.median([blob_size(w.cuts) for w in real], axis=0).tolist()
    blob = down, across
    rng = np.random.default_rng(0)
    compared(
        f"ideal blobs of {blob[0]:.1f} x {blob[1]:.1f} px, noise {IDEAL_NOISE}",
        [ideal(w, blob, rng) for w in real],
        args.rounds,
    )


if __name__ == "__main__":
    main()
