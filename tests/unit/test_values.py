"""Values: short reprs, pages for notebooks, tables for pandas and Arrow."""

import math
import sys
from dataclasses import replace
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest

import evlcp_sdk as evlcp
from evlcp_sdk.air.blocks import Kind, Message
from evlcp_sdk.air.kinds import TextKind
from evlcp_sdk.errors import StreamError
from evlcp_sdk.results.columns import FILTERED_COLUMNS, FRAME_COLUMNS
from evlcp_sdk.values import (
    Events,
    Fix,
    Frame,
    Packet,
    PresenceMap,
    Range,
    ReceivedMessage,
    SoftSymbols,
    Triggers,
)

EVENTS = Events.of(np.arange(65_536) * 12_300 // 65_535, *np.ones((3, 65_536), int))
SOFT = SoftSymbols(np.array([23, 18, 8, 51]), np.zeros((4, 6), np.float32), 0.973)
SEEN = np.arange(120).reshape(4, 6, 5) < 61
PRESENCE = PresenceMap(np.zeros((4, 6, 5), np.float32), 4, SEEN, np.zeros((4, 24, 20), np.float32))
SPREAD = np.diag([0.01, 0.04, 1.0])
FIX = Fix(5e3, 35.1, 137.2, 50.0, np.arange(3.0), SPREAD, SPREAD, 0.0, 0.0, 0.0, 0.1, (0, 1), verified=True)


def frame(number: int = 3, found: Range | None = None, filtered: Range | None = None) -> Frame:
    measured = Range(49.337, 0.088, 26) if found is None else found
    return Frame(0, 1, number, 66_123.4, SOFT, measured, filtered, 640.0, 360.0)


def text_message(text: str) -> ReceivedMessage:
    sent = Message(Kind.TEXT, 7, 2, text.encode())
    return ReceivedMessage(0, 1, 66e3, sent, TextKind(), text, "unverified", "")


def packet(*messages: ReceivedMessage) -> Packet:
    frames = frame(3), frame(4, Range(math.nan, math.nan, 0))
    return Packet(0, 1, 60_000.0, 100.0, frames, 10, None, 0, messages)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (EVENTS, "Events(65536 events, 0.0 to 12.3 ms)"),
        (Events.empty(), "Events(no events)"),
        (Triggers.of([1000, 2500], [0, 0], [1, 0]), "Triggers(2 edges, 1.0 to 2.5 ms)"),
        (PRESENCE, "PresenceMap(3 of 4 clusters seen, 5 x 6 cells of 4 px)"),
        (SOFT, "SoftSymbols(23 18 8 51, quality 0.97)"),
        (Range(49.337, 0.088, 26), "Range(49.34 ± 0.09 m, 26 pairs)"),
        (Range(math.nan, math.nan, 0), "Range(no distance, 0 pairs)"),
        (frame(), "Frame(transmitter 0, packet 1, frame 3, 66.1 ms, 23 18 8 51, 49.34 ± 0.09 m)"),
        (packet(text_message("a")), "Packet(transmitter 0, packet 1, 60.0 ms, 2 of 10 frames, 1 message)"),
        (text_message("x" * 900), f"ReceivedMessage('{'x' * 60}...' from 7, unverified, 66.0 ms)"),
        (Fix.from_refusal(5e3, (0,), "one-bar", "a single bar"), "Fix(5.0 ms, refused: one-bar)"),
        (FIX, "Fix(5.0 ms, 35.1000000, 137.2000000 deg, 50.00 m, ± 0.1 E 0.2 N 1 U m)"),
    ],
    ids=lambda v: type(v).__name__ if not isinstance(v, str) else "",
)
def test_reprs_are_short(value: object, text: str) -> None:
    assert repr(value) == text


def test_a_reflection_and_a_symbol_that_is_not_given_are_seen_in_reprs() -> None:
    hidden = replace(SOFT, symbols=np.array([23, -1, 8, 51]))
    echo = replace(frame(), soft=hidden, echo_of=2)
    assert repr(echo).startswith("Frame(transmitter 0, a reflection of 2, packet 1, frame 3, ")
    assert "23 - 8 51" in repr(echo)
    assert "-1" not in repr(echo) + repr(hidden)
    one = replace(packet(), frames=(echo,))
    assert (one.echo_of, packet().echo_of, replace(one, frames=()).echo_of) == (2, None, None)
    assert "transmitter 0, a reflection of 2, packet 1" in repr(one)
    assert "23 - 8 51" in one._repr_html_()


@pytest.mark.parametrize(
    ("columns", "fault"),
    [
        (([0.5, 1e30], [1, 2], [1, 2], [0, 1]), "t_us: 1e.30, expected int64"),
        (([1, np.nan], [1, 2], [1, 2], [0, 1]), "t_us: nan, expected int64"),
        (([1, 2], [1, 65536], [1, 2], [0, 1]), "x: 65536, expected uint16"),
        (([1, 2], [1, 2], np.array([1, -1]), [0, 1]), "y: -1, expected uint16"),
    ],
)
def test_events_of_what_columns_cannot_hold_are_refused(columns, fault) -> None:
    with pytest.raises(StreamError, match=fault):
        Events.of(*columns)
    assert Events.of([1.5, 2.0], [1, 2], [3, 4], [True, False]).t_us.tolist() == [1, 2]


def test_a_packet_in_a_notebook() -> None:
    page = packet(text_message("<script>alert('x')</script> & more"))._repr_html_()
    assert "<script" not in page
    # Every tag that opens must close, and has no attributes.
    found: dict[str, list[str]] = {}
    for element in fromstring(f"<page>{page}</page>").iter():
        assert not element.attrib
        if element.text:
            found.setdefault(element.tag, []).append(element.text)
    assert set(found) == {"p", "th", "td", "li"}
    assert found["th"] == ["frame", "ms", "symbols", "quality", "distance"]
    assert found["td"][:5] == ["3", "66.12", "23 18 8 51", "0.97", "49.34 ± 0.09 m"]
    assert found["td"][5:] == ["4", "66.12", "23 18 8 51", "0.97", "no distance"]
    assert found["li"][0].startswith('"<script>alert(')


def test_events_as_tables() -> None:
    pandas = pytest.importorskip("pandas", reason="the extra pandas is not installed")
    pyarrow = pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
    frame, table = EVENTS.to_pandas(), EVENTS.to_arrow()
    assert isinstance(frame, pandas.DataFrame)
    assert isinstance(table, pyarrow.Table)
    assert list(frame.columns) == table.column_names == ["t_us", "x", "y", "p"]
    for name in table.column_names:
        column = getattr(EVENTS, name)
        assert frame[name].dtype == column.dtype
        assert np.array_equal(frame[name], column)
        assert np.array_equal(table[name].to_numpy(), column)
    frame.loc[0, "x"] = 9
    assert EVENTS.x[0] == 1


def test_frames_as_arrow_with_nulls_and_the_filtered_distance() -> None:
    pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
    none = Range(math.nan, math.nan, 0)
    one = Packet(0, 1, 0.0, 100.0, (frame(0, none, Range(48.0, 0.1, 0)), frame(1)), 10)
    table = evlcp.frames_table([one], "arrow")
    assert table.column_names == [*FRAME_COLUMNS, *FILTERED_COLUMNS]
    assert table["distance_m"].to_pylist() == [None, 49.337]
    assert table["distance_filtered_m"].to_pylist() == [48.0, None]
    assert table["symbols"].to_pylist() == [[23, 18, 8, 51]] * 2
    assert (str(table["echo_of"].type), table["echo_of"].to_pylist()) == ("int64", [None, None])
    assert evlcp.frames_table([], "arrow").num_rows == 0
    with pytest.raises(evlcp.ConfigError, match="kind = 'csv', expected 'pandas' or 'arrow'"):
        evlcp.frames_table([], "csv")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("method", "library", "extra"), [("to_pandas", "pandas", "pandas"), ("to_arrow", "pyarrow", "parquet")]
)
def test_a_library_that_is_missing_is_named(method, library, extra, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(evlcp.ConfigError, match=rf"{library} is not installed.*evlcp-sdk\[{extra}\]"):
        getattr(EVENTS, method)()
