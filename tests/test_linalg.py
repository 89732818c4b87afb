"""What counts as a covariance."""

import numpy as np
import pytest

from qpmhe._linalg import least_pivot


@pytest.mark.parametrize("units", [np.ones(3), np.array([1e-9, 1.0, 1e12])])
def test_semidefinite_up_to_rounding_in_any_units(units):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 2))
    for matrix in (np.eye(3), np.zeros((3, 3)), root @ root.T, np.diag([1.0, 0.0, 1e-20])):
        assert least_pivot(units[:, None] * matrix * units) >= 0.0
    vector = np.linalg.qr(rng.normal(size=(3, 3)))[0][:, 0]
    for share, is_one in ((1e-12, True), (1e-3, False), (2.0, False)):
        matrix = np.eye(3) - (1.0 + share) * np.outer(vector, vector)
        assert (least_pivot(units[:, None] * (matrix + matrix.T) * units) >= 0.0) == is_one
    for wrong in (np.nan, np.inf, -np.inf):
        matrix = np.eye(3)
        matrix[1, 2] = matrix[2, 1] = wrong
        assert least_pivot(matrix) < 0.0
    assert least_pivot(np.diag([1.0, -1e-30, 1.0])) < 0.0
