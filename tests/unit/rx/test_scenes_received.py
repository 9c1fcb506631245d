"""Figures that the receiver gives of some scenes, to four digits: whoever moves one means to, or is wrong."""

from functools import partial

import numpy as np
import pytest
from rx_streams import LINK, frames_of, receive_cut

import evlcp_sdk as evlcp
from evlcp_sdk.files import find_shipped_file
from evlcp_sdk.io import read_events
from evlcp_sdk.link.resolve import load_link, resolve
from evlcp_sdk.sim import load_scene
from evlcp_sdk.values import Events
from tests.conftest import ROOT


def figures(packets):
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


def recording():
    return read_events(find_shipped_file("recordings", "night-50m-30kmh-cut.raw"))


def simulate_scene(scene, **overrides):
    """A scene that is kept, or a preset's."""
    path = ROOT / "examples" / "scenes" / f"{scene}.toml"
    source = evlcp.simulate(load_scene(path if path.exists() else scene, overrides), seed=1)
    return Events.concat(list(source.chunks()))


PANEL = {"rows": 16, "columns": 16, "led_pitch_m": 0.02, "cluster_rows": 4, "cluster_columns": 4}
RAW = {"modulation": {"id": "raw8"}, "air": {"pilot_every": 4}}
NRZ = {"modulation": {"id": "nrz"}}
FEEDBACK = {"decoding": {"id": "motion-feedback"}, "ranging": {"id": "centroid"}}
SCENES = {
    "a recording": (
        LINK,
        recording,
        "21 49.1527 0.0163515 421.776 357.135 99591.1 32.5546 1 30.7292 389.455 0.0662339 0",
    ),
    "by the paper's receiver": (
        load_link(ROOT / "examples" / "links" / "paper.toml"),
        recording,
        "21 49.1654 0.0521559 421.776 357.135 99591.1 30.7249 1 30.7292 389.455 0.0662339 0",
    ),
    "reflections": (
        LINK,
        partial(simulate_scene, "wet-road", duration_s=0.08),
        "46 54.5328 0.046115 402.845 490.195 38453.8 26.1046 0.999912 26.6454 449.809 0.0754531 23",
    ),
    "dark LEDs and a drop": (
        LINK,
        partial(simulate_scene, "street", duration_s=0.06),
        "17 59.5726 0.0743705 418.259 390.439 27892.7 19.3843 0.954275 29.5588 404.332 0.113848 0",
    ),
    "a low sun": (
        LINK,
        partial(simulate_scene, "low-sun", duration_s=0.06),
        "17 41.7474 0.0201847 340.595 390.351 27871.5 30.6114 1 29.8088 365.473 0.0806984 0",
    ),
    "bars on all sides": (
        LINK,
        partial(simulate_scene, "portal", duration_s=0.06),
        "50 53.7483 0.0289327 586.604 374.916 27616 31.3872 0.999996 32.5737 480.76 0.0701108 0",
    ),
    "a panel": (
        resolve({"bar": PANEL}),
        partial(simulate_scene, "night", duration_s=0.07, link={"bar": PANEL}),
        "19 49.7218 0.087394 382.211 389.453 31459.2 31.558 1 29.7599 385.832 0.141631 0",
    ),
    "few pilots": (
        resolve(RAW),
        partial(simulate_scene, "night", duration_s=0.06, link=RAW),
        "24 49.7518 0.0241178 382.115 390.766 30145.1 31.7202 1 120.01 386.464 0.0619525 0",
    ),
    "other codes": (
        resolve(NRZ),
        partial(simulate_scene, "night", duration_s=0.06, link=NRZ),
        "20 49.7339 0.0240748 382.303 390.347 27721.3 22.3601 0.977645 120.35 386.325 0.0958754 0",
    ),
    "motion feedback": (
        resolve(FEEDBACK),
        partial(simulate_scene, "fast-drive", duration_s=0.06),
        "17 79.3063 0.0901196 422.41 420.693 27873.5 30.4477 1 29.8088 421.551 0.0681698 0",
    ),
}
"""Links, events, and what `figures` gives of them."""


@pytest.mark.parametrize("scene", SCENES)
def test_figures_are_those_of_before(scene):
    link, events, wanted = SCENES[scene]
    assert figures(receive_cut(link, events())[1]) == pytest.approx([*map(float, wanted.split())], rel=1e-4)
