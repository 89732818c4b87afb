"""Observers in C: the Kalman filter, weights of the prior, projections onto X and their metrics."""

import ctypes
import functools

import numpy as np
import pytest
from oracles.test_kalman import Plant, distance, kalman

import qpmhe
from qpmhe import codegen
from qpmhe.codegen.compiler import compiled_library, find_compiler
from qpmhe.codegen.layout import Layout
from qpmhe.codegen.source import estimator_files
from qpmhe.observers.projection import ErrorMetric, NearestPoint

from .cases import case

ca = pytest.importorskip("casadi")
pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")


def linear(plant):
    """The plant's system by CasADi."""
    x, u = ca.SX.sym("x", len(plant.A)), ca.SX.sym("u", plant.B.shape[1])
    f, h = (
        ca.DM(M) @ x + ca.DM(N) @ u if u.numel() else ca.DM(M) @ x
        for M, N in ((plant.A, plant.B), (plant.C, plant.D))
    )
    given = [x, u] if u.numel() else [x]
    return qpmhe.from_casadi(
        ca.Function("f", given, [f]), ca.Function("h", given, [h]), compiled=False
    )


@pytest.mark.parametrize("make", [qpmhe.ExtendedKalman, qpmhe.UnscentedKalman])
@pytest.mark.parametrize("horizon", [1, 2, 5, 20])
@pytest.mark.parametrize("missing", [False, True], ids=["complete", "missing"])
@pytest.mark.parametrize("radius", [0.8, 1.15], ids=["stable", "unstable"])
def test_every_horizon_gives_the_kalman_predictor_and_filter(make, radius, missing, horizon):
    n, p = {1: (1, 2), 2: (2, 2), 5: (3, 1), 20: (2, 2)}[horizon]
    plant = Plant(100 * n + p, n, p, radius, m=n % 3, missing=missing)
    predicted, filtered, _ = kalman(plant)
    covariances = {"disturbance": plant.Q, "noise": plant.R}
    mhe = qpmhe.MovingHorizonEstimator(
        linear(plant), make(prior=plant.P, **covariances),
        qpmhe.QuadraticCost.from_covariances(prior=qpmhe.ObserverPrior(), **covariances),
        horizon=horizon, initial_state=plant.z0, engine="compiled",
    )
    assert mhe.engine == "compiled"
    run = mhe.run(plant.Y, plant.inputs())
    assert distance(run.states, np.array([x for x, _ in predicted])) < 1e-9
    assert distance(run.filtered, np.array([x for x, _ in filtered])) < 1e-9
    P = predicted[-1][1]
    np.testing.assert_allclose(mhe.covariances()[-1], P, rtol=0.0, atol=1e-8 * np.abs(P).max())


HOOKS = {
    "weigh": """
void weigh(const mhe_covariances *o, const real *covariance, real *weight)
{
    real P[NX * NX];
    memcpy(P, covariance, sizeof P);
    mhe_weight_of(o, P, weight);
}
""",
    "project": """
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
""",
}


@functools.cache
def hooked(hook, n, rows=None):
    """A library with functions of the step as they are, and its settings."""
    x = ca.SX.sym("x", n)
    system = qpmhe.from_casadi(
        ca.Function("f", [x], [x]), ca.Function("h", [x], [x[0]]), compiled=False
    )
    filters = {"observer": 1, "covariance": True, "observer_prior": True}
    layout = Layout(
        n, 1, 0, 1, ((False, 0), (False, 0), (rows is not None, rows or 0)), 0,
        **filters if hook == "weigh" else {},
    )
    settings = np.zeros((), layout.settings_type())
    files = estimator_files(system.symbolic, layout, settings)
    files["mhe.c"] += HOOKS[hook]
    return compiled_library(files, "mhe.c"), settings


def called(function, *arrays):
    kept = [np.ascontiguousarray(one) for one in arrays]
    return function(*(ctypes.c_void_p(one.ctypes.data) for one in kept))


def weight(covariance, rule):
    """The weight of the prior in C."""
    library, settings = hooked("weigh", len(covariance))
    own = settings["covariances"].copy()
    own["least"] = 1e-12
    own["minimum"], own["maximum"] = rule.bounds or (0.0, 0.0)
    found = np.zeros_like(covariance)
    called(library.weigh, own, covariance, found)
    return found


def correlated(rng, n, smallest):
    """Correlations with eigenvalues from about one down to ``smallest``."""
    values = np.append(np.geomspace(1.0, max(smallest, 0.1), n - 1), smallest if n > 1 else 1.0)
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    matrix = (basis * values) @ basis.T
    deviations = np.sqrt(matrix.diagonal())
    return matrix / np.outer(deviations, deviations)


@pytest.mark.parametrize("n", [1, 2, 3, 7, 12])
def test_the_weight_of_the_prior(n):
    """Whatever the units; as exact as the covariance's own rounding lets it be."""
    rule, eps = qpmhe.ObserverPrior(), np.finfo(float).eps
    for smallest in (0.1, 1e-4, 1e-9, 1e-11, 0.0):
        rng = np.random.default_rng([n, int(1e12 * smallest)])
        for _ in range(10):
            units = 10.0 ** rng.uniform(-6.0, 6.0, n)
            covariance = np.outer(units, units) * correlated(rng, n, smallest)
            covariance = 0.5 * (covariance + covariance.T)
            found, expected = weight(covariance, rule), rule.weight(covariance)
            np.testing.assert_array_equal(found, found.T)
            scale = np.outer(1.0 / units, 1.0 / units)
            least = max(smallest, 1e-12) if n > 1 else 1.0
            allowed = max(1e-12, 200.0 * eps / least) * np.abs(expected / scale).max()
            np.testing.assert_allclose(found / scale, expected / scale, rtol=0.0, atol=allowed)


@pytest.mark.parametrize("n", [1, 2, 3, 7, 12])
def test_the_weight_of_the_prior_in_bounds(n):
    rng = np.random.default_rng(n)
    for bounds in ((1e-3, 1e3), (0.5, 2.0), (1e-9, 1e9), (1.0, 1.0001)):
        rule = qpmhe.ObserverPrior(*bounds)
        for smallest, size in ((0.5, 1e-4), (1e-2, 1.0), (1e-6, 1e4), (0.0, 1.0)):
            covariance = size * correlated(rng, n, smallest)
            found, close = weight(covariance, rule), 1e-9 * bounds[1]
            np.testing.assert_allclose(found, rule.weight(covariance), rtol=0.0, atol=close)
            values = np.linalg.eigvalsh(found)
            assert values[0] >= bounds[0] * (1.0 - 1e-6) - 1e-12 * bounds[1]
            assert values[-1] <= bounds[1] * (1.0 + 1e-9)


def project(convex_set, rows, point, covariance):
    """The nearest point in C, whether the metric led there, and whether that is beyond the set."""
    n = point.size
    library, settings = hooked("project", n, rows)
    part, rows = settings["states"], len(convex_set.matrix)
    part["lower"], part["upper"] = convex_set.lower, convex_set.upper
    part["rows"], part["row_lower"], part["row_upper"] = 0.0, -np.inf, np.inf
    part["rows"][: rows * n] = convex_set.matrix.ravel()
    part["row_lower"][:rows], part["row_upper"][:rows] = convex_set.row_lower, convex_set.row_upper
    out, beyond = np.zeros(n), np.zeros(1, np.int32)
    reached = called(library.project, settings, covariance, point, out, beyond)
    return out, bool(reached), bool(beyond[0])


def random_set(rng, n, rows):
    """A box, a polytope or both, with a point inside; some without width or repeated."""
    inside = rng.standard_normal(n)
    lower, upper = inside - rng.exponential(size=n), inside + rng.exponential(size=n)
    lower[rng.random(n) < 0.3], upper[rng.random(n) < 0.3] = -np.inf, np.inf
    kind = rng.integers(3) if rows else 0
    if kind == 1:
        lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    one = qpmhe.Box(lower, upper)
    matrix = rng.standard_normal((0 if kind == 0 else rng.integers(1, rows + 1), n))
    if len(matrix) > 1:
        matrix[-1] = matrix[0]
    if len(matrix):
        one &= qpmhe.Polytope(matrix, matrix @ inside + rng.exponential(size=len(matrix)))
    return one


def test_nearest_points():
    for n, rows in ((1, 2), (2, 5), (4, 9)):
        for singular in (False, True):
            check_nearest_points(n, rows, singular)


def check_nearest_points(n, rows, singular):
    rng, events = np.random.default_rng([n, rows, singular]), set()
    for _ in range(120):
        convex_set, point = random_set(rng, n, rows), 3.0 * rng.standard_normal(n)
        # In units far apart.
        factor = 10 ** rng.uniform(-4, 4) * rng.standard_normal((n, n - 1 if singular else n))
        covariance = factor @ factor.T
        nearest = NearestPoint(convex_set)
        if nearest.contains(point):
            continue
        expected = nearest(point, covariance)
        found, reached, beyond = project(convex_set, rows, point, covariance)
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
    rng, outcomes = np.random.default_rng(n), set()
    library, settings = hooked("project", n, 0)
    for k in range(100):
        weight, gain = rng.standard_normal((n, n)), 0.3 * rng.standard_normal((n, 1))
        weight = weight @ weight.T + 0.1 * np.eye(n)
        a, c = rng.standard_normal((n, n)) / np.sqrt(n), rng.standard_normal((1, n))
        if k % 3 == 0 and n > 1:  # a parameter without correction
            a[-1], gain[-1] = np.eye(n)[-1], 0.0
        metric = ErrorMetric(qpmhe.Luenberger(gain), weight, np.ones(1))
        metric.settle(np.zeros(n), a, c, None)
        settings["gain"], settings["metric_weight"] = gain.ravel(), weight.ravel()
        found = np.zeros((n, n))
        assert bool(called(library.settle, settings, a, c, found)) == metric.settled
        if metric.settled:
            size = np.abs(metric.covariance).max()
            np.testing.assert_allclose(found, metric.covariance, rtol=0.0, atol=1e-8 * size)
            assert (np.linalg.eigvalsh(found) > 0.0).all()
        outcomes.add(metric.settled)
    assert outcomes == {True, False}


def test_the_header_names_the_observer(tmp_path):
    header, source = codegen.write(case("unscented prior").estimator("python"), tmp_path)
    assert "MHE_OBSERVER 2" in header.read_text()
    assert "MHE_COVARIANCE 1" in header.read_text()
    assert ".spread = 1.7320508" in source.read_text()
    header, _ = codegen.write(case("reactor").estimator("python"), tmp_path)
    assert "MHE_COVARIANCE 0" in header.read_text()
