"""The step whose matrices are held by their entries, beside the one that holds them whole."""

import numpy as np
import pytest

import qpmhe
from qpmhe.terms import entries

LEAST = 12
N, HORIZON, STEPS = 24, 4, 11


@pytest.fixture(autouse=True)
def few_states(monkeypatch):
    """Small models are sparse enough, too: the limits only save time."""
    monkeypatch.setattr(entries, "_LEAST_STATES", LEAST)
    monkeypatch.setattr(entries, "_MOST_FILLED", 0.6)
    monkeypatch.setattr("qpmhe_solvers.sparse_qp._GAIN", 16.0)


def graph(generator, n, kind):
    """Which states each state depends on."""
    if kind == "line":
        return np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 1
    if kind == "tree":
        there = np.eye(n, dtype=bool)
        for i in range(1, n):
            parent = generator.integers(max(0, i - 3), i)
            there[i, parent] = there[parent, i] = True
        return there
    # One-sided, with states that depend on themselves only by the disturbance.
    near = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 3
    return near & (generator.uniform(size=(n, n)) < 0.35)


class Case:
    """A random model with a sparse Jacobian, in random units, and its weights."""

    def __init__(self, seed, kind="line", n=N, vague=1.0, units=1.0, banded=False, discount=1.0,
                 seen=0.5):
        generator = self.generator = np.random.default_rng(seed)
        self.n, self.unit = n, units ** generator.uniform(-1.0, 1.0, n)
        self.there = graph(generator, n, kind)
        A = np.where(self.there, generator.normal(size=(n, n)), 0.0)
        self.A = 0.8 * A / np.maximum(1.0, np.abs(A).sum(axis=1, keepdims=True))
        self.seen = np.sort(generator.permutation(n)[: int(seen * n)])
        self.p = self.seen.size
        rows = [[(j, self.A[i, j]) for j in np.flatnonzero(self.A[i])] for i in range(n)]
        unit, seen = self.unit, self.seen

        def f(x):
            z = x / unit
            sums = [sum((a * np.tanh(z[j]) for j, a in row), 0.1 * np.sin(z[i]))
                    for i, row in enumerate(rows)]
            return unit * np.stack(sums)

        def h(x):
            z = x[seen] / unit[seen]
            return z + 0.1 * z**2

        self.system = qpmhe.System(f=f, h=h, n=n, p=self.p)
        weights = {
            "prior": np.eye(n) / vague**2, "disturbance": 4.0 * np.eye(n),
            "noise": 9.0 * np.eye(self.p),
        }
        if banded:
            for one in weights.values():
                for k in range(0, len(one) - 1, 2):
                    one[k, k + 1] = one[k + 1, k] = 0.3 * one[k, k]
            last = self.p - 3
            weights["noise"][last, last + 1] = weights["noise"][last + 1, last] = 2.0
        for name in ("prior", "disturbance"):
            weights[name] /= np.multiply.outer(unit, unit)
        self.weights = weights
        self.cost = qpmhe.QuadraticCost(**weights, discount=discount)
        gain = np.zeros((n, self.p))
        gain[self.seen, np.arange(self.p)] = 0.3 * unit[self.seen]
        self.observer = qpmhe.Luenberger(gain)
        self.start = 0.3 * unit * generator.normal(size=n)
        self.Y = generator.normal(size=(STEPS, self.p))

    def estimator(self, **options):
        usual = {"horizon": HORIZON, "engine": "python", "initial_state": self.start}
        return qpmhe.MovingHorizonEstimator(
            self.system, self.observer, self.cost, **{**usual, **options}
        )


def is_by_entries(mhe):
    return mhe._engine._tools.form.by_entries


def both(monkeypatch, case, take=None, **options):
    """Estimates by entries, and of whole matrices."""
    runs = []
    for least, expected in ((LEAST, True), (10**9, False)):
        monkeypatch.setattr(entries, "_LEAST_STATES", least)
        mhe = case.estimator(**options)
        assert is_by_entries(mhe) is expected
        runs.append(take(mhe) if take else [mhe.update(y) for y in case.Y])
    monkeypatch.setattr(entries, "_LEAST_STATES", LEAST)
    return runs


def assert_same(case, runs, tolerance=1e-9):
    for found, expected in zip(*runs, strict=True):
        assert found.status == expected.status
        assert found.cost == pytest.approx(expected.cost, rel=tolerance)
        assert found.candidate_cost == pytest.approx(expected.candidate_cost, rel=tolerance)
        scale = np.abs(expected.trajectory / case.unit).max()
        error = np.abs(found.trajectory - expected.trajectory) / case.unit
        assert error.max() <= tolerance * scale
        assert found.cost <= found.candidate_cost


@pytest.mark.parametrize("qps", [1, 3, None])
@pytest.mark.parametrize("kind", ["line", "tree", "random"])
@pytest.mark.parametrize("seed", range(3))
def test_estimates_are_those_of_whole_matrices(monkeypatch, seed, kind, qps):
    case = Case(seed, kind, banded=seed % 2 == 0)
    case.Y[4, ::2] = np.nan
    case.Y[6] = np.nan
    assert_same(case, both(monkeypatch, case, max_qps=qps))


@pytest.mark.parametrize("options", [
    {"units": 1e6}, {"discount": 0.7, "banded": True}, {"vague": 1e10, "seen": 1.0},
    {"vague": 1e10, "seen": 1.0, "units": 1e6, "banded": True},
], ids=str)
@pytest.mark.parametrize("seed", range(3))
def test_so_are_those_of_vague_priors_units_and_discounts(monkeypatch, seed, options):
    case = Case(seed, "line", **options)
    case.Y[5, 1:] = np.nan
    assert_same(case, both(monkeypatch, case, max_qps=2))


@pytest.mark.parametrize("seed", range(4))
def test_where_rounding_decides_the_promise_holds(seed):
    """States that a prior alone determines, which is as good as none: QPs get a ridge."""
    case = Case(seed, "line", vague=1e10)
    for estimate in map(case.estimator(max_qps=2).update, case.Y):
        assert estimate.cost <= estimate.candidate_cost
        assert np.isfinite(estimate.trajectory).all()
        assert not estimate.status & qpmhe.Status.SOLVER_FAILED


@pytest.mark.parametrize("options", [
    {}, {"kind": "tree", "banded": True}, {"kind": "random", "discount": 0.8}, {"units": 1e3},
], ids=str)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.filterwarnings("ignore:the observer was far")
def test_shorter_steps_have_the_same_metric(monkeypatch, seed, options):
    """Lengths, steepest descent and damping, where a full step does not lower J."""
    case, generator = Case(seed, **options), np.random.default_rng(seed)
    step, kinds = generator.normal(size=(HORIZON + 1, N)) * case.unit, []
    case.Y *= 10.0

    def take(mhe):
        found, subproblem = [], mhe._engine._tools.subproblem
        usual = subproblem.metric

        def metric(problem, trial):
            made = usual(problem, trial)
            d = step[: len(trial.trajectory)]
            qp = subproblem._qp
            damped = qp.copy()
            damped.band[...] = subproblem._form.damping(subproblem._minus_jacobian, trial.weights)
            found.append([
                made.information * case.unit**2, made.length(d),
                made.descent(d / case.unit**2) / case.unit, damped.hessian_times(d) * case.unit,
                qp.hessian_times(d) * case.unit,
            ])
            return made

        monkeypatch.setattr(subproblem, "metric", metric)
        for y in case.Y:
            mhe.update(y)
        kinds.append(subproblem._form.by_entries)
        return found

    found, expected = both(monkeypatch, case, take, max_qps=3)
    assert kinds == [True, False]
    assert len(found) == len(expected) > 3
    for one, other in zip(found, expected, strict=True):
        for value, right in zip(one, other, strict=True):
            assert value == pytest.approx(right, rel=1e-9, abs=1e-9 * np.abs(right).max())


@pytest.mark.parametrize("candidate", ["observer", "reinitialized"])
@pytest.mark.parametrize("arrival", ["filtered", "smoothed"])
def test_so_are_those_of_other_candidates(monkeypatch, candidate, arrival):
    case = Case(7, "tree")
    options = {"candidate": candidate}
    if arrival == "smoothed":
        options["arrival"] = arrival
    assert_same(case, both(monkeypatch, case, max_qps=2, **options))


@pytest.mark.parametrize("name", ["noise_weight", "disturbance_weight"])
@pytest.mark.parametrize("is_dense", [False, True])
def test_samples_bring_weights_of_their_own(monkeypatch, name, is_dense):
    """Weights of another pattern, after which matrices are held whole."""
    case = Case(1, "line")
    own = 2.0 * case.weights[name.removesuffix("_weight")]
    if is_dense:
        own = own + 0.01
    left = []

    def take(mhe):
        found = []
        for k, y in enumerate(case.Y):
            found.append(mhe.update(y, **({name: own} if k in (3, 8) else {})))
        left.append(is_by_entries(mhe))
        return found

    assert_same(case, both(monkeypatch, case, take, max_qps=2))
    assert left == [not is_dense, False]


def test_conditions_change_while_running(monkeypatch):
    case = Case(2, "line", banded=True)
    forms_taken = []

    def take(mhe):
        found = [mhe.update(y) for y in case.Y[:5]]
        for weight in (2.0 * np.eye(case.p), np.eye(case.p) + 0.05, 3.0 * np.eye(case.p)):
            found.append(mhe.set(noise_weight=weight))
            forms_taken.append(is_by_entries(mhe))
            found += [mhe.update(y) for y in case.Y[5:7]]
        return found

    assert_same(case, both(monkeypatch, case, take, max_qps=2))
    assert forms_taken[0]
    assert forms_taken[2]


def test_late_measurements(monkeypatch):
    case = Case(3, "tree")
    late = case.Y[4].copy()
    case.Y[4, 1:] = np.nan

    def take(mhe):
        found = [mhe.update(y) for y in case.Y[:7]]
        found.append(mhe.amend(4, late))
        return found + [mhe.update(y) for y in case.Y[7:]]

    assert_same(case, both(monkeypatch, case, take, max_qps=2))


def test_covariances_and_sensitivities(monkeypatch):
    case = Case(4, "line")

    def take(mhe):
        for y in case.Y:
            mhe.update(y)
        return mhe.covariances(), mhe.sensitivity().measurements

    found, expected = both(monkeypatch, case, take)
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, rel=1e-7, abs=1e-9 * np.abs(other).max())


@pytest.mark.parametrize("to_whole", [False, True])
@pytest.mark.parametrize("from_whole", [False, True])
def test_snapshots(monkeypatch, from_whole, to_whole):
    """One of whole matrices continues by entries, and the other way round."""
    case, made = Case(5, "tree"), []
    for whole in (from_whole, to_whole):
        monkeypatch.setattr(entries, "_LEAST_STATES", 10**9 if whole else LEAST)
        made.append(case.estimator(max_qps=2))
    first, second = made
    case.Y[3, 0] = np.nan
    for y in case.Y[:6]:
        first.update(y)
    state = first.state_dict()
    monkeypatch.setattr(entries, "_LEAST_STATES", 10**9 if to_whole else LEAST)
    second.load_state_dict(state)
    assert is_by_entries(second) is not to_whole
    runs = [[mhe.update(y) for y in case.Y[6:]] for mhe in (second, first)]
    assert_same(case, runs)


def test_a_model_that_fails_somewhere(monkeypatch):
    """Holes in f, and a Jacobian that is not finite at a place."""
    case = Case(6, "line")

    def f(x):
        return np.sqrt(np.abs(x)) * 0.5 + 0.1 * np.append(x[1:], x[:1]) + np.log(x[0] + 2.0)

    case.system = qpmhe.System(f=f, h=lambda x: x[case.seen], n=N, p=case.p)
    case.start[:] = 0.0
    case.Y[3:6, 0] = -90.0
    assert_same(case, both(monkeypatch, case, max_qps=2), 1e-4)


@pytest.mark.parametrize("what", [
    "X", "W", "V", "soft", "kalman", "restart", "huber", "singular", "solver", "untraced", "none",
])
def test_what_needs_whole_matrices_has_them(what):
    case, options = Case(8, "line"), {"max_qps": 2}
    box = qpmhe.Box(np.full(N, -50.0), np.full(N, 50.0))
    system = {"n": N, "p": case.p, "f": case.system.f.function, "h": case.system.h.function}
    if what == "X":
        case.system = qpmhe.System(**system, states=box)
    elif what == "W":
        case.system = qpmhe.System(**system, disturbances=box)
    elif what == "V":
        case.system = qpmhe.System(
            **system, noises=qpmhe.Box(np.full(case.p, -9.0), np.full(case.p, 9.0))
        )
    elif what == "soft":
        case.system = qpmhe.System(**system, states=box.soften(linear=1.0))
    elif what == "kalman":
        case.observer = qpmhe.ExtendedKalman(
            prior=np.eye(N), disturbance=np.eye(N), noise=np.eye(case.p)
        )
    elif what == "restart":
        options["restart"] = True
    elif what == "huber":
        case.cost = qpmhe.RobustCost(
            **{**case.weights, "noise": qpmhe.Huber(case.weights["noise"])}
        )
    elif what == "singular":
        case.cost = qpmhe.QuadraticCost.from_covariances(
            prior=np.eye(N), disturbance=np.diag(np.append(np.ones(N - 1), 0.0)),
            noise=np.eye(case.p),
        )
    elif what == "solver":
        options["backend"] = "daqp"
    elif what == "untraced":
        case.system = qpmhe.System(
            f=lambda x: np.asarray([float(one) for one in 0.5 * x]), h=lambda x: x[case.seen],
            n=N, p=case.p,
        )
    elif what == "none":
        options["max_qps"] = 0
    mhe = case.estimator(**options)
    assert not is_by_entries(mhe)
    assert np.isfinite(mhe.update(case.Y[0]).cost)


def test_a_function_that_has_changed_ends_it():
    case, rate = Case(9), [0.1]

    def f(x):
        return x + rate[0] * (np.append(x[1:], x[-1:]) - x)

    case.system = qpmhe.System(f=f, h=lambda x: x[case.seen], n=N, p=case.p)
    mhe = case.estimator(max_qps=2)
    for y in case.Y[:6]:
        mhe.update(y)
    assert is_by_entries(mhe)
    rate[0] = 0.2
    with pytest.warns(match="has changed since it was traced"):
        mhe.verify()
    assert not is_by_entries(mhe)
    for y in case.Y[6:]:
        estimate = mhe.update(y)
        assert estimate.cost <= estimate.candidate_cost


def test_a_snapshot_continues_where_the_function_has_no_trace():
    case = Case(10)
    case.system = qpmhe.System(f=lambda x: 0.5 * x, h=lambda x: x[case.seen], n=N, p=case.p)
    traced = case.estimator(max_qps=2)
    case.system = qpmhe.System(
        f=lambda x: np.asarray([0.5 * float(one) for one in x]), h=lambda x: x[case.seen],
        n=N, p=case.p,
    )
    untraced = case.estimator(max_qps=2)
    for y in case.Y[:6]:
        traced.update(y)
    untraced.load_state_dict(traced.state_dict())
    assert (is_by_entries(traced), is_by_entries(untraced)) == (True, False)
    assert_same(case, [[mhe.update(y) for y in case.Y[6:]] for mhe in (traced, untraced)], 1e-6)


@pytest.mark.parametrize("is_larger", [False, True])
def test_a_snapshot_continues_with_another_pattern(is_larger):
    """Of a model with entries that are lost in rounding."""
    case, runs, patterns = Case(11), [], []
    for factor in (0.0, 1e-300) if is_larger else (1e-300, 0.0):
        def f(x, factor=factor):
            return 0.5 * x + factor * np.append(x[2:], x[:2]) if factor else 0.5 * x

        case.system = qpmhe.System(f=f, h=lambda x: x[case.seen], n=N, p=case.p)
        runs.append(case.estimator(max_qps=2))
        patterns.append(runs[-1]._engine._tools.form.places["linear"].size)
    first, second = runs
    assert (patterns[0] < patterns[1]) is is_larger
    for y in case.Y[:6]:
        first.update(y)
    second.load_state_dict(first.state_dict())
    assert is_by_entries(second) is is_larger
    assert_same(case, [[mhe.update(y) for y in case.Y[6:]] for mhe in runs])
