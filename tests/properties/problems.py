"""Random problems with everything mixed, posed in any units, and the program of each window."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

import qpmhe
from tests.estimation.untraced import untraced
from tests.oracles.nlp import Row, Window, ca, module_of, quadratic, spd, times

SETS = {"states": "x", "disturbances": "w", "noises": "v"}
NONE = np.zeros(0)
# How users write a model; some can take one state at a time only.
BRANCHING = ("branching", "item", "flat", "loop", "buffer in a branch")
WRITINGS = {
    "numpy": ("batched", "columns", "looped", "buffer", "clipping in place", *BRANCHING),
    "casadi": ("compiled", "interpreted"), "jax": ("jax",),
}


class Units(NamedTuple):
    """Factors by which numbers grow in other units."""

    states: np.ndarray
    outputs: np.ndarray
    inputs: np.ndarray  # and the parameters
    disturbances: np.ndarray
    rows: np.ndarray  # of each set's and of the constraint
    time: float = 1.0
    cost: float = 1.0

    def of(self, name):
        return {"states": self.states, "noises": self.outputs}.get(name, self.disturbances)


@dataclass
class Sample:
    """A sample in the units in which it was drawn, and what it is taken with."""

    y: np.ndarray
    known: np.ndarray  # inputs and parameters
    disturbance: np.ndarray
    noise: np.ndarray
    bounds: dict
    dt: float
    own: dict = field(default_factory=dict)  # arguments of its update


def some_rule(rng, size):
    """What a Kalman-type observer makes of innovations: a gate, Huber's weights, or None."""
    which = rng.random()
    if which < 0.4:
        return None
    if which < 0.6:
        return qpmhe.HuberInnovation(rng.uniform(0.5, 3.0), reopen=int(rng.integers(1, 6)))
    groups = [list(range(size))] if rng.random() < 0.3 else None
    return qpmhe.Gate(rng.choice([0.5, 0.95, 0.997]), int(rng.integers(1, 6)), groups)


class Problem:
    """x+ = f(x, u) + G w and y = h(x, u) + v with a record, sets, a cost and an observer.

    Parameters
    ----------
    seed : int or sequence
        What is drawn.
    shares : dict
        The probability of each feature; 0 of the others: "ode", "irregular", "inputs",
        "parameters", "matrix", "covariance", "angles", "states", "disturbances", "noises",
        "rows", "soft", "constraint", "discount", "loss", "kalman", "observer prior", "rules",
        "held", "weights", "bounds", "sensors", "missing", "outliers", "untraced", "domain".
    steps : int
        Length of the record.
    writing : str
        One of `WRITINGS`: how the user writes the model.
    """

    def __init__(self, seed, shares, steps=14, writing="batched"):
        rng = self.rng = np.random.default_rng(seed)
        self.has = has = {name for name, share in shares.items() if rng.random() < share}
        n, p = self.n, self.p = int(rng.integers(1, 4)), int(rng.integers(1, 3))
        self.m, self.k = (
            int(rng.integers(1, 3)) if one in has else 0 for one in ("inputs", "parameters")
        )
        m = self.m + self.k
        self.a = rng.standard_normal((n, n))
        self.a *= rng.uniform(0.4, 1.0) / max(np.abs(np.linalg.eigvals(self.a)).max(), 1e-3)
        self.b, self.c = 0.4 * rng.standard_normal((n, n)), rng.standard_normal((p, n))
        self.d, self.e = 0.1 * rng.standard_normal((p, m)), 0.3 * rng.standard_normal((n, m))
        self.method = str(rng.choice(["euler", "rk4"])) if "ode" in has else None
        self.derivative = "traced"
        if "untraced" in has:
            self.derivative = str(rng.choice(["as written", "differences", "given"]))
        self.dt = 0.5
        self.edge = float(rng.choice([3.0, 1e3])) if "domain" in has else np.inf
        self.writing, self.limit = writing, -0.2 if "clip" in writing else rng.uniform(-0.3, 0.3)
        self.kink = 0.1 * rng.standard_normal(n) if writing in BRANCHING else None
        self.draw_directions()
        self.P, self.Q, self.R = (
            level * spd(rng, size) for level, size in
            ((0.1, n), (0.01, self.G.shape[1]), (0.02, p))
        )
        self.draw_cost()
        self.start, self.nominal = rng.uniform(-1.5, 1.5, n), rng.standard_normal(self.k)
        xs, ws, vs, us = self.simulate(steps)
        self.draw_sets(xs, ws, vs)
        self.draw_constraint({"x": xs[:-1], "u": us, "w": ws, "v": vs})
        self.draw_angles()
        self.draw_samples(xs, vs, us)
        # Models with branches or limits have no derivative everywhere.
        kalman = "kalman" in has and self.kink is None and "clip" not in writing
        self.kind = str(rng.choice(
            ["ekf", "ukf", "steady"] if kalman else ["luenberger", "injection"]
        ))
        self.from_observer = "observer prior" in has and kalman
        self.gain = 0.5 * rng.uniform(0.1, 1.5) * self.a @ np.linalg.pinv(self.c)
        self.rule = some_rule(rng, p) if "rules" in has and self.kind != "steady" else None
        self.held = {}
        if "held" in has and not np.isfinite(self.periods[0]).any():
            which = rng.permutation(n)[: rng.integers(1, n + 1)]  # as `augment_parameters` does
            self.held = {int(j): float(rng.uniform(0.05, 1.0)) for j in which}
        self.options = {
            "horizon": int(rng.integers(1, 7)), "max_qps": [0, 1, 1, 2, 3, None][rng.integers(6)],
            "warm_start": bool(rng.random() < 0.3),
            "candidate": "reinitialized" if rng.random() < 0.2 else "observer",
            "project_observer": bool(rng.random() < 0.8),
            "infeasible": ("drop_rows", "restore")[rng.integers(2)],
        }
        if self.options["candidate"] == "observer":
            self.options["restart"] = bool(np.random.default_rng([seed, 2]).random() < 0.3)
        # Of a generator of its own: what is drawn behind stays as it was.
        own = np.random.default_rng(rng.bit_generator.seed_seq.spawn(1)[0])
        if own.random() < 0.3:
            self.options["projection_metric"] = "diagonal"

    def draw_directions(self):
        """G: of the system, of a singular covariance of the disturbances, or none."""
        rng, n = self.rng, self.n
        self.G, self.how = np.eye(n), None
        if "matrix" in self.has:
            r, self.how = int(rng.integers(1, n + 1)), "matrix"
            self.G = rng.standard_normal((n, r))
            if r < n and rng.random() < 0.4:
                self.G[rng.integers(n)] = 0.0
        elif "covariance" in self.has and n > 1:
            # Of rank r to the last bit: rounding of a product would have its own units.
            self.how = "covariance"
            self.G = np.eye(n)[:, np.sort(rng.choice(n, int(rng.integers(1, n)), replace=False))]

    def draw_cost(self):
        rng, self.loss = self.rng, None
        self.discount = 0.9 if "discount" in self.has else 1.0
        if "loss" in self.has and self.how != "covariance":
            self.loss = str(rng.choice(["huber", "power", "barron"]))
        self.threshold, self.shape = rng.uniform(1.0, 2.5), float(rng.choice([0.5, 0.0, -2.0]))
        self.each, self.graduation = bool(rng.random() < 0.5), float(rng.choice([1.0, 10.0]))
        self.exponent, self.robust = float(rng.choice([1.0, 1.2, 1.5, 2.0])), ["noise"]
        if self.loss in ("huber", "power") and self.how is None:
            self.robust += [one for one in ("prior", "disturbance") if rng.random() < 0.3]
        if self.loss and self.each:
            self.P, self.Q, self.R = (
                np.diag(np.diag(one)) if name in self.robust else one for name, one in
                (("prior", self.P), ("disturbance", self.Q), ("noise", self.R))
            )

    def simulate(self, steps):
        rng, x = self.rng, self.start + np.linalg.cholesky(self.P) @ self.rng.normal(size=self.n)
        us = 0.5 * rng.standard_normal((steps, self.m))
        us = np.hstack((us, np.tile(self.nominal, (steps, 1))))
        ws, vs = (rng.standard_normal((steps, len(one))) @ np.linalg.cholesky(one).T
                  for one in (self.Q, self.R))
        xs = [x]
        for u, w in zip(us, ws, strict=True):
            xs.append(np.clip(self.f(xs[-1], u), -1e3, 1e3) + self.G @ w)
        return np.nan_to_num(xs), ws, vs, us

    def draw_sets(self, *reached):
        """Lower and upper limits, rows and their sides of X, W and V, which cut off some points."""
        rng, self.sets, self.prices = self.rng, {}, {}
        for name, points in zip(SETS, reached, strict=True):
            if name not in self.has or (name == "disturbances" and self.how == "covariance"):
                continue
            d, sizes, middle = points.shape[1], points.std(axis=0) + 1e-3, points.mean(axis=0)
            low, high = (middle + side * sizes * rng.uniform(0.8, 2.5, d) for side in (-1.0, 1.0))
            low[rng.random(d) < 0.15], high[rng.random(d) < 0.15] = -np.inf, np.inf
            j = rng.integers(d)
            if rng.random() < 0.1:
                low[j], high[j] = low[j] + 2.0 * sizes[j], high[j] + 2.0 * sizes[j]
            elif name == "disturbances" and rng.random() < 0.15:
                low[j] = high[j] = 0.0
            rows, side = np.zeros((0, d)), NONE
            if "rows" in self.has and rng.random() < 0.5 and d > 1:  # else they are bounds
                rows = rng.standard_normal((2, d))
                inside = np.clip(middle, low, high) @ rows.T  # so that the set is not empty
                room = 0.3 * np.abs(rows) @ sizes
                side = np.maximum(np.quantile(points @ rows.T, 0.9, axis=0), inside + room)
            self.sets[name] = low, high, rows, side
            if "soft" in self.has and rng.random() < 0.6 and (low < high).all():
                self.prices[name] = self.draw_prices(d + len(side))

    def draw_prices(self, size):
        """Linear and quadratic penalties; one of them may be None."""
        linear, quadratic = self.rng.uniform(0.3, 20.0, (2, size))
        return [(linear, None), (None, quadratic), (linear, quadratic)][self.rng.integers(3)]

    def draw_constraint(self, reached):
        self.names, self.g_prices = "", (None, None)
        if "constraint" not in self.has:
            return
        rng = self.rng
        # The w of a singular covariance has as many components as x.
        of_w = [] if self.how == "covariance" else ["w", "xwv"]
        self.names = str(rng.choice(["x", "v", *of_w, *(["xu"] if self.m else [])]))
        self.slopes = {
            name: rng.standard_normal((2, reached[name].shape[1])) / (reached[name].std() + 1e-3)
            for name in self.names
        }
        self.level = np.zeros(2)
        self.level = np.quantile(self.g({one: reached[one] for one in self.names}), 0.85, axis=0)
        if rng.random() < 0.6:
            self.g_prices = self.draw_prices(2)

    def g(self, values):
        flat = sum(times(self.slopes[name], one) for name, one in values.items())
        return flat + 0.1 * flat**2 - self.level

    def draw_angles(self):
        """Periods of the states and outputs that are angles, NaN of the others."""
        rng, share = self.rng, 0.3 if "angles" in self.has else 0.0
        states, outputs = (
            np.where(rng.random(size) < share, rng.uniform(1.0, 6.0, size), np.nan)
            for size in (self.n, self.p)
        )
        if "states" in self.sets:
            low, high, rows, _ = self.sets["states"]
            fixed = not np.isfinite(low - high).all() or len(rows) or "states" in self.prices
            states = np.full(self.n, np.nan) if fixed or "bounds" in self.has else states
        self.periods = states, outputs

    def draw_samples(self, xs, vs, us):
        rng, has, p, r = self.rng, self.has, self.p, self.G.shape[1]
        usual = {name: (low, high) for name, (low, high, *_) in self.sets.items()}
        weights = np.linalg.inv(self.Q), np.linalg.inv(self.R)
        self.usual = Sample(NONE, np.append(np.zeros(self.m), self.nominal), *weights, usual, 0.5)
        self.samples = []
        for x, v, u in zip(xs, vs, us, strict=False):
            y = self.h(x, u) + v
            if "outliers" in has and rng.random() < 0.1:
                y[rng.integers(p)] += 5.0 * rng.standard_normal()
            if "missing" in has:
                y[rng.random(p) < 0.15] = np.nan
            one = Sample(y, u.copy(), *weights, dict(usual), self.dt)
            if "irregular" in has and self.method and rng.random() < 0.2:
                one.dt = one.own["dt"] = float(rng.uniform(0.3, 0.7))
            if "weights" in has and rng.random() < 0.2:
                # With losses by component weights stay diagonal.
                one.noise = one.own["noise_weight"] = weights[1] * rng.uniform(0.3, 3.0)
            if "weights" in has and self.how != "covariance" and rng.random() < 0.2:
                one.disturbance = 30.0 * spd(rng, r)
                if self.each and "disturbance" in self.robust:
                    one.disturbance = np.diag(np.diag(one.disturbance))
                one.own["disturbance_weight"] = one.disturbance
            if self.k and rng.random() < 0.2:
                one.known[self.m :] = one.own["parameters"] = rng.standard_normal(self.k)
            if "bounds" in has and rng.random() < 0.3:
                one.own["bounds"] = self.moved()
                one.bounds |= one.own["bounds"]
            if "sensors" in has and rng.random() < 0.3:
                seen = sorted(rng.choice(p, rng.integers(1, p + 1), replace=False).tolist())
                one.y[[j for j in range(p) if j not in seen]] = np.nan
                one.own["sensors"] = seen
            self.samples.append(one)

    def moved(self):
        """Other limits for some of the sets that are boxes."""
        other = {}
        for name, (low, high, rows, _) in self.sets.items():
            if self.rng.random() < 0.5 and not len(rows):
                width = np.where(np.isfinite(high - low), high - low, 1.0)
                shift = 0.1 * width * self.rng.standard_normal(low.size)
                other[name] = low + shift, high + shift + 0.1 * width * self.rng.random()
        return other

    # The model, for arrays and for CasADi

    def clipped(self, x):
        if "clip" not in self.writing:
            return x
        return ca.fmax(x, self.limit) if module_of(x) is ca else np.maximum(x, self.limit)

    def map(self, x, u, side=None):
        x = self.clipped(x)
        value = times(self.a, x) + 0.4 * module_of(x).sin(times(self.b, x)) + times(self.e, u)
        if self.kink is not None:
            if module_of(x) is ca:
                side = ca.if_else(x[0] > self.limit, 1.0, -1.0)
            elif side is None:
                side = np.where(x[..., :1] > self.limit, 1.0, -1.0)
            value = value + side * self.kink * x
        return value if self.edge == np.inf else np.where(np.abs(x) < self.edge, value, np.nan)

    def rate(self, x, u, side=None):
        return (self.map(x, u, side) - x) / self.dt

    def f(self, x, u, dt=0.5):
        if not self.method:
            return self.map(x, u)
        one = self.rate(x, u)
        if self.method == "euler":
            return x + dt * one
        two = self.rate(x + 0.5 * dt * one, u)
        three = self.rate(x + 0.5 * dt * two, u)
        return x + dt / 6.0 * (one + 2.0 * two + 2.0 * three + self.rate(x + dt * three, u))

    def h(self, x, u, side=None):
        x = self.clipped(x)
        value = times(self.c, x) + times(self.d, u)
        return value + 0.03 * value**2

    # What the user writes, in other units

    @property
    def own_units(self):
        ones = (np.ones(size) for size in (self.n, self.p, self.m + self.k, self.G.shape[1]))
        return Units(*ones, np.ones(2))

    def written(self, function, factor, units, more=1.0):
        def call(x, u=NONE, **side):
            x = x / units.states
            if self.derivative == "differences":
                x, u = np.real(x), np.real(u)
            return function(x, u / units.inputs, **side) * factor / more

        if self.writing in ("compiled", "interpreted", "jax"):
            call = function
        styled = self.styled(call, np.size(factor))
        styled = untraced(styled) if "untraced" in self.has else styled
        if not self.m + self.k:
            return lambda x: styled(x, NONE)
        return lambda x, u: styled(x, u)

    def styled(self, call, size):
        """A function as this problem's user writes it."""
        buffer = np.empty(size)

        def looking(first):
            return lambda x, u: call(x, u, side=1.0 if first(x) > self.limit else -1.0)

        def buffered(x, u):
            buffer[:] = call(x, u)
            return buffer

        def buffered_in_a_branch(x, u):
            if x.item(0) <= self.limit:
                return call(x, u, side=-1.0)
            buffer[:] = call(x, u, side=1.0)
            return buffer

        def clipping(x, u):
            x[x < self.limit] = self.limit
            return call(x, u)

        return {
            "columns": lambda x, u: np.array([*call(x, u)]),
            "looped": lambda x, u: [float(one) for one in call(np.array([*map(float, x)]), u)],
            "branching": looking(lambda x: x[0]), "item": looking(lambda x: x.item(0)),
            "flat": looking(lambda x: x.flat[0]),
            "loop": looking(lambda x: np.asarray(x).ravel().tolist()[0]),
            "buffer": buffered, "buffer in a branch": buffered_in_a_branch,
            "clipping in place": clipping,
        }.get(self.writing, call)

    def map_jacobian(self, x, u):
        return self.a + 0.4 * np.cos(x @ self.b.T)[..., None] * self.b

    def rate_jacobian(self, x, u):
        return (self.map_jacobian(x, u) - np.eye(self.n)) / self.dt

    def h_jacobian(self, x, u):
        return (1.0 + 0.06 * (x @ self.c.T + u @ self.d.T))[..., None] * self.c

    def system(self, units):
        states, time, options = units.states, units.time, self.convex_sets(units)
        sizes = {"n": self.n, "p": self.p, "m": self.m + self.k}
        for name, periods, scale in zip(
            ("state_residual", "output_residual"), self.periods, (states, units.outputs),
            strict=True,
        ):
            which = np.flatnonzero(np.isfinite(periods))
            if which.size:
                options[name] = qpmhe.angles(which, (periods * scale)[which])
        if self.how == "matrix":
            options["disturbance_matrix"] = self.G * states[:, None] / units.disturbances
        name, parts = ("rate", (self.rate, self.rate_jacobian, time)) if self.method else (
            "f", (self.map, self.map_jacobian, 1.0)
        )
        if self.derivative == "given":
            slopes = states[:, None] / states, units.outputs[:, None] / states
            options[f"{name}_jacobian"] = self.written(parts[1], slopes[0], units, parts[2])
            options["h_jacobian"] = self.written(self.h_jacobian, slopes[1], units)
        f, h = self.written(parts[0], states, units, parts[2]), self.written(
            self.h, units.outputs, units
        )
        if self.method:
            options |= {"dt": self.dt * time, "method": self.method}
        make = qpmhe.System.from_ode if self.method else qpmhe.System
        if self.writing in ("compiled", "interpreted"):
            make, options["compiled"] = qpmhe.from_casadi, {"compiled": None}.get(
                self.writing, False
            )
        elif self.writing == "jax":
            make = qpmhe.from_jax
        made = make(f, h, **sizes, **options)
        return made.with_origin(held=dict(self.held))

    def convex_sets(self, units):
        made = {}
        for name, (low, high, rows, side) in self.sets.items():
            scale = units.of(name)
            made[name] = qpmhe.Box(low * scale, high * scale)
            if len(rows):
                matrix = rows * units.rows[:, None] / scale
                made[name] &= qpmhe.Polytope(matrix, side * units.rows)
            if name in self.prices:
                scale = np.append(scale, units.rows[: len(rows)])
                made[name] = made[name].soften(**penalties(self.prices[name], scale, units.cost))
        if self.names:
            scales = {"x": units.states, "u": units.inputs, "w": units.disturbances,
                      "v": units.outputs}

            def g(**values):
                if "untraced" in self.has:
                    np.isnan(values[self.names[0]])  # has no form in CasADi
                values = {name: value / scales[name] for name, value in values.items()}
                return self.g(values) * units.rows

            by_names = {
                "x": lambda x: g(x=x), "w": lambda w: g(w=w), "v": lambda v: g(v=v),
                "xu": lambda x, u: g(x=x, u=u), "xwv": lambda x, w, v: g(x=x, w=w, v=v),
            }
            made["constraints"] = [qpmhe.Constraint(
                by_names[self.names], 2, **penalties(self.g_prices, units.rows, units.cost)
            )]
        return made

    def parts(self, units):
        """System, observer and cost."""
        system, states = self.system(units), units.states
        full, by_w = self.Q, units.disturbances
        if self.how == "covariance":
            full, by_w = self.G @ self.Q @ self.G.T, states
        covariances = {
            "prior": self.P * np.outer(states, states), "disturbance": full * np.outer(by_w, by_w),
            "noise": self.R * np.outer(units.outputs, units.outputs),
        }
        gain = self.gain * states[:, None] / units.outputs
        if self.kind == "luenberger":
            observer = qpmhe.Luenberger(gain)
        elif self.kind == "injection":
            observer = qpmhe.OutputInjection(
                lambda z, v: gain @ (v / (1.0 + 0.1 * np.abs(v / units.outputs)))
            )
        elif self.kind == "steady":
            observer = qpmhe.SteadyStateKalman(
                system, self.start * states, np.zeros(self.m + self.k) if system.m else None,
                **covariances,
            )
        else:
            make = qpmhe.ExtendedKalman if self.kind == "ekf" else qpmhe.UnscentedKalman
            observer = make(**covariances, innovation=self.rule)
        covariances = {name: one / units.cost for name, one in covariances.items()}
        if self.from_observer:
            covariances["prior"] = qpmhe.ObserverPrior()
        cost = qpmhe.QuadraticCost.from_covariances(**covariances, discount=self.discount)
        if self.loss is None:
            return system, observer, cost
        root, each = np.sqrt(units.cost), {"per_component": self.each}
        loss = {
            "huber": lambda W: qpmhe.Huber(W, self.threshold * root, **each),
            "power": lambda W: qpmhe.Power(W, self.exponent, **each),
            "barron": lambda W: qpmhe.Barron(
                W, self.shape, self.threshold * root, **each, graduation=self.graduation
            ),
        }[self.loss]
        terms = {"disturbance": cost.disturbance}
        terms["prior"] = cost.observer_prior if self.from_observer else cost.prior
        for name in self.robust:
            if (name, self.from_observer) != ("prior", True):
                terms[name] = loss(getattr(cost, name))
        return system, observer, qpmhe.RobustCost(**terms, discount=self.discount)

    def estimator(self, units=None, **options):
        units = units or self.own_units
        if self.k:
            options["parameters"] = self.nominal * units.inputs[self.m :]
        return qpmhe.MovingHorizonEstimator(
            *self.parts(units), initial_state=self.start * units.states, **self.options | options,
        )

    def in_units(self, given, units):
        """Arguments of `update` or `set` in other units."""
        scale = {
            "parameters": units.inputs[self.m :], "dt": units.time, "sensors": None,
            "noise_weight": units.cost / np.outer(units.outputs, units.outputs),
            "disturbance_weight": units.cost / np.outer(units.disturbances, units.disturbances),
        }
        made = {
            name: one if scale[name] is None else one * scale[name]
            for name, one in given.items() if name != "bounds"
        }
        if "bounds" in given:
            made["bounds"] = {
                name: qpmhe.Box(*(one * units.of(name) for one in sides))
                for name, sides in given["bounds"].items()
            }
        return made

    def update(self, mhe, sample, units=None):
        """The estimate with a sample."""
        units = units or self.own_units
        y = sample.y * units.outputs
        u = (sample.known * units.inputs)[: self.m] if self.m else None
        return mhe.update(y[sample.own.get("sensors", slice(None))], u,
                          **self.in_units(sample.own, units))

    # A window as a program, in the units in which it was drawn

    def rho(self, q):
        square, width, half = self.threshold**2, 2.0 - self.shape, self.shape / 2.0
        if self.loss == "huber":
            r = ca.sqrt(ca.fmax(q, 1e-300))
            return ca.if_else(q <= square, q, 2.0 * self.threshold * r - square)
        if self.loss == "power":
            return ca.sqrt(ca.fmax(q, 1e-300)) ** self.exponent
        if self.shape == 0.0:
            return 2.0 * square * ca.log(1.0 + q / (2.0 * square))
        return square * width / half * ((1.0 + q / (square * width)) ** half - 1.0)

    def term(self, name):
        """A term of J, of a residual and its weight."""
        if self.loss is None or name not in self.robust or (name, self.from_observer) == (
            "prior", True
        ):
            return quadratic

        def cost(s, weight):
            forms = ca.vertsplit(s**2 * np.diag(weight)) if self.each else [quadratic(s, weight)]
            return sum(self.rho(q) for q in forms)

        return cost

    def rows(self, sample):
        """All inequalities at a sample: misses count in deviations, or widths if less."""
        spread = self.G @ self.Q @ self.G.T
        metric = np.diag(np.maximum(self.P.diagonal(), spread.diagonal()))
        covariances = dict(zip(SETS, (metric, self.Q, self.R), strict=True))
        for name, (_, _, rows, side) in self.sets.items():
            letter, (low, high), d = SETS[name], sample.bounds[name], rows.shape[1]
            linear, quadratic = self.prices.get(name, (None, None))
            matrix = np.vstack((np.eye(d), rows))
            deviations = np.sqrt(np.diag(matrix @ covariances[name] @ matrix.T))
            for j, row in enumerate(matrix):
                sides = (-np.inf, side[j - d]) if j >= d else (low[j], high[j])
                width = sides[1] - sides[0]
                scale = min(width, deviations[j]) if width > 0.0 else deviations[j]
                prices = tuple(one if one is None else float(one[j]) for one in (linear, quadratic))
                for sign, bound in zip((-1.0, 1.0), sides, strict=True):
                    if np.isfinite(bound):
                        yield Row(
                            lambda values, letter=letter, row=row, sign=sign, bound=bound:
                            sign * (ca.DM(row).T @ values[letter] - bound),
                            letter, *prices, row != 0.0, scale,
                        )
        if self.names:
            linear, quadratic = (one if one is None else ca.DM(one) for one in self.g_prices)
            # About the largest change within deviations of x, w and v.
            deviations = {SETS[name]: np.sqrt(np.diag(one)) for name, one in covariances.items()}
            scale = 1.0 + 10.0 * sum(
                np.abs(self.slopes[name]) @ deviations[name] for name in self.names if name != "u"
            )
            # The step's length comes with the inputs.
            yield Row(
                lambda values: self.g({
                    name: one[:-1, 0] if name == "u" else one for name, one in values.items()
                }), self.names, linear, quadratic, True, ca.DM(scale),
            )

    def window(self, estimate, hold=None, prior_weight=None):
        count = len(estimate.disturbances)
        samples = self.samples[estimate.time + 1 - count : estimate.time + 1]
        return Window(
            lambda x, u: self.f(x, u[:-1, 0], u[-1]), lambda x, u: self.h(x, u[:-1, 0]),
            np.array([one.y for one in samples]), estimate.candidate[0],
            (np.linalg.inv(self.P) if prior_weight is None else prior_weight,
             [one.disturbance for one in samples], [one.noise for one in samples]),
            us=[np.append(one.known, one.dt) for one in samples],
            rows=lambda i: self.rows(samples[i]), discount=self.discount,
            losses=[self.term(name) for name in ("prior", "disturbance", "noise")],
            matrix=self.G if self.how else None, periods=self.periods, hold=hold,
        )


def penalties(prices, rows, cost):
    linear, quadratic = prices
    made = {} if linear is None else {"linear": cost * linear / rows}
    return made if quadratic is None else made | {"quadratic": cost * quadratic / rows**2}
