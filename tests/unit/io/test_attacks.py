"""Files that would take all memory or time, or have others read: one line, and little of either."""

import json
import os
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

h5py = pytest.importorskip("h5py")

READ = """\
import contextlib, io, json, sys
from evlcp_sdk.cli.main import main
told = {}
for path in sys.argv[1:]:
    sys.argv = ["evlcp", "info", path]
    with contextlib.redirect_stderr(io.StringIO()) as err, contextlib.redirect_stdout(io.StringIO()):
        try:
            main()
        except SystemExit as end:
            told[path] = end.code, err.getvalue()
peak_kb = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(json.dumps([told, int(peak_kb) // 1024]))
"""
TABLES = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)",
    "INSERT INTO topics VALUES (1, '/e', 'event_camera_msgs/msg/EventPacket')",
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB)",
)


def _matlab_of_nothing(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name in "txyp":
            file.create_dataset(name, (1, 600_000_000), "u8", chunks=(1, 1000))
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file")


def _declared(rows: int, kind: str, chunk: int) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        with h5py.File(path, "w") as file:
            for name in "txyp":
                file.create_dataset(f"events/{name}", (rows,), kind, chunks=(chunk,), compression="gzip")

    return make


def _stored_in(name: str) -> Callable[[Path], None]:
    """Columns whose values are those of another file, or come out of a pipe."""

    def make(path: Path) -> None:
        os.mkfifo(path.with_name("pipe"))
        with h5py.File(path, "w") as file:
            group = file.create_group("events")
            for column in "txyp":
                plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
                plist.set_external(str(path.parent / name).encode(), 0, 100)
                space = h5py.h5s.create_simple((100,))
                h5py.h5d.create(group.id, column.encode(), h5py.h5t.STD_U8LE, space, dcpl=plist)

    return make


def _in_another_file(how: Callable[[h5py.File, Path], None]) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        other = path.with_name("other.h5")
        with h5py.File(other, "w") as file:
            for name in "txyp":
                file[f"events/{name}"] = np.arange(10)
        with h5py.File(path, "w") as file:
            how(file, other)

    return make


@_in_another_file
def _linked(file: h5py.File, other: Path) -> None:
    for name in "txyp":
        file[f"events/{name}"] = h5py.ExternalLink(str(other), f"/events/{name}")


@_in_another_file
def _virtual(file: h5py.File, other: Path) -> None:
    for name in "txyp":
        layout = h5py.VirtualLayout((10,), "i8")
        layout[:] = h5py.VirtualSource(str(other), f"/events/{name}", (10,))
        file.create_virtual_dataset(f"events/{name}", layout)


def _matlab_5_of_zeros(path: Path) -> None:
    from scipy.io import savemat

    savemat(path, {name: np.zeros(10**7) for name in "txyp"}, do_compression=True)


def _sqlite(*statements: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        with sqlite3.connect(path) as base:
            for statement in statements:
                base.execute(statement)
        base.close()

    return make


ENDLESS = (
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
    " SELECT i AS id, 'a' AS name, 'b' AS type FROM n"
)
BLOB = "SELECT 1 AS id, zeroblob(1000000000) AS name, 'b' AS type"
ATTACKS: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "MATLAB 7.3 of nothing": ("a.mat", _matlab_of_nothing, "more than 4... bytes can hold"),
    "one chunk of zeros": (
        "a.h5",
        _declared(10**8, "u1", 10**8),
        "has chunks of 100 MB, expected at most",
    ),
    "many rows of nothing": ("a.h5", _declared(10**12, "i8", 1 << 16), "bytes can hold"),
    "external storage": (
        "a.h5",
        _stored_in("/etc/passwd"),
        "is stored in another file, expected",
    ),
    "external storage in a pipe": ("a.h5", _stored_in("pipe"), "is stored in another file"),
    "external link": (
        "a.h5",
        _in_another_file(lambda file, other: file.update(events=h5py.ExternalLink(str(other), "/events"))),
        "/events is a link, expected it in the file itself",
    ),
    "external links of columns": ("a.h5", _linked, "expected x, y, p and t"),
    "virtual": ("a.h5", _virtual, "is stored in another file"),
    "a link to itself": (
        "a.h5",
        _in_another_file(lambda file, _: file.update(events=h5py.SoftLink("/events"))),
        "/events is a link",
    ),
    "MATLAB 5 of zeros": ("a.mat", _matlab_5_of_zeros, "holds 320 MB, expected at most 300"),
    "a bag of zeroblob": (
        "a.db3",
        _sqlite(*TABLES, "DROP TABLE topics", f"CREATE VIEW topics AS {BLOB}"),
        "found no table 'topics'",
    ),
    "messages of zeroblob": (
        "a.db3",
        _sqlite(
            *TABLES[:2],
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT,"
            " data GENERATED ALWAYS AS (zeroblob(1000000000)))",
            "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)",
        ),
        "too big",
    ),
    "an endless view": ("a.db3", _sqlite(f"CREATE VIEW topics AS {ENDLESS}"), "found no table 'topics'"),
    "text that is no UTF-8": (
        "a.db3",
        _sqlite(TABLES[0], "INSERT INTO topics VALUES (1, CAST(x'ff' AS TEXT), 'b')", TABLES[2]),
        "no topic of type event_camera_msgs/EventPacket",
    ),
}


@pytest.fixture(scope="module")
def read(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, tuple[int, str]], int]:
    """How `evlcp info` ended and what it said of each, all in one process; and its peak memory, MB."""
    paths = {}
    for name, (file, make, _) in ATTACKS.items():
        paths[name] = tmp_path_factory.mktemp("attack") / file
        make(paths[name])
    command = [sys.executable, "-c", READ, *paths.values()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    told, peak_mb = json.loads(done.stdout)
    return {name: told[str(path)] for name, path in paths.items()}, peak_mb


@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack_is_one_line(name: str, read: tuple[dict[str, tuple[int, str]], int]) -> None:
    (code, err), words = read[0][name], ATTACKS[name][2]
    assert (code, err.count("\n")) == (3, 1), err
    assert all(part in err for part in words.split("4...")), err


def test_attacks_take_little_memory(read: tuple[dict[str, tuple[int, str]], int]) -> None:
    assert read[1] < 500
