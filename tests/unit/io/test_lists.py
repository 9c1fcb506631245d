"""Lists of times and polarities without places."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.errors import InputError
from evlcp_sdk.io.lists import columns_of, time_unit
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
        ("t,p\n1,1\n2,5\n", "from line 2 on: polarity 5, expected 0 or 1"),
        ("t,p\n1,1\nx,1\n", "line 3: found 'x,1', expected a time and a polarity"),
        ("t,p\n1,1\n\n3\n", "line 4: found '3', expected a time and a polarity"),
        ("t,p\n1.0,1\nnan,1\n", "from line 2 on: a time that is no number"),
        ("t_s,p\n99999999999999999,1\n", "from line 2 on: a time that is too large"),
    ],
)
def test_a_fault_is_one_line_with_its_place(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_events(tmp_path / "a.csv")


def test_an_empty_list_has_no_events(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,p\n")
    assert len(read_events(tmp_path / "a.csv")) == 0


def test_the_name_of_the_column_counts_more_than_a_guess() -> None:
    assert time_unit(T_US, "ms").name == "ms"
    columns = columns_of(["Time [ms]", "Polarity"])
    assert columns is not None
    assert columns.unit == "ms"


def test_a_table_with_places_is_none() -> None:
    assert columns_of(["t_us", "x", "y", "p"]) is None
    assert columns_of(["a", "b"]) is None
