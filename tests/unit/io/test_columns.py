"""Tables of other people's tools hold the same events as the RAW file that they were made from."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.errors import InputError
from evlcp_sdk.io import open_source, read_events
from evlcp_sdk.io.columns import PIECE_ROWS
from evlcp_sdk.values import Events

N = 80_000
Columns = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def events() -> Events:
    """The first 8 ms of the recording that comes with the package."""
    from tests.conftest import ROOT

    return read_events(ROOT / "examples" / "recordings" / "night-50m-30kmh-cut.raw")[:N]


def same(path: Path | str, events: Events, shift_us: int = 0) -> Any:
    """The source, after it gave these events, perhaps at other times."""
    with open_source(path) as source:
        got, _ = source.read()
    assert "," in source.header["time"], "no reason"
    np.testing.assert_array_equal(got.t_us - shift_us, events.t_us)
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(getattr(got, name), getattr(events, name))
    return source


def columns_of(events: Events) -> Columns:
    """As integers."""
    return {"t": events.t_us, **{name: getattr(events, name).astype(np.int64) for name in "xyp"}}


def lines(events: Events, order: str, mark: str = ",") -> str:
    columns = columns_of(events)
    return "".join(
        f"{mark.join(map(str, row))}\n" for row in zip(*(columns[c].tolist() for c in order), strict=True)
    )


def numbered(events: Events) -> str:
    rows = lines(events, "txyp").splitlines()
    return ",t,x,y,p\n" + "".join(f"{k},{row}\n" for k, row in enumerate(rows))


def ours(make: Callable[[int, int, int, int], str], head: str = "t_us,x,y,p") -> Callable[[Events], str]:
    """Our own layout, its rows written in another way."""
    return lambda events: (
        f"{head}\n"
        + "".join(make(*row) for row in zip(*(columns_of(events)[c].tolist() for c in "txyp"), strict=True))
    )


TEXTS: dict[str, Callable[[Events], str]] = {
    "x,y,p,t without a header": lambda e: lines(e, "xypt"),
    "behind %geometry": lambda e: "%geometry:1280,720\n" + lines(e, "xypt"),
    "behind %camera_integrator_name": lambda e: "%camera_integrator_name:Prophesee\n" + lines(e, "xypt"),
    "numbers of rows without a name": numbered,
    "semicolons": lambda e: lines(e, "txyp", ";"),
    "tabs": lambda e: lines(e, "xytp", "\t"),
    "blanks after commas": ours("{}, {}, {}, {}\n".format),
    "times with a fraction": ours("{}.0,{},{},{}\n".format),
    "polarities -1 and 1": ours(lambda t, x, y, p: f"{t},{x},{y},{2 * p - 1}\n"),
    "True and False": ours(lambda t, x, y, p: f"{t},{x},{y},{p == 1}\n"),
    "a quoted header": ours("{},{},{},{}\n".format, '"t_us","x","y","p"'),
    "seconds": ours(lambda t, x, y, p: f"{t / 1e6:.6f},{x},{y},{p}\n", "t,x,y,p"),
    "seconds since 1970": lambda e: "".join(
        f"{1_700_000_000 + t // 1_000_000}.{t % 1_000_000:06d},{x},{y},{p}\n"
        for t, x, y, p in zip(e.t_us.tolist(), e.x.tolist(), e.y.tolist(), e.p.tolist(), strict=True)
    ),
}


@pytest.mark.parametrize("name", TEXTS)
def test_text(name: str, events: Events, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(TEXTS[name](events))
    source = same(tmp_path / "a.csv", events, 1_700_000_000_000_000 if "1970" in name else 0)
    assert not source.losses


def table_of(c: Columns, order: str, dtype: Any) -> np.ndarray:
    return np.stack([c[name] for name in order], 1).astype(dtype)


def renamed(c: Columns) -> Columns:
    return {"t_us" if name == "t" else name: column for name, column in c.items()}


ARRAYS: dict[str, Callable[[Columns], Columns]] = {
    "arrays": lambda c: c,
    "as floats": lambda c: {"timestamp": c["t"] * 1.0, "polarity": c["p"] * 1.0, "x": c["x"], "y": c["y"]},
    "txyp, int64": lambda c: {"events": table_of(c, "txyp", np.int64)},
    "xytp, float64": lambda c: {"events": table_of(c, "xytp", np.float64)},
    "txyp, columns on end": lambda c: {"events": np.asfortranarray(table_of(c, "txyp", np.int64))},
    "big-endian": lambda c: {name: column.astype(">i8") for name, column in c.items()},
    "seconds": lambda c: {**c, "t": c["t"] / 1e6},
    "nanoseconds": lambda c: {**c, "t": c["t"] * 1000},
    "polarity -1": lambda c: {**c, "p": 2 * c["p"] - 1},
    "polarity 1 and 2": lambda c: {**c, "p": c["p"] + 1},
    "polarity 255 for -1": lambda c: {**c, "p": (2 * c["p"] - 1).astype(np.uint8)},
    "polarity 0 and 255": lambda c: {**c, "p": (255 * c["p"]).astype(np.uint8)},
    "booleans": lambda c: {**c, "p": c["p"] > 0},
    "our names": lambda c: renamed({**c, "t": c["t"] * 1.0}),
    "our names, polarity 1 and 2": lambda c: renamed({**c, "p": c["p"] + 1.0}),
    "our names, polarity -1": lambda c: renamed({**c, "p": 2 * c["p"] - 1}),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays(name: str, events: Events, tmp_path: Path) -> None:
    arrays = ARRAYS[name](columns_of(events))
    np.savez_compressed(tmp_path / "a.npz", **arrays)  # type: ignore[arg-type]
    same(tmp_path / "a.npz", events)
    if len(arrays) == 1:
        np.save(tmp_path / "a.npy", arrays["events"])
        same(tmp_path / "a.npy", events)


@pytest.mark.parametrize("before_us", [200, 7000])
@pytest.mark.parametrize("end", [1 << 32, 1 << 31, 1 << 24], ids=["uint32", "int32", "24 bits"])
def test_counters_go_round(end: int, before_us: int, events: Events, tmp_path: Path) -> None:
    """Within the rows by which the unit is known, and beyond."""
    h5py = pytest.importorskip("h5py")
    c = columns_of(events)
    shift = end - before_us - int(c["t"][0])
    t = (c["t"] + shift).astype(np.uint32)
    c["t"] = {1 << 32: t, 1 << 31: t.view(np.int32), 1 << 24: t % (1 << 24)}[end]
    np.savez(tmp_path / "a.npz", **c)
    np.savez(tmp_path / "ours.npz", **renamed(c))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, column in c.items():
            file[f"events/{name}"] = column
    for name in ("a.npz", "ours.npz", "a.h5"):
        source = same(tmp_path / name, events, shift)
        assert source.counts["times_gone_round"] == 1
        assert source.guessed.endswith("the counter of times went round")


def test_a_clock_that_restarts_at_a_piece_has_not_gone_round(tmp_path: Path) -> None:
    """However much was counted before: a counter of 24 bits never had that."""
    n = PIECE_ROWS
    t = np.concatenate([3_000_000_000 + 100 * np.arange(n), 100 * np.arange(n)])
    np.savez(tmp_path / "a.npz", t_us=t, x=t % 640, y=t % 480, p=np.arange(2 * n) & 1)
    with open_source(tmp_path / "a.npz") as source:
        got, _ = source.read()
    np.testing.assert_array_equal(got.t_us, t)
    assert "times_gone_round" not in source.counts


@pytest.mark.parametrize("name", [n for n in ARRAYS if "txyp" not in n and "xytp" not in n])
@pytest.mark.parametrize("kind", ["group", "records"])
def test_hdf5(name: str, kind: str, events: Events, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    arrays = ARRAYS[name](columns_of(events))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if kind == "group":
            for column, values in arrays.items():
                file[f"events/{column}"] = values
        else:
            records = np.zeros(N, [(column, values.dtype) for column, values in arrays.items()])
            for column, values in arrays.items():
                records[column] = values
            file["CD/events"] = records
    same(tmp_path / "a.h5", events)


@pytest.mark.parametrize("version", ["5", "7.3"])
@pytest.mark.parametrize("name", ["arrays", "seconds", "polarity 1 and 2"])
def test_matlab(name: str, version: str, events: Events, tmp_path: Path) -> None:
    arrays = ARRAYS[name](columns_of(events))
    if version == "5":
        from scipy.io import savemat

        savemat(tmp_path / "a.mat", arrays)
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
            for column, values in arrays.items():
                file[column] = values[None, :]
        with (tmp_path / "a.mat").open("r+b") as raw:
            raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")
    same(tmp_path / "a.mat", events)


def test_late_rows_are_sorted_in(events: Events, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    c = columns_of(events)
    order = np.argsort(c["t"] + np.random.default_rng(3).integers(0, 50, N), kind="stable")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, column in c.items():
            file[f"events/{name}"] = column[order]
    np.savez(tmp_path / "a.npz", **renamed({name: column[order] for name, column in c.items()}))
    for name in ("a.h5", "a.npz"):
        with open_source(tmp_path / name) as source:
            got, _ = source.read()
        np.testing.assert_array_equal(got.t_us, events.t_us)
        assert source.counts["rows_out_of_order"] > 1000
        assert not source.losses


def test_rows_that_are_no_number_are_dropped_and_counted(events: Events, tmp_path: Path) -> None:
    rows = TEXTS["times with a fraction"](events).splitlines()
    for number, row in ((50_000, "nan,1,2,1"), (70_000, "60470,,2,1"), (79_999, "60470,1,2,NaN")):
        rows.insert(number, row)
    (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
    source = same(tmp_path / "a.csv", events)
    lost = source.losses["rows_dropped"]
    assert (lost.count, lost.first, lost.unit) == (3, 50_001, "line")


@pytest.mark.parametrize(
    ("digits", "words"), [(3, "times are rounded to 1 ms"), (4, "times are rounded to 100 us")]
)
def test_rounded_times_are_said(digits: int, words: str, events: Events, tmp_path: Path) -> None:
    text = "".join(
        f"{t / 1e6:.{digits}f},{p}\n" for t, p in zip(events.t_us.tolist(), events.p.tolist(), strict=True)
    )
    (tmp_path / "a.csv").write_text("t,p\n" + text)
    with open_source(f"list:{tmp_path / 'a.csv'}?unit=s") as source:
        assert source.header["step"] == words
        assert words in source.guessed
        assert source.step_us == 10 ** (6 - digits)


@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_whole_milliseconds_are_said(suffix: str, events: Events, tmp_path: Path) -> None:
    c = columns_of(events)
    c["t"] = c["t"] // 1000
    path = tmp_path / f"a.{suffix}"
    if suffix == "csv":
        np.savetxt(path, table_of(c, "txyp", np.int64), "%d", ",", header="t,x,y,p", comments="")
    else:
        np.savez(path, **c)  # type: ignore[arg-type]
    with open_source(path) as source:
        assert source.header["step"] == "times are rounded to 1 ms"
        assert "in ms, guessed" in source.header["time"]


def test_frames_are_those_of_the_recording(demo_raw: Path, tmp_path: Path, evlcp: Callable[..., Any]) -> None:
    """From end to end: what the camera maker's converter writes."""
    (tmp_path / "a.csv").write_text("%geometry:1280,720\n" + lines(read_events(demo_raw), "xypt"))
    for path, out in ((demo_raw, "raw"), (tmp_path / "a.csv", "csv")):
        assert evlcp("receive", path, "-o", tmp_path / out).code == 0
    assert (tmp_path / "csv" / "frames.csv").read_bytes() == (tmp_path / "raw" / "frames.csv").read_bytes()


def test_times_coarser_than_a_chip_are_warned_of(
    events: Events, tmp_path: Path, evlcp: Callable[..., Any]
) -> None:
    (tmp_path / "a.csv").write_text(
        "t_s,x,y,p\n"
        + "".join(
            f"{t / 1e6:.3f},{x},{y},{p}\n"
            for t, x, y, p in zip(*(columns_of(events)[c].tolist() for c in "txyp"), strict=True)
        )
    )
    done = evlcp("receive", tmp_path / "a.csv", "-o", tmp_path / "out")
    assert "times are rounded to 1 ms; a chip is 0.1 ms" in " ".join(done.out.split())


def test_more_than_a_hundredth_dropped_is_no_whole_result(
    events: Events, tmp_path: Path, evlcp: Callable[..., Any]
) -> None:
    rows = lines(events, "txyp").splitlines()
    rows[::50] = [",1,1,1"] * len(rows[::50])
    (tmp_path / "a.csv").write_text("t_us,x,y,p\n" + "\n".join(rows) + "\n")
    done = evlcp("receive", tmp_path / "a.csv", "-o", tmp_path / "out")
    assert done.code == 4
    assert "1600 events or words, 2.0%, were dropped" in " ".join((done.out + done.err).split())


def test_beside_a_table_stands_what_is_none(events: Events, tmp_path: Path) -> None:
    table = table_of(columns_of(events), "txyp", np.int64)
    info, wide = np.array({"a": 1}, dtype=object), np.zeros((100, 4000), np.uint8)
    for other in (info, wide, np.zeros((90, 60), order="F")):
        np.savez(tmp_path / "a.npz", events=table, img=other)
        same(tmp_path / "a.npz", events)


def test_a_value_of_a_gigabyte_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "a.npy").open("wb") as file:
        header = {"descr": "<U500000000", "fortran_order": False, "shape": (3,)}
        np.lib.format.write_array_header_1_0(file, header)
    with pytest.raises(InputError, match="expected numbers"):
        read_events(tmp_path / "a.npy")
