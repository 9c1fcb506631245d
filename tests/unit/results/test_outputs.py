"""The three files of a result: columns, values, streaming, and what is left after a stop or a crash."""

import hashlib
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.air.frames import symbols_of_bits
from evlcp_sdk.diagnosis.tallies import TransmitterTally
from evlcp_sdk.errors import InputError
from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.plugin.source import Loss
from evlcp_sdk.results.columns import FILTERED_COLUMNS, FRAME_COLUMNS, frame_columns, frame_value
from evlcp_sdk.results.lines import format_frame
from evlcp_sdk.results.summary import RunEnd
from evlcp_sdk.results.writer import ResultWriter
from evlcp_sdk.study.frames import read_frames
from evlcp_sdk.values import Frame, Packet, Range, SoftSymbols
from tests.conftest import rows_of

LINK = load_link(overrides=["modulation.id=wh8", "air.frames_per_packet=3", "messages.decode=false"])


def frame(packet: int, number: int, distance_m: float = 50.0, transmitter: int = 0) -> Frame:
    soft = SoftSymbols((np.arange(16) + number) % 16, np.zeros((16, 4), np.float32), 0.875)
    sigma_m = 0.05 if math.isfinite(distance_m) else math.nan
    filtered = Range(distance_m + 1, sigma_m / 2, 20) if math.isfinite(distance_m) else None
    found, t_us = Range(distance_m, sigma_m, 20), 12_345.678 + 3200 * number
    return Frame(transmitter, packet, number, t_us, soft, found, filtered, 640.1234, 360.5)


def packet(number: int, *frames: Frame, transmitter: int = 0) -> Packet:
    return Packet(transmitter, number, 9_745.678 + 12_200 * number * 0.99999, 99.999, frames, sent=3)


LOSS = Loss(1, 7, "byte", "a byte too many")
END = RunEnd("complete", {"path": "a.raw"}, {"elapsed_s": 1.0}, {"events": 3}, {"odd": LOSS})


def result(
    folder: Path, *packets: Packet, end: RunEnd = END, link: Link = LINK, **given: Any
) -> dict[str, Any]:
    with ResultWriter(folder, link, **given) as writer:
        writer.write(packets)
        return writer.finish(end)


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "packets.jsonl").read_text().splitlines()]


def test_the_files_of_a_result(tmp_path: Path) -> None:
    out = tmp_path / "out"
    one, later = packet(0, frame(0, 0), frame(0, 2, math.nan)), packet(2, frame(2, 1, 51.0))
    table = result(out, one, later, packet(0, transmitter=1))
    assert sorted(p.name for p in out.iterdir()) == ["frames.csv", "packets.jsonl", "summary.json"]

    rows = rows_of(out / "frames.csv")
    assert tuple(rows[0]) == FRAME_COLUMNS
    assert list(rows[0].values()) == [
        *("0", "0", "0", "12345.68", "0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15", "0.8750"),
        *("50.0000", "0.0500", "640.123", "360.500", ""),
    ]
    assert (rows[1]["distance_m"], rows[1]["distance_sigma_m"]) == ("", "")

    line, *others = lines_of(out)
    assert {one["kind"] for one in (line, *others)} == {"packet"}
    assert (line["transmitter"], line["packet"], line["t_us"]) == (0, 0, 9745.68)
    assert (line["frames_sent"], line["frames_received"]) == (3, 2)
    assert line["symbols"][1] is None
    assert line["bits"][64:128] == "?" * 64
    bits = [int(b) for b in line["bits"][:64]]
    assert symbols_of_bits(bits, 4, 16).tolist() == [line["symbols"][0]]

    assert table == json.loads((out / "summary.json").read_text())
    assert table["result"] == "2 transmitters, 3 frames"
    assert table["messages_off"] == "messages.decode = false"
    assert table["digest"] == LINK.digest
    assert table["codebook"] == {"digest": LINK.codebook.digest, "profile": "wh8"}
    assert table["losses"]["odd"]["first"] == 7
    first, second = table["transmitters"]
    assert first == {
        "transmitter": 0,
        "packets": 2,
        "frames_found": 3,
        "frames_expected": 8,
        "frames_ranged": 2,
        "echo_of": None,
        "frames_echo": 0,
        "symbols_given": 48,
        "symbols_erased": 0,
        "quality": 0.875,
        "clock_ppm": 10.0,
        "distance_first_m": 50.0,
        "distance_last_m": 51.0,
        "distance_median_m": 50.0,
    }
    assert {second[k] for k in ("quality", "clock_ppm", "distance_median_m")} == {None}
    short = load_link(overrides=["air.frames_per_packet=2"])
    assert "expected at least 18" in result(tmp_path / "short", link=short)["messages_off"]


def test_a_symbol_that_is_not_given_and_a_filtered_distance_in_all_files(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra parquet is not installed")
    one = frame(0, 0)
    symbols = one.soft.symbols.copy()
    symbols[[0, 5]] = -1
    hidden = replace(one, soft=replace(one.soft, symbols=symbols))
    link = load_link(overrides=["modulation.id=wh8", "air.frames_per_packet=3", "tracking.id=kalman"])
    result(tmp_path, packet(0, hidden, frame(0, 1, math.nan)), link=link, sinks=["parquet"])
    (row, other), (line,) = rows_of(tmp_path / "frames.csv"), lines_of(tmp_path)
    assert row["symbols"] == "- 1 2 3 4 - 6 7 8 9 10 11 12 13 14 15"
    assert line["symbols"][0] == [None, 1, 2, 3, 4, None, *range(6, 16)]
    assert line["bits"][:24] == "????" + "0001" + "0010" + "0011" + "0100" + "????"
    assert line["bits"][24:64] == "".join(f"{symbol:04b}" for symbol in range(6, 16))
    assert (row["distance_filtered_m"], row["distance_filtered_sigma_m"]) == ("51.0000", "0.0250")
    assert (other["distance_filtered_m"], other["distance_filtered_sigma_m"]) == ("", "")
    row, other = parquet.read_table(tmp_path / "frames.parquet").to_pylist()
    assert row["symbols"] == line["symbols"][0]
    assert (row["distance_filtered_m"], other["distance_filtered_m"]) == (51.0, None)


def test_a_reflection_is_named_as_one(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra parquet is not installed")
    own, echo = frame(0, 0), replace(frame(0, 0, transmitter=1), echo_of=0)
    table = result(tmp_path, packet(0, own), packet(0, echo, transmitter=1), sinks=["parquet"])
    assert [row["echo_of"] for row in rows_of(tmp_path / "frames.csv")] == ["", "0"]
    assert [line["echo_of"] for line in lines_of(tmp_path)] == [None, 0]
    column = parquet.read_table(tmp_path / "frames.parquet")["echo_of"]
    assert (str(column.type), column.to_pylist()) == ("int64", [None, 0])
    assert table["result"] == "1 transmitter, 1 frame; 1 reflection, 1 frame"
    reported = [(t["transmitter"], t["echo_of"], t["frames_echo"]) for t in table["transmitters"]]
    assert reported == [(0, None, 0), (1, 0, 1)]
    assert [(f.transmitter, f.echo_of) for f in read_frames(tmp_path)] == [(0, None), (1, 0)]


def test_a_new_result_replaces_all_of_the_old_one_and_only_at_the_end(tmp_path: Path) -> None:
    for name in ("regions.png", "track.png", "fixes.csv", "frames.parquet", "frames.csv", "notes.txt"):
        (tmp_path / name).write_text("old")
    with ResultWriter(tmp_path, LINK) as writer:
        writer.write([packet(0, frame(0, 0))])
        assert (tmp_path / "frames.csv").read_text() == "old"
        # A run that fails keeps what was decoded.
        table = writer.finish(replace(END, status="failed", error="found x"))
    assert (table["status"], table["error"]) == ("failed", "found x")
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["frames.csv", "notes.txt", "packets.jsonl", "summary.json"]
    assert len(rows_of(tmp_path / "frames.csv")) == 1


def test_the_summary_names_every_file_by_its_digest(tmp_path: Path) -> None:
    table = result(tmp_path, packet(0, frame(0, 0)), sinks=["points"])
    names = {p.name for p in tmp_path.iterdir()} - {"summary.json"}
    assert set(table["files"]) == names > {"frames.csv", "packets.jsonl"}
    for name, expected in table["files"].items():
        data = (tmp_path / name).read_bytes()
        assert expected == {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    assert len(read_frames(tmp_path)) == 1
    changed = (tmp_path / "frames.csv").read_text().replace(",50.0000", ",51.0000")
    (tmp_path / "frames.csv").write_text(changed)
    with pytest.raises(InputError, match=r"frames\.csv: not the file that summary\.json speaks of: SHA-256"):
        read_frames(tmp_path)
    (tmp_path / "frames.csv").unlink()
    with pytest.raises(InputError, match=r"frames\.csv: cannot be read"):
        read_frames(tmp_path)


def test_the_median_needs_no_memory_of_every_frame() -> None:
    tally = TransmitterTally(LINK.packet)
    distances = np.random.default_rng(1).normal(60.0, 2.0, 999)
    for i in range(0, 999, 3):
        tally.add(packet(i // 3, *(frame(i // 3, k, float(distances[i + k])) for k in range(3))))
    assert tally.median_m() == pytest.approx(np.median(distances), abs=0.006)
    tally.add(packet(333, frame(333, 0, 1e300)))
    assert max(tally.distance_cells) == 100_000


def test_a_line_has_all_columns() -> None:
    one = frame(0, 3)
    symbols = np.where(np.arange(16) == 1, -1, one.soft.symbols)
    found = replace(one, soft=replace(one.soft, symbols=symbols), echo_of=2)
    output = json.loads(format_frame(found, (*FRAME_COLUMNS, *FILTERED_COLUMNS)))
    assert output.pop("line") == "frame"
    assert list(output) == [*FRAME_COLUMNS, *FILTERED_COLUMNS]
    assert output["symbols"][:3] == [3, None, 5]
    for name, value in output.items():
        given = frame_value(found, name)
        assert value == (pytest.approx(given, abs=6e-3) if isinstance(given, float) else given)


def test_what_is_no_number_is_null() -> None:
    found = frame(0, 0)
    for value in (math.nan, math.inf, -math.inf):
        soft = replace(found.soft, quality=value)
        odd = replace(found, soft=soft, range=Range(value, value, 0), x_px=value, link="nan inf None")
        output = json.loads(format_frame(odd, frame_columns(filtered=False, links=True)))
        names = ("quality", "distance_m", "distance_sigma_m", "x_px", "echo_of")
        assert [output[name] for name in names] == [None] * 5
        assert (output["line"], output["link"], output["y_px"]) == ("frame", "nan inf None", 360.5)
