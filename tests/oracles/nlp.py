"""The program of one window for Ipopt: J by its definition, sets, and penalties as slacks."""

from typing import Any, NamedTuple

import numpy as np
import pytest

ca = pytest.importorskip("casadi")

OPTIONS = {
    "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10,
    "ipopt.bound_relax_factor": 0.0, "ipopt.max_iter": 1000,
}
SETS = {"states": "x", "disturbances": "w", "noises": "v"}


class Model(NamedTuple):
    """f(x) = a x + bent sin(b x) and h(x) = c x + curved (c x)^2, for arrays and for CasADi."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    bent: float
    curved: float

    @classmethod
    def drawn(cls, draw, n, p, growth, bent=0.5, curved=0.03):
        a = draw.normal(size=(n, n))
        a *= draw.uniform(*growth) / max(float(np.abs(np.linalg.eigvals(a)).max()), 1e-3)
        return cls(a, 0.4 * draw.normal(size=(n, n)), draw.normal(size=(p, n)), bent, curved)

    def f(self, x, u=None):
        sin = ca.sin if isinstance(x, ca.SX) else np.sin
        return times(self.a, x) + self.bent * sin(times(self.b, x))

    def h(self, x, u=None):
        return times(self.c, x) + self.curved * times(self.c, x) ** 2


def times(matrix, x):
    return ca.DM(matrix) @ x if isinstance(x, ca.SX) else x @ matrix.T


class Row(NamedTuple):
    """An inequality value(x, u, w, v) <= 0 with its penalties; hard without.

    ``outputs`` says on which components of v it depends, if it depends on v.
    """

    value: Any
    names: str
    linear: float | None
    quadratic: float | None
    outputs: Any = True

    @property
    def hard(self):
        return self.linear is None and self.quadratic is None

    def price(self, missed):
        return (self.linear or 0.0) * missed + (self.quadratic or 0.0) * missed**2


def quadratic(residual, weight):
    return ca.bilin(ca.DM(weight), residual, residual)


class Window:
    """J and the constraints of one window as functions of its trajectory.

    Parameters
    ----------
    f, h : callable
        Of (x, u), for CasADi.
    ys, prior : array_like
        Measurements, NaN where they are missing, and the mean of the prior.
    weights : sequence
        Of the prior; of each w; of all outputs at each sample.
    us : sequence, optional
        Inputs and parameters of each sample.
    boxes : dict, optional
        For the name of a set that at each sample; for the states one more.
    rows : sequence of Row
        At each sample; those on x alone also at the last state.
    loss : callable
        Of the noises that are there and their weight.
    matrix : array_like, optional
        G of x+ = f(x, u) + G w.
    """

    def __init__(
        self, f, h, ys, prior, weights, *, us=None, boxes=None, rows=(), discount=1.0,
        loss=quadratic, matrix=None,
    ):
        (P, Qs, Rs), count = weights, len(ys)
        self.x = x = ca.SX.sym("x", len(P), count + 1)
        self.J = discount**count * quadratic(x[:, 0] - ca.DM(prior), P)
        self.limits, self.penalties = [], []  # (expression, lower, upper), (factor, row, value)
        for i in range(count + 1):
            factor, values = discount ** max(count - 1 - i, 0), {"x": x[:, i]}
            there = np.ones(0, bool)
            if i < count:
                u, there = None if us is None else us[i], np.isfinite(ys[i])
                seen = np.flatnonzero(there).tolist()
                w = x[:, i + 1] - f(x[:, i], u)
                if matrix is not None:
                    null = np.linalg.svd(matrix.T)[2][matrix.shape[1]:]
                    self.limits.append((ca.DM(null) @ w, 0.0, 0.0))
                    w = ca.DM(np.linalg.pinv(matrix)) @ w
                v = ca.DM(np.nan_to_num(ys[i])) - h(x[:, i], u)
                self.J += factor * quadratic(w, Qs[i])
                if seen:
                    weight = np.linalg.inv(np.linalg.inv(Rs[i])[np.ix_(seen, seen)])
                    self.J += factor * loss(v[seen], weight)
                values |= {"u": u, "w": w, "v": v}
            for name, letter in SETS.items():
                if name in (boxes or {}) and letter in values:
                    keep = seen if letter == "v" else list(range(values[letter].numel()))
                    box = boxes[name][i]
                    self.limits.append((values[letter][keep], box.lower[keep], box.upper[keep]))
                    if len(box.matrix):
                        rows_of = ca.DM(box.matrix) @ values[letter]
                        self.limits.append((rows_of, box.row_lower, box.row_upper))
            for row in rows:
                if set(row.names) <= set(values) and not (
                    "v" in row.names and (~there & row.outputs).any()
                ):
                    value = row.value({name: values[name] for name in row.names})
                    if row.hard:
                        self.limits.append((value, -np.inf, 0.0))
                    else:
                        self.penalties.append((factor, row, value))

    def judged(self, trajectory):
        """J of a trajectory, and its largest miss of what is hard."""
        J = self.J + sum(
            factor * row.price(ca.fmax(value, 0.0)) for factor, row, value in self.penalties
        )
        misses = [ca.fmax(low - one, one - high) for one, low, high in self.limits]
        found = ca.Function("J", [ca.vec(self.x)], [J, ca.vertcat(-np.inf, *misses)])
        J, misses = found(trajectory.ravel())
        return float(J), float(np.array(misses).max())

    def minimum(self, start):
        """The least J that Ipopt reaches from a trajectory, and where; infinity if it fails."""
        slacks = ca.SX.sym("s", len(self.penalties))
        missed = ca.Function("s", [ca.vec(self.x)], [ca.vertcat(*(v for *_, v in self.penalties))])
        J, limits = self.J, list(self.limits)
        for s, (factor, row, value) in zip(ca.vertsplit(slacks), self.penalties, strict=True):
            J += factor * row.price(s)
            limits.append((value - s, -np.inf, 0.0))
        lower, upper = (
            [np.broadcast_to(one[k], one[0].numel()) for one in limits] for k in (1, 2)
        )
        solve = ca.nlpsol("solve", "ipopt", {
            "x": ca.vertcat(ca.vec(self.x), slacks), "f": J,
            "g": ca.vertcat(*(one for one, *_ in limits)),
        }, OPTIONS)
        at = start.ravel()
        found = solve(
            x0=np.append(at, np.maximum(np.array(missed(at)).ravel(), 0.0)),
            lbx=np.append(np.full(at.size, -np.inf), np.zeros(len(self.penalties))), ubx=np.inf,
            lbg=np.concatenate([np.zeros(0), *lower]), ubg=np.concatenate([np.zeros(0), *upper]),
        )
        if not solve.stats()["success"]:
            return np.inf, None
        return float(found["f"]), np.array(found["x"])[: at.size].reshape(start.shape)
