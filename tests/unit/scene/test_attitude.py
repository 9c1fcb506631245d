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
    with pytest.raises(ConfigError, match=r"line 3: rate_down_deg_s = .*: expected -100000 to 100000"):
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
        ("t_us,pitch_deg,roll_deg\n0,0,0\n1000,95,0\n", "line 3: pitch_deg = '95': expected -90 to 90"),
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


def test_angles_are_not_drawn_across_lines_that_are_lost() -> None:
    t_us = np.concatenate([np.arange(0, 50) * 1e3, np.arange(200, 250) * 1e3])
    angle = t_us * 1e-3
    still = np.zeros(len(t_us))
    log = AttitudeLog(t_us, angle, still, angle, still, still)
    for known_us in (0.0, 48.5e3, 49e3, 200e3, 249e3):
        at = log.at(known_us)
        assert at is not None
        assert at.pitch_deg == pytest.approx(known_us * 1e-3)
    assert log.at(49.1e3) is None
    assert log.at(199e3) is None
    assert log.between(48.5e3, 49.5e3) is None
    assert log.between(10e3, 210e3) is None
    for start_us, end_us in ((10e3, 49e3), (200e3, 249e3)):
        swing = log.between(start_us, end_us)
        assert swing is not None
        assert swing.turn_rad[-1] == pytest.approx(np.radians((end_us - start_us) * 1e-3))
    # Lines that come late, but not by much, and logs of few lines have no gaps.
    late = AttitudeLog(np.array([0.0, 1e3, 2e3, 9e3, 10e3]), *(np.zeros(5),) * 2, None, *(np.zeros(5),) * 2)
    assert late.at(5e3) is not None
    two = AttitudeLog(np.array([0.0, 1e9]), *(np.zeros(2),) * 2, None, *(np.zeros(2),) * 2)
    assert two.at(5e8) is not None


def rates_log(folder: Path, rate: Floats, heading: Floats, t_s: Floats) -> AttitudeLog:
    head = "t_us,pitch_deg,roll_deg,heading_deg,rate_right_deg_s,rate_down_deg_s,rate_forward_deg_s"
    rows = "\n".join(
        f"{t * 1e6:.0f},0,0,{h % 360:.6f},0,{r:.6f},0" for t, h, r in zip(t_s, heading, rate, strict=True)
    )
    (folder / "imu.csv").write_text(f"{head}\n{rows}\n")
    return AttitudeLog.read(folder / "imu.csv")


@pytest.mark.parametrize("turning", ["circle", "curves"])
@pytest.mark.parametrize("times", [1.0, np.pi / 180, -1.0, 1e3])
def test_rates_of_another_measure_or_sign_are_told(tmp_path: Path, turning: str, times: float) -> None:
    t_s = np.arange(0, 6, 0.01)
    if turning == "circle":
        heading, rate = 350 + 45 * t_s, np.full(len(t_s), 45.0)
    else:
        heading, rate = 10 * np.sin(2 * t_s), 20 * np.cos(2 * t_s)
    # A compass that is noisy, a gyroscope with a bias: neither is a fault.
    heading = heading + np.random.default_rng(1).normal(0, 0.5, len(t_s))
    if times == 1.0:
        rates_log(tmp_path, rate + 1.0, heading, t_s)
        return
    with pytest.raises(ConfigError) as caught:
        rates_log(tmp_path, rate * times, heading, t_s)
    told = re.search(r"rates turn the camera (\S+) times as far as its headings do", str(caught.value))
    assert told is not None
    assert float(told[1]) == pytest.approx(times, rel=0.1)


@pytest.mark.parametrize("rate", [0.0, -3.0])
def test_a_gyroscope_that_is_off_at_rest_is_no_fault(tmp_path: Path, rate: float) -> None:
    t_s = np.arange(0, 6, 0.01)
    rates_log(tmp_path, np.full(len(t_s), rate), 1.5 * t_s, t_s)


def test_headings_that_say_nothing_do_not_contradict_rates(tmp_path: Path) -> None:
    t_s = np.arange(0, 6, 0.01)
    noise = np.random.default_rng(2).normal(0, 5.0, len(t_s))
    for heading in (np.zeros(len(t_s)), noise):
        rates_log(tmp_path, np.full(len(t_s), 45.0), heading, t_s)
