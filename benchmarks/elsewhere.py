"""The conditions of `benchmarks/road.toml` at other places: nearer, farther, to other sides, with other bits.

    python benchmarks/elsewhere.py [--only NAME ...] [--seeds 2] [--first 1] [--near 0.86] [--far 1.17]
        [--keep FOLDER] [--frames] [--level]

Each road recording that the receiver is held against has its like here, rendered by the simulator: the same
kind of thing happens, but a tenth to a sixth nearer (even seeds) or farther (odd ones), and speed, the bar's
place in the image, its clock and payload, and what the condition is made of (reflections, covers, panels,
blindness) are drawn anew by the seed. Figures to reach are those of the recording; that of the distance grows
with its square. The last conditions are mixtures, which have no figures of their own: there must be no ghost,
and a warning where half of a bar's frames or more are missing. Received by the default link.

`--keep` keeps the recordings and results, and takes recordings that are there; `--frames` prints frames.
`--level` tells the receiver that the camera is level, to 0.02 degrees, which all but the pitched ones are. A
minute of processor time. The exit code is 1 where a figure is missed.
"""

import argparse
import math
import sys
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from road import TARGETS, cells_of, missed, number, show, targets_of
from scipy.stats import chi2

import evlcp_sdk as evlcp
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.sim import read_truth, resolve_scene, truth_path
from evlcp_sdk.study.frames import GivenFrame, read_frames
from evlcp_sdk.study.match import match
from evlcp_sdk.study.score import Score
from evlcp_sdk.study.tally import Statistics

Table = dict[str, Any]

LINK = load_link()
LEVEL = Attitude(0.0, 0.0, gravity_sigma_deg=0.02)
FOCAL_PX, BAR_M = LINK.camera.focal_px, LINK.bar.length_m


@dataclass(frozen=True)
class Draft:
    """A scene as it is drawn up: its table so far, the numbers that it is drawn by, and its distance."""

    table: Table
    rng: np.random.Generator
    distance_m: float

    @property
    def bar(self) -> Table:
        """The first bar's table."""
        return self.table["bars"][0]

    def between(self, low: float, high: float) -> float:
        """Draw a number."""
        return round(float(self.rng.uniform(low, high)), 6)

    def sign(self) -> float:
        """Draw 1 or -1."""
        return float(self.rng.choice([-1, 1]))


Add = Callable[[Draft], None]
"""Lays what happens over a clean scene."""


@dataclass(frozen=True)
class Condition:
    """What happens in a scene.

    Attributes:
        distance_m: That of the recording that it is like.
        duration_s: Of a scene.
        add: Lays what happens over a clean scene, at its distance.
        like: The recording whose figures it is held against; none: those of every recording.
    """

    distance_m: float
    duration_s: float
    add: Add
    like: str = ""


def clean(draft: Draft, duration_s: float) -> None:
    """A drive by day in the shade, as the independent recordings have it: sensor, vibration, one bar."""
    draft.table["duration_s"] = duration_s
    draft.table["motion"] = {
        "distance_m": round(draft.distance_m, 3),
        "speed_mps": draft.between(5, 14),
        "vib_rate_rad_s": 0.06,
        "vib_yaw_share": 0.5,
    }
    draft.table["background"] = {"light_w_m2": 0.3, "texture": 0.3}
    draft.table["sensor"] = {"jitter_us": 4.0, "refr_us": 20.0}
    draft.table["bars"] = [
        {
            # Within a third of the image's half width and height.
            "x_m": round(draft.distance_m / 50 * draft.between(-1.5, 1.5), 3),
            "y_m": round(draft.distance_m / 50 * draft.between(-0.7, 0.7), 3),
            "ppm": draft.between(-40, 40),
            "start_chip": draft.between(0, 345),
        }
    ]


def near_by(draft: Draft) -> None:
    """The bar is taller than half of the image: it stays in it."""
    draft.bar.update(x_m=draft.between(-0.9, 0.9), y_m=draft.between(-0.1, 0.1))


def rail(draft: Draft) -> None:
    shift = draft.between(22, 40) * draft.sign()
    draft.table["reflections"] = [
        {"kind": "window", "share": draft.between(0.12, 0.3), "shift_px": [round(float(shift), 2), 0.0]}
    ]


def wet(gap_m: tuple[float, float]) -> Add:
    def add(draft: Draft) -> None:
        draft.table["reflections"] = [
            {
                "share": draft.between(0.15, 0.3),
                "gap_m": draft.between(*gap_m),
                "blur_px": draft.between(0.4, 0.9),
            }
        ]

    return add


def another(draft: Draft, x_m: float, y_m: float) -> None:
    bar = draft.bar
    more = {
        "ppm": draft.between(-40, 40),
        "start_chip": draft.between(0, 345),
        "seed": int(draft.rng.integers(1 << 30)),
    }
    draft.table["bars"].append({"x_m": round(bar["x_m"] + x_m, 4), "y_m": round(bar["y_m"] + y_m, 4), **more})


def beside_it(draft: Draft) -> None:
    another(draft, draft.between(18, 27) * draft.distance_m / FOCAL_PX, 0.0)


def above_it(draft: Draft) -> None:
    another(draft, 0.0, -BAR_M - draft.between(9, 16) * draft.distance_m / FOCAL_PX)


def bracket(draft: Draft) -> None:
    first = int(draft.rng.integers(1, 11))
    lone = int(draft.rng.choice([k for k in range(16) if abs(k - first - 1) > 2]))
    draft.bar["covered"] = sorted([first, first + 1, first + 2, lone])


def truck(draft: Draft) -> None:
    draft.bar["cover_s"] = [
        [draft.between(0.05, 0.09), draft.between(0.15, 0.19), int(draft.rng.integers(8, 12)), 15]
    ]


def wiper(draft: Draft) -> None:
    draft.table["wiper"] = {
        "share": draft.between(0.93, 0.97),
        "at_s": draft.between(0.05, 0.11),
        "lasts_s": 0.03,
    }


def foliage(draft: Draft) -> None:
    draft.table["background"] = {
        "light_w_m2": 2.0,
        "texture": draft.between(0.7, 1.0),
        "texture_px": draft.between(3, 6),
        "texture_step_px": 0.4,
        "around_px": 60,
    }
    draft.bar["led_w_m2"] = 12.0
    draft.table["motion"]["vib_rate_rad_s"] = 0.1


def panel(hz: tuple[float, float], light_w_m2: float) -> Add:
    def add(draft: Draft) -> None:
        bar, px = draft.bar, draft.distance_m / FOCAL_PX
        draft.table["lamps"] = [
            {
                "x_m": round(bar["x_m"] + draft.between(-6, 6) * px, 4),
                "y_m": round(bar["y_m"] + draft.between(-30, 30) * px, 4),
                "width_m": draft.between(32, 48) * px,
                "height_m": draft.between(32, 48) * px,
                "light_w_m2": light_w_m2 * draft.between(0.8, 1.25),
                "flicker_hz": draft.between(*hz),
                "phase": draft.between(0, 0.99),
            }
        ]

    return add


def refractory(draft: Draft) -> None:
    draft.table["sensor"]["refr_us"] = draft.between(120, 150)


def low_sun(draft: Draft) -> None:
    draft.table["background"]["light_w_m2"] = 11.0
    draft.bar["led_w_m2"] = 9.0


def pothole(draft: Draft) -> None:
    draft.table["motion"] |= {
        "pothole_s": [draft.between(0.04, 0.1)],
        "pothole_rad_s": float(draft.between(0.85, 1.05) * draft.sign()),
    }


def rate_cap(draft: Draft) -> None:
    draft.table["sensor"]["cap_mev_s"] = 3.0


def pitch(draft: Draft) -> None:
    up_deg = draft.between(3, 5) * draft.sign()
    draft.table["motion"]["pitch_deg"] = round(up_deg, 3)
    draft.bar["y_m"] = round(-draft.distance_m * math.tan(math.radians(up_deg)), 3)


def off_missing(draft: Draft) -> None:
    draft.table["sensor"]["p_off_miss"] = 0.95


def bloom(draft: Draft) -> None:
    draft.table["lens"] = {"bloom": draft.between(0.15, 0.25), "bloom_px": draft.between(10, 15)}


def yaw(draft: Draft) -> None:
    draft.table["background"] |= {"texture": 0.4, "texture_px": 4.0}
    draft.table["motion"] |= {"vib_yaw_share": 1.0, "vib_rate_rad_s": draft.between(0.06, 0.1)}


def guesses(vib_rate_rad_s: float) -> Add:
    def add(draft: Draft) -> None:
        draft.table["sensor"] |= {"refr_us": draft.between(58, 66), "p_on_miss": 0.2, "p_off_miss": 0.5}
        draft.table["lens"] = {"halo": 0.03}
        draft.table["motion"]["vib_rate_rad_s"] = vib_rate_rad_s

    return add


def together(*parts: Add) -> Add:
    def add(draft: Draft) -> None:
        for part in parts:
            part(draft)

    return add


def hidden_end(draft: Draft) -> None:
    draft.bar["covered"] = list(range(4)) if draft.rng.random() < 0.5 else list(range(12, 16))


CONDITIONS: Mapping[str, Condition] = {
    "rail-reflection-40m": Condition(40, 0.15, rail),
    "rail-reflection-55m": Condition(55, 0.15, rail),
    "wet-road-45m": Condition(45, 0.15, wet((0.06, 0.16))),
    "wet-road-80m": Condition(80, 0.15, wet((0.5, 0.9))),
    "two-bars-22px-60m": Condition(60, 0.15, beside_it),
    "stacked-12px-55m": Condition(55, 0.15, above_it),
    "bracket-45m": Condition(45, 0.15, bracket),
    "truck-55m": Condition(55, 0.22, truck),
    "wiper-60m": Condition(60, 0.18, wiper),
    "foliage-45m": Condition(45, 0.15, foliage),
    "panel-1khz-55m": Condition(55, 0.15, panel((850, 1300), 1.2)),
    "panel-4khz-45m": Condition(45, 0.15, panel((3400, 4600), 0.8)),
    "refractory-140us-45m": Condition(45, 0.15, refractory),
    "low-sun-45m": Condition(45, 0.15, low_sun),
    "pothole-40m": Condition(40, 0.18, pothole),
    "rate-cap-3mev-50m": Condition(50, 0.15, rate_cap),
    "pitch-4deg-45m": Condition(45, 0.18, pitch),
    "near-16m": Condition(16, 0.08, near_by),
    "far-180m": Condition(180, 0.2, together()),
    "off-missing-95-50m": Condition(50, 0.15, off_missing),
    "bloom-40m": Condition(40, 0.15, bloom),
    "clean-yaw-66m": Condition(66, 0.15, yaw),
    "clean-yaw-44m-50kmh": Condition(44, 0.15, yaw),
    "guesses-62us-55m": Condition(55, 0.18, guesses(0.06)),
    "guesses-62us-shaking-90m": Condition(90, 0.18, guesses(0.15)),
    "foliage and a hidden end": Condition(45, 0.15, together(foliage, hidden_end), "foliage-45m"),
    "neighbour and wet road": Condition(55, 0.15, together(beside_it, wet((0.06, 0.16)))),
    "wiper and lively yaw": Condition(60, 0.18, together(wiper, yaw)),
    "pothole and side window": Condition(45, 0.15, together(pothole, rail)),
    "truck and panel": Condition(55, 0.2, together(truck, panel((850, 1300), 1.2))),
    "stacked and bloom": Condition(45, 0.15, together(above_it, bloom)),
    "low sun and bracket": Condition(35, 0.15, together(low_sun, bracket)),
    "guesses and wet road": Condition(55, 0.18, together(guesses(0.06), wet((0.06, 0.16)))),
}


def drafted(name: str, seed: int, near: float, far: float) -> Draft:
    """The scene of a condition at another place."""
    condition = CONDITIONS[name]
    rng = np.random.default_rng([seed, *name.encode()])
    farther = rng.uniform(1.1, far) if seed % 2 else rng.uniform(near, 0.92)
    draft = Draft({}, rng, condition.distance_m * round(float(farther), 6))
    clean(draft, condition.duration_s)
    condition.add(draft)
    return draft


def rendered(name: str, seed: int, folder: Path, near: float, far: float) -> tuple[Path, float]:
    """The recording of a scene, and its distance."""
    draft = drafted(name, seed, near, far)
    path = folder / f"{name.replace(' ', '-')}-{seed}.raw"
    if not truth_path(path).is_file():
        evlcp.simulate(resolve_scene({"name": path.stem, **draft.table}), seed).save(path)
    return path, draft.distance_m


HEAD = [
    *(
        "condition",
        "seed",
        "m",
        "frames",
        "BER",
        "erased",
        "claimed",
        "ranged",
        "RMSE, m",
        "bias",
        "worst",
        "NEES",
    ),
    *("ghosts", "echoes", "missed", "warnings"),
]


def lines_of(
    name: str, seed: int, folder: Path, args: argparse.Namespace
) -> tuple[list[list[str]], list[Statistics]]:
    """The rows of a scene, one a bar, and what was counted of each."""
    path, distance_m = rendered(name, seed, folder, args.near, args.far)
    truth, out = read_truth(truth_path(path)), folder / f"{path.stem}-out"
    summary = receive_to_folder(path, out, LINK, attitude=LEVEL if args.level else None)
    frames = read_frames(out)
    score = Score.of(frames, truth, road=True)
    if args.frames:
        print_frames(frames, truth)
    condition, table = CONDITIONS[name], tomllib.loads(TARGETS.read_text())
    rows = []
    for i, bar in enumerate(score.bars):
        tally = bar.total()
        targets = targets_of(table, condition.like or name, i)
        for key in ("rmse_m", "worst_m"):
            if key in targets:
                targets[key] = round(targets[key] * max(1.0, distance_m / condition.distance_m) ** 2, 4)
        words = missed(tally, score.unmatched if i == 0 else 0, targets)
        warnings = [warning["code"] for warning in summary["warnings"]]
        if "found" not in targets and 2 * tally.frames_found <= tally.frames_sent and not warnings:
            words.append("silence")
        rows.append(
            [
                name if i == 0 else f"  bar {i}",
                str(seed) if i == 0 else "",
                f"{distance_m:.1f}" if i == 0 else "",
                f"{tally.frames_found}/{tally.frames_sent}",
                *cells_of(tally, targets),
                number(tally.worst_m),
                number(tally.nees, 2),
                str(score.unmatched) if i == 0 else "",
                str(score.echoes) if i == 0 else "",
                ", ".join(words) or "none",
                " ".join(warnings) if i == 0 else "",
            ]
        )
    return rows, list(score.bars)


def print_frames(frames: Sequence[GivenFrame], truth: Any) -> None:
    """Every frame that is off: when it began, its wrong bits and symbols not given, its distance's error."""
    matched = match(frames, truth)
    for i, (sent, pairs) in enumerate(zip(matched.bars, matched.pairs, strict=True)):
        lost = sorted(set(range(len(sent.start_us))) - {n for _, n in pairs})
        print(f"bar {i}: lost at", *(f"{sent.start_us[n] / 1e3:.1f}" for n in lost), "ms")
        for frame, n in pairs:
            said = np.array(frame.symbols)
            wrong, missing = ((said >= 0) & (said != sent.symbols[n]), said < 0)
            wrong, missing = wrong & ~sent.cut[n], missing & ~sent.cut[n]
            error_m = frame.distance_m - sent.distance_m[n]
            print(
                f"{sent.start_us[n] / 1e3:6.1f} ms, wrong {wrong.sum():2d}, erased {missing.sum():2d},"
                f" error {error_m:+.3f} m, {error_m / frame.sigma_m:+.1f} sigma of {frame.sigma_m:.3f}"
            )


def within(blocks: float, low: float = 0.5, high: float = 2.0) -> float:
    """Probability that the NEES of a recording of honest sigmas is within bounds.

    With so many errors in it that are independent of each other, and normal, it is chi-square over their
    number: 0.32 of a single standing one, 0.98 of two dozens.
    """
    return float(chi2.cdf(high * blocks, blocks) - chi2.cdf(low * blocks, blocks))


def honest(nees: Sequence[float]) -> str:
    """What the NEES of recordings says of their sigmas: its mean, its spread, and how many it explains."""
    values = np.array([value for value in nees if math.isfinite(value)])
    if len(values) < 2:
        return "too few"
    drawn = np.random.default_rng(0).choice(values, (1000, len(values))).mean(1)
    low, high = np.quantile(drawn, [0.025, 0.975])
    # The variance of chi-square over n is 2 / n.
    blocks = 2 * values.mean() ** 2 / values.var(ddof=1)
    share = float(((values >= 0.5) & (values <= 2)).mean())
    mean = float(values.mean())
    return (
        f"mean {mean:.2f} ({low:.2f} to {high:.2f}) of {len(values)}, spread as of {blocks:.1f} errors;"
        f" {share:.0%} within 0.5 to 2, {within(blocks, 0.5 / mean, 2 / mean):.0%} by the closed form"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--near", type=float, default=0.86)
    parser.add_argument("--far", type=float, default=1.17)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--frames", action="store_true")
    parser.add_argument("--level", action="store_true")
    args = parser.parse_args()
    rows: list[list[str]] = []
    total: list[Statistics] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for name in CONDITIONS:
            if args.only and not any(word in name for word in args.only):
                continue
            for seed in range(args.first, args.first + args.seeds):
                more, bars = lines_of(name, seed, folder, args)
                print("\n".join(" ".join(row) for row in more), file=sys.stderr, flush=True)
                rows += more
                total += bars
    show(HEAD, rows)
    tally = sum(total, Statistics()).total()
    misses = sum(row[-2] != "none" for row in rows)
    print(
        f"{tally.frames_found} of {tally.frames_sent} frames, BER {number(tally.ber, 5)}, erased"
        f" {number(tally.erased_share)}, RMSE {number(tally.rmse_m)} m, NEES {number(tally.nees, 2)};"
        f" {misses} of {len(rows)} lines miss a figure"
    )
    nees = [(row[0], bar.total().nees) for row, bar in zip(rows, total, strict=True)]
    print("NEES, level:", honest([value for name, value in nees if not name.startswith("pitch")]))
    print("NEES, pitched:", honest([value for name, value in nees if name.startswith("pitch")]))
    sys.exit(misses > 0)


if __name__ == "__main__":
    main()
