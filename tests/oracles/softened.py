"""Random nonlinear problems with nonlinear constraints and soft sets."""

import numpy as np

import qpmhe

from .nlp import Model, Row, Window, ca, quadratic

#: Parameters of a nonlinear constraint, or the soft set and its shape.
HARD = ("x", "xu", "w", "v", "xwv")
SETS = tuple(f"{name} {shape}" for name in "XWV" for shape in ("box", "polytope"))
PENALTIES = ("linear", "quadratic", "both")
COSTS = ("plain", "discount", "robust")
THRESHOLD = 1.0


def huber(v, weight):
    q = quadratic(v, weight)
    far = 2.0 * THRESHOLD * ca.sqrt(ca.fmax(q, 1e-9)) - THRESHOLD**2
    return ca.if_else(q <= THRESHOLD**2, q, far)


class Case:
    """A random system with one constraint or soft set, and a record.

    Parameters
    ----------
    seed : int
        What is drawn.
    kind : str
        One of `HARD`, for a nonlinear constraint, or of `SETS`, for a soft set.
    penalty : str or None
        One of `PENALTIES`; None for a hard constraint.
    cost : str
        One of `COSTS`.
    """

    def __init__(self, seed, kind, penalty=None, cost="plain"):
        draw = self.draw = np.random.default_rng([seed, len(kind)])
        n = int(draw.integers(1, 4))
        p = min(int(draw.integers(1, 3)), n)
        self.m, self.horizon = int("u" in kind), int(draw.integers(3, 7))
        self.model = Model.drawn(draw, n, p, (0.5, 1.0))
        self.discount = 0.9 if cost == "discount" else 1.0
        self.robust = cost == "robust"
        self.weights = [
            np.diag(draw.uniform(*span, size)) for span, size in
            (((0.5, 3), n), ((4, 40), n), ((4, 40), p))
        ]
        self.inputs = draw.uniform(-0.2, 0.2, (self.horizon + 8, self.m))
        x, record = draw.uniform(-1, 1, n), []
        for u in self.inputs:
            w, v = draw.normal(size=n) * 0.1, draw.normal(size=p) * 0.3
            record.append((x, w, v, self.model.h(x) + v))
            x = self.f(x, u) + w
        states, disturbances, noises, self.measurements = (
            np.array(one) for one in zip(*record, strict=True)
        )
        self.start = draw.uniform(-1.2, 1.2, n)
        penalties = {}
        if penalty in ("linear", "both"):
            penalties["linear"] = float(10.0 ** draw.uniform(-0.3, 1.5))
        if penalty in ("quadratic", "both"):
            penalties["quadratic"] = float(10.0 ** draw.uniform(0, 1.7))
        reached = {"x": states, "u": self.inputs, "w": disturbances, "v": noises}
        make = self.constraint if kind in HARD else self.soft_set
        self.system = qpmhe.System(
            self.f if self.m else self.model.f, self.model.h, n=n, p=p, m=self.m,
            **make(kind, reached, penalties),
        )
        prior, disturbance, noise = self.weights
        self.cost = qpmhe.RobustCost(
            prior=prior, disturbance=disturbance, noise=qpmhe.Huber(noise, THRESHOLD)
        ) if self.robust else qpmhe.QuadraticCost(
            prior=prior, disturbance=disturbance, noise=noise, discount=self.discount
        )

    def f(self, x, u):
        return self.model.f(x) + (u[0] if self.m else 0.0)

    def constraint(self, kind, reached, penalties):
        """Two rows: a ball, and a bent half-space; both cut off some of the record."""
        draw = self.draw
        sizes = {name: reached[name].shape[1] for name in kind}
        slopes = {name: draw.normal(size=size) for name, size in sizes.items()}
        units = {name: max(float(np.std(reached[name])), 1e-3) for name in kind}
        bends = {name: 0.2 * draw.normal(size=size) for name, size in sizes.items()}

        def rows(values, module):
            ball, bent = 0.0, 0.0
            for name in kind:
                for j in range(sizes[name]):
                    s = values[name][j] / units[name]
                    ball = ball + s * s
                    bent = bent + slopes[name][j] * s + bends[name][j] * module.cos(s)
            return [ball, bent]

        seen = [rows({name: reached[name][t] for name in kind}, np)
                for t in range(len(self.inputs))]
        levels = np.quantile(seen, 0.75, axis=0)

        def g(**values):
            return np.array(rows(values, np)) - levels

        named = {
            "x": lambda x: g(x=x), "w": lambda w: g(w=w), "v": lambda v: g(v=v),
            "xu": lambda x, u: g(x=x, u=u), "xwv": lambda x, w, v: g(x=x, w=w, v=v),
        }
        linear, quadratic = penalties.get("linear"), penalties.get("quadratic")
        self.rows = [
            Row(lambda values, j=j: rows(values, ca)[j] - float(levels[j]), kind, linear, quadratic)
            for j in range(2)
        ]
        return {"constraints": [qpmhe.Constraint(named[kind], 2, **penalties)]}

    def soft_set(self, kind, reached, penalties):
        """A box or a polytope that part of the record violates."""
        letter, shape = kind.split()
        name, points = letter.lower(), reached[letter.lower()]
        d = points.shape[1]
        if shape == "box":
            lower, upper = np.quantile(points, 0.2, axis=0), np.quantile(points, 0.8, axis=0)
            convex = qpmhe.Box(lower, upper)
            matrix, bound = np.vstack((np.eye(d), -np.eye(d))), np.append(upper, -lower)
        else:
            matrix = self.draw.normal(size=(2, d))
            bound = np.quantile(points @ matrix.T, 0.7, axis=0)
            convex = qpmhe.Polytope(matrix, bound)
        self.rows = [
            Row(
                lambda values, row=row, side=side: ca.dot(ca.DM(row), values[name]) - float(side),
                name, penalties.get("linear"), penalties.get("quadratic"), row != 0.0,
            ) for row, side in zip(matrix, bound, strict=True)
        ]
        full = {"X": "states", "W": "disturbances", "V": "noises"}[letter]
        return {full: convex.soften(**penalties)}

    def estimator(self, **options):
        gain = 0.6 * self.model.a @ np.linalg.pinv(self.model.c)
        return qpmhe.MovingHorizonEstimator(
            self.system, qpmhe.Luenberger(gain), self.cost, horizon=self.horizon,
            initial_state=self.start, **options,
        )

    def window(self, estimate, measurements=None):
        """The program of an estimate's window."""
        ys = self.measurements if measurements is None else measurements
        count = len(estimate.disturbances)
        own, (P, Q, R) = slice(estimate.time + 1 - count, estimate.time + 1), self.weights
        return Window(
            lambda x, u: self.f(x, ca.DM(u)), self.model.h, ys[own], estimate.candidate[0],
            (P, [Q] * count, [R] * count), us=self.inputs[own], rows=self.rows,
            discount=self.discount, loss=huber if self.robust else quadratic,
        )
