"""The verified checks of matrices against exact rational elimination."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from qpmhe.certificates.evidence import CertificateError
from qpmhe.certificates.inequalities import (
    ErrorContraction,
    Matrices,
    OutputInjection,
    OutputWeight,
    definite,
    eigenvalue_bounds,
    euclidean_constants,
    norm_bound,
    quickly_definite,
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


@pytest.mark.parametrize("n", [1, 2, 4, 7])
def test_never_more_than_exact_arithmetic_and_hardly_less(n):
    generator = np.random.default_rng(n)
    proved = 0
    for _ in range(60):
        basis = generator.standard_normal((n, n))
        matrix = basis @ np.diag(10.0 ** generator.uniform(-8, 0, n)) @ basis.T
        matrix = 0.5 * (matrix + matrix.T)
        # About the boundary of the cone: some just inside, some just outside.
        matrix -= generator.choice([0.0, 0.5, 0.999999, 1.000001, 2.0]) * float(
            np.linalg.eigvalsh(matrix)[0]
        ) * np.eye(n)
        shown = bool(definite(Matrices.exact(matrix[None]))[0][0])
        truth = exactly_definite(matrix)
        assert truth or not shown
        assert truth or not quickly_definite(Matrices.exact(matrix[None]))[0]
        proved += shown
    assert proved > 10


def test_singular_and_broken_matrices_are_not_proved():
    ones = np.ones((3, 3))
    nan = np.full((3, 3), np.nan)
    shown, least = definite(Matrices.exact(np.stack((ones, nan, -np.eye(3), np.eye(3)))))
    assert shown.tolist() == [False, False, False, True]
    assert least[1] == -np.inf


def test_radius_is_covered():
    matrix = np.eye(3)[None] + 0.1
    generator = np.random.default_rng(5)
    assert definite(Matrices(matrix, np.full((1, 3, 3), 0.1)))[0][0]
    # A member is singular: (1.1 - r) I + (0.1 - r) (ones - I) from some r on.
    assert not definite(Matrices(matrix, np.full((1, 3, 3), 0.5)))[0][0]
    for _ in range(50):
        noise = generator.uniform(-0.1, 0.1, (3, 3))
        assert exactly_definite(matrix[0] + 0.5 * (noise + noise.T))


def test_quick_proof_covers_radii_and_refuses_what_is_singular():
    generator = np.random.default_rng(8)
    shown = 0
    for _ in range(200):
        n = int(generator.integers(1, 8))
        basis = generator.standard_normal((n, n)) * 10.0 ** generator.uniform(-3, 3, (n, 1))
        matrix = basis @ basis.T
        matrix = 0.5 * (matrix + matrix.T)
        sizes = np.sqrt(np.diag(matrix))
        radius = 10.0 ** generator.uniform(-6, 0) * np.outer(sizes, sizes)
        if not quickly_definite(Matrices(matrix[None], radius[None]))[0]:
            continue
        shown += 1
        noise = generator.choice([-1.0, 1.0], (n, n)) * radius
        assert exactly_definite(matrix + 0.5 * (noise + noise.T))
    assert shown > 50
    ones, nan = np.ones((3, 3)), np.full((3, 3), np.nan)
    stack = np.stack((ones, nan, -np.eye(3), np.eye(3), 1e-30 * np.eye(3)))
    assert quickly_definite(Matrices.exact(stack)).tolist() == [False, False, False, True, True]


def test_products_hold_exact_products():
    generator = np.random.default_rng(6)
    a, b = generator.standard_normal((2, 4, 4))
    product = Matrices.exact(a) @ Matrices.exact(b) - Matrices.exact(a)
    for i in range(4):
        for j in range(4):
            exact = sum(
                Fraction(float(a[i, k])) * Fraction(float(b[k, j])) for k in range(4)
            ) - Fraction(float(a[i, j]))
            middle = Fraction(float(product.middle[i, j]))
            assert abs(exact - middle) <= Fraction(float(product.radius[i, j]))
    assert product.radius.max() < 1e-13


def test_eigenvalue_and_norm_bounds_are_outward_and_tight():
    generator = np.random.default_rng(7)
    for n in (1, 3, 6):
        basis = generator.standard_normal((n, n))
        P = basis @ basis.T + 1e-3 * np.eye(n)
        P = 0.5 * (P + P.T)
        low, high = eigenvalue_bounds(P)
        assert exactly_definite(P, low)
        assert exactly_definite(-P, -high)
        values = np.linalg.eigvalsh(P)
        np.testing.assert_allclose([low, high], [values[0], values[-1]], rtol=1e-7)
        bound = norm_bound(Matrices.exact(basis[None]))[0]
        assert np.linalg.norm(basis, 2) <= bound <= np.linalg.norm(basis, 2) * (1 + 1e-8)
    with pytest.raises(CertificateError, match="eigenvalues"):
        eigenvalue_bounds(np.diag([1.0, -1.0]))


def test_matrices_are_what_they_say():
    """Definite exactly where the inequality on (dx, dh) holds: P = 1, scalar numbers."""
    a, c, eta, r = 1.2, 0.5, 0.8, 4.0
    J = Matrices.exact(np.array([[[a], [c]]]))
    one = np.ones((1, 1))
    for weight in (3.1, 3.3):  # (a^2 - eta^2) / c^2 = 3.2
        shown = definite(OutputWeight(one, weight * one, eta).matrices(J))[0][0]
        assert shown == (a * a < eta * eta + c * c * weight)
    for gain, expected in ((0.9, True), (0.7, False)):  # |a - gain c| < 0.8
        assert definite(ErrorContraction(one, gain * one, eta).matrices(J))[0][0] == expected
    injected = OutputInjection(one, r * one, -1.0 * one, 0 * one, 0 * one, eta)
    found = definite(injected.matrices(J))[0][0]
    quadratic = np.array([[eta**2 - (a - c) ** 2, -(a - c)], [-(a - c), r - 1.0]])
    assert found == bool(np.linalg.eigvalsh(quadratic)[0] > 0)
    # Multipliers alone give what the output weight gives.
    m = (a * a - eta * eta) / c * 1.02
    assert definite(
        OutputInjection(one, 1.1 * m / c * one, 0 * one, m * one, 0 * one, eta).matrices(J)
    )[0][0]


def test_constants_of_a_contraction():
    c_p, c_w, c_v = euclidean_constants(np.diag([1.0, 4.0]), np.array([[9.0]]), 0.5)
    np.testing.assert_allclose([c_p, c_w, c_v], [2.0, 4.0, 6.0], rtol=1e-8)
    assert c_p >= 2.0
    assert c_w >= 4.0
    assert c_v >= 6.0
