"""What time makes of position and velocity, against fine steps, numerical slopes and simulated drives."""

import dataclasses

import numpy as np
import pytest

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.trajectory import IMU, filter_fixes, imu_sigmas, reckon, smooth_trajectory
from evlcp_sdk.scene.attitude import AttitudeLog, Swing
from evlcp_sdk.values import Fix
from tests.unit.place.place_scenes import Floats, by_chance, fix, square

SPEC = ErrorModel(acceleration_m2_s3=0.7, rate_white_deg_rts=2.0, push_white_m2_s3=0.3)
VELOCITY = np.array([8.0, 5.0, -1.0])


def swing(*, gyro: bool = False, push: bool = False) -> Swing:
    t = np.linspace(0, 3, 61)
    turn = 0.6 * t + 0.3 * np.sin(2 * t)
    pushed = np.stack([2 * np.sin(t), np.cos(3 * t), 0.5 * t], 1) if push else None
    return Swing(t, turn, gyro, pushed)


def stepped(
    way: Swing, velocity: Floats, heading: float, imu: Floats, turned: Floats | float = 0.0
) -> Floats:
    """Place and velocity in the end, by many short steps; `turned` is added to the heading at each."""
    steps = 6000
    t = (np.arange(steps) + 0.5) * way.t_s[-1] / steps
    dt = way.t_s[-1] / steps
    bias = imu * imu_sigmas(way, SPEC)
    angle = np.interp(t, way.t_s, way.turn_rad) - (bias[0] * t if way.gyro else 0.0) + turned
    if way.push_m_s2 is None:
        east = velocity[0] * np.cos(angle) + velocity[1] * np.sin(angle)
        north = -velocity[0] * np.sin(angle) + velocity[1] * np.cos(angle)
        place = np.array([east.sum(), north.sum(), velocity[2] * steps]) * dt
        last = way.turn_rad[-1] - (bias[0] * way.t_s[-1] if way.gyro else 0.0)
        last += turned[-1] if isinstance(turned, np.ndarray) else turned
        cos, sin = np.cos(last), np.sin(last)
        after = [velocity[0] * cos + velocity[1] * sin, velocity[1] * cos - velocity[0] * sin, velocity[2]]
        return np.append(place, after)
    push = np.stack([np.interp(t, way.t_s, c) for c in way.push_m_s2.T], 1) - bias[-3:]
    facing = heading + angle
    right = np.stack([np.cos(facing), -np.sin(facing)], 1)
    ahead = np.stack([np.sin(facing), np.cos(facing)], 1)
    rise = push[:, :1] * right + push[:, 1:2] * ahead
    rise = np.concatenate([rise, push[:, 2:]], 1)
    speed = velocity + (np.cumsum(rise, 0) - rise / 2) * dt
    return np.append(speed.sum(0) * dt, velocity + rise.sum(0) * dt)


@pytest.mark.parametrize("push", [False, True])
def test_the_way_is_that_of_short_steps(push: bool) -> None:
    way, imu = swing(gyro=True, push=push), np.array([3.0, 1.0, -2.0, 0.5])[: 4 if push else 1]
    found = reckon(way, VELOCITY, 0.4, 0.0, imu, SPEC)
    exact = stepped(way, VELOCITY, 0.4, imu)
    start = np.append(np.zeros(3), VELOCITY)
    np.testing.assert_allclose(found.move @ start + found.added, exact, atol=2e-3)
    for i in range(3):
        step = np.eye(3)[i] * 0.1
        slope = (stepped(way, VELOCITY + step, 0.4, imu) - stepped(way, VELOCITY - step, 0.4, imu)) / 0.2
        np.testing.assert_allclose(found.move[:, 3 + i], slope, atol=1e-3)
    for i in range(len(imu)):
        step = np.eye(len(imu))[i] * 0.1
        slope = (stepped(way, VELOCITY, 0.4, imu + step) - stepped(way, VELOCITY, 0.4, imu - step)) / 0.2
        np.testing.assert_allclose(found.by_imu[:, i], slope, atol=1e-3)


def test_headings_error_pushes_aside() -> None:
    way = swing(gyro=True, push=True)
    quiet = dataclasses.replace(SPEC, rate_white_deg_rts=0.0)
    without = reckon(way, VELOCITY, 0.4, 0.0, np.zeros(4), quiet).noise
    found = reckon(way, VELOCITY, 0.4, 0.01, np.zeros(4), quiet).noise - without
    slope = stepped(way, VELOCITY, 0.401, np.zeros(4)) - stepped(way, VELOCITY, 0.399, np.zeros(4))
    np.testing.assert_allclose(found, np.outer(slope, slope) * 25, atol=1e-4)


@pytest.mark.parametrize("push", [False, True])
def test_noise_is_that_of_kicks(push: bool) -> None:
    """White acceleration, and a gyroscope's random walk, kick by kick through what follows each."""
    way = swing(gyro=True, push=push)
    found = reckon(way, VELOCITY, 0.4, 0.0, np.zeros(4 if push else 1), SPEC).noise
    t, kicks = way.t_s, 120
    noise, middles = np.zeros((6, 6)), (np.arange(kicks) + 0.5) * 3 / kicks
    grid = (np.arange(6000) + 0.5) * 3 / 6000
    white = SPEC.push_white_m2_s3 if push else SPEC.acceleration_m2_s3
    for s in middles:
        rest = 3 - s
        angle = np.interp(s + np.linspace(0, rest, 400), t, way.turn_rad) - np.interp(s, t, way.turn_rad)
        if push:
            by = np.concatenate([rest * np.eye(3), np.eye(3)])
        else:
            cos, sin, even = np.cos(angle), np.sin(angle), np.full(400, rest / 400)
            even[[0, -1]] /= 2
            even *= 400 / 399
            along, aside = even @ cos, even @ sin
            by = np.zeros((6, 3))
            by[:2, :2] = [[along, aside], [-aside, along]]
            by[3:5, :2] = [[cos[-1], sin[-1]], [-sin[-1], cos[-1]]]
            by[2, 2], by[5, 2] = rest, 1
        noise += white * 3 / kicks * by @ by.T
        # The heading is wrong from the kick on.
        late = np.where(grid > s, 0.005, 0.0)
        slope = stepped(way, VELOCITY, 0.4, np.zeros(4 if push else 1), late)
        slope = (slope - stepped(way, VELOCITY, 0.4, np.zeros(4 if push else 1), -late)) / 0.01
        noise += np.radians(SPEC.rate_white_deg_rts) ** 2 * 3 / kicks * np.outer(slope, slope)
    np.testing.assert_allclose(found, noise, atol=5e-3)


def drive(
    rng: np.random.Generator, spec: ErrorModel, *, push: bool, rate_deg_s: float
) -> tuple[list[Fix], AttitudeLog, Floats, Floats]:
    """A car that turns by turns, fixes with a gap of 3 s, an IMU of 50 Hz with biases; truth and biases."""
    steps, dt = 400, 0.02
    t = np.arange(steps + 1) * dt
    rate = np.radians(rate_deg_s) * np.sign(np.sin(t * 1.3))
    heading = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * dt)])
    turned = np.stack([np.sin(heading), np.cos(heading)], 1)
    velocity = np.zeros((steps + 1, 3))
    velocity[:, :2] = 10 * turned
    if not push:
        kicks = rng.normal(size=(steps + 1, 3)) * np.sqrt(spec.acceleration_m2_s3 * dt)
        right = np.stack([turned[:, 1], -turned[:, 0]], 1)
        own = np.cumsum(kicks, 0)
        velocity[:, :2] += own[:, :1] * right + own[:, 1:2] * turned
        velocity[:, 2] = own[:, 2]
    place = np.concatenate([np.zeros((1, 3)), np.cumsum((velocity[1:] + velocity[:-1]) / 2 * dt, 0)])
    biases = rng.normal(size=4 if push else 1)
    measured = np.degrees(rate) + biases[0] * spec.rate_sigma_deg_s
    measured += rng.normal(size=steps + 1) * spec.rate_white_deg_rts / np.sqrt(dt)
    forces = None
    if push:
        # A turn at 10 m/s is a push to its inside.
        felt = np.stack([10 * rate, np.zeros(steps + 1), np.zeros(steps + 1)], 1)
        felt += biases[1:] * spec.push_sigma_m_s2
        felt += rng.normal(size=felt.shape) * np.sqrt(spec.push_white_m2_s3 / dt)
        forces = np.stack([felt[:, 0], -9.80665 - felt[:, 2], felt[:, 1]], 1)
    still = np.zeros(steps + 1)
    rates = np.stack([still, measured, still], 1)
    log = AttitudeLog(t * 1e6, still, still, None, still, still, 0.0, 0.0, rates, forces)
    noise = np.eye(3) * 0.02**2
    fixes = []
    at = [i for i in range(0, steps + 1, 4) if not 150 < i < 300]
    for i in at:
        facing = {"heading_deg": np.degrees(heading[i]), "heading_sigma_deg": 0.01}
        fixes.append(fix(t[i] * 1e6, place[i] + rng.normal(0, 0.02, 3), noise, **facing))
    return fixes, log, place[at], biases


@pytest.mark.parametrize("push", [False, True])
def test_a_turning_car_is_followed_through_a_gap(push: bool) -> None:
    """At 45 degrees/s, forward and smoothed: errors as large as their covariances say, biases found."""
    rng = np.random.default_rng(5)
    spec = ErrorModel(acceleration_m2_s3=0.01, rate_sigma_deg_s=0.5, rate_white_deg_rts=0.1)
    squares: dict[tuple[str, int], list[float]] = {}
    estimates, sigmas = [], []
    for _ in range(9):
        fixes, log, truth, biases = drive(rng, spec, push=push, rate_deg_s=45.0)
        points = filter_fixes(fixes, spec, log.between)
        assert not any(p.misses for p in points)
        smooth = smooth_trajectory(points, spec)
        # 37 is the last fix before the gap, 38 the first one behind it.
        for name, found in (("forward", points), ("smoothed", smooth)):
            for at in (20, 37, 38, 55):
                off = square(found[at].mean[:3] - truth[at], found[at].covariance_m2)
                squares.setdefault((name, at), []).append(off)
        told = points[-1].standing(IMU)
        assert told is not None
        estimates.append(square(told[0] - biases, told[1]))
        sigmas.append(np.sqrt(np.diag(told[1])))
    assert all(by_chance(values, 3, 0.9999) for values in squares.values())
    assert by_chance(estimates, 4 if push else 1, 0.9999)
    assert np.mean(sigmas, 0)[0] < 0.5
