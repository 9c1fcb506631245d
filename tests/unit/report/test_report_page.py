"""The report of a recording: its numbers are those of the files, it is bounded, and a browser shows it."""

import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.air.frames import packet_chips
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.place.navigator import PositionPlan
from evlcp_sdk.report.motion import Motion, cluster_map
from evlcp_sdk.report.page import Report
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run
from evlcp_sdk.results.summary import RunEnd
from evlcp_sdk.results.writer import ResultWriter
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.testing import ideal_view
from evlcp_sdk.values import Events, Frame, FrameView, Packet, Range, SoftSymbols
from tests.conftest import rows_of
from tests.unit.report.test_pages import HOSTILE, Elements
from tests.unit.results.test_positions import ATTITUDE, SITE, packets
from tests.unit.study.browser import CHROMIUM, Browser

LINK = load_link()
SUMMARY: dict[str, Any] = {
    "status": "complete",
    "error": None,
    "result": HOSTILE,
    "transmitters": [],
    "recording": {"path": HOSTILE, "duration_s": 1.0, "counts": {"events": 7}},
    "processing": {"times_real_time": 1.0},
    "counts": {},
    "messages_off": HOSTILE,
    "warnings": [{"code": "a", "text": HOSTILE, "next_step": HOSTILE, "transmitter": 1}],
    "notes": [{"code": "b", "text": HOSTILE, "next_step": "", "transmitter": None}],
    "losses": {},
    "digest": "d" * 64,
    "configuration": {HOSTILE: HOSTILE},
    "versions": {},
}


@pytest.fixture(scope="module")
def result(demo_raw: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    receive_to_folder(demo_raw, folder, LINK, sinks=["report"])
    return folder


def plots_of(page: str) -> dict[str, Any]:
    """What the page's script reads."""
    plots, report = map(json.loads, Elements(page).scripts[:2])
    return {"plots": plots} | report


@contextmanager
def open_report(folder: Path, name: str = "a.raw", **summary: Any) -> Iterator[Report]:
    with ResultFolder(folder, ["report.html"]) as files:
        sink = Report(files, Run(name, LINK))
        yield sink
        sink.conclude(SUMMARY | summary)
        files.finish()


def test_numbers_are_those_of_the_files(result: Path) -> None:
    page = (result / "report.html").read_text()
    given, output = rows_of(result / "frames.csv"), plots_of(page)["plots"]
    assert len(given) == 21
    body = re.findall(r"<tr><td>(\d+)/(\d+)</td>(.*?)</tr>", page, re.DOTALL)
    dots = [text for _, _, text, _ in output["distance-0"]]
    for row, (packet, frame, cells), dot in zip(given, body, dots, strict=True):
        values = re.findall(r"<td[^>]*>(.*?)</td>", cells)
        assert (packet, frame) == (row["packet"], row["frame"])
        assert values[3:] == row["symbols"].split()
        # Both are rounded from the same number, the file's to more places.
        shown = [float(one) for one in values[1].split(" ± ")]
        assert shown == pytest.approx([float(row["distance_m"]), float(row["distance_sigma_m"])], abs=0.0051)
        assert f"{row['distance_m']} ± {row['distance_sigma_m']} m" in dot
        assert f"quality {row['quality']}" in dot
        assert f"packet {packet}, frame {frame}," in dot
    # Dots stand where their times and distances are, to a thousandth of the chart.
    for plot, axis, column, sign in (("quality", 0, "t_us", 1), ("distance-0", 1, "distance_m", -1)):
        at = np.array([dot[axis] for dot in output[plot]])
        value = np.array([float(row[column]) for row in given])
        slope, first = np.polyfit(value, at, 1)
        assert slope * sign > 0
        assert at == pytest.approx(slope * value + first, abs=1.1)
    summary = json.loads((result / "summary.json").read_text())
    doubts = [one["text"] for one in (*summary["warnings"], *summary["notes"])]
    for text in (summary["result"], *doubts, summary["digest"]):
        assert text in Elements(page).text
    assert f"<b>{21 * 16 * 6:,}</b>" in page
    assert summary["files"]["report.html"]["bytes"] == len(page.encode()) < 1_000_000


def test_the_slow_motion_is_what_was_sent(result: Path) -> None:
    (first,) = plots_of((result / "report.html").read_text())["motions"]
    named = "transmitter {transmitter}, packet {packet}, frame {frame}"
    (row,) = [one for one in rows_of(result / "frames.csv") if named.format(**one) == first["name"]]
    symbols = [int(s) for s in row["symbols"].split()]
    assert first["symbols"] == symbols
    sent = packet_chips(np.array([symbols]), LINK.codebook)[LINK.packet.preamble_chips :]
    assert first["lit"] == ["".join(map(str, chips)) for chips in sent.T.tolist()]
    shape = (first["chips"], first["height"], first["width"])
    sums = (np.frombuffer(first["events"].encode(), np.uint8).astype(int) - ord("e")).reshape(shape)
    clusters = np.array(first["clusters"]).reshape(shape[1:])
    assert set(clusters.ravel()) == set(range(-1, 16))
    # What a cluster shows changes with what it sends: events of a rising edge are positive.
    change = np.diff(sent.astype(int), axis=0)
    for k in range(16):
        seen = sums[1:, clusters == k].sum(1)
        assert np.corrcoef(seen, change[:, k])[0, 1] > 0.8


def motion_of(cluster_px: int) -> tuple[Motion, FrameView]:
    view = ideal_view(LINK.codebook, np.zeros(16, np.int64), cluster_px=cluster_px)
    nothing = Range(math.nan, math.nan, 0)
    return Motion.of(Frame(0, 0, 0, 0.0, view.soft, nothing, None, 5.0, 6.0), view), view


def test_a_picture_is_bounded_whatever_its_size() -> None:
    motion, view = motion_of(100)
    assert view.sums.size > 1_000_000
    assert motion.sums[0].shape == motion.clusters.shape
    assert motion.sums.size <= 300_000
    assert list(np.unique(motion.clusters)) == list(range(-1, 16))
    cut, view = motion_of(8)
    rows, columns = np.nonzero(cluster_map(view.presence, view.sums.shape[1:]) >= 0)
    top, left = rows.min() - 3, columns.min() - 3
    height, width = cut.clusters.shape
    assert (height, width) == (np.ptp(rows) + 7, np.ptp(columns) + 7)
    assert (cut.sums == view.sums[:, top : top + height, left : left + width]).all()


def test_a_recording_of_any_length_has_a_page_of_bounded_size(tmp_path: Path) -> None:
    """A long one is thinned: what is kept, and the page, do not grow."""
    soft = SoftSymbols(np.arange(16), np.zeros((16, 6), np.float32), 0.9)
    with open_report(tmp_path) as sink:
        for n in range(4000):
            frames = tuple(
                Frame(n % 9, n, k, 34e3 * n + 3200 * k, soft, Range(50 - n / 100, 0.1, 9), None, 5.0, 6.0)
                for k in range(10)
            )
            sink.packet(Packet(n % 9, n, 34e3 * n, 100.0, frames, 10))
        assert len(sink.transmitters) == 6
        assert all(len(seen.frames) <= 512 and len(seen.first) == 40 for seen in sink.transmitters.values())
    page = (tmp_path / "report.html").read_text()
    assert len(page) < 1_500_000
    assert re.search(r"[\d,]+ of 26,6\d0 frames are shown", page)


def test_what_others_wrote_stays_text(tmp_path: Path) -> None:
    with open_report(tmp_path, HOSTILE) as sink:
        sink._message_count = 101
        output: Any = SimpleNamespace(
            t_us=1e3,
            kind=SimpleNamespace(name=HOSTILE),
            message=SimpleNamespace(transmitter_id=7),
            trust="unverified",
            summary=lambda _most: HOSTILE,
        )
        sink._messages.append(output)
    page = Elements((tmp_path / "report.html").read_text())
    assert not [tag for tag, _ in page.tags if tag in ("img", "iframe")]
    assert len(page.scripts) == 4
    assert page.text.count(HOSTILE) == 9
    assert "100 between the first and the last ones are left out" in page.text


def test_the_map_shows_fixes_and_bars(tmp_path: Path) -> None:
    with ResultWriter(tmp_path, LINK, sinks=["report"], plan=PositionPlan((SITE,)), attitude=ATTITUDE) as out:
        out.write(packets(13))
        recording = {"path": "a.raw", "duration_s": 0.5, "counts": {"events": 1}}
        summary = out.finish(RunEnd("complete", recording, {"times_real_time": 1.0}))
    output = plots_of((tmp_path / "report.html").read_text())["plots"]
    fixes = rows_of(tmp_path / "fixes.csv")
    assert summary["positions"]["fixes"] == len(fixes) == len(output["track"]) == len(output["map"]) - 1
    for fix, (_, _, text, _) in zip(fixes, output["track"], strict=True):
        shown = [float(value) for value in re.findall(r"± (\S+) m", text)]
        sigmas = [float(fix[f"sigma_{axis}_m"]) for axis in ("east", "north", "up")]
        assert shown == pytest.approx(sigmas, rel=0.051)
    assert output["map"][-1][2].startswith("bar 0\neast 0.000 m\nnorth 0.000 m")
    assert {"height", "spread"} <= output.keys()


def test_nothing_found_has_a_page(tmp_path: Path) -> None:
    with ResultWriter(tmp_path, LINK, sinks=["report"]) as out:
        out.events(Events.empty())
        recording = {"path": "a.raw", "duration_s": 0.0, "counts": {"events": 0}}
        out.finish(RunEnd("complete", recording, {"times_real_time": None}))
    text = Elements((tmp_path / "report.html").read_text()).text
    assert "no transmitter was found" in text
    assert "Nothing looks wrong" not in text
    assert "evlcp diagnose" in text


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_a_browser_shows_it_wide_and_narrow_light_and_dark(result: Path, tmp_path: Path) -> None:
    plots = plots_of((result / "report.html").read_text())["plots"]
    with Browser(tmp_path / "profile") as browser:
        for width, dark in ((1280, False), (390, True)):
            browser.dress(width, dark=dark)
            browser.open(result / "report.html")
            assert browser.fits()
            paper = browser.value("getComputedStyle(document.body).backgroundColor")
            assert (sum(map(int, re.findall(r"\d+", paper))) < 380) is dark
            pictures = [picture(browser, chip) for chip in (0, 20, 20)]
            assert pictures[0] != pictures[1] == pictures[2]
            assert "chip 21 of 32, symbol, " in browser.value("document.querySelector('output').textContent")
            dot = plots["distance-0"][10]
            assert browser.hover("distance-0", dot) == dot[2]
            # The picture moves by itself until it is stopped.
            browser.value("document.querySelector('#motion button').click()")
            browser.until("document.querySelector('#motion input').value != 20")
            assert {url.split(":")[0] for url in browser.requests} <= {"file", "data"}
            assert browser.faults == []


def picture(browser: Browser, chip: int) -> str:
    """The slow-motion picture with the slider at a chip."""
    return str(
        browser.value(
            f"(() => {{ const s = document.querySelector('#motion input'); s.value = {chip};"
            " s.dispatchEvent(new Event('input')); return document.querySelector('canvas').toDataURL() })()"
        )
    )
