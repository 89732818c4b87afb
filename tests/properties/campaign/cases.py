"""Random estimators of the campaign, with all that a user can choose."""

from __future__ import annotations

import numpy as np

import qpmhe

from . import models

SETS = {"x": "states", "w": "disturbances", "v": "noises"}
BACKENDS = (
    "osqp", "daqp", "piqp", "clarabel", "quadprog", "banded", "proxqp", "highs", "scs", "ecos",
    "piqp_dense", "cvxopt",
)
OBSERVERS = {
    "luenberger": 0.25, "extended": 0.25, "unscented": 0.1, "steady": 0.08, "injection": 0.07,
    "zero": 0.05, "gate": 0.12, "huber": 0.08,
}
# Observers without a covariance.
PLAIN = ("luenberger", "injection", "zero")


class Alarm:
    """Interrupts the model at one of its next calls."""

    left = -1

    def __call__(self):
        if self.left >= 0:
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt


class Loss:
    """A loss of a residual: its name and numbers, as a user writes it and as a formula."""

    def __init__(self, r, diagonal):
        self.name = str(r.choice(["huber", "cauchy", "geman", "barron", "power"]))
        self.per_component = bool(diagonal and r.random() < 0.5)
        self.threshold = float(r.uniform(0.5, 3.0))
        self.graduation = float(r.choice([1.0, 10.0, 50.0]))
        self.shape = float(r.choice([1.5, 1.0, 0.5, -1.0, -np.inf]))
        self.exponent = float(r.choice([1.0, 1.3, 2.0, 3.0]))

    def written(self, weight):
        several = {"per_component": self.per_component}
        if self.name == "huber":
            return qpmhe.Huber(weight, threshold=self.threshold, **several)
        if self.name == "power":
            return qpmhe.Power(weight, self.exponent, **several)
        if self.name == "barron":
            graduation = 1.0 if self.shape >= 1.0 else self.graduation
            return qpmhe.Barron(
                weight, self.shape, self.threshold, graduation=graduation, **several
            )
        kind = qpmhe.Cauchy if self.name == "cauchy" else qpmhe.GemanMcClure
        return kind(weight, self.threshold, graduation=self.graduation, **several)

    def __call__(self, q):
        """Of the squared weighted size q."""
        q, c = np.asarray(q, float), self.threshold**2
        if self.name == "huber":
            return np.where(q <= c, q, 2.0 * self.threshold * np.sqrt(q) - c)
        if self.name == "power":
            return q ** (self.exponent / 2.0)
        shape = {"cauchy": 0.0, "geman": -2.0}.get(self.name, self.shape)
        if shape == 0.0:
            return 2.0 * c * np.log1p(q / (2.0 * c))
        if shape == -np.inf:
            return -2.0 * c * np.expm1(-q / (2.0 * c))
        inner = shape / 2.0 * np.log1p(q / (c * (2.0 - shape)))
        return 2.0 * c * (2.0 - shape) / shape * np.expm1(inner)


class Case:
    """One estimator, and everything that the judge has to know of it."""

    def __init__(self, seed, engine="python"):
        r = np.random.default_rng(seed)
        self.seed, self.engine, self.tags, self.alarm = seed, engine, [], Alarm()
        family = models.FAMILIES[int(r.integers(len(models.FAMILIES)))]
        self.model = model = family(r)
        self.n, self.p, self.m, self.k = model.n, model.p, model.m, len(model.parameters)
        self.x_units = self.y_units = 1.0
        if model.has_units and r.random() < 0.3:
            self.x_units, self.y_units = (10.0 ** r.uniform(-9.0, 9.0, c) for c in (self.n, self.p))
            self.tags.append("units")
        self.x_units, self.y_units = self.x_units * np.ones(self.n), self.y_units * np.ones(self.p)
        self.f, self.h = models.with_units(model, self.x_units, self.y_units)
        turns = r.random() < 0.8
        self.x_angles = model.state_angles if turns else None
        self.y_angles = model.output_angles if turns else None
        self.origin = model.start * self.x_units
        self._draw_weights(r)
        self._draw_sets(r)
        self._draw_constraint(r)
        self._draw_observer_and_cost(r)
        self._draw_options(r)
        writings = models.WRITINGS[engine]
        self.writing = models.installed(str(r.choice(list(writings), p=list(writings.values()))))
        self.tags += [family.__name__, self.writing]
        self._construct(r)

    def _draw_weights(self, r):
        n, G = self.n, None
        if r.random() < 0.15 and n > 1 and not self.x_angles:
            G = r.normal(size=(n, int(r.integers(1, n)))) * self.x_units[:, None]
            self.tags.append("matrix")
        self.G, self.d = G, n if G is None else G.shape[1]
        of_w = self.x_units if G is None else np.ones(self.d)
        Q, R = 10.0 ** r.uniform(-2.5, -0.5, self.d) * of_w, 10.0 ** r.uniform(-2.5, 0.0, self.p)
        P = 10.0 ** r.uniform(-2.0, 1.0, n) * self.x_units
        if r.random() < 0.2:
            P *= 10.0 ** r.uniform(2.0, 10.0)
            self.tags.append("vague")
        poor = r.random() < 0.1
        self.tags += ["ill-conditioned"] * poor
        self.diagonal = r.random() < 0.5

        def covariance(deviations):
            count = len(deviations)
            if self.diagonal or count < 2:
                return np.diag(deviations**2)
            axes, _ = np.linalg.qr(r.normal(size=(count, count)))
            span = 6.0 if poor else 0.5
            mixed = (axes * 10.0 ** r.uniform(-span, span, count)) @ axes.T
            factor = deviations / np.sqrt(np.diag(mixed))
            mixed = mixed * np.outer(factor, factor)
            return 0.5 * (mixed + mixed.T)

        self.P, self.Q, self.R = covariance(P), covariance(Q), covariance(R * self.y_units)
        inverses = [np.linalg.inv(one) for one in (self.P, self.Q, self.R)]
        self.prior_weight, self.iQ, self.iR = (0.5 * (one + one.T) for one in inverses)
        self.discount = float(r.choice([1.0, 1.0, 1.0, 0.95, 0.5, 0.02]))

    def _draw_sets(self, r):
        n, units, start = self.n, self.x_units, self.model.start
        self.sets, x = dict.fromkeys("xwv"), None
        if self.model.defined_within or r.random() < 0.35:
            width = r.uniform(0.2, 3.0, n)
            low, high = start - width, start + width
            kind = str(r.choice(["box", "below", "polytope", "far", "fixed"]))
            if self.model.positive:
                kind, high = "positive", np.abs(start) * r.uniform(1.0, 4.0) + 1.0
                x = qpmhe.Box(np.zeros(n), units * (high if r.random() < 0.4 else np.inf))
            elif self.x_angles:
                kind, turn = "rate", 0.3 * self.x_angles[1] if r.random() < 0.5 else np.inf
                x = qpmhe.Box([-turn, -r.uniform(0.3, 3.0)], [turn, r.uniform(0.3, 3.0)])
            elif kind == "polytope":
                M = r.normal(size=(2, n))
                x = qpmhe.Polytope(M / units, M @ start + r.uniform(0.1, 2.0, 2))
            elif kind == "far":
                x = qpmhe.Box((start + 5.0) * units, (start + 9.0) * units)
            elif kind == "fixed" and n > 1:
                low[0] = high[0] = start[0]
                x = qpmhe.Box(low * units, high * units)
            else:
                x = qpmhe.Box(low * units, high * units if kind == "box" else np.full(n, np.inf))
            self.sets["x"] = x
            self.tags.append(f"x: {kind}")
        if r.random() < 0.35:
            kind, Q = str(r.choice(["box", "zero", "beside", "above"])), np.sqrt(np.diag(self.Q))
            if kind == "box":
                wide = r.uniform(0.3, 5.0, self.d) * Q
                w = qpmhe.Box(-wide, wide)
            elif kind == "zero":
                wide = np.full(self.d, np.inf)
                wide[int(r.integers(self.d))] = 0.0
                w = qpmhe.Box(-wide, wide)
            else:
                w = qpmhe.Box(0.2 * Q, 4.0 * Q) if kind == "beside" else qpmhe.Box(
                    np.full(self.d, -np.inf), 2.0 * Q
                )
            self.sets["w"] = w
            self.tags.append(f"w: {kind}")
        if r.random() < 0.35:
            kind, R = str(r.choice(["box", "polytope", "beside"])), np.sqrt(np.diag(self.R))
            if kind == "polytope":
                v = qpmhe.Polytope(np.ones((1, self.p)) / R, [r.uniform(0.5, 3.0)])
            else:
                v = qpmhe.Box(0.1 * R, 5.0 * R) if kind == "beside" else qpmhe.Box(
                    -R * r.uniform(0.5, 4.0), R * r.uniform(0.5, 4.0)
                )
            self.sets["v"] = v
            self.tags.append(f"v: {kind}")
        self.given = dict(self.sets)
        # Of each soft set: the set, its linear and its quadratic penalties.
        self.soft = {}
        w = self.sets["w"]
        # Whether all directions have disturbances.
        self.is_everywhere = self.G is None and (w is None or not len(w.fixed_components))
        if self.engine == "compiled" and not self.is_everywhere:
            r = np.random.default_rng([self.seed, 16])  # other draws are what they were before
        if r.random() < 0.25:
            self._soften(r)

    def _soften(self, r):
        deviations = {"x": self.x_units, "w": np.sqrt(np.diag(self.Q)),
                      "v": np.sqrt(np.diag(self.R))}
        for name, one in self.sets.items():
            needed = name == "x" and (self.x_angles or self.model.defined_within)
            if one is None or needed or len(one.fixed_components) or r.random() < 0.4:
                continue
            count = len(one.matrix) or one.dimension
            scale = np.ones(count) if len(one.matrix) else deviations[name]
            lines, squares = r.uniform(0.0, 20.0, count) / scale, r.uniform(0.1, 20.0, count) / (
                scale**2
            )
            self.soft[name] = one, lines, squares
            self.given[name] = one.soften(linear=lines, quadratic=squares)
            self.tags.append("soft")
        self.sets = {
            name: None if name in self.soft else one for name, one in self.sets.items()
        }

    def _draw_constraint(self, r):
        """g, whether it is of x and v, and whether it is hard; None."""
        self.constraint = None
        if self.engine == "compiled":  # other draws are what they were before C had constraints
            r = np.random.default_rng([self.seed, 15])
        if r.random() >= 0.15:
            return
        units, radius, R = 1.0 / self.x_units, 2.0 + np.sum(self.model.start**2), np.sqrt(
            np.diag(self.R)
        )
        hard = r.random() < 0.6
        of_v = bool(hard and r.random() < 0.5)

        def ball(x):
            return sum((x[i] * units[i]) ** 2 for i in range(self.n)) - radius

        def with_noise(x, v):
            return (x[0] * units[0]) ** 2 + (v[0] / R[0]) ** 2 - radius - 9.0

        self.constraint = with_noise if of_v else ball, of_v, hard
        self.tags.append("constraint: " + ("hard" if hard else "soft"))

    def _draw_observer_and_cost(self, r):
        self.kind = str(r.choice(list(OBSERVERS), p=list(OBSERVERS.values())))
        if self.kind == "steady" and self.model.defined_within:
            self.kind = "luenberger"
        self.gain = 0.1 * r.normal(size=(self.n, self.p)) * self.x_units[:, None] / self.y_units
        self.gain *= self.kind != "zero"
        self.observer_Q = self.Q * (1.0 if r.random() < 0.8 else 0.3)
        self.rule = {
            "gate": qpmhe.Gate(probability=float(r.choice([0.9, 0.997])),
                               reopen=int(r.integers(1, 12))),
            "huber": qpmhe.HuberInnovation(reopen=int(r.integers(1, 12))),
        }.get(self.kind)
        self.is_unscented = self.kind == "unscented" or (self.rule and r.random() < 0.3)
        self.from_observer = self.kind not in PLAIN and r.random() < 0.3
        self.losses = {"p": None, "w": None, "v": None}
        if r.random() < 0.45:
            for name in self.losses:
                few = name == "w" and self.G is not None and self.engine == "compiled"
                if r.random() < 0.5 and not few and not (name == "p" and self.from_observer):
                    self.losses[name] = Loss(r, self.diagonal)
        self.tags += [f"observer: {self.kind}", *(
            f"loss: {loss.name}" for loss in self.losses.values() if loss
        ), *["prior of the observer"] * self.from_observer, *["discount"] * (self.discount < 1.0)]

    def _draw_options(self, r):
        caps = [0, 1, 2, 5, None]
        options = self.options = {
            "horizon": int(r.choice([1, 2, 3, 5, 8, 15, 30])),
            "max_qps": caps[int(r.choice(5, p=[0.05, 0.4, 0.25, 0.15, 0.15]))],
        }
        python = self.engine == "python"
        options |= {name: value for share, name, value in (
            (0.25, "warm_start", True), (0.2, "candidate", "reinitialized"),
            (0.15 * python, "arrival", "smoothed"), (0.2, "project_observer", False),
            (0.1 * python, "time_budget", float(10.0 ** r.uniform(-5.0, -2.0))),
            (0.15, "max_solver_iterations", int(r.integers(1, 8))),
            (0.3 * python, "backend", str(r.choice(BACKENDS))),
        ) if r.random() < share}
        later = np.random.default_rng([self.seed, 2])  # what older seeds have drawn stays as it was
        drawn = {name: value for share, name, value in (
            (0.35, "infeasible", "restore"), (0.3, "restart", True),
        ) if later.random() < share}
        if "candidate" in options:
            drawn.pop("restart", None)
        options |= drawn
        self.tags += drawn
        if options.get("backend") in ("banded", "quadprog"):
            options.pop("max_solver_iterations", None)
        elif options.get("backend") in ("osqp", "scs"):  # else minutes a step
            options.setdefault("max_solver_iterations", 300)
        if self.k:
            options["parameters"] = self.model.parameters

    def _construct(self, r):
        given = {SETS[name]: one for name, one in self.given.items() if one is not None}
        if self.G is not None:
            given["disturbance_matrix"] = self.G
        for name, angles in (("state", self.x_angles), ("output", self.y_angles)):
            if angles:
                given[f"{name}_residual"] = qpmhe.angles(angles[0], period=angles[1])
        if self.constraint:
            g, _, hard = self.constraint
            prices = {} if hard else {"linear": 3.0, "quadratic": 2.0}
            given["constraints"] = [qpmhe.Constraint(g, **prices)]
        self.system = models.system(
            self.writing, self.f, self.h, self.n, self.p, self.m, self.alarm, **given
        )
        spread = float(r.choice([0.0, 1.0, 1.0, 5.0]))
        away = r.normal(size=self.n) * np.sqrt(np.diag(self.P)) * spread
        if "vague" in self.tags and r.random() < 0.5:
            away = 0.1 * r.normal(size=self.n) * self.x_units
        self.start = self.origin + away
        if self.model.positive:
            self.start = np.abs(self.start) + 1e-3 * self.x_units
        self.observer, self.cost = self._observer(), self._cost()
        self.row_scale = self._scale_of_constraint() if self.constraint else 0.0

    def _observer(self):
        covariances = {"prior": self.P, "disturbance": self.observer_Q, "noise": self.R}
        if self.kind in ("luenberger", "zero"):
            return qpmhe.Luenberger(self.gain)
        if self.kind == "injection":
            return qpmhe.OutputInjection(lambda z, v: self.correction(v))
        if self.kind == "steady":
            at = {"u": np.append(np.zeros(self.m - self.k), self.model.parameters)}
            return qpmhe.SteadyStateKalman(
                self.system, self.origin, **covariances | (at if self.m else {})
            )
        kind = qpmhe.UnscentedKalman if self.is_unscented else qpmhe.ExtendedKalman
        return kind(**covariances, **({"innovation": self.rule} if self.rule else {}))

    def correction(self, v):
        """L(z, v) of an observer with a gain."""
        if self.kind == "injection":
            largest = 5.0 * np.sqrt(np.diag(self.R))
            v = np.clip(v, -largest, largest)
        return self.gain @ v

    def _cost(self):
        weights = {"p": self.prior_weight, "w": self.iQ, "v": self.iR}
        prior, w, v = (
            weight if self.losses[name] is None else self.losses[name].written(weight)
            for name, weight in weights.items()
        )
        kind = qpmhe.RobustCost if any(self.losses.values()) else qpmhe.QuadraticCost
        return kind(prior=qpmhe.ObserverPrior() if self.from_observer else prior, disturbance=w,
                    noise=v, discount=self.discount)

    def _scale_of_constraint(self):
        """At least the change of g within a deviation of the initial state, as documented."""
        g, of_v, _ = self.constraint
        P, R = np.sqrt(np.diag(self.P)), np.sqrt(np.diag(self.R))
        moves = [*np.diag(P), *-np.diag(P), P, -P]
        noises = (np.zeros(self.p), R, -R) if of_v else (None,)
        values = [
            float(g(self.start + move, v) if of_v else g(self.start + move))
            for move in (0.0, *moves) for v in noises
        ]
        return float(np.nanmax(np.abs(np.subtract(values, values[0]))))

    def estimator(self, engine=None, **options):
        return qpmhe.MovingHorizonEstimator(
            self.system, self.observer, self.cost, initial_state=self.start,
            engine=engine or self.engine, **self.options | options,
        )
