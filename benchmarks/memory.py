"""Peak memory of `evlcp receive` on what is hard for it, beside that of an interpreter with numba alone.

    python benchmarks/memory.py [CASE ...] [--keep FOLDER] [--most 500]

Each case is made, then received in a process of its own, kernels compiled before but in a "first run". A row
says the peak of that process's resident memory (VmHWM, so Linux only) or of a child of it, whichever is
higher, how long it took, how it ended, and what was dropped for want of room. Ends with 1 where a case takes
more than `--most` MB.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from evt3_decode import tile
from numpy.typing import NDArray

import evlcp_sdk as evlcp
from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.io import read_events
from evlcp_sdk.io.evt import EVT2
from evlcp_sdk.io.raw import RawWriter, format_header
from evlcp_sdk.values import Events

NIGHT = Path(__file__).parents[2] / "shared" / "recordings" / "night-50m-30kmh.raw"
WIDTH, HEIGHT = 1280, 720
CHIP_US = 100
PIECE_US = 10_000

ALONE = "import numba; numba.njit(lambda x: x + 1)(1); code = 0"
COMMAND = """
from evlcp_sdk.cli.main import main
try: main()
except SystemExit as end: code = end.code or 0
else: code = 0
"""
PEAK = """
import os, resource
try:
    while True: os.wait()
except ChildProcessError: pass
children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
with open("/proc/self/status") as file:
    peak = next(line.split()[1] for line in file if line.startswith("VmHWM"))
print(f"\\n{code} {max(int(peak), children)}")
"""

Recorded = Iterator[Events]


def in_order(t_us: NDArray[np.int64], x: NDArray[np.int64], y: NDArray[np.int64], p: object) -> Events:
    """Events sorted by time."""
    order = np.argsort(t_us, kind="stable")
    p = np.broadcast_to(np.asarray(p), t_us.shape)
    return Events.of(t_us[order], x[order], y[order], p[order])


def edges(rng: np.random.Generator, places: int, until_us: int) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Times at which places rise in the rhythm of a code, and which of them do."""
    due = rng.integers(1, 5, places)
    for chip in range(until_us // CHIP_US):
        (rising,) = np.nonzero(due == chip)
        due[rising] += rng.integers(2, 5, len(rising))
        yield chip * CHIP_US, rising


def blobs(columns: int, rows: int, rate: float, duration_us: int) -> Recorded:
    """Blobs of 4 px in a grid, each blinking with a code of its own, `rate` events a second in all."""
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    x, y = (u.ravel() * (WIDTH // columns) + 6), (v.ravel() * (HEIGHT // rows) + 6)
    burst = max(round(rate * 3 * CHIP_US * 1e-6 / (4 * len(x)) / 2), 1)
    pieces: list[Events] = []
    for t_us, rising in edges(rng, len(x), duration_us):
        shape = (len(rising), 4, burst)
        left = np.broadcast_to(x[rising, None, None] + np.array([0, 1, 0, 1])[:, None], shape).ravel()
        top = np.broadcast_to(y[rising, None, None] + np.array([0, 0, 1, 1])[:, None], shape).ravel()
        on, off = t_us + rng.integers(0, 20, (2, left.size)) + np.array([[0], [40]])
        t = np.concatenate([on, off])
        p = np.repeat([1, 0], left.size)
        pieces.append(in_order(t, np.tile(left, 2), np.tile(top, 2), p))
        if len(pieces) == PIECE_US // CHIP_US:
            yield Events.concat(pieces)
            pieces = []


def noise(rate: float, duration_us: int) -> Recorded:
    """Events anywhere at any time."""
    rng = np.random.default_rng(0)
    many = round(rate * PIECE_US * 1e-6)
    for start in range(0, duration_us, PIECE_US):
        t_us = start + np.sort(rng.integers(0, PIECE_US, many))
        yield Events.of(
            t_us, rng.integers(0, WIDTH, many), rng.integers(0, HEIGHT, many), rng.integers(0, 2, many)
        )


def flicker(period_us: int, share: float, duration_us: int) -> Recorded:
    """A lamp that all the sensor sees: at each turn a share of the pixels answers."""
    rng = np.random.default_rng(0)
    many = round(WIDTH * HEIGHT * share)
    for k, start in enumerate(range(0, duration_us, period_us // 2)):
        place = rng.integers(0, WIDTH * HEIGHT, many)
        t_us = start + np.sort(rng.integers(0, 30, many))
        yield Events.of(t_us, place % WIDTH, place // WIDTH, np.full(many, 1 - k % 2))


def in_code(share: float, duration_us: int) -> Recorded:
    """All the sensor blinks with one code: at each rise and fall a share of the pixels answers."""
    rng = np.random.default_rng(0)
    many = round(WIDTH * HEIGHT * share)
    for t_us, rising in edges(rng, 1, duration_us):
        for p in (1, 0) if len(rising) else ():
            place = rng.integers(0, WIDTH * HEIGHT, many)
            t = t_us + 40 * (1 - p) + np.sort(rng.integers(0, 20, many))
            yield Events.of(t, place % WIDTH, place // WIDTH, np.full(many, p))


def a_wall() -> Recorded:
    """A bar as large as the sensor, 45 rows a cluster; a tenth of the pixels answers at each edge."""
    rng = np.random.default_rng(0)
    link = evlcp.load_link()
    shape = (3, link.packet.frames, link.codebook.clusters)
    symbols = rng.integers(0, len(link.codebook.codewords), shape)
    chips = np.concatenate([packet_chips(one, link.codebook) for one in symbols]).astype(int)
    rows = HEIGHT // chips.shape[1]
    for n, (before, after) in enumerate(pairwise(chips), 1):
        changed = np.flatnonzero(before != after)
        many = round(WIDTH * rows * 0.1)
        y = (changed[:, None] * rows + rng.integers(0, rows, (len(changed), many))).ravel()
        t_us = n * CHIP_US + rng.integers(0, 20, y.size)
        yield in_order(t_us, rng.integers(0, WIDTH, y.size), y, np.repeat(after[changed], many))


def eight_bars() -> Recorded:
    """Eight bars side by side at 40 m, rendered."""
    bars = [{"x_m": -7.0 + 2 * k, "y_m": 0.2, "seed": k + 1} for k in range(8)]
    scene = {"name": "eight", "duration_s": 0.5, "motion": {"distance_m": 40.0}, "bars": bars}
    with evlcp.simulate(scene, 1) as source:
        yield from source.chunks()


def raw(path: Path, pieces: Recorded) -> Path:
    """Write events as EVT3."""
    with RawWriter(path.with_suffix(".raw"), WIDTH, HEIGHT) as writer:
        for piece in pieces:
            writer.write(piece)
    return writer.path


def tile_recording(path: Path) -> Path:
    """A recording again and again."""
    tile(read_events(NIGHT), path.with_suffix(".raw"), 40_000_000)
    return path.with_suffix(".raw")


def leaping_clock(path: Path) -> Path:
    """65 536 events in EVT2, TIME_HIGH a month later every 16th one."""
    rng = np.random.default_rng(0)
    high = np.arange(0, 4096) * (30 * 86_400 * 1_000_000 >> 6) & 0xFFFFFFF
    place = rng.integers(0, WIDTH, (4096, 16)) << 11 | rng.integers(0, HEIGHT, (4096, 16))
    stamps = np.sort(rng.integers(0, 64, (4096, 16))) << 22
    words = np.concatenate([(8 << 28 | high)[:, None], 1 << 28 | stamps | place], axis=1)
    path = path.with_suffix(".raw")
    path.write_bytes(format_header(EVT2, WIDTH, HEIGHT) + words.astype("<u4").tobytes())
    return path


def zeros(path: Path, **columns: tuple[int, str]) -> Path:
    """An NPZ file of arrays full of zeros, compressed."""
    path = path.with_suffix(".npz")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, (rows, kind) in columns.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(
                    member, {"descr": kind, "fortran_order": False, "shape": (rows,)}
                )
                left = rows * np.dtype(kind).itemsize
                while left:
                    left -= member.write(bytes(min(left, 1 << 24)))
    return path


def one_time(path: Path) -> Path:
    """A hundred million events in one microsecond, in one pixel."""
    n = 100_000_000
    return zeros(path, t_us=(n, "<i8"), x=(n, "<u2"), y=(n, "<u2"), p=(n, "u1"))


def triggers(path: Path) -> Path:
    """Three hundred million triggers and an event."""
    n = 300_000_000
    events = {"t_us": (1, "<i8"), "x": (1, "<u2"), "y": (1, "<u2"), "p": (1, "u1")}
    more = {"trigger_t_us": (n, "<i8"), "trigger_channel": (n, "u1"), "trigger_value": (n, "u1")}
    return zeros(path, **events, **more)


CASES: dict[str, Callable[[Path], Path]] = {
    "night-50m": lambda path: Path(shutil.copy(NIGHT, path.with_suffix(".raw"))),
    "night-50m, tiled to 40 Mev": tile_recording,
    "eight bars": lambda path: raw(path, eight_bars()),
    "a bar as large as the sensor": lambda path: raw(path, a_wall()),
    "252 blobs of 4 px, 40 Mev/s": lambda path: raw(path, blobs(21, 12, 40e6, 300_000)),
    "3600 blobs of 4 px, 40 Mev/s": lambda path: raw(path, blobs(80, 45, 40e6, 150_000)),
    "noise, 60 Mev/s": lambda path: raw(path, noise(60e6, 300_000)),
    "noise, 1 Gev/s": lambda path: raw(path, noise(1e9, 30_000)),
    "all the sensor flickers, 100 Hz": lambda path: raw(path, flicker(10_000, 1.0, 100_000)),
    "all the sensor blinks in code": lambda path: raw(path, in_code(0.1, 60_000)),
    "EVT2, leaps of months": leaping_clock,
    "NPZ, 1e8 events in 1 us": one_time,
    "NPZ, 3e8 triggers": triggers,
}


AGAIN: dict[str, tuple[str, tuple[str, ...], bool]] = {
    "eight bars, --figures --parquet": ("eight bars", ("--figures", "--parquet"), False),
    "night-50m, first run": ("night-50m", (), True),
    "eight bars, first run, --figures --parquet": ("eight bars", ("--figures", "--parquet"), True),
}
"""Cases received in another way: with options, and without kernels compiled before."""


def run_measured(code: str, *arguments: object, cache: Path | None = None) -> tuple[int, float, float, str]:
    """Run Python; exit code, peak memory, MB, seconds, and its stderr.

    Args:
        code: What sets `code`, the exit code.
        arguments: Its arguments.
        cache: Where numba keeps kernels, instead of its usual place.
    """
    began = time.perf_counter()
    command = [sys.executable, "-c", code + PEAK, *map(str, arguments)]
    environment = os.environ if cache is None else os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    ended, peak_kb = done.stdout.split()[-2:]
    return int(ended), float(peak_kb) / 1024, time.perf_counter() - began, done.stderr


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("cases", nargs="*", help="parts of their names; all without any")
    parser.add_argument("--keep", type=Path, help="folder in which the files stay, and are looked for")
    parser.add_argument("--most", type=float, default=500.0)
    args = parser.parse_args()
    usual: dict[str, tuple[str, tuple[str, ...], bool]] = {name: (name, (), False) for name in CASES}
    chosen = {
        name: how
        for name, how in (usual | AGAIN).items()
        if not args.cases or any(c in name for c in args.cases)
    }
    print("| case | MB | s | exit | dropped, left out |\n|---|---|---|---|---|")
    print(f"| an interpreter with numba | {run_measured(ALONE)[1]:.0f} | | | |", flush=True)
    above, todo = False, [case for case, *_ in chosen.values()]
    with tempfile.TemporaryDirectory() as folder:
        files = args.keep or Path(folder)
        files.mkdir(exist_ok=True)
        for name, (case, options, cold) in chosen.items():
            stem = files / "".join(c if c.isalnum() else "-" for c in case)
            found = (p for p in map(stem.with_suffix, (".raw", ".npz")) if p.exists())
            path = next(found, None) or CASES[case](stem)
            out, cache = Path(folder) / "out", Path(folder) / "cache" if cold else None
            arguments = ("receive", path, "-o", out, *options)
            code, peak_mb, elapsed_s, errors = run_measured(COMMAND, *arguments, cache=cache)
            if cache is not None:
                shutil.rmtree(cache)
            summary = out / "summary.json"
            counts = json.loads(summary.read_text())["counts"] if summary.exists() else {}
            lost = {k: n for k, n in counts.items() if n and ("dropped" in k or "left_out" in k)}
            lost |= {"frames": counts.get("frames", 0)}
            print(f"| {name} | {peak_mb:.0f} | {elapsed_s:.0f} | {code} | {lost} |", flush=True)
            if code not in (0, 4):
                print(errors)
            above |= peak_mb > args.most
            todo.pop(0)
            if not args.keep and case not in todo:
                path.unlink()
    sys.exit(above)


if __name__ == "__main__":
    main()
