"""A frame's line has the columns of every frame, with their values."""

import dataclasses
import json
import math

import numpy as np
import pytest

from evlcp_sdk.results.columns import FILTERED_COLUMNS, FRAME_COLUMNS, frame_value
from evlcp_sdk.results.lines import frame_line
from evlcp_sdk.values import Range
from tests.unit.results.test_positions import packets


def test_a_line_has_all_columns() -> None:
    (packet,) = packets(1)
    soft = packet.frames[3].soft
    soft = dataclasses.replace(soft, symbols=np.where(np.arange(16) == 1, -1, soft.symbols))
    frame = dataclasses.replace(packet.frames[3], soft=soft, filtered=Range(12.34567, 0.1, 3), echo_of=2)
    told = json.loads(json.dumps(frame_line(frame, (*FRAME_COLUMNS, *FILTERED_COLUMNS))))
    assert list(told) == ["line", *FRAME_COLUMNS, *FILTERED_COLUMNS]
    for name in (*FRAME_COLUMNS, *FILTERED_COLUMNS):
        value = frame_value(frame, name)
        if isinstance(value, float):
            assert told[name] == (None if math.isnan(value) else pytest.approx(value, abs=6e-3))
        else:
            assert told[name] == value
    assert told["symbols"][1] is None
