"""Tables of events as people and their tools write them, with places and without: the events are the same."""

import gzip

import numpy as np
import pytest

from evlcp_sdk.errors import InputError
from evlcp_sdk.io import open_source, read_events
from evlcp_sdk.io.fields import fields_from_names, infer_time_unit
from evlcp_sdk.values import Events
from tests.unit.io.writers import (
    records,
    write_hdf5,
    write_mat,
    write_mat_73,
    write_npy,
    write_npz,
    write_records,
)

RNG = np.random.default_rng(5)
N = 3000
T_US = np.sort(RNG.choice(400_000, N, replace=False)).astype(np.int64) + 12_345
P = RNG.integers(0, 2, N).astype(np.uint8)
X, Y = RNG.integers(300, 340, N), RNG.integers(200, 240, N)
T_S, SIGNS, ROWS = T_US * 1e-6, P.astype(int) * 2 - 1, np.arange(N)


def expect(name, *, placed):
    """The source, after it gave the events above."""
    with open_source(name) as source:
        events, _ = source.read()
    np.testing.assert_array_equal(events.t_us, T_US)
    np.testing.assert_array_equal(events.p, P)
    np.testing.assert_array_equal(events.x, X * placed)
    np.testing.assert_array_equal(events.y, Y * placed)
    assert source.header["pixels"].startswith("none given") is not placed
    assert "," in source.header["time"], "no reason"
    assert not source.losses
    return source


def text(*columns, head="", mark=",", form="%s"):
    rows = [
        mark.join(form % c if isinstance(c, float) else str(c) for c in row)
        for row in zip(*columns, strict=True)
    ]
    return "\n".join([head, *rows] if head else rows) + "\n"


LISTS = {
    "us": text(T_US, P, head="t,p"),
    "ns": text(T_US * 1000, P, head="timestamp,pol"),
    "minutes of nanoseconds": text(T_US * 1000 + 7, P, head="t,p"),
    "ms": text(T_US * 1e-3, P, head="t,p", form="%.3f"),
    "s": text(T_S, P, head="time,p", form="%.6f"),
    "no heading": text(T_US, P, mark=" "),
    "tabs and exponents": text(T_S, P, head="t\tp", mark="\t", form="%.6e").replace("e-0", "e-"),
    "windows": text(T_US, P, head="t,p").replace("\n", "\r\n"),
    "of a plot": text(P, T_S, head="Polarity,Time [s]", form="%.6f"),
    "as the beacon's authors call them": text(T_S, SIGNS, head="event_t,event", form="%.6f"),
    "words": text(T_US, np.where(P == 1, "ON", "OFF"), head="time_us,polarity"),
    "words, no heading": text(np.where(P == 1, "ON", "OFF"), T_US, mark="\t"),
    "with an index": text(ROWS, T_US, P, head=",t,p"),
    "polarity first, no heading": text(SIGNS, T_S, mark=" ", form="%.6f"),
    "comments": "# a beacon, 30 m\n% t p\n\n" + text(T_US, P, mark="  ") + "// end\n",
    "decimal comma": text(T_S, P, head="t;p", mark=";", form="%.6f").replace(".", ","),
    "decimal commas in quotes": text(T_S, P, head="t,p", form='"%.6f"').replace(".", ","),
    "unit in words": text(T_US, P, head="time in microseconds,polarity"),
    "units of polarity": text(T_US, P, head="t [us],p [0/1]"),
    "what polarity is": text(T_US, P, head="t (us),polarity (1=ON 0=OFF)"),
    "numbers of rows, no heading": text(ROWS, T_US, P),
    "the same throughout, no heading": text(T_US, P, np.full(N, 7)),
    "as R writes it": text(ROWS + 1, T_US, P, head='"t" "p"', mark=" "),
    "commas in quoted names": text(T_US, P, head='"t_us","polarity, 0 or 1"'),
    "a spreadsheet's hint": "sep=;\n" + text(T_US, P, head="t;p", mark=";"),
    "a title": "LED 1, 30 m\n\n" + text(T_US, P, head="t,p"),
    "a line of units": text(T_US * 1e-3, P, head="time,polarity\n[ms],[0/1]", form="%.3f"),
}
PLACED = {
    "x,y,p,t without a header": text(X, Y, P, T_US),
    "behind %geometry": "%geometry:1280,720\n" + text(X, Y, P, T_US),
    "the sensor's size": "1280 720\n" + text(T_US, X, Y, P, mark=" "),
    "blanks after commas": text(T_US, X, Y, P, head="t_us,x,y,p", mark=", "),
    "times with a fraction": text(T_US * 1.0, X, Y, P, head="t_us,x,y,p"),
}


@pytest.mark.parametrize("name", LISTS | PLACED)
def test_text(name, tmp_path):
    """The name of the file does not say that it is a table."""
    (tmp_path / "a.dat").write_text((LISTS | PLACED)[name])
    expect(tmp_path / "a.dat", placed=name in PLACED)


@pytest.mark.parametrize("name", ["windows", "a line of units", "a title", "x,y,p,t without a header"])
def test_files_of_text(name, tmp_path):
    content = (LISTS | PLACED)[name]
    for file, data in (
        ("a.csv", b"\xef\xbb\xbf" + content.encode()),
        ("a.csv.gz", gzip.compress(content.encode())),
        ("16.csv", content.encode("utf-16")),
        ("16", content.encode("utf-16")),
        ("16.gz", gzip.compress(content.encode("utf-16"))),
    ):
        (tmp_path / file).write_bytes(data)
        expect(tmp_path / file, placed=name in PLACED)


def table(order, kind=np.int64):
    columns = {"t": T_US, "x": X, "y": Y, "p": P, "s": T_S, "±": SIGNS}
    return np.stack([columns[name] for name in order], 1).astype(kind)


LIST, ALL = {"t": T_US, "p": P}, {"t": T_US, "x": X, "y": Y, "p": P}
ARRAYS = {
    "a list": LIST,
    "a list in seconds": {"event_t": T_S, "event": P * 2.0 - 1.0},
    "a list in nanoseconds": {"t_ns": T_US * 1000, "p": SIGNS.astype(np.int8)},
    "where the pixels are": {**LIST, "x": np.array(5), "y": np.array(6)},
    "arrays": ALL,
    "big-endian": {name: column.astype(">i8") for name, column in ALL.items()},
    "seconds": {**ALL, "t": T_S},
    "nanoseconds": {**ALL, "t": T_US * 1000},
    "polarity 1 and 2": {**ALL, "p": P + 1},
    "polarity 255 for -1": {**ALL, "p": SIGNS.astype(np.uint8)},
    "polarity 0 and 255": {**ALL, "p": 255 * P},
    "our names": {"t_us": T_US * 1.0, "x": X, "y": Y, "p": SIGNS},
}
LIST_TABLES = {
    "t p": table("sp", float),
    "t p on its side": table("tp").T,
    "p t, columns on end": np.asfortranarray(table("ps", float)),
    "records": records(t=T_US, p=P),
}
PLACED_TABLES = {
    "t x y p": table("txyp"),
    "x y t p": table("xyt±", float),
    "t x y p, columns on end": np.asfortranarray(table("txyp")),
    "records with places": records(x=X.astype(np.int16), y=Y.astype(np.int16), p=P, t=T_US),
}
TABLES = LIST_TABLES | PLACED_TABLES


COLUMNS = [name for name in ARRAYS if name != "where the pixels are"]
WRITTEN = [
    *(("a.npz", write_npz, name) for name in (*ARRAYS, *TABLES)),
    *(("a.npy", write_npy, name) for name in TABLES),
    *(("a.mat", write_mat, name) for name in (*TABLES, "a list in seconds", "polarity 1 and 2")),
    *(("a.mat", write_mat_73, name) for name in ("arrays", "a list in seconds", "polarity 1 and 2")),
    *(("a.h5", write_hdf5, name) for name in (*COLUMNS, "t p", "t x y p", "x y t p", "records with places")),
    *(("a.hdf5", write_records, name) for name in ("arrays", "big-endian", "our names", "a list")),
]


@pytest.mark.parametrize(("file", "write", "name"), WRITTEN)
def test_arrays(file, write, name, tmp_path):
    arrays = {"events": TABLES[name]} if name in TABLES else ARRAYS[name]
    write(tmp_path / file, arrays)
    source = expect(
        tmp_path / file, placed=name in PLACED_TABLES or ("x" in arrays and arrays["x"].size == N)
    )
    assert source.position_bytes == source.size_bytes
    assert source.width == (640 if write in (write_hdf5, write_records) else None)


def test_two_arrays_without_names(tmp_path):
    np.savez(tmp_path / "a.npz", P, T_S)
    expect(tmp_path / "a.npz", placed=False)
    # As SciPy gives those of MATLAB: rows and columns of one.
    np.savez(tmp_path / "b.npz", allow_pickle=False, event_t=T_S[:, None], event=SIGNS[None])
    expect(tmp_path / "b.npz", placed=False)


@pytest.mark.parametrize("on_its_side", [False, True])
@pytest.mark.parametrize("order", ["txyp", "xypt", "ptyx"])
def test_columns_of_an_hdf5_table_are_reported(order, on_its_side, tmp_path):
    path = tmp_path / "a.h5"
    write_hdf5(path, {"events": table(order).T if on_its_side else table(order)})
    expect(f"hdf5:{path}?columns={order}", placed=True)
    with open_source(f"hdf5:{path}?columns={order}&swapped=1") as source:
        got, _ = source.read()
    np.testing.assert_array_equal(got.x, Y)
    np.testing.assert_array_equal(got.y, X)


@pytest.mark.parametrize(
    ("factor", "unit", "form"),
    [(1e-6, "s", "%.6f"), (1e-3, "ms", "%.3f"), (1, "us", "%d"), (1000, "ns", "%d")],
)
def test_times_since_1970_say_their_unit(factor, unit, form, tmp_path):
    since_us = 1_600_000_000_000_000
    rows = [f"{form % ((since_us + int(t)) * factor)},{p}" for t, p in zip(T_US, P, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["t,p", *rows]))
    with open_source(tmp_path / "a.csv") as source:
        assert source.header["time"].startswith(f"in {unit}, guessed: times since 1970")
        events, _ = source.read()
    np.testing.assert_allclose(events.t_us - since_us, T_US, atol=1)


@pytest.mark.parametrize(("many", "first_us"), [(1, 0), (40, 37_123_000), (1, 259_200_012_000)])
@pytest.mark.parametrize("form", ["%.3f s", "%.6f s", "%.0f ms", "%.1f ms", "%.0f us", "%.0f ns"])
def test_times_to_the_millisecond_say_their_unit(form, many, first_us, tmp_path):
    """Characters of eleven bits at 504 bit/s, a few events or many an edge: 4 s that would be 4 ms."""
    rng = np.random.default_rng(0)
    edges_us = np.cumsum(rng.integers(1, 4, 1000)) * 1e6 / 504
    t_ms = np.rint((edges_us[:, None] + rng.exponential(200, (1000, many + 1))) / 1000)
    t_us = np.sort(t_ms.ravel()).astype(np.int64) * 1000 + first_us
    shape, unit = form.split()
    factor = {"s": 1e-6, "ms": 1e-3, "us": 1.0, "ns": 1e3}[unit]
    rows = "".join(f"{shape % (t * factor)},{k % 2}\n" for k, t in enumerate(t_us.tolist()))
    (tmp_path / "a.csv").write_text("t,p\n" + rows)
    with open_source(tmp_path / "a.csv") as source:
        np.testing.assert_array_equal(source.read()[0].t_us, t_us)
        assert "guessed" in source.header["time"]


@pytest.mark.parametrize(("digits", "words"), [(3, "1 ms"), (4, "100 us")])
def test_rounded_times_are_reported(digits, words, tmp_path):
    (tmp_path / "a.csv").write_text(text(T_S, P, head="t,p", form=f"%.{digits}f"))
    with open_source(f"list:{tmp_path / 'a.csv'}?unit=s") as source:
        assert source.header["step"] == f"times are rounded to {words}"
        assert source.header["step"] in source.guessed
        assert source.step_us == 10 ** (6 - digits)


def test_times_coarser_than_a_chip_are_warned_of(tmp_path, evlcp):
    (tmp_path / "a.csv").write_text(text(T_S, X, Y, P, head="t_s,x,y,p", form="%.3f"))
    done = evlcp("receive", tmp_path / "a.csv", "-o", tmp_path / "out")
    assert "times come in steps of 1 ms; a chip is 0.1 ms" in " ".join(done.out.split())


def test_a_light_that_blinks_in_another_unit_than_named_is_reported(tmp_path):
    t_us = np.arange(80_000) // 1000 * 100 + np.arange(80_000) % 1000 // 50
    for unit, expected in (("ns", "in us a light would blink"), ("us", "")):
        lines = [f"{t},{t % 2}" for t in t_us.tolist()]
        (tmp_path / "a.csv").write_text("\n".join([f"t_{unit},p", *lines]))
        with open_source(tmp_path / "a.csv") as source:
            assert expected in source.guessed
            assert bool(source.guessed) == bool(expected)


@pytest.mark.parametrize("before_us", [200, 7000])
@pytest.mark.parametrize("end", [1 << 32, 1 << 31, 1 << 24], ids=["uint32", "int32", "24 bits"])
def test_counters_go_round(end, before_us, tmp_path):
    """Within the rows by which the unit is known, and beyond."""
    n = 80_000
    # A light that blinks at 10 kHz, as the unit is by that.
    t_us = np.arange(n) // 1000 * 100 + np.arange(n) % 1000 // 50 + end - before_us
    counted = t_us.astype(np.uint32)
    columns = {
        "t": {1 << 32: counted, 1 << 31: counted.view(np.int32), 1 << 24: counted % (1 << 24)}[end],
        **{name: np.resize(column, n) for name, column in {"x": X, "y": Y, "p": P}.items()},
    }
    write_npz(tmp_path / "a.npz", columns)
    write_npz(tmp_path / "ours.npz", {name.replace("t", "t_us"): column for name, column in columns.items()})
    write_hdf5(tmp_path / "a.h5", columns)
    for name in ("a.npz", "ours.npz", "a.h5"):
        with open_source(tmp_path / name) as source:
            got, _ = source.read()
        np.testing.assert_array_equal(got.t_us, t_us)
        np.testing.assert_array_equal(got.x, columns["x"])
        assert source.counts["times_gone_round"] == 1
        assert source.guessed.endswith("the counter of times went round")


def test_rows_that_are_no_number_are_dropped_and_counted(tmp_path):
    t_us = np.arange(50_000) * 7001
    rows = text(t_us * 1.0, t_us % 640, t_us % 480, t_us % 2, head="t_us,x,y,p").splitlines()
    for number, row in ((30_000, "nan,1,2,1"), (49_000, "343000000,,2,1"), (49_999, "350000000,1,2,")):
        rows.insert(number, row)
    (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
    with open_source(tmp_path / "a.csv") as source:
        begun = next(source.chunks(1000))
        assert 0 < source.position_bytes <= source.size_bytes
        np.testing.assert_array_equal(Events.concat([begun, source.read()[0]]).t_us, t_us)
    lost = source.losses["rows_dropped"]
    assert (lost.count, lost.first, lost.unit) == (3, 30_001, "line")


def test_what_a_list_does_not_say_is_reported(tmp_path):
    (tmp_path / "a.csv").write_text(text(ROWS % 7, SIGNS, T_US))
    events = read_events(f"list:{tmp_path / 'a.csv'}?columns=-,p,t&unit=ms&inverted=1")
    np.testing.assert_array_equal(events.t_us, T_US * 1000)
    np.testing.assert_array_equal(events.p, 1 - P)
    for options, message in (
        ("", r"expected the columns t and p \(or say which they are, as by list:"),
        ("?unit=hours", "unit = 'hours': expected s, ms, us, ns"),
        ("?columns=t,q", "columns = 't,q': expected t and p, or t, x, y and p"),
    ):
        with pytest.raises(InputError, match=message):
            read_events(f"list:{tmp_path / 'a.csv'}{options}")


def test_a_last_line_that_is_cut_is_left_out_and_counted(tmp_path):
    (tmp_path / "a.csv").write_text(LISTS["us"] + "413")
    assert expect(tmp_path / "a.csv", placed=False).counts["rows_cut"] == 1


def test_names_that_do_not_tell():
    assert fields_from_names(["t", "x", "y"]) is None
    assert fields_from_names(["t_frame", "p"]) is None
    fields = fields_from_names(["timestamp_ms", "t", "sign", "p"])
    assert fields.numbers == (1, 3)


@pytest.mark.parametrize(
    ("times", "unit"),
    [
        # Too close for us; not so far apart in ms; too far apart for us; decimals are of no ns.
        (np.arange(100), "ms"),
        (np.arange(0, 600, 6), "us"),
        (np.array([0, 10**7 + 1, 2 * 10**7 + 3]), "ns"),
        (np.array([0.5, 1e7 + 0.25, 2e7 + 0.125]), "us"),
    ],
)
def test_few_times_say_their_unit(times, unit):
    assert infer_time_unit(times, None).name == unit
