"""The judge of the campaign: J, roll-outs and constraints in plain NumPy, from the formulas.

Where J differs from the estimator's by more than a first-order bound of rounding, the judge
measures by how much J moves when the trajectory and the data change in their last digits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from qpmhe import Status

EPS = np.finfo(float).eps
LOST = Status.MODEL_FAILED | Status.FAILED_STAGE
# What is missed by so much counts as satisfied, in standard deviations; documented: 5e-9.
FEASIBLE = 1e-8
# How many times the first-order bound, and how many times the measured rounding, J may differ.
BOUND, MEASURED = 50.0, 10.0
HUGE = 1e290  # beyond, squares that are added in another order may overflow


@dataclass
class Sample:
    """What an estimator was given with one sample; y is NaN where there is none."""

    u: np.ndarray
    y: np.ndarray
    disturbance: np.ndarray
    noise: np.ndarray
    sets: dict[str, Any] = field(default_factory=dict)

    @property
    def seen(self):
        return np.isfinite(self.y)


@dataclass
class Judged:
    """J of a trajectory, a bound of its rounding, and what it consists of."""

    J: float
    slack: float
    w: np.ndarray
    v: np.ndarray
    ahead: np.ndarray  # f along the trajectory
    d: np.ndarray  # x+ - f


def nudged(r, array):
    """Numbers changed in their last digits."""
    array = np.asarray(array, float)
    return array * (1.0 + EPS * r.integers(-1, 2, array.shape))


def wrapped(difference, angles):
    if angles is None:
        return difference
    difference, (indices, period) = difference.copy(), angles
    part = difference[..., indices]
    inside = (part >= -period / 2.0) & (part < period / 2.0)
    turned = (part + period / 2.0) % period - period / 2.0
    difference[..., indices] = np.where(inside, part, turned)
    return difference


def functions(case, x, u):
    """f and h along rows."""
    with np.errstate(all="ignore"):
        ones = np.ones(len(x))
        parts = [x[:, i] for i in range(case.n)], [u[:, i] for i in range(case.m)]
        return tuple(
            np.stack([np.asarray(one) * ones for one in rule(*parts, np)], axis=-1)
            for rule in (case.f, case.h)
        )


def _losses(loss, s, weights, error):
    """The loss of each residual, and by how much an error of it moves the loss."""
    size = np.abs(s)
    if loss is not None and loss.per_component:
        weights = np.diagonal(weights, axis1=-2, axis2=-1)
        q, dq = weights * s * s, weights * (2.0 * size + error) * error
    else:
        magnitudes = np.abs(weights)
        q = np.maximum(np.einsum("ki,kij,kj->k", s, weights, s), 0.0)
        dq = np.einsum("ki,kij,kj->k", 2.0 * size + error, magnitudes, error)
        dq += 4.0 * s.shape[1] * EPS * np.einsum("ki,kij,kj->k", size, magnitudes, size)
    if loss is None:
        return q, dq
    value = loss(q)
    moved = np.abs(loss(q + dq) - value) + np.abs(value - loss(np.maximum(q - dq, 0.0)))
    return value.reshape(len(s), -1).sum(axis=1), moved.reshape(len(s), -1).sum(axis=1)


def _seen_weight(weight, seen):
    """The weight of the components that are there: the inverse of their covariance."""
    if seen.all():
        return weight
    block, found = np.ix_(seen, seen), np.zeros_like(weight)
    found[block] = np.linalg.inv(np.linalg.inv(weight)[block])
    return found


def judged(case, x, window, mean, with_prior=True):
    with np.errstate(all="ignore"):
        return _judged(case, x, window, mean, with_prior)


def _judged(case, x, window, mean, with_prior):
    count = len(window)
    ahead, outputs = functions(case, x[:-1], np.array([one.u for one in window]))
    y, seen = (np.array([getattr(one, name) for one in window]) for name in ("y", "seen"))
    y = np.where(seen, y, 0.0)
    d = wrapped(x[1:] - ahead, case.x_angles)
    v = np.where(seen, wrapped(y - outputs, case.y_angles), 0.0)
    largest = np.abs(x / case.x_units).max()
    w, w_error = d, 2e-14 * (np.abs(x[1:]) + np.abs(ahead) + largest * case.x_units)
    v_error = 2e-14 * (np.abs(y) + np.abs(outputs) + largest * case.y_units) * seen
    if case.G is not None:
        D = metric(case)
        back = np.linalg.pinv(case.G / D[:, None])
        w, w_error = (d / D) @ back.T, (w_error / D) @ np.abs(back).T
    shares, J, slack = case.discount ** np.arange(count - 1.0, -1.0, -1.0), 0.0, 0.0
    disturbance = np.array([one.disturbance for one in window])
    noise = np.array([
        _seen_weight(one.noise, there) for one, there in zip(window, seen, strict=True)
    ])
    lost = EPS * max(
        (np.linalg.cond(one.noise) for one in window if not one.seen.all()), default=0.0
    )
    for name, s, of, error in (("w", w, disturbance, w_error), ("v", v, noise, v_error)):
        value, moved = _losses(case.losses[name], s, of, error)
        J, slack = J + float(shares @ value), slack + float(shares @ moved)
        if name == "v":  # the weights of what is there are differences of large numbers
            slack += lost * float(shares @ value)
    if with_prior:
        error = 4.0 * EPS * (np.abs(x[0]) + np.abs(mean))
        offset = wrapped(x[0] - mean, case.x_angles)
        value, moved = _losses(case.losses["p"], offset[None], case.prior_weight[None], error[None])
        share = case.discount**count
        J, slack = J + share * float(value[0]), slack + share * float(moved[0])
    value, moved = _penalties(case, x, w, v, seen)
    return Judged(J + value, slack + moved + 1e-10 * abs(J), w, np.where(seen, v, np.nan),
                  ahead, d)


def metric(case):
    """The standard deviations in which the directions of G are found."""
    return np.sqrt(np.maximum(np.diag(case.P), np.diag(case.G @ case.Q @ case.G.T)))


def _penalties(case, x, w, v, seen):
    """Of soft sets and of a soft constraint."""
    total, slack, count = 0.0, 0.0, len(w)
    shares = case.discount ** np.maximum(count - 1.0 - np.arange(count + 1.0), 0.0)
    for name, (one, lines, squares) in case.soft.items():
        points = {"x": x, "w": w, "v": v}[name]
        if len(one.matrix):
            value, size = points @ one.matrix.T, np.abs(points) @ np.abs(one.matrix).T
            missed = np.maximum(one.row_lower - value, value - one.row_upper)
        else:
            missed, size = np.maximum(one.lower - points, points - one.upper), np.abs(points)
        if name == "v":
            unknown = (~seen).astype(int) @ (one.matrix.T != 0.0) > 0 if len(one.matrix) else ~seen
            missed = np.where(unknown, 0.0, missed)
        missed = np.maximum(missed, 0.0)
        share = shares[: len(points), None]
        total += float(np.sum(share * (lines * missed + squares * missed**2)))
        slack += 1e-11 * float(np.sum(share * (lines + 2.0 * squares * missed) * size))
    if case.constraint and not case.constraint[2]:
        for share, point in zip(shares, x, strict=True):
            missed = max(0.0, float(case.constraint[0](point)))
            total += share * (3.0 * missed + 2.0 * missed * missed)
            slack += share * 1e-11 * (3.0 + 4.0 * missed) * (1.0 + missed)
    return total, slack


def rounding(case, x, window, mean, with_prior):
    """By how much J moves when the trajectory and the data change in their last digits."""
    r, found = np.random.default_rng(1), []
    here = judged(case, x, window, mean, with_prior).J
    for _ in range(8):
        samples = [
            Sample(nudged(r, one.u), nudged(r, one.y), one.disturbance, one.noise, one.sets)
            for one in window
        ]
        moved = nudged(r, x) + EPS * r.integers(-1, 2, x.shape) * (
            np.abs(x / case.x_units).max() * case.x_units
        )
        found.append(abs(judged(case, moved, samples, nudged(r, mean), with_prior).J - here))
    return max(found)


def rows(one, points, seen=None):
    """By how much points miss each inequality, if none of its components is missing."""
    sides = [one.lower - points, points - one.upper]
    if seen is not None:
        sides = [np.where(seen, side, -np.inf) for side in sides]
    if len(one.matrix):
        value = points @ one.matrix.T
        general = [one.row_lower - value, value - one.row_upper]
        if seen is not None:
            unknown = (~seen).astype(int) @ (one.matrix.T != 0.0) > 0
            general = [np.where(unknown, -np.inf, side) for side in general]
        sides += general
    return np.concatenate(sides, axis=-1)


def _allowed(one, covariance, size):
    """By how much each inequality may be missed: in deviations, and by rounding."""
    parts = [(np.sqrt(np.diag(covariance)), size)] * 2
    if len(one.matrix):
        deviation = np.sqrt(np.einsum("ij,jk,ik->i", one.matrix, covariance, one.matrix))
        parts += [(deviation, size @ np.abs(one.matrix).T)] * 2
    return np.concatenate([FEASIBLE * a + 1e-13 * b for a, b in parts], axis=-1)


class Judge:
    """Faults of one estimate after the other."""

    def __init__(self, case):
        self.case, self.counts = case, {}
        self.iQ, self.iR = case.iQ, case.iR  # as `set` leaves them

    def faults(self, estimate, window, mean=None):
        """(kind, detail) of each fault; the prior's mean is the candidate's first state if None."""
        with np.errstate(all="ignore"):
            return self._faults(estimate, window, mean)

    def _faults(self, estimate, window, mean):
        found: list[tuple[str, Any]] = []
        case, x, candidate = self.case, estimate.trajectory, estimate.candidate
        status, restored = estimate.status, Status.RESTORED in estimate.status
        moved, limit = Status.CANDIDATE not in status, estimate.candidate_cost
        if restored:
            limit = estimate.restored_cost
            self.count("restored")
        if not estimate.cost <= limit:
            found.append(("cost above its limit", (estimate.cost, limit, status)))
        if restored != (not math.isnan(estimate.restored_cost)) or (restored and (
            case.options.get("infeasible") != "restore" or estimate.dropped
            or Status.CANDIDATE_OUTSIDE not in status
        )):
            found.append(("restored in secret, or without a reason", status))
        if estimate.cost < 0.0 or estimate.candidate_cost < 0.0:
            found.append(("negative cost", (estimate.cost, estimate.candidate_cost)))
        if not (np.isfinite(x).all() and np.isfinite(estimate.state).all()):
            return [*found, ("an estimate that is not finite", status)]
        if len(window) != len(x) - 1:
            return [*found, ("length of the window", (len(window), len(x) - 1))]
        if (Status.IMPROVED in status) + restored + (Status.CANDIDATE in status) != 1:
            found.append(("improved, restored and the candidate, or none of them", status))
        if not moved and not np.array_equal(x, candidate):
            found.append(("not the candidate", status))
        if case.G is not None and not moved:
            return found  # its J is that of its roll-out
        mean = candidate[0] if mean is None else mean
        own = judged(case, x, window, mean, not case.from_observer)
        of_candidate = judged(case, candidate, window, mean, not case.from_observer)
        rolled, of_rolled = candidate, of_candidate
        if case.G is not None:  # J of the candidate is that of its roll-out, its rows are its own
            rolled = self._rolled_out(candidate, window)
            of_rolled = judged(case, rolled, window, mean, not case.from_observer)
            found += self._beside(own, x)
        for name, trajectory, ours, theirs in (
            ("candidate's cost", rolled, of_rolled, estimate.candidate_cost),
            ("cost", x, own, estimate.cost),
        ):
            found += self._compared(
                name, trajectory, ours, theirs, window, mean, status, candidate
            )
        slack = BOUND * (own.slack + of_candidate.slack)
        if (
            math.isfinite(estimate.candidate_cost) and not case.from_observer
            and case.G is None and not restored and of_candidate.J + slack < own.J
        ):
            moved_by = sum(rounding(case, one, window, mean, True) for one in (x, candidate))
            if not MEASURED * moved_by >= own.J - of_candidate.J:
                found.append(("own J above the candidate's", (own.J, of_candidate.J)))
        if moved:
            found += self._of_sets(estimate, window, own, of_candidate)
            found += self._of_noises(estimate, window, own)
        if case.kind in ("luenberger", "injection", "zero"):
            found += self._of_observer(estimate, window)
        return found

    def _compared(self, name, x, ours, theirs, window, mean, status, candidate):
        case, with_prior = self.case, not self.case.from_observer
        if not (math.isfinite(ours.J) and ours.J < HUGE):
            if math.isfinite(theirs) and theirs < HUGE:
                return [(f"{name} is finite, not for the judge", (ours.J, theirs))]
            return []
        if not math.isfinite(theirs):
            if status & LOST:
                self.count("J infinite after a failure of the model")
                return []
            return [(f"{name} is not finite, but for the judge", (ours.J, theirs, status))]
        apart = abs(ours.J - theirs) if with_prior else ours.J - theirs
        loose = 1e3 if case.G is not None else 1.0  # angles of the directions of G
        bound = BOUND * loose * ours.slack + (1e-7 * abs(ours.J) if loose > 1.0 else 0.0)
        if not apart > bound:
            return []
        moved = rounding(case, x, window, mean, with_prior)
        if case.G is not None and name == "candidate's cost":
            moved = np.fmax(moved, self._rounding_of_path(candidate, window, mean, ours.J))
        if apart <= MEASURED * moved:
            self.count("J apart by measured rounding")
            return []
        return [(f"{name} differs", (ours.J, theirs, ours.slack, status))]

    def _rolled_out(self, candidate, window, nudge=1.0):
        """The candidate with the model's own states in directions without disturbances."""
        D = nudge * metric(self.case)
        scaled = self.case.G / D[:, None]
        onto = D[:, None] * (scaled @ np.linalg.pinv(scaled)) / D
        path = [candidate[0]]
        for i, sample in enumerate(window):
            ahead = functions(self.case, path[-1][None], sample.u[None])[0][0]
            path.append(ahead + onto @ (candidate[i + 1] - ahead))
        return np.array(path)

    def _rounding_of_path(self, candidate, window, mean, J):
        """By how much J of the roll-out moves with the last digits of candidate and weights."""
        case, r = self.case, np.random.default_rng(2)
        # The metric is the inverse of a weight.
        error = max(EPS * np.linalg.cond(one) for one in (case.P, case.Q))
        paths = (self._rolled_out(
            nudged(r, candidate), window, 1.0 + error * r.uniform(-1.0, 1.0, case.n)
        ) for _ in range(8))
        return max(
            abs(judged(case, path, window, mean, not case.from_observer).J - J) for path in paths
        )

    def _beside(self, own, x):
        D = metric(self.case)
        missed = np.abs(own.d - own.w @ self.case.G.T) / D
        if np.nanmax(missed) > 1e-9 * (1.0 + np.abs(x / D).max()):
            return [("a disturbance beside G", float(np.nanmax(missed)))]
        return []

    def _of_noises(self, estimate, window, own):
        seen = np.array([one.seen for one in window])
        if not np.array_equal(np.isnan(estimate.noises), ~seen):
            return [("noises where nothing was measured", estimate.time)]
        y = np.where(seen, [one.y for one in window], 0.0)
        size = np.abs(own.v) + np.abs(y) + (
            np.abs(estimate.trajectory / self.case.x_units).max() * self.case.y_units
        )
        if np.nanmax(np.abs(estimate.noises - own.v) / size, initial=0.0) > 1e-9:
            return [("noises differ", estimate.time)]
        return []

    def _of_sets(self, estimate, window, own, of_candidate):
        """Hard rows that only the estimate misses, or all of them if none is dropped."""
        case, found, x = self.case, [], estimate.trajectory
        dropped = Status.ROWS_DROPPED in estimate.status
        largest = np.abs(x / case.x_units).max()
        seen = np.array([one.seen for one in window])
        y = np.where(seen, [one.y for one in window], 0.0)
        if case.G is not None:
            back = np.linalg.pinv(case.G / metric(case)[:, None])
        for name, points, before, covariance in (
            ("x", x, estimate.candidate, case.P), ("w", own.w, of_candidate.w, None),
            ("v", own.v, of_candidate.v, None),
        ):
            if case.sets[name] is None:
                continue
            if covariance is None:
                covariance = np.linalg.inv(self.iQ if name == "w" else self.iR)
            sets = [window[min(i, len(window) - 1)].sets[name] for i in range(len(points))]
            for one in {id(one): one for one in sets}.values():
                at = np.array([i for i, other in enumerate(sets) if other is one])
                there = seen[at] if name == "v" else None
                if name == "x":
                    size = np.abs(x[at])
                elif name == "v":
                    size = np.abs(y[at]) + largest * case.y_units
                else:
                    size = np.abs(x[at + 1]) + np.abs(own.ahead[at]) + largest * case.x_units
                    if case.G is not None:
                        size = 100.0 * (size / metric(case)) @ np.abs(back).T
                missed, kept = rows(one, points[at], there), rows(one, before[at], there) <= 0.0
                self.count("rows", missed.size)
                over = missed > _allowed(one, covariance, size)
                # Where the model failed, the candidate's residuals are unknown to the estimator.
                kept &= not estimate.status & LOST
                wrong = over & kept if dropped else over
                for k in np.flatnonzero(wrong.any(axis=1)):
                    i, allowed = int(at[k]), _allowed(one, covariance, size[k])
                    if name == "w":
                        allowed += self._rounding_of_rows(
                            one, x[i : i + 2], window[i], missed[k]
                        )
                    over = missed[k] > allowed
                    broken = over & kept[k]
                    if broken.any() or (over.any() and not dropped):
                        j = int(np.argmax(broken if broken.any() else over))
                        which = " that the candidate keeps" if broken.any() else ""
                        found.append((
                            f"a row of {name} is missed{which}",
                            (i, j, missed[k][j], allowed[j], estimate.status),
                        ))
        return found + self._of_constraint(estimate, window, own, of_candidate)

    def _rounding_of_rows(self, one, pair, sample, missed):
        """By how much rows of w move when two states change in their last digits."""
        case, r, found = self.case, np.random.default_rng(0), 0.0
        for _ in range(8):
            x = nudged(r, pair)
            d = wrapped(x[1] - functions(case, x[:1], sample.u[None])[0][0], case.x_angles)
            if case.G is not None:
                d = np.linalg.pinv(case.G / metric(case)[:, None]) @ (d / metric(case))
            moved = np.where(np.isfinite(missed), rows(one, d) - missed, 0.0)
            found = np.maximum(found, np.abs(moved))
        return MEASURED * found

    def _of_constraint(self, estimate, window, own, of_candidate):
        if not self.case.constraint or not self.case.constraint[2]:
            return []
        (g, of_v, _), count = self.case.constraint, len(window)
        now, before = (
            g(x[:count].T, of.v.T) if of_v else g(x.T)
            for x, of in ((estimate.trajectory, own), (estimate.candidate, of_candidate))
        )
        allowed = 1e-6 * (1.0 + np.abs(before)) + FEASIBLE * self.case.row_scale
        kept = before <= 0.0
        # Noises where nothing was measured are NaN, which misses nothing.
        missed = (now > allowed) & (kept | (Status.ROWS_DROPPED not in estimate.status))
        for i in np.flatnonzero(missed):
            which = " that the candidate keeps" if kept[i] else ""
            return [(f"a constraint is missed{which}",
                     (int(i), now[i], before[i], estimate.status))]
        return []

    def _of_observer(self, estimate, window):
        """The last step of an observer with a constant gain, if nothing projects it."""
        case, sample, path = self.case, window[-1], estimate.candidate
        if (
            case.sets["x"] is not None or "x" in case.soft or "candidate" in case.options
            or estimate.status & LOST or (case.kind == "injection" and not sample.seen.all())
        ):
            return []
        y = np.where(sample.seen, sample.y, 0.0)
        with np.errstate(all="ignore"):
            ahead, outputs = functions(case, path[-2][None], sample.u[None])
            v = np.where(sample.seen, wrapped(y - outputs[0], case.y_angles), 0.0)
            following = ahead[0] + case.correction(v)
            size = np.abs(following) + np.abs(ahead[0]) + np.abs(case.gain) @ np.abs(y) + (
                np.abs(path / case.x_units).max() * case.x_units
            )
            apart = np.abs(wrapped(following - path[-1], case.x_angles)) / size
        if np.isfinite(following).all() and apart.max() > 1e-11:
            return [("the observer's step differs", (apart.max(), estimate.status))]
        return []

    def count(self, name, number=1):
        self.counts[name] = self.counts.get(name, 0) + number
