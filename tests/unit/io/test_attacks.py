"""Files that would take all memory or time, or have others read: one line, and little of either."""

import json
import sqlite3
import subprocess
import sys
from contextlib import closing
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


def declare(file, rows, kind, chunk):
    """Columns that hold nothing, and say that they hold much."""
    for name in "txyp":
        file.create_dataset(f"events/{name}", (rows,), kind, chunks=(chunk,), compression="gzip")


def store_in(file, name):
    """Columns whose values are bytes of another file."""
    group = file.create_group("events")
    for column in "txyp":
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_external(str(name).encode(), 0, 100)
        space = h5py.h5s.create_simple((100,))
        h5py.h5d.create(group.id, column.encode(), h5py.h5t.STD_U8LE, space, dcpl=plist)


def map_on(file, other):
    """Columns that are views of another file's."""
    for name in "txyp":
        layout = h5py.VirtualLayout((10,), "i8")
        layout[:] = h5py.VirtualSource(str(other), f"/events/{name}", (10,))
        file.create_virtual_dataset(f"events/{name}", layout)


def link_to(file, other):
    for name in "txyp":
        file[f"events/{name}"] = h5py.ExternalLink(str(other), f"/events/{name}")


HDF5 = {
    "one chunk of zeros": (lambda file, _: declare(file, 10**8, "u1", 10**8), "has chunks of 100 MB"),
    "many rows of nothing": (lambda file, _: declare(file, 10**12, "i8", 1 << 16), "bytes can hold"),
    "external storage": (lambda file, _: store_in(file, Path("/etc/passwd")), "is stored in another file"),
    "external link": (
        lambda file, folder: file.update(events=h5py.ExternalLink(str(folder / "other.h5"), "/events")),
        "/events is a link, expected it in the file itself",
    ),
    "external links of columns": (
        lambda file, folder: link_to(file, folder / "other.h5"),
        "expected x, y, p and t",
    ),
    "virtual": (lambda file, folder: map_on(file, folder / "other.h5"), "is stored in another file"),
    "a link to itself": (lambda file, _: file.update(events=h5py.SoftLink("/events")), "/events is a link"),
}
TABLES = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)",
    "INSERT INTO topics VALUES (1, '/e', 'event_camera_msgs/msg/EventPacket')",
)
ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 'a' AS name FROM n"
BAGS = {
    "messages of zeroblob": (
        (
            *TABLES,
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT,"
            " data GENERATED ALWAYS AS (zeroblob(1000000000)))",
            "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)",
        ),
        "too big",
    ),
    "an endless view": ((f"CREATE VIEW topics AS {ENDLESS}",), "found no table 'topics'"),
}
MATLAB = {"matlab 7": "bytes can hold", "matlab 5": "holds 320 MB, expected at most 300"}
WORDS = {name: words for name, (_, words) in (HDF5 | BAGS).items()} | MATLAB


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """How `evlcp info` ended and what it said, by file, all in one process; and its peak memory, MB."""
    from scipy.io import savemat

    folder = tmp_path_factory.mktemp("attacks")
    with h5py.File(folder / "other.h5", "w") as file:
        for name in "txyp":
            file[f"events/{name}"] = np.arange(10)
    for name, (fill, _) in HDF5.items():
        with h5py.File(folder / name, "w") as file:
            fill(file, folder)
    for name, (statements, _) in BAGS.items():
        with closing(sqlite3.connect(folder / name)) as base, base:
            for statement in statements:
                base.execute(statement)
    with h5py.File(folder / "matlab 7", "w", userblock_size=512) as file:
        for name in "txyp":
            file.create_dataset(name, (1, 600_000_000), "u8", chunks=(1, 1000))
    with (folder / "matlab 7").open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file")
    zeros = {name: np.zeros(10**7) for name in "txyp"}
    savemat(folder / "matlab 5", zeros, do_compression=True, appendmat=False)
    command = [sys.executable, "-c", READ, *(folder / name for name in WORDS)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    by_path, peak_mb = json.loads(done.stdout)
    return {Path(path).name: ended for path, ended in by_path.items()} | {"peak_mb": peak_mb}


@pytest.mark.parametrize("name", WORDS)
def test_an_attack_is_one_line(name, told):
    code, err = told[name]
    assert (code, err.count("\n")) == (3, 1), err
    assert WORDS[name] in err


def test_attacks_take_little_memory(told):
    assert told["peak_mb"] < 500
