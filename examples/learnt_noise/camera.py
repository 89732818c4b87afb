"""A pendulum seen by a camera, whose noise depends on the brightness of the picture.

The model, records of it, and the estimates as a differentiable function of the noise: what both
programs of this folder share. It needs no framework for learning.
"""

import numpy as np

import qpmhe

DT, SAMPLES, HORIZON = 0.05, 60, 15
START = np.array([0.6, 0.0])
# Standard deviations: of the first guess of the state, and of its disturbances.
PRIOR, DISTURBANCE = np.array([0.1, 0.4]), np.array([0.005, 0.05])


def f(x):
    """One step of the pendulum: angle in rad, rate in rad/s."""
    angle, rate = x[..., 0], x[..., 1]
    return np.stack(
        [angle + DT * rate, rate - DT * (9.0 * np.sin(angle) + 0.4 * rate)], axis=-1
    )


def h(x):
    """The camera measures the angle."""
    return x[..., :1]


def deviation(brightness):
    """The camera's true noise, in rad, which no program of this folder knows."""
    return 0.01 + (brightness - 0.45) ** 2


def record(seed):
    """States (T + 1, 2), measurements (T, 1) and brightnesses (T,) between 0 and 1."""
    rng = np.random.default_rng(seed)
    states = np.empty((SAMPLES + 1, 2))
    states[0] = START + PRIOR * rng.normal(size=2)
    for t in range(SAMPLES):
        states[t + 1] = f(states[t]) + DISTURBANCE * rng.normal(size=2)
    # The light flickers over the whole range.
    phase = np.cumsum(rng.uniform(0.0, 1.6, SAMPLES))
    brightness = 0.5 + 0.5 * np.sin(phase)
    noise = deviation(brightness)[:, None] * rng.normal(size=(SAMPLES, 1))
    return states, h(states[:-1]) + noise, brightness


def estimator():
    """The estimator; each sample comes with its own weight of the noise."""
    return qpmhe.MovingHorizonEstimator(
        qpmhe.System(f, h, n=2, p=1),
        # Its gain is constant: the prior does not depend on the weights, and their derivatives
        # are exact. What a Kalman filter makes of them before the window is not included.
        qpmhe.Luenberger([[0.1], [0.1]]),
        qpmhe.QuadraticCost.from_covariances(
            prior=np.diag(PRIOR**2), disturbance=np.diag(DISTURBANCE**2), noise=0.05**2
        ),
        horizon=HORIZON, initial_state=START, max_qps=None, tolerance=1e-6,
    )


def estimate(measurements, variances):
    """Estimates (T, 2) of x(1), ..., x(T), with a variance (T,) of the noise at each sample."""
    mhe = estimator()
    return np.array([
        mhe.update(y, noise_weight=1.0 / variance).state
        for y, variance in zip(measurements, variances, strict=True)
    ])


def estimate_and_slopes(measurements, variances):
    """The same, and their derivatives (T, 2, HORIZON) by the variances in their windows.

    The last entry of a window belongs to its newest sample; windows at the start are filled up
    with zeros in front.
    """
    mhe, states = estimator(), np.empty((len(variances), 2))
    slopes = np.zeros((len(variances), 2, HORIZON))
    newest = np.zeros((2, HORIZON + 1, 2))  # two functions: the components of the newest state
    newest[:, -1] = np.eye(2)
    for t, (y, variance) in enumerate(zip(measurements, variances, strict=True)):
        states[t] = mhe.update(y, noise_weight=1.0 / variance).state
        count = min(t + 1, HORIZON)
        by_weight = mhe.sensitivity().adjoint(newest[:, -count - 1 :]).noise_weights[..., 0, 0]
        # The weight is 1 / variance.
        slopes[t, :, -count:] = -by_weight / variances[t + 1 - count : t + 1] ** 2
    return states, slopes


def pulled_back(cotangents, slopes):
    """The derivative (T,) by the variances, from the one (T, 2) by the estimates."""
    along = np.einsum("tn,tnk->tk", cotangents, slopes)
    samples = np.arange(len(along))[:, None] + np.arange(1 - HORIZON, 1)
    found = np.zeros(len(along))
    np.add.at(found, np.maximum(samples, 0), along)  # those before the start are zero
    return found


def table(rows):
    """The text of a table of test errors: names and errors of all states (..., 2)."""
    lines = [f"{'noise of the camera':<28}{'angle, rad':>12}{'rate, rad/s':>14}"]
    for name, errors in rows:
        angle, rate = np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
        lines.append(f"{name:<28}{angle:>12.4f}{rate:>14.4f}")
    return "\n".join(lines)
