"""Distances of bars in the corners of a lens that distorts."""

from dataclasses import replace
from pathlib import Path

import pytest

import evlcp_sdk as evlcp
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.sim import load_scene, read_truth, truth_path
from evlcp_sdk.study.frames import read_frames
from evlcp_sdk.study.score import score_frames
from tests.conftest import ROOT

CORNER = ROOT.parent / "shared" / "recordings" / "road2" / "k1-corner-45m.raw"


def bar_of(recording: Path, out: Path, link: evlcp.Link) -> dict[str, float]:
    """The score of a recording's bar."""
    receive_to_folder(recording, out, link)
    (bar,) = score_frames(read_frames(out), read_truth(truth_path(recording)))["road"]["bars"]
    return bar  # type: ignore[no-any-return]


@pytest.mark.parametrize(("x_m", "y_m"), [(-3.6, -1.6), (3.6, 1.6)])
def test_a_stated_distortion_reaches_distances_in_opposite_corners(
    tmp_path: Path, x_m: float, y_m: float
) -> None:
    lens = evlcp.load_link(overrides=["camera.k1=-0.25"])
    scene = load_scene(
        "night", {"duration_s": 0.15, "motion.distance_m": 45.0, "camera.k1": -0.25}, link=lens
    )
    scene = replace(scene, bars=(replace(scene.bars[0], x_m=x_m, y_m=y_m),))
    recording = tmp_path / "corner.raw"
    evlcp.simulate(scene, 3).save(recording)
    stated = bar_of(recording, tmp_path / "stated", lens)
    without = bar_of(recording, tmp_path / "without", evlcp.load_link())
    assert stated["ber"] < 0.005
    assert stated["rmse_m"] < 0.035
    assert stated["nees"] < 2
    assert without["bias_m"] > 2 * abs(stated["bias_m"])


@pytest.mark.skipif(not CORNER.exists(), reason="needs ../shared/recordings, which users do not have")
def test_an_independent_generator_s_corner(tmp_path: Path) -> None:
    bar = bar_of(CORNER, tmp_path / "out", evlcp.load_link(overrides=["camera.k1=-0.25"]))
    assert bar["frames_found"] == bar["frames_sent"]
    assert bar["bit_errors"] == 0
    assert bar["rmse_m"] < 0.025
    assert bar["nees"] < 2.5
