"""A trace holds the numbers that its function read: their changes are seen, without calling it."""

import functools
import types
import warnings

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import EngineWarning
from qpmhe.model.captured import Captured

ENGINES = ["python"] + (["compiled"] if find_compiler() else [])
A = np.array([[0.9, 0.2], [-0.1, 0.8]])
GAIN = 0.1
# Looks after which each change must have been seen.
LOOKS = 16
plant_data = types.ModuleType("plant_data")
plant_data.gain, plant_data.__file__ = 0.1, "plant_data.py"


class Plant:
    shared = 1.0

    def __init__(self):
        self.gain, self.seen, self.data = 0.1, 0, {"gain": 0.1}

    def f(self, x):
        return self.own(x) * self.shared + self.data["gain"] + self.half

    def own(self, x):
        return self.gain * x

    @property
    def half(self):
        return self.rate

    rate = 0.5


class Heir(Plant):
    def f(self, x):
        return super().f(x)


def _closure():
    gain = 0.1

    def change():
        nonlocal gain
        gain = 0.2

    return lambda x: gain * x, change


def _method(change, kind=Plant):
    plant = kind()
    return plant.f, lambda: change(plant)


def _array(array, index):
    def f(x):
        return array[0] * x

    def change():
        array[index] += 1.0

    return f, change


def _list(items, index):
    def change():
        items[index] = 0.2

    return lambda x: items[0] * x, change


def _partial():
    def f(x, gain):
        return gain * x

    found = functools.partial(f, gain=0.1)
    return found, lambda: found.keywords.update(gain=0.2)


def _default():
    def f(x, *, gain=(0.1,)):
        return gain[0] * x

    return f, lambda: f.__kwdefaults__.update(gain=(0.2,))


def _callable():
    class Called:
        gain = 0.1

        def __call__(self, x):
            return self.gain * x

    one = Called()
    return one, lambda: setattr(one, "gain", 0.2)


def _wrapped():
    inner, change = _closure()

    @functools.wraps(inner)
    def f(*arguments):
        return inner(*arguments)

    return f, change


KINDS = {
    "closure": _closure,
    "global": lambda: (lambda x: GAIN * x, lambda: globals().update(GAIN=globals()["GAIN"] + 1.0)),
    "attribute": lambda: _method(lambda plant: setattr(plant, "gain", 0.2)),
    "attribute that hides the class's": lambda: _method(lambda one: setattr(one, "shared", 2.0)),
    "attribute by a property": lambda: _method(lambda plant: setattr(plant, "rate", 2.0)),
    "method of the object": lambda: _method(lambda plant: setattr(plant, "own", lambda x: x)),
    "attribute, in a method of the base": lambda: _method(lambda p: setattr(p, "gain", 2.0), Heir),
    "dictionary": lambda: _method(lambda plant: plant.data.update(gain=0.2)),
    "module": lambda: (
        lambda x: plant_data.gain * x, lambda: setattr(plant_data, "gain", plant_data.gain + 1.0)
    ),
    "array": lambda: _array(np.ones(3), 2),
    "strided array": lambda: _array(np.ones((6, 4))[::2, 1:], (2, 1)),
    "large array": lambda: _array(np.ones(9000), 8999),
    "list": lambda: _list([0.1, 0.1], 1),
    "long list": lambda: _list([0.1] * 1000, 999),
    "partial": _partial,
    "default": _default,
    "callable object": _callable,
    "wrapped function": _wrapped,
}


@pytest.mark.whole
@pytest.mark.parametrize("kind", KINDS)
def test_a_changed_value_is_seen(kind):
    f, change = KINDS[kind]()
    captured = Captured([f])
    assert not any(captured.changed() for _ in range(3 * LOOKS))
    change()
    assert any(captured.changed() for _ in range(3 * LOOKS))
    captured.renew()
    assert not any(captured.changed() for _ in range(3 * LOOKS))


def test_an_attribute_that_the_functions_do_not_read_may_change():
    plant = Plant()
    captured = Captured([plant.f])
    plant.seen, plant.gain = 7, float("0.1")  # an equal number in another object
    assert not any(captured.changed() for _ in range(LOOKS))


def test_values_that_refer_to_one_another_are_followed_once():
    one, other = [0.1], {"gain": 0.2}
    one.append(other)
    other["again"] = one
    captured = Captured([lambda x: one[0] * x + other["gain"]])
    assert not captured.changed()
    other["gain"] = 0.3
    assert captured.changed()


# Estimators


class Counting:
    """A model that counts the calls with numbers."""

    def __init__(self, gain=0.1):
        self.gain, self.calls = [gain], 0

    def f(self, x):
        self.calls += 1
        return x @ A.T + self.gain[0] * np.sin(x)

    def system(self):
        return qpmhe.System(self.f, lambda x: x[..., :1], n=2, p=1)


def estimator(system, engine, **options):
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=10.0 * np.eye(2), noise=[[4.0]])
    return qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.4, 0.1]), cost, horizon=5, initial_state=[1.0, -1.0],
        engine=engine, **options,
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_functions_are_not_called_in_the_loop(engine):
    plant = Counting()
    mhe = estimator(plant.system(), engine, time_budget=10.0)
    made = plant.calls
    for _ in range(2):
        for k in range(1100):
            mhe.update([np.sin(0.1 * k)])
        mhe.reset()
    assert plant.calls == made
    assert mhe.verify()
    assert plant.calls > made


@pytest.mark.parametrize("engine", ENGINES)
def test_without_a_budget_they_are_called_every_thousandth_sample(engine):
    plant = Counting()
    mhe = estimator(plant.system(), engine)
    made, at = plant.calls, []
    for k in range(2100):
        before = plant.calls
        mhe.update([np.sin(0.1 * k)])
        if plant.calls > before:
            at.append(k)
    assert at == [1000, 2000]
    assert 0 < plant.calls - made < 10


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("sample", [0, 1, 37])
def test_a_change_is_seen_before_the_next_sample(engine, sample):
    plant, other = Counting(), Counting(0.3)
    mhe = estimator(plant.system(), engine, time_budget=10.0)
    for k in range(sample):
        mhe.update([np.sin(0.1 * k)])
    plant.gain[0] = 0.3
    with pytest.warns(EngineWarning, match="f has changed since it was traced"):
        found = mhe.update([0.4])
    assert mhe.engine == "python"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = mhe.update([0.3])
    w = found.trajectory[1:] - np.array([other.f(x) for x in found.trajectory[:-1]])
    np.testing.assert_allclose(found.disturbances, w, rtol=0, atol=1e-14 * abs(w).max() + 1e-15)


class Hidden:
    """A model with a number that it reads through a built-in function, where nothing can see it."""

    def __init__(self):
        self.values = {"gain": 0.1}
        self.read = types.SimpleNamespace(get=self.values.__getitem__)

    def system(self, above):
        read = self.read

        def f(x):
            return x @ A.T + np.where(x[..., :1] > above, read.get("gain"), 0.0)

        return qpmhe.System(f, lambda x: x[..., :1], n=2, p=1)


@pytest.mark.parametrize("engine", ENGINES)
def test_verify_finds_what_cannot_be_seen(engine):
    hidden = Hidden()
    mhe = estimator(hidden.system(-100.0), engine, time_budget=10.0)
    assert mhe.verify()
    hidden.values["gain"] = 0.3
    mhe.update([0.2])
    with pytest.warns(EngineWarning, match="f has changed since it was traced"):
        assert not mhe.verify()
    assert mhe.engine == "python"
    assert mhe.verify()  # nothing is traced any more


@pytest.mark.parametrize("engine", ENGINES)
def test_a_change_before_an_estimator_is_made_is_seen_when_it_is_made(engine):
    """Also of a branch that the initial state does not reach, but the first window may."""
    hidden = Hidden()
    system = hidden.system(1.3)
    estimator(system, engine)
    hidden.values["gain"] = 0.3
    with pytest.warns(EngineWarning, match="f has changed since it was traced"):
        mhe = estimator(system, engine)
    found = mhe.update([9.0])
    steps = np.array([system.f(x) for x in found.trajectory[:-1]])
    np.testing.assert_allclose(
        found.disturbances, found.trajectory[1:] - steps, rtol=0, atol=1e-13
    )
