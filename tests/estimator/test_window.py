import math

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.estimation.linearization import StageTerms
from qpmhe.estimation.window import Window

from .plain import spd

NONE = np.zeros(0)


def nonlinear(n, p, m, seed=0):
    generator = np.random.default_rng(seed)
    a, b = 0.6 * generator.standard_normal((n, n)), generator.standard_normal((n, max(m, 1)))
    c = generator.standard_normal((p, n))
    if m:
        return qpmhe.System(
            lambda x, u: np.sin(x @ a.T) + 0.5 * x + u @ b.T,
            lambda x, u: x @ c.T + 0.1 * np.cos(x[..., :1]) * u[..., :1], n=n, p=p, m=m,
        )
    return qpmhe.System(
        lambda x: np.sin(x @ a.T) + 0.5 * x, lambda x: x @ c.T + 0.1 * np.cos(x[..., :1]), n=n, p=p
    )


def observer_of(kind, n, p):
    generator = np.random.default_rng(7)
    gain = 0.1 * generator.standard_normal((n, p))
    if kind == "luenberger":
        return qpmhe.Luenberger(gain)
    if kind == "injection":
        return qpmhe.OutputInjection(lambda z, v: np.tanh(gain @ v) / (1.0 + z**2))
    return qpmhe.ExtendedKalman(
        prior=spd(generator, n), disturbance=spd(generator, n), noise=spd(generator, p)
    )


class Case:
    """A window with the record that goes into it and the observer kept in plain lists."""

    def __init__(self, kind, horizon, missing=0.0, sizes=(2, 2, 0)):
        self.n, self.p, self.m = sizes
        generator = np.random.default_rng(11)
        self.system = nonlinear(*sizes)
        self.observer = observer_of(kind, self.n, self.p)
        self.cost = qpmhe.QuadraticCost(
            prior=spd(generator, self.n), disturbance=spd(generator, self.n),
            noise=spd(generator, self.p),
        )
        self.horizon = horizon
        self.pushes = 2 * max(64, horizon) + horizon + 10
        self.ys = generator.standard_normal((self.pushes, self.p))
        self.us = generator.standard_normal((self.pushes, self.m))
        self.ys[generator.random(self.ys.shape) < missing] = np.nan
        start = generator.standard_normal(self.n)
        self.z = [start]
        self.covariances = [self.observer.initial_covariance()]
        self.corrections, self.errors, self.jacobians, self.weights = [], [], [], []
        self.window = Window(self.system, self.observer, self.cost, horizon, start, True, True)

    def push(self):
        """Push the next sample into the window and the lists."""
        t, system = len(self.z) - 1, self.system
        z, y, u = self.z[t], self.ys[t], self.us[t]
        there = ~np.isnan(y)
        error = np.where(there, y - system.h(z, u), 0.0)
        a, c = system.f_jacobian(z, u), system.h_jacobian(z, u)
        sample = qpmhe.Sample(
            system, u, f_jacobian=a, h_jacobian=c, observed=None if there.all() else there,
            covariance=self.covariances[t],
        )
        correction, covariance = self.observer.correct(z, error, sample)
        self.z.append(system.f(z, u) + correction)
        self.covariances.append(covariance)
        self.corrections.append(correction)
        self.errors.append(error)
        self.jacobians.append(np.vstack([a, c]))
        self.weights.append(self.cost.partial_weight(there))
        self.window.push(y, u)
        assert self.window.events == (0 if there.all() else Status.MISSING.value)

    def pushed(self):
        """Push everything, yielding the time and the first stage of the window."""
        for t in range(1, self.pushes + 1):
            self.push()
            yield t, max(0, t - self.horizon)

    def due(self, t):
        """Whether to look closely: early on, and around the slides to the front."""
        return t < 4 or t % 41 == 0 or (t - self.horizon) % max(64, self.horizon) < 2


@pytest.mark.parametrize("horizon", [1, 5, 90])
@pytest.mark.parametrize("missing", [0.0, 0.02])
@pytest.mark.parametrize("kind", ["luenberger", "injection", "kalman"])
def test_kept_terms_equal_terms_built_afresh(kind, horizon, missing):
    case = Case(kind, horizon, missing)
    window, n = case.window, case.n
    fresh = StageTerms(horizon, n, case.p)
    for t, first in case.pushed():
        if not case.due(t):
            continue
        count, z = t - first, window.candidate
        for k in range(count):
            u = window.inputs[k]
            fresh.linear[k, :n, 1:] = -case.system.f_jacobian(z[k], u)
            fresh.linear[k, n:, 1:] = -case.system.h_jacobian(z[k], u)
        residuals = np.array(
            [
                [*(z[k + 1] - case.system.f(z[k], u)), *(window.measurements[k]
                 - case.system.h(z[k], u)) * window.observed[k]]
                for k, u in enumerate(window.inputs)
            ]
        )
        weights = np.broadcast_to(window.stage_weights, (count, n + case.p, n + case.p))
        fresh.residuals[:count] = residuals
        fresh.set_all(count, weights)
        kept = slice(window.start, window.start + count)
        for name in ("linear", "panel", "gradient", "next_gradient"):
            np.testing.assert_allclose(
                getattr(window.terms, name)[kept], getattr(fresh, name)[:count],
                rtol=1e-12, atol=1e-12, err_msg=f"{name} at {t}",
            )


@pytest.mark.parametrize("horizon", [1, 3])
@pytest.mark.parametrize("sizes", [(1, 1, 0), (2, 2, 0), (3, 2, 1), (2, 1, 3)])
def test_terms_equal_plain_loops(sizes, horizon):
    case = Case("luenberger", horizon, 0.02, sizes)
    window, n, terms = case.window, case.n, case.window.terms
    for t, first in case.pushed():
        if not case.due(t):
            continue
        for k in range(first, t):
            weight, jacobian = case.weights[k], case.jacobians[k]
            residual = np.concatenate([case.corrections[k], case.errors[k]])
            place = window.start + k - first
            square, below = jacobian.T @ weight @ jacobian, -weight[:n, :n] @ jacobian[:n]
            blocks = np.vstack([square, below])
            for column in range(n):
                panel = np.zeros(2 * n)
                panel[: 2 * n - column] = blocks[column:, column]
                np.testing.assert_allclose(
                    terms.panel[place, column], panel, rtol=1e-12, atol=1e-12
                )
            np.testing.assert_allclose(
                terms.gradient[place], -jacobian.T @ weight @ residual, rtol=1e-12, atol=1e-12
            )
            np.testing.assert_allclose(
                terms.next_gradient[place], weight[:n, :n] @ residual[:n], rtol=1e-12, atol=1e-12
            )


@pytest.mark.parametrize("horizon", [1, 5, 90])
@pytest.mark.parametrize("missing", [0.0, 0.02])
@pytest.mark.parametrize("kind", ["luenberger", "injection", "kalman"])
def test_the_candidate_obeys_the_observer_bit_for_bit(kind, horizon, missing):
    case = Case(kind, horizon, missing, (3, 2, 1))
    window, n = case.window, case.n
    for t, first in case.pushed():
        np.testing.assert_array_equal(window.candidate, case.z[first : t + 1])
        if not case.due(t):
            continue
        np.testing.assert_array_equal(window.residuals[:, :n], case.corrections[first:t])
        np.testing.assert_array_equal(window.residuals[:, n:], case.errors[first:t])
        for k, (z, u) in enumerate(zip(window.candidate[:-1], window.inputs, strict=True)):
            following = case.system.f(z, u) + window.residuals[k, :n]
            np.testing.assert_array_equal(window.candidate[k + 1], following)


@pytest.mark.parametrize("horizon", [1, 2, 5, 64, 90])
def test_bookkeeping(horizon):
    case = Case("kalman", horizon, 0.02, (2, 2, 1))
    window = case.window
    assert (window.time, window.length) == (0, 0)
    np.testing.assert_array_equal(window.candidate, [case.z[0]])
    assert window.candidate_cost == 0.0
    for t, first in case.pushed():
        count = t - first
        assert (window.time, window.length) == (t, count)
        assert count == min(t, horizon)
        assert window.candidate.shape == (count + 1, 2)
        seen = ~np.isnan(case.ys[first:t])
        np.testing.assert_array_equal(window.observed, seen)
        np.testing.assert_array_equal(window.measurements[seen], case.ys[first:t][seen])
        assert np.isfinite(window.measurements).all()
        np.testing.assert_array_equal(window.inputs, case.us[first:t])
        np.testing.assert_array_equal(window.prior_covariance, case.covariances[first])
        assert window.has_special_weights is bool((~seen).any())
        weights = np.broadcast_to(window.stage_weights, (count, 4, 4))
        np.testing.assert_allclose(weights, case.weights[first:t], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("horizon", [1, 4, 90])
@pytest.mark.parametrize("missing", [0.0, 0.05])
def test_the_candidate_cost_is_the_sum_over_the_stages(horizon, missing):
    case = Case("luenberger", horizon, missing)
    for t, first in case.pushed():
        if not case.due(t):
            continue
        total = 0.0
        for k in range(first, t):
            residual = np.concatenate([case.corrections[k], case.errors[k]])
            for i, left in enumerate(residual):
                for j, right in enumerate(residual):
                    total += left * case.weights[k][i, j] * right
        assert case.window.candidate_cost == pytest.approx(total, rel=1e-11)


@pytest.mark.parametrize("horizon", [1, 2, 5, 64])
@pytest.mark.parametrize("when", [0, 1, 63, 64, 68, 130])
def test_a_missing_sample_is_known_while_it_stays(horizon, when):
    case = Case("luenberger", horizon)
    case.ys[when, 1] = np.nan
    for t in range(1, 140):
        case.push()
        assert (case.window.events == Status.MISSING.value) is (t == when + 1)
        assert case.window.has_special_weights is (max(0, t - horizon) <= when < t)
        assert case.window.stage_weights.ndim == (3 if case.window.has_special_weights else 2)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", ["luenberger", "injection", "kalman"])
def test_a_sample_without_any_output_is_predicted(kind, bad):
    case = Case(kind, 5)
    window, system = case.window, case.system
    for _ in range(3):
        case.push()
    cost = window.candidate_cost
    with np.errstate(invalid="ignore"):
        window.push(np.full(2, bad), NONE)
    assert window.events == Status.MISSING.value
    np.testing.assert_array_equal(window.candidate[-1], system.f(window.candidate[-2], NONE))
    np.testing.assert_array_equal(window.residuals[-1], np.zeros(4))
    assert window.candidate_cost == cost


@pytest.mark.parametrize("horizon", [1, 3, 90])
def test_windows_for_the_observer_alone_give_the_same_candidate(horizon):
    case = Case("luenberger", horizon, 0.02)
    plain = Window(case.system, case.observer, case.cost, horizon, case.z[0], False, True)
    for t, _ in case.pushed():
        plain.push(case.ys[t - 1], NONE)
        np.testing.assert_array_equal(plain.candidate, case.window.candidate)
        assert plain.candidate_cost == pytest.approx(case.window.candidate_cost, rel=1e-13)


def test_the_samples_are_copied():
    case = Case("luenberger", 3, sizes=(2, 2, 1))
    y, u = np.array([1.0, 2.0]), np.array([3.0])
    case.window.push(y, u)
    y[0], u[0] = 9.0, 9.0
    np.testing.assert_array_equal(case.window.measurements, [[1.0, 2.0]])
    np.testing.assert_array_equal(case.window.inputs, [[3.0]])


# A model that cannot be evaluated at some stage


def root_or_nan(x):
    return np.sqrt(x)


def root_or_raise(x):
    return np.array([math.sqrt(x[0])])


def failing_window(root, where, horizon=3, kind="luenberger"):
    """A window on a system whose f or h is a square root: no value for x < 0."""
    functions = {"f": lambda x: 0.5 * x, "h": lambda x: x}
    functions[where] = root
    system = qpmhe.System(
        functions["f"], functions["h"], n=1, p=1,
        f_jacobian=lambda x: np.array([[0.5]]) if where == "h" else 0.5 / np.sqrt(x)[..., None],
        h_jacobian=lambda x: np.array([[1.0]]) if where == "f" else 0.5 / np.sqrt(x)[..., None],
    )
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=2.0, noise=3.0)
    observer = qpmhe.Luenberger([1.0])
    if kind == "kalman":
        observer = qpmhe.ExtendedKalman(prior=1.0, disturbance=1.0, noise=0.1)
    return Window(system, observer, cost, horizon, np.array([4.0]), True, True)


@pytest.mark.parametrize("kind", ["luenberger", "kalman"])
@pytest.mark.parametrize("where", ["f", "h"])
@pytest.mark.parametrize("root", [root_or_nan, root_or_raise])
def test_a_failed_stage_steps_back_and_costs_infinitely(root, where, kind):
    window = failing_window(root, where, kind=kind)
    with np.errstate(invalid="ignore"):
        for y in (4.0, -500.0):
            window.push(np.array([y]), NONE)
            assert window.events == 0
        below = window.candidate[-1].copy()
        assert below[0] < 0.0
        assert math.isfinite(window.candidate_cost)
        window.push(np.array([1.0]), NONE)
        assert window.newest_failed
        assert window.events == Status.MODEL_FAILED.value
        # From there on, the observer goes on where the model last worked.
        np.testing.assert_array_equal(window.candidate[-2:], [below, window.candidate[1]])
        assert window.candidate_cost == math.inf
        assert (window.time, window.length) == (3, 3)
        np.testing.assert_array_equal(window.measurements[-1], [1.0])
        window.restart(np.array([4.0]))
        np.testing.assert_array_equal(window.candidate[-1], [4.0])
        for left in (True, True, False):
            window.push(np.array([4.0]), NONE)
            assert window.events == 0
            assert (window.candidate_cost == math.inf) is left
    kept = slice(window.start, window.start + 3)
    assert all(
        np.isfinite(getattr(window.terms, name)[kept]).all() for name in ("panel", "gradient")
    )


def flat_root():
    """A system that has a value everywhere it goes, but no slope at 0."""
    system = qpmhe.System(
        lambda x: np.sqrt(x), lambda x: x, n=1, p=1,
        f_jacobian=lambda x: 0.5 / np.sqrt(x)[..., None], h_jacobian=lambda x: np.eye(1),
    )
    return system, qpmhe.QuadraticCost(prior=1.0, disturbance=2.0, noise=3.0)


def test_a_stage_without_jacobian_keeps_its_residual_and_cost():
    system, cost = flat_root()
    window = Window(system, qpmhe.Luenberger([0.5]), cost, 4, np.zeros(1), True, True)
    with np.errstate(all="ignore"):
        window.push(np.array([1.0]), NONE)
    assert window.events == Status.MODEL_FAILED.value
    assert not window.newest_failed
    np.testing.assert_array_equal(window.candidate, [[0.0], [0.5]])
    np.testing.assert_array_equal(window.residuals, [[0.5, 1.0]])
    assert window.candidate_cost == 2.0 * 0.5**2 + 3.0 * 1.0**2
    assert np.isfinite(window.terms.panel[:1]).all()


def test_the_candidate_cost_is_true_after_a_stage_without_jacobian():
    system, cost = flat_root()
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.5]), cost, horizon=4, initial_state=[0.0]
    )
    ys = [1.0, 1.2, 1.1]
    for t, y in enumerate(ys):
        estimate = mhe.update([y])
        z = estimate.candidate[:, 0]
        true = sum(
            2.0 * (z[i + 1] - math.sqrt(z[i])) ** 2 + 3.0 * (ys[i] - z[i]) ** 2
            for i in range(t + 1)
        )
        assert estimate.candidate_cost == pytest.approx(true, rel=1e-12)
        assert estimate.cost <= true * (1 + 1e-12)
