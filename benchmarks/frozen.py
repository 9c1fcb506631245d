"""What must not change: frames and packets of recordings, chips of links, positions, against an earlier run.

    python benchmarks/frozen.py write FOLDER        with the commit to compare with
    python benchmarks/frozen.py check FOLDER [--only WORD ...]

`write` renders scenes into FOLDER/scenes and keeps what `evlcp` makes of them, of the recordings in
`../shared/recordings`, and of links on air. `check` makes it again and names each file that differs:
`frames.csv`, `packets.jsonl` and chips by their bytes, `fixes.csv` by 1 mm and by 1 % of each sigma.
The exit code is 1 where anything differs.
"""

import argparse
import csv
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared" / "recordings"
EVLCP = Path(sys.executable).with_name("evlcp")
MODES = {
    "plain": [],
    "wh8": ["modulation.id=wh8"],
    "raw8": ["modulation.id=raw8"],
    "nrz": ["modulation.id=nrz"],
    "ppm": ["modulation.id=ppm"],
    "dimmed": ["modulation.id=wh4x2-dimmed", "pilots.id=wh-dimmed"],
    "ring": ["bar.shape=ring"],
    "columns": ["bar.rows=24", "bar.columns=2", "bar.led_pitch_m=0.04", "bar.cluster_rows=3"],
    "panel": [
        *("bar.rows=16", "bar.columns=16", "bar.led_pitch_m=0.02"),
        *("bar.cluster_rows=4", "bar.cluster_columns=4"),
    ],
    "sparse": ["air.pilot_every=4"],
    "polar": ["error-correction.id=polar"],
    "reed-solomon": ["error-correction.id=reed-solomon"],
    "uart": [
        *("bar.rows=6", "bar.cluster_rows=6", "bar.columns=1", "bar.cluster_columns=1"),
        *("framing.id=uart", "air.chip_rate_hz=3125.0", "air.frames_per_packet=100"),
    ],
}
"""Links that are put on air, rendered at 50 m and received, by their settings."""

WITH_POSITIONS = ("gate", "portal")
KEPT = {"frames.csv", "packets.jsonl", "fixes.csv", "chips.npy"}


def run(*args: str | Path) -> None:
    """Run `evlcp`; what it cannot do is said, and is no file to compare."""
    done = subprocess.run([EVLCP, *map(str, args)], capture_output=True, text=True, check=False)
    if done.returncode:
        print("evlcp", *args, f"ends with {done.returncode}: {done.stderr.strip()[:300]}", file=sys.stderr)


def settings(values: Sequence[str]) -> list[str]:
    """As the command line takes them."""
    return [word for value in values for word in ("--set", value)]


def render(scenes: Path) -> None:
    """Render what is not there."""
    scenes.mkdir(parents=True, exist_ok=True)
    for name in WITH_POSITIONS:
        if not (scenes / f"{name}.raw").exists():
            run("simulate", ROOT / "examples" / "scenes" / f"{name}.toml", "-o", scenes / f"{name}.raw")
    for name, values in MODES.items():
        if not (path := scenes / f"link-{name}.raw").exists():
            own = [f"link.{value}" for value in values]
            run("simulate", "--preset", "night", "-o", path, *settings(["duration_s=0.2", *own]))


def jobs(folder: Path) -> Iterator[tuple[str, list[str | Path]]]:
    """Names and commands; `OUT` in one is where its files go."""
    for truth in sorted(SHARED.rglob("*.truth.json")):
        bars = json.loads(truth.read_text())["bars"]
        recording = truth.with_name(truth.name.replace(".truth.json", ".raw"))
        mode = settings([f"modulation.id={bars[0]['profile']}"] if bars else [])
        yield recording.stem, ["receive", recording, "-o", "OUT", *mode]
        if truth.parent == SHARED:
            paper = ["-c", ROOT / "examples" / "links" / "paper.toml"]
            yield f"paper-{recording.stem}", ["receive", recording, "-o", "OUT", *paper, *mode]
    scenes = folder / "scenes"
    for name in WITH_POSITIONS:
        sides = ["--sites", scenes / f"{name}.site.toml", "--attitude", scenes / f"{name}.attitude.csv"]
        yield f"position-{name}", ["receive", scenes / f"{name}.raw", "-o", "OUT", *sides]
    for name, values in MODES.items():
        yield f"link-{name}", ["receive", scenes / f"link-{name}.raw", "-o", "OUT", *settings(values)]
        chips = ["--random", "3", "--seed", "1", "--chips", "OUT/chips.npy"]
        yield f"chips-{name}", ["tx", "frames", *chips, *settings(values)]
    text = [
        "tx",
        "message",
        "--text",
        "Road works",
        "--id",
        "7",
        "--sequence",
        "1",
        "--chips",
        "OUT/chips.npy",
    ]
    yield "chips-message", [*text]


def write(folder: Path, kept: Path, only: Sequence[str]) -> None:
    """Run the jobs, into a folder each of `kept`."""
    render(folder / "scenes")
    for name, command in jobs(folder):
        if only and not any(word in name for word in only):
            continue
        out = kept / name
        out.mkdir(parents=True, exist_ok=True)
        run(*[str(word).replace("OUT", str(out)) if "OUT" in str(word) else word for word in command])
        for path in out.iterdir():
            if path.name not in KEPT:
                path.unlink()


def fixes_differ(ours: Path, theirs: Path) -> str:
    """What differs beyond 1 mm, or 1 % of a sigma; empty where nothing does."""
    rows, others = (list(csv.DictReader(path.open())) for path in (ours, theirs))
    if len(rows) != len(others):
        return f"{len(rows)} fixes, not {len(others)}"
    for i, (row, other) in enumerate(zip(rows, others, strict=True)):
        for key, value in other.items():
            if row.get(key) == value:
                continue
            try:
                here, there = float(row[key]), float(value)
            except (KeyError, ValueError):
                return f"row {i}: {key} is {row.get(key)!r}, not {value!r}"
            # A degree of latitude or longitude is 111 km at the most.
            bound = (
                0.001 if key.endswith("_m") else 1e-8 if key in ("latitude_deg", "longitude_deg") else 0.01
            )
            if abs(here - there) > max(bound, 0.01 * abs(there) if "sigma" in key else 0.0) or math.isnan(
                here
            ):
                return f"row {i}: {key} is {value} there, {row[key]} here"
    return ""


def check(folder: Path, only: Sequence[str]) -> bool:
    """Print what differs from what is kept; whether nothing does."""
    count, wrong = 0, 0
    with tempfile.TemporaryDirectory() as name:
        made = Path(name)
        write(folder, made, only)
        for theirs in sorted((folder / "kept").rglob("*.*")):
            if only and not any(word in theirs.parent.name for word in only):
                continue
            ours = made / theirs.relative_to(folder / "kept")
            count += 1
            if not ours.exists():
                what = "is not there"
            elif theirs.name == "fixes.csv":
                what = fixes_differ(ours, theirs)
            else:
                what = "" if ours.read_bytes() == theirs.read_bytes() else _first_difference(ours, theirs)
            if what:
                wrong += 1
                print(f"{theirs.parent.name}/{theirs.name}: {what}")
    print(f"{count} files, {wrong} differ")
    return count > 0 and not wrong


def _first_difference(ours: Path, theirs: Path) -> str:
    """Where two files part, and how many lines do."""
    if ours.suffix == ".npy":
        return "other chips"
    lines, others = ours.read_text().splitlines(), theirs.read_text().splitlines()
    parted = [i for i, (a, b) in enumerate(zip(lines, others, strict=False)) if a != b]
    if not parted:
        return f"{len(lines)} lines, not {len(others)}"
    i = parted[0]
    return (
        f"{len(parted)} of {len(others)} lines; line {i + 1} is\n    {lines[i][:160]}\n    {others[i][:160]}"
    )


def main() -> None:
    """Write or check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("write", "check"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD", help="Jobs with one of these words.")
    args = parser.parse_args()
    if args.what == "write":
        write(args.folder, args.folder / "kept", args.only)
    else:
        sys.exit(not check(args.folder, args.only))


if __name__ == "__main__":
    main()
