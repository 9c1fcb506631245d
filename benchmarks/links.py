"""How other codes and layouts are received: frames, wrong bits, and what their distances are worth.

    python benchmarks/links.py [--at 50] [--seeds 2] [--seconds 0.2] [--only NAME ...]

Each link is simulated by night (preset `night`: a car at 30 km/h, with vibration), received and scored. NEES
is the mean of (error / sigma)^2, 1 for true sigmas. Frames are those found of those that were wholly on air;
symbols that are not given count as erased, not as wrong. The last rows are recordings with two kinds of
transmitter in view.
"""

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import evlcp_sdk as evlcp
from evlcp_sdk.link.several import named_links
from evlcp_sdk.run import receive
from evlcp_sdk.sim import load_scene
from evlcp_sdk.sim.truth import read_truth
from evlcp_sdk.study.frames import frames_of
from evlcp_sdk.study.match import match
from evlcp_sdk.study.measure import bar_tallies
from evlcp_sdk.study.tally import Tally

_PANEL = [
    "bar.rows=16",
    "bar.columns=16",
    "bar.led_pitch_m=0.02",
    "bar.cluster_rows=4",
    "bar.cluster_columns=4",
]
_DIMMED = ["modulation.id=wh4x2-dimmed", "pilots.id=wh-dimmed"]
LINKS: dict[str, list[str]] = {
    "the default": [],
    "NRZ, 8b/10b-like codewords": ["modulation.id=nrz"],
    "4-PPM": ["modulation.id=ppm"],
    "25 % dimmed pair codes": _DIMMED,
    "ring of 12 LEDs": ["bar.shape=ring"],
    "two columns, .5 m apart": ["bar.shape=columns"],
    "two columns, 1.2 m apart": ["bar.shape=columns", "bar.apart_m=1.2", "bar.rows=24"],
    "two columns, 4 cm apart": [
        "bar.rows=24",
        "bar.columns=2",
        "bar.led_pitch_m=0.04",
        "bar.cluster_rows=3",
    ],
    "panel of 4 x 4 clusters": _PANEL,
    "the same panel, NRZ": [*_PANEL, "modulation.id=nrz"],
    "the same panel, dimmed": [*_PANEL, *_DIMMED],
}
PAIRS: dict[str, tuple[list[str], list[str]]] = {
    "a bar, and one of wh8 beside": ([], ["modulation.id=wh8"]),
    "a bar, and one of 5000 chips/s beside": ([], ["air.chip_rate_hz=5000.0"]),
}
HEAD = "| link | m | frames | wrong bits | erased | RMSE m | bias m | NEES |"


def simulated(path: Path, links: Sequence[evlcp.Link], distance_m: float, seconds: float, seed: int) -> None:
    """Render one bar of each link, side by side."""
    settings = {"duration_s": seconds, "motion.distance_m": distance_m}
    scene = load_scene("night", settings, link=links[0])
    if len(links) > 1:
        tables = [{part: dict(keys) for part, keys in one.table.items()} for one in links]
        bars = [replace(scene.bars[0], x_m=3.0 * i - 1.5, link=table) for i, table in enumerate(tables)]
        scene = replace(scene, bars=tuple(bars))
    evlcp.simulate(scene, seed).save(path)


def scored(path: Path, links: Sequence[evlcp.Link]) -> list[Tally]:
    """What was found of each bar, in the order of the links."""
    truth = read_truth(path.with_suffix(".truth.json"))
    with receive(path, links) as packets:
        frames = frames_of(packets)
    found = match(frames, truth, links=named_links(links) if len(links) > 1 else None)
    assert found.unmatched == 0, f"{path}: {found.unmatched} frames that nobody sent"
    return [
        sum((tally for _, tally in bar_tallies(*one)), Tally())
        for one in zip(found.bars, found.pairs, strict=True)
    ]


def row(name: str, distance_m: float, tally: Tally) -> str:
    """A line of the table."""
    figures = f"{tally.rmse_m:.3f} | {tally.bias_m:+.3f} | {tally.nees:.2f}" if tally.ranged else "- | - | -"
    frames = f"{tally.frames_found} of {tally.frames_sent}"
    wrong = f"{tally.bit_errors} of {tally.bits}"
    return f"| {name} | {distance_m:g} | {frames} | {wrong} | {tally.erased_share:.1%} | {figures} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--at", type=float, nargs="+", default=[50.0], metavar="M")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=0.2)
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD", help="Links with one of these words."
    )
    args = parser.parse_args()
    cases = {name: [sets] for name, sets in LINKS.items()} | {
        name: list(both) for name, both in PAIRS.items()
    }
    print(HEAD)
    print("|---|---|---|---|---|---|---|---|")
    for name, sets in cases.items():
        if args.only and not any(word in name for word in args.only):
            continue
        links = [evlcp.load_link(overrides=one) for one in sets]
        for distance_m in args.at:
            total = [Tally() for _ in links]
            for seed in range(args.seeds):
                with tempfile.TemporaryDirectory() as folder:
                    path = Path(folder) / "r.raw"
                    simulated(path, links, distance_m, args.seconds, seed)
                    total = [one + more for one, more in zip(total, scored(path, links), strict=True)]
            for i, tally in enumerate(total):
                which = f"{name}: {('the bar', 'the other')[i]}" if len(links) > 1 else name
                print(row(which, distance_m, tally), flush=True)


if __name__ == "__main__":
    main()
