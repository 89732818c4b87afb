"""`System.model`: one object for all that is computed from f and h; a System never changes."""

import ast
import copy
import pickle
from pathlib import Path

import numpy as np
import pytest

import qpmhe
from qpmhe.model.model import Expression, Functions
from tests.estimation.spoil import cost_of
from tests.estimation.untraced import untraced

PACKAGE = Path(qpmhe.__file__).parent
SCALES = [2.0, 0.5]


def rate(x, u):
    return np.array([x[1], u[0] - np.sin(x[0])])


def output(x):
    return x[:1] + 0.1 * x[1:] ** 2


def pendulum(change=lambda one: one, **options):
    return qpmhe.System.from_ode(
        change(rate), change(output), dt=0.1, n=2, p=1, m=1, **options
    )


KINDS = {"Expression": lambda one: one, "Functions": untraced}


def in_casadi():
    ca = pytest.importorskip("casadi")
    return qpmhe.from_casadi(
        lambda x, u: ca.vertcat(x[1], u[0] - ca.sin(x[0])),
        lambda x: x[0] + 0.1 * x[1] ** 2, n=2, p=1, m=1, dt=0.1, compiled=False,
    )


def points(count, m=1):
    generator = np.random.default_rng(7)
    return generator.uniform(-2.0, 2.0, (count, 2)), generator.uniform(-1.0, 1.0, (count, m))


@pytest.mark.parametrize("kind", [*KINDS, "CasADi"])
def test_a_model_of_any_kind_computes_the_same(kind):
    system = in_casadi() if kind == "CasADi" else pendulum(KINDS[kind])
    model = system.model(SCALES)
    assert type(model.functions) is (Functions if kind == "Functions" else Expression)
    x, u = points(6)
    k1 = rate(x.T, u.T).T
    k2 = rate((x + 0.05 * k1).T, u.T).T
    k3 = rate((x + 0.05 * k2).T, u.T).T
    k4 = rate((x + 0.1 * k3).T, u.T).T
    ahead = x + 0.1 / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    there = x[:, :1] + 0.1 * x[:, 1:] ** 2
    np.testing.assert_allclose(model.step(x, u), ahead, 1e-13)
    np.testing.assert_allclose(model.output(x, u), there, 1e-13)
    y = np.linspace(-1.0, 1.0, 5)[:, None]
    residuals = model.residuals(x, y, u[:5])
    expected = np.hstack((x[1:] - ahead[:5], y - there[:5]))
    np.testing.assert_allclose(residuals, expected, 1e-12, 1e-13)
    # Derivatives against differences of the values, and second ones against those of the first.
    a, c = model.linear(x, u)
    forces, h = np.random.default_rng(8).standard_normal((6, 3)), 1e-6
    curvature = model.curvature(x, u, forces)
    for j, move in enumerate(h * np.eye(2)):
        for found, function in ((a, model.step), (c, model.output)):
            slope = (function(x + move, u) - function(x - move, u)) / (2.0 * h)
            np.testing.assert_allclose(found[:, :, j], slope, 0.0, 1e-8)
        both = [np.concatenate(model.linear(x + sign * move, u), axis=1) for sign in (1.0, -1.0)]
        bent = np.einsum("kq,kqn->kn", forces, (both[0] - both[1]) / (2.0 * h))
        np.testing.assert_allclose(curvature.own[:, :, j], bent, 0.0, 2e-3)
    # Steps of other lengths: two of half a step are one.
    halves = np.hstack((u, np.full((6, 1), 0.05)))
    twice = model.timed.step(model.timed.step(x, halves), halves)
    np.testing.assert_allclose(twice, ahead, 1e-6)


def test_a_model_is_made_once_for_each_magnitude():
    system = pendulum()
    assert system.model(SCALES) is system.model(np.array(SCALES))
    assert system.model(SCALES) is not system.model([1.0, 1.0])
    with_sets = system.with_sets({"states": qpmhe.Box([-9.0, -9.0], [9.0, 9.0])})
    assert with_sets.model(SCALES) is system.model(SCALES)
    given = pendulum(scales=[1.0, 1.0])
    assert given.model(SCALES) is given.model()
    np.testing.assert_array_equal(given.model(SCALES).scales, [1.0, 1.0])


def test_a_closure_that_has_changed_gives_another_model():
    gain = [0.5]
    system = qpmhe.System(lambda x: gain[0] * x, lambda x: x, n=1, p=1)
    before = system.model([1.0])
    assert system.model([1.0]) is before
    gain[0] = 0.9
    x, u = np.ones((1, 1)), np.zeros((1, 0))
    assert system.model([1.0]).step(x, u) == 0.9
    assert before.step(x, u) == 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_an_estimator_never_changes_a_system(kind):
    """Not when it is made, by samples, `set`, `reset`, steps of other lengths or snapshots."""
    system = pendulum(KINDS[kind])
    before, methods = dict(vars(system)), system.evaluation.methods
    values = [one(np.array([0.3, -0.2]), np.array([0.1])) for one in (system.f, system.f_jacobian)]
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.Luenberger([0.4, 0.1]), cost_of(disturbance=10.0 * np.eye(2), noise=4.0),
        horizon=4, initial_state=[40.0, -1.0], max_qps=2, engine="python",
    )
    for t in range(7):
        mhe.update(40.0 + 0.1 * t, [0.1], **({"dt": 0.07} if t == 4 else {}))
    saved = mhe.state_dict()
    mhe.set(noise_weight=[[2.0]])
    mhe.reset([300.0, 1.0])
    mhe.update(300.0, [0.1])
    mhe.load_state_dict(saved)
    after = dict(vars(system))
    after.pop("timed", None)  # made when it is first asked for
    assert after.keys() == before.keys()
    assert all(after[name] is before[name] for name in before)
    assert system.evaluation.methods == methods
    for one, value in zip((system.f, system.f_jacobian), values, strict=True):
        np.testing.assert_array_equal(one(np.array([0.3, -0.2]), np.array([0.1])), value)


def test_no_attribute_of_a_system_can_be_set():
    system = pendulum()
    for name in [*vars(system), *(one for one in dir(type(system)) if not one.startswith("__"))]:
        with pytest.raises(AttributeError, match=f"a System does not change: {name} cannot be set"):
            setattr(system, name, None)
        with pytest.raises(AttributeError, match="a System does not change"):
            delattr(system, name)
    for other in (copy.copy(system), copy.deepcopy(system)):
        assert other.method == "rk4"
    model = system.model()
    with pytest.raises(AttributeError):
        model.scales = None
    with pytest.raises((AttributeError, pickle.PicklingError)):
        pickle.dumps(qpmhe.System(lambda x: x, lambda x: x, n=1, p=1))


def test_no_other_file_reaches_into_a_system():
    """Nor goes round its refusal."""
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.parts[-2:] == ("model", "system.py"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.Assign, ast.AugAssign, ast.AnnAssign)):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for one in targets:
                    words = ast.unparse(one)
                    assert not (
                        isinstance(one, ast.Attribute)
                        and ast.unparse(one.value).rpartition(".")[2] in ("system", "_system")
                    ), f"{path}:{node.lineno} sets {words}"
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                words = ast.unparse(node.func)
                assert words != "object.__setattr__" or "system" not in ast.unparse(node), (
                    f"{path}:{node.lineno}"
                )
