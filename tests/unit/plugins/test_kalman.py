"""The tracking filters against the textbook's matrices, and their consistency by simulation."""

import numpy as np
import pytest
from evlcp_kalman.tracking import KalmanTracking
from numpy.testing import assert_allclose


def test_it_is_the_textbook_filter():
    """Step by step with full matrices, covariance in Joseph's form."""
    q, speed, sigma = 2.0, 15.0, 0.1
    rng = np.random.default_rng(0)
    t_us = np.cumsum(rng.uniform(2000, 8000, 40))
    z = 50 - 8 * t_us * 1e-6 + rng.normal(0, sigma, 40)
    distance = KalmanTracking(acceleration_m2_s3=q, speed_m_s=speed).compile().distance
    state, got = distance.init(), []
    for t, value in zip(t_us, z, strict=True):
        state, (value,), found_sigma = distance.step(state, t, np.array([value]), sigma)
        got.append((value, found_sigma))
    x, P, H = np.array([z[0], 0.0]), np.diag([sigma**2, speed**2]), np.array([[1.0, 0.0]])
    want = [(x[0], np.sqrt(P[0, 0]))]
    for dt, value in zip(np.diff(t_us) * 1e-6, z[1:], strict=True):
        F = np.array([[1, dt], [0, 1]])
        P = F @ P @ F.T + q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        x = F @ x
        K = P @ H.T / (H @ P @ H.T + sigma**2)
        x = x + K[:, 0] * (value - x[0])
        J = np.eye(2) - K @ H
        P = J @ P @ J.T + K @ K.T * sigma**2
        want.append((x[0], np.sqrt(P[0, 0])))
    assert_allclose(got, want, rtol=1e-9)


def position_errors(measured, true, **parameters):
    """Of the values and of the predictions a step ahead, (n, 2); 1.5 ms a step, 0.25 px of noise."""
    filter_ = KalmanTracking(**parameters).compile().position
    state, out = filter_.init(), []
    for k, z in enumerate(measured):
        ahead = filter_.predict(state, 1500.0 * k)
        state, value, _ = filter_.step(state, 1500.0 * k, z, 0.25)
        out.append((np.abs(value - true[k]).max(), 0 if ahead is None else np.abs(ahead[0] - true[k]).max()))
    return np.array(out)


def shaking_camera(n, jolt_px_s=0.0):
    """A bar's centre on a shaking camera, whose speed changes at once in the middle."""
    t = 1.5e-3 * np.arange(n)
    after = np.maximum(t - t[n // 2], 0)
    y = 360 + 10 * np.sin(2 * np.pi * 12 * t) + jolt_px_s / 75 * np.sin(75 * after) * np.exp(-after / 0.05)
    return np.stack([400 + 4 * np.cos(2 * np.pi * 9 * t), y], axis=1)


@pytest.mark.parametrize("jolt_px_s", [-7000.0, 3000.0, 7000.0])
def test_a_pothole_is_followed(jolt_px_s):
    true = shaking_camera(120, jolt_px_s)
    measured = true + np.random.default_rng(3).normal(0, 0.25, true.shape)
    errors = position_errors(measured, true)
    assert errors[:, 0].max() < 1.5
    # Nothing can tell a jolt before it is measured.
    assert np.delete(errors[1:, 1], 60).max() < 4
    # Without jolts, what comes after one is lost for a while.
    assert position_errors(measured, true, jolt_px_s=0.0)[:, 0].max() > 10


def test_a_stray_position_is_no_jolt():
    true = shaking_camera(120)
    measured = true + np.random.default_rng(4).normal(0, 0.25, true.shape)
    measured[50] += (60.0, 0.0)
    errors = position_errors(measured, true)
    assert errors[:, 0].max() < 2
