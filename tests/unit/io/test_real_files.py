"""Recordings of real cameras decode to the columns that Prophesee's own decoder gives."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.io import open_source

REAL = Path(__file__).parents[3].parent / "shared" / "recordings" / "real"
NAMES = ["ros_evt3_trigger.raw", "ros_py_test_events_1.raw"]


def digests_of(events):
    """SHA-256 of each column."""
    columns = {"t_i8": events.t_us, "x_u2": events.x, "y_u2": events.y, "p_u1": events.p}
    return {
        key: hashlib.sha256(column.astype(f"<{key[2:]}").tobytes()).hexdigest()
        for key, column in columns.items()
    }


@pytest.mark.skipif(not REAL.exists(), reason=f"needs the recordings in {REAL}")
@pytest.mark.parametrize("name", NAMES)
def test_columns_have_the_expected_digests(name):
    expected = json.loads((REAL / "expected.json").read_text())[name]
    with open_source(REAL / name) as source:
        events, triggers = source.read()
    assert digests_of(events) == expected["sha256"]
    assert len(events) == expected["events"] == source.counts["events"]
    assert len(triggers) == expected["triggers"] == source.counts["triggers"]
    assert triggers.t_us[0] == expected["first_trigger_t_us"]
    assert np.unique(triggers.channel).tolist() == expected["trigger_ids"]
    assert f"{source.width}x{source.height}" == expected["size"]
    assert source.losses == {}
