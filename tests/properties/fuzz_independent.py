"""Random estimation problems, each step judged by code that shares nothing with the estimator.

J, the model, the observer and the sets are written here a second time, from the definitions of
the paper, one state at a time and in plain Python. From `qpmhe` comes only what a user writes
down: systems, observers, costs, sets, and the estimator that is tried.

    python -m tests.properties.fuzz_independent --steps 100000 --seed 0
"""

import argparse
import itertools
import math
import pickle
import sys
import time
import traceback
import warnings
from collections import Counter
from contextlib import contextmanager

import numpy as np

import qpmhe
from qpmhe import Status
from qpmhe.codegen import compiler

SETS = ("states", "disturbances", "noises")
# What is missed by so much counts as satisfied, as the documentation has it.
FEASIBLE = 5e-9
# Models with branches or limits have no derivative everywhere.
SMOOTH, KINKED = ("linear", "smooth", "bilinear"), ("branch", "limit")
WRITINGS = {
    "numpy": (
        "batched", "matmul", "columns", "looped", "view", "branching", "item", "flat", "loop",
        "buffer", "buffer in a branch", "clipping in place",
    ),
    "casadi": ("compiled", "interpreted"),
    "jax": ("jax",),
}
BACKENDS = (
    "auto", "banded", "osqp", "proxqp", "piqp", "daqp", "clarabel", "quadprog", "qpalm",
    "piqp_dense", "proxqp_sparse", "qpsolvers:osqp", "qpsolvers:piqp", "scs", "ecos", "cvxopt",
)
COMPILED_BACKENDS = ("auto",)


def spd(rng, size, low=-1.0, high=2.0):
    """A random weight with eigenvalues from 10^low to 10^high."""
    turn = np.linalg.qr(rng.standard_normal((size, size)))[0]
    weight = turn @ np.diag(10.0 ** rng.uniform(low, high, size)) @ turn.T
    return 0.5 * (weight + weight.T)


def one_of(rng, values):
    values = list(values)
    return values[int(rng.integers(len(values)))]


# The model: its numbers, the independent functions, and the ways in which users write it


class Model:
    """x+ = A x + B u + terms, or the same as a rate; y = C x + D u + terms."""

    def __init__(self, rng, source, writing):
        self.source, self.writing = source, writing
        # Small ones more often: compilers unroll their loops in more ways.
        most = one_of(rng, (3, 8))
        self.n, self.p = (int(rng.integers(1, most + 1)) for _ in range(2))
        self.m = int(one_of(rng, (0, 0, 1, 2, 3)))
        n, p, m = self.n, self.p, self.m
        branching = writing in ("branching", "item", "flat", "loop", "buffer in a branch")
        if writing in ("matmul", "view"):
            self.kind = "linear"
        elif writing == "clipping in place":
            self.kind = "limit"
        else:
            self.kind = "branch" if branching else one_of(rng, (*SMOOTH, *KINKED))
        self.timed = writing in ("batched", "columns", "looped", "branching", "compiled",
                                 "interpreted", "jax") and rng.random() < 0.35
        self.method = one_of(rng, ("euler", "rk4")) if self.timed else None
        self.dt = float(10.0 ** rng.uniform(-2, -0.5))
        A = rng.standard_normal((n, n))
        A *= rng.uniform(0.3, 0.95) / max(np.abs(np.linalg.eigvals(A)).max(), 1e-3)
        # Not far from normal: transients stay small.
        A = 0.5 * A / max(1.0, np.linalg.norm(A, 2)) + 0.4 * np.eye(n)
        self.A = A - 1.5 * np.eye(n) if self.timed else A
        self.B, self.D = 0.3 * rng.standard_normal((n, m)), 0.3 * rng.standard_normal((p, m))
        self.C = rng.standard_normal((p, n)) / math.sqrt(n)
        if writing == "view":
            self.p = p = min(p, n)
            self.C, self.D = np.eye(n)[:p], np.zeros((p, m))
        self.a, self.b, self.c = (rng.uniform(-0.3, 0.3, n) for _ in range(3))
        self.s = rng.uniform(-0.5, 0.5, p)
        self.k, self.l = rng.integers(0, n, n).tolist(), rng.integers(0, n, n).tolist()
        self.q = rng.integers(0, n, p).tolist()
        self.limit = -0.2 if self.kind == "limit" else float(rng.uniform(-0.3, 0.3))
        #: The same numbers as lists of floats, for loops.
        self.numbers = [one.tolist() for one in (self.A, self.B, self.C, self.D)]
        self.factors = [one.tolist() for one in (self.a, self.b, self.c, self.s)]

    # Independent: lists of floats, one state, no NumPy

    def f_terms(self, x, u):
        if self.kind == "limit":
            x = [max(value, self.limit) for value in x]
        values, (a, b, c, _) = [], self.factors
        for i, (row, forces) in enumerate(zip(*self.numbers[:2], strict=True)):
            value = 0.0
            for factor, one in zip(row, x, strict=True):
                value += factor * one
            for factor, one in zip(forces, u, strict=True):
                value += factor * one
            one, two = x[self.k[i]], x[self.l[i]]
            if self.kind == "smooth":
                value += a[i] * math.sin(one) + b[i] * two / (1.0 + two * two)
            elif self.kind == "bilinear":
                value += a[i] * one * two / (1.0 + one * one + two * two)
            elif self.kind == "branch":
                value += b[i] * one if one > self.limit else c[i] * one + a[i]
            values.append(value)
        return values

    def f(self, x, u, dt=None):
        """x(t+1) as a list of floats."""
        x = [float(value) for value in x]
        u = [float(value) for value in u]
        if not self.timed:
            return self.f_terms(x, u)
        dt = self.dt if dt is None else float(dt)

        def moved(share, slope):
            return [one + share * dt * rate for one, rate in zip(x, slope, strict=True)]

        one = self.f_terms(x, u)
        if self.method == "euler":
            return moved(1.0, one)
        two = self.f_terms(moved(0.5, one), u)
        three = self.f_terms(moved(0.5, two), u)
        four = self.f_terms(moved(1.0, three), u)
        total = [
            (a + 2.0 * b + 2.0 * c + d) / 6.0
            for a, b, c, d in zip(one, two, three, four, strict=True)
        ]
        return moved(1.0, total)

    def h(self, x, u):
        """y(t) as a list of floats."""
        x = [float(value) for value in x]
        if self.kind == "limit" and self.writing == "clipping in place":
            x = [max(value, self.limit) for value in x]
        values = []
        for i, (row, forces) in enumerate(zip(*self.numbers[2:], strict=True)):
            value = 0.0
            for factor, one in zip(row, x, strict=True):
                value += factor * one
            for factor, one in zip(forces, u, strict=True):
                value += factor * float(one)
            one, s = x[self.q[i]], self.factors[3][i]
            if self.kind == "branch":
                value += s * one if one > self.limit else 0.0
            elif self.kind != "linear":
                value += s * math.tanh(one)
            values.append(value)
        return values

    # What the user writes: the same numbers with the library's functions

    def _written(self, x, u, xp, where, output):
        """The components, of arrays x[j], u[j] of whatever the library has."""
        matrix, inputs = self.numbers[2:] if output else self.numbers[:2]
        if self.kind == "limit" and not output:
            x = [xp.maximum(one, self.limit) for one in x]
        values = []
        for i, row in enumerate(matrix):
            value = row[0] * x[0]
            for j in range(1, self.n):
                value = value + row[j] * x[j]
            for j in range(self.m):
                value = value + inputs[i][j] * u[j]
            if output:
                one, s = x[self.q[i]], self.factors[3][i]
                if self.kind == "branch":
                    value = value + where(one, s * one, 0.0 * one)
                elif self.kind != "linear":
                    value = value + s * xp.tanh(one)
            else:
                one, two = x[self.k[i]], x[self.l[i]]
                a, b, c = (factor[i] for factor in self.factors[:3])
                if self.kind == "smooth":
                    value = value + a * xp.sin(one) + b * two / (1.0 + two**2)
                elif self.kind == "bilinear":
                    value = value + a * one * two / (1.0 + one**2 + two**2)
                elif self.kind == "branch":
                    value = value + where(one, b * one, c * one + a)
            values.append(value)
        return values

    def _numpy(self, output):
        """A function (x, u) in NumPy."""
        writing, size = self.writing, self.p if output else self.n
        matrix, inputs = (self.C, self.D) if output else (self.A, self.B)
        buffer = np.empty(size)

        def choose(v, a, b):
            return np.where(v > self.limit, a, b)

        def batched(x, u):
            x = [x[..., j] for j in range(self.n)]
            u = [u[..., j] for j in range(self.m)]
            return np.stack(self._written(x, u, np, choose, output), axis=-1)

        def matmul(x, u):
            return x @ matrix.T + (u @ inputs.T if self.m else 0.0)

        def view(x, u):
            return x[..., :size] if output else matmul(x, u)

        def columns(x, u):
            return np.array(self._written(x, u, np, choose, output))

        def looped(x, u):
            return self.h(x, u) if output else self.f_terms([float(one) for one in x], list(u))

        def decided(v, a, b):
            return a if v > self.limit else b

        def branching(x, u):
            return np.array(self._written(x, u, np, decided, output))

        def item(x, u):
            # The decisions look at the first numbers of the memory.
            signs = [x.item(j) > self.limit for j in range(self.n)]
            return self._decided(x, u, signs, output)

        def flat(x, u):
            signs = [x.flat[j] > self.limit for j in range(self.n)]
            return self._decided(x, u, signs, output)

        def loop(x, u):
            signs = [float(one) > self.limit for one in np.asarray(x).ravel()[: self.n]]
            return self._decided(x, u, signs, output)

        def buffered(x, u):
            buffer[:] = self._written(x, u, np, choose, output)
            return buffer

        def buffered_in_a_branch(x, u):
            signs = [x.item(j) > self.limit for j in range(self.n)]
            if signs[0]:
                buffer[:] = self._decided(x, u, signs, output)
                return buffer
            return self._decided(x, u, signs, output)

        def clipping(x, u):
            x[x < self.limit] = self.limit
            return batched(x, u)

        return {
            "batched": batched, "matmul": matmul, "view": view, "columns": columns,
            "looped": looped, "branching": branching, "item": item, "flat": flat, "loop": loop,
            "buffer": buffered, "buffer in a branch": buffered_in_a_branch,
            "clipping in place": clipping,
        }[writing]

    def _decided(self, x, u, signs, output):
        """The branches taken by what was found of the state before."""
        matrix, inputs = (self.C, self.D) if output else (self.A, self.B)
        values = []
        for i in range(len(matrix)):
            value = sum(float(matrix[i, j]) * x[..., j] for j in range(self.n))
            for j in range(self.m):
                value = value + float(inputs[i, j]) * u[..., j]
            if output:
                j = self.q[i]
                value = value + (float(self.s[i]) * x[..., j] if signs[j] else 0.0)
            else:
                j = self.k[i]
                high, low = float(self.b[i]) * x[..., j], float(self.c[i]) * x[..., j]
                value = value + (high if signs[j] else low + float(self.a[i]))
            values.append(value)
        return np.stack(values, axis=-1)

    def _with_arity(self, function):
        if self.m:
            return lambda x, u: function(x, u)
        return lambda x: function(x, np.zeros(0))

    def system(self, sets):
        """The system as a user would make it."""
        sizes = {"n": self.n, "p": self.p, "m": self.m, **sets}
        if self.source == "numpy":
            f, h = self._with_arity(self._numpy(False)), self._with_arity(self._numpy(True))
            if self.timed:
                return qpmhe.System.from_ode(f, h, dt=self.dt, method=self.method, **sizes)
            return qpmhe.System(f, h, **sizes)
        timing = {"dt": self.dt, "method": self.method} if self.timed else {}
        if self.source == "casadi":
            import casadi as ca

            class XP:
                sin, tanh, maximum = ca.sin, ca.tanh, ca.fmax

            def write(x, u, output):
                def where(v, a, b):
                    return ca.if_else(v > self.limit, a, b)

                x, u = [x[j] for j in range(self.n)], [u[j] for j in range(self.m)]
                return ca.vertcat(*self._written(x, u, XP, where, output))

            compiled = None if self.writing == "compiled" else False
            return qpmhe.System.from_casadi(
                self._with_arity(lambda x, u: write(x, u, False)),
                self._with_arity(lambda x, u: write(x, u, True)),
                compiled=compiled, **timing, **sizes,
            )
        import jax.numpy as jnp

        def write(x, u, output):
            def where(v, a, b):
                return jnp.where(v > self.limit, a, b)

            return jnp.stack(self._written(x, u, jnp, where, output))

        return qpmhe.System.from_jax(
            self._with_arity(lambda x, u: write(x, u, False)),
            self._with_arity(lambda x, u: write(x, u, True)),
            **timing, **sizes,
        )

    def slopes(self, x, u, dt):
        """Jacobians of f and h by central differences."""
        A, C = np.empty((self.n, self.n)), np.empty((self.p, self.n))
        for j in range(self.n):
            step = 1e-5 * (1.0 + abs(float(x[j])))
            high, low = np.array(x, float), np.array(x, float)
            high[j] += step
            low[j] -= step
            A[:, j] = np.subtract(self.f(high, u, dt), self.f(low, u, dt)) / (2.0 * step)
            C[:, j] = np.subtract(self.h(high, u), self.h(low, u)) / (2.0 * step)
        return A, C


# The observer, twice as well


class Watcher:
    """What the auxiliary observer does: L(z, v), and its covariance where it has one."""

    def __init__(self, rng, model, kind, start):
        self.model, self.kind = model, kind
        n, p = model.n, model.p
        self.P0, self.Q, self.R = spd(rng, n, -1, 0.5), spd(rng, n, -2, -0.5), spd(rng, p, -2, 0)
        self.gain = 0.3 * np.linalg.pinv(model.C) @ np.diag(rng.uniform(0.2, 1.0, p))
        self.gain += 0.02 * rng.standard_normal((n, p))
        self.gain /= max(1.0, np.linalg.norm(self.gain, 2))
        self.spread = float(rng.uniform(0.5, 2.0))
        self.start = start
        self.exact = kind in ("luenberger", "injection", "unscented")

    def made(self, system):
        covariances = {"prior": self.P0, "disturbance": self.Q, "noise": self.R}
        if self.kind == "luenberger":
            return qpmhe.Luenberger(self.gain)
        if self.kind == "injection":
            gain = self.gain.copy()
            return qpmhe.OutputInjection(lambda z, v: gain @ np.tanh(v) / (1.0 + z[0] ** 2))
        if self.kind == "steady":
            u = {"u": np.zeros(self.model.m)} if self.model.m else {}
            observer = qpmhe.SteadyStateKalman(
                system, self.start, disturbance=self.Q, noise=self.R, **u
            )
            self._iterate()
            return observer
        kind = qpmhe.ExtendedKalman if self.kind == "extended" else qpmhe.UnscentedKalman
        more = {} if self.kind == "extended" else {"spread": self.spread}
        return kind(**covariances, **more)

    def _iterate(self):
        """The stationary covariance, by going on until it stands still."""
        self.A0, self.C0 = self.model.slopes(self.start, np.zeros(self.model.m), None)
        P = self.Q.copy()
        for _ in range(5000):
            S = self.C0 @ P @ self.C0.T + self.R
            K = self.A0 @ P @ self.C0.T @ np.linalg.inv(S)
            following = self.A0 @ P @ self.A0.T + self.Q - K @ S @ K.T
            done = np.abs(following - P).max() <= 1e-15 * np.abs(P).max()
            P = following
            if done:
                break
        self.P0, self.gain = P, K

    def step(self, z, P, sample):
        """z(t+1) and P(t+1)."""
        model = self.model
        y, u, dt, own = sample
        there = np.isfinite(y)
        v = np.where(there, y - np.array(model.h(z, u)), 0.0)
        ahead = np.array(model.f(z, u, dt))
        R = self.R if own is None else np.linalg.inv(own)
        if self.kind == "luenberger":
            return ahead + self.gain @ v, None
        if self.kind == "injection":
            return ahead + self.gain @ np.tanh(v) / (1.0 + z[0] ** 2), None
        if self.kind == "steady":
            K = np.where(there, self.gain, 0.0)
            closed = self.A0 - K @ self.C0
            return ahead + self.gain @ v, closed @ P @ closed.T + self.Q + K @ R @ K.T
        R = R[there][:, there]
        if self.kind == "extended":
            A, C = model.slopes(z, u, dt)
            C = C[there]
            K = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + R) if there.any() else A @ P @ C.T
            closed = A - K @ C
            return ahead + K @ v[there], closed @ P @ closed.T + K @ R @ K.T + self.Q
        root = np.linalg.cholesky(P)
        F, H = [], []
        for sign in (1.0, -1.0):
            for j in range(model.n):
                point = z + sign * self.spread * root[:, j]
                F.append(np.array(model.f(point, u, dt)) - ahead)
                H.append((np.array(model.h(point, u)) - model.h(z, u))[there])
        F, H = np.array(F), np.array(H)
        weight = 1.0 / (2.0 * self.spread**2)
        K = np.zeros((model.n, 0))
        if there.any():
            K = weight * F.T @ H @ np.linalg.inv(weight * H.T @ H + R)
        rest = F - H @ K.T
        return ahead + K @ v[there], weight * rest.T @ rest + K @ R @ K.T + self.Q


# The cost


class Price:
    """J from its definition."""

    def __init__(self, rng, model, watcher, prior_of_observer, quadratic):
        n, p = model.n, model.p
        self.model = model
        self.prior_of_observer = prior_of_observer
        self.discount = float(one_of(rng, (1.0, 1.0, 1.0, 0.95, 0.6)))
        self.names, self.weights, self.numbers, self.single = [], [], [], []
        for size in (n, n, p):
            kind = "quadratic" if quadratic else one_of(rng, ("quadratic", "huber", "power"))
            alone = kind != "quadratic" and rng.random() < 0.4
            weight = np.diag(10.0 ** rng.uniform(-1, 2, size)) if alone else spd(rng, size)
            number = {"quadratic": 2.0, "huber": float(rng.uniform(0.3, 2.0)),
                      "power": float(one_of(rng, (1.0, 1.3, 1.5, 2.0)))}[kind]
            self.names.append(kind)
            self.weights.append(weight)
            self.numbers.append(number)
            self.single.append(alone)
        self.quadratic = quadratic
        if prior_of_observer:
            self.names[0], self.single[0] = "quadratic", False
        self.low, self.high = 1e-3, 1e4

    def made(self):
        losses = []
        for kind, weight, number, alone in zip(
            self.names, self.weights, self.numbers, self.single, strict=True
        ):
            if kind == "quadratic":
                losses.append(weight)
            elif kind == "huber":
                losses.append(qpmhe.Huber(weight, number, per_component=alone))
            else:
                losses.append(qpmhe.Power(weight, number, per_component=alone))
        if self.prior_of_observer:
            losses[0] = qpmhe.ObserverPrior(self.low, self.high)
        kind = qpmhe.QuadraticCost if self.quadratic else qpmhe.RobustCost
        prior, disturbance, noise = losses
        return kind(prior=prior, disturbance=disturbance, noise=noise, discount=self.discount)

    def _loss(self, which, residual, weight):
        def of(q):
            number = self.numbers[which]
            if self.names[which] == "quadratic":
                return q
            if self.names[which] == "huber":
                r = math.sqrt(q)
                return q if r <= number else 2.0 * number * r - number * number
            return math.sqrt(q) ** number

        size = len(residual)
        if self.single[which]:
            return sum(of(float(weight[j, j]) * float(residual[j]) ** 2) for j in range(size))
        q = sum(
            float(residual[i]) * float(weight[i, j]) * float(residual[j])
            for i in range(size) for j in range(size)
        )
        return of(max(q, 0.0))

    def prior_weight(self, P):
        if not self.prior_of_observer:
            return self.weights[0]
        values, vectors = np.linalg.eigh(0.5 * (P + P.T))
        return vectors @ np.diag(np.clip(1.0 / values, self.low, self.high)) @ vectors.T

    def of(self, trajectory, prior, P, samples):
        """J, its prior term, and the residuals w and v."""
        K, model = len(samples), self.model
        first = self._loss(0, np.asarray(trajectory[0]) - prior, self.prior_weight(P))
        first *= self.discount**K
        J, ws, vs = first, [], []
        for i, (y, u, dt, own) in enumerate(samples):
            x = trajectory[i]
            w = np.asarray(trajectory[i + 1]) - np.array(model.f(x, u, dt))
            v = y - np.array(model.h(x, u))
            there = np.isfinite(y)
            stage = self._loss(1, w, self.weights[1])
            if there.any():
                weight = self.weights[2] if own is None else own
                if not there.all():
                    weight = np.linalg.inv(np.linalg.inv(weight)[there][:, there])
                stage += self._loss(2, v[there], weight)
            J += self.discount ** (K - 1 - i) * stage
            ws.append(w)
            vs.append(v)
        return J, first, np.array(ws), np.array(vs)


# The sets


class Region:
    """X, W or V: rows of inequalities, some of them bounds."""

    def __init__(self, rng, dimension, width, fixed=()):
        low, high = -width * rng.uniform(0.5, 1.5, dimension), width * rng.uniform(
            0.5, 1.5, dimension
        )
        low[rng.random(dimension) < 0.3], high[rng.random(dimension) < 0.3] = -np.inf, np.inf
        low[list(fixed)] = high[list(fixed)] = 0.0
        self.low, self.high, self.rows, self.side = low, high, None, None
        if rng.random() < 0.3:
            self.rows = rng.standard_normal((int(rng.integers(1, 3)), dimension))
            self.side = width * rng.uniform(1.0, 2.0, len(self.rows)) * math.sqrt(dimension)

    def made(self):
        box = qpmhe.Box(self.low, self.high)
        return box if self.rows is None else box & qpmhe.Polytope(self.rows, self.side)

    def missed(self, point):
        """By how much; inequalities on components that are NaN do not count."""
        worst = 0.0
        for j, value in enumerate(point):
            if math.isfinite(value):
                worst = max(worst, float(self.low[j]) - value, value - float(self.high[j]))
        if self.rows is not None:
            for row, side in zip(self.rows, self.side, strict=True):
                value = sum(float(a) * float(b) for a, b in zip(row, point, strict=True))
                if math.isfinite(value):
                    worst = max(worst, value - float(side))
        return worst


# One problem


class WrongStepError(Exception):
    """A step that is not what it says."""


class Case:
    """A model, an estimator for it, and what is expected of each of its steps."""

    def __init__(self, seed, source=None, writing=None, engine=None):
        rng = self.rng = np.random.default_rng(seed)
        self.seed = seed
        self.source = source or one_of(rng, ("numpy",) * 6 + ("casadi",) * 3 + ("jax",))
        self.writing = writing or one_of(rng, WRITINGS[self.source])
        self.model = model = Model(rng, self.source, self.writing)
        self.start = np.clip(0.5 * rng.standard_normal(model.n), -0.15, 2.0)
        self._set_up_sets()
        self.engine = engine
        self.level = "none"
        if self.writing == "compiled":
            self.level = " ".join(one_of(rng, getattr(compiler, "_LEVELS", (("as usual",),))))
        with self.optimised():
            self.system = model.system({name: one.made() for name, one in self.regions.items()})

    @contextmanager
    def optimised(self):
        """Compile with one of the levels of optimisation that are in use, or below."""
        levels = getattr(compiler, "_LEVELS", None)
        if levels is None:
            yield
            return
        compiler._LEVELS = tuple(one for one in levels if " ".join(one) == self.level) or levels
        try:
            yield
        finally:
            compiler._LEVELS = levels

    def _set_up_sets(self):
        rng, model = self.rng, self.model
        self.regions, self.fixed = {}, ()
        if self.writing == "clipping in place":
            region = Region(rng, model.n, 1.0)
            region.low, region.high = np.full(model.n, -0.2), np.full(model.n, np.inf)
            region.rows = None
            self.regions["states"] = region
        elif rng.random() < 0.25:
            self.regions["states"] = Region(rng, model.n, 3.0)
        if rng.random() < 0.25:
            if rng.random() < 0.4:
                self.fixed = (int(rng.integers(model.n)),)
            self.regions["disturbances"] = Region(rng, model.n, 0.3, self.fixed)
        if rng.random() < 0.2:
            self.regions["noises"] = Region(rng, model.p, 1.5)
        if "states" in self.regions and self.regions["states"].missed(self.start) > 0.0:
            self.start = np.zeros(model.n)

    def configure(self):
        """Another estimator for the same system."""
        rng, model = self.rng, self.model
        engine = self.engine
        if engine is None:
            engine = "python"
            # Not for components of w without noise: documented, and refused.
            if self.writing == "compiled" and not self.fixed and rng.random() < 0.6:
                engine = "compiled"
        kinds = ["luenberger", "luenberger", "injection"]
        if model.kind in SMOOTH:
            kinds += ["extended", "extended", "steady"]
        if "states" not in self.regions:
            kinds += ["unscented"]
        observer = "luenberger" if engine == "compiled" else one_of(rng, kinds)
        self.watcher = Watcher(rng, model, observer, self.start)
        if self.fixed:
            self.watcher.gain[list(self.fixed)] = 0.0
        candidate = "reinitialized" if rng.random() < 0.15 else "observer"
        covariant = observer in ("extended", "steady", "unscented")
        prior = covariant and candidate == "observer" and rng.random() < 0.6
        quadratic = engine == "compiled" or rng.random() < 0.65
        self.price = Price(rng, model, self.watcher, prior, quadratic)
        self.options = {
            "horizon": int(rng.integers(1, 13)),
            "backend": one_of(rng, COMPILED_BACKENDS if engine == "compiled" else BACKENDS),
            "max_qps": one_of(rng, (0, 1, 1, 2, 2, 5, None)),
            "max_solver_iterations": one_of(rng, (None, None, 1, 3)),
            "outside": one_of(rng, ("drop", "drop", "project", "keep")),
            "start": one_of(rng, ("candidate", "candidate", "best")),
            "candidate": candidate,
            "engine": engine,
        }
        if "states" in self.regions or "disturbances" in self.regions or "noises" in self.regions:
            if self.options["backend"] == "banded":
                self.options["backend"] = "auto"
        elif self.options["outside"] != "drop":
            self.options["outside"] = "drop"
        self.options["delay"] = int(rng.integers(0, self.options["horizon"] + 1))
        self.data = {
            "missing": one_of(rng, (0.0, 0.0, 0.1, 0.4)),
            "own noise": one_of(rng, (0.0, 0.0, 0.2)),
            "irregular": 0.2 if model.timed and rng.random() < 0.4 else 0.0,
            "outliers": one_of(rng, (0.0, 0.05)),
        }
        self.scribble = rng.random() < 0.3
        self.snapshots = rng.random() < 0.15
        observer, cost = self.watcher.made(self.system), self.price.made()
        self.arguments = (self.system, observer, cost)
        return self._estimator()

    def _estimator(self):
        with self.optimised():
            return qpmhe.MovingHorizonEstimator(
                *self.arguments, initial_state=self.start, **self.options
            )

    def describe(self):
        model = self.model
        return (
            f"seed {self.seed}: {self.source}/{self.writing}/{model.kind} n={model.n} p={model.p} "
            f"m={model.m} {model.method or 'discrete'} sets={sorted(self.regions)} "
            f"fixed={self.fixed} observer={self.watcher.kind} cost={self.price.names} "
            f"single={self.price.single} discount={self.price.discount} "
            f"observer prior={self.price.prior_of_observer} {self.options} {self.data} "
            f"scribble={self.scribble} snapshots={self.snapshots}"
        )

    def sample(self, x):
        """y, u, dt and own weight of a step, and where the plant goes."""
        rng, model = self.rng, self.model
        u = rng.uniform(-1.0, 1.0, model.m)
        dt = None
        if rng.random() < self.data["irregular"]:
            dt = model.dt * float(rng.uniform(0.3, 1.7))
        y = np.array(model.h(x, u)) + 0.2 * rng.standard_normal(model.p)
        if rng.random() < self.data["outliers"]:
            y[rng.integers(model.p)] += 20.0 * rng.standard_normal()
        y[rng.random(model.p) < self.data["missing"]] = np.nan
        own = None
        if rng.random() < self.data["own noise"]:
            single = self.price.single[2]
            own = np.diag(10.0 ** rng.uniform(-1, 2, model.p)) if single else spd(rng, model.p)
        following = np.array(model.f(x, u, dt)) + 0.1 * rng.standard_normal(model.n)
        return (y, u, dt, own), following

    # The promise

    def run(self, steps, counts):
        """Take so many steps; raises `WrongStepError`."""
        mhe = self.configure()
        N, model = self.options["horizon"], self.model
        x = self.start + 0.3 * self.rng.standard_normal(model.n)
        samples, z, P = [], [self.start.copy()], [self.watcher.P0.copy()]
        self.unseen = -1
        history, handed_out = [self.start.copy()], []
        buffer_y, buffer_u = np.empty(model.p), np.empty(model.m)
        for t in range(steps):
            sample, x = self.sample(x)
            y, u, dt, own = sample
            samples.append(sample)
            # The same arrays every time, as a driver would.
            buffer_y[:], buffer_u[:] = y, u
            given = {} if own is None else {"noise_weight": own.copy()}
            if dt is not None:
                given["dt"] = dt
            estimate = mhe.update(buffer_y, *((buffer_u,) if model.m else ()), **given)
            buffer_y[:], buffer_u[:] = 1e3, -1e3
            K = min(t + 1, N)
            self._check(estimate, t, K, samples, z, P, history, counts)
            if not np.array_equal(mhe.state, history[-1]):
                raise WrongStepError("the estimator's state is not the estimate's")
            arrays = [
                estimate.trajectory, estimate.candidate, estimate.disturbances, estimate.noises,
                estimate.state, estimate.filtered, mhe.state,
            ]
            if estimate.delayed is not None:
                arrays.append(estimate.delayed)
            if self.scribble:
                for one in arrays:
                    if one.flags.writeable:
                        one[...] = 777.0
            else:
                handed_out.append([(one, one.copy()) for one in arrays])
                # After the next step, and long after it left the window.
                old = handed_out[-2:-1] + handed_out[: -3 * N]
                del handed_out[: -3 * N]
                for one, kept in itertools.chain(*old):
                    if not np.array_equal(one, kept, equal_nan=True):
                        raise WrongStepError("an array that was handed out has changed")
            if self.snapshots and self.rng.random() < 0.1:
                state = pickle.loads(pickle.dumps(mhe.state_dict()))
                mhe = self._estimator()
                mhe.load_state_dict(state)
                counts["snapshots"] += 1
            self._count(estimate, sample, counts)

    def _count(self, estimate, sample, counts):
        y, _, dt, own = sample
        observed = np.isfinite(y)
        status = estimate.status
        counts["steps"] += 1
        for key, value in (
            ("model", f"{self.source}, {self.writing}"), ("engine", self.options["engine"]),
            ("engine and model", f"{self.options['engine']}, {self.source}"),
            ("optimisation", self.level), ("kind", self.model.kind),
            ("n", self.model.n), ("p", self.model.p), ("m", self.model.m),
            ("time", self.model.method or "discrete"),
            ("observer", self.watcher.kind),
            ("prior of the observer", self.price.prior_of_observer),
            ("cost", "quadratic" if self.price.quadratic else "robust"),
            ("discounted", self.price.discount < 1.0), ("horizon", self.options["horizon"]),
            ("backend", self.options["backend"]), ("max_qps", self.options["max_qps"]),
            ("cap", self.options["max_solver_iterations"]),
            ("candidate", self.options["candidate"]), ("start", self.options["start"]),
            ("sets", " ".join(sorted(self.regions)) or "none"),
            ("noise-free", bool(self.fixed)), ("outside", self.options["outside"]),
            ("sample", "complete" if observed.all() else "partial" if observed.any() else "none"),
            ("own noise weight", own is not None), ("irregular step", dt is not None),
            ("scribbled over", self.scribble),
        ):
            counts[key, value] += 1
        for flag in Status:
            if flag in status:
                counts["status", flag.name] += 1

    def _check(self, estimate, t, K, samples, z, P, history, counts):
        status, price = estimate.status, self.price
        window = samples[-K:]
        n = self.model.n
        if estimate.trajectory.shape != (K + 1, n) or estimate.candidate.shape != (K + 1, n):
            raise WrongStepError(f"shapes {estimate.trajectory.shape}, {estimate.candidate.shape}")
        if not np.isfinite(estimate.trajectory).all() or not math.isfinite(estimate.cost):
            raise WrongStepError(f"not finite: {estimate!r}")
        if Status.MODEL_FAILED in status or Status.FAILED_STAGE in status:
            raise WrongStepError(f"the model does not fail, says {status}")
        raw = self._observed(estimate, t, K, window, z, P, history)
        prior, covariance = raw[0], P[t + 1 - K]
        J, first, w, v = price.of(estimate.trajectory, prior, covariance, window)
        candidate_J, candidate_first, cw, cv = price.of(
            estimate.candidate, prior, covariance, window
        )
        loose = 1e-5 if price.prior_of_observer and not self.watcher.exact else 1e-8
        for name, told, own, term in (
            ("cost", estimate.cost, J, first),
            ("candidate_cost", estimate.candidate_cost, candidate_J, candidate_first),
        ):
            if not abs(told - own) <= 1e-8 * abs(own) + loose * term + 1e-10:
                raise WrongStepError(f"{name} is {told!r}, truly {own!r}; {status}")
        if not estimate.cost <= estimate.candidate_cost:
            raise WrongStepError(f"cost {estimate.cost!r} above {estimate.candidate_cost!r}")
        slack = 2.0 * loose * (first + candidate_first) + 1e-8 * candidate_J + 1e-10
        if not candidate_J + slack >= J:
            raise WrongStepError(f"truly, J {J!r} is above {candidate_J!r}")
        if (Status.IMPROVED in status) != (estimate.cost < estimate.candidate_cost):
            raise WrongStepError(f"{status} with {estimate.cost!r} and {estimate.candidate_cost!r}")
        if (Status.IMPROVED in status) == (Status.CANDIDATE in status):
            raise WrongStepError(f"{status}")
        if Status.CANDIDATE in status and not np.array_equal(
            estimate.trajectory, estimate.candidate
        ):
            raise WrongStepError("the estimate is not the candidate")
        scale = 1.0 + float(np.abs(estimate.trajectory).max())
        if not np.allclose(estimate.disturbances, w, rtol=0, atol=1e-12 * scale):
            raise WrongStepError("the disturbances are not those of the trajectory")
        y_scale = scale + float(np.nanmax(np.abs([s[0] for s in window]), initial=0.0))
        if not np.allclose(estimate.noises, v, rtol=0, atol=1e-12 * y_scale, equal_nan=True):
            raise WrongStepError("the noises are not those of the trajectory")
        self._check_sets(estimate, w, v, cw, cv, scale)
        if not np.array_equal(estimate.state, estimate.trajectory[-1]):
            raise WrongStepError("state is not the last of the trajectory")
        if not np.array_equal(estimate.filtered, estimate.trajectory[-2]):
            raise WrongStepError("filtered is not the last but one of the trajectory")
        delay = self.options["delay"]
        if delay <= K and not np.array_equal(estimate.delayed, estimate.trajectory[K - delay]):
            raise WrongStepError("delayed is another state")
        missing = not all(math.isfinite(value) for value in samples[-1][0])
        if missing != (Status.MISSING in status):
            raise WrongStepError(f"{status} of y = {samples[-1][0]}")
        history.append(estimate.state.copy())

    def _observed(self, estimate, t, K, window, z, P, history):
        """Check the candidate against the observer; the observer's own states."""
        first = t + 1 - K
        projected = Status.PROJECTED in estimate.status
        found = estimate.candidate
        if self.options["candidate"] == "reinitialized":
            z[first] = history[first]
            again = range(K)
        else:
            again = range(K - 1, K)
        # Past a projection the observer's states are those of the second implementation only.
        same = np.allclose if self.unseen >= first else np.array_equal
        if not projected and not same(found[0], z[first]):
            raise WrongStepError(f"the candidate starts at {found[0]}, not at {z[first]}")
        tolerance = 1e-9 if self.watcher.exact else 1e-5
        for i in again:
            following, covariance = self.watcher.step(z[first + i], P[first + i], window[i])
            del z[first + i + 1 :], P[first + i + 1 :]
            z.append(following)
            P.append(covariance)
            if projected:
                self.unseen = first + i + 1
                continue
            scale = 1.0 + float(np.abs(following).max())
            if not np.allclose(found[i + 1], following, rtol=0, atol=tolerance * scale):
                raise WrongStepError(f"the candidate goes to {found[i + 1]}, not to {following}")
            z[-1] = found[i + 1].copy()
        if not projected:
            if not same(found, np.array(z[first:])):
                raise WrongStepError("the candidate has changed within the window")
            z[first:] = [state.copy() for state in found]
            self.unseen = -1
        return z[first : first + K + 1]

    def _check_sets(self, estimate, w, v, cw, cv, scale):
        if not self.regions:
            if estimate.dropped:
                raise WrongStepError(f"dropped {estimate.dropped}, of no sets")
            return
        rounding = 1e-14 * scale

        def outside(trajectory, disturbances, noises, tolerance):
            points = dict(zip(SETS, (trajectory, disturbances, noises), strict=True))
            return {
                name for name, region in self.regions.items()
                if max(region.missed(point) for point in points[name]) > tolerance
            }

        status, policy = estimate.status, self.options["outside"]
        of_candidate = (estimate.candidate, cw, cv)
        surely = outside(*of_candidate, FEASIBLE * (1 + 1e-6) + rounding)
        perhaps = outside(*of_candidate, FEASIBLE * (1 - 1e-6) - rounding)
        if policy == "keep":
            if surely and Status.CANDIDATE not in status:
                raise WrongStepError("keep: the candidate is outside and not the estimate")
            if estimate.dropped:
                raise WrongStepError("keep: dropped")
            return
        if Status.PROJECTED in status:
            if policy != "project" or surely:
                raise WrongStepError(f"projected, and outside of {surely}")
        elif not surely <= set(estimate.dropped) <= perhaps:
            raise WrongStepError(f"dropped {estimate.dropped}, and not {surely}")
        left = outside(estimate.trajectory, w, v, FEASIBLE * (1 + 1e-6) + 10.0 * rounding)
        if not left <= set(estimate.dropped):
            raise WrongStepError(f"outside of {left}; dropped {estimate.dropped}")


def fuzz(steps, seed=0, *, source=None, writing=None, engine=None, estimators=3, report=None):
    """So many steps; counts by category and the failures found, as text."""
    counts, failures, began = Counter(), [], time.perf_counter()
    number = 0
    told = time.perf_counter()
    while counts["steps"] < steps:
        case_seed = seed * 1_000_003 + number
        number += 1
        case = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                case = Case(case_seed, source, writing, engine)
                slow = case.source == "jax" or case.writing == "compiled"
                for _ in range(estimators):
                    length = 90 if slow else 40
                    case.run(min(length, steps - counts["steps"]), counts)
                    counts["estimators"] += 1
                    if counts["steps"] >= steps:
                        break
        except WrongStepError as failure:
            failures.append(f"{failure}\n    {case.describe()}")
        except Exception:
            where = case.describe() if hasattr(case, "watcher") else (
                f"seed {case_seed}, source {source}, writing {writing}"
            )
            failures.append(f"{traceback.format_exc(limit=-4)}    {where}")
        counts["systems"] += 1
        counts["failures"] = len(failures)
        if len(failures) > 200:
            break
        if report is not None and time.perf_counter() - told > 30.0:
            told = time.perf_counter()
            report(f"{counts['steps']} steps, {len(failures)} failures, {told - began:.0f} s")
    return counts, failures


def table(counts):
    """The counts in lines."""
    lines = [f"{key}: {value}" for key, value in counts.items() if isinstance(key, str)]
    groups = {}
    for key, value in counts.items():
        if not isinstance(key, str):
            groups.setdefault(key[0], []).append((str(key[1]), value))
    for name, entries in groups.items():
        lines.append(f"{name}: " + "; ".join(f"{key} {value}" for key, value in sorted(entries)))
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--source", choices=WRITINGS)
    parser.add_argument("--writing")
    parser.add_argument("--engine", choices=("python", "compiled"))
    parser.add_argument("--show", type=int, default=20)
    given = parser.parse_args()
    counts, failures = fuzz(
        given.steps, given.seed, source=given.source, writing=given.writing, engine=given.engine,
        report=lambda line: print(line, flush=True),
    )
    print(table(counts))
    for failure in failures[: given.show]:
        print(failure)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
