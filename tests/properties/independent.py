"""The definitions a second time, for `fuzz_independent`: model, observer, J and sets.

From `qpmhe` comes only what a user writes down. Everything that judges is plain Python and
NumPy, for one state at a time, from the formulas in the paper and the documentation.
"""

import math

import numpy as np
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import nnls

import qpmhe

# Models with branches or limits have no derivative everywhere.
SMOOTH, KINKED = ("linear", "smooth", "bilinear"), ("branch", "limit")


def spd(rng, size, low=-1.0, high=2.0):
    """A random weight with eigenvalues from 10^low to 10^high."""
    turn = np.linalg.qr(rng.standard_normal((size, size)))[0]
    weight = turn @ np.diag(10.0 ** rng.uniform(low, high, size)) @ turn.T
    return 0.5 * (weight + weight.T)


def one_of(rng, values):
    values = list(values)
    return values[int(rng.integers(len(values)))]


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
            return qpmhe.from_casadi(
                self._with_arity(lambda x, u: write(x, u, False)),
                self._with_arity(lambda x, u: write(x, u, True)),
                compiled=compiled, **timing, **sizes,
            )
        import jax.numpy as jnp

        def write(x, u, output):
            def where(v, a, b):
                return jnp.where(v > self.limit, a, b)

            return jnp.stack(self._written(x, u, jnp, where, output))

        return qpmhe.from_jax(
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
        self.region = None
        #: Of the last step: whether it and its prediction were inside, by more than rounding.
        self.missed = self.predicted_missed = 0.0

    def keep_inside(self, region, prior_weight, noise_weight):
        """Project the observer onto a region, in the metric of its covariance or its error."""
        self.region, self.metric = region, np.linalg.inv(prior_weight)
        self.settled, self.prior_weight = False, prior_weight
        self.deviations = np.sqrt(np.linalg.inv(noise_weight).diagonal())
        self.exact = False

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
        following, covariance = self._free_step(z, P, sample)
        if self.region is None:
            return following, covariance
        if covariance is None and not self.settled:
            self._settle(z, sample)
        metric = self.metric if covariance is None else covariance
        self.missed = self.region.missed(following)
        self.predicted_missed = self.region.missed(self.model.f(z, *sample[1:3]))
        return self.region.nearest(following, metric), covariance

    def _settle(self, z, sample):
        """The Lyapunov metric of the error A - K C, if it is stable here."""
        A, C = self.model.slopes(z, *sample[1:3])
        gain = self.gain
        if self.kind == "injection":
            moves = self.gain @ np.diag(np.tanh(self.deviations) / self.deviations)
            gain = moves / (1.0 + z[0] ** 2)
        E = A - gain @ C
        if np.abs(np.linalg.eigvals(E)).max() < 1.0:
            self.metric = np.linalg.inv(solve_discrete_lyapunov(E.T, self.prior_weight))
            self.settled = True

    def filtered(self, z, P, sample):
        """The estimate of x(t) with y(t), and its covariance; z for an observer without one."""
        if P is None or self.kind in ("luenberger", "injection"):
            return z
        y, u, dt, own = sample
        there = np.isfinite(y)
        v = (y - np.array(self.model.h(z, u)))[there]
        R = (self.R if own is None else np.linalg.inv(own))[there][:, there]
        if self.kind == "unscented":
            root = self.spread * np.linalg.cholesky(P)
            moves = np.hstack((root, -root)).T
            H = np.array([self.model.h(z + move, u) for move in moves]) - self.model.h(z, u)
            cross = moves.T @ H[:, there] / (2.0 * self.spread**2)
            S = H[:, there].T @ H[:, there] / (2.0 * self.spread**2) + R
            K = cross @ np.linalg.inv(S)
            after = P - cross @ K.T
        else:
            C = self.C0[there] if self.kind == "steady" else self.model.slopes(z, u, dt)[1][there]
            K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
            if self.kind == "steady":  # its gain is that of all outputs
                S = self.C0 @ self.P0 @ self.C0.T + self.R
                K = (self.P0 @ self.C0.T @ np.linalg.inv(S))[:, there]
            closed = np.eye(len(z)) - K @ C
            after = closed @ P @ closed.T + K @ R @ K.T
        found = z + K @ v
        return found if self.region is None else self.region.nearest(found, after)

    def _free_step(self, z, P, sample):
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


class Price:
    """J from its definition."""

    def __init__(self, rng, model, watcher, prior_of_observer, quadratic):
        n, p = model.n, model.p
        self.model = model
        self.prior_of_observer = prior_of_observer
        self.discount = float(one_of(rng, (1.0, 1.0, 1.0, 0.95, 0.6)))
        self.names, self.weights, self.numbers, self.single = [], [], [], []
        for size in (n, n, p):
            kind = "quadratic" if quadratic else one_of(
                rng, ("quadratic", "huber", "power", "cauchy", "geman")
            )
            alone = kind != "quadratic" and rng.random() < 0.4
            weight = np.diag(10.0 ** rng.uniform(-1, 2, size)) if alone else spd(rng, size)
            threshold = float(rng.uniform(0.3, 2.0))
            number = {"quadratic": 2.0, "huber": threshold, "cauchy": threshold, "geman": threshold,
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
            elif kind in ("cauchy", "geman"):
                loss = {"cauchy": qpmhe.Cauchy, "geman": qpmhe.GemanMcClure}[kind]
                losses.append(loss(weight, number, per_component=alone))
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
            if self.names[which] == "cauchy":
                return 2.0 * number**2 * math.log1p(q / (2.0 * number**2))
            if self.names[which] == "geman":
                return q / (1.0 + q / (4.0 * number**2))
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

    def noise_weight(self, y, own):
        """Weight of the noises that are there, and which are."""
        there = np.isfinite(y)
        weight = self.weights[2] if own is None else own
        if there.any() and not there.all():
            weight = np.linalg.inv(np.linalg.inv(weight)[there][:, there])
        return weight, there

    def of(self, trajectory, prior, P, samples, hold=None):
        """J, its prior term, and the residuals w and v."""
        K, model = len(samples), self.model
        first = self._loss(0, np.asarray(trajectory[0]) - prior, self.prior_weight(P))
        if hold is not None:
            first += hold.term(trajectory[0])
        first *= self.discount**K
        J, ws, vs = first, [], []
        for i, (y, u, dt, own) in enumerate(samples):
            x = trajectory[i]
            w = np.asarray(trajectory[i + 1]) - np.array(model.f(x, u, dt))
            v = y - np.array(model.h(x, u))
            weight, there = self.noise_weight(y, own)
            stage = self._loss(1, w, self.weights[1])
            if there.any():
                stage += self._loss(2, v[there], weight)
            J += self.discount ** (K - 1 - i) * stage
            ws.append(w)
            vs.append(v)
        return J, first, np.array(ws), np.array(vs)


class Held:
    """States held at trusted values where a window does not see them, by dense inverses."""

    def __init__(self, rng, model, price, watcher, fixed):
        n = model.n
        self.places = rng.permutation(n)[: rng.integers(1, n + 1)].tolist()
        self.within = rng.uniform(0.05, 1.0, len(self.places))
        self.model, self.price, self.target = model, price, watcher.start[self.places]
        self.prior = np.linalg.inv(price.prior_weight(watcher.P0))
        free = [j for j in range(n) if j not in fixed]
        self.spread = np.zeros((n, n))
        self.spread[np.ix_(free, free)] = np.linalg.inv(price.weights[1][np.ix_(free, free)])

    def see(self, candidate, samples):
        """Find H, and the matrix by which the trusted values follow, of a window."""
        n, K = self.model.n, len(samples)
        covariance = np.kron(np.eye(K + 1), self.spread)  # of the first state and each w
        covariance[:n, :n] = self.prior
        slopes, information = np.eye(n, n * (K + 1)), np.zeros_like(covariance)
        for i, (y, u, dt, own) in enumerate(samples):
            A, C = self.model.slopes(candidate[i], u, dt)
            weight, there = self.price.noise_weight(y, own)
            if there.any():
                information += (C[there] @ slopes).T @ weight @ (C[there] @ slopes)
            slopes = A @ slopes
            slopes[:, n * (i + 1) : n * (i + 2)] += np.eye(n)
        left = covariance @ np.linalg.inv(np.eye(len(covariance)) + information @ covariance)
        part, left = (one[np.ix_(self.places, self.places)] for one in (self.prior, left))
        units = np.sqrt(part.diagonal())
        values, vectors = np.linalg.eigh(part / np.outer(units, units))
        root = units[:, None] * ((vectors * np.sqrt(values)) @ vectors.T)
        inverse, stiff, eye = np.linalg.inv(root), np.diag(1.0 / self.within), np.eye(len(root))
        values, vectors = np.linalg.eigh(inverse @ left @ inverse.T)
        low = np.minimum(values, 0.5)
        shares = (vectors * (low / (1.0 - low))) @ vectors.T
        self.weight = inverse.T @ stiff @ shares @ shares @ stiff @ inverse
        self.follow = root @ np.linalg.inv(eye + stiff @ shares @ stiff) @ (eye - shares) @ inverse

    def term(self, first):
        offset = np.asarray(first)[self.places] - self.target
        return float(offset @ self.weight @ offset)

    def learn(self, estimate):
        """Follow an estimate of the next window's first state."""
        self.target = self.target + self.follow @ (estimate[self.places] - self.target)


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

    def leave_out_zero(self, rng, width):
        """Move the bounds of one component beyond zero."""
        j = int(rng.integers(len(self.low)))
        if self.rows is None and self.low[j] < self.high[j]:
            move = 1.5 * width if math.isfinite(self.low[j]) else -1.5 * width
            self.low[j] += move
            self.high[j] += move

    def rows_of(self, d):
        """Index, coefficients and sides of each inequality."""
        for j in range(d):
            if math.isfinite(self.low[j]) or math.isfinite(self.high[j]):
                yield j, np.eye(d)[j], float(self.low[j]), float(self.high[j])
        for k in range(0 if self.rows is None else len(self.rows)):
            yield d + k, self.rows[k], -math.inf, float(self.side[k])

    def missed_rows(self, point, weight=None):
        """(index, side) of each inequality that a point misses, and by how much.

        With a weight in standard deviations, or widths if less. Inequalities on components that
        are NaN do not count.
        """
        found, covariance = {}, None if weight is None else np.linalg.inv(weight)
        for j, row, low, high in self.rows_of(len(point)):
            used = row != 0.0
            value = float(row[used] @ point[used])
            scale = 1.0
            if weight is not None:
                scale = math.sqrt(row @ covariance @ row)
                scale = min(scale, high - low) if high > low else scale
            for side, miss in (("lower", low - value), ("upper", value - high)):
                if miss > 0.0:
                    found[j, side] = miss / scale
        return found

    def missed(self, point):
        """By how much the worst inequality is missed."""
        return max(self.missed_rows(np.asarray(point)).values(), default=0.0)

    def nearest(self, point, covariance):
        """The nearest point in the metric of a covariance: least distance programming.

        Lawson and Hanson, Solving Least Squares Problems, chapter 23.
        """
        if not self.missed_rows(point):
            return point
        sides = []
        for _, row, low, high in self.rows_of(len(point)):
            sides += [(row, low)] * math.isfinite(low) + [(-row, -high)] * math.isfinite(high)
        root = np.linalg.cholesky(covariance)
        G = np.array([row @ root for row, _ in sides])
        gaps = np.array([side - row @ point for row, side in sides])
        E = np.vstack((G.T, gaps / np.abs(gaps).max()))
        u, _ = nnls(E, np.append(np.zeros(len(point)), 1.0), maxiter=1000)
        r = E @ u - np.append(np.zeros(len(point)), 1.0)
        return point - root @ (r[:-1] / r[-1]) * np.abs(gaps).max()
