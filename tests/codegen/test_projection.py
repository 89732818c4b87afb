"""The projection of the observer onto X in C, beside the one in Python."""

import ctypes
import functools

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import compiled_library, find_compiler
from qpmhe.codegen.layout import Layout
from qpmhe.codegen.source import estimator_files
from qpmhe.observers.projection import ErrorMetric, NearestPoint

casadi = pytest.importorskip("casadi")
pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")

HOOK = """
int32_t project(const mhe_settings *s, const real *P, const real *point, real *out, int32_t *beyond)
{
    const int reached = mhe_project(&s->states, P, point, out);
    *beyond = mhe_is_beyond(&s->states, P, point, out);
    return reached;
}
int32_t settle(const mhe_settings *s, const real *A, const real *C, real *covariance)
{
    static mhe_terms terms;
    memcpy(terms.f_jacobian, A, sizeof terms.f_jacobian);
    memcpy(terms.h_jacobian, C, sizeof terms.h_jacobian);
    return mhe_settle(s, s->gain, &terms, covariance);
}
"""


class CProjection:
    """The functions of projection.c for n states, one output and sets of so many rows."""

    def __init__(self, n, rows):
        x = casadi.SX.sym("x", n)
        system = qpmhe.from_casadi(
            casadi.Function("f", [x], [x]), casadi.Function("h", [x], [x[0]]), compiled=False
        )
        sets = (False, 0), (False, 0), (True, rows)
        layout = Layout(n, 1, 0, 1, sets, 0)
        self.settings = np.zeros((), layout.settings_type())
        files = estimator_files(system.symbolic, layout, self.settings)
        files["mhe.c"] += HOOK
        self.library, self.n = compiled_library(files, "mhe.c"), n

    def _call(self, function, *arrays):
        kept = [np.ascontiguousarray(one) for one in arrays]
        return function(*(ctypes.c_void_p(one.ctypes.data) for one in (self.settings, *kept)))

    def __call__(self, convex_set, point, covariance):
        """The nearest point, whether the metric led there, and whether that is beyond the set."""
        part, rows = self.settings["states"], len(convex_set.matrix)
        part["lower"], part["upper"] = convex_set.lower, convex_set.upper
        part["rows"], part["row_lower"], part["row_upper"] = 0.0, -np.inf, np.inf
        part["rows"][: rows * self.n] = convex_set.matrix.ravel()
        part["row_lower"][:rows] = convex_set.row_lower
        part["row_upper"][:rows] = convex_set.row_upper
        out, beyond = np.zeros(self.n), np.zeros(1, np.int32)
        reached = self._call(self.library.project, covariance, point, out, beyond)
        return out, bool(reached), bool(beyond[0])

    def metric(self, gain, weight, a, c):
        """The covariance that settles, or None."""
        self.settings["gain"], self.settings["metric_weight"] = gain.ravel(), weight.ravel()
        out = np.zeros((self.n, self.n))
        return out if self._call(self.library.settle, a, c, out) else None


projection = functools.cache(CProjection)


def random_set(rng, n, rows):
    """A box, a polytope or both, with a point inside; some without width or repeated."""
    inside = rng.standard_normal(n)
    lower, upper = inside - rng.exponential(size=n), inside + rng.exponential(size=n)
    lower[rng.random(n) < 0.3], upper[rng.random(n) < 0.3] = -np.inf, np.inf
    kind = rng.integers(3) if rows else 0
    if kind == 1:
        lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    one = qpmhe.Box(lower, upper)
    count = 0 if kind == 0 else rng.integers(1, rows + 1)
    matrix = rng.standard_normal((count, n))
    if count > 1:
        matrix[-1] = matrix[0]
    if count:
        one &= qpmhe.Polytope(matrix, matrix @ inside + rng.exponential(size=count))
    return one


@pytest.mark.parametrize(("n", "rows"), [(1, 2), (2, 0), (2, 5), (4, 0), (4, 9)])
@pytest.mark.parametrize("singular", [False, True])
def test_nearest_points(n, rows, singular):
    rng, project = np.random.default_rng([n, rows, singular]), projection(n, rows)
    events = set()
    for _ in range(300):
        convex_set, point = random_set(rng, n, rows), 3.0 * rng.standard_normal(n)
        # In units far apart.
        factor = 10 ** rng.uniform(-4, 4) * rng.standard_normal((n, n - 1 if singular else n))
        covariance = factor @ factor.T
        nearest = NearestPoint(convex_set)
        if nearest.contains(point):
            continue
        expected = nearest(point, covariance)
        found, reached, beyond = project(convex_set, point, covariance)
        assert reached == expected.reached
        np.testing.assert_allclose(found, expected.point, rtol=1e-8, atol=1e-8)
        assert nearest.contains(found)
        if not singular:
            assert beyond == nearest.is_beyond(point, expected.point, covariance)
        events.add(reached)
    assert True in events or (singular and n == 1)
    assert (False in events) == singular


@pytest.mark.parametrize("n", [1, 2, 4])
def test_metrics_settle_at_the_same_states(n):
    rng, project = np.random.default_rng(n), projection(n, 0)
    outcomes = set()
    for k in range(100):
        weight, gain = rng.standard_normal((n, n)), 0.3 * rng.standard_normal((n, 1))
        weight = weight @ weight.T + 0.1 * np.eye(n)
        a, c = rng.standard_normal((n, n)) / np.sqrt(n), rng.standard_normal((1, n))
        if k % 3 == 0 and n > 1:  # a parameter without correction
            a[-1], gain[-1] = np.eye(n)[-1], 0.0
        metric = ErrorMetric(qpmhe.Luenberger(gain), weight, np.ones(1))
        metric.settle(np.zeros(n), a, c, None)
        found = project.metric(gain, weight, a, c)
        assert (found is not None) == metric.settled
        if found is not None:
            size = np.abs(metric.covariance).max()
            np.testing.assert_allclose(found, metric.covariance, rtol=0.0, atol=1e-8 * size)
            assert (np.linalg.eigvalsh(found) > 0.0).all()
        outcomes.add(found is not None)
    assert outcomes == {True, False}
