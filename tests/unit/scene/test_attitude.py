"""An IMU's rates and forces against cameras whose turn and way are known in closed form."""

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
from tests.unit.mutants import refusal

Floats = NDArray[np.float64]
T_S = np.arange(0, 4, 0.005)
GRAVITY = np.array([0.0, 0.0, 9.80665])


def moving_log() -> AttitudeLog:
    """Pitched and rolled, turning at a rate that changes, on a circle in the end."""
    axes = [Attitude(7.0, -12.0, heading).rotation() for heading in heading_deg(T_S)]
    # Clockwise as seen from above: downward, right-handed.
    turns = (heading_deg(T_S + 1e-4) - heading_deg(T_S - 1e-4)) / 2e-4
    rates = [at.T @ [0.0, 0.0, -turn] for at, turn in zip(axes, turns, strict=True)]
    forces = [at.T @ (acceleration_enu(t) + GRAVITY) for at, t in zip(axes, T_S, strict=True)]
    still = 0 * T_S
    angles = T_S * 1e6, still + 7.0, still - 12.0, None, still, still
    return AttitudeLog(*angles, rates_deg_s=np.array(rates), forces_m_s2=np.array(forces))


def heading_deg(t: Floats | float) -> Floats:
    return np.asarray(350 + 20 * t + 15 * np.sin(2 * t))


def acceleration_enu(t: float) -> Floats:
    return np.array([np.sin(t), 0.3 * t, -0.2])


def test_turn_and_push_of_a_tilted_camera() -> None:
    log = moving_log()
    start, end = 0.5032, 3.2071
    found = log.motion_between(start * 1e6, end * 1e6)
    assert found.has_gyro
    assert found.t_s[0] == 0
    assert found.t_s[-1] == pytest.approx(end - start)
    turned = np.radians(heading_deg(start + found.t_s) - heading_deg(start))
    np.testing.assert_allclose(found.turn_rad, turned, atol=1e-4)
    for k in range(0, len(found.t_s), 50):
        heading = np.radians(heading_deg(start + found.t_s[k]))
        east, north, up = acceleration_enu(start + found.t_s[k])
        right, forward = np.cos(heading), np.sin(heading)
        own = [east * right - north * forward, east * forward + north * right, up]
        np.testing.assert_allclose(found.acceleration_m_s2[k], own, atol=2e-3)
    assert log.motion_between(-1.0, 1e6) is None
    assert log.motion_between(1e6, 5e6) is None


def test_without_rates_headings_tell_and_a_long_log_is_thinned() -> None:
    t_us = np.arange(100_000) * 1e3
    heading = np.linspace(0, 720, len(t_us))
    still = np.zeros(len(t_us))
    found = AttitudeLog(t_us, still, still, heading, still, still).motion_between(0.0, t_us[-1])
    assert not found.has_gyro
    assert found.turn_rad[-1] == pytest.approx(np.radians(720))
    assert 2048 < len(found.t_s) < 4100
    assert AttitudeLog(t_us, still, still, None, still, still).motion_between(0.0, 1e6) is None


@pytest.mark.parametrize(("with_heading", "with_imu"), [(True, True), (False, True), (True, False)])
def test_a_log_is_read_back(with_heading: bool, with_imu: bool, tmp_path: Path) -> None:
    log = replace(moving_log(), heading_deg=heading_deg(T_S) if with_heading else None)
    log = log if with_imu else replace(log, rates_deg_s=None, forces_m_s2=None)
    (tmp_path / "imu.csv").write_text(log.to_csv())
    again = AttitudeLog.read(tmp_path / "imu.csv")
    for column in fields(log):
        value, found = getattr(log, column.name), getattr(again, column.name)
        assert (value is None) == (found is None)
        # Without a heading its sigma is not written.
        if value is not None and (with_heading or column.name != "heading_sigma_deg"):
            np.testing.assert_allclose(found, value, atol=1e-5)


ANGLES = "t_us,pitch_deg,roll_deg"
RATES = "rate_right_deg_s,rate_down_deg_s,rate_forward_deg_s"
FORCES = "force_right_m_s2,force_down_m_s2,force_forward_m_s2"


@pytest.mark.parametrize(
    ("columns", "values", "message"),
    [
        ("", "90,0", "line 3: pitch_deg = '90': expected -89 to 89"),
        (",rate_right_deg_s", "0,0,0", "line 1: no column rate_down_deg_s"),
        (f",{RATES},force_down_m_s2", "0,0,0,0,0,0", "no column force_right_m_s2"),
        (f",{FORCES}", "0,0,0,0,0", "no column rate_right_deg_s: forces need"),
        (f",{RATES}", "0,0,0,1e17,0", "line 3: rate_down_deg_s = '1e17': expected -100000 to 100000"),
        (f",{RATES},{FORCES}", "0,0,0,0,0,0,9.8,0", "up by -9.8 m/s2 on the mean, expected about 9.8"),
        # Upside down at rest.
        (f",{RATES},{FORCES}", "0,180,0,0,0,0,9.8,0", None),
    ],
)
def test_lines_that_cannot_be_are_reported(
    tmp_path: Path, columns: str, values: str, message: str | None
) -> None:
    path = tmp_path / "imu.csv"
    first = values.replace("90", "0").replace("1e17", "0")
    path.write_text(f"{ANGLES}{columns}\n0,{first}\n1000,{values}\n")
    reported = refusal(lambda: AttitudeLog.read(path))
    assert reported is None if message is None else message in str(reported)


def test_angles_are_not_drawn_across_lines_that_are_lost() -> None:
    t_us = np.concatenate([np.arange(0, 50) * 1e3, np.arange(200, 250) * 1e3])
    angle = t_us * 1e-3
    still = np.zeros(len(t_us))
    log = AttitudeLog(t_us, angle, still, angle, still, still)
    for known_us in (0.0, 48.5e3, 49e3, 200e3, 249e3):
        at = log.interpolate(known_us)
        assert at.pitch_deg == pytest.approx(known_us * 1e-3)
    assert log.interpolate(49.1e3) is None
    assert log.interpolate(199e3) is None
    assert log.motion_between(48.5e3, 49.5e3) is None
    assert log.motion_between(10e3, 210e3) is None
    for start_us, end_us in ((10e3, 49e3), (200e3, 249e3)):
        swing = log.motion_between(start_us, end_us)
        assert swing.turn_rad[-1] == pytest.approx(np.radians((end_us - start_us) * 1e-3))
    # Lines that come late, but not by much, and logs of few lines have no gaps.
    for t_us in ([0.0, 1e3, 2e3, 9e3, 10e3], [0.0, 10e3]):
        none = np.zeros(len(t_us))
        assert AttitudeLog(np.array(t_us), none, none, None, none, none).interpolate(5e3) is not None


TURN_S = np.arange(0, 6, 0.01)
NOISE = np.random.default_rng(1).normal(0, 1.0, len(TURN_S))
CIRCLE = 350 + 45 * TURN_S + 0.5 * NOISE, 0 * TURN_S + 45.0
CURVES = 10 * np.sin(2 * TURN_S) + 0.5 * NOISE, 20 * np.cos(2 * TURN_S)


@pytest.mark.parametrize(
    ("heading_deg", "rate_deg_s", "times"),
    [
        # A compass that is noisy, a gyroscope with a bias: neither is a fault.
        (CIRCLE[0], CIRCLE[1] + 1.0, None),
        (CURVES[0], CURVES[1] + 1.0, None),
        # Nor is a gyroscope that is off at rest, or a heading that says nothing.
        (1.5 * TURN_S, np.full(len(TURN_S), -3.0), None),
        (np.zeros(len(TURN_S)), CIRCLE[1], None),
        (5.0 * NOISE, CIRCLE[1], None),
        (CIRCLE[0], CIRCLE[1] * np.pi / 180, np.pi / 180),
        (CURVES[0], -CURVES[1], -1.0),
        (CURVES[0], CURVES[1] * 1e3, 1e3),
    ],
)
def test_rates_of_another_measure_or_sign_are_reported(tmp_path, heading_deg, rate_deg_s, times) -> None:
    columns = zip(TURN_S * 1e6, heading_deg % 360, rate_deg_s, strict=True)
    lines = [f"{ANGLES},heading_deg,{RATES}", *(f"{t:.0f},0,0,{h:.6f},0,{r:.6f},0" for t, h, r in columns)]
    (tmp_path / "imu.csv").write_text("\n".join(lines))
    result = refusal(lambda: AttitudeLog.read(tmp_path / "imu.csv"))
    reported = re.search(r"rates turn the camera (\S+) times as far as its headings do", result or "")
    assert (reported and float(reported[1])) == (times and pytest.approx(times, rel=0.1))
