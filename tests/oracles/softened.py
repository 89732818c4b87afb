"""Random nonlinear problems with nonlinear constraints and soft sets, for NumPy and for CasADi."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

import qpmhe

Array = np.ndarray

#: Parameters of a nonlinear constraint, or the soft set and its shape.
HARD = ("x", "xu", "w", "v", "xwv")
SETS = tuple(f"{name} {shape}" for name in "XWV" for shape in ("box", "polytope"))
PENALTIES = ("linear", "quadratic", "both")
COSTS = ("plain", "discount", "robust")


class Row(NamedTuple):
    """One inequality value(x, u, w, v) <= 0, for CasADi, with its penalties; hard without.

    ``outputs`` says on which components of v it depends, if it depends on v.
    """

    value: Any
    names: str
    linear: float | None
    quadratic: float | None
    outputs: Any = True


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

    def __init__(
        self, seed: int, kind: str, penalty: str | None = None, cost: str = "plain",
        weight: float | None = None,
    ) -> None:
        draw = self.draw = np.random.default_rng([seed, len(kind)])
        n, p = self.n, self.p = int(draw.integers(1, 4)), 1
        self.p = p = min(int(draw.integers(1, 3)), n)
        self.m, self.horizon = int("u" in kind), int(draw.integers(3, 7))
        a = draw.normal(size=(n, n))
        a *= draw.uniform(0.5, 1.0) / max(float(np.abs(np.linalg.eigvals(a)).max()), 1e-3)
        b, c = 0.4 * draw.normal(size=(n, n)), draw.normal(size=(p, n))
        self.a, self.b, self.c = a, b, c
        self.discount = 0.9 if cost == "discount" else 1.0
        self.threshold = 1.0 if cost == "robust" else None
        self.weights = [
            np.diag(draw.uniform(*span, size)) for span, size in
            (((0.5, 3), n), ((4, 40), n), ((4, 40), p))
        ]
        self.inputs = draw.uniform(-0.2, 0.2, (self.horizon + 8, self.m))
        x = self.truth = draw.uniform(-1, 1, n)
        states, disturbances, noises, measurements = [], [], [], []
        for u in self.inputs:
            w, v = draw.normal(size=n) * 0.1, draw.normal(size=p) * 0.3
            for values, value in (
                (states, x), (disturbances, w), (noises, v),
                (measurements, self.h(x) + v),
            ):
                values.append(value)
            x = self.f(x) + (u[0] if self.m else 0.0) + w
        self.measurements = np.array(measurements)
        self.start = draw.uniform(-1.2, 1.2, n)
        linear = quadratic = None
        if penalty is not None:
            if penalty != "quadratic":
                linear = float(10.0 ** draw.uniform(-0.3, 1.5)) if weight is None else weight
            if penalty != "linear":
                quadratic = float(10.0 ** draw.uniform(0, 1.7)) if weight is None else weight
        self.rows: list[Row] = []
        options: dict[str, Any] = {}
        reached = {
            "x": np.array(states), "u": self.inputs, "w": np.array(disturbances),
            "v": np.array(noises),
        }
        if kind in HARD:
            options["constraints"] = [self.constraint(kind, reached, linear, quadratic)]
        else:
            options.update(self.soft_set(kind, reached, linear, quadratic))
        self.system = qpmhe.System(
            (lambda x, u: self.f(x) + u) if self.m else self.f,
            self.h, n=n, p=p, m=self.m, **options,
        )
        prior, disturbance, noise = self.weights
        if self.threshold is None:
            self.cost: qpmhe.Cost = qpmhe.QuadraticCost(
                prior=prior, disturbance=disturbance, noise=noise, discount=self.discount
            )
        else:
            self.cost = qpmhe.RobustCost(
                prior=prior, disturbance=disturbance, noise=qpmhe.Huber(noise, self.threshold)
            )

    def f(self, x: Array) -> Array:
        return x @ self.a.T + 0.5 * np.sin(x @ self.b.T)

    def h(self, x: Array) -> Array:
        return x @ self.c.T + 0.03 * (x @ self.c.T) ** 2

    def constraint(
        self, kind: str, reached: dict[str, Array], linear: float | None, quadratic: float | None
    ) -> qpmhe.Constraint:
        """Two rows: a ball, and a bent half-space; both cut off some of the record."""
        draw = self.draw
        sizes = {name: reached[name].shape[1] for name in kind}
        slopes = {name: draw.normal(size=size) for name, size in sizes.items()}
        units = {name: max(float(np.std(reached[name])), 1e-3) for name in kind}
        bends = {name: 0.2 * draw.normal(size=size) for name, size in sizes.items()}

        def rows(values: dict[str, Any], module: Any) -> list[Any]:
            ball, bent = 0.0, 0.0
            for name in kind:
                for j in range(sizes[name]):
                    s = values[name][j] / units[name]
                    ball = ball + s * s
                    bent = bent + slopes[name][j] * s + bends[name][j] * module.cos(s)
            return [ball, bent]

        seen = np.array([
            rows({name: reached[name][t] for name in kind}, np) for t in range(len(self.inputs))
        ])
        levels = [float(np.quantile(seen[:, j], 0.75)) for j in range(2)]

        def g(values: dict[str, Any]) -> Any:
            return np.array(rows(values, np)) - np.array(levels)

        named = {
            "x": lambda x: g({"x": x}), "w": lambda w: g({"w": w}), "v": lambda v: g({"v": v}),
            "xu": lambda x, u: g({"x": x, "u": u}),
            "xwv": lambda x, w, v: g({"x": x, "w": w, "v": v}),
        }
        self.rows = [
            Row(lambda values, j=j: rows(values, ca)[j] - levels[j], kind, linear, quadratic)
            for j in range(2)
        ]
        return qpmhe.Constraint(named[kind], 2, linear=linear, quadratic=quadratic)

    def soft_set(
        self, kind: str, reached: dict[str, Array], linear: float | None, quadratic: float | None
    ) -> dict[str, Any]:
        """A box or a polytope that part of the record violates."""
        letter, shape = kind.split()
        name, points = letter.lower(), reached[letter.lower()]
        d = points.shape[1]
        if shape == "box":
            lower, upper = np.quantile(points, 0.2, axis=0), np.quantile(points, 0.8, axis=0)
            convex: Any = qpmhe.Box(lower, upper)
            matrix, bound = np.vstack((np.eye(d), -np.eye(d))), np.append(upper, -lower)
        else:
            matrix = self.draw.normal(size=(2, d))
            bound = np.quantile(points @ matrix.T, 0.7, axis=0)
            convex = qpmhe.Polytope(matrix, bound)
        self.rows = [
            Row(
                lambda values, row=row, side=side: ca.dot(ca.DM(row), values[name]) - float(side),
                name, linear, quadratic, row != 0.0,
            ) for row, side in zip(matrix, bound, strict=True)
        ]
        full = {"X": "states", "W": "disturbances", "V": "noises"}[letter]
        return {full: convex.soften(linear=linear, quadratic=quadratic)}

    def estimator(self, **options: Any) -> qpmhe.MovingHorizonEstimator:
        gain = 0.6 * self.a @ np.linalg.pinv(self.c)
        return qpmhe.MovingHorizonEstimator(
            self.system, qpmhe.Luenberger(gain), self.cost, horizon=self.horizon,
            initial_state=self.start, max_qps=None, **options,
        )

    def judged(
        self, trajectory: Array, prior: Array, first: int, measurements: Array | None = None
    ) -> tuple[float, float]:
        """J of a trajectory and its largest miss of a hard row, by plain loops.

        Missing measurements are NaN; rows on v do not count there.
        """
        ys = self.measurements if measurements is None else measurements
        count, cost, worst = len(trajectory) - 1, 0.0, -np.inf
        offset, (weight, w_weight, v_weight) = trajectory[0] - prior, self.weights
        cost += self.discount**count * float(offset @ weight @ offset)
        for i in range(count + 1):
            factor, x = self.discount ** max(count - 1 - i, 0), trajectory[i]
            values = {"x": x}
            missing = np.zeros(self.p, bool)
            if i < count:
                u, y = self.inputs[first + i], ys[first + i]
                missing = np.isnan(y)
                w = trajectory[i + 1] - self.f(x) - (u[0] if self.m else 0.0)
                v = y - self.h(x)
                values |= {"u": u, "w": w, "v": v}
                there = ~np.isnan(y)
                part = np.linalg.inv(np.linalg.inv(v_weight)[np.ix_(there, there)])
                q = float(v[there] @ part @ v[there])
                if self.threshold is not None and q > self.threshold**2:
                    q = 2.0 * self.threshold * np.sqrt(q) - self.threshold**2
                cost += factor * (float(w @ w_weight @ w) + q)
            for row in self.rows:
                if set(row.names) - set(values) or (
                    "v" in row.names and (missing & row.outputs).any()
                ):
                    continue
                given = {name: np.nan_to_num(values[name]) for name in row.names}
                miss = np.float64(row.value(given))
                if row.linear is None and row.quadratic is None:
                    worst = max(worst, miss)
                    continue
                miss = np.maximum(miss, 0.0)
                cost += factor * ((row.linear or 0.0) * miss + (row.quadratic or 0.0) * miss**2)
        return cost, worst

    def minimum(self, candidate: Array, first: int, prior: Array | None = None) -> float:
        """What Ipopt reaches from a candidate whose first sample this is; infinity if nothing.

        The prior is the candidate's first state, or another one.
        """
        count = len(candidate) - 1
        a, b, c = (ca.DM(one) for one in (self.a, self.b, self.c))
        first_weight, disturbance, noise = (ca.DM(one) for one in self.weights)
        x = ca.SX.sym("x", self.n, count + 1)
        points: list[dict[str, Any]] = []
        factor = [self.discount ** (count - 1 - i) for i in range(count)]
        offset = x[:, 0] - ca.DM(candidate[0] if prior is None else prior)
        objective = self.discount**count * ca.bilin(first_weight, offset, offset)
        for i in range(count):
            u = ca.DM(self.inputs[first + i])
            step = a @ x[:, i] + 0.5 * ca.sin(b @ x[:, i]) + (u[0] if self.m else 0.0)
            output = c @ x[:, i] + 0.03 * (c @ x[:, i]) ** 2
            w, v = x[:, i + 1] - step, ca.DM(self.measurements[first + i]) - output
            points.append({"x": x[:, i], "u": u, "w": w, "v": v})
            objective += factor[i] * ca.bilin(disturbance, w, w)
            q = ca.bilin(noise, v, v)
            if self.threshold is not None:
                t = self.threshold
                q = ca.if_else(q <= t * t, q, 2.0 * t * ca.sqrt(ca.fmax(q, 1e-9)) - t * t)
            objective += factor[i] * q
        slacks, rows, starts = [], [], []
        for row in self.rows:
            places = list(enumerate(points))
            if row.names == "x":
                places.append((count, {"x": x[:, count]}))
            for i, values in places:
                value = row.value({name: values[name] for name in row.names})
                if row.linear is None and row.quadratic is None:
                    rows.append(value)
                    continue
                s = ca.SX.sym("s")
                slacks.append(s)
                rows.append(value - s)
                objective += (factor[i] if i < count else 1.0) * (
                    (row.linear or 0.0) * s + (row.quadratic or 0.0) * s * s
                )
                starts.append(value)
        unknowns = ca.vertcat(ca.vec(x), *slacks)
        solve = ca.nlpsol(
            "solve", "ipopt", {"x": unknowns, "f": objective, "g": ca.vertcat(*rows)},
            {"print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10,
             "ipopt.bound_relax_factor": 0.0, "ipopt.max_iter": 1000},
        )
        at = candidate.ravel()
        if starts:
            missed = np.array(ca.Function("s", [ca.vec(x)], [ca.vertcat(*starts)])(at)).ravel()
            at = np.append(at, np.maximum(missed, 0.0))
        lower = np.append(np.full(candidate.size, -np.inf), np.zeros(len(slacks)))
        found = solve(x0=at, lbg=-np.inf, ubg=0.0, lbx=lower, ubx=np.inf)
        return float(found["f"]) if solve.stats()["success"] else np.inf
