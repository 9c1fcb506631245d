"""Figures: drawn from whatever a recording gives, in bounded memory."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.report.figures import Figures, draw_distance, draw_presence, draw_regions
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run
from evlcp_sdk.testing import ideal_presence
from evlcp_sdk.testing.trees import map_arrays
from evlcp_sdk.values import Events, Frame, Packet, PresenceMap, Range, Region, SoftSymbols


def presence(fill: float) -> PresenceMap:
    shown = ideal_presence(16)
    return map_arrays(shown, lambda array: (array * fill).astype(array.dtype))


def frame(transmitter: int, number: int, distance_m: float, quality: float = 0.9) -> Frame:
    soft = SoftSymbols(np.zeros(16, np.int64), np.zeros((16, 6), np.float32), quality)
    return Frame(transmitter, 0, number, 3200.0 * number, soft, Range(distance_m, 0.1, 9), None, 100.0, 200.0)


@pytest.fixture
def figures(tmp_path: Path) -> Iterator[Figures]:
    with ResultFolder(tmp_path, []) as folder:
        yield Figures(folder, Run("REC.raw", load_link()))


def give(figures: Figures, one: Frame) -> None:
    figures.evlcp_stage_finished("frame", one)
    figures.packet(Packet(one.transmitter, one.packet, one.t_us, 100.0, (one,), 10))


def show(figures: Figures, transmitters: int, frames: int, fill: float = 1.0) -> Figures:
    """Have so many transmitters seen in so many frames."""
    for n in range(transmitters):
        for i in range(frames):
            figures.evlcp_stage_finished("regions", Region(n, 1000.0 * i, 100.0 + 50 * n, 200.0, 6.0, 80.0))
            figures.evlcp_stage_finished("separation", presence(fill))
            give(figures, frame(n, i, 50.0 - i, quality=0.5 + 0.4 * (i == 3)))
    return figures


def test_the_image_counts_events_on_the_sensor(figures: Figures) -> None:
    figures.events(Events.empty())
    figures.events(Events.of([70, 80, 90], [5, 5, 2000], [6, 6, 6], [1, 0, 1]))
    assert figures.first_us == 70
    assert figures.image[6, 5] == figures.image.sum() == 2


def test_nothing_to_show(figures: Figures) -> None:
    show(figures, 1, 1, fill=0.0)
    draw_presence(figures, "dark").draw_without_rendering()
    give(figures, frame(1, 0, math.nan))
    draw_distance(figures, "no distance").draw_without_rendering()


def test_a_reflection_is_named_as_one(figures: Figures) -> None:
    """By the newest frame, which knows most; the clearest may have been told before."""
    give(show(figures, 2, 6), replace(frame(1, 6, 44.0), echo_of=0))
    presences = draw_presence(figures, "REC.raw")
    for every in (
        [part.get_suptitle() for part in presences.subfigs],
        [axis.get_title(loc="left") for axis in draw_distance(figures, "REC.raw").get_axes()],
    ):
        named = [t for t in every if t.startswith("transmitter") and "off its" not in t]
        assert [title.startswith(f"transmitter {n}") for n, title in enumerate(named)] == [True, True]
        assert ["reflection of 0" in title for title in named] == [False, True]


def test_many_regions_and_transmitters_keep_a_bounded_share(figures: Figures) -> None:
    """Regions with the most places stay; transmitters that no figure shows are not kept."""
    for number in range(300):
        for i in range(6 if number < 4 else 1):
            figures.evlcp_stage_finished("regions", Region(number, 1000.0 * i, 100.0, 200.0, 6.0, 80.0))
    assert set(figures.regions) >= {0, 1, 2, 3}
    assert (len(figures.regions), figures.region_count) == (64, 300)
    show(figures, 40, 2)
    assert (sorted(figures.transmitters), sorted(figures.clearest)) == ([*range(6)], [*range(3)])
    title = draw_regions(figures, "many").axes[0].get_title("left")
    assert f"{figures.region_count} regions, 64 shown" in title
