"""Films: what a picture shows, event by event; what is shown of a recording; what cannot be."""

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.io import write_events
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.report.film import Film, Footage, count_pictures, draw_film, plan_film, save_film
from evlcp_sdk.run import film
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import Events, Frame, Range, Region, SoftSymbols

LINK = load_link()
LINKS = {"": LINK}
HEAD_PX = 20
SOFT = SoftSymbols(np.arange(16), np.zeros((16, 6), np.float32), 1.0)


def frame_at(x: float, y: float, number: int = 0, length: float = 90.0) -> Frame:
    points = np.column_stack([np.full(16, x), y + length * (np.arange(16) / 15 - 0.5)])
    return Frame(number, 0, 0, 1000.0, SOFT, Range(50, 0.02, 9), None, x, y, points, np.full(16, 0.1), 1500.0)


def random_events(count: int) -> Events:
    rng = np.random.default_rng(3)
    t_us = np.sort(rng.integers(0, 5000, count))
    return Events.of(t_us, *(rng.integers(0, most, count) for most in (40, 30, 2)))


def kinds(picture: Image.Image) -> np.ndarray:
    """1 where a picture is yellow, -1 where it is blue, 0 where it is dark, below the line above."""
    pixels = np.asarray(picture.convert("RGB")).astype(int)[HEAD_PX:]
    strong = pixels.max(2) > 90
    grey = np.ptp(pixels, axis=2) < 60
    return np.where(strong & ~grey, np.sign(pixels[..., 0] - pixels[..., 2]), 0)


@pytest.mark.parametrize("pieces", [1, 7, 300])
def test_a_picture_shows_the_last_chip_before_it(pieces: int) -> None:
    """In films that are faster than the chips; by a loop over all events, whatever pieces they come in."""
    events = random_events(900)
    shown = Film(1000.0, 8, 5, 3, 30, 20, 2.0, 100.0)
    cuts = np.array_split(np.arange(len(events)), pieces)
    pictures = list(draw_film(shown, (events[c] for c in cuts), Footage(0.0), LINKS))
    assert len(pictures) == 8
    for n, picture in enumerate(pictures):
        net = np.zeros((20, 30), int)
        for t, x, y, p in zip(events.t_us, events.x, events.y, events.p, strict=True):
            until = 1000 + 400 * (n + 1)
            if until - 100 <= t < until and 5 <= x < 35 and 3 <= y < 23:
                net[y - 3, x - 5] += 1 if p else -1
        assert picture.size == (60, 40 + HEAD_PX)
        assert (kinds(picture)[::2, ::2] == np.sign(net)).all()


def test_a_film_reads_no_further_than_it_shows() -> None:
    def endless() -> Iterator[Events]:
        for n in range(100):
            assert n < 5, "read on"
            yield Events.of([100 * n], [7], [7], [1])

    shown = Film(0.0, 3, 0, 0, 9, 9, 1.0, 400.0)
    assert len(list(draw_film(shown, endless(), Footage(0.0), LINKS))) == 3
    # Pictures after the last event are dark.
    dark = list(draw_film(shown, [], Footage(0.0), LINKS))
    assert [np.abs(kinds(p)).sum() for p in dark] == [0, 0, 0]


def test_what_is_shown_holds_the_bars_and_stays_in_the_image() -> None:
    camera = CameraModel()

    def plan(*frames: Frame, regions: tuple[Region, ...] = (), **more: Any) -> Film:
        return plan_film(Footage(0.0, 0.0, frames, regions), 20_000.0, 400.0, camera, 640, **more)

    for x, y in ((640.0, 360.0), (3.0, 3.0), (1278.0, 717.0)):
        one = plan(frame_at(x, y))
        assert 0 <= one.left <= x < one.left + one.columns <= camera.width
        assert 0 <= one.top <= y < one.top + one.rows <= camera.height
        assert one.columns < 300 > one.rows
        assert max(one.size_px[0], one.size_px[1] - HEAD_PX) <= 640
    two = plan(frame_at(100, 300), frame_at(1100, 400, 1))
    assert two.columns > 1000
    assert two.size_px[0] == 640
    blinks = plan(regions=(Region(0, 0.0, 900.0, 100.0, 20.0, 40.0),))
    assert blinks.left <= 890 <= 910 <= blinks.left + blinks.columns < 1000
    for all_of_it in (plan(), plan(frame_at(640, 360), whole=True)):
        assert (all_of_it.left, all_of_it.top) == (0, 0)
        assert (all_of_it.columns, all_of_it.rows) == (camera.width, camera.height)
    assert plan().pictures == count_pictures(20, 400) == 20e-3 * 400 * 25


def test_a_film_of_a_recording(evlcp: Callable[..., Any], demo_raw: Path, tmp_path: Path) -> None:
    for name, pictures, more in (
        ("a.webp", 10, ("--for-ms", "1")),
        ("b.gif", 20, ("--from-ms", "20", "--for-ms", "2", "--size", "200", "--json")),
    ):
        done = evlcp("video", demo_raw, "-o", tmp_path / name, *more)
        assert done.code == 0, done.err
        assert (tmp_path / name).stat().st_size < 1_000_000
        with Image.open(tmp_path / name) as picture:
            width, height = picture.size
            assert picture.n_frames == pictures
            assert picture.info["loop"] == 0
            picture.seek(pictures // 2)
            picture.load()
            assert picture.info["duration"] == 40
            lit = np.abs(kinds(picture.convert("RGB")))
        # The bar stands in the middle, and nothing else is as bright.
        columns = lit[HEAD_PX:].sum(0)
        assert abs(int(columns.argmax()) - width / 2) < 0.1 * width
        if name == "b.gif":
            result = json.loads(done.out)
            assert (result["pictures"], result["width"], result["height"]) == (pictures, width, height)
            assert (result["transmitters"], result["from_ms"]) == ([0], 20)
        else:
            assert "1 ms from 5.6 ms on, at 1/400; 1 transmitter, 1 frame\n" in done.out
            assert f"{pictures} pictures of {width} x {height} px" in done.out


def test_a_film_for_programs_that_play_no_pictures(tmp_path: Path) -> None:
    """Read again, each of its pictures is near the one that was drawn; an odd side gets one more."""
    av = pytest.importorskip("av")
    shown = Film(1000.0, 8, 5, 3, 31, 21, 3.0, 100.0)
    drawn = list(draw_film(shown, [random_events(900)], Footage(0.0), LINKS))
    save_film(drawn, tmp_path / "a.mp4", "MP4")
    with av.open(tmp_path / "a.mp4") as file:
        (stream,) = file.streams
        assert (stream.codec_context.name, stream.width, stream.height) == ("h264", 94, 84)
        assert stream.average_rate == 25
        again = [frame.to_ndarray(format="rgb24") for frame in file.decode(stream)]
    assert len(again) == len(drawn) == 8
    for picture, read in zip(drawn, again, strict=True):
        off = np.abs(read[:83, :93].astype(int) - np.asarray(picture.convert("RGB")).astype(int))
        assert off.mean() < 12


def test_what_cannot_be_filmed(demo_raw: Path, tmp_path: Path) -> None:
    few, no, out = (tmp_path / name for name in ("few.raw", "no.raw", "a.gif"))
    write_events(few, Events.of([10, 3010], [1, 2], [3, 4], [1, 0]), 1280, 720)
    write_events(no, Events.empty(), 1280, 720)
    large: dict[str, Any] = {"for_ms": 50, "whole": True, "longest_px": 1280}
    for message, recording, file, given in (
        ("100 ms at 1/400 would be 1000 pictures, at most 500", demo_raw, out, {"for_ms": 100}),
        ("20 ms at 1/inf would be inf pictures", demo_raw, out, {"slow": math.inf}),
        ("500 pictures of 1280 x 740 px are 474 megapixels, at most 160", demo_raw, out, large),
        ("a film needs a file", "-", out, {}),
        ("loop=1: a film needs a file", f"replay:{few}?loop=1", out, {}),
        ("a.avi: a film is written as NAME.webp or NAME.gif or NAME.mp4", few, tmp_path / "a.avi", {}),
        (r"ends 3\.0 ms after its first event, nothing to show from 4 ms on", few, out, {"from_ms": 4}),
        ("no.raw: no events", no, out, {}),
    ):
        with pytest.raises((ConfigError, InputError), match=message):
            film(recording, file, LINK, **given)
    assert not out.exists()
    shown = film(few, out, LINK, for_ms=0.4)
    assert [shown[key] for key in ("frames", "width", "pictures", "from_ms")] == [0, 640, 4, 0]
