"""Models of the campaign: each is written once, for NumPy, CasADi and JAX alike."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

import qpmhe

# A function of lists of numbers x and u, and of the module that has sqrt and the like.
Rule = Callable[[Any, Any, Any], list]


class Model(NamedTuple):
    """A discrete-time model; the last ``k`` inputs are parameters with usual values."""

    f: Rule
    h: Rule
    start: np.ndarray
    p: int
    m: int = 0
    parameters: np.ndarray = np.zeros(0)
    positive: bool = False  # X is at least x >= 0
    defined_within: bool = False  # and f and h have no values elsewhere
    state_angles: tuple | None = None  # indices and period
    output_angles: tuple | None = None
    has_units: bool = True  # each component may be scaled

    @property
    def n(self):
        return len(self.start)


def linear(r):
    n, p, m = int(r.integers(1, 6)), int(r.integers(1, 4)), int(r.integers(0, 3))
    A = r.normal(size=(n, n))
    A *= r.uniform(0.5, 1.05) / np.abs(np.linalg.eigvals(A)).max()
    C, B = r.normal(size=(p, n)), 0.3 * r.normal(size=(n, m))

    def product(M, x):
        return [sum(float(a) * x[j] for j, a in enumerate(row)) for row in M]

    def f(x, u, xp):
        return [a + b for a, b in zip(product(A, x), product(B, u), strict=True)]

    return Model(f, lambda x, u, xp: product(C, x), r.normal(size=n), p, m)


def network(r):
    n, p, m = int(r.integers(1, 5)), int(r.integers(1, 3)), int(r.integers(0, 2))
    B, C = r.normal(size=(n, n)), r.normal(size=(p, n))

    def f(x, u, xp):
        own = 0.1 * u[0] if m else 0.0
        return [
            0.9 * x[i] + 0.2 * xp.tanh(sum(float(B[i, j]) * x[j] for j in range(n))) + own
            for i in range(n)
        ]

    def h(x, u, xp):
        bend = 0.1 * x[0] * x[0]
        return [sum(float(C[i, j]) * x[j] for j in range(n)) + bend for i in range(p)]

    return Model(f, h, r.normal(size=n), p, m)


def reactor(r):
    def f(x, u, xp):
        rate = 0.016 * x[0] * x[0] - 0.0064 * x[1]
        return [x[0] - 2.0 * rate, x[1] + rate]

    return Model(f, lambda x, u, xp: [x[0] + x[1]], np.array([3.0, 1.0]), 1, positive=True)


def pendulum(r):
    period, both = float(r.choice([2.0 * np.pi, 360.0])), r.random() < 0.5
    k = 2.0 * np.pi / period

    def f(x, u, xp):
        pull = 2.943 / k * xp.sin(k * x[0]) + 0.2 * x[1]
        return [x[0] + 0.1 * x[1], x[1] - 0.1 * pull + 0.1 * u[0] / k]

    def h(x, u, xp):
        return [x[0] + 0.0 * x[1], xp.sin(k * x[0])][: 1 + both]

    angles = [0], period
    return Model(f, h, np.array([1.0 / k, 0.0]), 1 + both, 1, state_angles=angles,
                 output_angles=angles, has_units=False)


def tanks(r):
    n = int(r.integers(1, 4))

    def f(x, u, xp):
        out = [0.2 * xp.sqrt(x[i]) for i in range(n)]
        return [x[0] + u[0] - out[0], *(x[i] + out[i - 1] - out[i] for i in range(1, n))]

    return Model(f, lambda x, u, xp: [x[n - 1], xp.sqrt(x[0])], np.ones(n), 2, 1, positive=True,
                 defined_within=True)


def ranges(r):
    def f(x, u, xp):
        return [x[0] + 0.1 * x[2], x[1] + 0.1 * x[3], 0.98 * x[2], 0.98 * x[3]]

    def h(x, u, xp):
        return [xp.sqrt((x[0] - 3.0) ** 2 + x[1] ** 2), xp.sqrt(x[0] ** 2 + (x[1] - 4.0) ** 2),
                xp.arctan2(x[1] - 4.0, x[0] + 0.0)]

    return Model(f, h, np.array([1.0, -1.0, 0.3, 0.2]), 3, output_angles=([2], 2.0 * np.pi),
                 has_units=False)


def exponential(r):
    inverse = r.random() < 0.5

    def f(x, u, xp):
        k = xp.exp(-2.0 / x[1]) if inverse else xp.exp(x[1])
        return [x[0] + 0.05 * (1.0 - x[0] - k * x[0]),
                x[1] + 0.05 * (0.5 - x[1] + 0.5 * k * x[0])]

    return Model(f, lambda x, u, xp: [x[1] + 0.0 * x[0]], np.array([0.5, 0.6]), 1)


def branches(r):
    def f(x, u, xp):
        return [0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + xp.where(x[0] > 0.5, 0.1, -0.1)]

    return Model(f, lambda x, u, xp: [x[0] * xp.fabs(x[0])], np.array([0.6, 0.1]), 1)


def parameters(r):
    def f(x, u, xp):
        return [x[0] + 0.1 * (u[0] - u[1] * x[0] * u[2])]

    return Model(f, lambda x, u, xp: [x[0], u[1] * x[0] * x[0]], np.ones(1), 2, 3,
                 np.array([0.7, 1.1]))


def steep(r):
    """Derivatives of up to 1e150 or infinite ones, and values that overflow."""
    kind, large = int(r.integers(5)), 10.0 ** r.uniform(20.0, 150.0)

    def f(x, u, xp):
        return [
            lambda: [0.9 * x[0] + 0.1 * xp.tanh(large * x[1]), 0.95 * x[1] + 0.1 * x[0]],
            lambda: [0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + 0.05 * xp.sqrt(xp.fabs(x[0] - 0.5))],
            lambda: [0.9 * x[0] + 1e-3 * xp.exp(9.0 * x[0] * x[0]), 0.9 * x[1] - 0.1 * x[0]],
            lambda: [0.9 * x[0] + 0.1 * x[1], 0.9 * x[1] + 0.05 * xp.tanh(large * (x[0] - 0.6))],
            lambda: [0.95 * x[0] + 0.1 * x[1], 0.9 * x[1] - 0.1 * x[0]],
        ][kind]()

    def h(x, u, xp):
        if kind == 1:
            return [xp.sqrt(x[0] * x[0] + x[1] * x[1])]
        if kind == 4:
            return [xp.arctan2(large * x[0], 1.0 + 0.0 * x[1])]
        return [x[0] + 0.0 * x[1]]

    return Model(f, h, np.array([0.6, 0.0] if kind < 2 else [0.5, 0.3]), 1)


def holes(r):
    """Not finite somewhere: a logarithm, a quotient, a root."""
    kind = int(r.integers(3))

    def f(x, u, xp):
        return [
            lambda: [0.95 * x[0] + 0.05 * xp.log(x[1]), 0.9 * x[1] + 0.1 * x[0]],
            lambda: [0.95 * x[0] + 0.02 / x[1], 0.9 * x[1] + 0.1 * x[0]],
            lambda: [0.9 * x[0] + 0.1 * xp.sqrt(x[0] - 0.4), 0.95 * x[1] + 0.05 * x[0]],
        ][kind]()

    def h(x, u, xp):
        if kind == 1:
            return [x[0] + 0.0 * x[1], 1.0 / x[1]]
        return [xp.log(x[0]) + 0.1 * x[1], x[1]]

    return Model(f, h, np.ones(2), 2)


FAMILIES = (
    linear, network, reactor, pendulum, tanks, ranges, exponential, branches, parameters, steep,
    holes,
)
# Which way a model is written, and how often for an engine.
WRITINGS = {
    "python": {"single": 0.3, "batched": 0.25, "opaque": 0.15, "casadi": 0.2, "jax": 0.1},
    "compiled": {"single": 0.4, "batched": 0.2, "casadi": 0.25, "jax": 0.15},
}


def installed(writing):
    """The writing, or NumPy where its library is missing."""
    return "batched" if writing in ("casadi", "jax") and find_spec(writing) is None else writing


def with_units(model, x_units, y_units):
    """f and h of x and y in other units."""
    def scaled(rule, units):
        def values(x, u, xp):
            x = [float(1.0 / unit) * x[i] for i, unit in enumerate(x_units)]
            return [float(unit) * value for unit, value in zip(units, rule(x, u, xp), strict=True)]

        return values

    return scaled(model.f, x_units), scaled(model.h, y_units)


def system(writing, f, h, n, p, m, called, **keywords):
    """The `System` of rules f and h; ``called`` is called whenever f is."""
    keywords |= {"n": n, "p": p} | ({"m": m} if m else {})
    if writing == "casadi":
        import casadi as ca

        functions = SimpleNamespace(
            sin=ca.sin, tanh=ca.tanh, sqrt=ca.sqrt, exp=ca.exp, log=ca.log, fabs=ca.fabs,
            arctan2=ca.atan2, where=ca.if_else,
        )

        def written(rule):
            return _of(m, lambda x, u: ca.vertcat(*rule(
                [x[i] for i in range(n)], [u[i] for i in range(m)], functions
            )))

        return qpmhe.from_casadi(written(f), written(h), **keywords)
    if writing == "jax":
        import jax
        import jax.numpy as jnp

        jax.config.update("jax_enable_x64", True)
        return qpmhe.from_jax(*(
            _of(m, lambda x, u, rule=rule: jnp.stack(rule(x, u, jnp))) for rule in (f, h)
        ), **keywords)

    def evaluated(rule, x, u):
        if writing == "opaque":
            return np.array(rule([float(a) for a in x], [float(a) for a in u], np))
        if writing == "single":
            return np.array(rule(x, u, np))
        parts = [x[..., i] for i in range(n)], [u[..., i] for i in range(m)]
        return np.stack(rule(*parts, np), axis=-1)

    def counted(x, u):
        called()
        return evaluated(f, x, u)

    return qpmhe.System(_of(m, counted), _of(m, lambda x, u: evaluated(h, x, u)), **keywords)


def _of(m, function):
    """The function of x and u, or of x alone."""
    return function if m else lambda x: function(x, ())
