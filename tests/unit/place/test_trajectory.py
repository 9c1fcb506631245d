"""The track against dense solutions and fine steps of its model; on drives its sigmas and errors are true."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.navigator import EstimatedBias, estimate_biases, focal_share
from evlcp_sdk.place.observations import BarView, Rejection, project_bars
from evlcp_sdk.place.pose import solve_pose
from evlcp_sdk.place.trajectory import (
    IMU,
    TrajectoryPoint,
    dead_reckon,
    filter_fixes,
    imu_sigmas,
    smooth_trajectory,
)
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog, ImuMotion
from evlcp_sdk.scene.camera import CameraModel, CameraSigma
from evlcp_sdk.scene.sites import BarSite
from evlcp_sdk.values import Fix
from tests.unit.place.place_scenes import Floats, bar, by_chance, fix, square

SPEC = ErrorModel(acceleration_m2_s3=2.0)
SIGMA_M = np.array([0.3, 0.1, 0.05])
NOISE_M2 = np.diag(SIGMA_M**2)


def test_an_outlier_is_left_out_and_a_new_place_starts_a_trajectory() -> None:
    fixes = [fix(i * 1e5, np.array([float(i), 0, 0]), NOISE_M2) for i in range(10)]
    fixes[5] = fix(5e5, np.array([50.0, 0, 0]), NOISE_M2)
    # A refused one has no point.
    points = filter_fixes([*fixes, Fix.from_refusal(1e6, (0,), "misfit", "far off")], SPEC)
    assert [p.rejected for p in points] == [0, 0, 0, 0, 0, 1, 0, 0, 0, 0]
    assert abs(points[5].mean[0] - 5) < 0.5
    jumped = fixes[:5] + [fix((5 + i) * 1e5, np.array([1000.0 + i, 0, 0]), NOISE_M2) for i in range(15)]
    points = filter_fixes(jumped, SPEC)
    # As many as it had taken are left out.
    assert [i for i, p in enumerate(points) if p.starts] == [0, 10]
    smooth = smooth_trajectory(points, SPEC)
    assert max(p.mean[0] for p in smooth[:5]) < 10


def random_fixes(rng: np.random.Generator, count: int) -> list[Fix]:
    """Fixes anywhere at uneven times, of the camera and two of three bars in turn, with all their errors."""
    found = []
    for t_s in np.cumsum(rng.uniform(0.01, 0.2, count)):
        seen = ["camera", *(f"bar {i}" for i in range(3) if abs(t_s - 0.5 * i) < 0.6)]
        share = {name: 1 + 0.5 * np.sin(t_s + len(name)) for name in seen}
        moves = {name: s * np.array([[0.4, 0.1], [0.0, 0.3], [0.2, -0.1]]) for name, s in share.items()}
        place = rng.normal(0, 3, 3)
        found.append(fix(1e6 * t_s, place, NOISE_M2, slow_m2=0.04 * np.eye(3), standing=moves))
    return found


def dense(fixes: list[Fix], names: list[str]) -> tuple[Floats, Floats, Floats]:
    """States (n, 9), covariances of places (n, 3, 3) and standing errors, by one least-squares problem."""
    n = len(fixes)
    size = 9 * n + 2 * len(names)
    rows, right = [], []

    def add(row: Floats, value: Floats, covariance: Floats) -> None:
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        rows.append(white @ row)
        right.append(white @ value)

    def block(height: int, *parts: tuple[int, Floats]) -> Floats:
        row = np.zeros((height, size))
        for at, part in parts:
            row[:, at : at + part.shape[1]] = part
        return row

    add(block(3, (3, np.eye(3))), np.zeros(3), 30.0**2 * np.eye(3))
    add(block(3, (6, np.eye(3))), np.zeros(3), np.eye(3))
    whole = np.eye(2 * len(names))
    add(block(len(whole), (9 * n, whole)), np.zeros(len(whole)), whole)
    for i, one in enumerate(fixes):
        slow = np.sqrt(one.slow_m2[0, 0]) * np.eye(3)
        causes = [(9 * n + 2 * names.index(name), moves) for name, moves in one.standing.items()]
        add(block(3, (9 * i, np.eye(3)), (9 * i + 6, slow), *causes), one.enu_m, one.noise_m2)
        if i:
            dt = (one.t_us - fixes[i - 1].t_us) * 1e-6
            step = np.eye(6) + dt * np.eye(6, k=3)
            power = SPEC.acceleration_m2_s3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            add(block(6, (9 * i, np.eye(6)), (9 * i - 9, -step)), np.zeros(6), np.kron(power, np.eye(3)))
            fade = np.exp(-dt / SPEC.slow_s)
            row = block(3, (9 * i + 6, np.eye(3)), (9 * i - 3, -fade * np.eye(3)))
            add(row, np.zeros(3), (1 - fade**2) * np.eye(3))
    a, b = np.concatenate(rows), np.concatenate(right)
    covariance = np.linalg.inv(a.T @ a)
    mean = covariance @ (a.T @ b)
    places = np.array([covariance[9 * i : 9 * i + 3, 9 * i : 9 * i + 3] for i in range(n)])
    return mean[: 9 * n].reshape(n, 9), places, mean[9 * n :]


def test_standing_and_slow_errors_are_those_of_the_dense_problem() -> None:
    fixes = random_fixes(np.random.default_rng(21), 14)
    spec = dataclasses.replace(SPEC, gate_sigmas=1e3)
    points = filter_fixes(fixes, spec)
    smooth = smooth_trajectory(points, spec)
    names = [cause.name for cause in points[-1].causes]
    mean, places, standing = dense(fixes, names)
    np.testing.assert_allclose([p.mean[:9] for p in smooth], mean, atol=1e-5)
    np.testing.assert_allclose([p.covariance_m2 for p in smooth], places, atol=1e-6)
    np.testing.assert_allclose(points[-1].mean, np.append(mean[-1], standing), atol=1e-5)
    for i, name in enumerate(names):
        found = points[-1].standing(name)
        np.testing.assert_allclose(found[0], standing[2 * i : 2 * i + 2], atol=1e-5)
    assert points[-1].standing("bar 9") is None


@pytest.mark.parametrize("rate_deg_s", [45.0, -45.0, 5.0])
def test_a_car_that_turns_stays_on_its_track(rate_deg_s: float) -> None:
    """At 10 m/s and 45 degrees/s it is pushed aside by 8 m/s2; the camera's heading says so."""
    rng = np.random.default_rng(23)
    rate, squares, noise = np.radians(rate_deg_s), [], np.diag([0.02, 0.02, 0.02]) ** 2
    for trial in range(20):
        fixes, truth = [], []
        for i in range(60):
            t = i * 0.033 + (0.3 if i > 30 else 0.0)
            heading = rate * t
            radius = 10.0 / rate
            place = np.array([radius * (1 - np.cos(heading)), radius * np.sin(heading), 0.0])
            truth.append(place)
            facing = np.degrees(heading) + rng.normal(0, 0.02)
            fixes.append(fix(t * 1e6, place + rng.normal(0, 0.02, 3), noise, heading_deg=facing))
        points = filter_fixes(fixes, ErrorModel(acceleration_m2_s3=0.01))
        assert not any(p.rejected for p in points)
        at = 20 + trial % 30
        for found in (points, smooth_trajectory(points, ErrorModel(acceleration_m2_s3=0.01))):
            squares.append(square(found[at].mean[:3] - truth[at], found[at].covariance_m2))
    assert np.mean(squares) < stats.chi2.isf(1e-4, 60) / 20


def test_a_bar_long_out_of_sight_is_forgotten() -> None:
    """The states of a drive past many bars stay few; what is left is the dense problem without the rest."""
    bars = [{f"bar {i // 5}": 0.1 * np.eye(3)} for i in range(200)]
    fixes = [fix(i * 1e6, np.array([i, 0.0, 0.0]), NOISE_M2, standing=one) for i, one in enumerate(bars)]
    points = filter_fixes(fixes, SPEC)
    assert max(len(p.mean) for p in points) <= 9 + 3 * 4
    smooth = smooth_trajectory(points, SPEC)
    assert [len(p.mean) for p in smooth] == [len(p.mean) for p in points]
    assert all(np.linalg.eigvalsh(p.covariance)[0] > 0 for p in smooth)
    assert max(abs(p.mean[0] - i) for i, p in enumerate(smooth)) < 1e-3


def biased_drive(rng: np.random.Generator, fixes: int) -> tuple[list[Fix], Floats]:
    """Fixes, and places, of a drive; standing errors of a metre move each as of where it is, with noise."""
    t_s, along, noise_m = 0.04 * np.arange(fixes), np.array([1.0, 0.0, 0.0]), 0.1
    place = rng.normal(0, 1, 3) + np.outer(t_s, [2.0, 8.0, 0.0])
    base, slope = rng.normal(0, 0.6, (3, 6)), rng.normal(0, 0.12, (3, 6))
    errors = rng.normal(size=6)
    found = []
    for t, stands in zip(t_s, place, strict=True):
        seen = stands.copy()
        for _ in range(20):
            seen = stands + (base + slope * (along @ seen)) @ errors
        given = seen + rng.normal(0, noise_m, 3)
        moves = base + slope * (along @ given)
        noise_m2, stays = noise_m**2 * np.eye(3), {"bar 0": moves}
        whole = {"covariance_m2": noise_m2 + moves @ moves.T, "standing": stays, "weakest_axis": along}
        found.append(fix(t * 1e6, given, noise_m2, standing_slope={"bar 0": slope}, **whole))
    return found, place


def test_noise_does_not_show_errors_that_stay() -> None:
    """What they do to a fix follows its noise: a track that took it so would be far too sure."""
    rng = np.random.default_rng(31)
    kept: dict[str, list[float]] = {"forward": [], "smoothed": [], "as they are": [], "smoothed so": []}
    spec = dataclasses.replace(SPEC, acceleration_m2_s3=1e-2, gate_sigmas=50.0)
    for _ in range(30):
        fixes, place = biased_drive(rng, 24)
        plain = [dataclasses.replace(f, standing_slope={}) for f in fixes]
        forward, naive = filter_fixes(fixes, spec), filter_fixes(plain, spec)
        tracks = forward, smooth_trajectory(forward, spec), naive, smooth_trajectory(naive, spec)
        for squares, points, at in zip(kept.values(), tracks, (-1, 12, -1, 12), strict=True):
            squares.append(square(points[at].mean[:3] - place[at], points[at].covariance_m2))
    # By chance alone the mean of 30 is below 5 but for one in a thousand.
    assert max(np.mean(kept["forward"]), np.mean(kept["smoothed"])) < 5
    assert min(np.mean(kept["as they are"]), np.mean(kept["smoothed so"])) > 7


def test_a_young_track_is_not_believed_against_more_fixes_than_it_has() -> None:
    """Its second fix is off, so that it points elsewhere; those after it agree with one another."""
    t_us = np.arange(12) * 35e3
    seen = np.outer(t_us * 1e-6, [10.0, 0.0, 0.0])
    seen[1] += 12 * SIGMA_M
    points = filter_fixes([fix(t, p, NOISE_M2) for t, p in zip(t_us, seen, strict=True)], SPEC)
    assert [p.starts for p in points].index(True, 1) <= 5
    assert points[-1].rejected == 0
    assert (abs(points[-1].mean[:3] - seen[-1]) < 5 * np.sqrt(np.diag(points[-1].covariance_m2))).all()


STRONG = ErrorModel(acceleration_m2_s3=0.7, rate_white_deg_rts=2.0, accelerometer_white_m2_s3=0.3)
VELOCITY = np.array([8.0, 5.0, -1.0])


def motion(push: bool) -> ImuMotion:
    t = np.linspace(0, 3, 61)
    pushed = np.stack([2 * np.sin(t), np.cos(3 * t), 0.5 * t], 1) if push else None
    return ImuMotion(t, 0.6 * t + 0.3 * np.sin(2 * t), True, pushed)


def integrate(way, velocity, heading, imu, kicked_s=np.inf, turn=0.0, kick=0.0) -> Floats:
    """Place and velocity in the end, by many short steps; from a time on heading and velocity are off."""
    steps, end = 6000, way.t_s[-1]
    dt = end / steps
    t = np.append((np.arange(steps) + 0.5) * dt, end)
    late, bias = (t > kicked_s)[:, None], imu * imu_sigmas(way, STRONG)
    angle = np.interp(t, way.t_s, way.turn_rad) - bias[0] * t + turn * late[:, 0]
    speed = velocity + late * kick
    if way.acceleration_m_s2 is None:
        speed = turn_vectors(speed, angle)
    else:
        pushed = np.stack([np.interp(t, way.t_s, c) for c in way.acceleration_m_s2.T], 1) - bias[-3:]
        rise = turn_vectors(pushed, heading + angle) * dt
        rise[-1] = 0
        speed = speed + np.cumsum(rise, 0) - rise / 2
    return np.append(speed[:-1].sum(0) * dt, speed[-1])


def turn_vectors(vectors: Floats, angle: Floats) -> Floats:
    """Vectors (n, 3) turned about up, clockwise."""
    level = (vectors[:, 0] + 1j * vectors[:, 1]) * np.exp(-1j * angle)
    return np.stack([level.real, level.imag, vectors[:, 2]], 1)


def slopes(of: Callable[[Floats], Floats], size: int) -> Floats:
    """How what is given depends on each of so many numbers near 0, one a column."""
    steps = 1e-2 * np.eye(size)
    return np.stack([(of(step) - of(-step)) / 2e-2 for step in steps], 1)


@pytest.mark.parametrize("push", [False, True])
def test_the_way_is_that_of_short_steps(push: bool) -> None:
    way, imu = motion(push), np.array([3.0, 1.0, -2.0, 0.5])[: 4 if push else 1]
    found = dead_reckon(way, VELOCITY, 0.4, 0.0, imu, STRONG)
    start = np.append(np.zeros(3), VELOCITY)
    np.testing.assert_allclose(
        found.transition @ start + found.displacement, integrate(way, VELOCITY, 0.4, imu), atol=2e-3
    )
    by_speed = slopes(lambda off: integrate(way, VELOCITY + off, 0.4, imu), 3)
    np.testing.assert_allclose(found.transition[:, 3:], by_speed, atol=1e-3)
    by_imu = slopes(lambda off: integrate(way, VELOCITY, 0.4, imu + off), len(imu))
    np.testing.assert_allclose(found.by_bias, by_imu, atol=1e-3)


def test_headings_error_pushes_aside() -> None:
    way, imu = motion(True), np.zeros(4)
    exact, off = (dead_reckon(way, VELOCITY, 0.4, sigma, imu, STRONG).noise for sigma in (0.0, 0.01))
    slope = slopes(lambda turn: integrate(way, VELOCITY, 0.4 + turn[0], imu), 1)
    np.testing.assert_allclose(off - exact, 0.01**2 * slope @ slope.T, atol=1e-4)


@pytest.mark.parametrize("push", [False, True])
def test_noise_is_that_of_kicks(push: bool) -> None:
    """White acceleration, and a gyroscope's random walk, kick by kick through what follows each."""
    way, imu = motion(push), np.zeros(4 if push else 1)
    white = STRONG.accelerometer_white_m2_s3 if push else STRONG.acceleration_m2_s3
    power = np.array([np.radians(STRONG.rate_white_deg_rts) ** 2, *3 * [white]])
    noise = np.zeros((6, 6))
    for s in (np.arange(120) + 0.5) * 3 / 120:
        by = slopes(lambda k, s=s: integrate(way, VELOCITY, 0.4, imu, s, k[0], k[1:]), 4)
        noise += 3 / 120 * (by * power) @ by.T
    np.testing.assert_allclose(dead_reckon(way, VELOCITY, 0.4, 0.0, imu, STRONG).noise, noise, atol=5e-3)


def turning_drive(rng, spec, *, push, rate_deg_s) -> tuple[list[Fix], AttitudeLog, Floats, Floats]:
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
        felt += biases[1:] * spec.accelerometer_sigma_m_s2
        felt += rng.normal(size=felt.shape) * np.sqrt(spec.accelerometer_white_m2_s3 / dt)
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
        fixes, log, truth, biases = turning_drive(rng, spec, push=push, rate_deg_s=45.0)
        points = filter_fixes(fixes, spec, log.motion_between)
        assert not any(p.rejected for p in points)
        smooth = smooth_trajectory(points, spec)
        # 37 is the last fix before the gap, 38 the first one behind it.
        for name, found in (("forward", points), ("smoothed", smooth)):
            for at in (20, 37, 38, 55):
                off = square(found[at].mean[:3] - truth[at], found[at].covariance_m2)
                squares.setdefault((name, at), []).append(off)
        reported = points[-1].standing(IMU)
        estimates.append(square(reported[0] - biases, reported[1]))
        sigmas.append(np.sqrt(np.diag(reported[1])))
    assert all(by_chance(values, 3, 0.9999) for values in squares.values())
    assert by_chance(estimates, 4 if push else 1, 0.9999)
    assert np.mean(sigmas, 0)[0] < 0.5


BIASED = ErrorModel(stretch_share=0.0, shared_sigma_px=0.05, shared_along_px=0.05, shared_share=0.0)
CAMERA, LENS = CameraModel(), CameraSigma(focal_mm=0.005 * CameraModel().focal_mm)
SITE_M, BIAS_DEG, TIME_US = 0.1, 0.1, 8000.0


def angles_deg(t_s: float) -> Floats:
    """Pitch, roll and heading of a car that sways, and drives straight on."""
    return np.array([2 + np.sin(6 * t_s), 0.5 * np.cos(5 * t_s), 1.0])


def drive(rng: np.random.Generator) -> tuple[list[Fix], dict[tuple[str, str], float]]:
    """Past eight bars, two or three in view; what is to be added to each stated value."""
    truth = {("camera", "focal_mm"): LENS.focal_mm * rng.normal()}
    names = ("pitch_deg", "roll_deg", "heading_deg")
    truth |= {("attitude", name): BIAS_DEG * rng.normal() for name in names}
    truth["attitude", "time_us"] = TIME_US * rng.normal()
    off = rng.normal(0, SITE_M, (8, 3))
    for b, row in enumerate(off):
        truth |= {(f"bar {b}", name): v for name, v in zip(("east_m", "north_m", "up_m"), row, strict=True)}
    lens = dataclasses.replace(CAMERA, focal_mm=CAMERA.focal_mm + truth["camera", "focal_mm"])
    late_s = truth["attitude", "time_us"] * 1e-6
    fixes = []
    for t in np.arange(0, 20, 0.3):
        place = np.array([0.0, 10 * t, -4.0])
        turned = Attitude(*angles_deg(t)).rotation()
        measured = angles_deg(t + late_s) - [truth["attitude", name] for name in names]
        rate = (angles_deg(t + 1e-3) - angles_deg(t - 1e-3)) / 2e-3
        attitude = Attitude(*measured, BIAS_DEG, BIAS_DEG, time_sigma_us=TIME_US, rate_deg_s=tuple(rate))
        views = []
        for b in range(8):
            centre = np.array([(-1) ** b * 4.0, 60 + 25.0 * b, 0.5 * (b % 3)])
            if 28 < centre[1] - place[1] < 90:
                reported = bar(centre)
                points, _ = project_bars(reported + off[b], place, turned, lens)
                points += rng.normal(0, 0.07, points.shape) + rng.normal(0, BIASED.shared_sigma_px, 2)
                views.append(BarView(b, reported, points, np.full(16, 0.0707), (SITE_M, 0.0, 0.0)))
        pose = solve_pose(views, CAMERA, attitude, BIASED, LENS)
        if not isinstance(pose, Rejection):
            heading = Attitude.of_rotation(pose.rotation).heading_deg
            known = {"slow_m2": pose.slow, "standing": pose.standing, "heading_deg": heading}
            fixes.append(fix(t * 1e6, pose.enu_m, pose.noise, **known))
    return fixes, truth


def states_of(point: TrajectoryPoint) -> dict[str, tuple[Floats, Floats]]:
    found = {cause.name: point.standing(cause.name) for cause in point.causes}
    return {name: state for name, state in found.items() if state is not None}


def test_a_drive_past_bars_tells_their_errors_and_its_own() -> None:
    rng, squares, widths = np.random.default_rng(7), [], []
    sites = {b: BarSite(b, 35.0, 137.0, 50.0, position_sigma_m=SITE_M) for b in range(8)}
    reported = Attitude(0, 0, 0, BIAS_DEG, BIAS_DEG, time_sigma_us=TIME_US)
    for _ in range(3):
        fixes, truth = drive(rng)
        last = filter_fixes(fixes, dataclasses.replace(BIASED, acceleration_m2_s3=0.01))[-1]
        rows = estimate_biases(states_of(last), CAMERA, LENS, reported, sites, BIASED)
        squares += [((row.correction - truth[row.part, row.what]) / row.sigma) ** 2 for row in rows]
        table = {(row.part, row.what): row for row in rows}
        for key in (("camera", "focal_mm"), ("attitude", "time_us"), ("attitude", "heading_deg")):
            assert table[key].is_determined
            widths.append(table[key].sigma / table[key].stated_sigma)
        share, sigma = focal_share(last.standing("camera"), CAMERA, LENS)
        assert share == pytest.approx(table["camera", "focal_mm"].correction / CAMERA.focal_mm)
        assert sigma == pytest.approx(table["camera", "focal_mm"].sigma / CAMERA.focal_mm)
    assert max(widths) < 0.7
    # Errors of one drive hang together: a mean of squares, wide.
    assert 0.5 < np.mean(squares) < 1.8
    assert max(squares) < stats.chi2.isf(1e-5, 1)


def test_what_a_drive_does_not_tell_keeps_its_sigma() -> None:
    stays = {"camera": np.zeros((3, 7)), "attitude": np.zeros((3, 4)), "bar 3": np.zeros((3, 1))}
    fixes = [fix(t, np.zeros(3), np.eye(3), standing=stays) for t in (0.0, 1e5, 2e5)]
    points = filter_fixes(fixes, BIASED)
    rows = estimate_biases(states_of(points[-1]), CAMERA, LENS, Attitude(0, 0, 0, 0.2, 0.3), {}, BIASED)
    found = {(row.part, row.what): row for row in rows}
    # Nothing was stated of the clock, nor of the principal point, nor of the site.
    angles = [("attitude", name) for name in ("pitch_deg", "roll_deg", "heading_deg")]
    assert list(found) == [("camera", "focal_mm"), *angles]
    for row in rows:
        assert not row.is_determined
        assert row.sigma == pytest.approx(row.stated_sigma)
        assert row.correction == 0
    assert found["attitude", "heading_deg"].stated_sigma == 0.3
    assert math.isnan(focal_share(points[-1].standing("camera"), CAMERA, CameraSigma())[0])


def test_biases_of_an_imu_are_taken_off() -> None:
    state = np.array([1.0, 0.0, -2.0, 0.5]), np.diag([0.25, 1.0, 0.04, 1.0])
    rows = estimate_biases({IMU: state, "gnss": state}, CAMERA, LENS, None, {}, BIASED)
    assert rows[0] == EstimatedBias(IMU, "rate_deg_s", -0.1, 0.05, 0.1)
    assert [row.what for row in rows[1:]] == ["push_right_m_s2", "push_forward_m_s2", "push_up_m_s2"]
    assert rows[2].correction == pytest.approx(0.1)
    assert [row.is_determined for row in rows] == [True, False, True, False]
