"""An IMU's rates and forces against cameras whose turn and way are known in closed form."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError, EvlcpError
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog

Floats = NDArray[np.float64]
T_S = np.arange(0, 4, 0.005)


def moving_log() -> AttitudeLog:
    """Pitched and rolled, turning at a rate that changes, on a circle in the end."""
    pitch, roll = np.full(len(T_S), 7.0), np.full(len(T_S), -12.0)
    heading = heading_deg(T_S)
    rates, forces = np.empty((len(T_S), 3)), np.empty((len(T_S), 3))
    for i, t in enumerate(T_S):
        axes = Attitude(7.0, -12.0, heading[i]).rotation()
        # Clockwise as seen from above: downward, right-handed.
        turn = (heading_deg(t + 1e-4) - heading_deg(t - 1e-4)) / 2e-4
        rates[i] = axes.T @ [0.0, 0.0, -turn]
        forces[i] = axes.T @ (pushed_enu(t) + np.array([0.0, 0.0, 9.80665]))
    still = np.zeros(len(T_S))
    return AttitudeLog(T_S * 1e6, pitch, roll, None, still, still, rates_deg_s=rates, forces_m_s2=forces)


def heading_deg(t: Floats | float) -> Floats:
    return np.asarray(350 + 20 * t + 15 * np.sin(2 * t))


def pushed_enu(t: float) -> Floats:
    return np.array([np.sin(t), 0.3 * t, -0.2])


def test_turn_and_push_of_a_tilted_camera() -> None:
    log = moving_log()
    start, end = 0.5032, 3.2071
    found = log.between(start * 1e6, end * 1e6)
    assert found is not None
    assert found.gyro
    assert found.push_m_s2 is not None
    assert found.t_s[0] == 0
    assert found.t_s[-1] == pytest.approx(end - start)
    turned = np.radians(heading_deg(start + found.t_s) - heading_deg(start))
    np.testing.assert_allclose(found.turn_rad, turned, atol=1e-4)
    for k in range(0, len(found.t_s), 50):
        heading = np.radians(heading_deg(start + found.t_s[k]))
        east, north, up = pushed_enu(start + found.t_s[k])
        right, forward = np.cos(heading), np.sin(heading)
        own = [east * right - north * forward, east * forward + north * right, up]
        np.testing.assert_allclose(found.push_m_s2[k], own, atol=2e-3)
    assert log.between(-1.0, 1e6) is None
    assert log.between(1e6, 5e6) is None


def test_parts_of_a_turn_add_up() -> None:
    log = moving_log()
    ends = (0.3e6, 0.3001e6, 0.9e6, 1.7772e6)
    parts = [log.between(a, b) for a, b in itertools.pairwise(ends)]
    whole = log.between(ends[0], ends[-1])
    assert whole is not None
    assert sum(p.turn_rad[-1] for p in parts if p is not None) == pytest.approx(whole.turn_rad[-1])


def test_without_rates_headings_tell_and_a_long_log_is_thinned() -> None:
    t_us = np.arange(100_000) * 1e3
    heading = np.linspace(0, 720, len(t_us))
    still = np.zeros(len(t_us))
    found = AttitudeLog(t_us, still, still, heading, still, still).between(0.0, t_us[-1])
    assert found is not None
    assert not found.gyro
    assert found.turn_rad[-1] == pytest.approx(np.radians(720))
    assert 2048 < len(found.t_s) < 4100
    assert AttitudeLog(t_us, still, still, None, still, still).between(0.0, 1e6) is None


def test_rates_and_forces_are_read_back(tmp_path: Path) -> None:
    log = moving_log()
    (tmp_path / "imu.csv").write_text(log.to_csv())
    again = AttitudeLog.read(tmp_path / "imu.csv")
    assert log.rates_deg_s is not None
    assert log.forces_m_s2 is not None
    assert again.rates_deg_s is not None
    assert again.forces_m_s2 is not None
    np.testing.assert_allclose(again.rates_deg_s, log.rates_deg_s, atol=1e-5)
    np.testing.assert_allclose(again.forces_m_s2, log.forces_m_s2, atol=1e-5)


def test_a_rate_that_no_sensor_has_is_told(tmp_path: Path) -> None:
    names = "t_us,pitch_deg,roll_deg,rate_right_deg_s,rate_down_deg_s,rate_forward_deg_s"
    (tmp_path / "imu.csv").write_text(f"{names}\n0,0,0,0,0,0\n1000,0,0,0,1e17,0\n")
    with pytest.raises(ConfigError, match=r"line 3: rate_down_deg_s = .*: expected at most 100000"):
        AttitudeLog.read(tmp_path / "imu.csv")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ("rate_right_deg_s", "line 1: no column rate_down_deg_s"),
        ("rate_right_deg_s,rate_down_deg_s,rate_forward_deg_s,force_down_m_s2", "no column force_right_m_s2"),
        ("force_right_m_s2,force_down_m_s2,force_forward_m_s2", "no column rate_right_deg_s: forces need"),
    ],
)
def test_parts_of_an_imu_are_told(tmp_path: Path, columns: str, message: str) -> None:
    values = ",0" * (columns.count(",") + 1)
    rows = "\n".join(f"{t},0,0{values}" for t in (0, 1000))
    (tmp_path / "imu.csv").write_text(f"t_us,pitch_deg,roll_deg,{columns}\n{rows}\n")
    with pytest.raises(ConfigError, match=message):
        AttitudeLog.read(tmp_path / "imu.csv")


IMU = "t_us,pitch_deg,roll_deg,rate_right_deg_s,rate_down_deg_s,rate_forward_deg_s,"
IMU += "force_right_m_s2,force_down_m_s2,force_forward_m_s2"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t_us,pitch_deg,roll_deg\n0,0,0\n1000,0,0,7\n", "line 3: 4 fields, expected 3, as line 1 has"),
        ("t_us,pitch_deg,roll_deg\n0,0\n1000,0,0\n", "line 2: 2 fields, expected 3, as line 1 has"),
        ("t_us,pitch_deg,roll_deg\n0,0,0\n1000,95,0\n", "line 3: pitch_deg = 95: expected at most 90"),
        (
            f"{IMU}\n0,0,0,0,0,0,0,9.8,0\n9,0,0,0,0,0,0,9.8,0\n",
            "up by -9.8 m/s2 on the mean, expected about 9.8",
        ),
        (
            f"{IMU}\n0,0,0,0,0,0,0,-1,0\n9,0,0,0,0,0,0,-1,0\n",
            "up by 1.0 m/s2 on the mean, expected about 9.8",
        ),
    ],
)
def test_lines_that_cannot_be_are_told(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "imu.csv").write_text(text)
    with pytest.raises(EvlcpError, match=re.escape(message)):
        AttitudeLog.read(tmp_path / "imu.csv")


def test_an_upside_down_camera_at_rest_is_no_fault(tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text(f"{IMU}\n0,0,180,0,0,0,0,9.8,0\n9,0,180,0,0,0,0,9.8,0\n")
    assert AttitudeLog.read(tmp_path / "imu.csv").forces_m_s2 is not None
