"""The program of one window for Ipopt: J by its definition, sets, and penalties as slacks."""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pytest

ca = pytest.importorskip("casadi")

OPTIONS = {
    "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10,
    "ipopt.bound_relax_factor": 0.0, "ipopt.max_iter": 1000,
}
SETS = {"states": "x", "disturbances": "w", "noises": "v"}


SYMBOLS = ca.SX, ca.MX, ca.DM


def times(matrix, x):
    """A matrix and a vector, or vectors of leading dimensions, of any library."""
    return ca.DM(matrix) @ x if isinstance(x, SYMBOLS) else x @ matrix.T


def module_of(x):
    if type(x).__module__.startswith("jax"):
        return pytest.importorskip("jax.numpy")
    return ca if isinstance(x, SYMBOLS) else np


def spd(rng, size):
    factor = rng.standard_normal((size, size))
    return factor @ factor.T + 0.3 * np.eye(size)


class Row(NamedTuple):
    """Inequalities value(x, u, w, v) <= 0 with their penalties; hard without.

    ``outputs`` says on which components of v they depend, if they depend on v; a miss counts in
    units of ``scale``.
    """

    value: Any
    names: str
    linear: float | None = None
    quadratic: float | None = None
    outputs: Any = True
    scale: Any = 1.0

    @property
    def hard(self):
        return self.linear is None and self.quadratic is None

    def price(self, missed):
        linear, quadratic = (0.0 if one is None else one for one in (self.linear, self.quadratic))
        return linear * missed + quadratic * missed**2


def quadratic(residual, weight):
    return ca.bilin(ca.DM(weight), residual, residual)


def wrapped(difference, periods):
    """A residual whose angles, which have a period, are the shortest."""
    if periods is None or np.isnan(periods).all():
        return difference
    each = ca.vertsplit(difference)
    return ca.vertcat(*(
        one if np.isnan(period) else one - period * ca.floor(one / period + 0.5)
        for one, period in zip(each, periods, strict=True)
    ))


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
    rows : sequence of Row, or a function of a sample's number
        At each sample; those on x alone also at the last state.
    boxes : dict, optional
        For the name of a set that at all samples.
    losses : sequence of callable
        Of the initial error, w, and the noises that are there, and of their weights.
    matrix : array_like, optional
        G of x+ = f(x, u) + G w.
    periods : pair of array_like
        Of the angles in x and y, NaN elsewhere.
    hold
        The components, target and weight of states that are held.
    """

    def __init__(
        self, f, h, ys, prior, weights, *, us=None, boxes=None, rows=(), discount=1.0,
        losses=(quadratic,) * 3, matrix=None, periods=(None, None), hold=None,
    ):
        (P, Qs, Rs), count = weights, len(ys)
        self.x = x = ca.SX.sym("x", len(P), count + 1)
        self.J = losses[0](wrapped(x[:, 0] - ca.DM(prior), periods[0]), P)
        if hold is not None:
            away = x[hold.components.tolist(), 0] - ca.DM(hold.target)
            self.J += quadratic(away, hold.weight)
        self.J *= discount**count
        # (expression, lower, upper, scale); (factor, row, value)
        self.limits, self.penalties = [], []
        for i in range(count + 1):
            factor, values = discount ** max(count - 1 - i, 0), {"x": x[:, i]}
            there = np.ones(0, bool)
            if i < count:
                u, there = None if us is None else ca.DM(us[i]), np.isfinite(ys[i])
                seen = np.flatnonzero(there).tolist()
                w = wrapped(x[:, i + 1] - f(x[:, i], u), periods[0])
                if matrix is not None:
                    null = np.linalg.svd(matrix.T)[2][matrix.shape[1]:]
                    self.limits.append((ca.DM(null) @ w, 0.0, 0.0, 1.0))
                    w = ca.DM(np.linalg.pinv(matrix)) @ w
                v = wrapped(ca.DM(np.nan_to_num(ys[i])) - h(x[:, i], u), periods[1])
                self.J += factor * losses[1](w, Qs[i])
                if seen:
                    weight = np.linalg.inv(np.linalg.inv(Rs[i])[np.ix_(seen, seen)])
                    self.J += factor * losses[2](v[seen], weight)
                values |= {"u": u, "w": w, "v": v}
            for name, box in (boxes or {}).items():
                letter = SETS[name]
                if letter in values:
                    keep = seen if letter == "v" else list(range(values[letter].numel()))
                    self.limits.append((values[letter][keep], box.lower[keep], box.upper[keep], 1))
                    if len(box.matrix):
                        rows_of = ca.DM(box.matrix) @ values[letter]
                        self.limits.append((rows_of, box.row_lower, box.row_upper, 1.0))
            for row in rows(min(i, count - 1)) if callable(rows) else rows:
                if set(row.names) <= set(values) and not (
                    "v" in row.names and (~there & row.outputs).any()
                ):
                    value = row.value({name: values[name] for name in row.names})
                    if row.hard:
                        self.limits.append((value, -np.inf, 0.0, row.scale))
                    else:
                        self.penalties.append((factor, row, value))

    @cached_property
    def judge(self):
        J = self.J + sum(
            factor * ca.sum1(row.price(ca.fmax(value, 0.0)))
            for factor, row, value in self.penalties
        )
        misses = [ca.fmax(low - one, one - high) / scale for one, low, high, scale in self.limits]
        return ca.Function("J", [ca.vec(self.x)], [J, ca.vertcat(-np.inf, *misses)])

    def judged(self, trajectory):
        """J of a trajectory, and its largest miss of what is hard."""
        J, misses = self.judge(trajectory.ravel())
        return float(J), float(np.array(misses).max())

    def minimum(self, start):
        """The least J that Ipopt reaches from a trajectory, and where; infinity if it fails."""
        J, limits = self.J, [one[:3] for one in self.limits]
        missed = ca.vertcat(*(ca.fmax(value, 0.0) for *_, value in self.penalties))
        missed = ca.Function("s", [ca.vec(self.x)], [missed])
        slacks = ca.SX.sym("s", missed.numel_out(0))
        place = 0
        for factor, row, value in self.penalties:
            s = slacks[place : place + value.numel()]
            place += value.numel()
            J += factor * ca.sum1(row.price(s))
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
            x0=np.append(at, np.array(missed(at)).ravel()),
            lbx=np.append(np.full(at.size, -np.inf), np.zeros(place)), ubx=np.inf,
            lbg=np.concatenate([np.zeros(0), *lower]), ubg=np.concatenate([np.zeros(0), *upper]),
        )
        if not solve.stats()["success"]:
            return np.inf, None
        return float(found["f"]), np.array(found["x"])[: at.size].reshape(start.shape)
