"""Cholesky's root of a few unknowns against NumPy."""

import numpy as np
import pytest

from evlcp_sdk import _kernels

LEAST = 1e-13


@pytest.mark.parametrize("n", [1, 3, 14])
def test_inverses_are_those_of_numpy(n: int) -> None:
    root, out = np.random.default_rng(8).normal(size=(n, n + 2)), np.zeros((n, n))
    # Units that differ by orders of magnitude are what the scaling is for.
    units = 10.0 ** np.linspace(-6, 6, n)
    matrix = root @ root.T * np.outer(units, units)
    assert _kernels.inverted(matrix, LEAST, out)
    np.testing.assert_allclose(out * np.outer(units, units), np.linalg.inv(root @ root.T), rtol=1e-7)
    assert not _kernels.inverted(-matrix, LEAST, out)
    if n > 1:
        assert not _kernels.inverted(np.ones((n, n)), LEAST, out)


def test_damped_equations_are_solved_as_by_numpy() -> None:
    rng, damping = np.random.default_rng(3), 0.5
    root, side = rng.normal(size=(7, 9)), rng.normal(size=7)
    matrix = root @ root.T
    scale, low, out = np.zeros(7), np.full((7, 7), np.nan), np.zeros(7)
    assert _kernels.rooted(matrix, damping, LEAST, scale, low)
    _kernels.substituted(low, scale, side, out)
    damped = matrix + damping * np.diag(np.diag(matrix))
    np.testing.assert_allclose(out, np.linalg.solve(damped, side), rtol=1e-9)
    below = np.tril(low)
    np.testing.assert_allclose(below @ below.T, damped * np.outer(scale, scale), atol=1e-12)
