"""Figures: drawn from whatever a recording gives, in bounded memory."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.report.figures import (
    FigureProbe,
    Figures,
    draw_distance,
    draw_presence,
    draw_regions,
)
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import Events, Frame, PresenceMap, Range, Region, SoftSymbols


def presence(fill: float) -> PresenceMap:
    probability = np.zeros((16, 40, 4), np.float32)
    pixels = np.zeros((16, 80, 8), np.float32)
    for k in range(16):
        probability[k, 2 * k : 2 * k + 2, 1:3] = fill
        pixels[k, 4 * k : 4 * k + 4, 2:6] = fill
    return PresenceMap(probability, 2, probability > 0.5, pixels)


def frame(transmitter: int, number: int, distance_m: float, quality: float = 0.9) -> Frame:
    soft = SoftSymbols(np.zeros(16, np.int64), np.zeros((16, 6), np.float32), quality)
    return Frame(transmitter, 0, number, 3200.0 * number, soft, Range(distance_m, 0.1, 9), None, 100.0, 200.0)


def told(probe: FigureProbe, transmitters: int, frames: int, fill: float = 1.0) -> FigureProbe:
    for n in range(transmitters):
        for i in range(frames):
            probe.evlcp_stage_finished("regions", Region(n, 1000.0 * i, 100.0 + 50 * n, 200.0, 6.0, 80.0))
            probe.evlcp_stage_finished("separation", presence(fill))
            probe.evlcp_stage_finished("frame", frame(n, i, 50.0 - i, quality=0.5 + 0.4 * (i == 3)))
    return probe


def test_the_image_counts_events_on_the_sensor() -> None:
    probe = FigureProbe(CameraModel())
    probe.watch(Events.empty())
    probe.watch(Events.of([70, 80, 90], [5, 5, 2000], [6, 6, 6], [1, 0, 1]))
    assert probe.first_us == 70
    assert probe.image[6, 5] == probe.image.sum() == 2


@pytest.mark.parametrize("transmitters", [0, 7])
def test_any_number_of_transmitters(transmitters: int, tmp_path: Path) -> None:
    names = ["regions.png", "presence.png", "distance.png"]
    with ResultFolder(tmp_path, names) as folder:
        sink = Figures(folder, Run("a.raw", load_link()))
        told(sink.probe, transmitters, 5)
        sink.finish()
        folder.finish()
    names = names[: 3 if transmitters else 1]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names)


def test_nothing_to_show() -> None:
    probe = FigureProbe(CameraModel())
    assert isinstance(draw_regions(probe, "empty"), Figure)
    dark = told(FigureProbe(CameraModel()), 1, 1, fill=0.0)
    draw_presence(dark, "dark").draw_without_rendering()
    dark.evlcp_stage_finished("frame", frame(1, 0, math.nan))
    draw_distance(dark, "no distance").draw_without_rendering()


def test_a_reflection_is_named_as_one() -> None:
    """By the newest frame, which knows most; the clearest may have been told before."""
    probe = told(FigureProbe(CameraModel()), 2, 6)
    probe.evlcp_stage_finished("frame", replace(frame(1, 6, 44.0), echo_of=0))
    presences = draw_presence(probe, "REC.raw")
    parts = presences.subfigs
    presences.draw_without_rendering()
    for part in parts:
        (label,) = part.texts
        assert label.get_window_extent().x0 >= part.bbox.x0
        assert label.get_window_extent().x1 <= part.bbox.x1
    titles = [
        [part.get_suptitle() for part in parts],
        [axis.get_title(loc="left") for axis in draw_distance(probe, "REC.raw").get_axes()],
    ]
    for every in titles:
        named = [t for t in every if t.startswith("transmitter") and "off its" not in t]
        assert [title.startswith(f"transmitter {n}") for n, title in enumerate(named)] == [True, True]
        assert ["reflection of 0" in title for title in named] == [False, True]


def test_many_regions_and_transmitters_keep_a_bounded_share() -> None:
    """Regions with the most places stay; transmitters that no figure shows are not kept."""
    probe = FigureProbe(CameraModel(), points=8, most_regions=5)
    for number in range(300):
        for i in range(6 if number < 4 else 1):
            probe.evlcp_stage_finished("regions", Region(number, 1000.0 * i, 100.0, 200.0, 6.0, 80.0))
    assert set(probe.regions) >= {0, 1, 2, 3}
    assert len(probe.regions) == 5
    assert probe.many_regions == 300
    told(probe, 40, 2)
    assert sorted(probe.frames) == sorted(probe.clearest) == list(range(len(probe.frames)))
    assert len(probe.frames) < 10
    assert f"{probe.many_regions} regions, 5 shown" in draw_regions(probe, "many").axes[0].get_title("left")
