"""A frame's line has the columns of every frame, with their values."""

import dataclasses
import json
import math

import numpy as np
import pytest

from evlcp_sdk.results.columns import FILTERED_COLUMNS, FRAME_COLUMNS, frame_columns, frame_value
from evlcp_sdk.results.lines import format_frame
from evlcp_sdk.values import Range
from tests.unit.results.test_positions import packets


def test_a_line_has_all_columns() -> None:
    (packet,) = packets(1)
    soft = packet.frames[3].soft
    soft = dataclasses.replace(soft, symbols=np.where(np.arange(16) == 1, -1, soft.symbols))
    frame = dataclasses.replace(packet.frames[3], soft=soft, filtered=Range(12.34567, 0.1, 3), echo_of=2)
    told = json.loads(format_frame(frame, (*FRAME_COLUMNS, *FILTERED_COLUMNS)))
    assert list(told) == ["line", *FRAME_COLUMNS, *FILTERED_COLUMNS]
    for name in (*FRAME_COLUMNS, *FILTERED_COLUMNS):
        value = frame_value(frame, name)
        if isinstance(value, float):
            assert told[name] == (None if math.isnan(value) else pytest.approx(value, abs=6e-3))
        else:
            assert told[name] == value
    assert told["symbols"][1] is None


def test_what_is_no_number_is_null() -> None:
    (packet,) = packets(1)
    frame = packet.frames[0]
    for value in (math.nan, math.inf, -math.inf):
        soft = dataclasses.replace(frame.soft, quality=value)
        odd = dataclasses.replace(
            frame, soft=soft, range=Range(value, value, 0), x_px=value, link="nan inf None"
        )
        told = json.loads(format_frame(odd, frame_columns(filtered=False, links=True)))
        names = ("quality", "distance_m", "distance_sigma_m", "x_px", "echo_of")
        assert [told[name] for name in names] == [None] * 5
        assert (told["line"], told["link"], told["y_px"]) == ("frame", "nan inf None", round(frame.y_px, 3))
