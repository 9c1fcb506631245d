"""How high the wave is that boundaries between two pixels make, and how much of it distances have.

    python benchmarks/wave.py [RECORDING ...]

Without names, all recordings of one bar in `../shared/recordings/road` and one folder up, but that of the
pitched camera; `benchmarks/elsewhere.py --keep FOLDER` renders others. Of each: how far boundaries lie off
a parabola, in the sines of their places on the pixels (the height, px, by least squares over all frames,
with its standard error by what is left), and the slope of the errors of the ranging's distances over what a
wave of 1 px makes of each. The last line is the share of the height that the slopes have, by least squares,
and how far they are off it beyond their standard errors: `_WAVE_SHARE`, `_WAVE_REST_PX` of
`evlcp_sdk/rx/ranges.py`.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from road import SHARED, show

from evlcp_sdk.io.open import open_source
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.sim import read_truth, truth_path
from evlcp_sdk.values import Frame, FrameView

LEFT_OUT = "pitch-"


class Views:
    """The view of each frame that is accepted, with its start, us."""

    def __init__(self) -> None:
        self.found: list[tuple[float, FrameView]] = []
        self._view: FrameView | None = None

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: object) -> None:
        """A frame is rejected between its view and itself, or not."""
        if isinstance(value, FrameView):
            self._view = value
        elif stage == "frame" and isinstance(value, Frame) and self._view is not None:
            self.found.append((value.t_us, self._view))


def fit(y: Any, x: Any, weight: Any, beside: Any) -> tuple[float, float]:
    """Slope of y over x, and its standard error, with what `beside` (k, n) makes taken out; weighted."""
    root = np.sqrt(weight)
    basis = np.linalg.qr((beside * root).T)[0]
    y, x = (v * root - basis @ (basis.T @ (v * root)) for v in (y, x))
    slope = (x @ y) / (x @ x)
    return float(slope), float(np.sqrt(((y - slope * x) ** 2).sum() / (len(y) - len(beside) - 1) / (x @ x)))


def heights(path: Path) -> tuple[int, tuple[float, float], tuple[float, float]] | None:
    """Frames, the wave's height and the slope of the distances, each with its standard error."""
    truth = read_truth(truth_path(path))
    if len(truth.bars) != 1:
        return None
    (bar,) = truth.bars
    link = load_link(None, [f"modulation.id={bar.link.table['modulation']['id']}"])
    views = Views()
    receiver = Receiver([link], Registry.load(views).hook)
    with open_source(path) as source:
        for events in source.chunks():
            receiver.feed(events)
    receiver.close()
    measure = link.algorithm("ranging").compile(link.camera, link.bar, link.codebook)
    found = [(t_us, measure(view)) for t_us, view in views.found]
    found = [(t_us, one) for t_us, one in found if one.bend is not None and np.isfinite(one.sigma_m)]
    if len(found) < 10:
        return None
    squares, products, left, freedom = 0.0, 0.0, 0.0, 0
    for _, one in found:
        place, off, weight, wave = one.bend.place, one.bend.off, one.bend.weight, one.bend.wave
        use = weight > 0.1 * weight.max()
        root = np.sqrt(weight[use])
        basis = np.linalg.qr(np.stack([place**0, place, place**2], 1)[use] * root[:, None])[0]
        y, x = (v[use] * root - basis @ (basis.T @ (v[use] * root)) for v in (off, wave))
        squares, products, left = squares + x @ x, products + x @ y, left + y @ y
        freedom += int(use.sum()) - 3
    height = products / squares
    error = np.sqrt((left - height * products) / freedom / squares)
    chip_us = link.packet.chip_us
    t_us, distance_m, sigma_m, wave_m = np.array(
        [(t + one.late_chips * chip_us, one.distance_m, one.sigma_m, one.bend.wave_m) for t, one in found]
    ).T
    true_m = np.interp(t_us - truth.t0_us, truth.t_us, bar.distance_m)
    return (
        len(found),
        (height, error),
        fit(distance_m - true_m, wave_m, sigma_m**-2, np.ones((1, len(found)))),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    paths = parser.parse_args().recordings
    if not paths:
        paths = sorted([*SHARED.glob("*.raw"), *(SHARED / "road").glob("*.raw")])
        paths = [path for path in paths if not path.name.startswith(LEFT_OUT)]
    if not paths:
        sys.exit(f"no recordings in {SHARED}: name some")
    rows, both = [], []
    for path in paths:
        found = heights(path)
        if found is not None:
            frames, (height, height_error), (slope, slope_error) = found
            both.append((height, slope, slope_error))
            told = f"{height:+.3f} +- {height_error:.3f}", f"{slope:+.3f} +- {slope_error:.3f}"
            rows.append([path.stem, str(frames), *told])
    show(["recording", "frames", "height, px", "slope, px"], rows)
    height, slope, error = np.array(both).T
    share = (height * slope / error**2).sum() / (height**2 / error**2).sum()
    rest = np.sqrt(max(np.mean((slope - share * height) ** 2 - error**2), 0.0))
    print(f"{len(rows)} recordings: share {share:.2f}, off by {rest:.3f} px")


if __name__ == "__main__":
    main()
