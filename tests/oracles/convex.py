"""The convex problem of one window, linearised about a trajectory, stated for cvxpy."""

import cvxpy as cp
import numpy as np


def root(weight):
    """L with W = L L^T, also where rows of W are zero."""
    values, vectors = np.linalg.eigh(weight)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def loss_of(kind, rows):
    """The loss (name, parameter, per component) of each row of whitened residuals."""
    name, parameter, per_component = kind
    if name == "quadratic":
        return cp.sum(cp.square(rows), axis=1)
    if not per_component:
        size = cp.norm(rows, 2, axis=1)
        return cp.huber(size, parameter) if name == "huber" else cp.power(size, parameter)
    size = cp.abs(rows)
    each = cp.huber(size, parameter) if name == "huber" else cp.power(size, parameter)
    return cp.sum(each, axis=1)


def minimum(x, w, v, slopes, prior, weights, losses, discount=1.0, boxes=(None, None, None)):
    """The least cost of the linearised residuals, and where it is.

    x (K + 1, n) is the trajectory, w and v its residuals, slopes the Jacobians (A, C) at its
    first K states; weights and losses are those of prior, w and v, the last weight one for each
    stage; boxes are (lower, upper) for x, w and v.
    """
    count, n = w.shape
    d = cp.Variable((count + 1, n))
    a, c = slopes
    moved_w = cp.vstack([w[i] + d[i + 1] - a[i] @ d[i] for i in range(count)])
    moved_v = cp.vstack([v[i] - c[i] @ d[i] for i in range(count)])
    factors = discount ** np.arange(count - 1, -1, -1.0)
    white_v = cp.vstack([moved_v[i : i + 1] @ root(weights[2][i]) for i in range(count)])
    start = cp.reshape(x[0] + d[0] - prior, (1, n), order="C") @ root(weights[0])
    cost = (
        discount**count * cp.sum(loss_of(losses[0], start))
        + factors @ loss_of(losses[1], moved_w @ root(weights[1]))
        + factors @ loss_of(losses[2], white_v)
    )
    constraints = []
    for box, rows in zip(boxes, (x + d, moved_w, moved_v), strict=True):
        if box is not None:
            constraints += [rows >= np.tile(box[0], (rows.shape[0], 1)),
                            rows <= np.tile(box[1], (rows.shape[0], 1))]
    problem = cp.Problem(cp.Minimize(cost), constraints)
    tight = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-9)
    problem.solve(solver=cp.CLARABEL, **tight)
    return problem.value, x + d.value
