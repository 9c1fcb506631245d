"""Lists of times and polarities without places."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.fields import fields_of
from evlcp_sdk.io.open import open_source, read_events

RNG = np.random.default_rng(5)
T_US = np.sort(RNG.choice(400_000, 3000, replace=False)).astype(np.int64) + 12_345
P = RNG.integers(0, 2, 3000).astype(np.uint8)


def csv(head: str, cell: str, factor: float, low: int = 0, mark: str = ",") -> str:
    rows = [mark.join((cell % (t * factor), str(int(p) or low))) for t, p in zip(T_US, P, strict=True)]
    return "\n".join([head.replace(",", mark), *rows] if head else rows) + "\n"


CSVS = {
    "us": csv("t,p", "%d", 1),
    "us named": csv("t_us,polarity", "%d", 1, low=-1),
    "ns": csv("timestamp,pol", "%d", 1000),
    "ms": csv("t,p", "%.3f", 1e-3),
    "s": csv("time,p", "%.6f", 1e-6),
    "s semicolon": csv("t (s),p", "%.6f", 1e-6, mark=";"),
    "no heading": csv("", "%d", 1, mark=" "),
    "tab": csv("t,p", "%.6e", 1e-6, mark="\t").replace("e-01", "e-1"),
    "windows": csv("t,p", "%d", 1).replace("\n", "\r\n"),
    "no last line end": csv("t,p", "%d", 1).rstrip("\n"),
    "words": csv("t,p", "%d", 1).replace(",1\n", ",True\n").replace(",0\n", ",False\n"),
}


@pytest.mark.parametrize("name", CSVS)
@pytest.mark.parametrize("zipped", [False, True])
def test_a_csv_list_in_any_unit(name: str, zipped: bool, tmp_path: Path) -> None:
    path = tmp_path / ("a.csv.gz" if zipped else "a.csv")
    text = CSVS[name].encode()
    path.write_bytes(gzip.compress(text) if zipped else text)
    events = read_events(path)
    np.testing.assert_array_equal(events.t_us, T_US)
    np.testing.assert_array_equal(events.p, P)
    assert not events.x.any()
    assert not events.y.any()


@pytest.mark.parametrize(
    ("arrays", "unit"),
    [
        ({"t": T_US, "p": P}, "us"),
        ({"t": T_US.astype(np.uint32), "p": P.astype(bool)}, "us"),
        ({"t": T_US * 1e-6, "p": P * 2.0 - 1.0}, "s"),
        ({"t_ns": T_US * 1000, "p": P.astype(np.int8) * 2 - 1}, "ns"),
        ({"time": T_US * 1e-3, "polarity": P}, "ms"),
    ],
)
def test_an_npz_list(arrays: dict[str, np.ndarray], unit: str, tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", allow_pickle=False, **arrays)
    with open_source(tmp_path / "a.npz") as source:
        assert source.header["time"].startswith(f"in {unit},")
        assert source.header["pixels"] == "none given: x = y = 0"
        events, _ = source.read()
    np.testing.assert_array_equal(events.t_us, T_US)
    np.testing.assert_array_equal(events.p, P)


def test_pieces_of_a_long_list_are_the_whole(tmp_path: Path) -> None:
    t_us = np.arange(300_000) * 7
    rows = "".join(f"{t},{t % 2}\n" for t in t_us.tolist())
    (tmp_path / "a.csv").write_text("t,p\n" + rows)
    np.testing.assert_array_equal(read_events(tmp_path / "a.csv").t_us, t_us)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,p\n1,1\n2,5\n", "line 3: polarity 5 beside 1, expected 0 and 1"),
        (
            "t,p\n1,1\n2,-1\n3,0\n4,0\n",
            "line 4: polarity 0 beside -1 and 1, expected 0 and 1, or -1",
        ),
        ("t,x,y,p\n1,1,1,1\n2,1,70000,1\n", "line 3: place 70000, expected whole numbers from 0"),
        ("t,p\n1,1\nx,1\n", "line 3: found 'x,1', expected a time and a polarity"),
        ("t,p\n1,1\n\n3\n", "line 4: found '3', expected a time and a polarity"),
        ("t_s,p\n99999999999999999,1\n", "line 2: time 9{17} s, expected a number up to"),
    ],
)
def test_a_fault_is_one_line_with_its_place(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_events(tmp_path / "a.csv")


def test_an_empty_list_has_no_events(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,p\n")
    assert len(read_events(tmp_path / "a.csv")) == 0


T_S = T_US * 1e-6
EPOCH_US = 1_600_000_000_000_000
X = RNG.integers(300, 340, 3000)
Y = RNG.integers(200, 240, 3000)
SIGNS = P.astype(int) * 2 - 1
WORDS = np.where(P == 1, "ON", "OFF")


def text(*columns: np.ndarray, head: str = "", mark: str = ",", form: str = "%s") -> str:
    rows = [
        mark.join(form % c if isinstance(c, float) else str(c) for c in row)
        for row in zip(*columns, strict=True)
    ]
    return "\n".join([head, *rows] if head else rows) + "\n"


ODD = {
    "of a plot": text(P, T_S, head="Polarity,Time [s]", form="%.6f"),
    "seconds, spelled": text(T_S, SIGNS, head='"timestamp (seconds)","event"', form="%.6f"),
    "as the beacon's authors call them": text(T_S, SIGNS, head="event_t,event", form="%.6f"),
    "words": text(T_US, WORDS, head="time_us,polarity"),
    "words, no heading": text(WORDS, T_US, mark="\t"),
    "with an index": text(np.arange(3000), T_US, P, head=",t,p"),
    "polarity first, no heading": text(SIGNS, T_S, mark=" ", form="%.6f"),
    "floats throughout": text(T_US * 1.0, P * 1.0, form="%.1f"),
    "comments": "# a beacon, 30 m\n% t p\n\n" + text(T_US, P, mark="  ") + "// end\n",
    "savetxt": "# t,p\n" + text(T_US * 1.0, SIGNS * 1.0, form="%.18e"),
    "decimal comma": text(T_S, P, head="t;p", mark=";", form="%.6f").replace(".", ","),
    "decimal comma and blanks": text(T_S, P, mark=" ", form="%.6f").replace(".", ","),
    "blanks around": text(T_US, P, head="t , p", mark=" , "),
    "right-aligned": "".join(f"{t:>12d} {p:>3d}\n" for t, p in zip(T_US, SIGNS, strict=True)),
    "minutes of nanoseconds": text(T_US * 1000 + 7, P, head="t,p"),
}


@pytest.mark.parametrize("name", ODD)
def test_lists_as_people_write_them(name: str, tmp_path: Path) -> None:
    for suffix in (".csv", ".txt"):
        (tmp_path / f"a{suffix}").write_text(ODD[name])
        with open_source(tmp_path / f"a{suffix}") as source:
            events, _ = source.read()
            assert source.counts["events"] == 3000
            assert not source.losses
        np.testing.assert_array_equal(events.t_us, T_US)
        np.testing.assert_array_equal(events.p, P)


MORE = {
    "ts is a time, and no seconds": text(T_US, P, head="ts,p"),
    "unit in words": text(T_US, P, head="time in microseconds,polarity"),
    "a unit for a name": text(T_S, P, head="seconds,pol", form="%.6f"),
    "units of polarity": text(T_US, P, head="t [us],p [0/1]"),
    "what polarity is": text(T_US, P, head="t (us),polarity (1=ON 0=OFF)"),
    "t of events": text(T_US, P, head="t_event,p_event"),
    "a state": text(T_US, P, head="t,is_on"),
    "elapsed": text(T_US * 1e-3, P, head="elapsed_ms,event_type", form="%.3f"),
    "numbers of rows, no heading": text(np.arange(3000), T_US, P),
    "numbers of rows from 1": text(np.arange(1, 3001), T_S, SIGNS, mark=" ", form="%.6f"),
    "the same throughout, no heading": text(T_US, P, np.full(3000, 7)),
    "as R writes it": text(np.arange(1, 3001), T_US, P, head='"t" "p"', mark=" "),
    "commas in quoted names": text(T_US, P, head='"time, us","polarity, 0 or 1"').replace("time, us", "t_us"),
    "decimal commas in quotes": "t,p\n"
    + "".join(f'"{t:.6f}",{p}\n'.replace(".", ",") for t, p in zip(T_S, P, strict=True)),
    "bars": text(T_US, P, head="t|p", mark="|"),
    "a spreadsheet's hint": "sep=;\n" + text(T_US, P, head="t;p", mark=";"),
    "a title": "LED 1, 30 m\n\n" + text(T_US, P, head="t,p"),
    "a title and no names": "LED 1\n" + text(T_US, P),
    "the sensor's size": "1280 720\n" + text(T_US, X, Y, P, mark=" "),
    "a line of units": text(T_US * 1e-3, P, head="time,polarity\n[ms],[0/1]", form="%.3f"),
    "rising and falling": text(T_US, np.where(P == 1, "rising", "falling"), head="t,edge type").replace(
        "edge ", ""
    ),
}


@pytest.mark.parametrize("name", MORE)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_headings_of_many_kinds(name: str, encoding: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(MORE[name], encoding)
    with open_source(tmp_path / "a.csv") as source:
        events, _ = source.read()
    np.testing.assert_array_equal(events.t_us, T_US)
    np.testing.assert_array_equal(events.p, P)


@pytest.mark.parametrize("many", [1, 40])
@pytest.mark.parametrize("form", ["%.3f s", "%.6f s", "%.0f ms", "%.1f ms", "%.0f us", "%.0f ns"])
@pytest.mark.parametrize("first_us", [0, 37_123_000, 259_200_012_000])
def test_times_to_the_millisecond_say_their_unit(many: int, form: str, first_us: int, tmp_path: Path) -> None:
    """Characters of eleven bits at 504 bit/s, a few events or many an edge: 4 s that would be 4 ms."""
    rng = np.random.default_rng(0)
    edges = np.cumsum(rng.integers(1, 4, 1000)) * 1e6 / 504
    rounded = (
        np.sort(np.rint((edges[:, None] + rng.exponential(200, (1000, many + 1))) / 1000).ravel()) * 1000
    )
    rounded = rounded.astype(np.int64) + first_us
    shape, unit = form.split()
    factor = {"s": 1e-6, "ms": 1e-3, "us": 1.0, "ns": 1e3}[unit]
    rows = "".join(f"{shape % (t * factor)},{k % 2}\n" for k, t in enumerate(rounded.tolist()))
    (tmp_path / "a.csv").write_text("t,p\n" + rows)
    with open_source(tmp_path / "a.csv") as source:
        np.testing.assert_array_equal(source.read()[0].t_us, rounded)
        assert "guessed" in source.header["time"]


def test_two_arrays_without_names_and_where_the_pixels_are(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", P, T_S)
    np.savez(tmp_path / "b.npz", t=T_US, p=P, x=5, y=6)
    np.save(tmp_path / "c.npy", np.rec.fromarrays([P, T_US]))
    for name in ("a.npz", "b.npz", "c.npy"):
        with open_source(tmp_path / name) as source:
            events, _ = source.read()
        np.testing.assert_array_equal(events.t_us, T_US)
        np.testing.assert_array_equal(events.p, P)


def records(names: list[str], *columns: np.ndarray) -> np.ndarray:
    out = np.empty(3000, [(name, c.dtype) for name, c in zip(names, columns, strict=True)])
    for name, column in zip(names, columns, strict=True):
        out[name] = column
    return out


ARRAYS = {
    "records": records(["t", "p"], T_US, P),
    "records with places": records(["x", "y", "p", "t"], X.astype(np.int16), Y.astype(np.int16), P, T_US),
    "n by 2": np.stack([T_S, SIGNS], 1),
    "2 by n": np.stack([T_US, P.astype(np.int64)]),
    "columns on end": np.asfortranarray(np.stack([P * 1.0, T_S], 1)),
    "n by 4": np.stack([T_US, X, Y, P], 1),
    "x y t p": np.stack([X, Y, T_US, SIGNS], 1) * 1.0,
}


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("kind", ["npy", "npz", "mat"])
def test_an_array_is_a_list(name: str, kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind}"
    if kind == "npy":
        np.save(path, ARRAYS[name])
    elif kind == "npz":
        np.savez(path, events=ARRAYS[name])
    else:
        from scipy.io import savemat

        array = ARRAYS[name]
        named = {key: array[key] for key in array.dtype.names} if array.dtype.names else array
        savemat(path, {"beacon": named, "note": "30 m"})
    events = read_events(path)
    np.testing.assert_array_equal(events.t_us, T_US)
    np.testing.assert_array_equal(events.p, P)
    if name in ("records with places", "n by 4", "x y t p"):
        np.testing.assert_array_equal(events.x, X)


def test_arrays_of_a_matlab_file_by_name(tmp_path: Path) -> None:
    from scipy.io import savemat

    savemat(tmp_path / "a.mat", {"event_t": T_S, "event": SIGNS * 1.0})
    with open_source(tmp_path / "a.mat") as source:
        assert source.header["time"].startswith("in s,")
        events, _ = source.read()
    np.testing.assert_array_equal(events.t_us, T_US)
    np.testing.assert_array_equal(events.p, P)
    # And what scipy makes of it, saved by NumPy: rows of one.
    np.savez(tmp_path / "b.npz", allow_pickle=False, event_t=T_S[:, None], event=SIGNS[None])
    np.testing.assert_array_equal(read_events(tmp_path / "b.npz").p, P)


@pytest.mark.parametrize(
    ("factor", "unit", "form"),
    [(1e-6, "s", "%.6f"), (1e-3, "ms", "%.3f"), (1, "us", "%d"), (1000, "ns", "%d")],
)
def test_times_since_1970_say_their_unit(factor: float, unit: str, form: str, tmp_path: Path) -> None:
    rows = [f"{form % ((EPOCH_US + int(t)) * factor)},{p}" for t, p in zip(T_US, P, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["t,p", *rows]))
    with open_source(tmp_path / "a.csv") as source:
        assert source.header["time"].startswith(f"in {unit}, guessed: times since 1970")
        events, _ = source.read()
    np.testing.assert_allclose(events.t_us - EPOCH_US, T_US, atol=1)


def test_what_a_list_does_not_say_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text(np.arange(3000) % 7, SIGNS, T_US))
    with pytest.raises(
        InputError, match=r"expected the columns t and p \(or say which they are, as by list:"
    ):
        read_events(f"list:{tmp_path / 'a.csv'}")
    events = read_events(f"list:{tmp_path / 'a.csv'}?columns=-,p,t&unit=ms&inverted=1")
    np.testing.assert_array_equal(events.t_us, T_US * 1000)
    np.testing.assert_array_equal(events.p, 1 - P)
    with pytest.raises(InputError, match="unit = 'hours': expected s, ms, us, ns"):
        read_events(f"list:{tmp_path / 'a.csv'}?unit=hours")
    with pytest.raises(InputError, match="columns = 't,q': expected t and p, or t, x, y and p"):
        read_events(f"list:{tmp_path / 'a.csv'}?columns=t,q")


def test_a_last_line_that_is_cut_is_left_out_and_counted(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text(T_US, P, head="t,p") + "413")
    with open_source(tmp_path / "a.csv") as source:
        assert len(source.read()[0]) == 3000
        assert source.counts["rows_cut"] == 1


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            "t,p\n1,1\n2,up\n3,sideways\n4,1\n",
            "line 4: polarity 'sideways', expected 0 or 1, or -1 or 1, or ON or OFF",
        ),
        ("t,x,y,p\n1,1,1,1\n2,99999,1,0\n", "place 99999, expected whole numbers from 0 to 65535"),
        (
            "t,x,y,p\n1,1,1,1\n2,1,0\n3,1,1,1\n",
            "line 3: found '2,1,0', expected a time and a polarity, x and y",
        ),
    ],
)
def test_faults_of_words_and_places(rows: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(rows)
    with pytest.raises(InputError, match=message):
        read_events(tmp_path / "a.csv")


def test_names_that_do_not_tell() -> None:
    assert fields_of(["a", "b"]) is None
    assert fields_of(["t", "x", "y"]) is None
    fields = fields_of(["timestamp_ms", "t", "sign", "p"])
    assert fields is not None
    assert fields.which == (1, 3)
