"""What the receiver finds on a road, beside the figures to reach, and how fast: one table each.

    python benchmarks/road.py [RECORDING or FOLDER ...] [--only NAME ...]
        [--against LINK.toml or NAME:TABLE.KEY=VALUE,...] [--rounds 3]
        [--json | --markdown]

Without names, all recordings of `../shared/recordings/road` and one folder up. Each has its truth beside it,
and is received by what `evlcp receive` calls, in this process and on one thread, with the modulation that it
was sent with; its `frames.csv` is counted as the road score of `evlcp score` counts. Where the scorer that is
not this project's is at hand, `tools/score_road.py` above the recordings, the table says whether it agrees.
Figures to reach are in `benchmarks/road.toml`, by the recording's name.

`--against` puts another link beside the default one, from a file or as settings; it may be repeated.
`--markdown` prints the tables of docs/compare.md: what each link finds, side by side.

Speed is processor time, kernels warm, the best of the rounds (0 leaves it out): recorded time and events over
it. It is printed, and is never a miss. The exit code is 1 where a figure is missed.
"""

import argparse
import json
import math
import os
import runpy
import sys
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from evlcp_sdk.errors import EvlcpError
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.sim import Truth, read_truth, truth_path
from evlcp_sdk.study.compare import load_variants
from evlcp_sdk.study.frames import read_frames
from evlcp_sdk.study.match import match_frames
from evlcp_sdk.study.measure import tally_bar
from evlcp_sdk.study.score import score_frames
from evlcp_sdk.study.tally import Statistics, Tally

SHARED = Path(__file__).parents[2] / "shared" / "recordings"
TARGETS = Path(__file__).with_suffix(".toml")

Make = Callable[[str], Link]
"""A link for recordings of a modulation."""

Plain = dict[str, Any]


def targets_of(table: Mapping[str, Any], name: str, bar: int) -> Plain:
    """What one bar of a recording is held against."""
    values = {**table["every"], **table.get(name, {})}
    return {
        key: value[min(bar, len(value) - 1)] if isinstance(value, list) and key != "nees" else value
        for key, value in values.items()
    }


def missed_targets(tally: Tally | None, ghosts: int, targets: Mapping[str, Any]) -> list[str]:
    """Names of the figures that do not reach what they are held against; a figure that is not there does not.

    Args:
        tally: What was counted of one bar; None for a recording without one.
        ghosts: Rows of the recording that match no true frame.
        targets: What `targets_of` gave.
    """
    found = ["ghosts"] if ghosts > targets["ghosts"] else []
    if tally is None:
        return found

    def check_limit(name: str, value: float, key: str) -> None:
        if key in targets and not value <= targets[key]:
            found.append(name)

    if "found" in targets and tally.frames_found < targets["found"] * tally.frames_sent:
        found.append("frames")
    check_limit("BER", tally.ber, "ber")
    if tally.hidden:
        check_limit("claimed", tally.claimed_share, "claimed")
    check_limit("RMSE", tally.rmse_m, "rmse_m")
    check_limit("worst", tally.worst_m, "worst_m")
    if tally.filtered:
        check_limit("filtered", tally.filtered_rmse_m, "rmse_m")
    low, high = targets["nees"]
    if tally.ranged and not low <= tally.nees <= high:
        found.append("NEES")
    return found


def independent(tool: Path, folder: Path, truth: Path) -> Plain | None:
    """What the scorer that is not this project's says; None where it is not there."""
    if not tool.is_file():
        return None
    result: Plain = runpy.run_path(str(tool))["score"](folder, truth)
    return result


def speed(path: Path, folder: Path, link: Link, rounds: int) -> Plain:
    """Processor time of a recording, the round with the least."""
    found = (receive_to_folder(path, folder, link) for _ in range(rounds))
    best = min(found, key=lambda summary: summary["processing"]["processor_s"])
    done, recording = best["processing"], best["recording"]
    return {
        "processor_s": done["processor_s"],
        "recorded_s": recording["duration_s"],
        "events": recording["counts"]["events"],
        "real_time": done["times_real_time"],
        "mev_s": done["events_per_s"] / 1e6,
    }


def measure(path: Path, make: Make, table: Mapping[str, Any], tool: Path, rounds: int) -> Plain:
    """Everything about a recording and a link; `fault` is in it where it cannot be received."""
    truth: Truth = read_truth(truth_path(path))
    lit = [bar for bar in truth.bars if bar.sends_frames]
    profile = (lit[0] if lit else truth.bars[0]).link.table["modulation"]["id"] if truth.bars else "wh4x2"
    name = path.name.split(".")[0]
    result: Plain = {"recording": name, "bars": [], "ghosts": 0, "echoes": 0, "rows": 0}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        try:
            summary = receive_to_folder(path, out, make(profile))
            if summary["status"] != "complete":
                raise EvlcpError(str(summary["error"]))
            frames = read_frames(out)
            found = match_frames(frames, truth)
        except Exception as fault:  # whatever ends one recording must not end the table
            return result | {"fault": f"{type(fault).__name__}: {fault}".splitlines()[0]}
        ours, other = score_frames(frames, truth)["road"], independent(tool, out, truth_path(path))
        ghosts, bars = found.unmatched, zip(found.bars, found.pairs, strict=True)
        result |= {
            "rows": len(frames),
            "ghosts": ghosts,
            "echoes": found.echoes,
            "warnings": [warning["code"] for warning in summary["warnings"]],
            "independent": "absent" if other is None else "agrees" if other == ours else "differs",
        }
        for number, bar in enumerate(Statistics.of(tally_bar(*one)) for one in bars):
            targets = targets_of(table, name, number)
            result["bars"].append(
                {
                    "statistics": bar,
                    "targets": targets,
                    "missed": missed_targets(bar.total(), ghosts if number == 0 else 0, targets),
                }
            )
        if not found.bars:
            targets = targets_of(table, name, 0)
            result["bars"].append(
                {"statistics": None, "targets": targets, "missed": missed_targets(None, ghosts, targets)}
            )
        if rounds:
            result["speed"] = speed(path, out, make(profile), rounds)
    return result


def number(value: float, digits: int = 3) -> str:
    """A figure, `-` for none; never as a power of ten."""
    if math.isnan(value):
        return "-"
    return "0" if value == 0 else f"{value:.{digits}f}"


def with_limit(value: float, limit: float | None, digits: int = 3) -> str:
    """A figure and the limit that it is held against."""
    text = number(value, digits)
    if limit is None or math.isnan(value):
        return text
    return f"{text} {'<=' if value <= limit else '>'} {limit:g}"


HEAD = [
    *("link", "recording", "frames", "BER", "erased", "claimed", "ranged", "RMSE, m", "bias", "worst"),
    *("filtered", "NEES", "ghosts", "echoes", "missed"),
]


def cells_of(tally: Tally, targets: Mapping[str, Any]) -> list[str]:
    """What a table says of a bar from its wrong bits to the bias of its distances."""
    return [
        with_limit(tally.ber, targets.get("ber"), 5),
        number(tally.erased_share),
        with_limit(tally.claimed_share, targets.get("claimed") if tally.hidden else None),
        str(tally.ranged),
        with_limit(tally.rmse_m, targets.get("rmse_m"), 4),
        number(tally.bias_m),
    ]


def lines_of(result: Plain, link: str) -> list[list[str]]:
    """The rows of a recording."""
    if "fault" in result:
        return [
            [link, result["recording"], *["-"] * (len(HEAD) - 3), f"cannot be received: {result['fault']}"]
        ]
    rows = []
    for i, bar in enumerate(result["bars"]):
        tally = Tally() if bar["statistics"] is None else bar["statistics"].total()
        targets = bar["targets"]
        share = targets.get("found")
        frames = f"{tally.frames_found}/{tally.frames_sent}"
        if share is not None and tally.frames_sent:
            frames += f" {'>=' if 'frames' not in bar['missed'] else '<'} {share:.0%}"
        low, high = targets["nees"]
        nees = number(tally.nees, 2)
        if tally.ranged:
            nees += "" if "NEES" not in bar["missed"] else f" not {low:g}..{high:g}"
        word = ", ".join(bar["missed"]) or "none"
        if result["independent"] == "differs":
            word += "; the independent scorer differs"
        rows.append(
            [
                link,
                result["recording"] if i == 0 else "  bar " + str(i),
                frames,
                *cells_of(tally, targets),
                with_limit(tally.worst_m, targets.get("worst_m")),
                number(tally.filtered_rmse_m),
                nees,
                str(result["ghosts"]) if i == 0 else "",
                str(result["echoes"]) if i == 0 else "",
                word,
            ]
        )
    return rows


def total_of(results: Sequence[Plain], link: str) -> list[str]:
    """The row of all recordings together."""
    bars = [bar for result in results for bar in result["bars"]]
    seen = [bar["statistics"] for bar in bars if bar["statistics"] is not None]
    tally = sum(seen, Statistics()).total()
    lines = len(bars) + sum("fault" in result for result in results)
    misses = lines - sum(not bar["missed"] for bar in bars)
    return [
        link,
        f"all {lines}",
        f"{tally.frames_found}/{tally.frames_sent}",
        number(tally.ber, 5),
        number(tally.erased_share),
        number(tally.claimed_share),
        str(tally.ranged),
        number(tally.rmse_m),
        number(tally.bias_m),
        number(tally.worst_m),
        number(tally.filtered_rmse_m),
        number(tally.nees, 2),
        str(sum(result["ghosts"] for result in results)),
        str(sum(result["echoes"] for result in results)),
        f"{misses} of {lines} lines miss a figure",
    ]


def show(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table, without the columns that have nothing to say."""
    kept = [j for j in range(len(head)) if any(row[j] not in ("", "-") for row in rows)]
    widths = [max(len(line[j]) for line in [head, *rows]) for j in kept]
    for line in [head, *rows]:
        print("  ".join(line[j].ljust(w) for j, w in zip(kept, widths, strict=True)).rstrip())


SPEED_HEAD = ["link", "recording", "Mev", "x real time", "Mev/s"]


def speed_line(name: str, link: str, found: Plain, real_time: float | None) -> list[str]:
    def least(value: float, limit: float | None, digits: int) -> str:
        text = f"{value:.{digits}f}"
        return text if limit is None else f"{text} {'>=' if value >= limit else '<'} {limit:g}"

    return [
        link,
        name,
        f"{found['events'] / 1e6:.2f}",
        least(found["real_time"], real_time, 2),
        f"{found['mev_s']:.1f}",
    ]


def links_of(texts: Sequence[str]) -> dict[str, Make]:
    """Links by name, the default one first; all faults are told at once, before anything is received."""

    def of_file(file: Path | None, profile: str) -> Link:
        return load_link(file, [f"modulation.id={profile}"])

    def of_settings(text: str, profile: str) -> Link:
        return load_variants([text], None, [f"modulation.id={profile}"])[0].links[""]

    links: dict[str, Make] = {"default": partial(of_file, None)}
    for text in texts:
        path = Path(text)
        if path.suffix == ".toml":
            links[path.stem] = partial(of_file, path)
        else:
            links[text.partition(":")[0]] = partial(of_settings, text)
    for make in links.values():
        make("wh4x2")
    return links


def recordings_of(args: argparse.Namespace) -> list[Path]:
    """The recordings that were named, of which each has its truth beside it."""
    if args.recordings:
        named = args.recordings
    elif SHARED.is_dir():
        named = [SHARED / "road", SHARED]
    else:
        sys.exit("no recording is named, and ../shared/recordings is not there: name some that have truth")
    found: list[Path] = []
    for path in named:
        if not path.exists():
            sys.exit(f"{path}: no such file or folder")
        found += sorted(path.glob("*.raw")) if path.is_dir() else [path]
    found = [p for p in found if not args.only or any(word in p.name for word in args.only)]
    lone = [str(p) for p in found if not truth_path(p).is_file()]
    if lone or not found:
        sys.exit(f"without a truth beside it: {', '.join(lone)}" if lone else "no recording with these names")
    return found


FIGURES = [
    *("frames_sent", "frames_found", "bits", "bit_errors", "visible", "erased", "hidden", "claimed"),
    *("ranged", "ber", "erased_share", "claimed_share", "rmse_m", "bias_m", "worst_m", "filtered_rmse_m"),
    "nees",
]
"""Of a tally, what JSON gets."""


def to_json(results: Mapping[str, Sequence[Plain]]) -> Plain:
    """Everything as JSON values; null where nothing was measured."""

    def bar_of(bar: Plain) -> Plain:
        tally = None if bar["statistics"] is None else bar["statistics"].total()
        values = {} if tally is None else {name: getattr(tally, name) for name in FIGURES}
        values = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values.items()}
        return values | {"targets": bar["targets"], "missed": bar["missed"]}

    return {
        link: {"recordings": [one | {"bars": [bar_of(bar) for bar in one["bars"]]} for one in found]}
        for link, found in results.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME")
    parser.add_argument("--against", action="append", default=[], metavar="LINK")
    parser.add_argument("--rounds", type=int, default=3)
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true")
    form.add_argument("--markdown", action="store_true")
    args = parser.parse_args()
    if "OPENBLAS_NUM_THREADS" not in os.environ:
        # The library reads it when it is loaded: begin anew.
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | {"OPENBLAS_NUM_THREADS": "1"})
    recordings = recordings_of(args)
    try:
        links = links_of(args.against)
    except EvlcpError as fault:
        sys.exit(str(fault))
    table = tomllib.loads(TARGETS.read_text())
    results: dict[str, list[Plain]] = {name: [] for name in links}
    for path in recordings:
        tool = next(
            (p / "tools" / "score_road.py" for p in path.resolve().parents if (p / "tools").is_dir()), Path()
        )
        for name, make in links.items():
            results[name].append(measure(path, make, table, tool, args.rounds))
    if args.json:
        print(json.dumps(to_json(results), indent=2))
    elif args.markdown:
        print_markdown(results)
    else:
        print_tables(results, table)
    sys.exit(
        any("fault" in one or any(b["missed"] for b in one["bars"]) for one in results[next(iter(links))])
    )


def print_markdown(results: Mapping[str, Sequence[Plain]]) -> None:
    """Print one table: a row a bar, and of each link the frames found, bit error rate and RMSE."""

    def cells(tally: Tally) -> list[str]:
        frames = f"{tally.frames_found} of {tally.frames_sent}"
        return [frames, number(tally.ber, 4), number(tally.rmse_m)]

    def line(words: Sequence[str]) -> None:
        print(f"| {' | '.join(words)} |")

    line(["recording", *(f"{what}, {name}" for name in results for what in ("frames", "BER", "RMSE, m"))])
    line(["---"] * (1 + 3 * len(results)))
    for found in zip(*results.values(), strict=True):
        for i in range(max(len(one["bars"]) for one in found)):
            tallies = [
                Tally()
                if i >= len(one["bars"]) or one["bars"][i]["statistics"] is None
                else one["bars"][i]["statistics"].total()
                for one in found
            ]
            if any(tally.frames_sent for tally in tallies):
                name = found[0]["recording"] + (f", bar {i}" if len(found[0]["bars"]) > 1 else "")
                line([name, *(cell for tally in tallies for cell in cells(tally))])
    totals = [
        sum((bar["statistics"] for one in found for bar in one["bars"] if bar["statistics"]), Statistics())
        for found in results.values()
    ]
    line(["all", *(cell for total in totals for cell in cells(total.total()))])
    print()
    line(["link", "ghosts", "said to be reflections", "erased", "claimed", "x real time, median"])
    line(["---"] * 6)
    for (name, found), total in zip(results.items(), totals, strict=True):
        tally = total.total()
        times = sorted(one["speed"]["real_time"] for one in found if "speed" in one and one["rows"])
        line(
            [
                name,
                str(sum(one["ghosts"] for one in found)),
                str(sum(one["echoes"] for one in found)),
                number(100 * tally.erased_share, 1) + " %",
                number(100 * tally.claimed_share, 1) + " %",
                number(median(times), 2) if times else "-",
            ]
        )


def print_tables(results: Mapping[str, Sequence[Plain]], table: Mapping[str, Any]) -> None:
    """Print what was found, and then the speed."""
    alone = len(results) == 1
    names = {name: "" if alone else name for name in results}
    rows = [
        line
        for found in zip(*results.values(), strict=True)
        for name, one in zip(results, found, strict=True)
        for line in lines_of(one, names[name])
    ]
    show(HEAD, [*rows, *(total_of(found, names[name]) for name, found in results.items())])
    agreed = [one.get("independent") for found in results.values() for one in found]
    if "absent" not in agreed:
        print(f"The independent scorer says the same of {agreed.count('agrees')} of {len(agreed)}.")
    rows = []
    for found in zip(*results.values(), strict=True):
        for name, one in zip(results, found, strict=True):
            if "speed" in one:
                least = table.get(one["recording"], {}).get("real_time")
                rows.append(speed_line(one["recording"], names[name], one["speed"], least))
    if rows:
        print()
        show(SPEED_HEAD, rows)


if __name__ == "__main__":
    main()
