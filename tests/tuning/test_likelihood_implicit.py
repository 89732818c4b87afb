"""The likelihood in C of models with implicit steps: NumPy's, and its slope that of differences."""

import threading

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen import filters as library
from qpmhe.diagnosis import bank
from qpmhe.diagnosis.bank import FilterBank, Hypothesis
from tests.diagnosis.test_compiled_filters import check_same as check_filtered
from tests.tuning.test_likelihood import check_slope, problem


def rate(x, u, a):
    """A fast and a slow state, of which the fast one drives the slow one; then one in a unit."""
    fast, slow = x[..., 0], a * x[..., 1]
    drive = u[..., 0] if u.shape[-1] else 0.5
    pull = u[..., 1] if u.shape[-1] > 1 else 1.0
    return np.stack([
        -50.0 * pull * (fast - np.cos(slow)) - fast**3, (-slow + fast * drive) / a,
    ], axis=-1)


def made(kind, unit=1.0, m=1, steps=2):
    """A model of each kind, its second state in another unit."""
    sizes = {"dt": 0.2, "n": 2, "p": 2, "m": m, "steps": steps}

    def output(x, u):
        return np.stack([x[..., 0] + 0.1 * (unit * x[..., 1]) ** 2, x[..., 1] * u[..., 0]], -1)

    if kind in ("radau", "midpoint"):
        return qpmhe.System.from_ode(
            lambda x, u: rate(x, u, unit), output, method=kind, **sizes)
    if kind == "implicit":
        return qpmhe.System.from_implicit(
            lambda xdot, x, u: (2.0 + np.sin(x)) * (xdot - rate(x, u, unit)), output, **sizes)
    states = {"states": qpmhe.Box([-0.9, -np.inf], [0.9, np.inf])} if kind == "dae" else {}
    return qpmhe.System.from_dae(
        lambda x, z, u: rate(x, u, unit) * z[..., :1] + 0.1 * z[..., 1:],
        lambda x, z, u: np.stack([
            z[..., 0] + 0.2 * z[..., 0] ** 3 - 1.2 - 0.1 * np.sin(unit * x[..., 1]) * z[..., 1],
            z[..., 1] - x[..., 0] * z[..., 0],
        ], axis=-1),
        lambda x, z, u: np.stack(
            [x[..., 0] + 0.3 * z[..., 0] ** 2, x[..., 1] * z[..., 0] * u[..., 0]], -1),
        k=2, algebraic_guess=[1.0, 0.0], **sizes, **states,
    )


KINDS = ["radau", "midpoint", "dae", "implicit"]


def record(unit=1.0, m=1, samples=40, dt=None, missing=True):
    generator = np.random.default_rng(0)
    y = 0.5 + 0.2 * generator.standard_normal((samples, 2))
    y[:, 1] /= unit
    if missing:
        y[generator.random(y.shape) < 0.2] = np.nan
        y[10:14] = np.nan
    u = np.repeat(generator.uniform(0.5, 1.5, (-(-samples // 5), m)), 5, axis=0)[:samples]
    start = [0.5, 0.5 / unit]
    return qpmhe.tuning.TuningRecord(y, u, dt=dt, initial_state=start)


def covariances(unit=1.0, vague=1.0):
    scale = np.array([1.0, 1.0 / unit])
    units = np.outer(scale, scale)
    return vague * 0.04 * units * np.eye(2), 1e-3 * units * np.eye(2), 0.02 * units * np.eye(2)


def both(system, given, parts, **options):
    """The likelihood by NumPy, the one in C, and where to compare them."""
    found = [problem(system, given, parts, **options)[0] for _ in range(2)]
    found[1].compile(always=True)
    assert not found[1].not_compiled
    start = found[0].structure.start
    return *found, start + 0.1 * np.sin(np.arange(1, 1 + len(start)))


def check_values(first, second, theta, tolerance=1e-9):
    every = [np.ones(len(one), np.bool_) for one in first.data]
    expected = first.value(theta, every)
    assert np.isfinite(expected)
    assert second.value(theta, every) == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize(("kind", "structure", "threshold", "steps"), [
    ("radau", "full", None, 1), ("dae", "diagonal", 1.5, 2), ("midpoint", "full", 1.5, 3),
    ("implicit", "full", None, 1), ("dae", "full", None, 1), ("radau", "diagonal", 2.0, 4),
])  # fmt: skip
def test_it_is_the_one_of_numpy_and_its_slope_the_one_of_differences(
    kind, structure, threshold, steps
):
    options = {"structure": structure, "threshold": threshold}
    first, second, theta = both(made(kind, steps=steps), record(), covariances(), **options)
    check_values(first, second, theta)
    check_slope(second, theta, 40)
    _, expected = first.gradient(theta)
    _, slope = second.gradient(theta)
    np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-6 * np.linalg.norm(expected))


@pytest.mark.parametrize(("kind", "unit", "vague"), [
    ("dae", 1e6, 1e10), ("radau", 1e-6, 1e10), ("implicit", 1e-6, 1.0), ("midpoint", 1e6, 1.0),
])  # fmt: skip
def test_vague_priors_and_units(kind, unit, vague):
    # From so vague a prior, one start is as good as another: a sample that tells both states.
    given = record(unit, missing=False)
    first, second, theta = both(made(kind, unit), given, covariances(unit, vague))
    check_values(first, second, theta, 1e-9 * max(1.0, vague / 1e7))
    slopes = [one.gradient(theta, [np.ones(40, np.bool_)])[1] for one in (first, second)]
    error = 1e-6 * max(1.0, vague / 1e7) * np.linalg.norm(slopes[0])
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=0, atol=error)


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_among_the_inputs_and_steps_of_other_lengths(kind):
    generator = np.random.default_rng(0)
    given = record(m=1, dt=generator.uniform(0.1, 0.4, 40))
    first, second, theta = both(
        made(kind, m=2), given, covariances(), inputs=1, parameters={"pull": 0.7})
    check_values(first, second, theta)
    check_slope(second, theta, 40)


@pytest.mark.parametrize("kind", ["dae", "radau"])
def test_filters_under_hypotheses_are_those_of_numpy(kind, monkeypatch):
    system, given = made(kind), record(samples=60)
    prior, disturbance, noise = covariances()
    base = Hypothesis(
        given.measurements, given.inputs, noise, disturbance,
        np.array(given.initial_state), prior)
    tried = [
        base, Hypothesis(**vars(base) | {"outliers": True}),
        Hypothesis(**vars(base) | {"disturbance": 100.0 * disturbance}),
        Hypothesis(**vars(base) | {"step": 1.1}),
    ]
    expected = FilterBank(system, None).run(tried)
    monkeypatch.delenv("QPMHE_ENGINE", raising=False)
    filters = FilterBank(system, None, filters=10**9)
    filters.run(tried[:1])  # compiles, and compares with NumPy
    assert bank._libraries[system][()] is not None
    monkeypatch.setattr(filters, "_run_in_numpy", lambda *_: pytest.fail("it is not compiled"))
    check_filtered(filters.run(tried), expected)


def test_where_a_step_does_not_exist_it_costs_infinitely_much():
    system = qpmhe.System.from_ode(
        lambda x: x**2, lambda x: x, dt=1.0, n=1, p=1, method="radau")
    given = qpmhe.tuning.TuningRecord(
        np.r_[np.full(41, 1e-3), 5.0, np.full(8, np.nan)][:, None], initial_state=[1e-3])
    one = np.eye(1)
    first, second, theta = both(system, given, (one, one, 1e-4 * one))
    every = [np.ones(50, np.bool_)]
    assert first.value(theta, every) == second.value(theta, every) == np.inf
    assert second.gradient(theta, every)[0] == np.inf


def test_wrong_code_is_found(monkeypatch):
    system, given, parts = made("radau"), record(), covariances()
    right = library.LikelihoodLibrary.adjoint

    def wrong(self, *arguments):
        value, *by = right(self, *arguments)
        by[1] *= 1.01
        return value, *by

    monkeypatch.setattr(library.LikelihoodLibrary, "adjoint", wrong)
    monkeypatch.setattr("qpmhe.codegen.compiler._LEVELS", (("-O0",),))
    likelihood, plan = problem(system, given, parts)
    expected = likelihood.value(plan.start)
    likelihood.compile(always=True)
    assert "slope" in likelihood.not_compiled
    assert likelihood.value(plan.start) == expected


@pytest.mark.slow
def test_the_adjoint_of_many_substeps_needs_no_large_stack(monkeypatch):
    # NumPy's filter would take long.
    monkeypatch.setattr("qpmhe.tuning.likelihood._Filter._compared_with_numpy", lambda *_: "")
    n, steps = 8, 1000  # which have a megabyte of Jacobians
    system = qpmhe.System.from_ode(
        lambda x: np.roll(x, 1, axis=-1) - 2.0 * x, lambda x: x[..., :1], dt=0.1, n=n, p=1,
        method="radau", steps=steps)
    given = qpmhe.tuning.TuningRecord(np.ones((2, 1)), initial_state=np.zeros(n))
    likelihood, plan = problem(
        system, given, (np.eye(n), 0.01 * np.eye(n), np.eye(1)), "scalar")
    likelihood.compile(always=True)
    assert not likelihood.not_compiled
    size = threading.stack_size(2**19)
    try:
        thread = threading.Thread(target=check_slope, args=(likelihood, plan.start, 2))
        thread.start()
        thread.join()
    finally:
        threading.stack_size(size)
