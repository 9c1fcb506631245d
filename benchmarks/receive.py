"""What a frame costs the receiver of the processor's time, and how that compares with an earlier commit.

    python benchmarks/receive.py                    of ../shared, and made: clutter, four bars
    python benchmarks/receive.py REC.raw -c examples/links/paper.toml
    python benchmarks/receive.py --against 9c93e22  the same beside that commit, built by git
    python benchmarks/receive.py --cores 2          how much sooner two processes are done, by the clock

Events are received from memory, kernels warm. Each version is a process of its own, on one thread; they take
turns scene by scene, so that both meet the same pace of the machine. Printed of each scene: the least time a
frame, how many times real time that is, and the median of the pairs' ratios (new over old) with the least and
the greatest. To night-50m are added ten million events a second, or eight lamps.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from memory import CHIP_US, in_order, noise

from evlcp_sdk.io import read_events, write_events
from evlcp_sdk.simulated import simulate
from evlcp_sdk.values import Events

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared" / "recordings"
NAMES = "night-50m-30kmh", "two-bars-60m-75m", "tunnel-90m-30kmh", "day-35m-20kmh"

CHILD = """
import json, sys, time
import evlcp_sdk as evlcp
chunks = {}
for line in sys.stdin:
    path, link, workers = json.loads(line)
    if path not in chunks:
        with evlcp.open(path) as source:
            chunks[path] = list(source.chunks())
    receiver = evlcp.Receiver(evlcp.load_link(link), **({"workers": workers} if workers > 1 else {}))
    begin_s, clock_s = time.process_time(), time.perf_counter()
    for events in chunks[path]:
        receiver.feed(events)
    receiver.close()
    spent_s = time.perf_counter() - clock_s if workers else time.process_time() - begin_s
    print(json.dumps([spent_s, receiver.counts["frames"]]), flush=True)
"""


def start(*folders: Path) -> subprocess.Popen[str]:
    """A process of the version of the SDK that is found in some folders."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, folders)), "OMP_NUM_THREADS": "1"}
    command, pipe = [sys.executable, "-P", "-c", CHILD], subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment, cwd="/", text=True)


def receive(child: subprocess.Popen[str], *scene: Any) -> tuple[float, int]:
    """Time, s, to receive a scene (recording, link, processes), of the processor if 0; and its frames."""
    assert child.stdin is not None
    assert child.stdout is not None
    print(json.dumps(scene), file=child.stdin, flush=True)
    spent_s, frames = json.loads(child.stdout.readline())
    return spent_s, frames


def merge(one: Events, other: Events) -> Events:
    """The events of both, in order."""
    return in_order(*vars(Events.concat([one, other])).values())


def lamps(duration_us: int, *, steady: bool) -> Events:
    """Eight lamps of 12 x 12 px that blink with a period of two chips, or each chip by a coin toss."""
    rng, chips = np.random.default_rng(0), np.arange(duration_us // CHIP_US - 1)
    v, u = np.indices((12, 12)).reshape(2, -1)
    parts = []
    for left in range(100, 100 + 8 * 140, 140):
        light = chips % 2 if steady else rng.integers(0, 2, len(chips))
        edges = np.flatnonzero(np.diff(light)) + 1
        t_us = edges[:, None] * CHIP_US + rng.integers(0, 25, (len(edges), u.size))
        columns = np.broadcast_arrays(t_us, left + u, 40 + v, light[edges][:, None])
        parts.append(in_order(*(column.ravel() for column in columns)))
    return Events.concat(parts)


def four_bars() -> Events:
    """The events of four bars 60 m ahead, 8 m from the first to the last."""
    bars = [{"x_m": 8 / 3 * i - 4, "y_m": -0.3, "seed": i + 1} for i in range(4)]
    motion = {"distance_m": 60.0, "speed_mps": 10.0}
    scene: dict[str, Any] = {"name": "beside", "duration_s": 0.4, "motion": motion, "bars": bars}
    return Events.concat(list(simulate(scene, seed=1).chunks()))


def usual_recordings(folder: Path) -> list[Path]:
    """The recordings of `../shared`, and those made by this script."""
    if not SHARED.exists():
        sys.exit(f"no recording named, and {SHARED} is not there")
    night = read_events(SHARED / f"{NAMES[0]}.raw")
    night = Events.of(night.t_us - night.t_us[0], night.x, night.y, night.p)
    long_us = int(night.t_us[-1])
    made = {
        "noise": merge(night, Events.concat(list(noise(1e7, long_us)))),
        "steady-lamps": merge(night, lamps(long_us, steady=True)),
        "random-lamps": merge(night, lamps(long_us, steady=False)),
        "four-bars": four_bars(),
    }
    for name, events in made.items():
        write_events(folder / f"{name}.raw", events, 1280, 720)
    return [*(SHARED / f"{name}.raw" for name in NAMES), *(folder / f"{name}.raw" for name in made)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("-c", "--config", type=Path, help="a link.toml")
    parser.add_argument("--against", help="a commit of this repository")
    parser.add_argument("--cores", type=int, default=0)
    parser.add_argument("--pairs", type=int, default=10)
    given = parser.parse_args()
    link = None if given.config is None else str(given.config.resolve())
    with tempfile.TemporaryDirectory() as name:
        versions = [start(ROOT, ROOT / "plugins")]
        if given.against:
            old, source = Path(name, "old"), f"evlcp-sdk @ git+file://{ROOT}@{given.against}"
            install = sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target"
            subprocess.run([*install, old, source], check=True)
            versions.append(start(old))
        for path in given.recordings or usual_recordings(Path(name)):
            scene = str(path.resolve()), link
            runs = [(child, given.cores) for child in versions]
            if given.cores:
                runs.append((versions[0], 1))
            # The first loads, or compiles, the kernels.
            turns = [[receive(child, *scene, many) for child, many in runs] for _ in range(given.pairs + 1)]
            rounds = turns[1:]
            best_s, frames = min(pair[0] for pair in rounds)
            t_us = read_events(path).t_us
            line = f"{path.stem:24} {best_s / max(frames, 1) * 1e6:6.0f} us/frame"
            line += f"  {(t_us[-1] - t_us[0]) * 1e-6 / best_s:6.2f} x real time"
            if given.against or given.cores:
                ratios = [one[0] / other[0] for one, other in rounds]
                peer = given.against or "one core"
                line += f"  {median(ratios):5.3f} of {peer} ({min(ratios):.2f} to {max(ratios):.2f})"
            print(line, flush=True)


if __name__ == "__main__":
    main()
