"""Recordings of real cameras decode to the columns that Prophesee's own decoder gives."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from evt_twins import decode_evt3

from evlcp_sdk.io import open_source, write_events

REAL = Path(__file__).parents[3].parent / "shared" / "recordings" / "real"
NAMES = ["ros_evt3_trigger.raw", "ros_py_test_events_1.raw"]

needs_recordings = pytest.mark.skipif(not REAL.exists(), reason=f"needs the recordings in {REAL}")


@needs_recordings
@pytest.mark.parametrize("name", NAMES)
def test_columns_have_the_expected_digests(name):
    expected = json.loads((REAL / "expected.json").read_text())[name]
    with open_source(REAL / name) as source:
        events, triggers = source.read()
    digests = {
        key: hashlib.sha256(column.astype(code).tobytes()).hexdigest()
        for key, column, code in (
            ("t_i8", events.t_us, "<i8"),
            ("x_u2", events.x, "<u2"),
            ("y_u2", events.y, "<u2"),
            ("p_u1", events.p, "u1"),
        )
    }
    assert digests == expected["sha256"]
    assert len(events) == expected["events"] == source.counts["events"]
    assert len(triggers) == expected["triggers"] == source.counts["triggers"]
    assert triggers.t_us[0] == expected["first_trigger_t_us"]
    assert np.unique(triggers.channel).tolist() == expected["trigger_ids"]
    assert f"{source.width}x{source.height}" == expected["size"]
    assert source.losses == {}


@needs_recordings
@pytest.mark.parametrize("name", NAMES)
def test_twin_agrees_and_every_format_keeps_them(name, tmp_path):
    with open_source(REAL / name) as source:
        events, triggers = source.read()
    data = (REAL / name).read_bytes()
    twin = decode_evt3(data[data.index(b"% end\n") + 6 :], source.width, source.height)
    assert twin.losses == {}
    assert np.array_equal(
        np.array(twin.triggers), np.stack([triggers.t_us, triggers.channel, triggers.value], 1)
    )
    assert np.array_equal(np.array(twin.events), np.stack([events.t_us, events.x, events.y, events.p], 1))
    for copy, kind in (("a.raw", "EVT3"), ("b.raw", "EVT2"), ("c.npz", "NPZ")):
        write_events(tmp_path / copy, events, source.width, source.height, triggers, kind)
        with open_source(tmp_path / copy) as again:
            got, edges = again.read()
        assert all(np.array_equal(getattr(got, c), getattr(events, c)) for c in ("t_us", "x", "y", "p"))
        assert all(
            np.array_equal(getattr(edges, c), getattr(triggers, c)) for c in ("t_us", "channel", "value")
        )


def test_import_is_cheap():
    code = "import sys, evlcp_sdk.io; print(sorted({'numba', 'scipy', 'faery'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"
