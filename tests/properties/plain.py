"""J, the promise and the observer's path, by loops that share nothing with the library."""

import numpy as np

from qpmhe import Status

NO_SETS = (None, None, None)


def there(y):
    """Which components count: beyond 1e150, a number has no finite square."""
    return np.abs(y) <= 1e150


def true_cost(f, h, trajectory, prior, Y, weights):
    """J, and how far its rounding may take another way of computing it."""
    P, Q, R = weights
    offset = trajectory[0] - prior
    total, slack = offset @ P @ offset, 0.0
    for x, following, y in zip(trajectory[:-1], trajectory[1:], Y, strict=True):
        seen, fx, hx = there(y), f(x), h(x)
        w, v = following - fx, np.where(seen, np.where(seen, y, 0.0) - hx, 0.0)
        # The weight of what is there: the inverse of its covariance.
        weight, block = np.zeros_like(R), np.ix_(seen, seen)
        weight[block] = np.linalg.inv(np.linalg.inv(R)[block])
        total += w @ Q @ w + v @ weight @ v
        for r, size, part in ((w, following, Q), (w, fx, Q), (v, hx, weight)):
            error, largest = 1e-14 * np.abs(size).max(), np.abs(part).sum()
            slack += largest * error * (2.0 * np.abs(r).max() + error)
    return total, slack


def observer_path(f, h, gain, z, Y):
    """States of z+ = f(z) + gain v with v = y - h(z), zero where y is missing."""
    path = [z]
    for y in Y:
        z = f(z) + gain @ np.where(there(y), np.where(there(y), y, 0.0) - h(z), 0.0)
        path.append(z)
    return np.array(path)


def keeps_promise(f, h, estimate, Y, weights, sets=NO_SETS):
    """Hold an estimate to the promise; Y are the measurements of its window."""
    status, trajectory, seen = estimate.status, estimate.trajectory, there(Y)
    restored = Status.RESTORED in status
    assert estimate.cost <= (estimate.restored_cost if restored else estimate.candidate_cost)
    assert (Status.IMPROVED in status) + restored + (Status.CANDIDATE in status) == 1
    assert trajectory.shape == estimate.candidate.shape == (len(Y) + 1, estimate.state.size)
    for array in (trajectory, estimate.candidate, estimate.disturbances, estimate.noises[seen]):
        assert np.isfinite(array).all()
    assert np.isnan(estimate.noises[~seen]).all()
    assert (Status.MISSING in status) == (not seen[-1].all())
    assert status.explain()
    if Status.IMPROVED in status:
        # Within the sets at the same cost is better, too.
        outside = Status.CANDIDATE_OUTSIDE in status
        assert estimate.cost < estimate.candidate_cost or outside
    elif restored:
        assert Status.CANDIDATE_OUTSIDE in status
        assert not estimate.dropped
    else:
        assert estimate.cost == estimate.candidate_cost
        assert trajectory.tolist() == estimate.candidate.tolist()
    if np.isfinite(estimate.cost):
        true, slack = true_cost(f, h, trajectory, estimate.candidate[0], Y, weights)
        assert abs(estimate.cost - true) <= 1e-9 * true + slack
        if not estimate.dropped and (
            estimate.improved or restored or Status.CANDIDATE_OUTSIDE not in status
        ):
            within(sets, estimate, seen, weights)


def within(sets, estimate, seen, weights):
    """Hold an estimate to boxes for x, w and v."""
    # An estimate is clipped into X, a candidate is believed to be on its boundary; a difference
    # of large states is no better than their rounding. Misses count in deviations.
    _, by_w, by_v = (np.sqrt(np.linalg.inv(one).diagonal()) for one in weights)
    rounding = 4e-15 * np.abs(estimate.trajectory[1:]).max(axis=1, keepdims=True)
    clipped = Status.CANDIDATE not in estimate.status
    for box, points, slack in zip(
        sets, (estimate.trajectory, estimate.disturbances, np.where(seen, estimate.noises, np.nan)),
        (0.0 if clipped else 1e-9, 1e-8 * by_w + rounding, 1e-8 * by_v), strict=True,
    ):
        if box is not None:
            assert not (points < box.lower - slack).any()
            assert not (points > box.upper + slack).any()


def steps(mhe, model, Y, weights, sets=NO_SETS, given=None, before=lambda t: None):
    """Every estimate of a record, held to the promise; ``given`` is the record as it came."""
    f, h = model
    for t, y in enumerate(Y if given is None else given):
        before(t)
        estimate = mhe.update(y)
        assert (estimate.time, mhe.time) == (t, t + 1)
        keeps_promise(f, h, estimate, Y[max(0, t + 1 - mhe.horizon) : t + 1], weights, sets)
        yield estimate
