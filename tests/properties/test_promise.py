"""J is never above the candidate's and the sets hold, on whatever system, data and solver."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import qpmhe
from qpmhe import Status

from .plain import observer_path, steps

pytestmark = pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
# Additions to a linear model of x, its linear part and another linear function.
KINDS = {
    "linear": lambda x, linear, inner: linear,
    "smooth": lambda x, linear, inner: linear + 0.5 * np.sin(inner),
    "kinked": lambda x, linear, inner: linear + np.abs(inner) - 0.3 * np.maximum(x, 0.5),
    "cubic": lambda x, linear, inner: linear + 0.3 * x**3,
    "exponential": lambda x, linear, inner: linear + 0.1 * np.exp(np.abs(inner)),
    "branching": lambda x, linear, inner: -0.5 * linear if x[0] < -0.2 else linear,
    "raising": lambda x, linear, inner: linear + 0.1 * np.tanh(inside(x, inner)),
}
SPECIALS = (np.nan, np.inf, -np.inf, 1e3, -1e6, 1e30, 1e200)


def inside(x, inner):
    if np.abs(x).max() > 3.0:
        raise ValueError("outside of the model's domain")
    return inner


def weight(rng, size):
    factor = rng.standard_normal((size, size))
    scales = 10.0 ** rng.uniform(-1.5, 1.5, size)
    return (factor @ factor.T + 0.1 * np.eye(size)) * np.sqrt(np.outer(scales, scales))


def one_state(g):
    def single(x):
        if x.ndim != 1:
            raise TypeError("a function of one state")
        return g(x)

    return single


class Case:
    """A random system with sets, weights, a gain and a record, all from a few numbers.

    The plain loops call `f` and `h` with one state at a time. The library gets them as they
    are, which most of them can take with leading dimensions, or in a form that refuses those.
    """

    def __init__(self, seed, n, p, kind, as_it_is, boxes, growth, specials, steps):
        rng = np.random.default_rng(seed)
        A, B = rng.standard_normal((2, n, n))
        C, D = rng.standard_normal((2, p, n))
        A *= growth / np.sqrt(n)
        self.f = lambda x: KINDS[kind](x, x @ A.T, x @ B.T)
        self.h = lambda x: x @ C.T + np.cos(0.3 * x @ D.T) - 1.0
        self.gain = rng.standard_normal((n, p)) * rng.choice([0.0, 0.1, 0.5])
        self.weights = tuple(weight(rng, size) for size in (n, n, p))
        self.z0 = np.clip(rng.standard_normal(n), -2.9, 2.9)  # a model is defined there
        self.Y = rng.standard_normal((steps, p)) * rng.choice([0.1, 1.0, 5.0])
        for t, j, value in specials:
            self.Y[t % steps, j % p] = value
        sizes = rng.choice([0.0, 0.3, 2.0], size=(3, 2)) + 0.05
        bounds = (self.z0 - sizes[0, 0], self.z0 + 2 * sizes[0, 1])
        self.sets = (
            qpmhe.Box(*bounds) if boxes[0] else None,
            qpmhe.Box(np.full(n, -sizes[1, 0]), np.full(n, sizes[1, 1])) if boxes[1] else None,
            qpmhe.Box(np.full(p, -3 * sizes[2, 0]), np.full(p, np.inf)) if boxes[2] else None,
        )
        form = (lambda g: g) if as_it_is and kind != "branching" else one_state
        names = ("states", "disturbances", "noises")
        self.system = qpmhe.System(
            form(self.f), form(self.h), n=n, p=p, **dict(zip(names, self.sets, strict=True))
        )

    def check(self, horizon, max_qps, **options):
        """Run the record, and hold every step to the promise."""
        prior, disturbance, noise = self.weights
        mhe = qpmhe.MovingHorizonEstimator(
            self.system, qpmhe.Luenberger(self.gain),
            qpmhe.QuadraticCost(prior=prior, disturbance=disturbance, noise=noise),
            horizon=horizon, initial_state=self.z0, max_qps=max_qps, **options,
        )
        model, failed, given = (self.f, self.h), Status(0), self.Y.copy()
        with np.errstate(all="ignore"):
            for t, estimate in enumerate(steps(mhe, model, self.Y, self.weights, self.sets)):
                failed |= estimate.status & (Status.MODEL_FAILED | Status.OBSERVER_PROJECTED)
                if failed:
                    continue
                path = observer_path(*model, self.gain, self.z0, self.Y[: t + 1])
                own = path[max(0, t + 1 - horizon) :]
                # With QPs the model is traced, which may round sums in another order.
                if max_qps == 0:
                    assert estimate.candidate.tolist() == own.tolist()
                size = 1e-9 * float(np.abs(path).max())
                np.testing.assert_allclose(estimate.candidate, own, rtol=0.0, atol=size)
        np.testing.assert_array_equal(self.Y, given)


special = st.tuples(st.integers(0, 7), st.integers(0, 1), st.sampled_from(SPECIALS))


@pytest.mark.shortened
@pytest.mark.parametrize("backend", qpmhe.solvers.available())
@settings(derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    # The structure is drawn, the coefficients come from a drawn seed.
    case=st.builds(
        Case, seed=st.integers(0, 10_000), n=st.integers(1, 3), p=st.integers(1, 2),
        kind=st.sampled_from([*KINDS]), as_it_is=st.booleans(),
        boxes=st.tuples(st.booleans(), st.booleans(), st.booleans()),
        growth=st.sampled_from([0.5, 0.95, 1.3, 5.0]), specials=st.lists(special, max_size=3),
        steps=st.integers(1, 8),
    ),
    horizon=st.integers(1, 6),
    max_qps=st.sampled_from([0, 1, 2, 5, None]),
    max_solver_iterations=st.sampled_from([1, 3, 10]),
)
def test_promise(backend, case, horizon, max_qps, max_solver_iterations):
    case.check(
        horizon, max_qps, backend=backend, max_solver_iterations=max_solver_iterations
    )
