"""Figures that the receiver gives of some scenes, to five digits: whoever moves one means to, or is wrong."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from rx_streams import LINK, frames_of, received

import evlcp_sdk as evlcp
from evlcp_sdk.files import shipped
from evlcp_sdk.io import read_events
from evlcp_sdk.link.resolve import Link, load_link, resolve
from evlcp_sdk.sim import load_scene
from evlcp_sdk.values import Events, Packet
from tests.conftest import ROOT


def figures(packets: list[Packet]) -> list[float]:
    """Frames; means of distance, sigma, place, time, LLRs, quality, symbols and points; reflections."""
    frames = frames_of(packets)
    ranges = np.array([(f.range.distance_m, f.range.sigma_m, f.x_px, f.y_px, f.t_us) for f in frames])
    soft = np.array([(np.abs(f.soft.llr).mean(), f.soft.quality, f.soft.symbols.mean()) for f in frames])
    points = [
        np.nanmean(np.concatenate(part))
        for part in zip(*((f.points_px, f.points_sigma_px[:, None]) for f in frames), strict=True)
    ]
    echoes = sum(f.echo_of is not None for f in frames)
    return [len(frames), *np.nanmean(ranges, 0), *soft.mean(0), *points, echoes]


def recording() -> Events:
    return read_events(shipped("recordings", "night-50m-30kmh-cut.raw"))


def simulated(scene: str, **overrides: object) -> Events:
    """A scene that is kept, or a preset's."""
    path = ROOT / "examples" / "scenes" / f"{scene}.toml"
    source = evlcp.simulate(load_scene(path if path.exists() else scene, overrides), seed=1)
    return Events.concat(list(source.chunks()))


PANEL = {"rows": 16, "columns": 16, "led_pitch_m": 0.02, "cluster_rows": 4, "cluster_columns": 4}
RAW = {"modulation": {"id": "raw8"}, "air": {"pilot_every": 4}}
NRZ = {"modulation": {"id": "nrz"}}
FEEDBACK = {"decoding": {"id": "motion-feedback"}, "ranging": {"id": "centroid"}}
SCENES: dict[str, tuple[Link, Callable[[], Events], str]] = {
    "a recording": (
        LINK,
        recording,
        "21 49.1524 0.0162521 421.776 357.128 99591.1 32.9186 1 30.7292 389.452 0.0657735 0",
    ),
    "by the paper's receiver": (
        load_link(ROOT / "examples" / "links" / "paper.toml"),
        recording,
        "21 49.1663 0.0563105 421.776 357.128 99591.1 31.0241 1 30.7292 389.452 0.0657735 0",
    ),
    "reflections": (
        LINK,
        partial(simulated, "wet-road", duration_s=0.08),
        "46 54.5367 0.0460972 402.848 490.206 38453.8 26.059 0.999911 26.6454 449.811 0.0753653 23",
    ),
    "dark LEDs and a drop": (
        LINK,
        partial(simulated, "street", duration_s=0.06),
        "17 59.5647 0.0817301 418.256 390.44 27892.7 19.3752 0.951505 29.5588 404.332 0.113415 0",
    ),
    "a low sun": (
        LINK,
        partial(simulated, "low-sun", duration_s=0.06),
        "17 41.7475 0.0195711 340.597 390.339 27871.5 30.5583 0.999999 29.8088 365.468 0.0791635 0",
    ),
    "bars on all sides": (
        LINK,
        partial(simulated, "portal", duration_s=0.06),
        "50 53.7495 0.0291702 586.608 374.913 27616 31.3198 0.999996 32.5737 480.761 0.0710069 0",
    ),
    "a panel": (
        resolve({"bar": PANEL}),
        partial(simulated, "night", duration_s=0.07, link={"bar": PANEL}),
        "19 49.7309 0.083961 382.207 389.463 31459.2 31.4565 1 29.7599 385.835 0.141219 0",
    ),
    "few pilots": (
        resolve(RAW),
        partial(simulated, "night", duration_s=0.06, link=RAW),
        "24 49.7518 0.0244647 382.12 390.771 30145.1 31.7202 1 120.01 386.464 0.0619525 0",
    ),
    "other codes": (
        resolve(NRZ),
        partial(simulated, "night", duration_s=0.06, link=NRZ),
        "20 49.7336 0.0245363 382.303 390.338 27721.3 22.5206 0.96764 120.35 386.321 0.095726 0",
    ),
    "motion feedback": (
        resolve(FEEDBACK),
        partial(simulated, "fast-drive", duration_s=0.06),
        "17 79.3032 0.0907183 422.413 420.692 27873.5 30.4383 1 29.8088 421.553 0.0690567 0",
    ),
}
"""Links, events, and what `figures` gives of them."""


@pytest.mark.parametrize("scene", SCENES)
def test_figures_are_those_of_before(scene: str) -> None:
    link, events, wanted = SCENES[scene]
    assert figures(received(link, events())[1]) == pytest.approx([*map(float, wanted.split())], rel=1e-5)
