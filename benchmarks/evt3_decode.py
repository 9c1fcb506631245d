"""EVT3 decoding side by side with the PyPI package `evt3`, the limit that memory sets, and peak memory.

    pip install evt3==0.4.1
    python benchmarks/evt3_decode.py [RECORDING] [--events 20000000] [--bytes 2000000000]

A recording (by default one of `../shared`, else a synthetic one) is tiled in time by our own writer. Each way
to decode it runs in turn, one thread, kernels warm, and the best of the rounds counts. Copying the decoded
columns once is the limit: a decoder has to write them at least. Then a file of `--bytes` is streamed in a
fresh process for its peak resident memory (`--bytes 0` leaves that out).
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np

from evlcp_sdk.io import DEFAULT_MAX_EVENTS, open_source, open_writer, read_events
from evlcp_sdk.values import Events

COLUMNS = ("t_us", "x", "y", "p")
SHARED = Path(__file__).parents[2] / "shared" / "recordings" / "night-50m-30kmh.raw"
BATCH_BYTES = (8 << 20, 1 << 20, 1 << 18)


def synthetic(n: int = 2_000_000) -> Events:
    """Return events of a 1280x720 camera at 10 Mev/s, in rows as the sensor reads them out."""
    rng = np.random.default_rng(0)
    t, y = np.sort(rng.integers(0, n // 10, n)), rng.integers(200, 400, n)
    order = np.lexsort((y, t))
    return Events.of(t, rng.integers(0, 1280, n), y[order], rng.integers(0, 2, n))


def tile(events: Events, path: Path, count: int) -> None:
    """Write `count` events: `events` again and again, later each time."""
    span = (int(events.t_us[-1]) // 4096 + 1) * 4096
    with open_writer(path, 1280, 720) as writer:
        for k in range(0, count, len(events)):
            piece = events[: count - k]
            offset = k // len(events) * span
            writer.write(Events(piece.t_us + offset, piece.x, piece.y, piece.p))


def best_rates(ways: dict[str, Callable[[], object]], events: int, rounds: int) -> dict[str, float]:
    """Return the best rate of each way, Mev/s, run in turn."""
    best = dict.fromkeys(ways, float("inf"))
    for way in ways.values():
        way()
    for _ in range(rounds):
        for name, way in ways.items():
            start = time.perf_counter()
            result = way()
            best[name] = min(best[name], time.perf_counter() - start)
            del result
    return {name: events / seconds / 1e6 for name, seconds in best.items()}


def compare(path: Path, rounds: int) -> None:
    """Print the rates of both decoders and of copies."""
    try:
        import evt3
    except ImportError:
        sys.exit("needs the package to compare with: pip install evt3==0.4.1")
    ours, theirs = read_events(path), evt3.decode_file(str(path))
    same = all(
        np.array_equal(getattr(ours, a), getattr(theirs, b)) for a, b in zip(COLUMNS, "txyp", strict=True)
    )
    if not same:
        sys.exit("the two decoders disagree")
    del theirs

    def stream() -> None:
        with open_source(path) as source:
            for _ in source.stream():
                pass

    def batches(size: int) -> None:
        for _ in evt3.decode_file_batches(str(path), batch_bytes=size):
            pass

    columns = [getattr(ours, name) for name in COLUMNS]
    targets = [column.copy() for column in columns]

    def copy() -> None:
        for target, column in zip(targets, columns, strict=True):
            np.copyto(target, column)

    name = f"evt3 {version('evt3')}"
    rates = best_rates(
        {
            "evlcp, streamed": stream,
            **{
                f"{name}, batches of {size >> 10} KiB": lambda size=size: batches(size)
                for size in BATCH_BYTES
            },
            "evlcp, whole file": lambda: read_events(path),
            f"{name}, whole file": lambda: evt3.decode_file(str(path)),
            "copy of the columns, in place": copy,
            "copy of the columns, new arrays": lambda: [column.copy() for column in columns],
        },
        len(ours),
        rounds,
    )
    print(f"{len(ours):,} events, {path.stat().st_size:,} bytes, {DEFAULT_MAX_EVENTS} events a piece")
    for way, rate in rates.items():
        print(f"  {way:<32} {rate:7.1f} Mev/s {rate * 13e-3:7.2f} GB/s of columns")
    rival = max(rate for way, rate in rates.items() if "batches" in way)
    streamed, whole = rates["evlcp, streamed"], rates["evlcp, whole file"]
    print(f"streamed:   {streamed / rival:.2f} times {name} with its best batches")
    print(f"whole file: {whole / rates[f'{name}, whole file']:.2f} times {name}")
    limits = rates["copy of the columns, in place"], rates["copy of the columns, new arrays"]
    print(f"limit:      streamed at {streamed / limits[0]:.0%} of a copy in place,", end=" ")
    print(f"whole file at {whole / limits[1]:.0%} of a copy to new arrays")


STREAM = """
import re, sys, time
from pathlib import Path
from evlcp_sdk.io import open_source
start = time.perf_counter()
with open_source(sys.argv[1]) as source:
    events = sum(map(len, source.chunks()))
seconds = time.perf_counter() - start
# Not ru_maxrss: that one a process inherits from its parent.
peak = int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024 / 1e6
print(f"{source.size_bytes:,} bytes, {events:,} events in {seconds:.1f} s, peak {peak:.0f} MB")
"""


def main() -> None:
    parser = argparse.ArgumentParser(description="EVT3 decoding, side by side")
    parser.add_argument("recording", nargs="?", type=Path, default=SHARED)
    parser.add_argument("--events", type=int, default=20_000_000)
    parser.add_argument("--bytes", type=int, default=2_000_000_000)
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    events = read_events(options.recording) if options.recording.exists() else synthetic()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tiled.raw"
        tile(events, path, options.events)
        compare(path, options.rounds)
        if options.bytes:
            tile(events, path, round(options.bytes * options.events / path.stat().st_size))
            print("streamed:  ", end=" ", flush=True)
            subprocess.run([sys.executable, "-c", STREAM, str(path)], check=True)


if __name__ == "__main__":
    main()
