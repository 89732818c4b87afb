"""A window and its Hessian by plain loops and dense algebra; losses and integrators."""

import numpy as np

STEP = 1e-30  # of the complex differences, which are exact for any tiny step


def spd(generator, n):
    root = generator.standard_normal((n, n))
    return root @ root.T + 0.5 * np.eye(n)


def quadratic(s, weight):
    return s @ weight @ s


def huber(threshold):
    def loss(s, weight):
        q = s @ weight @ s
        if q.real <= threshold**2:
            return q
        return 2.0 * threshold * np.sqrt(q) - threshold**2

    return loss


def euler(rate):
    return lambda x, u, dt: x + dt * rate(x, u)


def rk4(rate):
    def step(x, u, dt):
        k1 = rate(x, u)
        k2 = rate(x + dt / 2.0 * k1, u)
        k3 = rate(x + dt / 2.0 * k2, u)
        k4 = rate(x + dt * k3, u)
        return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    return step


def differences(function, trajectory):
    """Complex differences of a function of the trajectory, the last axis one a component."""
    columns = []
    for k in np.ndindex(trajectory.shape):
        moved = trajectory.astype(complex)
        moved[k] += 1j * STEP
        columns.append(np.imag(function(moved)) / STEP)
    return np.stack(columns, axis=-1)


class Record:
    """All samples since the start, and the observer z+ = f(z) + gain (y - h(z)) along them.

    Weights are (P, Q, R).
    """

    def __init__(self, h, gain, start, weights, horizon, discount):
        self.h, self.gain, self.horizon = h, np.asarray(gain, dtype=float), horizon
        self.P, self.Q, self.R = weights
        self.discount = discount
        self.z = [np.array(start, dtype=float)]
        self.steps, self.ys, self.noise_weights = [], [], []

    @property
    def first(self):
        """Time of the window's first state."""
        return max(0, len(self.ys) - self.horizon)

    @property
    def count(self):
        return len(self.ys) - self.first

    def push(self, step, y, noise_weight=None):
        """Take in a sample and the model x -> f(x) of its time."""
        self.steps.append(step)
        self.ys.append(np.array(y, dtype=float))
        self.noise_weights.append(self.R if noise_weight is None else noise_weight)
        self.z.append(None)
        self.observe(len(self.ys) - 1, self.z[-2])

    def observe(self, time, z):
        """Run the observer again from a state at this time on."""
        self.z[time] = z
        for t in range(time, len(self.ys)):
            v = np.nan_to_num(self.ys[t] - self.h(self.z[t]), nan=0.0)
            self.z[t + 1] = self.steps[t](self.z[t]) + self.gain @ v

    def amend(self, time, y):
        new = np.isfinite(y)
        self.ys[time][new] = np.asarray(y)[new]
        self.observe(time, self.z[time])

    def weight(self, t):
        """Weight of v(t): the inverse of the covariance of the components that are there."""
        seen, weight = np.isfinite(self.ys[t]), self.noise_weights[t]
        if seen.all():
            return weight
        reduced = np.zeros_like(weight)
        if seen.any():
            block = np.linalg.inv(weight)[np.ix_(seen, seen)]
            reduced[np.ix_(seen, seen)] = np.linalg.inv(block)
        return reduced

    def residuals(self, trajectory):
        """(w, v) of the window's stages, with zeros where y is missing; complex will do."""
        stages = []
        for i, t in enumerate(range(self.first, len(self.ys))):
            seen = np.isfinite(self.ys[t])
            y = np.where(seen, self.ys[t], 0.0)
            w = trajectory[i + 1] - self.steps[t](trajectory[i])
            stages.append(np.concatenate([w, (y - self.h(trajectory[i])) * seen]))
        return np.array(stages)

    def hessian(self, trajectory, cost):
        """Of J/2, with the residuals' Jacobians between the weights that majorise the cost."""
        n, count, first = len(self.Q), self.count, self.first
        total = np.zeros((trajectory.size, trajectory.size))
        total[:n, :n] = cost.majorise_prior(trajectory[0] - self.z[first], self.P)
        total *= self.discount**count
        residuals = self.residuals(trajectory)
        for i, slope in enumerate(differences(self.residuals, trajectory)):
            joint = np.zeros((len(slope), len(slope)))
            joint[:n, :n], joint[n:, n:] = self.Q, self.weight(first + i)
            joint = cost.majorise(residuals[i : i + 1], joint[None])[0]
            total += self.discount ** (count - 1 - i) * slope.T @ joint @ slope
        return total
