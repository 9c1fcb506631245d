"""How far a bar's image points are off, by simulated drives, and the sigmas of `[position]` that say so.

    python benchmarks/points.py [--seeds 4] [--first 100] [--jobs 2] [--duration 0.25] [--keep FILE]

Drives past one upright bar, two, and three of which one lies above the road, at distances spread over those
of `examples/campaigns/position.toml` and by seeds that it does not have; and past two while the camera turns
at 45 degrees/s (`turning.toml`). At each time of a fix, the points that it would be computed from are
compared with where the clusters' middles are: by the image's shift, what all bars in view share of it and
what is a bar's own, and by its shape: stretch and lean, on which a pose hangs, and bends along and across.
Sigmas are fitted by maximum likelihood on drives with even seeds, and held against those with odd ones: the
mean of squares over variances is 1 where they hold. Errors of a drive are not independent of one another, so
intervals are by bootstrap over drives.

`--keep` keeps what was found in a file (NPY), and takes it from there. Four minutes of processor time.
"""

import argparse
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.points import SeenPoints, points_at
from evlcp_sdk.place.positioner import BarKind
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.sim import Simulation, load_scene
from evlcp_sdk.sim.motion import project
from evlcp_sdk.values import Frame

Floats = NDArray[np.float64]

LINK = load_link()
SCENES = {
    "one bar": ("one-bar", []),
    "two bars": ("gate", ['world.attitude="gravity"']),
    "three bars": ("portal", ['world.attitude="none"']),
    "by day": ("gate", ['world.attitude="gravity"', "background.light_w_m2=3.0"]),
    "no wings": ("gate", ['world.attitude="gravity"', "lens.wings=false"]),
    "turning": ("gate", ['world.attitude="gravity"', 'motion.path_file="turning.csv"']),
}
TURNING = ("turning",)
"""Scenes whose path says how far away they are."""
DISTANCES_M = (27.0, 31.0, 37.0, 43.0, 52.0, 59.0, 68.0, 78.0)
START = (0.05, 0.03, 0.05, 1e-4, 0.1, 4e-4, 12.0, 30.0)
NAMES = (
    "shaken_sigma_px", "shared_sigma_px", "shared_along_px", "shared_share", "pixel_sigma_px",
    "stretch_share", "early_sigma_us",
)  # fmt: skip
ALIKE = "all bars alike, us"
"""By how much a moving image is seen early, or late, in all bars: to a position, as if the camera had turned.
The last of the sigmas, and none of `[position]`."""
MODES = ("columns", "rows", "stretch", "lean", "bend along", "bend across")
ROW = [
    ("scene", "U12"),
    ("seed", int),
    ("drive", int),
    ("t_us", float),
    ("along", float, 2),
    ("length_px", float),
]
SIGMAS = [(name, float) for name in ("white_px", "pixel_px", "shift_px", "between", "early_px", "across_px")]
DTYPE = np.dtype([*ROW, *SIGMAS, ("modes_px", float, len(MODES))])
"""A bar at the time of a fix. Sigmas of a mode of sum of squares 1: `white_px` by frames, `pixel_px` by where
in a pixel it is, of a `pixel_sigma_px` of 1, `early_px` by how far the image moves in a microsecond; all
along the bar, and `across_px` across it, as is stated; `shift_px` is what frames do not show across the bar,
`between` that of `BarView`; `modes_px` are its errors, the shifts those of the mean."""


def rows_of(what: str, distance_m: float, seed: int, duration_s: float, drive: int) -> NDArray[np.void]:
    """All bars at all times of fixes of a drive, `DTYPE` (n,)."""
    base, sets = SCENES[what]
    motion = [f"duration_s={duration_s}"]
    if what not in TURNING:
        motion.append(f"motion.distance_m={distance_m}")
    scene = load_scene(f"examples/scenes/{base}.toml", [*motion, *sets])
    simulation = Simulation(scene, seed)
    receiver = Receiver(LINK)
    packets = [p for events in simulation.stream() for p in receiver.feed(events)] + receiver.close()
    frames: dict[int, list[Frame]] = {}
    for packet in packets:
        if packet.echo_of is None:
            frames.setdefault(packet.transmitter, []).extend(
                f for f in packet.frames if math.isfinite(f.points_t_us)
            )
    rows = []
    spec = ErrorModel(pixel_sigma_px=1.0, early_sigma_us=1.0)
    period_us, layout_m = BarKind.of(LINK).packet_us, LINK.bar.cluster_positions_m()
    for seen in frames.values():
        seen.sort(key=lambda frame: frame.points_t_us)
        first, last = seen[0].points_t_us, seen[-1].points_t_us
        for number in range(math.ceil(first / period_us), math.floor(last / period_us) + 1):
            t_us = number * period_us
            points = points_at(seen, t_us, period_us, layout_m, spec)
            if points is not None:
                stated = points_at(seen, t_us, period_us, layout_m, ErrorModel.of(LINK.position))
                assert stated is not None
                true_px = true_points(simulation, t_us, points.points_px)
                rows.append(row_of(points, stated, true_px, (what, seed, drive, t_us)))
    return np.array([row for row in rows if row is not None], DTYPE)


def true_points(simulation: Simulation, t_us: float, near_px: Floats) -> Floats:
    """The middles of the clusters of the bar that is nearest to points, px, float64 (K, 2)."""
    at = simulation.path.at([t_us - simulation.scene.t0_us])
    bars = []
    for bar in simulation.bars:
        cuts = bar.strips[0].strip.cuts_m()
        bars.append(project((cuts[1:] + cuts[:-1]) / 2, *at, simulation.scene.camera)[0][0])
    return min(bars, key=lambda bar: float(np.nanmean(np.linalg.norm(near_px - bar, axis=1))))


def row_of(
    points: SeenPoints, stated: SeenPoints, true_px: Floats, when: tuple[str, int, int, float]
) -> tuple[Any, ...] | None:
    """Of one bar at a time: `DTYPE`; None of one that is not seen whole.

    `points` are of sigmas of 1, and `stated` of those that are.
    """
    off = points.points_px - true_px
    if not np.isfinite(off).all():
        return None
    whole = true_px[-1] - true_px[0]
    along = whole / np.linalg.norm(whole)
    across = np.array([-along[1], along[0]])
    place = (true_px - true_px.mean(0)) @ along
    line = place / np.linalg.norm(place)
    bend = place**2 - (place**2).mean()
    bend -= (bend @ line) * line
    bend /= np.linalg.norm(bend)
    mean, a, b = off.mean(0), off @ along, off @ across
    white = points.sigma_px**2 - points.pixel_px**2
    clusters = len(off)
    length_px = float(np.linalg.norm(whole)) * clusters / (clusters - 1)
    modes = (*mean, line @ a, line @ b, bend @ a, bend @ b)
    return (
        *when,
        along,
        length_px,
        math.sqrt(white.mean()),
        points.pixel_px,
        points.shift_px,
        points.between,
        points.early_px,
        stated.across * math.sqrt((stated.sigma_px**2).mean()),
        modes,
    )


def variances(rows: NDArray[np.void], sigmas: Sequence[float] | Floats) -> Floats:
    """Of the `MODES` of a bar's shape, px^2, (n, 4), by `NAMES`."""
    *_, pixel, stretch, early, _ = sigmas
    each = rows["white_px"] ** 2 + (pixel * rows["pixel_px"]) ** 2 + (early * rows["early_px"]) ** 2
    # All points of a bar are off by a share of their places.
    longer = each + (stretch * rows["length_px"]) ** 2 * (LINK.bar.clusters / 12)
    return np.stack([longer, rows["across_px"] ** 2, each, rows["across_px"] ** 2], 1)


def own_shifts(rows: NDArray[np.void], sigmas: Sequence[float] | Floats) -> Floats:
    """Covariance of the shift that is a bar's own, px^2, (n, 2, 2), by `NAMES`."""
    _, across, along, share, pixel, _, early, _ = sigmas
    each = rows["white_px"] ** 2 + (pixel * rows["pixel_px"]) ** 2 + (early * rows["early_px"]) ** 2
    longways = rows["along"][:, :, None] * rows["along"][:, None]
    _, of = np.unique(rows[["drive", "t_us"]], return_inverse=True)
    moved = math.sqrt(2) * sigmas[0] * (rows["between"] - _means(rows["between"], of)[of])
    both = moved**2 + (early * rows["early_px"]) ** 2
    aside = across**2 + rows["shift_px"] ** 2 + both + rows["across_px"] ** 2 / LINK.bar.clusters
    more = along**2 + (share * rows["length_px"]) ** 2 + both + each / LINK.bar.clusters - aside
    return aside[:, None, None] * np.eye(2) + more[:, None, None] * longways


def _means(values: Floats, of: NDArray[np.intp]) -> Floats:
    return np.bincount(of, values) / np.bincount(of)


def common_px2(rows: NDArray[np.void], sigmas: Sequence[float] | Floats) -> Floats:
    """Variance of what all bars share at each time, px^2."""
    _, of = np.unique(rows[["drive", "t_us"]], return_inverse=True)
    shaken, early = sigmas[0] * _means(rows["between"], of), sigmas[-1] * _means(rows["early_px"], of)
    return np.asarray(shaken**2 + early**2)


def parted(
    rows: NDArray[np.void], sigmas: Sequence[float] | Floats
) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.bool_]]:
    """Shifts of bars at one time: what all have, and what each has besides.

    Returns:
        Of each time, the mean weighed by the bars' own covariances, (n, 2), and its covariance, (n, 2, 2); of
        each bar, what it differs from the mean, (m, 2), and the covariance of that, (m, 2, 2); which bars are
        not alone at their time, (m,).
    """
    own = own_shifts(rows, sigmas)
    _, of = np.unique(rows[["drive", "t_us"]], return_inverse=True)
    weight = np.linalg.inv(own)
    total = np.zeros((of.max() + 1, 2, 2))
    moment = np.zeros((of.max() + 1, 2))
    shifts = rows["modes_px"][:, :2]
    np.add.at(total, of, weight)
    np.add.at(moment, of, np.einsum("nij,nj->ni", weight, shifts))
    spread = np.linalg.inv(total)
    mean = np.einsum("nij,nj->ni", spread, moment)
    return (
        mean,
        spread + common_px2(rows, sigmas)[:, None, None] * np.eye(2),
        shifts - mean[of],
        own - spread[of],
        np.bincount(of)[of] > 1,
    )


def fitted(rows: NDArray[np.void], start: Sequence[float] | Floats) -> Floats:
    """The sigmas under which the errors of a normal distribution are the likeliest.

    A pose hangs on the shifts, the stretch and the lean; bends do not count, as they hardly change it.
    """

    def surprise(logs: Floats) -> float:
        sigmas = np.exp(logs)
        mean, of_mean, rest, _, _ = parted(rows, sigmas)
        own = own_shifts(rows, sigmas)
        # Errors of a group with a common part: the means', and what is left about them.
        shifts = np.einsum("ni,nij,nj->", rest, np.linalg.inv(own), rest)
        shifts += np.einsum("ni,nij,nj->", mean, np.linalg.inv(of_mean), mean)
        alone = of_mean - common_px2(rows, sigmas)[:, None, None] * np.eye(2)
        for covariance, sign in ((own, 1), (of_mean, 1), (alone, -1)):
            shifts += sign * np.linalg.slogdet(covariance)[1].sum()
        of = variances(rows, sigmas)[:, :2]
        shapes = np.log(of) + rows["modes_px"][:, 2:4] ** 2 / of
        return float(shifts + shapes.sum())

    return np.exp(
        minimize(
            surprise,
            np.log(start),
            method="Nelder-Mead",
            options={"maxiter": 6000, "maxfev": 6000, "adaptive": True},
        ).x
    )


def ratios(rows: NDArray[np.void], sigmas: Sequence[float] | Floats) -> Floats:
    """Mean squares over variances: what bars share, what each has across and along besides, shapes."""
    mean, of_mean, rest, of_rest, several = parted(rows, sigmas)
    common = np.einsum("ni,nij,nj->n", mean, np.linalg.inv(of_mean), mean).mean() / 2
    along = rows["along"]
    own = []
    for way in (np.stack([-along[:, 1], along[:, 0]], 1), along):
        of = np.einsum("ni,nij,nj->n", way, of_rest, way)
        squares = (rest * way).sum(1)[several] ** 2 / of[several]
        own.append(squares.mean() if len(squares) else math.nan)
    shapes = (rows["modes_px"][:, 2:] ** 2 / variances(rows, sigmas)).mean(0)
    return np.array([common, *own, *shapes])


def interval(
    rows: NDArray[np.void], of: Callable[[NDArray[np.void]], Floats], many: int = 200
) -> tuple[Floats, Floats]:
    """5 and 95 % of what is said of drives, by bootstrap over them."""
    rng = np.random.default_rng(1)
    drives = np.unique(rows["drive"])
    by = {drive: rows[rows["drive"] == drive] for drive in drives}
    draws = []
    for _ in range(many):
        some = [by[d].copy() for d in rng.choice(drives, len(drives))]
        for number, drive in enumerate(some):
            drive["drive"] = number  # Drawn twice, it is two.
        draws.append(of(np.concatenate(some)))
    low, high = np.quantile(draws, [0.05, 0.95], axis=0)
    return low, high


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--duration", type=float, default=0.25)
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    if given.keep is not None and given.keep.exists():
        told(np.load(given.keep))
        return
    drives = [
        (what, distance_m, seed)
        for what in SCENES
        for distance_m in (DISTANCES_M[:1] if what in TURNING else DISTANCES_M)
        for seed in range(given.first, given.first + given.seeds)
    ]
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        found = [pool.submit(rows_of, *drive, given.duration, number) for number, drive in enumerate(drives)]
        rows = np.concatenate([future.result() for future in found])
    if given.keep is not None:
        np.save(given.keep, rows)
    told(rows)


def told(rows: NDArray[np.void]) -> None:
    """Print what was found of all bars, `DTYPE` (n,)."""
    spec = LINK.position
    stated = [*(getattr(spec, name) for name in NAMES), 0.0]
    even = rows[rows["seed"] % 2 == 0]
    odd = rows[rows["seed"] % 2 == 1]
    best = fitted(even, START)
    low, high = interval(even, lambda some: fitted(some, best), 40)
    print("| sigma | stated | fitted | 5 to 95 % |")
    print("|---|---|---|---|")
    for name, now, then, least, most in zip([*NAMES, ALIKE], stated, best, low, high, strict=True):
        print(f"| `{name}` | {now:.4f} | {then:.4f} | {least:.4f} to {most:.4f} |")
    print()
    print("Root mean squares, px:")
    print("| bars | n | length | " + " | ".join(MODES) + " |")
    print("|---|---|---|" + "---|" * len(MODES))
    lies = abs(rows["along"][:, 0]) > math.sqrt(0.5)
    for lying in (False, True):
        for shortest, longest in ((0, 120), (120, 200), (200, 999)):
            long = (rows["length_px"] >= shortest) & (rows["length_px"] < longest)
            some = rows[(lies == lying) & long]
            if len(some):
                rms = np.sqrt((some["modes_px"] ** 2).mean(0))
                name = "lying" if lying else "upright"
                cells = " | ".join(f"{one:.3f}" for one in rms)
                print(f"| {name} | {len(some)} | {some['length_px'].mean():.0f} | {cells} |")
    print()
    print("Squares over variances, of drives that were not fitted:")
    print("| by | common shift | own, across | along | " + " | ".join(MODES[2:]) + " |")
    print("|---|" + "---|" * (len(MODES) + 1))
    for by, sigmas in (("stated", stated), ("fitted", best)):
        ends = zip(ratios(odd, sigmas), *interval(odd, lambda of, by=sigmas: ratios(of, by)), strict=True)
        cells = " | ".join(f"{one:.2f} ({least:.2f} to {most:.2f})" for one, least, most in ends)
        print(f"| {by} | {cells} |")
    print()
    print("Shifts by scene, px, and squares over variances by what is fitted:")
    print("| scene | n | columns | said by frames | common shift | own, across | along |")
    print("|---|---|---|---|---|---|---|")
    for scene in SCENES:
        some = rows[rows["scene"] == scene]
        columns, said = (some["modes_px"][:, 0] ** 2).mean() ** 0.5, (some["shift_px"] ** 2).mean() ** 0.5
        cells = " | ".join(f"{one:.2f}" for one in ratios(some, best)[:3])
        print(f"| {scene} | {len(some)} | {columns:.3f} | {said:.3f} | {cells} |")


if __name__ == "__main__":
    main()
