"""Ten studies behind docs/explanation/fast-answers.md, each a few lines on a small system.

    python examples/studies/fast_answers.py

writes the page's tables between its markers, ``<!-- fast:name -->`` and ``<!-- end -->``.
``--only NAME`` runs one of them; ``--share 0.1`` a tenth of the records.
"""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

import qpmhe

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "fast-answers.md"
Array = np.ndarray
Rows = list[dict[str, Any]]

#: A slowly turning system of two states, of which the first is measured.
A = np.array([[1.0, 0.1], [-0.2, 0.95]])
C = np.array([[1.0, 0.0]])
Q, R = np.diag([1e-3, 1e-2]), np.array([[0.1]])
PRIORS = {"prior 100 P": 100.0, "prior P": 1.0, "prior P / 100": 0.01}


def linear(F: Array, H: Array, **options: Any) -> qpmhe.System:
    """x+ = F x + w, y = H x + v."""
    return qpmhe.System(
        lambda x: x @ F.T, lambda x: x @ H.T, n=len(F), p=len(H),
        f_jacobian=lambda x: np.broadcast_to(F, (*x.shape, len(F))),
        h_jacobian=lambda x: np.broadcast_to(H, (*x.shape[:-1], *H.shape)), **options,
    )


def rms(errors: Any) -> float:
    """Root of the mean square of all entries."""
    return float(np.sqrt(np.mean(np.square(errors))))


def stationary(F: Array, H: Array, Q: Array, R: Array) -> Array:
    """Covariance of the Kalman filter's prediction, once it has settled."""
    from scipy.linalg import solve_discrete_are

    return solve_discrete_are(F.T, H.T, Q, R)


def record(steps: int, seed: int, P: Array) -> tuple[Array, Array]:
    """States and measurements of the turning system; its start is N(0, P)."""
    numbers = np.random.default_rng(seed)
    x = np.linalg.cholesky(P) @ numbers.standard_normal(2)
    w = numbers.standard_normal((steps, 2)) * np.sqrt(np.diag(Q))
    v = numbers.standard_normal((steps, 1)) * np.sqrt(R[0])
    states = np.empty((steps, 2))
    for t in range(steps):
        states[t], x = x, A @ x + w[t]
    return states, states @ C.T + v


def bounds(share: float = 1.0) -> Rows:
    """A speed that is never negative; the distance is its integral, and is not measured."""
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0, 1.0]])
    covariances = {"disturbance": np.diag([1e-8, 0.01]), "noise": np.array([[0.25]])}
    free = linear(F, H)
    kept = linear(F, H, states=qpmhe.Box([-np.inf, 0.0], [np.inf, np.inf]))
    rows = []
    for steps in (100, 300):
        errors: dict[str, list[Array]] = {"free": [], "kept": []}
        for seed in range(max(2, round(40 * share))):
            numbers = np.random.default_rng(seed)
            x, pedal, states = np.zeros(2), 0.0, []
            for w in 0.1 * numbers.standard_normal(steps):
                states.append(x)
                pedal = 0.9 * pedal - 0.02 + w  # the vehicle stands while this is negative
                x = np.array([x[0] + x[1], max(0.0, pedal)])
            truth = np.array(states)
            y = truth @ H.T + 0.5 * numbers.standard_normal((steps, 1))
            for name, system in (("free", free), ("kept", kept)):
                mhe = qpmhe.MovingHorizonEstimator(
                    system, qpmhe.ExtendedKalman(prior=np.diag([1e-8, 0.01]), **covariances),
                    qpmhe.QuadraticCost.from_covariances(**covariances), horizon=10,
                    initial_state=[0.0, 0.0], max_qps=None,
                )
                errors[name].append(mhe.run(y).filtered - truth)
        free_errors, kept_errors = (np.array(errors[name]) for name in ("free", "kept"))
        rows.append({
            "samples": steps,
            "speed, without bound": rms(free_errors[:, :, 1]),
            "speed, v ≥ 0": rms(kept_errors[:, :, 1]),
            "distance at the end, without": rms(free_errors[:, -1, 0]),
            "distance at the end, v ≥ 0": rms(kept_errors[:, -1, 0]),
        })
    return rows


def uniform(share: float = 1.0) -> Rows:
    """Disturbances uniform in [-1, 1]: the Kalman filter, its cost within the bounds, the MAP."""
    F = H = np.eye(1)
    rows = []
    for noise in (0.01, 0.1, 1.0, 10.0):
        variance = {"disturbance": np.eye(1) / 3.0, "noise": noise * np.eye(1)}
        # The exact density has no term for w within its bounds: a weight that counts for nothing.
        flat = {"disturbance": 1e6 * np.eye(1), "noise": noise * np.eye(1)}
        within = linear(F, H, disturbances=qpmhe.Box([-1.0], [1.0]))
        made = {
            "Kalman filter": (linear(F, H), variance),
            "its cost, w bounded": (within, variance),
            "exact MAP": (within, flat),
        }
        errors: dict[str, list[Array]] = {name: [] for name in made}
        for seed in range(max(2, round(20 * share))):
            numbers = np.random.default_rng(seed)
            truth = np.cumsum(numbers.uniform(-1.0, 1.0, (100, 1)), axis=0)
            y = truth + np.sqrt(noise) * numbers.standard_normal(truth.shape)
            for name, (system, covariances) in made.items():
                mhe = qpmhe.MovingHorizonEstimator(
                    system, qpmhe.ExtendedKalman(prior=np.eye(1), **variance),
                    qpmhe.QuadraticCost.from_covariances(**covariances), horizon=20,
                    initial_state=[0.0], max_qps=None,
                )
                errors[name].append((mhe.run(y).filtered - truth)[20:])
        rows.append({"r": noise, **{name: rms(found) for name, found in errors.items()}})
    return rows


def horizons(share: float = 1.0) -> Rows:
    """A constant prior that is a hundred times too large, right, or too small, at each horizon."""
    P = stationary(A, C, Q, R)
    system = linear(A, C)
    luenberger = qpmhe.Luenberger([[0.4], [0.5]])
    kalman = qpmhe.SteadyStateKalman(system, [0.0, 0.0], disturbance=Q, noise=R)
    records = [record(150, seed, P) for seed in range(max(2, round(20 * share)))]

    def error(observer: qpmhe.Observer, horizon: int, factor: float, qps: int = 1) -> float:
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer,
            qpmhe.QuadraticCost.from_covariances(prior=factor * P, disturbance=Q, noise=R),
            horizon=horizon, initial_state=[0.0, 0.0], max_qps=qps,
        )
        return predicted(mhe, records)

    best = error(kalman, 1, 1.0, qps=0)
    rows: Rows = [{"N": "observer alone", **{
        name: error(luenberger, 1, 1.0, qps=0) / best for name in PRIORS
    }}]
    rows += [{"N": N, **{
        name: error(luenberger, N, factor) / best for name, factor in PRIORS.items()
    }} for N in (1, 2, 3, 5, 10, 20, 40)]
    return rows


def predicted(mhe: qpmhe.MovingHorizonEstimator, records: list[tuple[Array, Array]]) -> float:
    """Error of the estimates before each measurement, once they have settled."""
    found = []
    for states, y in records:
        mhe.reset()
        found.append((mhe.run(y).states[:-1] - states)[30:])
    return rms(found)


def smoothed(share: float = 1.0) -> Rows:
    """The last solution's state as mean of the prior, whose covariance is a multiple of P."""
    P = stationary(A, C, Q, R)
    system = linear(A, C)
    records = [record(150, seed, P) for seed in range(max(2, round(20 * share)))]

    def error(horizon: int, factor: float, arrival: str) -> float:
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.SteadyStateKalman(system, [0.0, 0.0], disturbance=Q, noise=R),
            qpmhe.QuadraticCost.from_covariances(prior=factor * P, disturbance=Q, noise=R),
            horizon=horizon, initial_state=[0.0, 0.0], arrival=arrival,
        )
        found = []
        for states, y in records:
            mhe.reset()
            found.append((mhe.run(y).filtered - states)[30:])
        return rms(found)

    best = error(5, 1.0, "observer")
    return [
        {"prior": f"{factor:g} P", **{
            f"N = {N}": error(N, factor, "smoothed") / best for N in (2, 5, 10, 20)
        }}
        for factor in (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
    ]


def outliers(share: float = 1.0) -> Rows:
    """One measurement in ten is off by 20 deviations: Huber's loss against gates."""
    F = H = np.eye(1)
    rows = []
    for q in (1e-4, 1e-2, 1.0, 100.0):
        covariances = {"disturbance": q * np.eye(1), "noise": np.eye(1)}
        start = {"prior": stationary(F, H, q * np.eye(1), np.eye(1)), **covariances}
        system = linear(F, H)
        quadratic = qpmhe.QuadraticCost.from_covariances(**covariances)
        robust = qpmhe.RobustCost(
            disturbance=np.eye(1) / q, noise=qpmhe.Huber(np.eye(1), threshold=1.345))
        made = {
            "sensor": (qpmhe.ExtendedKalman(**start), quadratic, 0),
            "innovation": (
                qpmhe.ExtendedKalman(innovation=qpmhe.Gate(), **start), quadratic, 0),
            "Huber": (
                qpmhe.ExtendedKalman(innovation=qpmhe.HuberInnovation(), **start), robust, 10),
        }
        errors: dict[str, list[Array]] = {name: [] for name in made}
        for seed in range(max(2, round(20 * share))):
            numbers = np.random.default_rng(seed)
            truth = np.cumsum(np.sqrt(q) * numbers.standard_normal((200, 1)), axis=0)
            y = truth + numbers.standard_normal(truth.shape)
            hit = numbers.random(truth.shape) < 0.1
            y += hit * numbers.choice([-20.0, 20.0], truth.shape)
            for name, (observer, cost, qps) in made.items():
                mhe = qpmhe.MovingHorizonEstimator(
                    system, observer, cost, horizon=10, initial_state=[0.0], max_qps=qps)
                found = []
                for value in y:
                    # Three deviations of the sensor, whatever the state may do meanwhile.
                    far = name == "sensor" and abs(value - mhe.state) > 3.0
                    found.append(mhe.update([np.nan] if far else value).filtered.copy())
                errors[name].append((np.array(found) - truth)[20:])
        sensor, innovation, huber = (rms(errors[name]) for name in made)
        rows.append({
            "q / r": q, "gate, 3 deviations of the sensor": sensor,
            "gate on the innovation": innovation, "Huber": huber,
            "Huber over the first": huber / sensor, "over the second": huber / innovation,
        })
    return rows


def missing(share: float = 1.0) -> Rows:
    """Half of the measurements: every second, or each with a chance of one half."""
    F = H = np.eye(1)
    rows = []
    for q in (1e-2, 1.0, 100.0):
        covariances = {"disturbance": q * np.eye(1), "noise": np.eye(1)}
        errors: dict[str, list[Array]] = {"regular": [], "random": []}
        for seed in range(max(2, round(40 * share))):
            numbers = np.random.default_rng(seed)
            truth = np.cumsum(np.sqrt(q) * numbers.standard_normal((300, 1)), axis=0)
            y = truth + numbers.standard_normal(truth.shape)
            for name, lost in (
                ("regular", np.arange(300) % 2 == 1), ("random", numbers.random(300) < 0.5)
            ):
                mhe = qpmhe.MovingHorizonEstimator(
                    linear(F, H), qpmhe.ExtendedKalman(prior=np.eye(1), **covariances),
                    qpmhe.QuadraticCost.from_covariances(**covariances), horizon=10,
                    initial_state=[0.0],
                )
                seen = np.where(lost[:, None], np.nan, y)
                errors[name].append((mhe.run(seen).filtered - truth)[20:])
        regular, random = rms(errors["regular"]), rms(errors["random"])
        rows.append({
            "q / r": q, "every second": regular, "at random": random,
            "random over regular": random / regular,
        })
    return rows


def consistency(share: float = 1.0) -> Rows:
    """Mean of J / (N p) at the optimum, with several priors."""
    P = stationary(A, C, Q, R)
    system = linear(A, C)
    kalman = qpmhe.SteadyStateKalman(system, [0.0, 0.0], disturbance=Q, noise=R)
    updated, constant = (
        qpmhe.QuadraticCost.from_covariances(prior=prior, disturbance=Q, noise=R)
        for prior in (None, P)
    )
    luenberger = qpmhe.Luenberger([[0.4], [0.5]])
    made = {
        "Kalman filter, its covariance": (kalman, updated, "observer"),
        "Luenberger observer, P": (luenberger, constant, "observer"),
        "smoothed state, P": (kalman, constant, "smoothed"),
    }
    records = [record(200, seed, P) for seed in range(max(8, round(400 * share)))]
    rows = []
    for name, (observer, cost, arrival) in made.items():
        row: dict[str, Any] = {"prior": name}
        for N in (5, 10, 20):
            mhe = qpmhe.MovingHorizonEstimator(
                system, observer, cost, horizon=N, initial_state=[0.0, 0.0], arrival=arrival)
            costs = []
            for _, y in records:
                mhe.reset()
                costs.append(mhe.run(y).costs[40:])
            row[f"N = {N}"] = float(np.mean(costs)) / N
        rows.append(row)
    return rows


def projection(share: float = 1.0) -> Rows:
    """States that are zero, and known not to be negative; P couples neighbours."""
    rows = []
    solver = qpmhe.solvers.create(
        "auto", qpmhe.solvers.SolverOptions(absolute_tolerance=1e-9))
    for n in (5, 11, 21):
        place = np.arange(n)
        P = np.exp(-np.abs(place[:, None] - place) / 5.0)
        weight = np.linalg.inv(P)
        qp = qpmhe.solvers.QP(1, n)
        for offset in range(n):
            qp.band[0, : n - offset, offset] = np.diag(weight, -offset)
        row: dict[str, Any] = {"n": n}
        farther = 0
        numbers = np.random.default_rng(n)
        for name, root in (
            ("errors as P says", np.linalg.cholesky(P)), ("independent errors", np.eye(n))
        ):
            before, after, cut = [], [], []
            for _ in range(max(20, round(500 * share))):
                z = root @ numbers.standard_normal(n)
                qp.lower[0] = -z  # the step to the nearest point in P^-1
                point = z + solver.solve(qp).d[0]
                farther += point @ weight @ point > z @ weight @ z * (1.0 + 1e-9)
                before.append(z)
                after.append(point)
                cut.append(np.maximum(z, 0.0))
            row[name] = rms(after) / rms(before)
            if name.startswith("independent"):
                row["the same, cut off at 0"] = rms(cut) / rms(before)
        rows.append({**row, "farther in P⁻¹": int(farther)})
    return rows


def unobservable(share: float = 1.0) -> Rows:
    """A unicycle and one beacon: nothing tells of a turn of everything about the beacon."""
    steps, dt = 150, 0.1
    Q, R = np.diag([1e-6, 1e-6, 1e-8]), np.diag([0.01, 0.01])
    P = np.diag([25.0, 25.0, 0.25])
    inputs = np.column_stack((np.full(steps, 2.0), 0.6 * np.sin(0.1 * np.arange(steps))))

    def f(x: Array, u: Array) -> Array:
        return np.stack((
            x[..., 0] + dt * u[..., 0] * np.cos(x[..., 2]),
            x[..., 1] + dt * u[..., 0] * np.sin(x[..., 2]), x[..., 2] + dt * u[..., 1],
        ), axis=-1)

    def h(x: Array, _: Array) -> Array:  # range, and bearing against the heading
        return np.stack((
            np.sqrt(x[..., 0]**2 + x[..., 1]**2),
            np.arctan2(-x[..., 1], -x[..., 0]) - x[..., 2],
        ), axis=-1)

    system = qpmhe.System(
        f, h, n=3, p=2, m=2, output_residual=qpmhe.angles(1), state_residual=qpmhe.angles(2))
    start = np.array([10.0, 0.0, 1.5])
    turn = np.array([0.0, 10.0, 1.0])  # derivative of the start in such a turn
    least = 1.0 / np.sqrt(turn @ np.linalg.inv(P) @ turn)
    claims, errors, along = [], [], []
    for seed in range(max(2, round(40 * share))):
        numbers = np.random.default_rng(seed)
        x, guess = start, start + np.sqrt(np.diag(P)) * numbers.standard_normal(3)
        observer = qpmhe.ExtendedKalman(prior=P, disturbance=Q, noise=R)
        mhe = qpmhe.MovingHorizonEstimator(
            system, observer, qpmhe.QuadraticCost.from_covariances(disturbance=Q, noise=R),
            horizon=10, initial_state=guess, max_qps=5,
        )
        true = P  # the filter's covariance with derivatives at the true states
        for u in inputs:
            estimate = mhe.update(h(x, u) + 0.1 * numbers.standard_normal(2), u)
            F = np.array([
                [1.0, 0.0, -dt * u[0] * np.sin(x[2])], [0.0, 1.0, dt * u[0] * np.cos(x[2])],
                [0.0, 0.0, 1.0],
            ])
            far = np.hypot(x[0], x[1])
            H = np.array([
                [x[0] / far, x[1] / far, 0.0], [-x[1] / far**2, x[0] / far**2, -1.0],
            ])
            gain = true @ H.T @ np.linalg.inv(H @ true @ H.T + R)
            true = F @ (true - gain @ H @ true) @ F.T + Q
            x = f(x, u) + np.sqrt(np.diag(Q)) * numbers.standard_normal(3)
        along.append(np.sqrt(true[2, 2]))
        claims.append(np.sqrt(mhe.covariances()[-1, 2, 2]))
        error = estimate.state[2] - x[2]
        errors.append(np.arctan2(np.sin(error), np.cos(error)))
    return [{
        "least possible deviation (rad)": least, "along the true states": float(np.median(along)),
        "claimed (median)": float(np.median(claims)), "error (rms)": rms(errors),
    }]


def condensing(_: float = 1.0) -> Rows:
    """x+ = 2 x + w, y = x + v: the same window solved by stages, and with the states eliminated."""
    rows = []
    for N in (10, 20, 30, 40):
        numbers = np.random.default_rng(0)
        y = numbers.standard_normal(N)
        exact = _exact(y)
        system = linear(2.0 * np.eye(1), np.eye(1))
        mhe = qpmhe.MovingHorizonEstimator(
            system, qpmhe.Luenberger([[1.5]]), qpmhe.QuadraticCost(
                prior=1.0, disturbance=1.0, noise=1.0), horizon=N, initial_state=[0.0])
        for value in y:
            estimate = mhe.update([value])
        # States as a function of the first one and of the disturbances.
        lift = np.zeros((N + 1, N + 1))
        for k in range(N + 1):
            lift[k, : k + 1] = 2.0 ** (k - np.arange(k + 1))
        matrix, side = np.vstack((np.eye(N + 1), lift[:N])), np.append(np.zeros(N + 1), y)
        hessian = matrix.T @ matrix
        orthogonal, triangle = np.linalg.qr(matrix)
        unknowns = np.linalg.solve(triangle, orthogonal.T @ side)
        by_qr = lift @ unknowns
        try:
            factor = np.linalg.cholesky(hessian)
            unknowns = np.linalg.solve(factor.T, np.linalg.solve(factor, matrix.T @ side))
            by_cholesky = f"{_off(lift @ unknowns, exact):.0e}"
        except np.linalg.LinAlgError:
            by_cholesky = "not positive definite"
        rows.append({
            "N": N, "condition": f"{np.linalg.cond(matrix) ** 2:.0e}",
            "by stages (qpmhe)": f"{_off(estimate.trajectory[:, 0], exact):.0e}",
            "condensed, QR": f"{_off(by_qr, exact):.0e}", "condensed, Cholesky": by_cholesky,
        })
    return rows


def _exact(y: Array) -> Array:
    """The window's states in rational arithmetic: the normal equations of all states."""
    N = len(y)
    diagonal = [Fraction(6)] * N + [Fraction(1)]  # 1 of prior or disturbance, 1 of noise, 4 of f
    side = [Fraction(float(value)) for value in y] + [Fraction(0)]
    for k in range(1, N + 1):
        factor = Fraction(-2) / diagonal[k - 1]
        diagonal[k] += 2 * factor
        side[k] -= factor * side[k - 1]
    x = [side[N] / diagonal[N]]
    for k in range(N - 1, -1, -1):
        x.append((side[k] + 2 * x[-1]) / diagonal[k])
    return np.array([float(value) for value in reversed(x)])


def _off(found: Array, exact: Array) -> float:
    return float(np.abs(found - exact).max() / np.abs(exact).max())


TOPICS: dict[str, Callable[[float], Rows]] = {
    "bounds": bounds, "uniform": uniform, "projection": projection, "horizons": horizons,
    "smoothed": smoothed, "outliers": outliers, "missing": missing, "unobservable": unobservable,
    "consistency": consistency, "condensing": condensing,
}


def table(rows: Rows) -> str:
    """Rows as a table, numbers with three digits."""
    columns = list(rows[0])
    lines = [f"| {' | '.join(columns)} |", f"|{' --- |' * len(columns)}"]
    for row in rows:
        cells = (_cell(row[column]) for column in columns)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if isinstance(value, str | int):
        return str(value)
    return f"{value:.3g}"


def filled(page: str, name: str, text: str) -> str:
    """The page with a text between the markers of a name, which it must have once."""
    form = re.compile(rf"(<!-- fast:{name} -->\n).*?(<!-- end -->)", re.DOTALL)
    found, count = form.subn(lambda match: f"{match[1]}\n{text}\n\n{match[2]}", page)
    if count != 1:
        raise ValueError(f"the page has the markers of {name!r} {count} times; expected once.")
    return found


def main() -> int:
    """Run the studies and write their tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=TOPICS, nargs="+", default=list(TOPICS), metavar="NAME")
    parser.add_argument("--share", type=float, default=1.0, help="share of the records")
    parser.add_argument("--page", type=Path, default=PAGE)
    given = parser.parse_args()
    # Some of the observers are poor on purpose.
    warnings.simplefilter("ignore", qpmhe.ObserverWarning)
    warnings.simplefilter("ignore", qpmhe.PriorWarning)
    for name in given.only:
        text = table(TOPICS[name](given.share))
        print(f"{name}\n{text}", flush=True)
        page = filled(given.page.read_text(encoding="utf-8"), name, text)
        given.page.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
