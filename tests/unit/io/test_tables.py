"""NPZ and CSV tables: round trips, streaming, and a fault for every kind of bad content."""

import gzip
import io
import itertools
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from evlcp_sdk.errors import InputError, StreamError
from evlcp_sdk.io import open_source, open_writer, read_events, write_events
from evlcp_sdk.io.describe import Span
from evlcp_sdk.values import Events, Triggers

times, sides = st.integers(-(10**18) + 1, 10**18 - 1), st.integers(0, 65535)
tables = st.lists(st.tuples(times, sides, sides, st.integers(0, 1)), max_size=60).map(sorted)


def rows(events):
    return list(
        zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True)
    )


@pytest.mark.parametrize("name", ["a.npz", "a.csv", "a.csv.gz"])
def test_round_trip_is_the_identity(name, tmp_path_factory):
    path = tmp_path_factory.mktemp("tables") / name

    @settings(max_examples=30)
    @given(tables, st.integers(0, 60), st.integers(1, 50))
    def check(table, cut, max_events):
        events = Events.of(*(zip(*table, strict=True) if table else ([], [], [], [])))
        with open_writer(path) as writer:
            writer.write(events[:cut])
            writer.write(events[cut:])
        with open_source(path) as source:
            got = list(source.chunks(max_events))
            assert all(len(piece) <= max_events for piece in got)
            assert source.losses == {}
            assert source.counts == {"events": len(table), "triggers": 0}
            assert source.position_bytes == source.size_bytes
        assert rows(Events.concat(got)) == table

    check()


def npz(**changes):
    """Two good events in an NPZ file, but for some arrays; those given as bytes are members as they are."""
    arrays = {"t_us": [1, 2], "x": [3, 4], "y": [5, 6], "p": [1, 0], **changes}
    file = io.BytesIO()
    plain = {name: np.array(a) for name, a in arrays.items() if not isinstance(a, bytes | None)}
    np.savez(file, **plain)
    with zipfile.ZipFile(file, "a") as archive:
        for name in arrays.keys() - plain.keys():
            if arrays[name] is not None:
                archive.writestr(f"{name}.npy", arrays[name])
    return file.getvalue()


def npy(header, data=bytes(16)):
    """An array with this header."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


BAD_NPZ = {
    "empty": (b"", "found no NPZ file, expected one"),
    "a column missing": (npz(p=None), "found the arrays t_us, x, y, expected t and p"),
    "floats": (npz(x=[1.5, 2.0]), "row 1: place 1.5, expected whole numbers from 0 to 65535"),
    "objects": (npz(x=[None, 1]), r"array x: found no array of numbers \(.* objects"),
    "two dimensions": (npz(x=[[1, 2], [3, 4]]), r"array x: found int64 \(2, 2\), expected numbers"),
    "unequal lengths": (npz(y=[1]), "'y': 1.*expected one length"),
    "bad width": (npz(width="wide"), "array width: found <U4"),
    "polarity": (npz(p=[1, 7]), "row 2: polarity 7 beside 1, expected 0 and 1, or -1 and 1"),
    "a huge time": (npz(t_us=np.array([1, 1 << 63], np.uint64)), r"row 2: time 9\.22\d*e\+18 us, expected"),
    "no trigger channels": (npz(trigger_t_us=[1]), "found the arrays p, t_us, trigger_t_us, x, y, expected"),
    "a flipped byte": (npz().replace(b"\x03\x00\x00\x00\x00", b"\x03\x00\x01\x00\x00", 1), "Bad CRC-32"),
    "a header of code": (
        npz(t_us=npy(b"__import__('os')._exit(7)\n")),
        r"array t_us: found no array of numbers \(malformed",
    ),
    "rows beyond memory": (
        npz(t_us=npy(b"{'descr': '<i8', 'fortran_order': False, 'shape': (%s,)}\n" % (b"9" * 30))),
        r"array t_us: found no array of numbers \(Python int too large",
    ),
    "a pickle": (
        npz(t_us=npy(b"{'descr': '|O', 'fortran_order': False, 'shape': (2,)}\n")),
        r"array t_us: found no array of numbers \(.* objects",
    ),
}


HEAD = b"t_us,x,y,p\n"
TEN_THOUSAND = b"".join(b"%d,1,1,1\n" % t for t in range(10_000))
BAD_CSV = {
    "another header": (b"t,x,y,on air\n1,2,3,1\n", r"line 1: found 't,x,y,on air', expected the columns"),
    "a column missing": (HEAD + b"1,2,3\n", "line 2: found '1,2,3', expected a time and a polarity, x and y"),
    "a word": (HEAD + b"1,2,3,1\n\n1,two,3,1\n", "line 4: found '1,two,3,1', expected"),
    "x too large": (HEAD + b"1,1,1,1\n1,65536,3,1\n", "line 3: place 65536, expected whole numbers from 0"),
    "polarity": (HEAD + b"1,2,3,7\n", "line 2: polarity 7, expected 0 and 1, or -1 and 1, 1 and 2, 0"),
    "polarity 0": (b"t,p\n1,1\n2,-1\n3,0\n4,0\n", "line 4: polarity 0 beside -1 and 1, expected 0 and 1"),
    "polarity in a word": (b"t,p\n1,1\n2,up\n3,aside\n4,1\n", "line 4: polarity 'aside', expected 0 or 1,"),
    "a number without end": (HEAD + b"9" * 30 + b",2,3,1\n", r"line 2: time 1e\+30 us, expected a number"),
    "a line without end": (HEAD + b"1" * 3_000_000 + b"\n", "line 2: found '1{60}\\.\\.\\.', expected"),
    "nothing but such a line": (b"1" * 9_000_000, "line 1: found '1{60}\\.\\.\\.', expected the columns"),
    "cut gzip": (gzip.compress(HEAD + TEN_THOUSAND)[:10_000], r"bad\.csv: damaged or closed file"),
}


BAD = {
    f"{kind}: {name}": (kind, *bad)
    for kind, every in (("npz", BAD_NPZ), ("csv", BAD_CSV))
    for name, bad in every.items()
}


@pytest.mark.parametrize(("kind", "data", "message"), BAD.values(), ids=BAD.keys())
def test_a_bad_table_is_an_error(kind, data, message, tmp_path):
    path = tmp_path / f"bad.{kind}"
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read_events(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300
    assert "\n" not in str(caught.value)


def test_csv_has_no_place_for_triggers(tmp_path):
    with pytest.raises(StreamError, match=r"a\.csv: 1 trigger, which a CSV file has no place for"):
        write_events(tmp_path / "a.csv", Events.empty(), triggers=Triggers.of([1], [0], [1]))
    assert list(tmp_path.iterdir()) == []


def test_events_that_no_receiver_may_see_are_dropped_and_counted(tmp_path):
    table = {"t_us": [5, 9, 4, 8, 9, 10], "x": [1, 700, 2, 3, 4, 5], "y": [1] * 6, "p": [1] * 6}
    np.savez(tmp_path / "a.npz", width=640, height=480, **{k: np.array(v) for k, v in table.items()})
    for max_events in (1, 2, 10):
        with open_source(tmp_path / "a.npz") as source:
            got = Events.concat(source.chunks(max_events))
        assert got.t_us.tolist() == [4, 5, 8, 9, 10]
        assert source.counts["rows_out_of_order"] == 2
        assert {k: (v.count, v.unit) for k, v in source.losses.items()} == {"outside_sensor": (1, "row")}
    late = HEAD + b"50000,1,1,1\n40000,2,1,1\n30000,2,1,1\n60000,3,1,1\n60001,3,1,1\n"
    (tmp_path / "a.csv").write_bytes(late)
    with open_source(tmp_path / "a.csv") as source:
        assert source.read()[0].t_us.tolist() == [40000, 50000, 60000, 60001]
    assert source.counts["rows_out_of_order"] == 2
    assert sum(loss.count for loss in source.losses.values()) == 1


def test_content_tells_the_format_whatever_the_name(tmp_path):
    events = Events.of([1], [2], [3], [1])
    for name in ("NPZ", "CSV", "EVT3", "EVT2"):
        write_events(tmp_path / "a.bin", events, 640, 480, format=name.lower())
        with open_source(tmp_path / "a.bin") as source:
            assert source.format == name
            assert rows(source.read()[0]) == [(1, 2, 3, 1)]


def test_triggers_of_a_long_file_come_in_pieces(tmp_path):
    rng = np.random.default_rng(5)
    n, m = 40_000, 30_000
    t_us, trigger_us = (np.sort(rng.integers(0, 1_000_000, k)) for k in (n, m))
    trigger_us[:10_000] = 5
    triggers = Triggers.of(trigger_us, rng.integers(0, 8, m), rng.integers(0, 2, m))
    events = Events.of(t_us, rng.integers(0, 640, n), rng.integers(0, 480, n), rng.integers(0, 2, n))
    write_events(tmp_path / "a.npz", events, 640, 480, triggers)
    with open_source(tmp_path / "a.npz") as source:
        taken = list(source.stream(1000))
    assert max(len(column) for piece in taken for column in piece) == 1000
    assert rows(Events.concat(e for e, _ in taken)) == rows(events)
    for column in ("t_us", "channel", "value"):
        got = np.concatenate([getattr(g, column) for _, g in taken])
        assert np.array_equal(got, getattr(triggers, column))
    # A piece holds the triggers up to its last event, and no later piece one from before that.
    for (e, g), (later, rest) in itertools.pairwise(taken):
        if len(e) and len(rest):
            assert rest.t_us[0] >= e.t_us[-1]
        if len(e) and len(g) and len(later):
            assert later.t_us[0] >= g.t_us[-1]


def test_many_triggers_in_a_small_file_take_little_memory(tmp_path):
    """10^8 triggers are 1 GB; packed, they are a file of 1 MB."""
    path, n = tmp_path / "a.npz", 100_000_000
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in ("t_us", "x", "y", "p"):
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.array([0, 1], np.int64))
        zeros = bytes(1 << 24)
        for name in ("trigger_t_us", "trigger_channel", "trigger_value"):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                head = {"descr": "|u1", "fortran_order": False, "shape": (n,)}
                np.lib.format.write_array_header_1_0(member, head)
                for k in range(0, n, len(zeros)):
                    member.write(zeros[: n - k])
    assert path.stat().st_size < 3e6
    write_events(tmp_path / "b.npz", Events.of([1], [2], [3], [1]), triggers=Triggers.of([1], [0], [1]))
    code = (
        "import resource; from evlcp_sdk.io import open_source\n"
        f"for path in {str(tmp_path / 'b.npz')!r}, {str(path)!r}:\n"
        "    with open_source(path) as source:\n"
        "        for _, _ in zip(range(100), source.stream()): pass\n"
        # What compiling takes comes first.
        "    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after = map(int, done.stdout.split())
    assert after - before < 50_000


def stretch(first_us):
    t = first_us + np.arange(400) * 100
    return Events.of(t, np.arange(400), np.arange(400), np.arange(400) & 1)


def save_table(path, events):
    """A table of events in any order, past the writers, which refuse some."""
    if path.suffix == ".npz":
        np.savez(path, t_us=events.t_us, x=events.x, y=events.y, p=events.p, width=640, height=480)
    else:
        path.write_bytes(HEAD + "".join("{},{},{},{}\n".format(*row) for row in rows(events)).encode())
    return path


@pytest.mark.parametrize("name", ["a.npz", "a.csv"])
@pytest.mark.parametrize("size", [1, 37, 5000])
def test_a_clock_may_leap_and_a_time_be_wrong(name, size, tmp_path):
    """A clock that restarts or leaps is followed; a time that no others agree with costs its own event."""
    good = stretch(5_000_000)
    parts = [good[:200], Events.of([10**15], [5], [5], [1]), good[200:]]
    parts += [stretch(0), stretch(90_000_000_000), stretch(10_000_000)]
    path = save_table(tmp_path / name, Events.concat(parts))
    with open_source(path) as source:
        got = Events.concat(source.chunks(size))
    del parts[1]
    assert np.array_equal(got.t_us, np.concatenate([part.t_us for part in parts]))
    first = 201 if name == "a.npz" else 202
    assert {k: (v.count, v.first) for k, v in source.losses.items()} == {"time_doubtful": (1, first)}
    assert source.counts["clock_restarts"] == 2
    span = Span()
    for part in (stretch(5_000_000), stretch(0), Events.concat([stretch(5_000_000), stretch(0)])):
        span.add(part)
    assert span.duration_us == 5_000_000 + 3 * np.ptp(stretch(0).t_us)
