"""EVT3 decoding side by side with other packages, the limit that memory sets, and peak memory.

    pip install evt3==0.4.1 evutils==0.3.18 expelliarmus==1.1.12 faery==0.7.1
    python benchmarks/evt3_decode.py [RECORDING] [--as-recorded] [--events 20000000] [--bytes 2000000000]

Those that are installed are compared, each at the batch that a few rounds find best, as ours is; one that
decodes another number of events is named and left out; one with other values is named, and runs, but ours is
not held against it. A recording (by default one of `../shared`, else a synthetic one) is tiled in time by our
own writer; `--as-recorded` repeats its words instead, vectors and all, with the times gone on.

Machines are noisy: neighbours change the speed of a core twofold within seconds. So all ways run in turn,
kernels warm, in rounds of alternating order, by processor time; a ratio is given of the least times and of
each round's pair (median and quartiles), and the spread of our own times says how noisy it was. By the clock
(wall) is told beside it: ours is one thread.

Copying the decoded columns once is the limit: a decoder has to write them at least; a pass that only reads
the words stands beside it. Then a file of `--bytes` is streamed in a fresh process for its peak resident
memory (`--bytes 0` leaves that out).
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from evlcp_sdk.io import DEFAULT_MAX_EVENTS, open_source, open_writer, read_events
from evlcp_sdk.io._words import EVT3_TIME_HIGH
from evlcp_sdk.io.evt3 import EVT3
from evlcp_sdk.io.raw import MAX_HEADER_BYTES, parse_header
from evlcp_sdk.values import Events

COLUMNS = ("t_us", "x", "y", "p")
SHARED = Path(__file__).parents[2] / "shared" / "recordings" / "night-50m-30kmh.raw"
BATCH_BYTES = (8 << 20, 1 << 20, 1 << 18)
PIECE_EVENTS = (1 << 20, 1 << 17, 1 << 14)
OWN_EVENTS = (1 << 16,)
SETTLING_ROUNDS = 4


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


def repeat(path: Path, out: Path, count: int) -> None:
    """Write a RAW recording's own words again and again, `count` events or more, later each time."""
    data = path.read_bytes()
    header = parse_header(data[:MAX_HEADER_BYTES], path)
    if header.codec is not EVT3:
        sys.exit(f"{path}: {header.codec.name}, expected EVT3 for --as-recorded")
    start = header.size_bytes
    words = np.frombuffer(data[start : start + (len(data) - start) // 2 * 2], "<u2")
    highs = words >> 12 == EVT3_TIME_HIGH
    steps = np.diff(words[highs].astype(np.int64)) & 0xFFF
    span = int(steps[steps < 0x800].sum()) + 1
    with out.open("wb") as file:
        file.write(data[:start])
        for k in range(-(-count // len(read_events(path)))):
            later = words.copy()
            later[highs] = EVT3_TIME_HIGH << 12 | (words[highs] + np.uint16(k * span & 0xFFF)) & 0xFFF
            file.write(later.tobytes())


@dataclass
class Times:
    """What a way took in each round, s: of the processor and by the clock."""

    processor: list[float] = field(default_factory=list)
    clock: list[float] = field(default_factory=list)

    def take(self, way: Callable[[], object]) -> None:
        """Run it once more."""
        clock, processor = time.perf_counter(), time.process_time()
        result = way()
        self.processor.append(time.process_time() - processor)
        self.clock.append(time.perf_counter() - clock)
        del result


def in_turn(ways: dict[str, Callable[[], object]], rounds: int, fresh: bool = False) -> dict[str, Times]:
    """Run all ways in turn, every other round from the last to the first.

    With `fresh`, for ways that take much memory anew, each runs right before it counts: else it would pay for
    what the one before gave back, which a virtual machine may have to ask of its host again.
    """
    times = {name: Times() for name in ways}
    for way in ways.values():
        way()
    for k in range(rounds):
        for name in list(ways)[:: -1 if k % 2 else 1]:
            if fresh:
                ways[name]()
            times[name].take(ways[name])
    return times


def held_against(ours: Times, theirs: Times) -> str:
    """How many times as fast ours is: by the least times, and median and quartiles of each round's pair."""
    pairs = np.array(theirs.processor) / np.array(ours.processor)
    low, middle, high = np.quantile(pairs, [0.25, 0.5, 0.75])
    least = min(theirs.processor) / min(ours.processor)
    wall = float(np.median(np.array(theirs.clock) / np.array(ours.clock)))
    paired = f"{middle:.2f} ({low:.2f} to {high:.2f}) by pairs"
    return f"{least:.2f} by least times, {paired}, {wall:.2f} by the clock"


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
    """Print the rates of all decoders and of copies, and how ours compare."""
    ours = read_events(path)

    def stream(size: int) -> None:
        with open_source(path) as source:
            drained(source.stream(size))

    own_pieces: dict[str, Way] = {
        f"{size >> 10} Ki": lambda size=size: stream(size)
        for size in sorted({*OWN_EVENTS, DEFAULT_MAX_EVENTS})
    }
    rates = in_turn(own_pieces, SETTLING_ROUNDS)
    own_best = min(rates, key=lambda how: min(rates[how].processor))
    said = [f"{how} {len(ours) / min(rates[how].processor) / 1e6:.0f}" for how in rates]
    print(f"evlcp, events a piece and Mev/s: {', '.join(said)}; by default {DEFAULT_MAX_EVENTS >> 10} Ki")
    streamed: dict[str, Way] = {"evlcp, streamed": own_pieces[own_best]}
    whole_file: dict[str, Way] = {"evlcp, whole file": lambda: read_events(path)}
    others: set[str] = set()
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
        wrong = [
            f"{b} ({np.count_nonzero(one != other) / len(one):.0%})"
            for (one, other), b in zip(pairs, "txyp", strict=True)
            if not np.array_equal(one, other)
        ]
        del theirs, pairs
        found = in_turn(pieces, SETTLING_ROUNDS)
        best = min(found, key=lambda how: min(found[how].processor))
        streamed[f"{called}, {best}"] = pieces[best]
        whole_file[f"{called}, whole file"] = whole
        if wrong:
            print(f"{called}: other values of {', '.join(wrong)}")
            others |= {f"{called}, {best}", f"{called}, whole file"}

    columns = [getattr(ours, name) for name in COLUMNS]
    targets = [column.copy() for column in columns]

    def copy() -> None:
        for target, column in zip(targets, columns, strict=True):
            np.copyto(target, column)

    words = np.frombuffer(path.read_bytes(), np.uint8)
    words = words[len(words) % 2 :].copy().view(np.uint16)
    reading: dict[str, Way] = {
        "words read once, nothing written": words.max,
        "copy of the columns, in place": copy,
    }
    copying: dict[str, Way] = {"copy of the columns, new arrays": lambda: [one.copy() for one in columns]}
    times = in_turn(streamed | reading, rounds)
    times |= in_turn(whole_file | copying, -(-rounds // 3), fresh=True)
    print(
        f"{len(ours):,} events, {path.stat().st_size:,} bytes; ours in pieces of {own_best} events;"
        f" {rounds} rounds, a third of them for whole files,"
        f" load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )
    print(f"  {'Mev/s of the processor':<42} {'best':>7} {'median':>7} {'GB/s of columns at best':>24}")
    for way, took in times.items():
        best_s, middle_s = min(took.processor), float(np.median(took.processor))
        rates = [len(ours) / seconds / 1e6 for seconds in (best_s, middle_s)]
        print(f"  {way:<42} {rates[0]:7.1f} {rates[1]:7.1f} {rates[0] * 13e-3:24.2f}")
    for what, ways in (("streamed", streamed), ("whole file", whole_file)):
        own = times[f"evlcp, {what}"]
        rivals = [way for way in ways if not way.startswith("evlcp")]
        for way in rivals:
            note = "; has other values" if way in others else ""
            print(f"{what} against {way}: {held_against(own, times[way])}{note}")
        right = [way for way in rivals if way not in others]
        if right:
            fastest = min(right, key=lambda way: min(times[way].processor))
            print(f"{what}, times the fastest of them: {held_against(own, times[fastest])}; {fastest}")
        spread = np.quantile(own.processor, [0.5, 1.0]) / min(own.processor)
        print(f"{what}, noise: our median {spread[0]:.2f} times our best, our worst {spread[1]:.2f} times")
    for what, limit in (("streamed", "in place"), ("whole file", "new arrays")):
        share = min(times[f"copy of the columns, {limit}"].processor) / min(times[f"evlcp, {what}"].processor)
        print(f"{what}, limit: at {share:.0%} of the speed of a copy, {limit}")


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
    parser.add_argument("--rounds", type=int, default=21)
    parser.add_argument("--as-recorded", action="store_true")
    options = parser.parse_args()
    events = read_events(options.recording) if options.recording.exists() else synthetic()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tiled.raw"
        if options.as_recorded:
            repeat(options.recording, path, options.events)
        else:
            tile(events, path, options.events)
        compare(path, options.rounds)
        if options.bytes:
            tile(events, path, round(options.bytes * options.events / path.stat().st_size))
            print("streamed:  ", end=" ", flush=True)
            subprocess.run([sys.executable, "-c", STREAM, str(path)], check=True)


if __name__ == "__main__":
    main()
