"""J is never above the candidate's and the sets hold, on whatever system, data and solver."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import qpmhe
from qpmhe import Status

from .plain import keeps_promise, observer_path

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
KINDS = ("linear", "smooth", "kinked", "cubic", "exponential", "raising", "branching")
SPECIALS = (np.nan, np.inf, -np.inf, 1e3, -1e6, 1e30, 1e200)


class Case:
    """A random system with sets, weights, a gain and a record, all from a few numbers.

    The plain loops call `f` and `h` with one state at a time. The library gets them as they
    are, which most of them can take with leading dimensions, or in a form that refuses those.
    """

    def __init__(self, seed, n, p, kind, as_it_is, boxes, growth, specials, steps):
        rng = np.random.default_rng(seed)
        self.n, self.p, self.kind = n, p, kind
        self.A = rng.standard_normal((n, n)) * growth / np.sqrt(n)
        self.B, self.C = rng.standard_normal((n, n)), rng.standard_normal((p, n))
        self.D = 0.3 * rng.standard_normal((p, n))
        self.gain = rng.standard_normal((n, p)) * rng.choice([0.0, 0.1, 0.5])
        self.weights = tuple(_weight(rng, size) for size in (n, n, p))
        self.z0 = rng.standard_normal(n)
        self.Y = rng.standard_normal((steps, p)) * rng.choice([0.1, 1.0, 5.0])
        for t, j, value in specials:
            self.Y[t % steps, j % p] = value
        center, sizes = self.z0, rng.choice([0.0, 0.3, 2.0], size=(3, 2)) + 0.05
        bounds = (center - sizes[0, 0], center + 2 * sizes[0, 1])
        self.sets = (
            qpmhe.Box(*bounds) if boxes[0] else None,
            qpmhe.Box(np.full(n, -sizes[1, 0]), np.full(n, sizes[1, 1])) if boxes[1] else None,
            qpmhe.Box(np.full(p, -3 * sizes[2, 0]), np.full(p, np.inf)) if boxes[2] else None,
        )
        form = (lambda g: g) if as_it_is and kind != "branching" else _one_state
        self.system = qpmhe.System(
            form(self.f), form(self.h), n=n, p=p,
            states=self.sets[0], disturbances=self.sets[1], noises=self.sets[2],
        )
        self.cost = qpmhe.QuadraticCost(
            prior=self.weights[0], disturbance=self.weights[1], noise=self.weights[2]
        )

    def f(self, x):
        linear, inner = x @ self.A.T, x @ self.B.T
        if self.kind == "linear":
            return linear
        if self.kind == "smooth":
            return linear + 0.5 * np.sin(inner)
        if self.kind == "kinked":
            return linear + np.abs(inner) - 0.3 * np.maximum(x, 0.5)
        if self.kind == "cubic":
            return linear + 0.3 * x**3
        if self.kind == "exponential":
            return linear + 0.1 * np.exp(np.abs(inner))
        if self.kind == "raising" and np.abs(x).max() > 3.0:
            raise ValueError("outside of the model's domain")
        if self.kind == "branching" and x[0] < -0.2:
            return -0.5 * linear
        return linear + 0.1 * np.tanh(inner)

    def h(self, x):
        return x @ self.C.T + np.cos(x @ self.D.T) - 1.0

    def estimator(self, horizon, **options):
        return qpmhe.MovingHorizonEstimator(
            self.system, qpmhe.Luenberger(self.gain), self.cost, horizon=horizon,
            initial_state=self.z0, **options,
        )


def _weight(rng, size):
    factor = rng.standard_normal((size, size))
    scales = 10.0 ** rng.uniform(-1.5, 1.5, size)
    return (factor @ factor.T + 0.1 * np.eye(size)) * np.sqrt(np.outer(scales, scales))


def _one_state(g):
    def single(x):
        if x.ndim != 1:
            raise TypeError("a function of one state")
        return g(x)

    return single


def check(case, horizon, **options):
    """Run the record, and hold every step to the promise."""
    mhe = case.estimator(horizon, **options)
    failed = False
    with np.errstate(all="ignore"):
        for t, y in enumerate(case.Y):
            given_y = y.copy()
            estimate = mhe.update(y)
            np.testing.assert_array_equal(y, given_y)
            other = Status.MODEL_FAILED | Status.OBSERVER_PROJECTED
            failed = failed or bool(estimate.status & other)
            first = max(0, t + 1 - horizon)
            Y = case.Y[first : t + 1]
            keeps_promise(case.f, case.h, estimate, Y, case.weights, case.sets)
            if not failed:
                path = observer_path(case.f, case.h, case.gain, case.z0, case.Y[: t + 1])
                # With QPs the model is traced, which may round sums in another order.
                if options.get("max_qps") == 0:
                    assert estimate.candidate.tolist() == path[first:].tolist()
                size = 1e-9 * float(np.abs(path).max())
                np.testing.assert_allclose(estimate.candidate, path[first:], rtol=0.0, atol=size)


@st.composite
def cases(draw):
    """A case; its structure is drawn, its coefficients come from a drawn seed."""
    special = st.tuples(st.integers(0, 7), st.integers(0, 1), st.sampled_from(SPECIALS))
    return Case(
        seed=draw(st.integers(0, 10_000)),
        n=draw(st.integers(1, 3)),
        p=draw(st.integers(1, 2)),
        kind=draw(st.sampled_from(KINDS)),
        as_it_is=draw(st.booleans()),
        boxes=draw(st.tuples(st.booleans(), st.booleans(), st.booleans())),
        growth=draw(st.sampled_from([0.5, 0.95, 1.3, 5.0])),
        specials=draw(st.lists(special, max_size=3)),
        steps=draw(st.integers(1, 8)),
    )


@pytest.mark.parametrize("backend", qpmhe.solvers.available())
@settings(derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    case=cases(),
    horizon=st.integers(1, 6),
    max_qps=st.sampled_from([0, 1, 2, 5, None]),
    max_solver_iterations=st.sampled_from([1, 3, 10]),
)
def test_promise(backend, case, horizon, max_qps, max_solver_iterations):
    check(
        case, horizon, backend=backend, max_qps=max_qps,
        max_solver_iterations=max_solver_iterations,
    )
