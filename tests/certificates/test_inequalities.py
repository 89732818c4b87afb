"""The verified checks of matrices against exact rational elimination."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from qpmhe.certificates.evidence import CertificateError
from qpmhe.certificates.inequalities import (
    Matrices,
    definite,
    eigenvalue_bounds,
    euclidean_constants,
    norm_bound,
)


def exactly_definite(matrix, shift=0.0):
    """Positive definiteness of matrix - shift I, by elimination without rounding."""
    rows = [[Fraction(float(entry)) for entry in row] for row in matrix]
    n = len(rows)
    for k in range(n):
        rows[k][k] -= Fraction(float(shift))
    for k in range(n):
        if rows[k][k] <= 0:
            return False
        for i in range(k + 1, n):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return True


def test_never_more_than_exact_arithmetic_and_hardly_less():
    generator, proved = np.random.default_rng(1), 0
    for n in np.repeat([1, 2, 4, 7], 60):
        basis = generator.standard_normal((n, n))
        matrix = basis @ np.diag(10.0 ** generator.uniform(-8, 0, n)) @ basis.T
        matrix = 0.5 * (matrix + matrix.T)
        # About the boundary of the cone: some just inside, some just outside, some with a radius.
        matrix -= generator.choice([0.0, 0.5, 0.999999, 1.000001, 2.0]) * float(
            np.linalg.eigvalsh(matrix)[0]
        ) * np.eye(n)
        sizes = np.sqrt(np.abs(np.diag(matrix)))
        radius = generator.choice([0.0, 1e-6, 1e-3]) * np.outer(sizes, sizes)
        noise = generator.choice([-1.0, 1.0], (n, n)) * radius
        shown = bool(definite(Matrices(matrix[None], radius[None]))[0])
        assert exactly_definite(matrix + 0.5 * (noise + noise.T)) or not shown
        proved += shown
    assert proved > 60
    stack = np.stack((np.ones((3, 3)), np.full((3, 3), np.nan), -np.eye(3), 1e-30 * np.eye(3)))
    assert definite(Matrices.exact(stack)).tolist() == [False, False, False, True]


def test_products_hold_exact_products():
    a, b = np.random.default_rng(6).standard_normal((2, 4, 4))
    product = Matrices.exact(a) @ Matrices.exact(b) - Matrices.exact(a)
    exact = np.vectorize(Fraction)
    away = np.abs(exact(a) @ exact(b) - exact(a) - exact(product.middle))
    assert (away <= exact(product.radius)).all()
    assert product.radius.max() < 1e-13


def test_eigenvalue_and_norm_bounds_and_constants_are_outward_and_tight():
    for n in (1, 3, 6):
        basis = np.random.default_rng(n).standard_normal((n, n))
        P = basis @ basis.T + 1e-3 * np.eye(n)
        P = 0.5 * (P + P.T)
        low, high = eigenvalue_bounds(P)
        assert exactly_definite(P, low)
        assert exactly_definite(-P, -high)
        np.testing.assert_allclose([low, high], np.linalg.eigvalsh(P)[[0, -1]], rtol=1e-7)
        bound = norm_bound(Matrices.exact(basis[None]))[0]
        assert np.linalg.norm(basis, 2) <= bound <= np.linalg.norm(basis, 2) * (1 + 1e-8)
        for unit in (1e11, 1e-30):
            units = np.where(np.arange(n) % 2, unit, 1.0)
            Q = np.outer(units, units) * P
            low, high = eigenvalue_bounds(Q)
            assert exactly_definite(Q, low)
            assert exactly_definite(-Q, -high)
            # The least is the inverse of the largest one of the inverse, which is as exact.
            largest = np.linalg.eigvalsh(np.linalg.inv(P) / np.outer(units, units))[-1]
            np.testing.assert_allclose(low, 1.0 / largest, rtol=1e-7)
    with pytest.raises(CertificateError, match="eigenvalues"):
        eigenvalue_bounds(np.diag([1.0, -1.0]))
    found = np.array(euclidean_constants(np.diag([1.0, 4.0]), np.array([[9.0]]), 0.5))
    np.testing.assert_allclose(found, [2.0, 4.0, 6.0], rtol=1e-8)
    assert (found >= [2.0, 4.0, 6.0]).all()
