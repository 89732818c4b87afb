"""Batches of estimators against single ones, member by member and step by step."""

import math

import numpy as np
import pytest
from oracles.systems import SYSTEMS

import qpmhe
from qpmhe import Status
from qpmhe.batch import BatchEstimator
from qpmhe.errors import OptionError, QpmheError, ShapeError, UnknownOptionError

from .plain import spd

A = np.array([[1.0, 0.1], [-0.1, 0.95]])
GAIN = np.array([[0.3], [0.2]])


def f(x):
    return x @ A.T


def h(x):
    return x[..., :1]


def parts(f=f, h=h, gain=GAIN, n=2, p=1, discount=1.0, **system):
    cost = qpmhe.QuadraticCost(
        prior=10.0 * np.eye(n), disturbance=100.0 * np.eye(n), noise=25.0 * np.eye(p),
        discount=discount,
    )
    return qpmhe.System(f, h, n=n, p=p, **system), qpmhe.Luenberger(gain), cost


def same(found, expected, label, tolerance=1e-10):
    """Equal up to a share of each member's largest number; infinite at the same places."""
    found, expected = np.asarray(found), np.asarray(expected)
    finite = np.isfinite(expected)
    assert found.shape == expected.shape, label
    assert np.array_equal(np.isfinite(found), finite), label
    size = np.where(finite, np.abs(expected), 0.0).reshape(len(expected), -1).max(axis=1)
    allowed = tolerance * size.reshape(-1, *[1] * (expected.ndim - 1)) + 1e-15
    with np.errstate(invalid="ignore"):
        off = np.argwhere((np.abs(found - expected) > allowed) & finite)
    assert not off.size, f"{label}: {off[0]}"


def compare(
    parts, Y, U=None, *, starts, horizon=5, mode="looped", before=None, tolerance=1e-10,
    **options,
):
    """Run a batch beside single estimators; the estimates of the batch.

    ``before(t)`` is called before the step of time t, once for the batch and once for each
    single estimator.
    """
    members, steps = Y.shape[:2]
    before = before or (lambda t: None)
    batch = BatchEstimator(
        *parts, members=members, horizon=horizon, initial_states=starts, **options
    )
    assert batch.mode == mode
    singles = [
        qpmhe.MovingHorizonEstimator(*parts, horizon=horizon, initial_state=start, **options)
        for start in np.broadcast_to(starts, (members, batch.system.n))
    ]
    collected = []
    for t in range(steps):
        before(t)
        estimate = batch.update(Y[:, t], None if U is None else U[..., t, :])
        assert batch.time == estimate.time + 1 == t + 1
        singly = []
        for k, single in enumerate(singles):
            before(t)
            u = None if U is None else np.broadcast_to(U, (members, *U.shape[-2:]))[k, t]
            singly.append(single.update(Y[k, t], u))
        assert estimate.statuses == [one.status for one in singly], t
        assert estimate.qps.tolist() == [one.qps for one in singly], t
        assert estimate.improved.tolist() == [one.improved for one in singly], t
        for several, name in (
            (estimate.candidates, "candidate"), (estimate.trajectories, "trajectory"),
            (estimate.states, "state"), (estimate.filtered, "filtered"), (batch.states, "state"),
            (estimate.costs, "cost"), (estimate.candidate_costs, "candidate_cost"),
        ):
            same(
                several, [getattr(one, name) for one in singly], f"{name} at time {t}", tolerance
            )
        if singly[0].delayed is None:
            assert estimate.delayed is None
        else:
            same(estimate.delayed, [one.delayed for one in singly], f"delayed at time {t}")
        collected.append(estimate)
    return collected


def flags_seen(estimates):
    seen = Status(0)
    for estimate in estimates:
        for status in estimate.statuses:
            seen |= status
    return seen


def case_records(case, members, steps):
    return np.array([case.record(seed, steps) for seed in range(members)])


def spoilt(Y, generator):
    """Components, whole samples and a whole member's measurements that are not there."""
    Y = Y.copy()
    Y[generator.random(Y.shape) < 0.15] = np.nan
    Y[generator.random(Y.shape[:2]) < 0.1] = np.nan
    Y[0, 2:6] = [np.inf]
    if Y.shape[0] > 1:
        Y[1] = np.nan
    Y[-1, 7, 0] = -1e200
    return Y


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize(
    "options", [{"max_qps": 0}, {}, {"max_qps": 3}, {"max_qps": None}], ids=str
)
def test_systems(name, options):
    case = SYSTEMS[name]()
    Y = case_records(case, 4, 20)
    one = (
        qpmhe.System(case.f, case.h, n=case.n, p=case.p), qpmhe.Luenberger(case.gain), case.cost
    )
    estimates = compare(one, Y, starts=case.start, horizon=case.horizon, **options)
    assert estimates[-1].improved.all() == (options.get("max_qps") != 0)


@pytest.mark.parametrize("members", [1, 2, 7])
@pytest.mark.parametrize(
    ("horizon", "steps", "max_qps"), [(1, 20, None), (4, 150, 2), (70, 75, 1)]
)
def test_numbers_of_members_and_lengths_of_windows(members, horizon, steps, max_qps):
    # Windows of one sample, beyond the length of the arrays twice, and growing for long.
    reactor = qpmhe.models.batch_reactor()
    Y = np.array([reactor.scenario.simulate(seed, steps).measurements for seed in range(members)])
    starts = np.random.default_rng(1).uniform(0.5, 4.0, (members, 2))
    compare(reactor[:3], Y, starts=starts, horizon=horizon, max_qps=max_qps, delay=1)


@pytest.mark.parametrize("members", [1, 2, 7])
@pytest.mark.parametrize("options", [{"max_qps": 0}, {}, {"max_qps": 3}], ids=str)
@pytest.mark.parametrize("discount", [1.0, 0.8])
def test_missing_measurements(members, options, discount):
    generator = np.random.default_rng(5)
    weights = {"prior": spd(generator, 4), "disturbance": spd(generator, 4)}
    cost = qpmhe.QuadraticCost(**weights, noise=spd(generator, 2), discount=discount)
    case = SYSTEMS["tracking"]()
    one = qpmhe.System(case.f, case.h, n=4, p=2), qpmhe.Luenberger(case.gain), cost
    Y = spoilt(case_records(case, members, 25), generator)
    estimates = compare(one, Y, starts=case.start, **options)
    assert Status.MISSING in flags_seen(estimates)


@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
def test_a_large_measurement_is_missing_only_where_its_cost_overflows():
    Y = np.zeros((3, 12, 1))
    Y[0, 4], Y[1, 5], Y[2, 6] = 1.1e150, 1e160, 1e140
    estimates = compare(parts(), Y, starts=[0.5, 0.0])
    statuses = [[Status.MISSING in one for one in e.statuses] for e in estimates]
    assert np.argwhere(statuses).tolist() == [[5, 1]]
    # Where another component's does, those with a finite square stay.
    Y = np.zeros((2, 12, 2))
    Y[0, 4], Y[1, 5] = [1e149, 1e170], [1e151, 1e170]
    compare(parts(h=lambda x: x, gain=0.1 * np.eye(2), p=2), Y, starts=[0.5, 0.0])


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("start", [False, True])
def test_inputs(shared, start):
    def driven(x, u):
        return np.sin(x @ A.T) + u @ np.array([[0.3, 0.1], [0.0, 0.2], [0.1, -0.1]])

    def output(x, u):
        return x[..., :1] * (1.0 + 0.1 * u[..., :1])

    generator = np.random.default_rng(3)
    Y = generator.standard_normal((3, 20, 1))
    U = generator.standard_normal((20, 3) if shared else (3, 20, 3))
    if not shared:
        U[1, 5] = np.nan
    estimates = compare(
        parts(driven, output, m=3), Y, U, starts=generator.standard_normal((3, 2)), max_qps=2,
        warm_start=start,
    )
    assert (Status.MODEL_FAILED in flags_seen(estimates)) != shared






def strict(x):
    """Raises for a whole batch where one of it is negative."""
    with np.errstate(all="raise"):
        root = np.sqrt(x)
    return x + 0.1 * np.stack([0.4 - 0.4 * root[..., 0], 0.4 * (root[..., 0] - root[..., 1])], -1)


def plain(x):
    """One state at a time, which raises where it is negative."""
    first, second = math.sqrt(x[0]), math.sqrt(x[1])
    return [x[0] + 0.1 * (0.4 - 0.4 * first), x[1] + 0.1 * 0.4 * (first - second)]


def silent(x):
    """NaN where the state is negative."""
    root = np.sqrt(x)
    return x + 0.1 * np.stack([0.4 - 0.4 * root[..., 0], 0.4 * (root[..., 0] - root[..., 1])], -1)


def logarithm(x):
    return np.stack([x[..., 0], 0.9 * x[..., 1] + 0.1 * np.log(x[..., 0])], axis=-1)












class Slope:
    """The Jacobian of f, which can be spoilt where x_1 > 1 once the model is made."""

    def __init__(self, how):
        self.how, self.spoilt = how, False

    def __call__(self, x):
        value = np.broadcast_to(A, (*x.shape[:-1], 2, 2)).copy()
        if self.spoilt:
            far = x[..., 0] > 1.0
            if self.how == "raises" and far.any():
                raise ZeroDivisionError
            value[far] *= {"raises": 1.0, "nan": np.nan}.get(self.how, self.how)
        return value












class Reused:
    """A function that returns one array for all values of a shape, once the model is made."""

    def __init__(self, function):
        self.function, self.kept, self.begun = function, {}, False

    def __call__(self, x):
        value = self.function(x)
        if not self.begun:
            return value
        out = self.kept.setdefault((value.shape, value.dtype), np.empty_like(value))
        out[...] = value
        return out


def constant_slope(x):
    return np.broadcast_to(A, (*x.shape[:-1], 2, 2))






SETS = {"states": qpmhe.Box([-9.0, -9.0], [9.0, 9.0])}
LOOPED = {
    "sets": (SETS, {}, "sets"),
    "backend": ({}, {"backend": "daqp"}, "daqp"),
    "reinitialized": ({}, {"candidate": "reinitialized"}, "reinitialized"),
    "exact": ({}, {"subproblem": "exact"}, "exact"),
    "budget": ({}, {"time_budget": 100.0}, "time budget"),
}




@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_models_and_steps_in_c(engine):
    pytest.importorskip("casadi")
    from qpmhe.codegen.compiler import find_compiler
    from qpmhe.models.batch_reactor import casadi_output, casadi_rate

    if find_compiler() is None:
        pytest.skip("no C compiler")
    reactor = qpmhe.models.batch_reactor()
    system = qpmhe.from_casadi(casadi_rate, casadi_output, dt=0.1, method="euler", n=2)
    Y = np.array([reactor.scenario.simulate(seed, 25).measurements for seed in range(4)])
    Y[2, 3] = np.nan
    mode = "looped" if engine == "python" else "compiled"
    compare((system, *reactor[1:3]), Y, starts=[3.0, 0.0], mode=mode, max_qps=2, engine=engine)


class Own(qpmhe.Luenberger):
    def correct(self, z, v, sample):
        return 0.5 * self.gain @ v, None








def test_a_run_is_its_updates():
    reactor = qpmhe.models.batch_reactor()
    Y = np.array([reactor.scenario.simulate(seed, 20).measurements for seed in range(4)])
    options = {"members": 4, "horizon": 5, "initial_states": [3.0, 0.0], "delay": 2}
    batch, twin = BatchEstimator(*reactor[:3], **options), BatchEstimator(*reactor[:3], **options)
    run = batch.run(Y[..., 0])
    np.testing.assert_array_equal(run.states[:, 0], np.tile([3.0, 0.0], (4, 1)))
    for t in range(20):
        estimate = twin.update(Y[:, t, 0])
        assert len(estimate) == 4
        assert estimate.time == t
        np.testing.assert_array_equal(run.states[:, t + 1], estimate.states)
        np.testing.assert_array_equal(run.filtered[:, t], estimate.filtered)
        np.testing.assert_array_equal(run.costs[:, t], estimate.costs)
        np.testing.assert_array_equal(run.candidate_costs[:, t], estimate.candidate_costs)
        np.testing.assert_array_equal(run.qps[:, t], estimate.qps)
        assert [Status(value) for value in run.statuses[:, t]] == estimate.statuses
        delayed = np.full((4, 2), np.nan) if estimate.delayed is None else estimate.delayed
        np.testing.assert_array_equal(run.delayed[:, t], delayed)
    assert len(run) == 20
    assert run.share(Status.IMPROVED) == (run.costs < run.candidate_costs).mean()
    assert np.isnan(run.delayed[:, 0]).all()
    # And going on from there is the same as having gone on.
    again = batch.run(Y)
    np.testing.assert_array_equal(again.states[:, 0], run.states[:, -1])
    assert batch.time == 40
    empty = batch.run(Y[:, :0])
    assert len(empty) == 0
    assert empty.share(Status.IMPROVED) == 0.0


def test_records_of_inputs():
    def driven(x, u):
        return x @ A.T + u

    generator = np.random.default_rng(3)
    Y, U = generator.standard_normal((3, 9, 1)), generator.standard_normal((3, 9, 2))
    one = parts(driven, m=2)
    options = {"members": 3, "horizon": 4, "initial_states": np.eye(3, 2)}
    run = BatchEstimator(*one, **options).run(Y, U)
    shared = BatchEstimator(*one, **options).run(Y, U[1])
    for k in range(3):
        for inputs, found in ((U[k], run), (U[1], shared)):
            single = qpmhe.MovingHorizonEstimator(*one, horizon=4, initial_state=np.eye(3, 2)[k])
            same(found.states[k], single.run(Y[k], inputs).states, "records")


@pytest.mark.parametrize("sets", [{}, SETS], ids=["free", "sets"])
def test_reset(sets):
    Y = np.random.default_rng(4).standard_normal((3, 90, 1))
    Y[0, 3], Y[1, 70] = np.nan, np.nan
    options = {"members": 3, "horizon": 5, "max_qps": 2, "warm_start": True}
    batch = BatchEstimator(*parts(**sets), initial_states=[0.5, 0.0], **options)
    first = batch.run(Y).states
    batch.reset()
    assert batch.time == 0
    np.testing.assert_array_equal(batch.states, np.tile([0.5, 0.0], (3, 1)))
    np.testing.assert_array_equal(batch.run(Y).states, first)
    batch.reset(np.eye(3, 2))
    fresh = BatchEstimator(*parts(**sets), initial_states=np.eye(3, 2), **options)
    np.testing.assert_array_equal(batch.run(Y).states, fresh.run(Y).states)


@pytest.mark.parametrize("start", [False, True])
def test_what_the_caller_does_to_an_estimate_does_not_come_back(start):
    Y = np.random.default_rng(4).standard_normal((3, 30, 1))
    options = {"members": 3, "horizon": 5, "max_qps": 2, "warm_start": start}
    starts = np.array([0.5, 0.0])
    batch = BatchEstimator(*parts(), initial_states=starts, **options)
    spared = BatchEstimator(*parts(), initial_states=starts.copy(), **options)
    starts[...] = np.nan
    for t in range(30):
        y = Y[:, t].copy()
        estimate, expected = batch.update(y), spared.update(Y[:, t])
        np.testing.assert_array_equal(estimate.trajectories, expected.trajectories)
        np.testing.assert_array_equal(batch.states, expected.states)
        kept = estimate.trajectories.copy(), estimate.costs.copy(), estimate.candidates.copy()
        batch.states[...] = y[...] = np.nan
        for array in (estimate.trajectories, estimate.candidates, estimate.costs,
                      estimate.candidate_costs):
            array[...] = np.nan
        np.testing.assert_array_equal(batch.states, expected.states)
        # Nor does the next step write into what was given.
        for found, before in zip(
            (expected.trajectories, expected.costs, expected.candidates), kept, strict=True
        ):
            np.testing.assert_array_equal(found, before)


def test_every_way_of_saying_that_nothing_was_measured():
    nan = np.nan
    one = parts(h=lambda x: x, gain=np.eye(2) * 0.1, p=2)
    ways = (
        ([[1.0, 2.0], [nan, nan]], [[1.0, 2.0], None], [[1.0, 2.0], [None, None]],
         ([1.0, 2.0], [np.inf, 1e300]), np.ma.masked_invalid([[1.0, 2.0], [nan, nan]])),
        ([[nan, nan]] * 2, None, [None, None], np.full((2, 2), -np.inf)),
        ([[1.0, nan], [nan, 3.0]], [[1.0, None], [None, 3.0]]),
    )
    for expected, *others in ways:
        states = []
        for value in (expected, *others):
            batch = BatchEstimator(*one, members=2, horizon=3, initial_states=[0.5, 0.0])
            batch.update([[0.3, 0.1], [0.2, 0.1]])
            states.append(batch.update(value).trajectories)
        for other in states[1:]:
            np.testing.assert_array_equal(other, states[0])
    batch = BatchEstimator(*parts(), members=2, horizon=3, initial_states=[0.5, 0.0])
    assert batch.update([1.0, None]).statuses[1] & Status.MISSING
    assert batch.update([[None], None]).statuses[0] & Status.MISSING


def estimator(**options):
    return BatchEstimator(
        *parts(), **({"members": 3, "horizon": 3, "initial_states": [0.5, 0.0]} | options)
    )


@pytest.mark.parametrize(
    ("kind", "fragments", "options"),
    [
        (OptionError, ["members is 0", ">= 1"], {"members": 0}),
        (OptionError, ["members is -2", ">= 1"], {"members": -2}),
        (OptionError, ["members is 2.5", "integer"], {"members": 2.5}),
        (OptionError, ["members is True", "integer"], {"members": True}),
        (OptionError, ["horizon is 0"], {"horizon": 0}),
        (OptionError, ["max_qps is -1"], {"max_qps": -1}),
        (OptionError, ["engine is 'fast'"], {"engine": "fast"}),
        (UnknownOptionError, ["max_qp", "Did you mean max_qps?"], {"max_qp": 1}),
        (UnknownOptionError, ["initial_states"], {"initial_state": [0.5, 0.0]}),
        (ShapeError, ["(3,)", "(3, 2)", "(2,) for all"], {"initial_states": [1.0, 2.0, 3.0]}),
        (ShapeError, ["(2, 2)", "(3, 2)"], {"initial_states": np.ones((2, 2))}),
        (ShapeError, ["1 to 2 states", "same"], {"initial_states": [[1.0, 2.0], [1.0], [1, 2]]}),
        (QpmheError, ["initial_states", "finite"], {"initial_states": [1.0, np.nan]}),
        (QpmheError, ["initial_states", "real numbers"], {"initial_states": "here"}),
    ],
)
def test_what_cannot_be_made(kind, fragments, options):
    with pytest.raises(kind) as caught:
        estimator(**options)
    for fragment in fragments:
        assert fragment in str(caught.value)


def test_parts_that_are_none():
    system, observer, cost = parts()
    options = {"members": 2, "horizon": 3, "initial_states": [0.5, 0.0]}
    for wrong, word in (
        ((None, observer, cost), "system"), ((system, None, cost), "observer"),
        ((system, observer, None), "cost"),
    ):
        with pytest.raises(QpmheError, match=f"{word} is None"):
            BatchEstimator(*wrong, **options)
    with pytest.raises(ShapeError, match="gain has shape"):
        BatchEstimator(system, qpmhe.Luenberger(np.ones((3, 1))), cost, **options)


def test_initial_states_outside_of_the_set_are_projected_with_a_warning():
    starts = [[0.5, 0.0], [9.5, 0.0], [0.0, 0.0]]
    with pytest.warns(qpmhe.ObserverWarning, match=r"initial_states\[1\] is \[9.5, 0.0\]"):
        batch = BatchEstimator(*parts(**SETS), members=3, horizon=3, initial_states=starts)
    np.testing.assert_array_equal(batch.states, np.clip(starts, -9.0, 9.0))
    with pytest.warns(qpmhe.ObserverWarning, match=r"initial_states\[2\]"):
        batch.reset([*starts[:1], *starts[:1], [0.0, -20.0]])
    np.testing.assert_array_equal(batch.states[2], [0.0, -9.0])


@pytest.mark.parametrize(
    ("system", "starts", "fragments"),
    [
        ({"f": silent}, [[0.5, 0.0], [0.5, 0.1], [-1.0, 0.0]], ["initial_states[2]", "nan"]),
        ({"f": plain}, [[0.5, 0.0], [-0.5, 0.1], [1.0, 0.0]], ["initial_states[1]", "raised"]),
        (
            {"f_jacobian": lambda x: A * (1.0 + (np.abs(x[..., :1, None]) > 50.0))},
            [[0.5, 0.0], [60.0, 0.1], [1.0, 0.0]], ["initial_states[1]", "f_jacobian[0, 0]"],
        ),
    ],
    ids=["nan", "raises", "jacobian"],
)
def test_initial_states_that_a_single_estimator_would_not_take(system, starts, fragments):
    one = parts(**system)
    with pytest.raises(QpmheError) as caught:
        BatchEstimator(*one, members=3, horizon=3, initial_states=starts)
    for fragment in fragments:
        assert fragment in str(caught.value)
    good = BatchEstimator(*one, members=3, horizon=3, initial_states=[0.5, 0.1])
    good.update([0.5, 0.4, 0.6])
    states = good.states
    with pytest.raises(QpmheError):
        good.reset(starts)
    assert good.time == 1
    np.testing.assert_array_equal(good.states, states)




BAD_SAMPLES = [
    (ShapeError, ["Y has shape (2, 1)", "(3, 1)", "member"], ([[1.0], [2.0]],)),
    (ShapeError, ["Y has shape (3, 2)", "(3, 1)"], (np.ones((3, 2)),)),
    (ShapeError, ["Y has shape ()", "(3, 1)"], (1.0,)),
    (ShapeError, ["1 to 2 components", "NaN"], ([[1.0], [1.0, 2.0], [1.0]],)),
    (QpmheError, ["Y is", "real numbers"], (["a", "b", "c"],)),
    (QpmheError, ["U was given", "leave it out"], ([1.0] * 3, [1.0])),
]
BAD_RECORDS = [
    (ShapeError, ["4 to 6 samples", "NaN"], ([np.ones(5), np.ones(4), np.ones(6)],)),
    (ShapeError, ["4 to 6 samples"], ([[[1.0]] * 6, [[1.0]] * 6, [[1.0]] * 4],)),
    (ShapeError, ["(2, 5, 1)", "(3, T, 1)"], (np.ones((2, 5, 1)),)),
    (ShapeError, ["(3, 5, 2)", "(3, T, 1)"], (np.ones((3, 5, 2)),)),
    (ShapeError, ["(5,)", "(3, T, 1)"], (np.ones(5),)),
    (QpmheError, ["U was given"], (np.ones((3, 5, 1)), np.ones((5, 1)))),
]


def unharmed(build, calls, sample):
    spoilt, twin = build(), build()
    for _ in range(4):
        for kind, fragments, call in calls:
            with pytest.raises(kind) as caught:
                call(spoilt)
            for fragment in fragments:
                assert fragment in str(caught.value)
        found, expected = spoilt.update(*sample), twin.update(*sample)
        assert spoilt.time == twin.time
        np.testing.assert_array_equal(found.trajectories, expected.trajectories)


@pytest.mark.parametrize("sets", [{}, SETS], ids=["free", "sets"])
def test_bad_samples_and_records_are_refused_before_any_is_taken(sets):
    calls = [(kind, text, lambda b, a=a: b.update(*a)) for kind, text, a in BAD_SAMPLES]
    calls += [(kind, text, lambda b, a=a: b.run(*a)) for kind, text, a in BAD_RECORDS]
    options = {"members": 3, "horizon": 3, "initial_states": [0.5, 0.0]}
    unharmed(lambda: BatchEstimator(*parts(**sets), **options), calls, ([1.0, 2.0, 3.0],))


def test_bad_inputs_are_refused_before_a_sample_is_taken():
    Y = np.ones((3, 5, 1))
    calls = [
        (QpmheError, ["U is missing", "2 inputs", "update(Y, U)"], lambda b: b.update(Y[:, 0])),
        (QpmheError, ["U is missing", "run(Y, U)"], lambda b: b.run(Y)),
        (ShapeError, ["U has shape (3,)", "(2,) for all"], lambda b: b.update(Y[:, 0], [1, 2, 3])),
        (ShapeError, ["U has shape (2, 2)"], lambda b: b.update(Y[:, 0], np.ones((2, 2)))),
        (ShapeError, ["(4, 2)", "(3, 5, 2)"], lambda b: b.run(Y, np.ones((4, 2)))),
        (ShapeError, ["(3, 4, 2)", "(3, 5, 2)"], lambda b: b.run(Y, np.ones((3, 4, 2)))),
        (ShapeError, ["1 to 2 components"], lambda b: b.update(Y[:, 0], [[1, 2], [1], [1, 2]])),
    ]

    def build():
        one = parts(lambda x, u: x @ A.T + u, m=2)
        return BatchEstimator(*one, members=3, horizon=3, initial_states=[0.5, 0.0])

    unharmed(build, calls, (Y[:, 0], [0.1, 0.2]))


def test_one_state_one_output_one_input_without_brackets():
    cost = qpmhe.QuadraticCost(prior=1.0, disturbance=10.0, noise=1.0)
    one = qpmhe.System(lambda x, u: 0.9 * x + u, lambda x: x, n=1, p=1, m=1), (
        qpmhe.Luenberger([0.3])
    ), cost
    batch = BatchEstimator(*one, members=2, horizon=3, initial_states=0.5)
    full = BatchEstimator(*one, members=2, horizon=3, initial_states=[[0.5], [0.5]])
    found, expected = batch.update([1.0, 2.0], 0.1), full.update([[1.0], [2.0]], [[0.1], [0.1]])
    np.testing.assert_array_equal(found.trajectories, expected.trajectories)
    run = batch.run([[1.0, 2.0], [0.5, 0.7]], [0.1, 0.2])
    other = full.run([[[1.0], [2.0]], [[0.5], [0.7]]], [[[0.1], [0.2]]] * 2)
    np.testing.assert_array_equal(run.states, other.states)


def test_what_is_shown():
    batch = estimator()
    assert "members=3" in repr(batch)
    assert batch.horizon == 3
    assert "improved=3" in repr(batch.update([1.0, 2.0, 3.0]))
