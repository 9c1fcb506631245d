"""Bags of real cameras, and files of HDF5, give the events that are in them."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.errors import InputError
from evlcp_sdk.io import open_source, open_writer, read_events, write_events
from evlcp_sdk.values import Events, Triggers
from tests.conftest import ROOT
from tests.unit.io.writers import pack_ros1, pack_ros2, write_mcap, write_ros1, write_sqlite

BAGS = Path(__file__).parents[3].parent / "shared" / "recordings" / "bags"
RECORDING = ROOT / "examples" / "recordings" / "night-50m-30kmh-cut.raw"
shared = pytest.mark.skipif(not BAGS.is_dir(), reason="needs ../shared/recordings, which users do not have")


@shared
@pytest.mark.parametrize(
    ("name", "events", "triggers", "first_us", "last_us"),
    [
        ("{}/events-ros1.bag", 343474, 4157, 7139845, 9218023),
        ("{}/events-db3", 343474, 4157, 7139845, 9218023),
        ("bag:{}/events-db3/test_events_1.db3?topic=/event_camera/events", 343474, 4157, 7139845, 9218023),
        ("bag:{}/trigger-db3", 82469, 2, 14224870, 15476187),
    ],
)
def test_bags_of_real_cameras(name, events, triggers, first_us, last_us):
    if "ros1" in name:
        pytest.importorskip("rosbags")
    with open_source(name.format(BAGS)) as source:
        got, edges = source.read()
        assert (source.format, source.width, source.height) == ("BAG", 640, 480) or "trigger" in name
        assert source.losses == {}
    assert (len(got), len(edges)) == (events, triggers)
    assert (int(got.t_us[0]), int(got.t_us[-1])) == (first_us, last_us)


@pytest.fixture(scope="module")
def packets():
    """The recording that comes with the package, in 60 packets."""
    words = RECORDING.read_bytes().partition(b"% end\n")[2]
    size = len(words) // 120 * 2
    return list(enumerate(words[k : k + size] for k in range(0, len(words), size)))


def same_as_the_recording(path):
    expected = read_events(RECORDING)
    with open_source(path) as source:
        got, _ = source.read()
    for name in ("t_us", "x", "y", "p"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    assert not source.losses
    return source


@pytest.mark.parametrize("listed", [True, False])
def test_files_of_a_folder_are_read_in_their_order(listed, packets, tmp_path):
    """Twelve: by their names, 10 would come before 2."""
    for n in range(12):
        messages = list(map(pack_ros2, packets[n * 6 : n * 6 + 6]))
        write_sqlite(tmp_path / f"name_{n}.db3", messages, range(6))
    paths = "".join(f"    - name_{n}.db3\n" for n in range(12)) if listed else ""
    head = "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n" if listed else ""
    (tmp_path / "metadata.yaml").write_text(f"{head}{paths}  duration:\n    nanoseconds: 80000000\n")
    source = same_as_the_recording(tmp_path)
    assert "packets_out_of_order" not in source.counts
    if listed:
        (tmp_path / "name_3.db3").unlink()
        with pytest.raises(InputError, match=r"metadata\.yaml names name_3\.db3, which is not there"):
            open_source(tmp_path)


@pytest.mark.parametrize(
    ("write", "pack"), [(write_sqlite, pack_ros2), (write_mcap, pack_ros2), (write_ros1, pack_ros1)]
)
@pytest.mark.parametrize("how", ["one is 0", "jitter", "go round"])
def test_packets_are_in_order_whatever_their_log_times(how, write, pack, packets, tmp_path):
    times = 10**9 + 10**7 * np.arange(len(packets))
    if how == "one is 0":
        times[30] = 0
    elif how == "jitter":
        times += np.random.default_rng(1).integers(-3 * 10**7, 3 * 10**7, len(times))
    else:
        times[35:] -= times[35]
    write(tmp_path / "a.bag", [pack(packet) for packet in packets], times.tolist())
    source = same_as_the_recording(tmp_path / "a.bag")
    assert write is not write_ros1 or how == "go round" or source.counts["packets_out_of_order"] > 0


@pytest.mark.parametrize("how", ["one after the other", "a hundred later"])
def test_packets_that_are_there_twice_are_left_out(how, packets, tmp_path):
    both = [m for one in packets for m in (one, one)] if how.startswith("one") else packets * 2
    source = same_as_the_recording(write_sqlite(tmp_path / "a.db3", list(map(pack_ros2, both)), range(999)))
    assert source.counts["packets_twice"] == len(packets)


def test_packets_that_are_missing_are_counted(packets, tmp_path):
    there = [pack_ros2(packet) for packet in packets if packet[0] not in (20, 21, 40)]
    with open_source(write_sqlite(tmp_path / "a.db3", there, range(99))) as source:
        source.read()
    lost = source.losses["packets_lost"]
    assert (lost.count, lost.unit) == (3, "byte")
    assert lost.first == pytest.approx(sum(len(words) for _, words in packets[:20]), abs=200)


def test_a_driver_that_begins_anew(packets, tmp_path):
    """Numbers from 0 again, other words: what came before is given first, and nothing is missing."""
    again = [(n - 40, words) for n, words in packets[40:]]
    messages = [pack_ros2(one, order=">") for one in packets[:40] + again]
    same_as_the_recording(write_sqlite(tmp_path / "a.db3", messages, range(999)))


def test_what_is_wrong_with_a_bag_is_reported(tmp_path):
    message = pack_ros2((0, np.array([0x8001, 0x6000, 0x0005, 0x2007], "<u2").tobytes()))
    write_sqlite(tmp_path / "two.db3", [message], [0], topics=2)
    write_sqlite(tmp_path / "none.db3", [], [], topics=0)
    write_sqlite(tmp_path / "cut.db3", [message[:-3]], [0])
    write_sqlite(tmp_path / "other.db3", [message.replace(b"evt3", b"evt2")], [0])
    write_sqlite(tmp_path / "good.db3", [message], [0])
    (tmp_path / "no.bag").write_bytes(b"nothing of the kind")
    (tmp_path / "empty").mkdir()
    for name, wanted in (
        ("two.db3", "2 topics of type event_camera_msgs/EventPacket"),
        ("none.db3", "no topic of type event_camera_msgs/EventPacket (topics: none)"),
        ("good.db3?topic=/imu", "topic '/imu', expected one of type EventPacket"),
        ("cut.db3", "expected more: it is cut"),
        ("other.db3", "packets of encoding 'evt2', expected 'evt3'"),
        ("no.bag", "expected a bag of ROS 1, SQLite or MCAP"),
        ("empty", "a folder without .db3 or .mcap files"),
        ("gone", "No such file"),
    ):
        with pytest.raises(InputError, match=re.escape(wanted)):
            open_source(f"bag:{tmp_path / name}")


def test_a_bag_that_is_written_is_read_back(demo_raw, tmp_path, evlcp):
    """By our reader; by `rosbags`, which knows ROS 2's own packing; and by `mcap`."""
    pytest.importorskip("mcap"), pytest.importorskip("rosbags")
    path = tmp_path / "a.mcap"
    edges = Triggers.of([5, 12_345, 70_000], [0, 0, 1], [1, 0, 1])
    with open_source(demo_raw) as source, open_writer(path, 1280, 720) as writer:
        reported, _ = source.read()
        cut = len(reported) // 3
        edge = int(np.searchsorted(edges.t_us, reported.t_us[cut]))
        for events, triggers in ((reported[:cut], edges[:edge]), (reported[cut:], edges[edge:])):
            writer.write(events, triggers)
    with open_source(path) as source:
        got, ticks = source.read()
        assert (source.format, source.width, source.height, source.losses) == ("BAG", 1280, 720, {})
    for name in ("t_us", "x", "y", "p"):
        assert (getattr(got, name) == getattr(reported, name)).all()
    assert ticks.t_us.tolist() == edges.t_us.tolist()

    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    seqs = []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert (schema.name, schema.encoding) == ("event_camera_msgs/msg/EventPacket", "ros2msg")
            assert (channel.topic, channel.message_encoding) == ("/event_camera/events", "cdr")
            if not seqs:
                # What the file says its messages are, and not what we think.
                text = schema.data.decode().split("=" * 80)[0]
                store.register(get_types_from_msg(text, schema.name))
            packet = store.deserialize_cdr(message.data, schema.name)
            stamp = packet.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == message.log_time
            assert (packet.encoding, packet.width, packet.height) == ("evt3", 1280, 720)
            seqs.append(packet.seq)
    assert seqs == list(range(len(seqs)))
    assert len(seqs) >= 8

    done = evlcp("convert", path, "-o", tmp_path / "back.raw", "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out)["counts"] == {"events": len(reported), "triggers": 3}
    assert (read_events(tmp_path / "back.raw").x == reported.x).all()


def test_a_command_that_converts_says_what_is_wrong(tmp_path, evlcp):
    raw, npz, cut = (tmp_path / name for name in ("a.raw", "a.npz", "cut.csv"))
    write_events(raw, Events.of(range(1200), range(1200), [5] * 1200, [1] * 1200), 1280, 720)
    cut.write_text("t_us,x,y,p\n1,2,3,1\n2,3,what,0\n")
    for arguments, code, wanted in (
        ([raw, "-o", npz], 0, f"{npz}: 1,200 events, 0 triggers\n"),
        ([npz, "-o", raw], 0, f"{raw}: 1,200 events, 0 triggers\n"),
        ([raw, "-o", tmp_path / "a.txt"], 2, "suffix '.txt', expected .raw, .npz, .csv"),
        ([npz, "-o", raw, "--size", "9"], 2, "'9': expected WIDTHxHEIGHT"),
        ([cut, "-o", raw], 2, "expected a width and a height for EVT3"),
        ([tmp_path / "none.raw", "-o", raw], 3, "none.raw: No such file"),
        ([cut, "--size", "1280x720", "-o", tmp_path / "cut.raw"], 3, "line 3"),
    ):
        done = evlcp("convert", *arguments)
        assert (done.code, wanted in done.out + done.err) == (code, True), done.err
    assert (tmp_path / "cut.raw").exists()


def test_what_is_wrong_with_hdf5_is_reported(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["images"] = file["other"] = np.zeros(3)
    with h5py.File(tmp_path / "table.h5", "w") as file:
        file["events"] = np.arange(40.0).reshape(10, 4)
    with h5py.File(tmp_path / "ecf.h5", "w") as file:
        # As such a file says it: the filter need not be there to be asked for, where it may be left out.
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((4,))
        plist.set_filter(36559, h5py.h5z.FLAG_OPTIONAL, (0,))
        kind = h5py.h5t.py_create(np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")]))
        group = file.create_group("CD")
        h5py.h5d.create(group.id, b"events", kind, h5py.h5s.create_simple((4,), (4,)), dcpl=plist)
    for name, wanted in (
        ("other.h5", "found images, other, expected /events or /raw_events or /CD/events"),
        ("table.h5", "say which columns they are, as by hdf5:PATH?columns=txyp"),
        ("table.h5?columns=txy", "columns = 'txy': expected the letters t, x, y and p"),
        ("ecf.h5", "compressed by ECF, Prophesee's own codec"),
    ):
        with pytest.raises(InputError, match=re.escape(wanted)):
            open_source(f"hdf5:{tmp_path / name}")
