"""How near the default ranging comes to the Cramer-Rao bound of each frame, recording by recording.

    python benchmarks/bound.py [RECORDING ...]

Without names, all recordings of one bar in `../shared/recordings/road` and one folder up. Printed are the
RMSE of the default link, the row `Cramer-Rao bound` of `evlcp compare`, their ratio, and by how much it may
be off by chance (1/sqrt(2n) of it for n frames whose errors are independent; they are less so). 15 seconds.
"""

import argparse
import math
import sys
from pathlib import Path
from statistics import median

from road import SHARED, show

from evlcp_sdk.io.open import open_source
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.sim import read_truth, truth_path
from evlcp_sdk.study.compare.run import measure_recording
from evlcp_sdk.study.compare.variants import load_variants


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    paths = parser.parse_args().recordings or sorted(
        [*SHARED.glob("*.raw"), *(SHARED / "road").glob("*.raw")]
    )
    if not paths:
        sys.exit(f"no recordings in {SHARED}: name some")
    registry = Registry.load()
    rows, ratios = [], []
    for path in paths:
        truth = read_truth(truth_path(path))
        if len(truth.bars) != 1:
            continue
        modulation = truth.bars[0].link.table["modulation"]["id"]
        variants = load_variants(["default:"], None, [f"modulation.id={modulation}"])
        table = measure_recording(path.stem, lambda path=path: open_source(path, registry), variants, truth)
        rmse_m, bound_m = table.rows[0].measured.tally.rmse_m, table.bound_m.rms
        frames = table.bound_m.count
        if not frames:
            rows.append([path.stem, "0", f"{rmse_m:.4f}", "-", "-", "-"])
            continue
        ratio = rmse_m / bound_m
        ratios.append(ratio)
        chance = ratio / math.sqrt(2 * frames)
        rows.append(
            [path.stem, str(frames), f"{rmse_m:.4f}", f"{bound_m:.4f}", f"{ratio:.2f}", f"{chance:.2f}"]
        )
    show(["recording", "frames", "RMSE, m", "bound, m", "ratio", "by chance"], rows)
    print(f"{len(ratios)} recordings: {min(ratios):.2f} to {max(ratios):.2f}, median {median(ratios):.2f}")


if __name__ == "__main__":
    main()
