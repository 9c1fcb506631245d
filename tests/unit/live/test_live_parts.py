"""Listeners, delays, pictures, the budget and the reader of a live run, one by one."""

import io
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.live import Budget, DelayTally, PictureSlot, Publisher, Shedder
from evlcp_sdk.live.reader import ArrivalClock, Reader
from evlcp_sdk.plugin.source import EventSource
from evlcp_sdk.results.picture import encode_png, paint_events
from evlcp_sdk.values import Events, Region, Triggers


def events_at(t_us: list[int] | np.ndarray, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    n = len(t_us)
    return Events.of(t_us, rng.integers(0, 1280, n), rng.integers(0, 720, n), rng.integers(0, 2, n))


def test_each_listener_gets_its_kinds_and_its_queue() -> None:
    publisher = Publisher()
    woken = []
    frames = publisher.subscribe({"frame"}, most=3, wake=lambda: woken.append(1))
    everything = publisher.subscribe()
    for number in range(5):
        publisher.publish("frame", number, number, late_ms=0.5)
        publisher.publish("status", number, number)
    assert [news.value for news in frames.take()] == [2, 3, 4]
    assert (frames.dropped, everything.dropped, len(woken)) == (2, 0, 5)
    assert [(news.kind, news.value) for news in everything.take()][:2] == [("frame", 0), ("status", 0)]
    assert frames.take(timeout_s=0) == []
    publisher.unsubscribe(frames)
    publisher.publish("frame", 9.0, 9)
    assert (frames.ended, everything.ended) == (True, False)
    publisher.close()
    assert [news.value for news in everything.take()] == [9]
    assert everything.ended
    assert publisher.subscribe().ended


def test_quantiles_are_those_of_numpy_to_two_percent() -> None:
    rng = np.random.default_rng(1)
    delays_ms = rng.lognormal(0.5, 1.5, 5000)
    tally = DelayTally()
    for delay_ms in delays_ms:
        tally.add(float(delay_ms))
    for share in (0.01, 0.5, 0.99, 1.0):
        expected = np.quantile(delays_ms, share, method="inverted_cdf")
        assert expected * 0.999 <= tally.quantile_ms(share) <= expected * 1.021
    reported = tally.to_dict()
    assert reported["count"] == 5000
    assert reported["max_ms"] == round(float(delays_ms.max()), 3)
    assert DelayTally().to_dict()["p50_ms"] is None


@pytest.mark.parametrize("size", [(5, 4), (3, 7), (16, 1), (1, 2), (1, 1), (34, 50), (640, 480)])
@pytest.mark.parametrize("density", [0.0, 0.0003, 0.01, 0.3, 3.0])
def test_a_picture_is_read_back(size: tuple[int, int], density: float) -> None:
    (width, height), rng = size, np.random.default_rng(1)
    painted, cells = np.zeros((2, height, width), np.uint8)
    for _ in range(2):
        n = int(width * height * density)
        # Some lie outside.
        events = Events.of(*(rng.integers(0, most, n) for most in (9, width + 2, height + 1, 2)))
        paint_events(painted, events)
        paint(cells, events)
    assert (painted == cells).all()
    reported = encode_png(painted)
    with Image.open(io.BytesIO(reported)) as picture:
        picture.load()
        assert picture.mode == "P"
        assert (np.array(picture) == cells).all()
        assert reported[24] == 2, "bits a pixel"
        assert picture.getpalette()[:12] == [16, 16, 20, 70, 150, 255, 255, 205, 70, 235, 235, 235]


def paint(cells: np.ndarray, events: Events) -> None:
    """One by one: 1 where a pixel went off, 2 where it went on, 3 both."""
    height, width = cells.shape
    for column, row, sign in zip(events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True):
        if row < height and column < width:
            cells[row, column] |= 1 << sign


def test_a_picture_shows_what_each_pixel_did() -> None:
    slot = PictureSlot()
    slot.request()
    events = events_at(np.sort(np.random.default_rng(2).integers(0, 50_000, 4000)))
    drawn = []
    for from_us in range(0, 50_000, 5000):
        if from_us in (25_000, 45_000):
            slot.request()
        before = slot.newest
        slot.add(events[(events.t_us >= from_us) & (events.t_us < from_us + 5000)], 1280, 720, [])
        if slot.newest is not before:
            drawn.append(slot.newest)
    assert [picture.number for picture in drawn] == [0, 1, 2]
    for picture in drawn:
        cells = np.zeros((720, 1280), np.uint8)
        paint(cells, events[(events.t_us > picture.t_us - 10_000) & (events.t_us <= picture.t_us)])
        assert (picture.paint() == cells).all()
    slot.add(events_at([5]), 1280, 720, [])
    assert len(slot._recent) == 1, "the camera's clock has restarted"


def test_what_is_shed_and_counted_is_what_lies_outside() -> None:
    events = events_at(np.arange(50_000, 54_000))
    regions = [Region(0, 0.0, 100.0, 200.0, 20.0, 60.0), Region(1, 0.0, 1270.0, 700.0, 20.0, 60.0)]
    shedder = Shedder()
    assert shedder.shed(events, 0, regions) is events
    assert shedder.shed(events, 4, []) is events
    rows, inside = set(), np.zeros(len(events), bool)
    for r in regions:
        near_y = np.abs(events.y - r.y_px) <= r.height_px / 2 + 16
        inside |= near_y & (np.abs(events.x - r.x_px) <= r.width_px / 2 + 16)
        rows |= set(events.y[near_y].tolist())
    by_rows, by_area = shedder.shed(events, 1, regions), shedder.shed(events, 3, regions)
    assert (by_rows.t_us == events.t_us[np.isin(events.y, list(rows))]).all()
    assert (by_area.t_us == events.t_us[inside]).all()
    assert shedder.counts == {
        "rows_outside_regions": len(events) - len(by_rows),
        "empty_areas": len(events) - len(by_area),
        "too_late": 0,
    }
    # New bars are found in times that are left whole.
    sweep = events_at(np.arange(100_000, 101_000))
    assert len(shedder.shed(sweep, 2, regions)) == 1000
    assert len(shedder.shed(sweep, 3, regions)) < 1000


def test_a_budget_rises_at_once_and_falls_at_half() -> None:
    budget = Budget(waiting_ms=10, most_ms=100)
    levels, level = [], 0
    for waiting_ms in (0, 11, 6, 4, 21, 15, 9, 41, 101, 60, 49, 19, 9, 4):
        level = budget.choose_level(waiting_ms, level)
        levels.append(level)
    assert levels == [0, 1, 1, 0, 2, 2, 1, 3, 4, 4, 3, 2, 1, 0]
    with pytest.raises(ConfigError, match="the most at least four times"):
        Budget(waiting_ms=10, most_ms=20)


def test_the_least_delay_of_the_last_seconds_is_none_and_drift_is_followed() -> None:
    clock = ArrivalClock()
    rng = np.random.default_rng(3)
    for n in range(20_000):
        t_us = n * 1000.0
        # The camera's clock is 100 ppm slow; slices come up to 3 ms late.
        arrived_s = 5.0 + t_us * 1e-6 * 1.0001 + rng.uniform(0, 3e-3)
        clock.add_arrival(t_us, arrived_s)
    assert abs(clock.to_host_s(20e6) - (5.0 + 20 * 1.0001)) < 0.5e-3
    # The camera's clock leaps ahead by a minute.
    clock.add_arrival(80e6, 25.1)
    assert clock.to_host_s(80e6) == pytest.approx(25.1)


class Counted(EventSource):
    """A thousand pieces of ten events, as fast as they are taken."""

    def __init__(self, live: bool, fault: Exception | None = None) -> None:
        super().__init__(Path("counted"), "X", 1280, 720)
        self.live = live
        self.pieces: Iterator[int] = iter(range(1000))
        self.fault = fault
        self.all_taken = threading.Event()

    def take(self, max_events: int) -> tuple[Events, Triggers] | None:
        n = next(self.pieces, None)
        if n is None:
            self.all_taken.set()
            if self.fault:
                raise self.fault
            return None
        return events_at([n] * 10), Triggers.empty()

    def close(self) -> None:
        pass


def read_all(source: Counted) -> tuple[Reader, list[int]]:
    """A reader that has read all there is, or all that it may, before it is asked; and what it gives."""
    reader, got = Reader(source), []
    if source.live:
        assert source.all_taken.wait(60)
    while not reader.ended:
        piece = reader.take(0.05)
        if piece is not None:
            got.append(int(piece.events.t_us[0]))
    return reader, got


def test_a_file_waits_for_its_reader_and_a_camera_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evlcp_sdk.live.reader._MAX_EVENTS", 50)
    reader, got = read_all(Counted(live=False))
    assert got == list(range(1000))
    assert (reader.dropped, reader.fault) == (0, None)
    reader, got = read_all(Counted(live=True))
    assert got == list(range(1000 - len(got), 1000))
    assert reader.dropped == 10 * (1000 - len(got)) > 0
    monkeypatch.undo()
    fault = InputError("unplugged")
    reader, got = read_all(Counted(live=True, fault=fault))
    assert len(got) == 1000
    assert reader.fault is fault
