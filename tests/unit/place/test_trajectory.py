"""The trajectory against a batch solution of the same model, and its consistency."""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from evlcp_sdk.link.sections import PositionSpec
from evlcp_sdk.place.trajectory import filter_fixes, smooth_trajectory, trajectory_step
from evlcp_sdk.values import Fix

SPEC = PositionSpec(acceleration_m2_s3=2.0)
SIGMA_M = np.array([0.3, 0.1, 0.05])


def fix(t_us: float, enu_m: NDArray[np.float64], standing_m: float = 0.0) -> Fix:
    noise = np.diag(SIGMA_M**2)
    return dataclasses.replace(
        Fix.refused(t_us, (0,), "", ""),
        enu_m=enu_m,
        noise_m2=noise,
        covariance_m2=noise + standing_m**2 * np.eye(3),
    )


def drive(rng: np.random.Generator, n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times, us, at uneven steps, and states (n, 6) of white acceleration from a likely start."""
    t_s = np.cumsum(rng.uniform(0.01, 0.2, n))
    states = np.empty((n, 6))
    states[0] = np.concatenate([rng.normal(0, 100, 3), rng.normal(0, 30, 3)])
    for i in range(1, n):
        dt = t_s[i] - t_s[i - 1]
        power = SPEC.acceleration_m2_s3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        kick = np.linalg.cholesky(power) @ rng.normal(size=(2, 3))
        states[i, :3] = states[i - 1, :3] + dt * states[i - 1, 3:] + kick[0]
        states[i, 3:] = states[i - 1, 3:] + kick[1]
    return t_s * 1e6, states


def batch(t_us: NDArray[np.float64], seen: NDArray[np.float64], axis: int) -> tuple[NDArray[np.float64], ...]:
    """Means (n, 2) and covariances of one axis by one dense least-squares problem over all times."""
    n = len(t_us)
    rows, right = [], []

    def add(row: NDArray[np.float64], value: NDArray[np.float64], covariance: NDArray[np.float64]) -> None:
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        rows.append(white @ row)
        right.append(white @ value)

    first = np.zeros((1, 2 * n))
    first[0, 1] = 1
    add(first, np.zeros(1), np.array([[30.0**2]]))
    for i in range(n):
        at = np.zeros((1, 2 * n))
        at[0, 2 * i] = 1
        add(at, seen[i : i + 1, axis], np.array([[SIGMA_M[axis] ** 2]]))
        if i:
            dt = (t_us[i] - t_us[i - 1]) * 1e-6
            step = np.zeros((2, 2 * n))
            step[:, 2 * i : 2 * i + 2] = np.eye(2)
            step[:, 2 * i - 2 : 2 * i] = -np.array([[1, dt], [0, 1]])
            power = SPEC.acceleration_m2_s3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            add(step, np.zeros(2), power)
    a, b = np.concatenate(rows), np.concatenate(right)
    covariance = np.linalg.inv(a.T @ a)
    return (covariance @ (a.T @ b)).reshape(n, 2), np.diag(covariance).reshape(n, 2)


def test_filter_and_smoother_are_the_batch_solution() -> None:
    rng = np.random.default_rng(4)
    t_us, states = drive(rng, 12)
    seen = states[:, :3] + rng.normal(size=(12, 3)) * SIGMA_M
    spec = dataclasses.replace(SPEC, gate_sigmas=50.0)
    points = filter_fixes([fix(t, p) for t, p in zip(t_us, seen, strict=True)], spec)
    smooth = smooth_trajectory(points, spec)
    for axis in range(3):
        mean, variance = batch(t_us, seen, axis)
        np.testing.assert_allclose([p.mean[axis::3] for p in smooth], mean, atol=1e-6)
        np.testing.assert_allclose([np.diag(p.noise)[axis::3] for p in smooth], variance, rtol=1e-6)
        np.testing.assert_allclose(points[-1].mean[axis::3], mean[-1], atol=1e-6)
        np.testing.assert_allclose(points[-1].mean, smooth[-1].mean)


def test_both_are_consistent() -> None:
    rng = np.random.default_rng(8)
    forward, backward, count = [], [], 60
    for _ in range(count):
        t_us, states = drive(rng, 20)
        seen = states[:, :3] + rng.normal(size=(20, 3)) * SIGMA_M
        standing = rng.normal(0, 0.5, 3)
        fixes = [fix(t, p + standing, 0.5) for t, p in zip(t_us, seen, strict=True)]
        points = filter_fixes(fixes, SPEC)
        for found, kept in ((points, forward), (smooth_trajectory(points, SPEC), backward)):
            # One time a trajectory: errors at its other times are not independent.
            error = found[10].mean[:3] - states[10, :3]
            kept.append(error @ np.linalg.solve(found[10].covariance_m2, error))
    low, high = stats.chi2.interval(0.95, 3 * count)
    assert low / count < np.mean(forward) < high / count
    assert low / count < np.mean(backward) < high / count


def test_an_outlier_is_left_out_and_a_new_place_starts_a_trajectory() -> None:
    fixes = [fix(i * 1e5, np.array([float(i), 0, 0])) for i in range(10)]
    fixes[5] = fix(5e5, np.array([50.0, 0, 0]))
    points = filter_fixes(fixes, SPEC)
    assert [p.misses for p in points] == [0, 0, 0, 0, 0, 1, 0, 0, 0, 0]
    assert abs(points[5].mean[0] - 5) < 0.5
    jumped = fixes[:5] + [fix((5 + i) * 1e5, np.array([1000.0 + i, 0, 0])) for i in range(15)]
    points = filter_fixes(jumped, SPEC)
    assert [i for i, p in enumerate(points) if p.starts] == [0, 15]
    smooth = smooth_trajectory(points, SPEC)
    assert max(p.mean[0] for p in smooth[:5]) < 10


def test_refused_fixes_have_no_point_and_the_state_is_not_changed() -> None:
    refused = Fix.refused(1e5, (0,), "misfit", "far off")
    points = filter_fixes([fix(0, np.zeros(3)), refused, fix(2e5, np.ones(3) * 0.1)], SPEC)
    assert [p.t_us for p in points] == [0, 2e5]
    before = points[0].mean.copy(), points[0].noise.copy()
    trajectory_step(points[0], fix(3e5, np.ones(3)), SPEC)
    np.testing.assert_array_equal(before[0], points[0].mean)
    np.testing.assert_array_equal(before[1], points[0].noise)
