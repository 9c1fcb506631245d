"""What a road adds, and where it breaks the receiver: the figures and the tables of docs/road.md.

    python docs/figures/road.py                 draws road-scenes.png: what each condition looks like
    python docs/figures/road.py road.sqlite     draws road.png and prints the tables, from what
                                                      evlcp sweep examples/campaigns/road.toml -o road.sqlite
                                                      has found

A step of a condition holds where the receiver finds 95 % of the frames, reads 99.9 % of the bits of visible
clusters that it gives, claims not more than 2 % of the hidden ones, has not more than 2 % of frames too many
(ghosts), and measures distances to 0.25 % of the distance (rms); it is lost where less than half of the
frames are found or more than a tenth of the bits is wrong; else it suffers.
"""

import argparse
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from evlcp_sdk.sim import Scene, Simulation, truth_of
from evlcp_sdk.study.store import Store
from evlcp_sdk.study.summary import summarize
from evlcp_sdk.study.tally import Statistics, Tally
from evlcp_sdk.study.task import plan_campaign
from evlcp_sdk.values import Events

ROOT = Path(__file__).parents[2]
CAMPAIGN = ROOT / "examples" / "campaigns" / "road.toml"
ON, OFF, INK, PAPER = "#d55e00", "#0072b2", "#222222", "#ffffff"
COLOURS = {"holds": "#b6d7f0", "suffers": "#f7dc9c", "lost": "#d98a84"}

FOUND, WRONG, CLAIMED, GHOSTS, RANGING = 0.95, 1e-3, 0.02, 0.02, 0.0025
"""What holds: see above."""

LOST_FRAMES, LOST_BITS = 0.5, 0.1


@dataclass(frozen=True)
class Step:
    """One step of a condition, received by one link."""

    found: float
    ber: float
    claimed: float
    ghosts: float
    rmse_m: float
    nees: float
    distance_m: float

    @classmethod
    def of(cls, statistics: Statistics) -> "Step":
        """The figures of a series."""
        total: Tally = statistics.total()
        far = sum((start + 5) * tally.frames_sent for start, tally in statistics.segments.items())
        return cls(
            total.frames_found / max(total.frames_sent, 1),
            total.ber,
            total.claimed_share,
            # One a recording is the frame that its end cuts.
            max(statistics.unmatched - statistics.tasks, 0) / max(total.frames_sent, 1),
            total.rmse_m,
            total.nees,
            far / max(total.frames_sent, 1),
        )

    @property
    def verdict(self) -> str:
        """Whether it holds, suffers or is lost."""
        if self.found < LOST_FRAMES or not self.ber <= LOST_BITS:
            return "lost"
        kept = (
            self.found >= FOUND,
            self.ber <= WRONG,
            not self.claimed > CLAIMED,
            self.ghosts <= GHOSTS,
            self.rmse_m <= RANGING * self.distance_m,
        )
        return "holds" if all(kept) else "suffers"

    @property
    def text(self) -> str:
        """Frames found, wrong bits, distance RMSE, and what else is amiss."""
        if self.found == 0:
            return "no frame" + (f"\n{self.ghosts:.0%} ghosts" if self.ghosts > 0 else "")
        parts = [f"{self.found:.0%}  {_share(self.ber)}", f"{_metres(self.rmse_m)}"]
        if self.claimed > CLAIMED:
            parts[1] += f"  claims {self.claimed:.0%}"
        elif self.ghosts > GHOSTS:
            parts[1] += f"  {self.ghosts:.0%} ghosts"
        return "\n".join(parts)


def _share(share: float) -> str:
    if share == 0 or not math.isfinite(share):
        return "0" if share == 0 else "-"
    return f"{share:.0e}".replace("e-0", "e-") if share < 0.01 else f"{share:.2f}".lstrip("0")


def _metres(rmse_m: float) -> str:
    if not math.isfinite(rmse_m):
        return "no distance"
    return f"{rmse_m:.2g} m" if rmse_m < 10 else f"{rmse_m:.0f} m"


def steps_of(results: Path) -> dict[str, dict[str, dict[str, Step]]]:
    """What was found, by link, condition and step, in the campaign's order."""
    with Store(results) as store:
        summary = summarize(store)
    if summary.done < summary.tasks:
        print(f"{summary.done} of {summary.tasks} tasks are done")
    found: dict[str, dict[str, dict[str, Step]]] = {}
    for series in summary.series:
        condition, _, step = str(series.labels["scene.variant"]).partition(": ")
        by_link = found.setdefault(str(series.labels["link.variant"]), {})
        by_link.setdefault(condition, {})[step] = Step.of(series.statistics)
    return found


def draw_verdicts(found: Mapping[str, Mapping[str, Mapping[str, Step]]], path: Path) -> None:
    """One row a condition, one box a step, one half of the figure a link."""
    conditions = next(iter(found.values()))
    most = max(len(steps) for steps in conditions.values())
    figure = Figure(figsize=(13, 0.52 * len(conditions) + 1.3), layout="constrained")
    axes = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for axis, (link, rows) in zip(axes, found.items(), strict=True):
        for i, steps in enumerate(rows.values()):
            for j, (name, step) in enumerate(steps.items()):
                axis.add_patch(
                    Rectangle((j + 0.02, i + 0.05), 0.96, 0.9, color=COLOURS[step.verdict], linewidth=0)
                )
                axis.text(j + 0.06, i + 0.12, name, fontsize=6.8, color=INK, va="top", weight="bold")
                axis.text(j + 0.06, i + 0.4, step.text, fontsize=6.5, color=INK, va="top", linespacing=1.25)
        axis.set(xlim=(0, most), ylim=(len(rows), 0), xticks=[])
        axis.set_yticks(np.arange(len(rows)) + 0.5, list(rows), fontsize=9)
        axis.tick_params(length=0)
        axis.set_title(f"{link} link", loc="left", fontsize=11, color=INK)
        for side in axis.spines.values():
            side.set_visible(False)
    handles = [Rectangle((0, 0), 1, 1, color=colour) for colour in COLOURS.values()]
    figure.legend(
        handles, list(COLOURS), loc="outside lower left", ncols=3, frameon=False, fontsize=9,
        title="in each box: frames found, share of wrong bits, distance RMSE", title_fontsize=9,
        alignment="left",
    )  # fmt: skip
    figure.savefig(path, dpi=110)


def print_tables(found: Mapping[str, Mapping[str, Mapping[str, Step]]]) -> None:
    """Up to where each link holds, and every figure."""
    links = list(found)
    print("| condition |" + "".join(f" {link}: holds | suffers | lost |" for link in links))
    print("|---|" + "---|---|---|" * len(links))
    for condition in found[links[0]]:
        cells = []
        for link in links:
            steps = found[link][condition]
            for verdict in COLOURS:
                cells.append(
                    ", ".join(name for name, step in steps.items() if step.verdict == verdict) or "-"
                )
        print(f"| {condition} | " + " | ".join(cells) + " |")
    print()
    print(
        "| condition | step |"
        + "".join(f" {link}: frames | BER | claimed | ghosts | RMSE m | NEES |" for link in links)
    )
    print("|---|---|" + "---|---|---|---|---|---|" * len(links))
    for condition, steps in found[links[0]].items():
        for name in steps:
            cells = []
            for link in links:
                step = found[link][condition][name]
                cells += [
                    f"{step.found:.1%}",
                    "-" if math.isnan(step.ber) else f"{step.ber:.2g}",
                    "-" if math.isnan(step.claimed) else f"{step.claimed:.1%}",
                    f"{step.ghosts:.1%}" if step.ghosts else "0",
                    "-" if math.isnan(step.rmse_m) else f"{step.rmse_m:.3f}",
                    "-" if math.isnan(step.nees) else f"{step.nees:.2g}",
                ]
            print(f"| {condition} | {name} | " + " | ".join(cells) + " |")


def draw_scenes(scenes: Sequence[tuple[str, Scene]], path: Path, window_us: int = 4000) -> None:
    """Events of some milliseconds of each scene, ON red, OFF blue, in the middle of what happens in it."""
    columns = 7
    figure = Figure(figsize=(13, 2.75 * math.ceil(len(scenes) / columns)), layout="constrained")
    axes = figure.subplots(math.ceil(len(scenes) / columns), columns, squeeze=False).ravel()
    for axis in axes[len(scenes) :]:
        axis.set_visible(False)
    for axis, (name, scene) in zip(axes, scenes, strict=False):
        events = Events.concat(Simulation(scene).stream())
        end_us = int(scene.duration_s * 1e6)
        events = events[events.t_us >= end_us - window_us]
        x, y = (float(v) for v in truth_of(scene).bars[0].centre_px[-1 - window_us // 2000])
        half = max(60.0, 0.48 / scene.motion.distance_m * scene.camera.focal_px * 1.6)
        image = np.zeros((2, scene.camera.height, scene.camera.width))
        np.add.at(image, (events.p, events.y, events.x), 1)
        strength = 1 - np.exp(-image / 8)
        # ON takes away what is not red, OFF what is not blue.
        colour = np.ones((*image.shape[1:], 3))
        for layer, shade in zip(strength, (OFF, ON), strict=True):
            ink = np.array([int(shade[i : i + 2], 16) / 255 for i in (1, 3, 5)])
            colour *= 1 - layer[..., None] * (1 - ink)
        axis.imshow(colour, interpolation="nearest", aspect="equal")
        axis.set(
            xlim=(x - half * 0.75, x + half * 0.75),
            ylim=(y + 1.3 * half, y - 0.9 * half),
            xticks=[],
            yticks=[],
        )
        axis.set_title("\n".join(textwrap.wrap(name, 24)), fontsize=8, loc="left", color=INK)
    figure.savefig(path, dpi=110)


def scenes_to_show() -> list[tuple[str, Scene]]:
    """The third step of each condition, cut in the middle of what happens in it."""
    found: dict[str, list[tuple[str, Scene]]] = {}
    for case in plan_campaign(CAMPAIGN).scenes:
        name = str(case.labels["variant"])
        found.setdefault(name.partition(": ")[0], []).append((name, case.value))
    scenes = []
    for steps in found.values():
        name, scene = steps[min(2, len(steps) - 1)]
        until_s = {"truck": 0.06, "wiper": 0.072, "pothole": 0.064}.get(name.partition(": ")[0], 0.02)
        scenes.append((name, replace(scene, duration_s=until_s)))
    return scenes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("results", type=Path, nargs="?", help="what evlcp sweep has written")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "docs" / "images")
    args = parser.parse_args()
    if args.results is None:
        draw_scenes(scenes_to_show(), args.out / "road-scenes.png")
        return
    found = steps_of(args.results)
    draw_verdicts(found, args.out / "road.png")
    print_tables(found)


if __name__ == "__main__":
    main()
