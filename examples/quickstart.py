"""Estimate the angle and speed of a damped pendulum from noisy angles."""

import numpy as np

import qpmhe

DT = 0.05


def pendulum(x, u):
    """Angle (rad) and speed (rad/s), driven by a torque u, one step on."""
    angle, speed = x[..., 0], x[..., 1]
    acceleration = -9.81 * np.sin(angle) - 0.3 * speed + u[..., 0]
    return np.stack([angle + DT * speed, speed + DT * acceleration], axis=-1)


system = qpmhe.System(pendulum, lambda x: x[..., :1], n=2, p=1, m=1)
cost = qpmhe.QuadraticCost.from_covariances(
    prior=np.diag([1.0, 1.0]), disturbance=np.diag([1e-4, 1e-3]), noise=[[0.1**2]]
)
observer = qpmhe.Luenberger([0.2, 0.3])  # stable, and not good: that is enough
mhe = qpmhe.MovingHorizonEstimator(
    system, observer, cost, horizon=15, initial_state=[0.0, 0.0], max_qps=2
)

rng = np.random.default_rng(1)
x, errors, observer_errors = np.array([1.2, 0.0]), [], []
for t in range(200):
    u = np.array([np.sin(0.1 * t)])
    y = x[:1] + 0.1 * rng.standard_normal(1)
    estimate = mhe.update(y, u)  # y(t) and u(t) in, the estimate of x(t+1) out
    x = pendulum(x, u) + rng.multivariate_normal([0, 0], np.diag([1e-4, 1e-3]))
    errors.append(estimate.state - x)
    observer_errors.append(estimate.candidate[-1] - x)

print("RMSE of angle (rad) and speed (rad/s)")
print("  observer:", np.sqrt(np.mean(np.square(observer_errors), axis=0)).round(3))
print("  MHE:     ", np.sqrt(np.mean(np.square(errors), axis=0)).round(3))
print(estimate.status.explain())
