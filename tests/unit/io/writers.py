"""Tables of events and bags, written as other people's tools write them; a package that is missing skips."""

import sqlite3
import struct
from contextlib import closing

import numpy as np
import pytest


def records(**columns):
    return np.rec.fromarrays(list(columns.values()), names=list(columns))


def write_npz(path, arrays):
    np.savez_compressed(path, allow_pickle=True, **arrays)


def write_npy(path, arrays):
    (array,) = arrays.values()
    np.save(path, array)


def write_mat(path, arrays):
    """Records become a structure of arrays, beside which stands something else."""
    from scipy.io import savemat

    named = {
        key: {name: array[name] for name in array.dtype.names} if array.dtype.names else array
        for key, array in arrays.items()
    }
    savemat(path, {**named, "note": "30 m"}, do_compression=True)


def write_hdf5(path, arrays):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, column in arrays.items():
            place = name if len(arrays) == 1 else f"raw_events/{name}"
            file.create_dataset(place, data=column, compression="gzip")
        file.attrs["width"], file.attrs["height"] = 640, 480


def write_records(path, arrays):
    write_hdf5(path, {"CD/events": records(**arrays)})


def write_mat_73(path, arrays):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, column in arrays.items():
            file[name] = column[None, :]
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")


KIND = "event_camera_msgs/msg/EventPacket"
DEFINITION = (
    "Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
    "bool is_bigendian\nuint8[] events\n"
)


def pack_ros2(packet, order="<"):
    """A message of ROS 2, by hand: every field at a multiple of its size."""
    seq, words = packet
    head = struct.pack(f"{order}iII4sIIQQ", 1, 2, 4, b"cam\0", 720, 1280, seq, 0)
    tail = struct.pack(f"{order}I5sBxxI", 5, b"evt3\0", 0, len(words))
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + head + tail + words


def pack_ros1(packet):
    """A message of ROS 1: nothing stands between fields, and the header has a number of its own."""
    seq, words = packet
    head = struct.pack("<IIII3sIIQQ", 0, 1, 2, 3, b"cam", 720, 1280, seq, 0)
    return head + struct.pack("<I4sBI", 4, b"evt3", 0, len(words)) + words


def write_sqlite(path, messages, times, topics=1):
    with closing(sqlite3.connect(path)) as base, base:
        base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB)")
        for n in range(1, topics + 1):
            base.execute("INSERT INTO topics VALUES (?, ?, ?)", (n, f"/{n}", KIND))
        rows = [(n, at, data) for n, (at, data) in enumerate(zip(times, messages, strict=False))]
        base.executemany("INSERT INTO messages VALUES (?, 1, ?, ?)", rows)
    return path


def write_mcap(path, messages, times):
    writer = pytest.importorskip("mcap.writer")
    with path.open("wb") as file:
        made = writer.Writer(file, chunk_size=200_000)
        made.start()
        channel = made.register_channel("/events", "cdr", made.register_schema(KIND, "ros2msg", b""))
        for at, data in zip(times, messages, strict=True):
            made.add_message(channel, log_time=at, data=data, publish_time=at)
        made.finish()


def write_ros1(path, messages, times):
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    store.register(typesys.get_types_from_msg(DEFINITION, KIND))
    with rosbag1.Writer(path) as out:
        connection = out.add_connection("/events", KIND, typestore=store)
        for at, data in zip(times, messages, strict=True):
            out.write(connection, at, data)
