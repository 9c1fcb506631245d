"""EVT3 decoding side by side with other packages, the limit that memory sets, and peak memory.

    pip install evt3==0.4.1 evutils==0.3.18 expelliarmus==1.1.12 faery==0.7.1
    python benchmarks/evt3_decode.py [RECORDING] [--events 20000000] [--bytes 2000000000]

Those that are installed are compared, each at its best batch; one that decodes another number of events
is named and left out; one with other values is named, and runs, but ours is not held against it. A
recording (by default one of `../shared`, else a synthetic one) is tiled in time by
our own writer. Each way to decode it runs in turn, kernels warm, and the least processor time of the rounds
counts. Copying the decoded columns once is the limit: a decoder has to write them at least; a pass that only
reads the words stands beside it. Then a file of `--bytes` is streamed in a fresh process for its peak
resident memory (`--bytes 0` leaves that out).
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from evlcp_sdk.io import DEFAULT_MAX_EVENTS, open_source, open_writer, read_events
from evlcp_sdk.values import Events

COLUMNS = ("t_us", "x", "y", "p")
SHARED = Path(__file__).parents[2] / "shared" / "recordings" / "night-50m-30kmh.raw"
BATCH_BYTES = (8 << 20, 1 << 20, 1 << 18)
PIECE_EVENTS = (1 << 20, 1 << 17, 1 << 14)


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
            start = time.process_time()
            result = way()
            best[name] = min(best[name], time.process_time() - start)
            del result
    return {name: events / seconds / 1e6 for name, seconds in best.items()}


Way = Callable[[], object]


def drained(pieces: Iterable[object]) -> None:
    for _ in pieces:
        pass


def of_evt3(path: Path) -> tuple[Callable[[], Any], dict[str, Way]]:
    import evt3

    return lambda: evt3.decode_file(str(path)), {
        f"batches of {size >> 10} KiB": lambda size=size: drained(
            evt3.decode_file_batches(str(path), batch_bytes=size)
        )
        for size in BATCH_BYTES
    }


def of_evutils(path: Path) -> tuple[Callable[[], Any], dict[str, Way]]:
    from evutils.io import EventReader

    def pieces(size: int) -> None:
        with EventReader(str(path), n_events=size, mode="n_events") as reader:
            drained(reader)

    return lambda: EventReader(str(path), mode="all").read_all(), {
        f"pieces of {size >> 10} Ki events": lambda size=size: pieces(size) for size in PIECE_EVENTS
    }


def of_expelliarmus(path: Path) -> tuple[Callable[[], Any], dict[str, Way]]:
    from expelliarmus import Wizard

    def pieces(size: int) -> None:
        wizard = Wizard(encoding="evt3", chunk_size=size)
        wizard.set_file(str(path))
        drained(wizard.read_chunk())

    return lambda: Wizard(encoding="evt3").read(str(path)), {
        f"pieces of {size >> 10} Ki events": lambda size=size: pieces(size) for size in PIECE_EVENTS
    }


def of_faery(path: Path) -> tuple[Callable[[], Any], dict[str, Way]]:
    import faery

    return lambda: faery.events_stream_from_file(path).to_array(), {
        "its own packets": lambda: drained(faery.events_stream_from_file(path))
    }


PEERS = {"evt3": of_evt3, "evutils": of_evutils, "expelliarmus": of_expelliarmus, "faery": of_faery}


def column(events: Any, name: str) -> Any:
    """A column of an array with fields, of an object with attributes, or of a mapping."""
    for key in (name, {"p": "on"}.get(name, name)):
        if getattr(getattr(events, "dtype", None), "names", None) and key in events.dtype.names:
            return events[key]
        if hasattr(events, key):
            return getattr(events, key)
    return events[name]


def compare(path: Path, rounds: int) -> None:
    """Print the rates of all decoders and of copies."""
    ours = read_events(path)

    def stream() -> None:
        with open_source(path) as source:
            for _ in source.stream():
                pass

    others: list[str] = []
    ways: dict[str, Way] = {"evlcp, streamed": stream, "evlcp, whole file": lambda: read_events(path)}
    for name, peer in PEERS.items():
        try:
            whole, pieces = peer(path)
        except ImportError:
            print(f"{name}: not installed")
            continue
        called = f"{name} {version(name)}"
        theirs = whole()
        pairs = [
            (getattr(ours, a), np.asarray(column(theirs, b))) for a, b in zip(COLUMNS, "txyp", strict=True)
        ]
        if any(len(a) != len(b) for a, b in pairs):
            print(f"{called}: {len(pairs[0][1])} events, ours {len(ours)}; left out")
            continue
        wrong = [b for (one, other), b in zip(pairs, "txyp", strict=True) if not np.array_equal(one, other)]
        if wrong:
            print(f"{called}: other values of {', '.join(wrong)}")
            others.append(called)
        del theirs, pairs
        ways |= {f"{called}, {how}": way for how, way in pieces.items()} | {f"{called}, whole file": whole}

    columns = [getattr(ours, name) for name in COLUMNS]
    targets = [column.copy() for column in columns]

    def copy() -> None:
        for target, column in zip(targets, columns, strict=True):
            np.copyto(target, column)

    words = np.frombuffer(path.read_bytes(), np.uint8)
    words = words[len(words) % 2 :].copy().view(np.uint16)
    ways["words read once, nothing written"] = words.max
    ways["copy of the columns, in place"] = copy
    ways["copy of the columns, new arrays"] = lambda: [column.copy() for column in columns]
    rates = best_rates(ways, len(ours), rounds)
    print(f"{len(ours):,} events, {path.stat().st_size:,} bytes, {DEFAULT_MAX_EVENTS} events a piece")
    for way, rate in rates.items():
        print(f"  {way:<42} {rate:7.1f} Mev/s {rate * 13e-3:7.2f} GB/s of columns")
    rivals = {
        way: rate
        for way, rate in rates.items()
        if not way.startswith(("evlcp", "copy", "words", *(f"{called}," for called in others)))
    }
    streamed, whole_file = rates["evlcp, streamed"], rates["evlcp, whole file"]
    for what, rate, kind in (("streamed", streamed, False), ("whole file", whole_file, True)):
        best = max(
            ((r, way) for way, r in rivals.items() if way.endswith("whole file") == kind), default=None
        )
        if best is not None:
            print(f"{what + ':':<11} {rate / best[0]:.2f} times {best[1]}")
    limits = rates["copy of the columns, in place"], rates["copy of the columns, new arrays"]
    print(f"limit:      streamed at {streamed / limits[0]:.0%} of a copy in place,", end=" ")
    print(f"whole file at {whole_file / limits[1]:.0%} of a copy to new arrays")


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
