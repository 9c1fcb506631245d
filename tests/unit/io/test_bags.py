"""Bags of real cameras, and files of HDF5, give the events that are in them."""

import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.errors import InputError
from evlcp_sdk.io import open_source
from evlcp_sdk.values import Events

BAGS = Path(__file__).parents[3].parent / "shared" / "recordings" / "bags"
shared = pytest.mark.skipif(not BAGS.is_dir(), reason="needs ../shared/recordings, which users do not have")


@shared
@pytest.mark.parametrize(
    ("name", "events", "triggers", "first_us", "last_us"),
    [
        ("bag:{}/events-ros1.bag", 343474, 4157, 7139845, 9218023),
        ("{}/events-ros1.bag", 343474, 4157, 7139845, 9218023),
        ("{}/events-db3", 343474, 4157, 7139845, 9218023),
        ("bag:{}/events-db3/test_events_1.db3?topic=/event_camera/events", 343474, 4157, 7139845, 9218023),
        ("bag:{}/trigger-db3", 82469, 2, 14224870, 15476187),
    ],
)
def test_bags_of_real_cameras(name: str, events: int, triggers: int, first_us: int, last_us: int) -> None:
    if "ros1" in name:
        pytest.importorskip("rosbags")
    with open_source(name.format(BAGS)) as source:
        got, edges = source.read()
        assert (source.format, source.width, source.height) == ("BAG", 640, 480) or "trigger" in name
        assert source.losses == {}
    assert (len(got), len(edges)) == (events, triggers)
    assert (int(got.t_us[0]), int(got.t_us[-1])) == (first_us, last_us)


@shared
def test_other_codecs_and_topics_are_refused_in_one_line() -> None:
    pytest.importorskip("mcap")
    for name, told in (
        ("libcaer-mcap", "packets of encoding 'libcaer_cmp', expected 'evt3'"),
        ("events-db3?topic=/imu", "topic '/imu', expected one of type EventPacket"),
    ):
        with pytest.raises(InputError) as fault:
            open_source(f"bag:{BAGS / name}")
        assert told in str(fault.value)


def packed(seq: int, words: bytes, frame_id: str = "cam", order: str = "<") -> bytes:
    """A message of ROS 2, by hand: every field at a multiple of its size."""
    out = b""

    def add(code: str, value: int) -> None:
        nonlocal out
        size = struct.calcsize(code)
        out += bytes(-len(out) % size) + struct.pack(order + code, value)

    def text(value: str) -> None:
        nonlocal out
        add("I", len(value) + 1)
        out += value.encode() + b"\0"

    add("i", 1), add("I", 2), text(frame_id)
    add("I", 480), add("I", 640), add("Q", seq), add("Q", 0), text("evt3"), add("B", 0), add("I", len(words))
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + out + words


def bag(path: Path, messages: list[bytes], topics: tuple[str, ...] = ("/events",)) -> Path:
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB)")
        for n, name in enumerate(topics, 1):
            base.execute("INSERT INTO topics VALUES (?, ?, 'event_camera_msgs/msg/EventPacket')", (n, name))
        for n, data in enumerate(messages):
            base.execute("INSERT INTO messages VALUES (?, 1, ?, ?)", (n, n, data))
    base.close()
    return path


WORDS = np.array([0x8001, 0x6000, 0x0005, 0x2007, 0x6001, 0x2008], "<u2").tobytes()


@pytest.mark.parametrize("frame_id", ["", "a", "ab", "abc", "abcdefgh"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_fields_stand_where_their_size_says(frame_id: str, order: str, tmp_path: Path) -> None:
    messages = [packed(n, WORDS, frame_id, order) for n in (4, 5, 9)]
    with open_source(bag(tmp_path / "a.db3", messages)) as source:
        events, _ = source.read()
        assert (source.width, source.height) == (640, 480)
        assert events.x.tolist()[:2] == [7, 8]
        assert events.y.tolist()[:2] == [5, 5]
        assert events.t_us.tolist()[:2] == [4096, 4097]
        assert source.losses["packets_lost"].count == 3


def test_what_is_wrong_with_a_bag_is_said(tmp_path: Path) -> None:
    two = bag(tmp_path / "two.db3", [packed(0, WORDS)], ("/a", "/b"))
    none = bag(tmp_path / "none.db3", [], ())
    cut = bag(tmp_path / "cut.db3", [packed(0, WORDS)[:-3]])
    (tmp_path / "no.bag").write_bytes(b"nothing of the kind")
    (tmp_path / "empty").mkdir()
    for path, told in (
        (two, "2 topics of type event_camera_msgs/EventPacket"),
        (none, "no topic of type event_camera_msgs/EventPacket (topics: none)"),
        (cut, "expected more: it is cut"),
        (tmp_path / "no.bag", "expected a bag of ROS 1, SQLite or MCAP"),
        (tmp_path / "empty", "a folder without .db3 or .mcap files"),
        (tmp_path / "gone", "No such file"),
    ):
        with pytest.raises(InputError) as fault:
            open_source(f"bag:{path}")
        assert told in str(fault.value)


EVENTS = Events.of(np.arange(900) * 3, np.arange(900) % 640, np.arange(900) % 480, np.arange(900) % 2)


@pytest.mark.parametrize("layout", ["records", "columns", "signed"])
def test_hdf5_in_plain_layout(layout: str, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    columns = {"t": EVENTS.t_us, "x": EVENTS.x, "y": EVENTS.y, "p": EVENTS.p}
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        if layout == "records":
            records = np.zeros(900, [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
            for name, column in columns.items():
                records[name] = column
            file.create_dataset("CD/events", data=records, compression="gzip")
        else:
            for name, column in columns.items():
                spelled = f"raw_events/{name}s" if layout == "signed" else f"events/{name}"
                signed = layout == "signed" and name == "p"
                file[spelled] = column.astype(np.int8) * 2 - 1 if signed else column
            file.attrs["width"], file.attrs["height"] = 640, 480
    with open_source(tmp_path / "a.hdf5") as source:
        got, _ = source.read()
        assert (source.format, source.width) == ("HDF5", None if layout == "records" else 640)
        assert source.position_bytes == source.size_bytes
    for name in ("t_us", "x", "y", "p"):
        assert (getattr(got, name) == getattr(EVENTS, name)).all()


def test_what_is_wrong_with_hdf5_is_said(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["images"] = np.zeros(3)
    with h5py.File(tmp_path / "short.h5", "w") as file:
        file["events/x"] = np.zeros(3)
    with h5py.File(tmp_path / "ecf.h5", "w") as file:
        # As such a file says it: the filter need not be there to be asked for, where it may be left out.
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((4,))
        plist.set_filter(36559, h5py.h5z.FLAG_OPTIONAL, (0,))
        kind = h5py.h5t.py_create(np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")]))
        group = file.create_group("CD")
        h5py.h5d.create(group.id, b"events", kind, h5py.h5s.create_simple((4,), (4,)), dcpl=plist)
    for name, told in (
        ("other.h5", "found images, expected /events or /raw_events or /CD/events"),
        ("short.h5", "/events has x, expected x, y, p and t"),
        ("ecf.h5", "compressed by ECF, Prophesee's own codec"),
    ):
        with pytest.raises(InputError) as fault:
            open_source(tmp_path / name)
        assert told in str(fault.value)
