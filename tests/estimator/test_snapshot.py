import json
import pickle
import subprocess
import sys

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.estimation.snapshot import read, written
from qpmhe.models.batch_reactor import casadi_output, casadi_rate

OPTIONS = {
    "plain": {},
    "converged": {"max_qps": None},
    "best": {"warm_start": True, "max_qps": 2},
    "reinitialized": {"candidate": "reinitialized"},
    "smoothed": {"arrival": "smoothed"},
    "smoothed anew": {"arrival": "smoothed", "candidate": "reinitialized"},
    "observer alone": {"max_qps": 0},
    "delayed": {"delay": 3},
}


def make(system=None, **options):
    numpy_system, observer, cost, scenario = qpmhe.models.batch_reactor()
    system = system or numpy_system
    return qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=6, initial_state=scenario.initial_estimate, **options
    )


def record(steps=30):
    measurements = qpmhe.models.batch_reactor().scenario.simulate(2, steps).measurements
    measurements[7] = np.nan
    return measurements


def feed(mhe, measurements, first=0):
    """A record with irregular steps, own noises and a late measurement at stated times."""
    estimates = []
    for t, y in enumerate(measurements, first):
        weight = [[4.0]] if t == 10 else None
        estimates.append(mhe.update(y, dt=0.15 if t == 9 else None, noise_weight=weight))
        if t == 11:
            estimates.append(mhe.amend(7, [7.0]))
    return estimates


def assert_equal(ours, theirs):
    for one, other in zip(ours, theirs, strict=True):
        assert one.trajectory.tolist() == other.trajectory.tolist()
        assert (one.cost, one.status, one.time) == (other.cost, other.status, other.time)
        assert one.candidate.tolist() == other.candidate.tolist()
        assert one.candidate_cost == other.candidate_cost
        np.testing.assert_array_equal(one.noises, other.noises)


@pytest.mark.parametrize("stop", [0, 1, 5, 8, 10, 12, 29])
@pytest.mark.parametrize("name", OPTIONS)
def test_a_restored_estimator_continues_bit_for_bit(name, stop):
    measurements, options = record(), OPTIONS[name]
    whole = make(**options)
    feed(whole, measurements[:stop])
    restored = pickle.loads(pickle.dumps(whole))
    loaded = make(**options)
    loaded.load_state_dict(whole.state_dict())
    rest = measurements[stop:]
    expected = feed(whole, rest, stop)
    assert_equal(feed(restored, rest, stop), expected)
    assert_equal(feed(loaded, rest, stop), expected)
    assert whole.covariances().tolist() == restored.covariances().tolist()


class Rounding:
    """A model's fused calls, whose last digits no other way of calling it has."""

    def __init__(self, kernel):
        self.kernel, self.factor = kernel, 1.0 + 4.0 * np.finfo(float).eps
        self.prepare = kernel.prepare

    def stage(self, x, u):
        return tuple(self.factor * value for value in self.kernel.stage(x, u))

    def residuals(self, trajectory, y, u):
        return self.factor * self.kernel.residuals(trajectory, y, u)


@pytest.mark.parametrize("fused", ["interpreted", "compiled", "other digits"])
@pytest.mark.parametrize("bounds", [None, qpmhe.Box([0.0, 0.0], [np.inf, np.inf])])
@pytest.mark.parametrize("name", OPTIONS)
def test_fused_calls_of_a_model_continue_bit_for_bit(name, bounds, fused):
    """CasADi evaluates a stage, or all residuals of a window, in one call."""
    pytest.importorskip("casadi")
    if fused == "compiled" and find_compiler() is None:
        pytest.skip("no C compiler")
    system = qpmhe.from_casadi(
        casadi_rate, casadi_output, n=2, dt=0.1, method="euler", states=bounds,
        compiled=fused == "compiled",
    )
    if fused == "other digits":
        system.kernel = Rounding(system.kernel)
    options, measurements = OPTIONS[name], record(60)
    regular = [y for y in measurements if np.isfinite(y).all()]
    # All samples alike; or a missing one, irregular steps, noises of their own, a late one.
    for taken, first, stops in ((regular, 100, (1, 20)), (measurements, 0, (5, 10, 12))):
        for stop in stops:
            whole, loaded = make(system, **options), make(system, **options)
            feed(whole, taken[:stop], first)
            loaded.load_state_dict(whole.state_dict())
            restored = pickle.loads(pickle.dumps(whole)) if fused != "other digits" else None
            expected = feed(whole, taken[stop:], first + stop)
            for one in filter(None, (loaded, restored)):
                assert_equal(feed(one, taken[stop:], first + stop), expected)
                assert whole.covariances().tolist() == one.covariances().tolist()


@pytest.mark.parametrize("stop", [1, 8, 12, 60, 75])
@pytest.mark.parametrize("name", OPTIONS)
def test_after_a_reset_it_is_as_new(name, stop):
    measurements, used, new = record(80), make(**OPTIONS[name]), make(**OPTIONS[name])
    feed(used, measurements[:stop])
    used.reset()
    # Shorter than before, and without any unusual sample.
    first = measurements[:6]
    assert_equal([used.update(y) for y in first], [new.update(y) for y in first])
    used.reset()
    new.reset()
    assert_equal(feed(used, measurements), feed(new, measurements))


def test_covariances_are_known_after_a_restart():
    whole = make()
    feed(whole, record(12))
    assert pickle.loads(pickle.dumps(whole)).covariances().tolist() == whole.covariances().tolist()


def test_a_kalman_type_observer_and_a_robust_cost_are_restored():
    system, _, _, scenario = qpmhe.models.batch_reactor()
    observer = qpmhe.ExtendedKalman(
        prior=np.eye(2), disturbance=0.01 * np.eye(2), noise=[[0.04]]
    )
    cost = qpmhe.RobustCost(
        prior=qpmhe.ObserverPrior(), disturbance=100.0 * np.eye(2), noise=qpmhe.Huber([[25.0]])
    )
    whole = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=6, initial_state=scenario.initial_estimate
    )
    measurements = record()
    feed(whole, measurements[:14])
    restored = pickle.loads(pickle.dumps(whole))
    assert_equal(feed(restored, measurements[14:], 14), feed(whole, measurements[14:], 14))
    restored.reset()
    new = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=6, initial_state=scenario.initial_estimate
    )
    assert_equal(feed(restored, measurements), feed(new, measurements))


def test_a_state_is_a_copy():
    mhe, other = make(), make()
    feed(mhe, record(12))
    state = mhe.state_dict()
    other.load_state_dict(state)
    before = other.update([7.0])
    other.load_state_dict(state)
    assert_equal([other.update([7.0])], [before])


def test_another_process_continues_bit_for_bit(tmp_path):
    measurements, mhe = record(), make(warm_start=True, max_qps=2)
    feed(mhe, measurements[:13])
    np.save(tmp_path / "rest.npy", measurements[13:])
    (tmp_path / "mhe.pickle").write_bytes(pickle.dumps(mhe))
    code = (
        "import pickle, sys, numpy as np\n"
        "mhe = pickle.load(open(sys.argv[1] + '/mhe.pickle', 'rb'))\n"
        "rest = np.load(sys.argv[1] + '/rest.npy')\n"
        "np.save(sys.argv[1] + '/states.npy', [mhe.update(y).state for y in rest])\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    expected = [e.state for e in feed(mhe, measurements[13:], 13)]
    assert np.load(tmp_path / "states.npy").tolist() == np.array(expected).tolist()


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ({}, "None"),
        ({"problem": (2, 1, 0, 7)}, r"2, 1, 0, 7.; expected \(2, 1, 0, 6\)"),
    ],
)
def test_a_state_of_another_problem_is_refused(state, words):
    mhe = make()
    feed(mhe, record(8))
    before = mhe.state.copy()
    with pytest.raises(qpmhe.errors.InvalidInputError, match=words):
        mhe.load_state_dict(written(state))
    assert mhe.state.tolist() == before.tolist()
    assert mhe.time == 8


def damaged(key, value):
    mhe = make()
    feed(mhe, record(8))
    state = read(mhe.state_dict())
    if value is None:
        del state[key]
    else:
        state[key] = value
    return written(state)


@pytest.mark.parametrize(
    "state",
    [
        damaged("window", None),
        damaged("window", 3),
        damaged("history", []),
        damaged("history", [[1.0, 2.0, 3.0]]),
        damaged("modes", None),
        damaged("trajectory", "text"),
        damaged("problem", 3),
    ],
)
def test_a_damaged_state_is_refused_and_nothing_is_half_done(state):
    mhe, twin = make(), make()
    measurements = record(12)
    feed(mhe, measurements[:5])
    feed(twin, measurements[:5])
    words = r"the state is (damaged|of a problem)"
    with pytest.raises(qpmhe.errors.InvalidInputError, match=words):
        mhe.load_state_dict(state)
    assert_equal(feed(mhe, measurements[5:], 5), feed(twin, measurements[5:], 5))


def test_a_state_of_another_observer_is_refused():
    system, _, cost, scenario = qpmhe.models.batch_reactor()
    observer = qpmhe.ExtendedKalman(
        prior=np.eye(2), disturbance=0.01 * np.eye(2), noise=[[0.04]]
    )
    other = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=6, initial_state=scenario.initial_estimate
    )
    with pytest.raises(qpmhe.errors.InvalidInputError, match="another observer"):
        other.load_state_dict(make().state_dict())


def test_how_models_of_other_steps_are_called_goes_along():
    def rate(x):
        x = np.asarray(x.tolist())  # loses the batch axis
        return -x * (1.0 if x[..., 0].max() < 8.5 else 1.001)

    def make():
        system = qpmhe.System.from_ode(rate, lambda x: x[..., :1], dt=0.1, n=2, p=1)
        return qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([[0.3], [0.1]]),
            qpmhe.QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1)),
            horizon=4, initial_state=[1.0, 1.0],
        )

    one, other = make(), make()
    generator = np.random.default_rng(0)
    for _ in range(40):
        one.update(generator.uniform(0.0, 10.0, 1), dt=0.11)
    one._own_system.timed.f.mode = "looped"
    other.load_state_dict(one.state_dict())
    assert other._own_system.timed.f.mode == "looped"
    assert other.system.timed.f.mode == "batched"
    state = read(one.state_dict())
    state["modes"] = state["modes"][:3]
    with pytest.raises(qpmhe.errors.InvalidInputError, match="damaged"):
        other.load_state_dict(written(state))


@pytest.mark.parametrize("name", OPTIONS)
def test_a_long_window_keeps_no_views_and_is_the_same(name, monkeypatch):
    measurements, kept = record(80), make(**OPTIONS[name])
    monkeypatch.setattr("qpmhe.estimation.stages._KEPT", 5)
    fresh = make(**OPTIONS[name])
    assert isinstance(kept._engine._window._stage_views, list)
    assert not isinstance(fresh._engine._window._stage_views, list)
    assert_equal(feed(fresh, measurements), feed(kept, measurements))


@pytest.mark.parametrize("engine", ["python", "compiled"])
@pytest.mark.parametrize("how", ["npz", "json"])
def test_files_without_pickle_keep_every_bit(how, engine, tmp_path):
    if engine == "compiled":
        pytest.importorskip("casadi")
    system, _, cost, scenario = qpmhe.models.batch_reactor()
    covariances = {"prior": np.eye(2), "disturbance": 0.01 * np.eye(2), "noise": [[0.04]]}

    def make():
        return qpmhe.MovingHorizonEstimator(
            system, qpmhe.ExtendedKalman(**covariances), cost, horizon=6,
            initial_state=scenario.initial_estimate, engine=engine,
        )

    mhe, other = make(), make()
    _, Y = scenario.simulate(1)
    for t in range(9):
        mhe.update([np.nan] if t == 4 else Y[t], noise_weight=[[30.0]] if t == 6 else None)
    if how == "npz":
        np.savez(tmp_path / "state.npz", **mhe.state_dict())
        with np.load(tmp_path / "state.npz") as file:
            other.load_state_dict(file)
    else:
        text = json.dumps(mhe.state_dict(), default=np.ndarray.tolist)
        other.load_state_dict(json.loads(text))
    for t in range(9, 14):
        one, two = mhe.update(Y[t]), other.update(Y[t])
        np.testing.assert_array_equal(one.trajectory, two.trajectory)
        assert (one.cost, one.candidate_cost) == (two.cost, two.candidate_cost)


@pytest.mark.parametrize(
    ("state", "words"),
    [
        (3, "the state is a int; expected the dict that state_dict gave"),
        ({}, "the state has no 'structure' .it is empty.; expected the whole dict"),
        ({"z": 1}, "the state has no 'structure' .only 'z'."),
    ],
)
def test_what_is_no_state_is_refused_with_what_is_missing(state, words):
    with pytest.raises(qpmhe.errors.InvalidInputError, match=words):
        make().load_state_dict(state)


def test_an_array_that_is_missing_is_named():
    mhe = make()
    feed(mhe, record(8))
    state = mhe.state_dict()
    del state["trajectory"]
    with pytest.raises(qpmhe.errors.InvalidInputError, match="the state has no 'trajectory'"):
        make().load_state_dict(state)
