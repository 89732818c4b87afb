"""Solvers that fail, lie or vandalise: none makes an estimate worse than its candidate."""

import contextlib

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.solvers import Backend, RawSolution, Solver

from .plain import NO_SETS, steps

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


def raising(error):
    def lie(qp, rng):
        raise error

    return lie


def claimed(make, done=True, *more):
    """An answer with the iterate that is made of the QP and random numbers."""
    return lambda qp, rng: RawSolution(make(qp, rng), done, *more)


def scribble(qp, rng):
    """Overwrite everything that was only lent."""
    for array in (qp.band, qp.gradient, qp.lower, qp.upper, qp.row_own, qp.row_next):
        array[...] = rng.standard_normal(array.shape) * 1e3
    return RawSolution(rng.standard_normal(qp.size), True)


def honest(qp, rng):
    return newton(qp)


def noise(qp, rng):
    return rng.standard_normal(qp.size)


def rows(qp):
    return np.zeros(qp.stages * qp.rows)


# Answers that are no iterate at all; `tests/solvers` has many more.
NO_ITERATE = {
    "nan": claimed(lambda qp, rng: np.full(qp.size, np.nan)),
    "one nan": claimed(lambda qp, rng: np.append(newton(qp)[:-1], np.nan), True, 1),
    "nothing": lambda qp, rng: None,
    "too long": claimed(lambda qp, rng: np.append(newton(qp), 0.0)),
    "text": claimed(lambda qp, rng: "solved"),
    "a warning": raising(UserWarning("inaccurate")),
    "an exit": raising(SystemExit(3)),
    "a panic": raising(Panic("called `Option::unwrap()` on a `None` value")),
}

# Iterates that lower J at no step length.
USELESS = {
    "zero, stopped": claimed(lambda qp, rng: np.zeros(qp.size), False),
    "zero, claimed": claimed(lambda qp, rng: np.zeros(qp.size)),
    # Stationarity is met by multipliers of bounds that are not active, or not even there.
    "zero, with made-up multipliers": lambda qp, rng: RawSolution(
        np.zeros(qp.size), True, 1, -qp.gradient.ravel(), rows(qp)
    ),
    "uphill": claimed(lambda qp, rng: -newton(qp)),
    "huge both ways": claimed(lambda qp, rng: 1e200 * (-1.0) ** np.arange(qp.size)),
}

# Good or random iterates with something odd about them; what becomes of them is not fixed.
ODD = {
    "random, claimed optimal": lambda qp, rng: RawSolution(
        noise(qp, rng), True, 1, noise(qp, rng), rng.standard_normal(qp.stages * qp.rows)
    ),
    "outside of the sets": claimed(lambda qp, rng: newton(qp) + 10.0),
    "complex": claimed(lambda qp, rng: newton(qp) + 1j),
    "its own buffer": claimed(lambda qp, rng: np.negative(qp.gradient, out=qp.gradient)),
    "scribbling": scribble,
    "multipliers are text": claimed(honest, True, 1, "none", "none"),
    "multipliers are nan": lambda qp, rng: RawSolution(
        newton(qp), True, 1, np.full(qp.size, np.nan), rows(qp)
    ),
    "count is an array": claimed(honest, True, np.array([3, 1])),
    "message is None": lambda qp, rng: RawSolution(newton(qp), True, message=None),
}


@contextlib.contextmanager
def registered(lie, **methods):
    """A backend that answers with the lie, gone afterwards."""
    rng = np.random.default_rng(3)
    liar = type("Liar", (Solver,), {"_solve": lambda self, qp, start: lie(qp, rng), **methods})
    qpmhe.solvers.register(Backend("liar", liar, "lies", iteration_cap=True))
    try:
        yield
    finally:
        qpmhe.solvers.unregister("liar")


def estimates(sets=False, max_qps=2, backend="liar"):
    """An estimator and its estimates of the record, each held to the promise."""
    system = qpmhe.System(f, h, n=2, p=1, **(SETS if sets else {}))
    mhe = qpmhe.MovingHorizonEstimator(
        system, OBSERVER, COST, horizon=HORIZON, initial_state=[3.0, 0.0], backend=backend,
        max_qps=max_qps,
    )
    return mhe, [*steps(mhe, (f, h), Y, WEIGHTS, tuple(SETS.values()) if sets else NO_SETS)]


sets_or_not = pytest.mark.parametrize("sets", [False, True], ids=["free", "sets"])


@sets_or_not
@pytest.mark.parametrize("lie", [*NO_ITERATE, *USELESS])
def test_no_useful_iterate_leaves_the_candidate_and_says_so(lie, sets):
    with registered((NO_ITERATE | USELESS)[lie]):
        _, found = estimates(sets)
    for estimate in found:
        outside = Status.CANDIDATE_OUTSIDE & estimate.status
        assert Status.CANDIDATE in estimate.status
        if lie in USELESS:
            assert estimate.status & (Status.CAP_REACHED | Status.NO_DECREASE)
            assert Status.CONVERGED not in estimate.status
        else:
            assert estimate.status == Status.CANDIDATE | Status.SOLVER_FAILED | outside
            assert estimate.message
            assert estimate.qps == 1 + bool(outside)  # once more without the violated rows


@pytest.mark.slow
@sets_or_not
@pytest.mark.parametrize("max_qps", [1, None])
@pytest.mark.parametrize("lie", ODD)
def test_an_odd_answer_breaks_nothing(lie, max_qps, sets):
    with registered(ODD[lie]):
        mhe, found = estimates(sets, max_qps)
        mhe.reset()
        assert len(mhe.run(Y)) == len(found)  # its arrays hold the counts
    for estimate in found:
        assert repr(estimate)
        count = estimate.solver_iterations
        assert count is None or isinstance(count, (int, np.integer))
        assert isinstance(estimate.message, str)


def test_an_honest_qp_after_a_lie_is_as_good_as_ever():
    """And is copied: its buffer changes later."""
    _, expected = estimates(max_qps=1, backend="banded")
    turns, buffers, lies = iter(range(STEPS)), [], list(NO_ITERATE.values())

    def now_and_then(qp, rng):
        turn = next(turns)
        if turn % 3:
            return lies[turn % len(lies)](qp, rng)
        for buffer in buffers:
            buffer[...] = np.nan
        buffers.append(newton(qp))
        return RawSolution(buffers[-1], True)

    with registered(now_and_then):
        _, found = estimates(max_qps=1)
    for t in range(0, STEPS, 3):
        assert found[t].improved
        np.testing.assert_allclose(found[t].trajectory, expected[t].trajectory, rtol=1e-9)
        assert not found[t + 1].improved


def test_interrupts_get_through_and_no_other_exit_does():
    with registered(raising(KeyboardInterrupt())), pytest.raises(KeyboardInterrupt):
        estimates()
    shifts = []

    def leave(self, *arguments):
        shifts.append(1)
        raise SystemExit(3)

    with registered(claimed(honest), shift=leave):
        _, found = estimates()
    assert len(shifts) == len(Y) - HORIZON
    assert found[-1].improved
    with registered(honest, solve=leave):
        _, found = estimates()
    assert found[0].status == Status.CANDIDATE | Status.SOLVER_FAILED
    assert "SystemExit" in found[0].message
