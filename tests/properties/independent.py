"""Observers, projections and held states a second time, for `fuzz_independent`.

Everything that judges is plain NumPy, for one state at a time, from the formulas in the paper
and the documentation.
"""

import math

import numpy as np
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import nnls

SPREAD = math.sqrt(3.0)  # of sigma points


def jacobians(one, x, sample):
    """Of f and h by central differences."""
    A, C = np.empty((one.n, one.n)), np.empty((one.p, one.n))
    for j in range(one.n):
        step = 1e-5 * (1.0 + abs(float(x[j]))) * np.eye(one.n)[j]
        of_f = one.f(x + step, sample.known, sample.dt) - one.f(x - step, sample.known, sample.dt)
        of_h = one.h(x + step, sample.known) - one.h(x - step, sample.known)
        A[:, j], C[:, j] = of_f / (2.0 * step[j]), of_h / (2.0 * step[j])
    return A, C


def misses(sets, name, point, covariance=None):
    """Of each inequality that a point misses its name, and by how much.

    With a covariance in standard deviations, or widths if less. Inequalities on components that
    are NaN do not count.
    """
    if name not in sets:
        return {}
    found, (low, high, rows, side) = {}, sets[name]
    for j, row in enumerate(np.vstack((np.eye(len(low)), rows))):
        lower, upper = (low[j], high[j]) if j < len(low) else (-math.inf, side[j - len(low)])
        used = row != 0.0
        value, scale = float(row[used] @ point[used]), 1.0
        if covariance is not None:
            scale = math.sqrt(row @ covariance @ row)
            scale = min(scale, upper - lower) if upper > lower else scale
        for which, miss in (("lower", lower - value), ("upper", value - upper)):
            if miss > 0.0:
                found[name, j, which] = miss / scale
    return found


def nearest(sets, point, covariance):
    """The nearest point of X in the metric of a covariance: least distance programming.

    Lawson and Hanson, Solving Least Squares Problems, chapter 23.
    """
    if not misses(sets, "states", point):
        return point
    low, high, rows, side = sets["states"]
    normals = np.vstack((np.eye(len(low)), -np.eye(len(low)), -rows))
    limits = np.concatenate((low, -high, -side))
    normals, limits = normals[np.isfinite(limits)], limits[np.isfinite(limits)]
    root, gaps = np.linalg.cholesky(covariance), limits - normals @ point
    E = np.vstack(((normals @ root).T, gaps / np.abs(gaps).max()))
    last = np.append(np.zeros(len(point)), 1.0)
    r = E @ nnls(E, last, maxiter=1000)[0] - last
    return point - root @ (r[:-1] / r[-1]) * np.abs(gaps).max()


class Watcher:
    """What the auxiliary observer does: L(z, v), and its covariance where it has one."""

    def __init__(self, one, prior_weight):
        self.one, self.kind, self.sets = one, one.kind, one.sets
        self.P0, self.Q = one.P, one.G @ one.Q @ one.G.T
        self.projects = "states" in one.sets and one.options["project_observer"]
        self.exact = self.kind in ("luenberger", "injection", "ukf") and not self.projects
        self.prior_weight, self.metric = prior_weight, np.linalg.inv(prior_weight)
        self.settled = False
        self.gain = one.gain.copy()
        if self.kind == "steady":
            self._iterate()
        #: Of the last step: by how much it and its prediction were outside.
        self.missed = self.predicted_missed = 0.0

    def _iterate(self):
        """The stationary covariance, by going on until it stands still."""
        one = self.one
        usual = type(one.usual)(one.usual.y, np.zeros(one.m + one.k), None, None, {}, one.dt)
        self.A, self.C = jacobians(one, one.start, usual)
        P, before = self.Q.copy(), None
        for _ in range(5000):
            S = self.C @ P @ self.C.T + one.R
            K = self.A @ P @ self.C.T @ np.linalg.inv(S)
            P, before = self.A @ P @ self.A.T + self.Q - K @ S @ K.T, P
            if np.abs(before - P).max() <= 1e-15 * np.abs(before).max():
                break
        self.gain = K
        self.update_gain = before @ self.C.T @ np.linalg.inv(S)

    def step(self, z, P, sample):
        """z(t+1) and P(t+1)."""
        following, covariance = self._free_step(z, P, sample)
        if not self.projects:
            return following, covariance
        if covariance is None and not self.settled:
            self._settle(z, sample)
        ahead = self.one.f(z, sample.known, sample.dt)
        self.missed, self.predicted_missed = (
            max(misses(self.sets, "states", point).values(), default=0.0)
            for point in (following, ahead)
        )
        metric = self.metric if covariance is None else covariance
        return self._inside(following, metric), covariance

    def _inside(self, point, covariance):
        if self.one.options.get("projection_metric") == "diagonal":
            covariance = np.diag(covariance.diagonal())
        return nearest(self.sets, point, covariance)

    def _settle(self, z, sample):
        """The Lyapunov metric of the error A - K C, if it is stable here."""
        A, C = jacobians(self.one, z, sample)
        gain = self.gain
        if self.kind == "injection":
            gain = gain / (1.0 + 0.1 * np.sqrt(self.one.R.diagonal()))
        E = A - gain @ C
        if np.abs(np.linalg.eigvals(E)).max() < 1.0:
            self.metric = np.linalg.inv(solve_discrete_lyapunov(E.T, self.prior_weight))
            self.settled = True

    def _joint(self, z, P, sample, there):
        """Covariances of (x, y), (x+, y), y and x+ without noise."""
        one, known, dt = self.one, sample.known, sample.dt
        if self.kind == "ekf":
            A, C = jacobians(one, z, sample)
            C = C[there]
            return P @ C.T, A @ P @ C.T, C @ P @ C.T, A @ P @ A.T
        root = np.linalg.cholesky(P).T * SPREAD
        moves = np.vstack((root, -root))
        F = np.array([one.f(z + move, known, dt) for move in moves]) - one.f(z, known, dt)
        H = (np.array([one.h(z + move, known) for move in moves]) - one.h(z, known))[:, there]
        weight = 1.0 / (2.0 * SPREAD**2)
        return weight * moves.T @ H, weight * F.T @ H, weight * H.T @ H, weight * F.T @ F

    def filtered(self, z, P, sample):
        """The estimate of x(t) with y(t); z for an observer without covariances."""
        if P is None or self.kind in ("luenberger", "injection"):
            return z
        there = np.isfinite(sample.y)
        v = (sample.y - self.one.h(z, sample.known))[there]
        R = np.linalg.inv(sample.noise)[there][:, there]
        if self.kind == "steady":  # its gain is that of all outputs
            K = self.update_gain[:, there]
            closed = np.eye(len(z)) - K @ self.C[there]
            after = closed @ P @ closed.T + K @ R @ K.T
        else:
            cross, _, S, _ = self._joint(z, P, sample, there)
            K = cross @ np.linalg.inv(S + R)
            after = P - K @ cross.T
        found = z + K @ v
        return self._inside(found, after) if self.projects else found

    def _free_step(self, z, P, sample):
        there = np.isfinite(sample.y)
        v = np.where(there, sample.y - self.one.h(z, sample.known), 0.0)
        ahead, R = self.one.f(z, sample.known, sample.dt), np.linalg.inv(sample.noise)
        if self.kind == "luenberger":
            return ahead + self.gain @ v, None
        if self.kind == "injection":
            return ahead + self.gain @ (v / (1.0 + 0.1 * np.abs(v))), None
        Q = self.one.G @ np.linalg.inv(sample.disturbance) @ self.one.G.T
        if self.kind == "steady":
            K = np.where(there, self.gain, 0.0)
            closed = self.A - K @ self.C
            return ahead + self.gain @ v, closed @ P @ closed.T + Q + K @ R @ K.T
        _, cross, S, spread = self._joint(z, P, sample, there)
        K = cross @ np.linalg.inv(S + R[there][:, there])
        return ahead + K @ v[there], spread - K @ cross.T + Q


class Held:
    """States held at trusted values where a window does not see them, by dense inverses."""

    def __init__(self, one, prior_weight):
        self.one, self.components = one, np.array(list(one.held))
        self.within = np.array(list(one.held.values()))
        self.target, self.prior = one.start[self.components], np.linalg.inv(prior_weight)
        low, high, *_ = one.sets.get("disturbances", (np.zeros(one.n), np.ones(one.n)))
        free = np.flatnonzero(low < high)
        self.spread = np.zeros((one.n, one.n))
        weight = np.linalg.inv(one.Q)[np.ix_(free, free)]
        self.spread[np.ix_(free, free)] = np.linalg.inv(weight)

    def see(self, candidate, samples):
        """Find H, and the matrix by which the trusted values follow, of a window."""
        n, K = self.one.n, len(samples)
        covariance = np.kron(np.eye(K + 1), self.spread)  # of the first state and each w
        covariance[:n, :n] = self.prior
        slopes, information = np.eye(n, n * (K + 1)), np.zeros_like(covariance)
        for i, sample in enumerate(samples):
            A, C = jacobians(self.one, candidate[i], sample)
            there = np.isfinite(sample.y)
            weight = np.linalg.inv(np.linalg.inv(sample.noise)[there][:, there])
            information += (C[there] @ slopes).T @ weight @ (C[there] @ slopes)
            slopes = A @ slopes
            slopes[:, n * (i + 1) : n * (i + 2)] += np.eye(n)
        left = covariance @ np.linalg.inv(np.eye(len(covariance)) + information @ covariance)
        part, left = (one[np.ix_(self.components, self.components)] for one in (self.prior, left))
        units = np.sqrt(part.diagonal())
        values, vectors = np.linalg.eigh(part / np.outer(units, units))
        root = units[:, None] * ((vectors * np.sqrt(values)) @ vectors.T)
        inverse, stiff, eye = np.linalg.inv(root), np.diag(1.0 / self.within), np.eye(len(root))
        values, vectors = np.linalg.eigh(inverse @ left @ inverse.T)
        low = np.minimum(values, 0.5)
        shares = (vectors * (low / (1.0 - low))) @ vectors.T
        self.weight = inverse.T @ stiff @ shares @ shares @ stiff @ inverse
        self.follow = root @ np.linalg.inv(eye + stiff @ shares @ stiff) @ (eye - shares) @ inverse

    def learn(self, estimate):
        """Follow an estimate of the next window's first state."""
        self.target = self.target + self.follow @ (estimate[self.components] - self.target)
