"""Positions on a recording by an independent generator, whose truth says where the bars are in the image."""

import json
import math
from typing import Any

import numpy as np
import pytest

from evlcp_sdk.io import open_source
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.place.navigator import Navigator, PositionPlan
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from tests.conftest import ROOT

RECORDING = ROOT.parent / "shared" / "recordings" / "two-bars-60m-75m.raw"
AXES = LocalAxes(35.0, 137.0, 0.0)
ENU = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""East, north and up of a scene that looks north: x right, y down, z ahead."""


def poses(truth: dict[str, Any], bars: np.ndarray, focal_px: float) -> tuple[np.ndarray, list[Attitude]]:
    """Places, m, float64 (n, 3), and attitudes of a camera on the scene's axis that sees the bars there."""
    camera, places, attitudes = truth["camera"], [], []
    centres = np.transpose(truth["bar_centre_px"], (2, 1, 0))
    for depth, (x, y) in zip(np.transpose(truth["distance_m"]), centres, strict=True):
        seen = np.stack([(x - camera["cx"]) / focal_px, (y - camera["cy"]) / focal_px, np.ones(2)], 1)
        seen *= depth[:, None]
        ahead = bars[:, 2] - np.sqrt((seen**2).sum(1) - bars[:, 0] ** 2 - bars[:, 1] ** 2)
        here = np.array([0.0, 0.0, ahead.mean()])
        one, _, two = np.linalg.svd((bars - here).T @ seen)
        turned = one @ np.diag([1.0, 1.0, np.linalg.det(one @ two)]) @ two
        places.append(ENU @ here)
        attitudes.append(Attitude.of_rotation(ENU @ turned))
    return np.array(places), attitudes


@pytest.mark.skipif(not RECORDING.is_file(), reason="the shared recordings are not beside the repository")
def test_two_bars_of_another_generator_say_where_the_camera_is() -> None:
    truth, link = json.loads(RECORDING.with_suffix(".truth.json").read_text()), load_link()
    stated = truth["bars"]
    bars = np.array([[b["x_m"], b["y_m"], b["z_m"] + truth["scene"]["distance_m"]] for b in stated])
    places, attitudes = poses(truth, bars, link.camera.focal_px)
    t_us = np.array(truth["t_s"]) * 1e6 + truth["scene"]["t0_us"]
    # An IMU that is off by one sigma of each angle.
    pitch, roll, heading = np.array([(a.pitch_deg, a.roll_deg, a.heading_deg) for a in attitudes]).T
    sigma, heading = np.full(len(t_us), 0.1), np.unwrap(heading, period=360)
    log = AttitudeLog(t_us, pitch + 0.1, roll - 0.1, heading + 0.1, sigma, sigma)
    receiver = Receiver(link, attitude=log)
    with open_source(str(RECORDING)) as source:
        packets = [p for events in source.chunks() for p in receiver.feed(events)] + receiver.close()
    sites = []
    for number in {p.transmitter for p in packets}:
        frame = next(p for p in packets if p.transmitter == number).frames[0]
        centres = np.transpose(truth["bar_centre_px"], (2, 1, 0))[0]
        i = int(np.argmin(np.hypot(centres[0] - frame.x_px, centres[1] - frame.y_px)))
        place, long_m = map(float, AXES.to_geodetic(ENU @ bars[i])), stated[i]["length_m"]
        sites.append(BarSite(i + 1, *place, length_m=long_m, transmitter=number))
    navigator = Navigator(link, PositionPlan(tuple(sites)), log)
    placed = navigator.feed(packets)
    rest, _ = navigator.close()
    squares = []
    for fix in (one.fix for one in [*placed, *rest]):
        assert not fix.refusal, fix.refusal
        true_m = [float(np.interp(fix.t_us, t_us, places[:, k])) for k in range(3)]
        error = fix.enu_m - navigator.positioner.axes.to_enu(*map(float, AXES.to_geodetic(np.array(true_m))))
        squares.append(error @ np.linalg.solve(fix.covariance_m2, error))
        assert np.linalg.norm(error) < 0.15
        assert math.hypot(error[0], error[1]) < fix.hpl_m
        assert abs(error[2]) < fix.vpl_m
    assert len(squares) >= 6
    assert np.mean(squares) < 10
