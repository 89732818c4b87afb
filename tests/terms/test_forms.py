"""Matrices of a stage by their entries beside whole ones, for random patterns."""

import numpy as np
import pytest

import qpmhe
from qpmhe.terms import entries
from qpmhe.terms.forms import SparseForm, WholeForm
from qpmhe.terms.linearization import Stage
from qpmhe.terms.selected_inverse import SelectedInverse

COUNT = 3


@pytest.fixture(autouse=True)
def any_size(monkeypatch):
    monkeypatch.setattr(entries, "_LEAST_STATES", 1)
    monkeypatch.setattr(entries, "_MOST_FILLED", 1.0)
    monkeypatch.setattr("qpmhe_solvers.sparse_qp._GAIN", 1e6)
    monkeypatch.setattr(entries.StageProducts, "work", staticmethod(lambda *_: 0))


def random_weight(generator, d, share):
    """Symmetric, positive definite, with a random pattern."""
    found = np.where(generator.uniform(size=(d, d)) < share, generator.normal(size=(d, d)), 0.0)
    found = found + found.T
    return found + np.diag(np.abs(found).sum(axis=1) + generator.uniform(0.5, 2.0, d))


class Both:
    """A stage's patterns and numbers in both forms."""

    def __init__(self, seed):
        generator = self.generator = np.random.default_rng(seed)
        n, p = self.n, self.p = [int(generator.integers(1, one)) for one in (12, 7)]
        share = generator.uniform(0.0, 0.6, 3)
        there = generator.uniform(size=(n + p, n)) < share[0]
        there[np.arange(n), np.arange(n)] = True
        self.there = there
        self.cost = qpmhe.QuadraticCost(
            prior=random_weight(generator, n, share[1]),
            disturbance=random_weight(generator, n, share[1]),
            noise=random_weight(generator, p, share[2]),
        )
        self.sparse = SparseForm.of(np.nonzero(there), self.cost, COUNT + 1)
        self.whole = WholeForm(n, p)
        self.slopes = np.where(there, generator.normal(size=(COUNT, n + p, n)), 0.0)
        self.residuals = generator.normal(size=(COUNT, n + p))

    @property
    def entries(self):
        return self.slopes[:, self.there]

    def terms(self, weights):
        """Of both forms, for their weights: all stages, then each by itself."""
        found = []
        for form, slopes, weight in zip(
            (self.sparse, self.whole), (self.entries, self.slopes), weights, strict=True
        ):
            terms, single = form.terms(COUNT), form.terms(COUNT)
            for one in terms, single:
                one.slopes[...], one.residuals[...] = slopes, self.residuals
            costs = terms.set_all(COUNT, weight)
            for k in range(COUNT):
                own = weight if form.is_single(weight) else weight[k]
                assert single.set_stage(Stage(single, k), own) == pytest.approx(costs[k])
            for name in ("panel", "gradient", "next_gradient"):
                assert getattr(single, name) == pytest.approx(getattr(terms, name))
            found.append((costs, terms))
        return found

    def expand(self, bands):
        """Entries of panels as whole ones."""
        qp = self.sparse.qp(len(bands), 0)
        qp.band = bands
        return qp.full().band


def close(one, other):
    return one == pytest.approx(other, rel=1e-12, abs=1e-12 * (1.0 + np.abs(other).max()))


@pytest.mark.parametrize("seed", range(40))
def test_terms_are_those_of_whole_matrices(seed):
    both = Both(seed)
    weights = [form.usual_weight(both.cost) for form in (both.sparse, both.whole)]
    masks = both.generator.uniform(size=(COUNT, both.p)) < 0.6
    partial = [
        np.array([form.partial_weight(both.cost, mask, None, None) for mask in masks])
        for form in (both.sparse, both.whole)
    ]
    for mine, theirs in (weights, partial):
        assert close(both.sparse.whole(mine), theirs)
        assert close(both.sparse.diagonal(mine), both.whole.diagonal(theirs))
        (costs, terms), (expected, whole) = both.terms((mine, theirs))
        assert close(costs, expected)
        assert close(both.expand(terms.panel), whole.panel)
        assert close(terms.gradient, whole.gradient)
        assert close(terms.next_gradient, whole.next_gradient)
        assert close(
            both.sparse.times(both.residuals, mine), both.whole.times(both.residuals, theirs)
        )
        band = both.sparse.disturbance_band(np.atleast_2d(mine))
        right = both.whole.disturbance_band(theirs if theirs.ndim == 3 else theirs[None])
        assert close(both.expand(band), right)
        damping = both.sparse.damping(both.entries, mine)
        assert close(both.expand(damping), both.whole.damping(both.slopes, theirs))
    assert close(
        both.expand(both.sparse.band(both.cost.prior)[None])[0], both.whole.band(both.cost.prior)
    )


@pytest.mark.parametrize("seed", range(40))
def test_so_is_what_is_free_where_disturbances_are(seed):
    both = Both(seed)
    force, states = both.generator.normal(size=(2, COUNT, both.n))
    masks = both.generator.uniform(size=(COUNT, both.p)) < 0.6
    mine, theirs = (
        np.array([form.partial_weight(both.cost, mask, None, None) for mask in masks])
        for form in (both.sparse, both.whole)
    )
    eye = np.eye(both.n)
    found = both.sparse.freed(both.entries, mine, lambda: eye)
    expected = both.whole.freed(both.slopes, theirs, lambda: eye)
    # What the data say is a difference of the Hessian's block and what later states take of it.
    size = np.abs(both.slopes).max() ** 2 * np.abs(theirs).max() * (both.n + both.p)
    assert found.information == pytest.approx(expected.information, rel=1e-10, abs=1e-13 * size)
    for k in range(COUNT):
        assert close(found.spread(k, force[k]), expected.spread(k, force[k]))
    for name, one in (("times_minus_a", states), ("minus_a_transposed", force)):
        value = getattr(both.sparse, name)(both.entries, one)
        assert close(value, getattr(both.whole, name)(both.slopes, one))
    square = both.sparse.disturbance_square(mine, states)
    assert square == pytest.approx(both.whole.disturbance_square(theirs, states))


@pytest.mark.parametrize("seed", range(10))
def test_a_weight_outside_of_the_pattern_does_not_fit(seed):
    both = Both(seed)
    assert both.sparse.fits(2.0 * both.cost.noise, both.cost.disturbance)
    assert both.sparse.fits(None, None)
    outside = np.argwhere(both.cost.disturbance == 0.0)
    if outside.size:
        other = both.cost.disturbance.copy()
        other[tuple(outside[0])] = 0.1
        assert not both.sparse.fits(None, other)


@pytest.mark.parametrize(("size", "width", "reach"), [
    (1, 0, 0), (7, 0, 1), (13, 2, 2), (30, 3, 7), (30, 3, 100), (41, 5, 6),
])
def test_entries_of_an_inverse(size, width, reach):
    generator = np.random.default_rng(size)
    band = np.zeros((width + 1, size))
    matrix = np.zeros((size, size))
    for k in range(width + 1):
        band[k, : size - k] = generator.normal(size=size - k) if k else 2.0 * width + 3.0
        matrix += np.diag(band[k, : size - k], -k)
    matrix += np.tril(matrix, -1).T
    rows, columns = np.nonzero(np.abs(np.subtract.outer(np.arange(size), np.arange(size))) <= reach)
    found = SelectedInverse(band, reach)(rows, columns)
    assert found == pytest.approx(np.linalg.inv(matrix)[rows, columns], rel=1e-12, abs=1e-14)
