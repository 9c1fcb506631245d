"""Scenes that are hard on purpose, in short cuts, and sensors of other makers, as in docs/sensors.md."""

import runpy
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.sim import Simulation, Truth, load_scene, truth_of
from evlcp_sdk.study.frames import frames_of
from evlcp_sdk.study.measure import statistics_of
from evlcp_sdk.study.tally import Tally
from evlcp_sdk.values import Events
from tests.conftest import ROOT

SCENES = ROOT / "examples" / "scenes"
DEFAULT: tuple[str, ...] = ()
BEST = ("decoding.id=motion-feedback", "ranging.id=joint-scale", "tracking.id=kalman")


@cache
def render(scene: str, seed: int, settings: tuple[str, ...]) -> tuple[Events, Truth]:
    cut = load_scene(scene if scene.startswith("drive") else SCENES / f"{scene}.toml", settings)
    return Events.concat(Simulation(cut, seed).stream()), truth_of(cut, seed=seed)


def score_scene(scene: str, seeds: Iterable[int], settings: tuple[str, ...], link: tuple[str, ...]) -> Tally:
    """What a link finds in a scene, over seeds."""
    total = Tally()
    for seed in seeds:
        events, truth = render(scene, seed, settings)
        receiver = Receiver(load_link(overrides=link))
        packets = receiver.feed(events) + receiver.close()
        # A last frame whose end is not quite in the recording counts as not sent, and so as a ghost.
        whole = [f for f in frames_of(packets) if f.t_us - truth.t0_us + 3400 <= truth.duration_us]
        found = statistics_of(whole, truth)
        assert found.unmatched == 0
        total += found.total()
    return total


@pytest.mark.parametrize("link", [DEFAULT, BEST], ids=["default", "best"])
@pytest.mark.parametrize("distance_m", [79.0, 58.0, 38.0])
def test_a_fast_drive_that_shakes(distance_m: float, link: tuple[str, ...]) -> None:
    """80 km/h with twice the vibration: the bit error rate far, midway and near."""
    cut = (f"motion.distance_m={distance_m}", "duration_s=0.15")
    found = score_scene("fast-drive", (1, 2), cut, link)
    assert found.frames_found >= 0.95 * found.frames_sent
    assert found.ber <= 0.01
    assert found.ranged == found.frames_found


def test_motion_feedback_helps() -> None:
    """Motion that is left where regions are not followed well costs bits: half of them and more come back."""
    cut = ("motion.distance_m=90.0", "motion.vib_rate_rad_s=0.24", "duration_s=0.3")
    links = (("decoding.id=ml-soft",), ("decoding.id=motion-feedback",))
    soft, feedback = (score_scene("fast-drive", (6, 10), cut, link) for link in links)
    assert soft.bit_errors >= 10
    assert feedback.bit_errors <= 0.5 * soft.bit_errors


TABLE = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "figures" / "sensors.py"))


@pytest.mark.parametrize("name", sorted(TABLE["SENSORS"]))
def test_a_sensor_reads_a_bar_whose_clusters_cover_four_pixels(name: str) -> None:
    tally = TABLE["drive"](name, 1)
    assert tally.frames_found == tally.frames_sent >= 14
    assert tally.bits > 1000
    assert tally.bit_errors == 0
    assert tally.rmse_m < 0.004 * TABLE["distance_m"](TABLE["load_link"](TABLE["LINKS"] / f"{name}.toml"))
