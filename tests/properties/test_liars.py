"""Solvers that fail, lie or vandalise: none makes an estimate worse than its candidate."""

import contextlib

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.solvers import Backend, RawSolution, Solver

from .plain import true_cost

STEPS, HORIZON = 12, 5
_, OBSERVER, COST, SCENARIO = qpmhe.models.batch_reactor()
WEIGHTS = (COST.prior, COST.disturbance, COST.noise)
Y = SCENARIO.simulate(11, STEPS).measurements
SETS = {
    "states": qpmhe.Box([0.0, -1.0], [6.0, 6.0]),
    "disturbances": qpmhe.Box([-0.5, -0.5], [0.5, 0.5]),
    "noises": qpmhe.Box(-6.0, 6.0),
}


def f(x):
    reaction = 0.16 * x[..., 0] ** 2 - 0.64 * x[..., 1]
    return x + 0.1 * np.stack([-2.0 * reaction, reaction], axis=-1)


def h(x):
    return x[..., :1] + x[..., 1:]


def newton(qp):
    """The honest answer of a QP without inequalities."""
    return -np.linalg.solve(qp.dense(), qp.gradient.ravel())


class Panic(BaseException):
    """What extension modules written in Rust raise: not an Exception."""


class Hostile:
    """An object that cannot be looked at."""

    def __getattr__(self, name):
        raise RuntimeError("do not look")


def raising(error):
    def lie(qp, rng):
        raise error

    return lie


def scribble(qp, rng):
    """Overwrite everything that was only lent."""
    for array in (qp.band, qp.gradient, qp.lower, qp.upper, qp.row_own, qp.row_next):
        array[...] = rng.standard_normal(array.shape) * 1e3
    return RawSolution(rng.standard_normal(qp.size), True)


# Answers that are no iterate at all.
NO_ITERATE = {
    "nan": lambda qp, rng: RawSolution(np.full(qp.size, np.nan), True),
    "one nan": lambda qp, rng: RawSolution(np.append(newton(qp)[:-1], np.nan), True, 1),
    "infinite": lambda qp, rng: RawSolution(np.full(qp.size, -np.inf), True),
    "nothing": lambda qp, rng: None,
    "no iterate": lambda qp, rng: RawSolution(None, True),
    "an array": lambda qp, rng: newton(qp),
    "too short": lambda qp, rng: RawSolution(newton(qp)[:-1], True),
    "too long": lambda qp, rng: RawSolution(np.append(newton(qp), 0.0), True),
    "a number": lambda qp, rng: RawSolution(0.0, True),
    "text": lambda qp, rng: RawSolution("solved", True),
    "ragged": lambda qp, rng: RawSolution([[1.0], [2.0, 3.0]], True),
    "a hostile object": lambda qp, rng: RawSolution(Hostile(), True),
    "KeyError": raising(KeyError("P")),
    "ZeroDivisionError": raising(ZeroDivisionError()),
    "MemoryError": raising(MemoryError()),
    "RecursionError": raising(RecursionError()),
    "StopIteration": raising(StopIteration()),
    "a qpmhe error": raising(qpmhe.QpmheError("mine")),
    "a warning": raising(UserWarning("inaccurate")),
    "an exit": raising(SystemExit(3)),
    "the exit of a generator": raising(GeneratorExit()),
    "a panic": raising(Panic("called `Option::unwrap()` on a `None` value")),
}

# Iterates that lower J at no step length.
USELESS = {
    "zero, stopped": lambda qp, rng: RawSolution(np.zeros(qp.size), False),
    "zero, claimed": lambda qp, rng: RawSolution(np.zeros(qp.size), True),
    "zero, with multipliers": lambda qp, rng: RawSolution(
        np.zeros(qp.size), True, 1, np.zeros(qp.size), np.zeros(qp.stages * qp.rows)
    ),
    # Stationarity is met by multipliers of bounds that are not active, or not even there.
    "zero, with made-up multipliers": lambda qp, rng: RawSolution(
        np.zeros(qp.size), True, 1, -qp.gradient.ravel(), np.zeros(qp.stages * qp.rows)
    ),
    "uphill": lambda qp, rng: RawSolution(-newton(qp), True),
    "a little uphill": lambda qp, rng: RawSolution(1e-3 * qp.gradient.ravel(), True, 10**9),
    "huge": lambda qp, rng: RawSolution(np.full(qp.size, 1e300), True),
    "huge both ways": lambda qp, rng: RawSolution(
        1e200 * (-1.0) ** np.arange(qp.size), True
    ),
}

# Good or random iterates with something odd about them; what becomes of them is not fixed.
ODD = {
    "random": lambda qp, rng: RawSolution(rng.standard_normal(qp.size), True),
    "random, claimed optimal": lambda qp, rng: RawSolution(
        rng.standard_normal(qp.size), True, 1, rng.standard_normal(qp.size),
        rng.standard_normal(qp.stages * qp.rows),
    ),
    "outside of the sets": lambda qp, rng: RawSolution(newton(qp) + 10.0, True),
    "far too long": lambda qp, rng: RawSolution(40.0 * newton(qp), True),
    "complex": lambda qp, rng: RawSolution(newton(qp) + 1j, True),
    "a list": lambda qp, rng: RawSolution(list(newton(qp)), True),
    "integers": lambda qp, rng: RawSolution(np.ones(qp.size, dtype=int), True),
    "in another shape": lambda qp, rng: RawSolution(newton(qp)[None, :, None], True),
    "its own buffer": lambda qp, rng: RawSolution(np.negative(qp.gradient, out=qp.gradient), True),
    "scribbling": scribble,
    "multipliers are text": lambda qp, rng: RawSolution(newton(qp), True, 1, "none", "none"),
    "multipliers are ragged": lambda qp, rng: RawSolution(newton(qp), True, 1, [[1], [2, 3]]),
    "multipliers are nan": lambda qp, rng: RawSolution(
        newton(qp), True, 1, np.full(qp.size, np.nan), np.zeros(qp.stages * qp.rows)
    ),
    "count is text": lambda qp, rng: RawSolution(newton(qp), True, "many"),
    "count is nan": lambda qp, rng: RawSolution(newton(qp), True, float("nan")),
    "count is an array": lambda qp, rng: RawSolution(newton(qp), True, np.array([3, 1])),
    "claim is an array": lambda qp, rng: RawSolution(newton(qp), np.array([True, False])),
    "claim is text": lambda qp, rng: RawSolution(newton(qp), "no"),
    "message is None": lambda qp, rng: RawSolution(newton(qp), True, message=None),
    "count is of numpy": lambda qp, rng: RawSolution(newton(qp), True, np.int64(3)),
}


@contextlib.contextmanager
def registered(lie):
    """A backend that answers with the lie, gone afterwards."""

    class Liar(Solver):
        def _solve(self, qp, start):
            return lie(qp, self.rng)

        rng = np.random.default_rng(3)

    qpmhe.solvers.register(Backend("liar", Liar, "lies", iteration_cap=True))
    try:
        yield
    finally:
        qpmhe.solvers.unregister("liar")
    assert "liar" not in qpmhe.solvers.available()


def estimator(backend, sets, **options):
    system = qpmhe.System(f, h, n=2, p=1, **(SETS if sets else {}))
    options = {"max_qps": 2, **options}
    return qpmhe.MovingHorizonEstimator(
        system, OBSERVER, COST, horizon=HORIZON, initial_state=[3.0, 0.0], backend=backend,
        **options,
    )


def run(mhe):
    """Take the record step by step, holding every estimate to the promise."""
    estimates = []
    for t, y in enumerate(Y):
        estimate = mhe.update(y)
        estimates.append(estimate)
        assert estimate.time == t
        assert estimate.cost <= estimate.candidate_cost
        assert np.isfinite(estimate.trajectory).all()
        window = Y[max(0, t + 1 - HORIZON) : t + 1]
        prior = estimate.candidate[0]
        true, slack = true_cost(f, h, estimate.trajectory, prior, window, WEIGHTS)
        assert abs(estimate.cost - true) <= 1e-9 * true + slack
        if estimate.improved and mhe.system.states and not estimate.dropped:
            for box, values in zip(
                SETS.values(),
                (estimate.trajectory, estimate.disturbances, estimate.noises),
                strict=True,
            ):
                assert (values >= box.lower - 1e-8).all()
                assert (values <= box.upper + 1e-8).all()
    return estimates


sets_or_not = pytest.mark.parametrize("sets", [False, True], ids=["free", "sets"])


@sets_or_not
@pytest.mark.parametrize("lie", NO_ITERATE)
def test_no_iterate_leaves_the_candidate_and_says_so(lie, sets):
    with registered(NO_ITERATE[lie]):
        estimates = run(estimator("liar", sets))
    for estimate in estimates:
        outside = Status.CANDIDATE_OUTSIDE & estimate.status
        assert estimate.status == Status.CANDIDATE | Status.SOLVER_FAILED | outside
        assert estimate.message
        assert estimate.qps == 1 + bool(outside)  # once more without the rows that are violated
        assert estimate.trajectory.tolist() == estimate.candidate.tolist()


@sets_or_not
@pytest.mark.parametrize("lie", USELESS)
def test_a_useless_iterate_leaves_the_candidate_and_says_so(lie, sets):
    with registered(USELESS[lie]):
        estimates = run(estimator("liar", sets))
    for estimate in estimates:
        assert Status.CANDIDATE in estimate.status
        assert Status.NO_DECREASE in estimate.status
        assert Status.CONVERGED not in estimate.status
        assert estimate.trajectory.tolist() == estimate.candidate.tolist()


@sets_or_not
@pytest.mark.parametrize("max_qps", [1, None])
@pytest.mark.parametrize("lie", ODD)
def test_an_odd_answer_breaks_nothing(lie, max_qps, sets):
    with registered(ODD[lie]):
        mhe = estimator("liar", sets, max_qps=max_qps)
        estimates = run(mhe)
        mhe.reset()
        record = mhe.run(Y)  # whose arrays hold the counts
    assert len(record) == len(estimates)
    for estimate in estimates:
        assert repr(estimate)
        count = estimate.solver_iterations
        assert count is None or isinstance(count, (int, np.integer))
        assert isinstance(estimate.message, str)


@pytest.mark.parametrize("lie", [k for k in NO_ITERATE if k != "a panic"])
def test_an_honest_qp_after_a_lie_is_as_good_as_ever(lie):
    # Nothing is carried from one estimate to the next: after a lie comes what would have come.
    honest = run(estimator("banded", False, max_qps=1))
    turn = iter(range(STEPS))

    def now_and_then(qp, rng):
        if next(turn) % 3 == 0:
            return RawSolution(newton(qp), True)
        return NO_ITERATE[lie](qp, rng)

    with registered(now_and_then):
        estimates = run(estimator("liar", False, max_qps=1))
    for t in range(0, STEPS, 3):
        assert estimates[t].improved
        np.testing.assert_allclose(estimates[t].trajectory, honest[t].trajectory, rtol=1e-9)
        assert not estimates[t + 1].improved


def test_an_iterate_in_a_buffer_that_changes_later_is_copied():
    buffers = []

    def reusing(qp, rng):
        for buffer in buffers:
            buffer[...] = np.nan
        buffers.append(newton(qp))
        return RawSolution(buffers[-1], True)

    with registered(reusing):
        estimates = run(estimator("liar", False))
    honest = run(estimator("banded", False))
    for one, other in zip(estimates, honest, strict=True):
        np.testing.assert_allclose(one.trajectory, other.trajectory, rtol=1e-9)


def test_interrupts_get_through():
    with registered(raising(KeyboardInterrupt())), pytest.raises(KeyboardInterrupt):
        estimator("liar", False).update(Y[0])


@pytest.mark.parametrize("error", [RuntimeError("stuck"), SystemExit(3)], ids=repr)
def test_a_solver_that_cannot_follow_the_window_does_not_stop_a_step(error):
    shifts = []

    class Stuck(Solver):
        def _solve(self, qp, start):
            return qpmhe.solvers.create("banded")._solve(qp, start)

        def shift(self):
            shifts.append(1)
            raise error

    qpmhe.solvers.register(Backend("stuck", Stuck, "stuck"))
    try:
        estimates = run(estimator("stuck", False))
    finally:
        qpmhe.solvers.unregister("stuck")
    assert len(shifts) == len(Y) - HORIZON
    assert estimates[-1].improved


def test_a_solver_that_leaves_from_a_solve_of_its_own_does_not_stop_a_step():
    class Leaving(Solver):
        def _solve(self, qp, start):
            raise NotImplementedError

        def solve(self, qp, start=None):
            raise SystemExit(3)

    qpmhe.solvers.register(Backend("leaving", Leaving, "leaving"))
    try:
        estimate = estimator("leaving", False).update(Y[0])
    finally:
        qpmhe.solvers.unregister("leaving")
    assert estimate.status == Status.CANDIDATE | Status.SOLVER_FAILED
    assert "SystemExit" in estimate.message
