"""Snapshots of other estimators and damaged ones are refused whole; a System is never changed."""

import copy

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import InvalidInputError
from qpmhe.estimation.snapshot import read, written

from .test_interrupts import leaves
from .test_own_memory import (
    BOX,
    OPTIONS,
    PYTHON_ONLY,
    assert_same,
    estimator,
    feed,
    numbers,
    samples,
    system_of,
)
from .untraced import untraced

ENGINES = ["numpy", "casadi", "compiled"]
needed = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
engines = pytest.mark.parametrize(
    "engine", ["numpy", "casadi", pytest.param("compiled", marks=needed)]
)


def fed(engine, count=15, **options):
    mhe = estimator(engine, **options)
    for arguments in samples(count):
        feed(mhe, arguments, False)
    return mhe


def cost_of(**changed):
    values = {"prior": np.eye(2), "disturbance": 10.0 * np.eye(2), "noise": np.eye(1)}
    return qpmhe.QuadraticCost(**{**values, **changed})


def other_model(engine, f=1.0, h=0.1):
    if engine == "numpy":
        def rate(x, u):
            return np.stack((x[..., 1], u[..., 0] - f * np.sin(x[..., 0])), axis=-1)

        return qpmhe.System.from_ode(
            rate, lambda x, u: x[..., :1] + h * x[..., :1] ** 2, dt=0.1, n=2, p=1, m=1,
            method="euler",
        )
    ca = pytest.importorskip("casadi")
    return qpmhe.from_casadi(
        lambda x, u: [x[1], u[0] - f * ca.sin(x[0])], lambda x, u: x[0] + h * x[0] ** 2, dt=0.1,
        method="euler", n=2, m=1,
    )


def others(engine):
    """Estimators that differ in one thing, with the word that must name it."""
    def made(system=None, observer=None, cost=None, **options):
        return qpmhe.MovingHorizonEstimator(
            system or other_model(engine), observer or qpmhe.Luenberger([0.3, 0.4]),
            cost or cost_of(), **{
                "horizon": 4, "initial_state": [0.5, 0.0],
                "engine": engine if engine == "compiled" else "python",
            } | options,
        )

    box = {"states": qpmhe.Box([-5.0, -5.0], [5.0, 5.0])}
    return made, {
        "cost.prior": made(cost=cost_of(prior=1.1 * np.eye(2))),
        "cost.disturbance": made(cost=cost_of(disturbance=9.0 * np.eye(2))),
        "cost.noise": made(cost=cost_of(noise=1.001 * np.eye(1))),
        "cost.discount": made(cost=cost_of(discount=0.9)),
        "observer.gain": made(observer=qpmhe.Luenberger([0.3, 0.41])),
        f"set of {'disturbances' if engine == 'compiled' else 'states'}": made(
            system_of(engine, box)
        ),
        "model": made(other_model(engine, f=1.001)),
        "(h)": made(other_model(engine, h=0.1001)),
        "candidate": made(candidate="reinitialized"),
        "expected": made(horizon=5),
    }


@engines
@pytest.mark.parametrize("count", [0, 1, 15])
def test_the_state_of_another_estimator_is_refused_by_name(engine, count):
    state = fed(engine, count).state_dict()
    for name, mhe in others(engine)[1].items():
        for arguments in samples(3):
            feed(mhe, arguments, False)
        before = mhe.state
        with pytest.raises(InvalidInputError) as error:
            mhe.load_state_dict(copy.deepcopy(state))
        assert name in str(error.value), (name, str(error.value))
        np.testing.assert_array_equal(mhe.state, before)
        assert mhe.time == 3


@engines
def test_what_the_description_does_not_show_shows_in_the_stages(engine):
    """With the description taken away, the second computation of the stages tells."""
    state = read(fed(engine).state_dict())
    made, found = others(engine)
    for name in ("cost.disturbance", "cost.noise", "observer.gain", "model", "(h)"):
        mhe = found[name]
        described = read(mhe.state_dict())["estimator"]
        with pytest.raises(InvalidInputError, match="another"):
            mhe.load_state_dict(written({**state, "estimator": described}))
    made().load_state_dict(written(state))


def test_other_observers_losses_and_corrections_are_refused():
    names = ("prior", "disturbance", "noise")

    def kalman(scale):
        return qpmhe.ExtendedKalman(
            **dict(zip(names, (scale * np.eye(2), np.eye(2), np.eye(1)), strict=True))
        )

    def huber(threshold):
        return qpmhe.RobustCost(
            prior=np.eye(2), disturbance=np.eye(2), noise=qpmhe.Huber([[1.0]], threshold)
        )

    def injection(gain):
        return qpmhe.OutputInjection(lambda z, v: gain * np.tanh(v[0]) * np.ones(2))

    def made(observer, cost):
        return qpmhe.MovingHorizonEstimator(
            system_of("numpy"), observer, cost, horizon=4, initial_state=[0.5, 0.0]
        )

    plain = cost_of()
    for one, another in (
        (made(kalman(1.0), plain), made(kalman(1.1), plain)),
        (made(injection(0.3), plain), made(injection(0.31), plain)),
        (made(kalman(1.0), huber(1.0)), made(kalman(1.0), huber(1.5))),
        (made(qpmhe.Luenberger([0.3, 0.4]), plain), made(injection(0.3), plain)),
        (made(kalman(1.0), plain), made(qpmhe.Luenberger([0.3, 0.4]), plain)),
        (made(kalman(1.0), plain), made(kalman(1.0), huber(1.0))),
    ):
        for arguments in samples(9):
            feed(one, arguments, False)
        with pytest.raises(InvalidInputError, match=r"another (observer|cost|weight)"):
            another.load_state_dict(one.state_dict())
        assert another.time == 0


@engines
def test_caps_and_policies_may_change(engine):
    """The observer's part is the same then; terms that were not there are computed."""
    own = engine if engine == "compiled" else "python"
    made = others(engine)[0]
    for first, second in (
        ({"max_qps": 0}, {"max_qps": 2}), ({"max_qps": 3}, {"max_qps": 0}),
        ({}, {"max_qps": None, "tolerance": 1e-6, "solver_tolerance": 1e-5, "delay": 1}),
        ({}, {"backend": "banded", "max_solver_iterations": 7}),
        ({}, {"warm_start": True, "max_qps": None}),
        ({"infeasible": "keep_candidate"}, {"infeasible": "drop_rows"}),
    ):
        one, other, fresh = made(**first), made(**second), made(**second)
        assert other.engine == own
        record = samples(20)
        for arguments in record[:12]:
            feed(one, arguments, False)
            feed(fresh, arguments, False)
        other.load_state_dict(one.state_dict())
        for arguments in record[12:]:
            found, expected = feed(other, arguments, False), feed(fresh, arguments, False)
            np.testing.assert_allclose(found.candidate, expected.candidate, rtol=1e-12)
            np.testing.assert_allclose(found.trajectory, expected.trajectory, rtol=1e-6, atol=1e-7)
            assert found.cost <= found.candidate_cost


# The System


def test_estimators_of_one_system_do_not_change_each_other():
    def f(x):
        return 0.9 * x

    def branching(x):  # decides for a batch by its first state
        return x[..., :1] * (1.0 if np.ravel(x)[0] < 1.5 else 1.1)

    def made(system):
        return qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([[0.3], [0.1]]), cost_of(), horizon=4,
            initial_state=[1.0, 1.0],
        )

    system = qpmhe.System(f, branching, n=2, p=1)
    calling = system.call_modes()
    one, other, alone = made(system), made(system), made(qpmhe.System(f, branching, n=2, p=1))
    generator = np.random.default_rng(0)
    state = read(made(system).state_dict())
    state["modes"], state["methods"] = ["looped"] * 2, ["finite differences"] * 2
    for t in range(40):
        y = generator.uniform(0.0, 4.0, 1)
        found, expected = other.update(y), alone.update(y)
        assert_same(numbers(found), numbers(expected))
        one.update(generator.uniform(0.0, 4.0, 1))
        if t % 10 == 5:
            one.load_state_dict(written(state))
            one.reset([1.4, 1.0])
        assert system.call_modes() == calling


def test_a_system_is_as_it_was_made():
    def bent(x):  # the complex step is right on one side only
        return np.where(x.real < 50.0, x, np.abs(x))

    system = qpmhe.System(untraced(bent), lambda x: x[..., :1], n=2, p=1)
    for start in ([1.0, 1.0], [80.0, 90.0]):
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([[0.3], [0.1]]), cost_of(), horizon=3, initial_state=start
        )
    assert mhe._own_system.f_jacobian.method == "finite differences"
    assert system.f_jacobian.method == "complex step"
    assert mhe.system is system


# Damage


def leaves_of(value, path=()):
    items = (
        value.items() if isinstance(value, dict)
        else enumerate(value) if isinstance(value, (list, tuple)) else ()
    )
    found = [path] if path else []
    for key, item in items:
        found += leaves_of(item, (*path, key))
    return found


def replaced(value, path, new):
    if not path:
        return new
    if isinstance(value, dict):
        return {k: replaced(v, path[1:], new) if k == path[0] else v for k, v in value.items()}
    return type(value)(
        replaced(v, path[1:], new) if k == path[0] else v for k, v in enumerate(value)
    )


def at(value, path):
    for key in path:
        value = value[key]
    return value


OWN = {"noise_weight": np.eye(1)}
JUNK = [
    None, 3, -1, 2**70, 0.5, np.nan, True, "text", "", b"bytes", [], (), {}, [1, 2], [[1, 2], [3]],
    {"a": 1}, object(), np.zeros(0), np.zeros((3, 3)), np.array(1.25), np.array(["a"]),
    np.full(2, np.nan), np.array([None, 1]),
]


def mutated(state, generator):
    """A state with some part of it replaced, and whether that can be told."""
    paths = leaves_of(state)
    path = paths[generator.integers(len(paths))]
    old, kind = at(state, path), generator.integers(5)
    if isinstance(old, np.ndarray) and kind:
        new = old.copy()
        if kind == 1 and old.ndim:
            new = new[:-1] if old.shape[0] else np.zeros((1, *old.shape[1:]), old.dtype)
        elif kind == 2:
            new = new.astype(np.float32 if old.dtype == np.float64 else np.int64)
        elif kind == 3 and new.size and new.dtype == np.float64:
            new.flat[generator.integers(new.size)] = generator.choice([np.nan, np.inf, -7.0])
        elif new.size:
            k = generator.integers(new.size)
            new.flat[k] = ~new.flat[k] if new.dtype != np.float64 else 1.5 * new.flat[k] + 0.1
    elif isinstance(old, (list, tuple)) and kind == 1 and old:
        new = type(old)(old[:-1])
    elif isinstance(old, dict) and kind == 1 and old:
        new = dict(list(old.items())[:-1])
    elif isinstance(old, int) and kind == 1:
        new = old + int(generator.integers(1, 50)) * (1 if generator.random() < 0.5 else -1)
    else:
        new = JUNK[generator.integers(len(JUNK))]
    return path, replaced(state, path, new)


def cases():
    for engine in ENGINES:
        names = OPTIONS if engine == "compiled" else OPTIONS | PYTHON_ONLY
        for name in ("plain", "reinitialized", "dropped", "robust", "kalman"):
            if name in names:
                yield pytest.param(
                    engine, names[name], id=f"{engine}-{name}",
                    marks=needed if engine == "compiled" else (),
                )


@pytest.mark.parametrize(("engine", "options"), list(cases()))
def test_damaged_states_are_refused_whole_or_harmless(engine, options):
    mhe, generator = fed(engine, 11, **options), np.random.default_rng(3)
    twin, refused = fed(engine, 11, **options), 0
    state = read(fed(engine, 15, **options).state_dict())
    for _ in range(400):
        path, damaged = mutated(state, generator)
        if leaves(damaged) == leaves(state):
            continue
        try:
            mhe._engine.load_state_dict(damaged)
        except InvalidInputError:
            refused += 1
        else:
            # What no computation confirms: estimates of the past, the covariance at the
            # window's start, and what a model that failed had before.
            assert path[0] in (
                "history", "trajectory", "watched", "modes", "memory", "methods", "linearized"
            ) or (
                path[:2] in (
                    ("window", "earlier"), ("window", "earlier_covariance"),
                    ("window", "time"), ("window", "covariance"), ("window", "y"), ("window", "u"),
                    ("window", "irregular"),
                    ("window", "linear"), ("window", "panel"), ("window", "gradient"),
                    ("window", "next_gradient"),
                )
            ), path
            mhe.update(np.zeros(1), np.zeros(1))
            mhe._engine.load_state_dict(state)
            mhe = fed(engine, 11, **options)
        np.testing.assert_array_equal(mhe.state, twin.state)
        assert mhe.time == twin.time
    assert refused > 280
    for arguments in samples(8, 4):
        assert_same(numbers(feed(mhe, arguments, False)), numbers(feed(twin, arguments, False)))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("modes",), [[1, 2], [3]]), (("modes",), ["batched", "mixed"]), (("modes",), "ab"),
        (("modes",), ["batched"]), (("methods",), ["given", "given"]),
        (("window", "own"), None), (("window", "own"), {-3: OWN}),
        (("window", "own"), {14: {"noise_weight": -np.eye(1)}}),
        (("window", "own"), {14: {"noise_weight": np.eye(2)}}),
        (("window", "own"), {14: {"noise_weight": 3.0}}), (("window", "own"), {14: []}),
        (("window", "own"), {14: {"sampled": np.ones(2, np.bool_)}}),
        (("window", "own"), {14: {"parameters": np.ones(1)}}),
        (("window", "own"), {14: {"states": {"lower": np.zeros(2)}}}),
        (("window", "own"), {14: {"colour": np.zeros(2)}}), (("usual",), None), (("usual",), []),
        (("usual",), {"disturbance_weight": np.eye(1)}),
        (("usual",), {"noise_weight": 3.0 * np.eye(1)}),
        (("window", "time"), -1), (("window", "time"), 3), (("window", "time"), 15.0),
        (("window", "z"), np.full((5, 2), np.nan)),
        (("window", "z"), np.zeros((5, 2))), (("window", "z"), np.zeros((5, 2), np.float32)),
        (("window", "weights"), []),
        (("trajectory",), None), (("linearized",), 1), (("watched",), (0, 16)),
        (("watched",), (-1, 0)), (("watched",), (0.0, 0)), (("estimator",), None),
        (("estimator",), {}),
        (("engine",), "compiled"), (("problem",), (2, 1)),
    ],
    ids=str,
)
def test_damage_that_was_seen(path, value):
    state, mhe = read(fed("numpy").state_dict()), fed("numpy", 6)
    before = mhe.state
    with pytest.raises(InvalidInputError, match="the state is"):
        mhe._engine.load_state_dict(
            {**state, path[0]: value} if len(path) == 1 else replaced(state, path, value)
        )
    assert (mhe.time, mhe.state.tolist()) == (6, before.tolist())


def test_a_covariance_where_the_observer_has_none():
    state = read(fed("numpy").state_dict())
    state["window"]["covariance"] = np.zeros((5, 2, 2))
    with pytest.raises(InvalidInputError, match="another observer"):
        fed("numpy").load_state_dict(written(state))


@pytest.mark.parametrize("engine", ["numpy", pytest.param("compiled", marks=needed)])
@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0 + 1e-4, 2.0, np.inf, -1.0])
def test_altered_costs_of_stages_are_refused(engine, factor):
    mhe = fed(engine)
    state = mhe.state_dict()
    if engine == "compiled":
        state["memory"].view(mhe._engine._memory.dtype)[0]["stages"]["cost"][2] *= factor
    else:
        state["window/costs"][2] *= factor
    with pytest.raises(InvalidInputError):
        mhe.load_state_dict(state)


def test_a_system_with_sets_and_one_without():
    assert BOX["states"].dimension == 2
    state = fed("numpy", sets=BOX).state_dict()
    with pytest.raises(InvalidInputError, match="set of states"):
        estimator("numpy").load_state_dict(state)
