"""EVT3 decoding beside other packages and the limit that memory sets.

    pip install evt3==0.4.1 faery==0.7.1
    python benchmarks/evt3_decode.py [RECORDING] [--events 20000000] [--rounds 21]

Those that are installed are compared on a recording, by default the one that comes with the package, tiled in
time. All run in turn, in rounds of alternating order, by processor time; a ratio is the median of
each round's pair, with quartiles. Copying the decoded columns once is the limit: a decoder has to write them.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path

import numpy as np

from evlcp_sdk.io import open_source, open_writer, read_events
from evlcp_sdk.values import Events

RECORDING = Path(__file__).parents[1] / "examples" / "recordings" / "night-50m-30kmh-cut.raw"


def tile(events: Events, path: Path, count: int) -> None:
    """Write `count` events: `events` again and again, later each time."""
    span = (int(events.t_us[-1]) // 4096 + 1) * 4096
    with open_writer(path, 1280, 720) as writer:
        for k in range(0, count, len(events)):
            piece = events[: count - k]
            offset = k // len(events) * span
            writer.write(Events(piece.t_us + offset, piece.x, piece.y, piece.p))


def drain(pieces: Iterable[object]) -> None:
    """Read all, keep nothing."""
    for _ in pieces:
        pass


def read_by_evlcp(path: Path) -> None:
    with open_source(path) as source:
        drain(source.chunks())


def read_by_evt3(path: Path) -> None:
    import evt3

    drain(evt3.decode_file_batches(str(path), batch_bytes=1 << 20))


def read_by_faery(path: Path) -> None:
    import faery

    drain(faery.events_stream_from_file(path))


def main() -> None:
    parser = argparse.ArgumentParser(description="EVT3 decoding, side by side")
    parser.add_argument("recording", nargs="?", type=Path, default=RECORDING)
    parser.add_argument("--events", type=int, default=20_000_000)
    parser.add_argument("--rounds", type=int, default=21)
    given = parser.parse_args()
    events = read_events(given.recording)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tiled.raw"
        tile(events, path, given.events)
        columns = [getattr(read_events(path), name) for name in ("t_us", "x", "y", "p")]
        targets = [column.copy() for column in columns]

        def copy() -> None:
            for target, column in zip(targets, columns, strict=True):
                np.copyto(target, column)

        ways: dict[str, Callable[[], object]] = {"evlcp": lambda: read_by_evlcp(path)}
        for name, peer in (("evt3", read_by_evt3), ("faery", read_by_faery)):
            try:
                peer(path)
            except ImportError:
                print(f"{name}: not installed")
            else:
                ways[f"{name} {version(name)}"] = lambda peer=peer: peer(path)
        ways["a copy of the columns"] = copy
        took_s: dict[str, list[float]] = {name: [] for name in ways}
        for k in range(given.rounds):
            for name in list(ways)[:: -1 if k % 2 else 1]:
                began = time.process_time()
                ways[name]()
                took_s[name].append(time.process_time() - began)
    print("| way | Mev/s, best | median | time over evlcp's, by pairs (quartiles) |\n|---|---|---|---|")
    for name, times in took_s.items():
        low, middle, high = np.quantile(np.array(times) / np.array(took_s["evlcp"]), [0.25, 0.5, 0.75])
        best, usual = given.events / min(times) / 1e6, given.events / np.median(times) / 1e6
        print(f"| {name} | {best:.0f} | {usual:.0f} | {middle:.2f} ({low:.2f} to {high:.2f}) |")


if __name__ == "__main__":
    main()
