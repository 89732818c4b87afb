"""An observer's own memory lies in the window: undone, redone, reset and saved like its state."""

import numpy as np
import pytest

import qpmhe
from qpmhe.errors import InvalidInputError, ModelError
from tests.estimation.same import assert_same

GAIN = np.array([0.4, 0.2])
START, MEMORY = np.array([0.5, -0.2]), np.array([0.3, 0.0])
YS = np.random.default_rng(8).normal(0.0, 0.7, (40, 1))


def f(x):
    return np.array([x[0] + 0.1 * x[1], 0.95 * x[1] - 0.1 * np.sin(x[0])])


def h(x):
    return x[:1]


class Wary(qpmhe.Observer):
    """Remembers the mean square of its errors, and how many there were."""

    def __init__(self, memory=MEMORY):
        self.memory = memory

    def check(self, system, initial_state):
        """Nothing to check."""

    def initial_memory(self):
        return self.memory

    def correct(self, z, v, sample):
        before = sample.memory
        assert not before.flags.writeable
        sample.next_memory[:] = 0.9 * before[0] + 0.1 * v[0] ** 2, before[1] + 1.0
        return GAIN * v[0] / (1.0 + before[0]), None


def observed(ys):
    """The observer written out here: its states, and what it remembers at the end."""
    z, memory, states = START, MEMORY.copy(), [START]
    for y in ys:
        v = y[0] - z[0]
        z = f(z) + GAIN * v / (1.0 + memory[0])
        memory = np.array([0.9 * memory[0] + 0.1 * v**2, memory[1] + 1.0])
        states.append(z)
    return np.array(states), memory


def estimator(observer=None, **options):
    system = qpmhe.System(f, h, n=2, p=1)
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=10.0 * np.eye(2), noise=[[4.0]])
    return qpmhe.MovingHorizonEstimator(
        system, observer or Wary(), cost,
        **{"horizon": 5, "initial_state": START, "engine": "python"} | options,
    )


def test_the_observer_remembers_from_sample_to_sample():
    """Beyond the window's arrays, which move to the front at the 37th sample."""
    mhe = estimator()
    run = mhe.run(YS)
    np.testing.assert_allclose(run.observer_states, observed(YS)[0], rtol=0.0, atol=1e-14)
    assert (run.costs <= run.candidate_costs).all()
    mhe.reset()
    np.testing.assert_array_equal(mhe.run(YS).observer_states, run.observer_states)


def test_late_and_undone_samples_find_the_memory_as_it_was(monkeypatch):
    mhe, late = estimator(), YS.copy()
    late[12] = 2.0
    for t, y in enumerate(YS[:15]):
        with monkeypatch.context() as patch:
            patch.setattr(mhe._engine, "_warn", lambda: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                mhe.update(100.0 + y)
        assert mhe.update(y).time == t
    mhe.amend(12, late[12])
    np.testing.assert_allclose(mhe.observer_state, observed(late[:15])[0][-1], rtol=0.0, atol=1e-14)
    mhe.set(noise_weight=[[2.0]])  # runs the observer again from the window's start
    np.testing.assert_allclose(mhe.observer_state, observed(late[:15])[0][-1], rtol=0.0, atol=1e-14)
    memory = mhe.state_dict()["window/memory"][-1]
    np.testing.assert_allclose(memory, observed(late[:15])[1], rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("options", [{}, {"candidate": "reinitialized"}, {"max_qps": 0}])
def test_snapshots_contain_the_memory(options):
    mhe, other = estimator(**options), estimator(**options)
    mhe.run(YS[:20])
    mhe.forget_warm_start()
    other.load_state_dict(mhe.state_dict())
    for y in YS[20:]:
        assert_same(other.update(y), mhe.update(y))
    plain = estimator(qpmhe.Luenberger(GAIN[:, None]), **options)
    with pytest.raises(InvalidInputError, match="another observer"):
        plain.load_state_dict(mhe.state_dict())


def test_a_re_initialised_observer_starts_with_what_it_remembered_there():
    mhe = estimator(candidate="reinitialized", max_qps=0, horizon=3)
    mhe.run(YS[:9])
    state, memory = mhe.state_dict(), observed(YS[:6])[1]
    # Its states start at estimates, so its errors are others; how many there were is the same.
    assert state["window/memory"][0, 1] == memory[1] == 6.0


@pytest.mark.parametrize(("memory", "words"), [
    (np.zeros((1, 2)), r"Wary.initial_memory returned shape \(1, 2\); expected \(2,\)"),
    (np.zeros(0), r"returned shape \(0,\); expected \(1,\)"),
    (np.array([np.nan]), r"returned \[nan\]; expected finite numbers"),
    (["a"], "without real numbers"),
])
def test_a_wrong_memory_is_refused_by_name(memory, words):
    with pytest.raises(ModelError, match=words):
        estimator(Wary(memory))


def test_a_memory_that_runs_away_fails_the_stage():
    class Lost(Wary):
        def correct(self, z, v, sample):
            correction, _ = super().correct(z, v, sample)
            if sample.memory[1] == 6.0:
                sample.next_memory[0] = np.inf
            return correction, None

    mhe = estimator(Lost())
    statuses = [mhe.update(y).status for y in YS[:10]]
    failed = [qpmhe.Status.MODEL_FAILED in status for status in statuses]
    # It goes on with what it remembered before, so it is lost at each sample from there on.
    assert failed == [False] * 6 + [True] * 4
    assert np.isfinite(mhe.state).all()


class Assigning(Wary):
    """Assigns what it remembers, which nobody would read, from one of its samples on."""

    def __init__(self, first):
        super().__init__()
        self.first = first

    def correct(self, z, v, sample):
        correction = super().correct(z, v, sample)
        if sample.memory[1] >= self.first:
            sample.next_memory = np.array([0.0, 9.0])
        return correction


def test_an_assigned_memory_is_an_error():
    with pytest.raises(ModelError, match=r"Assigning.correct assigned sample.next_memory; exp"):
        estimator(Assigning(0.0))
    mhe = estimator(Assigning(4.0))  # only when it runs: then the stage fails, and says why
    estimates = [mhe.update(y) for y in YS[:7]]
    failed = [qpmhe.Status.MODEL_FAILED in one.status for one in estimates]
    assert failed == [False] * 4 + [True] * 3
    assert "assigned sample.next_memory" in estimates[-1].message


def test_the_compiled_step_refuses_it_by_name():
    pytest.importorskip("casadi")

    class Remembering(qpmhe.Luenberger):
        def initial_memory(self):
            return np.zeros(1)

    with pytest.raises(qpmhe.errors.OptionError, match="Remembering has a memory of its own"):
        estimator(Remembering(GAIN[:, None]), engine="compiled")
    assert estimator(Remembering(GAIN[:, None]), engine="auto").engine == "python"
