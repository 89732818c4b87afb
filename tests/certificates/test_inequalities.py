"""The verified checks of matrices against exact rational elimination."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from qpmhe.certificates.evidence import CertificateError
from qpmhe.certificates.inequalities import (
    Form,
    Matrices,
    definite,
    eigenvalue_bounds,
    euclidean_constants,
    norm_bound,
    norms,
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


def random_matrix(generator, n, decades):
    basis = generator.standard_normal((n, n))
    matrix = basis @ np.diag(10.0 ** generator.uniform(-decades, 0, n)) @ basis.T
    return 0.5 * (matrix + matrix.T)


def test_never_more_than_exact_arithmetic_and_hardly_less():
    generator, proved = np.random.default_rng(1), 0
    for n in np.repeat([1, 2, 4, 7], 50):
        matrix = random_matrix(generator, n, 8)
        # About the boundary of the cone: some just inside, some just outside.
        matrix -= generator.choice([0.0, 0.5, 0.999999, 1.000001, 2.0]) * float(
            np.linalg.eigvalsh(matrix)[0]
        ) * np.eye(n)
        shown = bool(definite(Matrices.exact(matrix[None]))[0])
        assert exactly_definite(matrix) or not shown
        proved += shown
    assert proved > 80
    ones, nan = np.ones((3, 3)), np.full((3, 3), np.nan)
    stack = np.stack((ones, nan, -np.eye(3), np.eye(3), 1e-30 * np.eye(3)))
    assert definite(Matrices.exact(stack)).tolist() == [False, False, False, True, True]


def test_radii_are_covered():
    generator, shown = np.random.default_rng(8), 0
    for _ in range(150):
        n = int(generator.integers(1, 8))
        matrix, sizes = random_matrix(generator, n, 3), 10.0 ** generator.uniform(-3, 3, n)
        matrix = np.outer(sizes, sizes) * matrix
        sizes = np.sqrt(np.diag(matrix))
        radius = 10.0 ** generator.uniform(-6, -1) * np.outer(sizes, sizes)
        if definite(Matrices(matrix[None], radius[None]))[0]:
            shown += 1
            noise = generator.choice([-1.0, 1.0], (n, n)) * radius
            assert exactly_definite(matrix + 0.5 * (noise + noise.T))
    assert shown > 30


def test_products_hold_exact_products():
    a, b = np.random.default_rng(6).standard_normal((2, 4, 4))
    product = Matrices.exact(a) @ Matrices.exact(b) - Matrices.exact(a)
    exact = np.vectorize(Fraction)
    away = np.abs(exact(a) @ exact(b) - exact(a) - exact(product.middle))
    assert (away <= exact(product.radius)).all()
    assert product.radius.max() < 1e-13


def test_eigenvalue_and_norm_bounds_and_constants_are_outward_and_tight():
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
    found = np.array(euclidean_constants(np.diag([1.0, 4.0]), np.array([[9.0]]), 0.5))
    np.testing.assert_allclose(found, [2.0, 4.0, 6.0], rtol=1e-8)
    assert (found >= [2.0, 4.0, 6.0]).all()
    # An output weight below zero by rounding is no weight.
    c_p, c_w, c_v = euclidean_constants(np.eye(1), np.array([[-1e-9]]), 0.5)
    assert (c_p, c_w) == pytest.approx((1.0, 2.0))
    assert 0.0 < c_v < 1e-3


@pytest.mark.parametrize("observes", [False, True])
def test_the_sum_of_squares_follows_from_both_inequalities(observes):
    generator, shown = np.random.default_rng(9), 0
    for _ in range(200):
        A, C, G, L = (
            0.4 * generator.standard_normal(size) for size in ((2, 2), (1, 2), (2, 2), (2, 1))
        )
        P, X = np.eye(2), generator.uniform(0.3, 0.9) * np.eye(2)
        Q, R = generator.uniform(0.5, 4.0) * np.eye(2), generator.uniform(0.5, 4.0) * np.eye(1)
        form = Form(
            P, 0.9, R, L if observes else None, None, X, np.hstack((G, -L)) if observes else G, Q
        )
        J = Matrices.exact(np.vstack((A, C))[None])
        if not (form.holds_always() and definite(form.matrices(J))[0]):
            continue
        shown += 1
        e, w, v = (generator.standard_normal((100, k)) for k in (2, 2, 1))
        ahead = e @ A.T + w @ G.T - ((e @ C.T + v) @ L.T if observes else 0.0)
        noise = v if observes else e @ C.T
        supplied = 0.81 * norms(e, P) ** 2 + norms(w, Q) ** 2 + norms(noise, R) ** 2
        assert (norms(ahead, P) ** 2 <= supplied).all()
        assert (form.excess(e, e @ A.T, e @ C.T) <= 0.0).all()
    assert shown > 20
