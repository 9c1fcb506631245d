"""Bags of real cameras, and files of HDF5, give the events that are in them."""

import json
import re
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evlcp_formats.bags import _of_cdr

from evlcp_sdk.errors import InputError
from evlcp_sdk.io import open_source, open_writer, read_events
from evlcp_sdk.values import Events, Triggers
from tests.conftest import ROOT

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


def packed(
    seq: int, words: bytes, frame_id: str = "cam", order: str = "<", size: tuple[int, int] = (640, 480)
) -> bytes:
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
    (
        add("I", size[1]),
        add("I", size[0]),
        add("Q", seq),
        add("Q", 0),
        text("evt3"),
        add("B", 0),
        add("I", len(words)),
    )
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


@pytest.fixture(scope="module")
def messages() -> list[bytes]:
    """The recording that comes with the package, in 60 packets."""
    data = (ROOT / "examples" / "recordings" / "night-50m-30kmh-cut.raw").read_bytes()
    words = data[data.index(b"% end\n") + 6 :] if b"% end\n" in data[:2000] else data.split(b"\n%")[-1]
    size = len(words) // 120 * 2
    pieces = [words[k : k + size] for k in range(0, len(words), size)]
    return [packed(n, piece, size=(1280, 720)) for n, piece in enumerate(pieces)]


def same_as_the_recording(path: Path) -> Any:
    expected = read_events(ROOT / "examples" / "recordings" / "night-50m-30kmh-cut.raw")
    with open_source(path) as source:
        got, _ = source.read()
    for name in ("t_us", "x", "y", "p"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    assert not source.losses
    return source


@pytest.mark.parametrize("listed", [True, False])
def test_files_of_a_folder_are_read_in_their_order(
    listed: bool, messages: list[bytes], tmp_path: Path
) -> None:
    """Twelve: by their names, 10 would come before 2."""
    for n in range(12):
        bag(tmp_path / f"name_{n}.db3", messages[n * 6 : n * 6 + 6])
    paths = "".join(f"    - name_{n}.db3\n" for n in range(12)) if listed else ""
    head = "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n" if listed else ""
    (tmp_path / "metadata.yaml").write_text(f"{head}{paths}  duration:\n    nanoseconds: 80000000\n")
    source = same_as_the_recording(tmp_path)
    assert "packets_out_of_order" not in source.counts
    if listed:
        (tmp_path / "name_3.db3").unlink()
        with pytest.raises(InputError, match=r"metadata\.yaml names name_3\.db3, which is not there"):
            open_source(tmp_path)


@pytest.mark.parametrize("kind", ["db3", "mcap", "bag"])
@pytest.mark.parametrize("how", ["one is 0", "jitter", "go round"])
def test_packets_are_in_order_whatever_their_log_times(
    how: str, kind: str, messages: list[bytes], tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    times = 10**9 + 10**7 * np.arange(len(messages))
    if how == "one is 0":
        times[30] = 0
    elif how == "jitter":
        times += rng.integers(-3 * 10**7, 3 * 10**7, len(times))
    else:
        times[35:] -= times[35]
    path = tmp_path / f"a.{kind}"
    if kind == "db3":
        bag(path, messages)
        with sqlite3.connect(path) as base:
            stamped = [(at, n) for n, at in enumerate(times.tolist())]
            base.executemany("UPDATE messages SET timestamp = ? WHERE id = ?", stamped)
        base.close()
    elif kind == "mcap":
        writer = pytest.importorskip("mcap.writer")
        with path.open("wb") as file:
            made = writer.Writer(file, chunk_size=200_000)
            made.start()
            schema = made.register_schema("event_camera_msgs/msg/EventPacket", "ros2msg", b"")
            channel = made.register_channel("/events", "cdr", schema)
            for at, data in zip(times.tolist(), messages, strict=True):
                made.add_message(channel, log_time=at, data=data, publish_time=at)
            made.finish()
    else:
        rosbag1 = pytest.importorskip("rosbags.rosbag1")
        typesys = pytest.importorskip("rosbags.typesys")
        store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
        text = "Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        name = "event_camera_msgs/msg/EventPacket"
        store.register(typesys.get_types_from_msg(text + "bool is_bigendian\nuint8[] events\n", name))
        with rosbag1.Writer(path) as out:
            connection = out.add_connection("/events", name, typestore=store)
            for at, data in zip(times.tolist(), messages, strict=True):
                # Without its byte order, the gap before its number, and what makes fields even: by hand.
                out.write(connection, at, ros1_of(data))
    source = same_as_the_recording(path)
    assert kind != "bag" or how == "go round" or source.counts["packets_out_of_order"] > 0


def ros1_of(data: bytes) -> bytes:
    """The same message as ROS 1 has it."""
    packet = _of_cdr(Path("a"), data)
    text = b"\x04\0\0\0evt3"
    numbers = struct.pack("<IIQQ", packet.height, packet.width, packet.seq, 0)
    header = struct.pack("<IIII", 0, 1, 2, 3) + b"cam"
    return header + numbers + text + b"\0" + struct.pack("<I", len(packet.data)) + bytes(packet.data)


@pytest.mark.parametrize("how", ["one after the other", "a hundred later"])
def test_packets_that_are_there_twice_are_left_out(how: str, messages: list[bytes], tmp_path: Path) -> None:
    both = [m for one in messages for m in (one, one)] if how.startswith("one") else messages * 2
    source = same_as_the_recording(bag(tmp_path / "a.db3", both))
    assert source.counts["packets_twice"] == len(messages)


def test_a_driver_that_begins_anew(messages: list[bytes], tmp_path: Path) -> None:
    """Numbers from 0 again, other words: what came before is given first, and nothing is missing."""
    words = [bytes(_of_cdr(Path("a"), data).data) for data in messages]
    again = [packed(n, words[n + 40], size=(1280, 720)) for n in range(len(words) - 40)]
    same_as_the_recording(bag(tmp_path / "a.db3", messages[:40] + again))


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


def test_a_bag_that_is_written_is_read_back(
    demo_raw: Path, tmp_path: Path, evlcp: Callable[..., Any]
) -> None:
    """By our reader; by `rosbags`, which knows ROS 2's own packing; and by `mcap`, word for word."""
    pytest.importorskip("mcap"), pytest.importorskip("rosbags")
    path = tmp_path / "a.mcap"
    edges = Triggers.of([5, 12_345, 70_000], [0, 0, 1], [1, 0, 1])
    with open_source(demo_raw) as source, open_writer(path, 1280, 720) as writer:
        told, _ = source.read()
        cut = len(told) // 3
        edge = int(np.searchsorted(edges.t_us, told.t_us[cut]))
        for events, triggers in ((told[:cut], edges[:edge]), (told[cut:], edges[edge:])):
            writer.write(events, triggers)
    with open_source(path) as source:
        got, ticks = source.read()
        assert (source.format, source.width, source.height, source.losses) == ("BAG", 1280, 720, {})
    for name in ("t_us", "x", "y", "p"):
        assert (getattr(got, name) == getattr(told, name)).all()
    assert ticks.t_us.tolist() == edges.t_us.tolist()

    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    words, seqs = b"", []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            assert (schema.name, schema.encoding) == ("event_camera_msgs/msg/EventPacket", "ros2msg")
            assert (channel.topic, channel.message_encoding) == ("/event_camera/events", "cdr")
            if not seqs:
                # What the file says its messages are, and not what we think.
                text = schema.data.decode().split("=" * 80)[0]
                store.register(get_types_from_msg(text, schema.name))
            packet: Any = store.deserialize_cdr(message.data, schema.name)
            stamp = packet.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == message.log_time
            assert (packet.encoding, packet.width, packet.height) == ("evt3", 1280, 720)
            words, seqs = words + packet.events.tobytes(), [*seqs, packet.seq]
    assert seqs == list(range(len(seqs)))
    assert len(seqs) >= 8
    (tmp_path / "words.raw").write_bytes(b"% evt 3.0\n% geometry 1280x720\n% end\n" + words)
    assert (read_events(tmp_path / "words.raw").t_us == told.t_us).all()

    done = evlcp("convert", path, "-o", tmp_path / "back.raw", "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out)["counts"] == {"events": len(told), "triggers": 3}
    assert (read_events(tmp_path / "back.raw").x == told.x).all()


def test_a_command_that_converts_says_what_is_wrong(
    demo_raw: Path, tmp_path: Path, evlcp: Callable[..., Any]
) -> None:
    done = evlcp("convert", demo_raw, "-o", tmp_path / "a.npz")
    assert (done.code, done.out) == (0, f"{tmp_path / 'a.npz'}: 764,142 events, 0 triggers\n")
    for arguments, code, told in (
        (
            [demo_raw, "-o", tmp_path / "a.txt"],
            1,
            "suffix '.txt', expected .raw, .npz, .csv, .csv.gz or format EVT2",
        ),
        ([tmp_path / "a.npz", "-o", tmp_path / "a.raw"], 0, ""),
        ([tmp_path / "a.npz", "-o", tmp_path / "a.raw", "--size", "9"], 2, "'9': expected WIDTHxHEIGHT"),
        ([tmp_path / "none.raw", "-o", tmp_path / "a.raw"], 3, "none.raw: No such file"),
    ):
        done = evlcp("convert", *arguments)
        assert (done.code, told in done.err) == (code, True), done.err
    cut = tmp_path / "cut.csv"
    cut.write_text("t_us,x,y,p\n1,2,3,1\n2,3,what,0\n")
    done = evlcp("convert", cut, "--size", "1280x720", "-o", tmp_path / "cut.raw")
    assert done.code == 3
    assert "line 3" in done.err
    assert (tmp_path / "cut.raw").exists()


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


@pytest.mark.parametrize("on_its_side", [False, True])
@pytest.mark.parametrize("order", ["txyp", "xypt", "ptyx"])
def test_hdf5_tables_without_names(order: str, on_its_side: bool, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    columns = {"t": EVENTS.t_us, "x": EVENTS.x, "y": EVENTS.y, "p": EVENTS.p}
    table = np.stack([columns[name].astype(np.int64) for name in order], axis=0 if on_its_side else 1)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["events"] = table
    with open_source(f"hdf5:{tmp_path / 'a.h5'}?columns={order}") as source:
        got, _ = source.read()
    for name in ("t_us", "x", "y", "p"):
        assert (getattr(got, name) == getattr(EVENTS, name)).all()
    with open_source(f"hdf5:{tmp_path / 'a.h5'}?columns={order}&swapped=1") as source:
        got, _ = source.read()
    assert (got.x == EVENTS.y).all()
    assert (got.y == EVENTS.x).all()
    if order.index("x") < order.index("y"):
        # By its values, as those of a list.
        assert (read_events(tmp_path / "a.h5").x == EVENTS.x).all()
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["events"] = np.arange(40.0).reshape(10, 4)
    for name, told in (
        (str(tmp_path / "b.h5"), "say which columns they are, as by hdf5:PATH?columns=txyp"),
        (f"hdf5:{tmp_path / 'a.h5'}?columns=txy", "columns = 'txy': expected the letters t, x, y and p"),
    ):
        with pytest.raises(InputError, match=re.escape(told)):
            open_source(name)


def test_what_is_wrong_with_hdf5_is_said(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["images"] = file["other"] = np.zeros(3)
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
        ("other.h5", "found images, other, expected /events or /raw_events or /CD/events"),
        ("short.h5", "/events has x, expected x, y, p and t"),
        ("ecf.h5", "compressed by ECF, Prophesee's own codec"),
    ):
        with pytest.raises(InputError) as fault:
            open_source(tmp_path / name)
        assert told in str(fault.value)
