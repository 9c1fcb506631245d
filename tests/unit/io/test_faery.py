"""AEDAT4, DAT and Event Stream files through the optional package faery."""

import sys

import numpy as np
import pytest

from evlcp_sdk.errors import InputError
from evlcp_sdk.io import open_source

NAMES = {"a.aedat4": "AEDAT4", "a.dat": "DAT", "a.es": "ES"}


@pytest.fixture
def faery():
    return pytest.importorskip("faery", reason="needs pip install 'evlcp-sdk[faery]'")


@pytest.mark.parametrize(("name", "kind"), NAMES.items())
def test_events_are_those_written(name, kind, faery, tmp_path):
    rng = np.random.default_rng(5)
    records = np.zeros(10_000, faery.EVENTS_DTYPE)
    records["t"] = np.sort(rng.integers(100, 1_000_000, len(records)))
    records["x"] = rng.integers(0, 640, len(records))
    records["y"] = rng.integers(0, 480, len(records))
    records["on"] = rng.integers(0, 2, len(records))
    faery.events_stream_from_array(records, (640, 480)).to_file(tmp_path / name, zero_t0=False)
    with open_source(tmp_path / name) as source:
        assert (source.format, source.width, source.height) == (kind, 640, 480)
        pieces = list(source.stream(1000))
    assert all(len(events) <= 1000 for events, _ in pieces)
    for ours, theirs in (("t_us", "t"), ("x", "x"), ("y", "y"), ("p", "on")):
        column = np.concatenate([getattr(events, ours) for events, _ in pieces])
        assert np.array_equal(column, records[theirs])
    assert source.losses == {}


@pytest.mark.parametrize(("name", "kind"), NAMES.items())
def test_bad_file_is_an_error(name, kind, faery, tmp_path):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=f"{name}: found no {kind} file, expected one"):
        open_source(tmp_path / name)


def test_cut_file_is_an_error(faery, tmp_path):
    records = np.zeros(10_000, faery.EVENTS_DTYPE)
    faery.events_stream_from_array(records, (640, 480)).to_file(tmp_path / "a.aedat4")
    data = (tmp_path / "a.aedat4").read_bytes()
    (tmp_path / "a.aedat4").write_bytes(data[: len(data) // 2])
    with open_source(tmp_path / "a.aedat4") as source, pytest.raises(InputError, match="at event"):
        source.read()


def test_missing_package_is_named_with_the_way_to_install_it(monkeypatch, tmp_path):
    (tmp_path / "a.es").write_bytes(b"Event Stream")
    monkeypatch.setitem(sys.modules, "faery", None)
    with pytest.raises(InputError, match=r"pip install 'evlcp-sdk\[faery\]'"):
        open_source(tmp_path / "a.es")
