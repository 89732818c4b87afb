"""J of a trajectory and the observer's path, by loops that share nothing with the library."""

import numpy as np


def there(y):
    """Which components count: beyond 1e150, a number has no finite square."""
    return np.abs(y) <= 1e150


def stage_weight(noise_weight, seen):
    """Weight of the components of y that are there: the inverse of their covariance."""
    weight = np.zeros_like(noise_weight)
    if seen.any():
        block = np.linalg.inv(noise_weight)[np.ix_(seen, seen)]
        weight[np.ix_(seen, seen)] = np.linalg.inv(block)
    return weight


def true_cost(f, h, trajectory, prior, Y, weights):
    """J, and how far its rounding may take another way of computing it."""
    P, Q, R = weights
    offset = trajectory[0] - prior
    total, slack = offset @ P @ offset, 0.0
    for x, following, y in zip(trajectory[:-1], trajectory[1:], Y, strict=True):
        seen = there(y)
        fx, hx = f(x), h(x)
        w, v = following - fx, np.where(seen, np.where(seen, y, 0.0) - hx, 0.0)
        weight = stage_weight(R, seen)
        total += w @ Q @ w + v @ weight @ v
        for r, size, part in ((w, following, Q), (w, fx, Q), (v, hx, weight)):
            error, largest = 1e-14 * np.abs(size).max(), np.abs(part).sum()
            slack += largest * error * (2.0 * np.abs(r).max() + error)
    return total, slack


def observer_path(f, h, gain, z, Y):
    """States of z+ = f(z) + gain v with v = y - h(z), zero where y is missing."""
    path = [z]
    for y in Y:
        v = np.where(there(y), y, 0.0) - h(z)
        v[~there(y)] = 0.0
        z = f(z) + gain @ v
        path.append(z)
    return np.array(path)
