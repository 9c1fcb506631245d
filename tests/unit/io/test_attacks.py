"""Files that would take all memory or time, or have others read: one line, and little of either."""

import os
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

h5py = pytest.importorskip("h5py")

READ = (
    "from evlcp_sdk.cli.main import main\n"
    "try: main()\n"
    "except SystemExit as end:\n"
    "    kb = next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM'))\n"
    "    print(end.code, int(kb) // 1024)"
)
TOPIC = "INSERT INTO topics VALUES (1, '/e', 'event_camera_msgs/msg/EventPacket')"
TABLES = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)",
    TOPIC,
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB)",
)


def _matlab_of_nothing(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name in "txyp":
            file.create_dataset(name, (1, 600_000_000), "u8", chunks=(1, 1000))
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file")


def _one_chunk_of_zeros(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name in "txyp":
            made = file.create_dataset(f"events/{name}", (10**8,), "u1", chunks=(10**8,), compression="gzip")
            made[:1] = 0


def _many_rows_of_nothing(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name in "txyp":
            file.create_dataset(f"events/{name}", (10**12,), "i8", chunks=(1 << 16,))


def _another_file_s_bytes(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name in "txyp":
            space = h5py.h5s.create_simple((100,))
            plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            plist.set_external(b"/etc/passwd", 0, 100)
            group = file.require_group("events")
            h5py.h5d.create(group.id, name.encode(), h5py.h5t.STD_U8LE, space, dcpl=plist)


def _a_pipe_s_bytes(path: Path) -> None:
    os.mkfifo(path.with_suffix(".fifo"))
    with h5py.File(path, "w") as file:
        group = file.create_group("events")
        for name in "txyp":
            plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            plist.set_external(str(path.with_suffix(".fifo")).encode(), 0, 100)
            space = h5py.h5s.create_simple((100,))
            h5py.h5d.create(group.id, name.encode(), h5py.h5t.STD_U8LE, space, dcpl=plist)


def _links_to_another_file(path: Path) -> None:
    other = path.with_name("other.h5")
    with h5py.File(other, "w") as file:
        for name in "txyp":
            file[f"events/{name}"] = np.arange(10)
    with h5py.File(path, "w") as file:
        file["events"] = h5py.ExternalLink(str(other), "/events")


def _links_of_columns(path: Path) -> None:
    _links_to_another_file(path)
    with h5py.File(path, "w") as file:
        for name in "txyp":
            file[f"events/{name}"] = h5py.ExternalLink(str(path.with_name("other.h5")), f"/events/{name}")


def _virtual(path: Path) -> None:
    _links_to_another_file(path)
    with h5py.File(path, "w") as file:
        for name in "txyp":
            layout = h5py.VirtualLayout((10,), "i8")
            layout[:] = h5py.VirtualSource(str(path.with_name("other.h5")), f"/events/{name}", (10,))
            file.create_virtual_dataset(f"events/{name}", layout)


def _a_loop_of_groups(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["events"] = h5py.SoftLink("/events")


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
    "one chunk of zeros": ("a.h5", _one_chunk_of_zeros, "has chunks of 100 MB, expected at most 67"),
    "many rows of nothing": ("a.h5", _many_rows_of_nothing, "bytes can hold"),
    "external storage": ("a.h5", _another_file_s_bytes, "is stored in another file, expected it in this one"),
    "external storage in a pipe": ("a.h5", _a_pipe_s_bytes, "is stored in another file"),
    "external link": ("a.h5", _links_to_another_file, "/events is a link, expected it in the file itself"),
    "external links of columns": ("a.h5", _links_of_columns, "expected x, y, p and t"),
    "virtual": ("a.h5", _virtual, "is stored in another file"),
    "a link to itself": ("a.h5", _a_loop_of_groups, "/events is a link"),
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


@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack_is_one_line_and_takes_little(name: str, tmp_path: Path) -> None:
    file, make, words = ATTACKS[name]
    make(tmp_path / file)
    done: Any = subprocess.run(
        [sys.executable, "-c", READ, "info", tmp_path / file],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    code, peak_mb = done.stdout.split()[-2:]
    assert code == "3", done.stderr + done.stdout
    assert done.stderr.count("\n") == 1
    assert all(part in done.stderr for part in words.split("4...")), done.stderr
    assert int(peak_mb) < 500
