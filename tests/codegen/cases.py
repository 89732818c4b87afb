"""Estimators with every feature of the step, each with a record: one table for all tests of C."""

from __future__ import annotations

import functools
import warnings
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

import qpmhe
from qpmhe import (
    Box,
    Constraint,
    Gate,
    HuberInnovation,
    Luenberger,
    ObserverPrior,
    Polytope,
    QuadraticCost,
)
from qpmhe.models.batch_reactor import batch_reactor
from qpmhe.models.batch_reactor import casadi_output as reactor_output
from qpmhe.models.batch_reactor import casadi_rate as reactor_rate

EKF, UKF = qpmhe.ExtendedKalman, qpmhe.UnscentedKalman
STEPS, INF = 24, np.inf
TERMS = ("prior", "disturbance", "noise")


@dataclass(frozen=True)
class Case:
    """Arguments of an estimator, of each `update`, and of `set` after some samples, by number.

    Both engines must agree to ``tolerance``, relative to what is compared.
    """

    system: qpmhe.System
    observer: qpmhe.Observer
    cost: qpmhe.Cost
    start: Any
    samples: tuple[dict[str, Any], ...]
    options: dict[str, Any] = field(default_factory=lambda: {"horizon": 5, "max_qps": 2})
    tolerance: float = 1e-9
    changes: dict[int, dict[str, Any]] = field(default_factory=dict)

    def estimator(self, engine, **options):
        """An estimator of this case."""
        with warnings.catch_warnings():
            # Of a start outside of the states, which some cases have.
            warnings.simplefilter("ignore", qpmhe.errors.ObserverWarning)
            return qpmhe.MovingHorizonEstimator(
                self.system, self.observer, self.cost, initial_state=self.start, engine=engine,
                **(self.options | options),
            )

    def with_options(self, **options):
        """The case with other options."""
        return replace(self, options=self.options | options)


def spd(seed, n):
    """A positive definite matrix that is not diagonal."""
    root = np.random.default_rng(seed).standard_normal((n, n))
    return root @ root.T + 0.5 * np.eye(n)


def recorded(system, start, *, seed=3, disturbance=0.02, noise=0.1, steps=STEPS):
    """Samples of the system along a disturbed trajectory that starts near a state."""
    generator = np.random.default_rng(seed)
    x, samples = np.asarray(start) + noise * generator.standard_normal(system.n), []
    for u in generator.uniform(-1.0, 1.0, (steps, system.m)):
        y = system.h(x, u) + noise * generator.standard_normal(system.p)
        samples.append({"y": y, "u": u} if system.m else {"y": y})
        x = system.f(x, u) + disturbance * generator.standard_normal(system.n)
    return tuple(samples)


# Changes of a case.


def samples_with(one, change):
    """The case with what a function of time and measurement says of each sample."""
    return replace(one, samples=tuple(
        sample | change(t, np.array(sample["y"], float)) for t, sample in enumerate(one.samples)
    ))


def gaps(one):
    """The case with missing components, missing samples and, of an ODE, other steps."""

    def own(t, y):
        if t % 5 == 3:
            y[t % y.size] = np.nan
        if t % 11 == 7:
            y[:] = np.nan
        return {"y": y} | ({"dt": 0.7 * one.system.dt} if one.system.dt and t % 6 == 4 else {})

    return samples_with(one, own)


def outliers(one):
    """The case with a large error in some of its measurements, and a fault that lasts."""
    generator, p = np.random.default_rng(17), one.system.p
    scale = np.std([np.array(sample["y"], float) for sample in one.samples], axis=0)

    def own(t, y):
        y += (generator.random(p) < 0.15) * generator.choice([-1.0, 1.0], p) * 10.0 * scale
        y[0] += 8.0 * scale[0] * (9 <= t < 16)
        return {"y": y}

    return samples_with(one, own)


def far(one):
    """The case from a start that is far off, with a constant gain that is much smaller."""
    gain, start = one.observer.constant_gain, np.asarray(one.start) + 3.0
    observer = one.observer if gain is None else Luenberger(0.01 * gain)
    return replace(one, start=start, observer=observer)


def jumping(one):
    """The case with states that jump beyond what the observer takes for likely, as measured."""
    return samples_with(one, lambda t, y: {"y": y + 8.0 * (t >= 8)})


def looser(one):
    """The case whose engines agree to fewer digits, as rounding decides."""
    return replace(one, tolerance=1e-7)


def by(observer):
    """A change to another observer."""
    return lambda one: replace(one, observer=observer(one))


def prior_by(weight=None):
    """A change to a prior with a weight, or that of the observer."""

    def changed(one):
        kept = {name: getattr(one.cost, name) for name in ("disturbance", "noise", "discount")}
        prior = ObserverPrior() if weight is None else weight
        return replace(one, cost=QuadraticCost(prior=prior, **kept))

    return changed


def filtered(make=EKF, weight=None, scale=1.0, innovation=None, **given):
    """A change to a filter of the cost's covariances, times a factor, or of those given.

    It weighs the prior, unless a weight is given, or judges the innovations.
    """

    def changed(one):
        covariances = {
            name: scale * np.linalg.inv(getattr(one.cost, name)) for name in TERMS
            if name not in given
        } | given
        if innovation is not None:
            return replace(one, observer=make(innovation=innovation, **covariances))
        return prior_by(weight)(replace(one, observer=make(**covariances)))

    return changed


def judged(innovation, make=EKF):
    """A change to outliers, and an observer that judges them."""
    change = filtered(make, innovation=innovation, scale=0.01)
    return lambda one: change(outliers(one))


def other_weights(one, t):
    """Weights of noise and disturbance; diagonal where the cost's are."""
    found = {}
    for name in ("noise", "disturbance"):
        usual = getattr(one.cost, name)
        factor = np.diag(1.0 + 0.2 * np.sin(t + np.arange(len(usual))))
        found[f"{name}_weight"] = factor @ usual @ factor
    return found


def other_bounds(one, lower, upper):
    """The sets of the system, with sides so many times as far from their middle."""
    found = {}
    for name in ("states", "disturbances", "noises"):
        usual, sides = one.system.set_of(name), []
        if usual is not None:
            for low, high in ((usual.lower, usual.upper), (usual.row_lower, usual.row_upper)):
                half = np.where(np.isfinite(high - low), 0.5 * (high - low), 0.2)
                sides += [low + (1.0 - lower) * half, high - (1.0 - upper) * half]
            found[name] = usual.with_sides(*sides)
    return {"bounds": found} if found else {}


def with_conditions(one):
    """The case with other weights, bounds, sensors, parameters and steps at some samples."""
    p, parameters = one.system.p, np.array(one.options.get("parameters", ()))

    def own(t, y):
        found, kind, weights = {}, t % 7, other_weights(one, t)
        if kind in (1, 6):
            found["noise_weight"] = weights["noise_weight"]
        if kind in (2, 6):
            found["disturbance_weight"] = weights["disturbance_weight"]
        if kind in (3, 6):
            found |= {"sensors": [t % p] if t % 2 else np.arange(p) == t % p, "y": y[[t % p]]}
        if kind in (4, 6):
            found |= other_bounds(one, 0.8, 0.6 + 0.05 * (t % 3))
        if kind in (5, 6) and one.system.dt:
            found["dt"] = 0.7 * one.system.dt
        if kind in (2, 5) and parameters.size:
            found["parameters"] = parameters * (1.0 + 0.1 * np.cos(t))
        return found

    return samples_with(one, own)


def with_changes(one):
    """The case with other usual weights, bounds and parameters from some samples on."""
    third, weights = len(one.samples) // 3, other_weights(one, 1)
    parameters = one.options.get("parameters", ())
    second = other_bounds(one, 0.9, 0.8) | {"disturbance_weight": weights["disturbance_weight"]}
    if parameters:
        second["parameters"] = 1.2 * np.array(parameters)
    return replace(one, changes={
        0: {"noise_weight": weights["noise_weight"]}, third: second,
        2 * third: other_weights(one, 2),
    })


def conditions(one):
    """The case with conditions of single samples, and others as usual from some samples on."""
    return with_changes(with_conditions(one))


# The systems.


def _reactor():
    """The paper's batch reactor in CasADi's language, evaluated by its virtual machine."""
    _, observer, cost, scenario = batch_reactor("rk4")
    system = qpmhe.from_casadi(
        reactor_rate, reactor_output, n=2, dt=0.1, method="rk4", compiled=False
    )
    samples = tuple({"y": y} for y in scenario.simulate(1, STEPS).measurements)
    return Case(system, observer, cost, np.array(scenario.initial_estimate), samples)


def with_inputs(**options):
    """Three states, two outputs, two inputs: f and h both take the inputs."""

    def f(x, u):
        return [0.9 * x[0] + 0.2 * ca.sin(x[1]) + 0.1 * u[0],
                0.8 * x[1] - 0.1 * x[0] ** 2 + 0.1 * u[0] * u[1],
                0.7 * x[2] + 0.2 * x[0] * ca.cos(x[1])]

    return qpmhe.from_casadi(
        f, lambda x, u: [x[0] + 0.3 * u[1] * x[1], x[2] + 0.1 * x[1] ** 2], n=3, m=2,
        compiled=False, **options,
    )


def _inputs(**sets):
    system, start = with_inputs(**sets), np.array([0.5, 0.5, 0.2])
    cost = QuadraticCost(
        prior=spd(1, 3), disturbance=10 * spd(2, 3), noise=spd(3, 2), discount=0.95
    )
    one = Case(system, Luenberger(OTHER_GAIN), cost, start, recorded(system, start))
    return one.with_options(solver_tolerance=1e-12) if sets else one


def boxed(one):
    """The case in narrow sets of disturbances and noises, solved to convergence."""
    system = with_inputs(
        disturbances=Box([-0.05] * 3, [0.05] * 3) & Polytope([[1.0, 1.0, -1.0]], [0.06]),
        noises=Box([-0.3, -0.4], [0.3, 0.4]),
    )
    return replace(one, system=system).with_options(max_qps=None, solver_tolerance=1e-9)


def _plain(f, h, n, p, horizon=4, steps=14, substeps=1, **options):
    """A system by itself: its size, its language or its method is what matters."""
    system = qpmhe.from_casadi(f, h, n=n, compiled=False, steps=substeps, **options)
    cost = QuadraticCost(prior=2.0 * np.eye(n), disturbance=20.0 * spd(1, n), noise=10 * spd(2, p))
    start, observer = np.full(n, 0.2), Luenberger(0.1 * np.cos(np.arange(n * p)).reshape(n, p))
    samples = recorded(system, start, steps=steps)
    return Case(system, observer, cost, start, samples, {"horizon": horizon, "max_qps": 2})


def _kinetics(method, steps=1):
    """Stiff kinetics, fed and measured, in NumPy; the time constants are 1/2000 to 25 samples."""

    def rate(x, u):
        one, two = 0.04 * x[..., 0], 100.0 * x[..., 1] * x[..., 2]
        three = 2000.0 * x[..., 1] ** 2
        return np.stack([two - one + u[..., 0], one - two - three, three - 0.02 * x[..., 2]], -1)

    system = qpmhe.System.from_ode(
        rate, lambda x, u: np.stack([x[..., 0] + u[..., 0], x[..., 2]], -1), dt=1.0, n=3, p=2, m=1,
        method=method, steps=steps,
    )
    cost = QuadraticCost.from_covariances(
        prior=np.diag([0.1, 0.001, 0.1]) ** 2, disturbance=0.05**2 * np.eye(3),
        noise=0.02**2 * np.eye(2),
    )
    generator, x, samples = np.random.default_rng(3), np.array([1.0, 0.004, 0.2]), []
    for u in generator.uniform(0.0, 0.05, (14, 1)):
        samples.append({"y": system.h(x, u) + 0.02 * generator.standard_normal(2), "u": u})
        x = system.f(x, u)
    observer = Luenberger([[0.3, 0.0], [0.0, 0.0], [0.0, 0.4]])
    options = {"horizon": 4, "max_qps": 2}
    return Case(system, observer, cost, np.array([0.9, 0.004, 0.25]), tuple(samples), options)


def _uptake():
    """What is fed and runs out: damped Newton steps, where whole ones go back and forth."""

    def rate(x, u):
        taken = x[..., 0] / (1e-3 + np.abs(x[..., 0]))
        return np.stack([u[..., 0] - taken, 0.1 * taken - 0.05 * x[..., 1]], -1)

    system = qpmhe.System.from_ode(
        rate, lambda x, u: x, dt=1.0, n=2, p=2, m=1, method="radau", scales=[1.0, 1.0]
    )
    cost = QuadraticCost.from_covariances(
        prior=0.1**2 * np.eye(2), disturbance=0.05**2 * np.eye(2), noise=0.1**2 * np.eye(2)
    )
    generator, x, samples = np.random.default_rng(4), np.array([2.0, 0.5]), []
    for u in generator.uniform(0.0, 0.5, (14, 1)):
        samples.append({"y": x + 0.1 * generator.standard_normal(2), "u": u})
        x = system.f(x, u)
    observer = Luenberger([[0.3, 0.0], [0.0, 0.3]])
    options = {"horizon": 4, "max_qps": 2}
    return Case(system, observer, cost, np.array([1.9, 0.6]), tuple(samples), options)


def _swing(method="radau", steps=1):
    """A generator at a bus with a load, whose angle and voltage are algebraic states."""

    def flows(x, z):
        angle, voltage = x[..., 0] - z[..., 0], z[..., 1]
        return (
            3.6 * voltage * np.sin(angle), 2.0 * voltage * np.sin(z[..., 0]),
            3.6 * voltage * np.cos(angle) + 2.0 * voltage * np.cos(z[..., 0]) - 5.3 * voltage**2,
        )

    def rate(x, z, u):
        return np.stack([x[..., 1], 4.0 * (u[..., 0] - flows(x, z)[0] - 0.3 * x[..., 1])], -1)

    def balance(x, z):
        generated, sent, reactive = flows(x, z)
        return np.stack([generated - sent - 0.3 * z[..., 1], reactive - 0.2], -1)

    system = qpmhe.System.from_dae(
        rate, balance, lambda x, z, u: np.stack([z[..., 1], z[..., 0] + 0.1 * u[..., 0]], -1),
        dt=0.1, n=2, k=2, p=2, m=1, algebraic_guess=[0.0, 1.0], method=method, steps=steps,
    )
    cost = QuadraticCost.from_covariances(
        prior=np.diag([0.1, 0.2]) ** 2, disturbance=np.diag([0.01, 0.05]) ** 2,
        noise=0.01**2 * np.eye(2),
    )
    model, generator, x, samples = system.model(), np.random.default_rng(3), np.zeros(2), []
    for u in 0.8 + generator.uniform(-0.1, 0.1, (14, 1)):
        y = model.functions.h(x, u) + 0.01 * generator.standard_normal(2)
        samples.append({"y": y, "u": u})
        x = model.functions.f(x, u)
    observer, options = Luenberger([[0.1, 0.3], [0.2, 1.5]]), {"horizon": 4, "max_qps": 2}
    return Case(system, observer, cost, np.array([0.1, 0.1]), tuple(samples), options)


def _layered(method=None, steps=1, **options):
    """A network with a layer of 24 by 24, a product with which is one operation."""
    draw = np.random.default_rng(5).standard_normal
    first, middle, last = draw((24, 4)) / 2.0, draw((24, 24)) / 5.0, draw((3, 24)) / 10.0

    def rate(x, u):
        hidden = np.tanh(first @ np.concatenate((x, u)))
        return last @ np.tanh(middle @ hidden + 0.1) - x

    def output(x):
        return (draw_out @ np.tanh(x))[:2]

    draw_out = draw((140, 3)) / 3.0
    if method is None:
        system = qpmhe.System(lambda x, u: x + 0.3 * rate(x, u), output, n=3, p=2, m=1)
    else:
        system = qpmhe.System.from_ode(
            rate, output, dt=0.3, n=3, p=2, m=1, method=method, steps=steps
        )
    cost = QuadraticCost(
        prior=2.0 * np.eye(3), disturbance=20.0 * spd(1, 3), noise=10.0 * spd(2, 2)
    )
    generator, x, samples = np.random.default_rng(3), np.array([0.3, -0.2, 0.1]), []
    for u in generator.uniform(-1.0, 1.0, (14, 1)):
        samples.append({"y": system.h(x, u) + 0.1 * generator.standard_normal(2), "u": u})
        x = system.f(x, u)
    observer = Luenberger([[0.2, 0.1], [0.0, 0.2], [0.1, 0.0]])
    return Case(system, observer, cost, np.zeros(3), tuple(samples), {"horizon": 4, "max_qps": 2})


def _dense():
    """A dense linear part that is a product of one operation."""
    matrix = np.linalg.qr(np.random.default_rng(4).standard_normal((20, 20)))[0]
    n, p = 20, 2
    system = qpmhe.System(
        lambda x: 0.95 * np.einsum("...j,ij->...i", x, matrix) + 0.05 * np.sin(x),
        lambda x: x[..., :2], n=n, p=p,
    )
    cost = QuadraticCost(disturbance=20.0 * np.eye(n), noise=10.0 * np.eye(p))
    observer = EKF(prior=np.eye(n), disturbance=0.05 * np.eye(n), noise=0.1 * np.eye(p))
    samples = recorded(system, np.full(n, 0.2), steps=10)
    return Case(system, observer, cost, np.zeros(n), samples, {"horizon": 4, "max_qps": 1})


def _rate(x):
    return ca.sin(ca.vertcat(x[1:], x[0])) - 1.4 * x


def _spline(x):
    grid = np.linspace(-3, 3, 9)
    turned = ca.solve(ca.MX(ca.DM([[2.0, 0.3], [0.1, 2.0]])), x + ca.sin(x))
    spline = ca.interpolant("s", "bspline", [grid], np.sin(grid))
    return turned + 0.1 * spline(x[0]) + 0.1 * ca.logsumexp(x)


def _reaction_in(states, start=(0.1, 4.5), **sets):
    """2A -> B in pressures, of which the sum is measured; runs away from negative ones.

    In a set of states, which the observer leaves.
    """

    def f(x):
        rate = 0.016 * x[0] ** 2
        return [x[0] - 2.0 * rate, x[1] + rate]

    system = qpmhe.from_casadi(
        f, lambda x: [x[0] + x[1]], n=2, compiled=False, states=states, **sets
    )
    cost = QuadraticCost(prior=np.eye(2), disturbance=np.eye(2), noise=np.eye(1))
    samples = recorded(system, [3.0, 1.0], disturbance=0.0)
    options = {"horizon": 5, "max_qps": 2, "solver_tolerance": 1e-12}
    return Case(system, Luenberger([0.8, -0.3]), cost, np.array(start), samples, options)


def _steady(one):
    """The case with a constant gain, whose covariance weighs the prior."""
    observer = qpmhe.SteadyStateKalman(
        one.system, one.start, [0.3, 0.2][: one.system.m], disturbance=0.05 * spd(5, one.system.n),
        noise=0.05 * spd(6, one.system.p), prior=spd(4, one.system.n),
    )
    kept = {name: getattr(one.cost, name) for name in ("disturbance", "noise")}
    cost = QuadraticCost(prior=ObserverPrior(6.0), **kept)
    return replace(one, observer=observer, cost=cost)


class PseudoHuber(qpmhe.Loss):
    """Quadratic near zero, and linear far away."""

    def value(self, q):
        return 2.0 * (np.sqrt(1.0 + q) - 1.0)

    def slope(self, q):
        return 1.0 / np.sqrt(1.0 + q)


def huber(threshold, per_component=False):
    return partial(qpmhe.Huber, threshold=threshold, per_component=per_component)


def power(exponent, per_component=False):
    return partial(qpmhe.Power, exponent=exponent, per_component=per_component)


def losses(**given):
    """A change to diagonal weights with these losses, by name of the term, and to outliers."""

    def changed(one):
        terms = {}
        for name in TERMS:
            weight = np.diag(np.diag(getattr(one.cost, name)))
            terms[name] = given[name](weight) if name in given else weight
        return outliers(replace(one, cost=qpmhe.RobustCost(**terms, discount=0.9)))

    return changed


def vanishing():
    """Corrections from which the loss takes all weight, of states that one output does not see."""
    one = _plain(_rate, lambda x: x[:1], 4, 1, dt=0.2)
    one = replace(one, observer=Luenberger([[0.5], [2.0], [-3.0], [1.0]]))
    return losses(disturbance=partial(qpmhe.Barron, shape=-INF, threshold=0.5))(one)


def _emptied():
    """Two tanks that the observer empties: the outflow has no derivative there."""
    def f(x, u):
        first, second = 0.2 * ca.sqrt(x[0]), 0.2 * ca.sqrt(x[1])
        return [x[0] + u[0] - first, x[1] + first - second]

    system = qpmhe.from_casadi(
        f, lambda x: [x[1], ca.sqrt(x[0])], n=2, m=1, compiled=False, states=POSITIVE
    )
    cost = QuadraticCost(prior=spd(11, 2), disturbance=9.0 * spd(12, 2), noise=7.0 * spd(13, 2))
    start, generator = np.array([0.3, 0.2]), np.random.default_rng(14)
    samples = tuple(
        {"y": system.h(start, [0.0]) * generator.uniform(0.0, 1.5, 2), "u": [0.03]}
        for _ in range(STEPS)
    )
    return Case(system, Luenberger([[0.7, 0.9], [1.3, 0.3]]), cost, start, samples)


def excluding():
    """Curved outputs whose narrow bounds exclude each other: no trajectory satisfies all rows."""
    generator = np.random.default_rng(37)
    a, b, c, d = generator.normal(size=4)
    sides = 10.0 ** generator.uniform(-2.5, -0.5, size=2)
    system = qpmhe.from_casadi(
        lambda x: [0.9 * x[0] + 0.3 * ca.sin(3 * a * x[1]), 0.8 * x[1] + 0.2 * b * x[0] ** 2],
        lambda x: [c * x[0] ** 2 + ca.sin(4 * x[1]), x[0] * x[1] + d * ca.cos(3 * x[0])], n=2,
        compiled=False, disturbances=Box(-sides, sides), noises=Box([-0.05] * 2, [0.05] * 2),
    )
    cost = QuadraticCost(
        prior=np.eye(2), disturbance=np.diag(sides**-2), noise=100.0 * np.eye(2)
    )
    samples = recorded(system, [0.5, 0.5], seed=37, disturbance=0.2, steps=5)
    observer = Luenberger(0.1 * generator.normal(size=(2, 2)))
    start = generator.normal(size=2)
    return Case(system, observer, cost, start, samples, {"horizon": 5, "max_qps": 1})


def _tank():
    """A tank whose outflow's coefficient is a parameter, with two gauges and a push."""
    system = qpmhe.from_casadi(
        lambda x, u: [u[0] - u[1] * ca.sqrt(ca.fmax(x[0], 0.01)) - 0.1 * x[1], 0.5 * x[0] - x[1]],
        lambda x, u: [x[0], x[0] + 0.3 * x[1] ** 2], n=2, m=2, dt=0.1, compiled=False,
        noises=Box([-0.25, -0.4], [0.25, 0.4]), disturbances=Box([-0.15, -0.2], [0.1, 0.15]),
    )
    cost = QuadraticCost(prior=spd(4, 2), disturbance=2500 * spd(5, 2), noise=40 * spd(6, 2))
    start = np.array([1.0, 0.5])
    one = Case(
        system, Luenberger([[0.2, 0.05], [0.0, 0.1]]), cost, start, recorded(system, start)
    )
    one = samples_with(one, lambda t, y: {"u": np.array([0.6 + 0.2 * np.sin(t)])})
    return one.with_options(parameters=(0.5,), max_qps=None, solver_tolerance=1e-9)


def _turn(period):
    """The residual of a heading and its rate, as a user's function."""
    def turn(a, b):
        away = (a - b)[..., 0]
        return np.stack((away - period * np.floor(away / period + 0.5), (a - b)[..., 1]), axis=-1)

    return turn


def _ship(kinds=("output", "state"), functions=False, **sets):
    """A turning ship whose heading is seen in degrees; the angles may be stated or not."""
    angles = {"output": qpmhe.angles([0], 360.0), "state": qpmhe.angles([0])}
    if functions:
        angles = {"output": _turn(360.0), "state": _turn(2.0 * np.pi)}

    def wrapped(angle):
        return ca.atan2(ca.sin(angle), ca.cos(angle))

    system = qpmhe.from_casadi(
        lambda x: [wrapped(x[0] + x[1]), 0.9 * x[1] + 0.1 * ca.sin(x[0]) + 0.05],
        lambda x: [wrapped(x[0]) * 180.0 / ca.pi, x[1] + 0.1 * ca.cos(x[0])], n=2, compiled=False,
        **{f"{kind}_residual": angles[kind] for kind in kinds}, **sets,
    )
    cost = QuadraticCost.from_covariances(
        prior=np.diag([0.2, 0.05]), disturbance=np.diag([0.01, 0.002]), noise=np.diag([30.0, 0.04])
    )
    start, observer = np.array([3.0, 0.5]), Luenberger([[0.005, 0.1], [0.001, 0.1]])
    samples = recorded(system, start, disturbance=0.05, noise=0.3, steps=2 * STEPS)
    return Case(system, observer, cost, start, samples, {"horizon": 6, "max_qps": 3})


def _saturated(z, v):
    """A correction that large errors cannot drive far, and that depends on the state."""
    bounded = np.tanh(v)
    return np.array([[0.3, 0.0], [0.1, 0.05], [0.0, 0.3]]) @ bounded * (1.0 + 0.2 * np.cos(z))


class Own(qpmhe.Observer):
    """A user's own, whose correction is traced."""

    def check(self, system, initial_state):
        pass

    def correct(self, z, v, sample):
        return 1.5 * _saturated(z, v), None


def _failing(error=12.0):
    """A model that is not defined below zero, where errors lead the observer at times."""
    system = qpmhe.from_casadi(
        lambda x: [x[0] - 0.1 * ca.sqrt(x[0]) + 0.05 * x[1], 0.9 * x[1] + 0.1],
        lambda x: [x[0] + 0.1 * ca.sqrt(x[1])], n=2, compiled=False,
    )
    start = np.array([1.0, 1.0])
    samples = recorded(system, start, disturbance=0.01, noise=0.02)
    cost = QuadraticCost(prior=10.0 * np.eye(2), disturbance=100.0 * np.eye(2), noise=[[100.0]])
    one = Case(system, Luenberger([[0.5], [0.3]]), cost, start, samples)
    return samples_with(one, lambda t, y: {"y": y - error} if t in (6, 7, 15) else {})


def _fewer(**options):
    """The system with inputs, with two disturbances on its three states; G is dense."""
    matrix = np.array([[1.0, 0.2], [0.5, -1.0], [0.3, 0.8]])
    system = with_inputs(disturbance_matrix=matrix, **options)
    cost = QuadraticCost(prior=spd(1, 3), disturbance=10 * spd(2, 2), noise=spd(3, 2))
    one = replace(case("inputs"), system=system, cost=cost)
    return one.with_options(solver_tolerance=1e-10)


def singular(one):
    """The case with a covariance of the disturbance of rank one."""
    direction = np.array([1.0, -0.5, 2.0])
    cost = QuadraticCost.from_covariances(
        prior=np.eye(3), disturbance=0.05 * np.outer(direction, direction), noise=np.eye(2)
    )
    return replace(one, cost=cost).with_options(solver_tolerance=1e-10, max_qps=3)


def _of_all(x, u, w, v):
    """Curved rows, of which the second one is never active."""
    return np.array([
        x[0] * v[1] + w[0] * x[2] + 0.1 * u[0] * w[1] - 0.02, x[0] ** 2 + v[0] ** 2 - 30.0,
        v[0] ** 2 + 0.5 * x[1] - 0.3,
    ])


def _of_few(x, w, v):
    """Curved rows of two disturbances; the last one of states and noises alone."""
    return np.array([
        x[0] * v[1] + w[0] * x[2] - 0.02, w[0] * w[1] + 5.0 * w[1] ** 2 - 0.01 - 0.05 * w[0],
        v[0] ** 2 + 0.5 * x[1] - 0.3,
    ])


def _of_states(x):
    """Rows that also hold at the newest state."""
    return np.array([x[0] ** 2 + 2.0 * x[1] ** 2 - 0.5, 0.2 - x[0] - x[2] ** 2])


def _undefined(x):
    """Has no value at small states."""
    return np.log(x[1] + 0.5) + 0.1


def constraints_of(size):
    """A hard and a soft constraint, in units in which their slopes have this size."""
    return _inputs(constraints=[
        Constraint(lambda x: size * (0.15 - x[0] + x[1] ** 2)),
        Constraint(lambda x, v: size * (x[0] * x[1] - 0.02 + 0.1 * v[0]), linear=3.0 / size),
    ])


def _held(hold=0.2, bounds=None, **options):
    """Two unknown parameters, which are seen only while the input acts."""
    system = qpmhe.from_casadi(
        lambda x, u: [0.8 * x[0] + 0.2 * u[1] * u[0] + 0.05 * x[1],
                      0.7 * x[1] + 0.3 * u[2] * ca.sin(x[0])],
        lambda x: [x[0], x[1] + 0.1 * x[0] ** 2], n=2, m=3, compiled=False, **options,
    )
    nominal, r = np.array([1.0, 0.5]), system.r + 2
    augmented = qpmhe.augment_parameters(
        system, nominal=nominal, drifting=True, parameter_bounds=bounds, hold=hold
    )
    weights = {
        "prior": spd(8, 4), "disturbance": np.diag([400.0] * (r - 2) + [2500.0, 900.0]),
        "noise": np.diag([100.0, 60.0]),
    }
    generator, x, samples = np.random.default_rng(12), np.array([0.2, 0.1]), []
    for t in range(3 * STEPS):
        u = np.array([np.sin(0.7 * t) if t < STEPS or t >= 2 * STEPS else 0.0])
        y = system.h(x, np.append(u, nominal)) + 0.1 * generator.standard_normal(2)
        samples.append({"y": y, "u": u})
        x = system.f(x, np.append(u, nominal + np.array([0.3, -0.2])))
    gain = [[0.3, 0.0], [0.0, 0.3], [0.02, 0.0], [0.0, 0.01]]
    return Case(
        augmented, Luenberger(gain), QuadraticCost(**weights), np.append([0.0, 0.0], nominal),
        tuple(samples), {"horizon": 6, "max_qps": 2},
    )


OTHER_GAIN = [[0.2, 0.0], [0.1, 0.05], [0.0, 0.2]]
POSITIVE = Box([0.0, 0.0], [INF, INF])
SMALLER = Box([-0.05] * 3, [0.05] * 3) & Polytope([[1.0, 1.0, -1.0]], [0.06])
NARROW = Box([0.0, -INF, -0.2], [0.6, 0.4, INF])
WEDGE = Polytope([[-1.0, 0.1], [0.1, -1.0], [1.0, 1.0]], [0.0, 0.0, 4.2])
SMALL = {"disturbances": Box([-0.05, -0.08], [0.1, 0.06])}
SINGULAR = {"prior": np.diag([1.0, 0.0, 0.5]), "disturbance": np.diag([0.02, 0.0, 0.0])}
AGAIN, WARM, ALONE = {"candidate": "reinitialized"}, {"warm_start": True}, {"max_qps": 0}
ONE, MANY, SMOOTH = {"max_qps": 1}, {"max_qps": None}, {"arrival": "smoothed"}
RESTORE = {"infeasible": "restore", "solver_tolerance": 1e-12}
RESTART = {"restart": True, "horizon": 4}
BESIDE = {"disturbances": Box([0.2, -0.5, -0.5], [1.0, 0.5, 0.5])}
DIAGONAL = {"projection_metric": "diagonal"}
METRIC = by(lambda one: Luenberger([0.8, -0.3], metric=[[2.0, 1.0], [1.0, 1.0]]))
LEAVING = by(lambda one: Luenberger([[0.6, 0.0], [0.3, -0.4], [0.1, 0.7]]))

# Each case is made when it is asked for, and kept by `case`: what it is made of, by a function or
# the name of another case, and its changes: functions, or options. Of each feature, there is a
# case in every sample.
FEATURES = {
    "usual": {
        "reactor": (_reactor,),
        "reactor with gaps": ("reactor", gaps),
        "reactor conditions": ("reactor with gaps", with_conditions, AGAIN, WARM),
        "inputs": (_inputs,),
        "inputs converged": ("inputs", gaps, MANY),
        "inputs reinitialized": ("inputs", AGAIN, WARM, ONE, conditions),
        "one of each": (lambda: _plain(ca.sin, lambda x: x, 1, 1, horizon=1), gaps),
        "euler": (lambda: _plain(_rate, lambda x: x[:1], 3, 1, dt=0.2, method="euler"), gaps, WARM),
        "runge-kutta": (lambda: _plain(_rate, lambda x: x[:2], 4, 2, 3, dt=0.2), AGAIN, gaps),
        "matrix expressions": (lambda: _plain(_spline, lambda x: x[0] + x[1] ** 2, 2, 1), gaps),
        "many states": (lambda: _plain(_rate, lambda x: x[:6], 42, 6, steps=9, dt=0.1), gaps),
    },
    "angles": {
        "angles of outputs": (lambda: _ship(["output"]), WARM),
        "angles of states": (lambda: _ship(["state"]), gaps, AGAIN),
        "angles by functions": (lambda: _ship(functions=True), gaps, WARM),
        "angles, conditions": (_ship, gaps, conditions),
        "angles unscented": (_ship, gaps, filtered(UKF), SMOOTH, WARM),
        "angles across the seam": (
            lambda: _ship(states=Box([2.0, -1.0], [4.5, 2.0])), conditions, AGAIN, WARM,
            {"solver_tolerance": 1e-12},
        ),
        "angles in sets": (lambda: _ship(
            disturbances=Box([-0.1, -0.1], [0.1, 0.1]), noises=Box([-8.0, -0.5], [8.0, 0.5])
        ), MANY),
    },
    "directions": {
        "fewer disturbances": (_fewer, gaps, WARM),
        "fewer disturbances in sets": (
            lambda: _fewer(**SMALL, noises=Box([-0.4, -0.4], [0.4, 0.4])), MANY,
        ),
        "fewer disturbances reinitialized": (lambda: _fewer(**SMALL), conditions, AGAIN, MANY),
        "fewer disturbances extended": (_fewer, filtered(), gaps, conditions, ALONE),
        "fewer disturbances graduated": (_fewer, losses(noise=qpmhe.GemanMcClure), {"horizon": 8}),
        "singular covariance": ("inputs", singular, gaps),
    },
    "held": {
        "held with gaps": (_held, gaps, with_changes),
        "held in sets": (lambda: _held(
            {1: 0.1}, bounds=Box([0.9, 0.2], [1.2, 0.6]), noises=Box([-0.2, -0.3], [0.2, 0.3])
        ), WARM, {"solver_tolerance": 1e-10}),
        "held, fewer disturbances": (
            lambda: _held(disturbance_matrix=[[1.0], [0.5]]), gaps, conditions, WARM,
        ),
        "held, graduated": (_held, losses(prior=huber(0.5), noise=qpmhe.GemanMcClure), AGAIN),
    },
    "losses": {
        "huber everywhere": (
            "inputs", losses(**dict.fromkeys(TERMS, huber(0.5))), gaps, with_conditions, WARM,
        ),
        "mixed losses": ("inputs", losses(
            prior=huber(1.0), disturbance=power(1.5, True), noise=huber(2.0, True)
        ), conditions, AGAIN, WARM, {"max_qps": 4}),
        "power": ("inputs", losses(
            prior=power(1.0, True), disturbance=power(3.0, True), noise=power(1.2)
        ), gaps, AGAIN),
        "own losses": ("inputs", losses(
            prior=partial(PseudoHuber, per_component=True), noise=PseudoHuber
        ), gaps),
        "redescending": ("inputs", losses(
            prior=partial(qpmhe.GemanMcClure, graduation=1.0),
            disturbance=partial(qpmhe.Barron, shape=-3.0, threshold=1.5),
            noise=partial(qpmhe.Barron, shape=-INF, threshold=2.0),
        ), WARM, {"max_qps": 4}),
        "graduated": ("inputs", losses(
            prior=huber(0.5), disturbance=qpmhe.Cauchy,
            noise=partial(qpmhe.GemanMcClure, graduation=30.0),
        ), with_conditions, WARM, ONE),
        "graduated in sets": (
            lambda: _inputs(disturbances=Box([-0.1] * 3, [0.2] * 3), noises=Box([-3] * 2, [3] * 2)),
            losses(noise=partial(qpmhe.Cauchy, per_component=True, threshold=0.8)), WARM,
        ),
        # The trajectory of the surrogate, not the estimate, is kept where a snapshot is taken.
        "graduated reinitialized": ("inputs", losses(
            noise=partial(qpmhe.GemanMcClure, threshold=0.5, graduation=100.0)
        ), lambda one: replace(one, samples=one.samples[:14]), AGAIN, ONE, {"horizon": STEPS}),
        # Its candidate leaves the sets while the first window fills.
        "graduated from outside": (
            lambda: _inputs(disturbances=Box([-INF] * 3, [0.05] * 3)),
            losses(noise=partial(qpmhe.Cauchy, threshold=0.8)), {"horizon": 8},
        ),
    },
    "states": {
        "states in a box": (lambda: _reaction_in(POSITIVE),),
        "states in a box, conditions": ("states in a box", gaps, conditions, AGAIN, WARM),
        "states from outside": (lambda: _reaction_in(WEDGE, (-1.0, 4.5)), MANY),
        "states on a bound without derivative": (_emptied, gaps, ALONE),
        "states in a metric": ("states in a box", METRIC, gaps, ALONE),
        "states in a polytope": (lambda: _reaction_in(WEDGE),),
        "states in both": (lambda: _reaction_in(
            POSITIVE & Polytope([[1.0, 1.0]], [4.2]), noises=Box([-0.15], [0.2])
        ), conditions),
        # The window never is full of such samples, about which there is a warning.
        "states not projected": ("states in a polytope", conditions, {
            "project_observer": False, "horizon": STEPS + 1,
        }),
        "states in a diagonal metric": ("states in a polytope", METRIC, conditions, DIAGONAL),
        "extended in states, diagonal": ("states in a polytope", filtered(), gaps, DIAGONAL),
        "extended in states": ("states in a polytope", filtered(), gaps, ONE),
        "unscented in states": ("states in a box", filtered(UKF, np.eye(2)), gaps, AGAIN),
        "steady in states": (lambda: _steady(_reaction_in(WEDGE, (2.0, 1.5))), gaps),
    },
    "soft": {
        "soft states": (
            lambda: _reaction_in(POSITIVE.soften(linear=0.5, quadratic=2.0)),
            gaps, conditions, AGAIN,
        ),
        "soft states in a polytope": (lambda: _reaction_in(WEDGE.soften(linear=3.0)), WARM),
        "soft states by squares": (
            lambda: _inputs(states=NARROW.soften(quadratic=30.0)), gaps, conditions, MANY,
        ),
        "soft disturbances and noises": (lambda: _inputs(
            disturbances=SMALLER.soften(linear=4.0, quadratic=1.0),
            noises=Box([-0.2, -0.1], [0.2, 0.1]).soften(linear=2.0),
        ), gaps, conditions, WARM, MANY),
        "soft states, hard noises": (lambda: _inputs(
            states=NARROW.soften(linear=20.0), noises=Box([-0.2, -0.1], [0.2, 0.1]),
        ), gaps, AGAIN),
        # Of a row that is missed, both penalties push back.
        "soft states, narrow noises": (lambda: _inputs(
            states=NARROW.soften(linear=2.0, quadratic=400.0), noises=Box([-0.02] * 2, [0.02] * 2),
        ), MANY),
        "soft noises, hard states": (lambda: _inputs(
            states=NARROW, noises=Box([-0.05, -0.1], [0.1, 0.1]).soften(linear=1.0, quadratic=5.0),
        ), MANY),
        "soft equations": (lambda: _inputs(
            states=Polytope([[1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]], [0.5, -0.5]).soften(linear=0.3),
            disturbances=Box([-0.5, 0.0, -0.5], [0.5, 0.0, 0.5]).soften(linear=1.0, quadratic=2.0),
        ), gaps, ONE),
        "soft angles": (lambda: _ship(
            disturbances=Box([-0.02, -0.01], [0.05, 0.01]).soften(linear=20.0),
            noises=Box([-3.0, -0.2], [3.0, 0.2]).soften(quadratic=0.5),
        ), conditions, WARM),
        "soft, extended": (
            lambda: _inputs(states=NARROW.soften(linear=2.0)),
            filtered(), outliers, gaps, AGAIN, looser,
        ),
        "soft, graduated": (lambda: _inputs(states=NARROW.soften(linear=2.0)), losses(
            disturbance=qpmhe.Cauchy, noise=partial(qpmhe.GemanMcClure, graduation=30.0)
        ), WARM),
        "soft states, fewer disturbances": (lambda: _fewer(
            **SMALL, states=NARROW.soften(linear=0.5, quadratic=30.0),
            noises=Box([-0.4, -0.4], [0.4, 0.4]),
        ), gaps, conditions, MANY, AGAIN),
        "soft disturbances, fewer": (lambda: _fewer(
            disturbances=Box([-0.02, -0.03], [0.05, 0.03]).soften(linear=4.0),
            noises=Box([-0.2, -0.1], [0.2, 0.1]).soften(linear=2.0, quadratic=1.0),
        ), gaps, conditions, WARM, MANY),
        "soft, singular covariance": (lambda: singular(_inputs(
            states=NARROW.soften(linear=2.0), disturbances=SMALLER.soften(linear=1.0),
        )), gaps),
        "soft states, noise-free": (lambda: _inputs(
            states=NARROW.soften(linear=2.0, quadratic=3.0),
            disturbances=Box([-0.5, 0.0, -0.5], [0.5, 0.0, 0.5]),
        ), conditions, MANY, {"solver_tolerance": 1e-10}),
        "soft, unscented": (
            lambda: _reaction_in(POSITIVE.soften(linear=0.5)), filtered(UKF), gaps,
        ),
    },
    "constraints": {
        "constraints": (lambda: _inputs(constraints=[Constraint(_of_all, 3)]), gaps),
        "constraints, conditions": (lambda: _inputs(
            constraints=[
                Constraint(_of_states, 2), Constraint(lambda w: w[0] + 5.0 * w[1] ** 2 - 0.04)
            ],
            noises=Box([-0.4, -0.4], [0.4, 0.4]),
        ), conditions, AGAIN, WARM),
        "soft constraints": (lambda: _inputs(constraints=[
            Constraint(_of_states, 2, linear=[2.0, 0.5], quadratic=[1.0, 30.0]),
            Constraint(_of_all, 3, linear=20.0),
        ]), gaps, MANY),
        "constraints and soft sets": (lambda: _inputs(
            constraints=[Constraint(_of_states, 2), Constraint(_of_all, 3, linear=20.0)],
            states=NARROW.soften(linear=1.0), noises=Box([-0.4, -0.4], [0.4, 0.4]),
        ), conditions, WARM),
        "constraints, unscented": (
            lambda: _inputs(constraints=[Constraint(_of_states, 2)]), filtered(UKF), gaps, MANY,
        ),
        "constraints of angles": (lambda: _ship(constraints=[
            Constraint(lambda x, v: np.sin(x[0]) * x[1] + 0.001 * v[0] - 0.3, linear=5.0),
        ]), gaps, MANY, {"solver_tolerance": 1e-12}),
        "constraints, fewer disturbances": (lambda: _fewer(
            constraints=[Constraint(_of_few, 3), Constraint(_of_states, 2)],
        ), gaps, MANY),
        "soft constraints, fewer disturbances": (lambda: _fewer(**SMALL, constraints=[
            Constraint(_of_states, 2, linear=[2.0, 0.5], quadratic=[1.0, 30.0]),
            Constraint(_of_few, 3, linear=20.0),
        ], states=NARROW.soften(linear=1.0)), conditions, MANY),
        "constraints, noise-free": (lambda: _inputs(
            constraints=[Constraint(_of_states, 2), Constraint(_of_all, 3, linear=20.0)],
            disturbances=Box([-0.5, 0.0, -0.5], [0.5, 0.0, 0.5]),
        ), gaps, AGAIN, {"solver_tolerance": 1e-10}),
        "constraints, fewer disturbances, restored": (lambda: _fewer(
            constraints=[Constraint(lambda w: 0.05 - w[0] + w[1] ** 2)]
        ), gaps, RESTORE, {"solver_tolerance": 1e-10}),
        "constraints that fail": (lambda: _inputs(constraints=[
            Constraint(lambda x: 0.3 - np.sqrt(x[0] - 0.2), linear=2.0), Constraint(_undefined),
        ]),),
        # Steps that converge, that do not, and that find no decrease behind trials without values.
        "constraints that fail along trials": (
            lambda: _inputs(constraints=[
                Constraint(lambda x: np.log(x[1] + 0.3) - 1.0),
                Constraint(lambda x, w: 0.02 - np.sqrt(x[0] + 0.1) + w[0]),
            ]), MANY, {"tolerance": 1e-5},
            lambda one: samples_with(
                one, lambda t, y: {"y": y + 2.0} if t % 5 == 2 else {}
            ),
        ),
        "constraints of 1e200": (lambda: constraints_of(1e200), MANY),
        "constraints, restored": (lambda: _inputs(
            constraints=[Constraint(lambda w: 0.2 - w[0] + w[1] ** 2)]
        ), gaps, RESTORE),
    },
    "equations": {
        "noise-free reinitialized": (lambda: _inputs(
            disturbances=Box([-0.05, 0.01, -0.05], [0.05, 0.01, 0.05])
        ), gaps, AGAIN, MANY),
        "a known noise": (lambda: _inputs(noises=Box([0.1, -3.0], [0.1, 3.0])),),
        "states in a plane": (
            lambda: _inputs(states=Polytope([[1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]], [0.5, -0.5])),
        ),
        "noise-free conditions": (lambda: _inputs(
            states=Box([0.0, -0.2, -2.0], [0.6, 0.4, 2.0]),
            disturbances=Box([-0.5, 0.0, -0.5], [0.5, 0.0, 0.5]),
        ), conditions),
    },
    # Their candidates leave sets that hold no trajectory at a cost as low.
    "restored": {
        "restored": (lambda: _inputs(**BESIDE), gaps, conditions, RESTORE),
        "restored reinitialized": (lambda: _inputs(**BESIDE), AGAIN, ONE, RESTORE),
        "restored, fewer disturbances": (lambda: _fewer(
            disturbances=Box([0.1, -0.05], [0.5, 0.3]), noises=Box([-0.4, -0.4], [0.4, 0.4])
        ), MANY, RESTORE),
        "restored, graduated": (
            lambda: _inputs(disturbances=Box([0.2, -INF, -INF], [INF, INF, INF])),
            losses(noise=partial(qpmhe.Cauchy, threshold=0.8)), {"horizon": 8}, WARM, RESTORE,
        ),
        "restored extended": (
            lambda: _inputs(**BESIDE, noises=Box([-1.0, -1.0], [1.0, 1.0])), filtered(), MANY,
            RESTORE,
        ),
        "restored noise-free": (
            lambda: _inputs(disturbances=Box([0.1, 0.01, -0.5], [0.5, 0.01, 0.5])), gaps, RESTORE,
        ),
    },
    # Their observers are slow, or too sure of themselves, and start far off.
    "restarted": {
        "restarted": ("inputs", far, conditions, RESTART),
        "restarted extended": (
            "inputs", filtered(scale=1e-4, disturbance=1e-9 * np.eye(3)), far, gaps,
            conditions, RESTART,
        ),
        "restarted in states": (
            lambda: _reaction_in(WEDGE, (-1.0, 4.0)), far, conditions, RESTART,
        ),
        "restarted unscented gated": (
            "inputs", filtered(UKF, scale=1e-2, innovation=Gate(reopen=1000)), jumping, RESTART,
        ),
    },
    "conditions": {
        # Bounds on one side and on both, and an observer that leaves them.
        "inputs and states": (
            lambda: _inputs(states=Box([0.0, -INF, -0.2], [0.6, 0.4, INF])), LEAVING,
        ),
        "narrow conditions": ("inputs", boxed, conditions, {"horizon": 1}),
        "tank conditions": (_tank, conditions),
        "tank in time": ("tank conditions", {"time_budget": 1e6}),
    },
    "observers": {
        "smoothed": ("inputs", SMOOTH, {"horizon": 4}, gaps, AGAIN, with_changes),
        "extended": ("inputs", filtered(weight=spd(1, 3)), with_conditions),
        "extended prior": ("inputs", filtered(), gaps, SMOOTH, WARM),
        # Some covariances are then singular up to rounding, and the weights as large as can be.
        "extended singular": ("inputs", filtered(**SINGULAR), looser),
        "extended conditions": ("reactor", filtered(
            prior=np.eye(2), disturbance=0.01 * np.eye(2), noise=[[0.01]]
        ), conditions, AGAIN, WARM),
        "unscented": ("inputs", filtered(UKF, ObserverPrior(5.0), spread=1.2), gaps),
        "unscented prior": ("inputs", filtered(UKF), AGAIN, ONE, conditions),
        # A covariance that is singular up to rounding has a root only up to that.
        "unscented singular": ("inputs", filtered(UKF, spd(1, 3), **SINGULAR), looser),
        "steady prior": ("inputs", _steady, gaps, conditions),
    },
    "innovations": {
        "gated": ("inputs", judged(Gate(0.95, reopen=2, groups=[[1, 0]])), prior_by(), conditions),
        "gated in states": ("inputs and states", judged(Gate(reopen=2)), gaps, AGAIN, WARM),
        "gated angles": (_ship, judged(Gate(reopen=2)), gaps),
        "weighted": ("inputs", judged(HuberInnovation(0.7, reopen=1)), SMOOTH),
        "unscented gated in states": (
            "inputs and states", judged(Gate(reopen=2), UKF), gaps, conditions,
        ),
        "unscented weighted": ("inputs", judged(HuberInnovation(reopen=2), UKF), gaps, conditions),
    },
    "injections": {
        "injection": (
            "inputs", by(lambda one: qpmhe.OutputInjection(_saturated)), conditions, AGAIN, WARM,
        ),
        "injection in sets": ("inputs and states", by(
            lambda one: qpmhe.OutputInjection(lambda z, v: 2.0 * _saturated(z, v))
        )),
        "own observer": ("inputs", by(lambda one: Own()), gaps, with_changes, WARM),
        "own observer in sets": ("inputs and states", by(lambda one: Own()), gaps, AGAIN),
    },
    "steps": {
        "radau": (lambda: _kinetics("radau"), with_conditions),
        "radau substeps": (lambda: _kinetics("radau", 2), filtered(), gaps, AGAIN, WARM),
        "midpoint": (lambda: _kinetics("midpoint", 3), filtered(UKF), gaps),
        "radau damped": (_uptake, with_conditions),
        "rk4 substeps": (lambda: _plain(
            _rate, lambda x: [x[0]], 3, 1, dt=0.3, method="rk4", substeps=3
        ), with_conditions),
        "euler substeps": (lambda: _plain(
            _rate, lambda x: [x[0]], 3, 1, dt=0.3, method="euler", substeps=2
        ),),
    },
    "algebraic": {
        "algebraic": (_swing, with_conditions),
        "algebraic substeps": (lambda: _swing(steps=2), filtered(), gaps, AGAIN, WARM),
        "algebraic midpoint": (lambda: _swing("midpoint", 3), filtered(UKF), gaps),
    },
    "products": {
        "layered": (_layered, with_conditions, AGAIN, WARM),
        "layered rk4": (lambda: _layered("rk4", 2), filtered(), gaps),
        "layered euler": (lambda: _layered("euler", 2), conditions),
        "layered radau": (lambda: _layered("radau"), gaps),
        "dense": (_dense,),
    },
    "failing": {
        "power failing": (lambda: _failing(1.8), losses(**dict.fromkeys(TERMS, power(1.5)))),
        "extended failing": (_failing, filtered(), AGAIN),
        "unscented failing": (_failing, filtered(UKF)),
        # Without QPs, as the observer is far from their estimates, of which there is a warning.
        "gated failing": (_failing, judged(Gate(reopen=2)), ALONE),
    },
}
CASES = {name: made for table in FEATURES.values() for name, made in table.items()}

@functools.cache
def case(name):
    """The case of this name."""
    base, *changes = CASES[name]
    one = case(base) if isinstance(base, str) else base()
    for change in changes:
        one = one.with_options(**change) if isinstance(change, dict) else change(one)
    return one
