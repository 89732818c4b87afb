"""Functions of NumPy as CasADi expressions: the same numbers, or no trace and the reason."""

import contextlib
import itertools
import math
import subprocess
import sys
import warnings

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.errors import EngineWarning, OptionError
from qpmhe.model.captured import Due
from qpmhe.model.tracing import traced
from tests.estimation import spoil
from tests.estimation.same import Interruption
from tests.estimation.spoil import cost_of

ZOO = qpmhe.models.catalogue()
ENGINES = ["python", "compiled"] if find_compiler() else ["python"]
KEPT, YS = [], np.random.default_rng(0).normal(size=200)

A = np.array([[0.9, 0.2], [-0.1, 0.8]])


def in_place(x):
    y = np.eye(2) @ x
    y += np.sin(x)
    y[..., 0] *= 2.0
    np.divide(1.0, x, out=y, where=np.abs(x) > 0.5)
    return y


STRAIGHT = {
    # NumPy's generator itself calls `numpy.empty` for an array of numbers.
    "compiled code": lambda x: np.random.default_rng(3).normal(size=2) + np.array(x),
    "in place": in_place,
    "dot": lambda x: np.dot(A, x) + x.dot(A),
    "a product over nothing": lambda x: x + x[2:] @ np.zeros((0, 2)),
    "einsum": lambda x: np.einsum("ij,...j->...i", A, x),
    "cross": lambda x: np.cross(np.array([x[0], x[1], 1.0]), [1.0, 2.0, 3.0]),
    "solve": lambda x: np.linalg.solve(np.array([[2.0 + x[0] ** 2, 1.0], [1.0, 3.0]]), x),
    "inv and det": lambda x: np.linalg.inv(np.diag(2.0 + x**2)) * np.linalg.det(A * x[0]),
    "norm": lambda x: x / (1.0 + np.linalg.norm(x, axis=-1, keepdims=True)),
    "norms": lambda x: [np.linalg.norm(x, 1), np.linalg.norm(x, np.inf), np.clip(x[0], -1, 2)],
    "sums": lambda x: x + x.sum() + np.mean(x) + x.prod() + np.cumsum(x) + np.std(x),
    "where": lambda x: np.where((x > 0.0) & (x < 9.0), x, 2.0 * x),
    "extrema": lambda x: np.maximum(x, 0.0) + np.minimum(x[::-1], x) + x.max() - np.min(x),
    "arctan2": lambda x: [np.arctan2(x[1], x[0]), np.hypot(x[0], x[1])],
    "wrapped": lambda x: (x + np.pi) % (2.0 * np.pi) - np.pi,
    "whole numbers": lambda x: np.floor(x) + np.ceil(x) + np.trunc(x) + np.rint(x) + x % -0.2,
    "powers": lambda x: np.abs(x) ** 0.3 + x**3 + np.square(x) + np.cbrt(x) + 2.0**x,
    "transcendental": lambda x: (
        np.log(np.abs(x)) + np.log1p(x * x) + np.expm1(0.01 * x) + np.tanh(x) + np.arctan(x)
    ),
    "tables": lambda x: (
        np.interp(x, [0.0, 2.0], [1.0, 3.0], left=-1.0, right=7.0) + np.round(x, 1)
        + np.select([x < 0.0, x > 3.0], [x, 3.0 + 0.0 * x], 1.0) + np.heaviside(x, 0.5)
    ),
    "loop over components": lambda x: [sum(v * v for v in np.hstack((x, [1.0]))), abs(x[0])],
    "outside of the domain": lambda x: np.sqrt(x) + np.log(x) + np.arccos(x),
    "truth values": lambda x: (x > 0.0) * x + ((x > 0.0) + (x > 1.0)) + np.sum(x > 0.0) + ~(x > 2),
    "any": lambda x: np.where(np.any(x > 1.0), x, -x) + np.where(np.all(x > 1.0), 1.0, x),
    "pieces": lambda x: np.concatenate((x[1:], x[:1])) + np.roll(x, 1) + np.stack((x[1], x[0])),
    "math": lambda x: math.atan2(x[0], x[1]) + math.sqrt(x[0] ** 2) + math.log(abs(x[1])),
    "constants": lambda x: np.linalg.inv(A) @ np.outer(x, x) @ x + np.linspace(0.0, 1.0, 2),
}


def points(count=60):
    generator = np.random.default_rng(1)
    # Where functions jump, tie, or have no value.
    yield from generator.choice([-2.0, -1.0, -0.5, 0.0, 0.25, 0.5, 1.0, 1.5, 3.0], (count, 2))
    for k in range(count):
        scale = 10.0 ** generator.uniform(-3.0, 2.0)
        yield scale * generator.uniform(-1.0 if k % 2 else 0.0, 1.0, 2)


def test_a_traced_function_gives_the_same_numbers():
    for way, function in STRAIGHT.items():
        found = traced(function, (2,))
        assert found.function is not None, (way, found.reason)
        for x in points():
            with np.errstate(all="ignore"):
                mine = np.array(found.function(x)).reshape(found.shape)
                try:
                    expected = np.asarray(function(x.copy()), float)
                except ValueError:  # math raises where NumPy returns NaN
                    assert not np.isfinite(mine).all()
                    continue
            assert expected.shape == found.shape
            np.testing.assert_allclose(mine, expected, rtol=1e-12, atol=1e-13, err_msg=way)


def swallowed(x):
    try:
        beyond = bool(x[0] > 12.0)
    except Exception:  # whatever the symbol raises
        beyond = False
    return 0.5 * x if beyond else 0.95 * x


def remembered(x):
    KEPT.append(x)
    return x + 1e-3 * KEPT[-2] if len(KEPT) > 1 else x


# The function, and a word of the reason why it is not traced.
BAD = {
    "a branch": (lambda x: x if x[0] > 12.0 else 2.0 * x, "branch"),
    "float()": (lambda x: float(x[0]) * x, "float()"),
    "a type": (lambda x: x if type(x[0]) is np.float64 else -x, "same expression"),
    "what it was called with": (remembered, "same expression"),
    "random numbers": (lambda x: x + np.random.default_rng().normal(), "again"),
    "a special function": (lambda x: __import__("scipy.special").special.gamma(x), "gamma"),
    "an exception": (lambda x: 1 / 0, "ZeroDivisionError"),
}


def test_a_function_that_asks_for_more_is_not_traced():
    for way, (function, word) in BAD.items():
        found = traced(function, (2,))
        assert found.function is None, way
        assert word in found.reason, way
    line = swallowed.__code__.co_firstlineno + 2
    assert f"{__file__}:{line} asks for" in traced(swallowed, (2,)).reason


COMPILED = """
import numpy as np
from qpmhe.model.tracing import traced

def shifted(x):
    out = np.empty(2)
    out[:] = x + np.random.default_rng(0).normal(size=2)
    return out

assert traced(shifted, (2,)).function, traced(shifted, (2,)).reason
"""


def test_compiled_functions_find_numpy_as_it_is():
    """NumPy's generators write numbers into what ``numpy.empty`` gives them: no symbols there."""
    done = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_numpy_is_itself_after_a_trace():
    before = np.zeros, np.array, math.sin
    for lines in (1, 3, 6, 12, 30, 40, 60, 100, 150, 200):  # interrupted, too
        with Interruption(lines), contextlib.suppress(KeyboardInterrupt, SystemError):
            traced(in_place, (2,))
    traced(swallowed, (2,))
    assert (np.zeros, np.array, math.sin) == before
# Models


@pytest.mark.whole
@pytest.mark.parametrize("name", ZOO)
def test_models_of_the_zoo_are_traced_and_are_the_same(name):
    """At states of a simulation."""
    example = ZOO[name]()
    system, scenario = example.system, example.scenario
    assert system.derivatives == {"f": "traced", "h": "traced"}, system.explain()
    record, own = scenario.simulate(1, 12), system.evaluated_by(system.model())
    for k, x in enumerate(record.states[:12]):
        u = record.inputs[k] if system.m else np.zeros(0)
        for which in ("f", "h"):
            found, expected = getattr(own, which)(x, u), getattr(system, which)(x, u)
            size = np.abs(expected).max() if which == "f" else np.abs(expected)
            assert (np.abs(found - expected) <= 1e-12 * size).all()


class Plant:
    """A model whose parameter can change behind one's back."""

    def __init__(self):
        self.gain = 0.1

    def f(self, x):
        return x @ A.T + self.gain * np.sin(x)

    def h(self, x):
        return x[..., :1]

    def system(self, **options):
        return qpmhe.System(self.f, self.h, n=2, p=1, **options)


def estimator(system, engine="python", **options):
    return spoil.estimator(
        system, qpmhe.Luenberger([0.4, 0.1]), cost_of(disturbance=10.0 * np.eye(2), noise=4.0),
        horizon=5, initial_state=[1.0, -1.0], max_qps=2, engine=engine, **options,
    )


def update_all(mhe, ys):
    for y in ys:
        estimate = mhe.update(y)
    return estimate


def cost_by_hand(plant, estimate, measured):
    x = estimate.trajectory
    w, v = x[1:] - plant.f(x[:-1]), np.array(measured)[:, None] - plant.h(x[:-1])
    prior = ((x[0] - estimate.candidate[0]) ** 2).sum()
    return prior + 10.0 * (w**2).sum() + 4.0 * (v**2).sum()


def has_changed():
    return pytest.warns(EngineWarning, match="f has changed since it was traced")


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("call", ["update", "run"])
def test_a_closure_that_changes_is_found_and_no_sample_is_lost(call, engine):
    plant = Plant()
    mhe = estimator(plant.system(), engine)
    update_all(mhe, YS[:40])
    plant.gain = 0.3
    go_on = mhe.run if call == "run" else lambda ys: update_all(mhe, ys)
    with has_changed():
        go_on(YS[40:120])
    assert (mhe.engine, mhe.time) == ("python", 120)
    assert not mhe._engine.system.evaluation.is_traced
    for t in range(120, 140):
        estimate = mhe.update(YS[t])
        if t >= 125:
            by_hand = cost_by_hand(plant, estimate, YS[t - 4 : t + 1])
            assert estimate.cost == pytest.approx(by_hand, rel=1e-12)
        assert estimate.cost <= estimate.candidate_cost


@pytest.mark.parametrize("engine", ENGINES)
def test_a_warning_as_an_error_takes_no_sample(engine):
    plant = Plant()
    mhe = estimator(plant.system(), engine)
    mhe.update(0.5)
    plant.gain = 0.3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(EngineWarning):
            mhe.update(0.4)
        assert mhe.time == 1
        estimate = mhe.update(0.4)
    assert estimate.cost == pytest.approx(cost_by_hand(plant, estimate, [0.5, 0.4]), rel=1e-12)


@pytest.mark.parametrize("engine", ENGINES)
def test_an_interrupt_while_a_trace_is_left_does_not_keep_it(engine):
    """At each of the calls of f until the sample is taken."""
    class Interrupting(Plant):
        left = np.inf

        def f(self, x):
            self.left -= 1
            if self.left < 0 and type(x) is np.ndarray and x.dtype == np.float64:
                self.left = np.inf
                raise KeyboardInterrupt
            return super().f(x)

    plant = Interrupting()
    for calls in itertools.count():
        plant.gain, plant.left = 0.1, np.inf
        mhe = estimator(plant.system(), engine)
        mhe.update(0.5)
        plant.gain, plant.left = 0.3, calls
        with has_changed():
            try:
                mhe.update(0.4)
                break
            except KeyboardInterrupt:
                assert mhe.time == 1
                estimate = mhe.update(0.4)
        by_hand = cost_by_hand(plant, estimate, [0.5, 0.4])
        assert estimate.cost == pytest.approx(by_hand, rel=1e-12)
    assert calls > 4


@pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
@pytest.mark.parametrize("options", [
    {"candidate": "reinitialized"}, {"arrival": "smoothed", "warm_start": True},
], ids=["reinitialized", "smoothed"])
def test_what_a_compiled_estimator_hands_over_is_all_it_knew(options):
    one, two = (estimator(Plant().system(), engine, **options) for engine in ENGINES)
    for t, y in enumerate(YS[:30]):
        own = {"noise_weight": [[7.0]]} if t % 5 == 2 else {}
        expected, expectation = one.update(y, **own), contextlib.nullcontext()
        if t == 20:
            # As if its trace had failed, without any difference.
            vars(two._engine._system.evaluation)["fault"] = lambda where: "no difference"
            two._engine._times.due = lambda time: Due.HERE
            two._engine._times.next = 0
            expectation = pytest.warns(EngineWarning, match="no difference")
        with expectation:
            found = two.update(y, **own)
        np.testing.assert_allclose(found.trajectory, expected.trajectory, atol=1e-8)
        assert found.cost == pytest.approx(expected.cost, rel=1e-8)
    assert two.engine == "python"


# Models that are not traced, or in part


def branching(x):
    return x if x[0] > 12.0 else 0.5 * x


@pytest.mark.skipif(len(ENGINES) < 2, reason="there is no C compiler")
@pytest.mark.parametrize("call", ["update", "run"])
def test_a_batch_goes_on_in_python_where_a_closure_has_changed(call):
    """Each member as a single estimator, and no sample is lost."""
    plant, ys = Plant(), YS[:180].reshape(3, 60)
    start = np.array([[1.0, -1.0]]) + 0.1 * np.arange(3)[:, None]
    singles = [estimator(plant.system(), "compiled") for _ in start]
    batch = qpmhe.BatchEstimator(
        plant.system(), singles[0].observer, singles[0].cost, members=3, initial_states=start,
        horizon=5, max_qps=2, engine="compiled",
    )
    for one, own in zip(singles, start, strict=True):
        one.reset(own)
    for mhe, records in zip((batch, *singles), (ys.T, *ys), strict=True):
        update_all(mhe, records[:20])
    plant.gain = 0.3
    for mhe, records in zip((batch, *singles), (ys[:, 20:], *ys[:, 20:]), strict=True):
        with has_changed():
            mhe.run(records) if call == "run" else update_all(mhe, records.T)
    assert (batch.engine, batch.mode, batch.time) == ("python", "looped", 60)
    np.testing.assert_allclose(batch.states, [one.state for one in singles], 1e-9, 1e-12)


def test_what_cannot_be_traced_is_used_as_it_is_written():
    system = qpmhe.System(branching, lambda x: np.sin(x[..., :1]), n=2, p=1)
    assert system.derivatives == {"f": "finite differences", "h": "traced"}
    assert system.symbolic is None
    line, text = branching.__code__.co_firstlineno + 1, system.explain()
    assert f"f: not traced: {__file__}:{line} asks for the truth of a comparison" in text
    assert "h: traced" in text
    estimate = update_all(estimator(system), YS[:20])
    assert estimate.cost <= estimate.candidate_cost
    with pytest.raises(OptionError, match="asks for the truth"):
        estimator(system, "compiled")
