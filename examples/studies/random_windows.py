"""Converged sequences of QPs against Ipopt and Levenberg-Marquardt, from the same candidates.

``python -m examples.studies.random_windows`` prints the table of docs/how-to/failing-qps.md. A
window lies anywhere in a record of a model of the zoo. Its observer starts 1 to 10 standard
deviations of the prior away from the true state; the observer's states are the candidate, from
which all three begin. The peers get the same J from here, written down for CasADi by its
definition.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

import qpmhe

Array = NDArray[np.float64]
#: Two costs are the same where they differ by less than this share.
SAME = 1e-6
#: A point is stationary where a Gauss-Newton step promises to take less than this share off J.
STATIONARY = 1e-6
FARTHEST, RECORDS, MOST = 10, 20, 1000
OPTIONS = {
    "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10,
    "ipopt.max_iter": MOST, "ipopt.bound_relax_factor": 0.0, "show_eval_warnings": False,
}


class Program:
    """J = |r|^2 of a window of a model, as functions of its trajectory, and its minima by others.

    Parameters
    ----------
    example : qpmhe.models.Example
        A model without sets but bounds of states.
    """

    def __init__(self, example: qpmhe.models.Example) -> None:
        system, _, cost, scenario = example
        n, p, m, count = system.n, system.p, system.m, scenario.horizon
        step, self.shape = system.symbolic.step(), (count + 1, n)
        x, mean = ca.SX.sym("x", n, count + 1), ca.SX.sym("mean", n)
        y, u = ca.SX.sym("y", p, count), ca.SX.sym("u", m, count)
        roots = [
            ca.DM(np.linalg.cholesky(weight).T)
            for weight in (cost.prior, cost.disturbance, cost.noise)
        ]
        parts = [roots[0] @ wrapped(system.state_residual, x[:, 0] - mean)]
        for i in range(count):
            w = x[:, i + 1] - step(x[:, i], u[:, i], system.dt)
            v = y[:, i] - system.symbolic.h(x[:, i], u[:, i])
            parts.append(roots[1] @ wrapped(system.state_residual, w))
            parts.append(roots[2] @ wrapped(system.output_residual, v))
        z, r, data = ca.vec(x), ca.vertcat(*parts), ca.veccat(mean, y, u)
        self._residual = ca.Function("r", [z, data], [r])
        self._jacobian = ca.Function("J", [z, data], [ca.jacobian(r, z)])
        self._solve = ca.nlpsol("s", "ipopt", {"x": z, "p": data, "f": ca.sumsqr(r)}, OPTIONS)
        free = np.full(n, np.inf)
        box = system.states
        self.lower = np.tile(-free if box is None else box.lower, count + 1)
        self.upper = np.tile(free if box is None else box.upper, count + 1)

    def cost(self, x: Array, data: Array) -> float:
        """J of a trajectory; infinite where it is not finite."""
        r = self.residual(x, data)
        J = float(r @ r)
        return J if np.isfinite(J) else np.inf

    def residual(self, x: Array, data: Array) -> Array:
        """Weighted residuals; infinite where they are not finite."""
        r = np.array(self._residual(x.ravel(), data)).ravel()
        return r if np.isfinite(r).all() else np.full(r.shape, 1e150)

    def jacobian(self, x: Array, data: Array) -> Array:
        """The derivative of the residuals."""
        return np.array(self._jacobian(x.ravel(), data))

    def ipopt(self, x: Array, data: Array) -> Array:
        """The minimiser that Ipopt finds, with exact second derivatives."""
        found = self._solve(x0=x.ravel(), p=data, lbx=self.lower, ubx=self.upper)
        return np.clip(np.array(found["x"]).ravel(), self.lower, self.upper)

    def minpack(self, x: Array, data: Array) -> Array:
        """The minimiser that MINPACK finds; where states have bounds, SciPy's trust region."""
        bounded = np.isfinite(np.concatenate((self.lower, self.upper))).any()
        where = {"method": "trf", "bounds": (self.lower, self.upper)} if bounded else {
            "method": "lm"
        }
        found = least_squares(
            lambda z: self.residual(z, data), x.ravel(), lambda z: self.jacobian(z, data),
            x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-14, max_nfev=MOST, **where,
        )
        return np.asarray(found.x)

    def left(self, x: Array, data: Array) -> float:
        """The scaled gradient: the share of J that a Gauss-Newton step promises to take off.

        Components at a bound towards which J falls do not move.
        """
        r, slopes = self.residual(x, data), self.jacobian(x, data)
        x, gradient = x.ravel(), slopes.T @ r
        free = ~(((x <= self.lower) & (gradient > 0)) | ((x >= self.upper) & (gradient < 0)))
        part = slopes[:, free]
        step = np.linalg.lstsq(part / np.linalg.norm(part, axis=0), r, rcond=1e-13)[0]
        gained = part / np.linalg.norm(part, axis=0) @ step
        return float(gained @ gained / (r @ r))


def wrapped(angles: Any, difference: Any) -> Any:
    """A difference whose angles are the shortest."""
    if angles is not None:
        for j, period in zip(angles.components.tolist(), angles.periods.tolist(), strict=True):
            difference[j] -= period * ca.floor(difference[j] / period + 0.5)
    return difference


@dataclass(frozen=True, eq=False)
class Compared:
    """A window: how far its start was, J of all results, and two scaled gradients.

    ``claimed`` is what the estimator says of ours. ``left`` is the scaled gradient of our result,
    ``theirs`` that of the better one of the others.
    """

    number: int
    distance: int
    candidate: float
    claimed: float
    ours: float
    ipopt: float
    minpack: float
    left: float
    theirs: float
    qps: int
    status: str

    @property
    def verdict(self) -> str:
        """How our cost compares with the best of the others."""
        best = min(self.ipopt, self.minpack)
        if not np.isfinite(self.candidate):
            return "no candidate"
        if self.ours < best * (1.0 - SAME):
            return "below"
        if self.ours <= best * (1.0 + SAME):
            return "same"
        if self.left <= STATIONARY:
            return "other"
        return "short" if self.theirs <= STATIONARY else "none"


def windows(
    example: qpmhe.models.Example, accepts: Callable[[Array], bool], count: int, seed: int
) -> Iterator[tuple[Any, ...]]:
    """Random windows: number, distance of the start in deviations, measurements, inputs.

    The direction is drawn again where the start is outside of X, or the observer does not accept
    it: some are not stable everywhere.
    """
    system, _, cost, scenario = example
    rng, records = np.random.default_rng(seed), {}
    deviations = np.linalg.inv(np.linalg.cholesky(cost.prior)).T
    for number in range(count):
        one = number % RECORDS
        if one not in records:
            records[one] = scenario.simulate(1000 * seed + one)
        record, distance = records[one], 1 + number % FARTHEST
        first = int(rng.integers(len(record.measurements) - scenario.horizon + 1))
        for _ in range(1000):
            away = rng.standard_normal(system.n)
            start = record.states[first] + distance * deviations @ (away / np.linalg.norm(away))
            if (system.states is None or not system.states.violation(start)) and accepts(start):
                break
        else:
            continue
        part = slice(first, first + scenario.horizon)
        us = np.zeros((scenario.horizon, 0)) if record.inputs is None else record.inputs[part]
        yield number, distance, record.measurements[part], us


def _starts(mhe: qpmhe.MovingHorizonEstimator, start: Array) -> bool:
    """Start an estimator anew, if its observer can start there."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", qpmhe.ModelWarning)
        try:
            mhe.reset(start)
        except qpmhe.errors.ModelError:
            return False
    return True


def compared(
    example: qpmhe.models.Example, chosen: Collection[int], seed: int = 0
) -> Iterator[Compared]:
    """Our converged cost, and that of the others from the same candidate, for some windows."""
    program, (system, observer, cost, scenario) = Program(example), example
    made = [
        qpmhe.MovingHorizonEstimator(
            system, observer, cost, horizon=scenario.horizon, max_qps=cap, engine="python",
            initial_state=scenario.initial_estimate,
        )
        for cap in (0, MOST)
    ]
    accepts = partial(_starts, made[0])
    for number, distance, ys, us in windows(example, accepts, max(chosen) + 1, seed):
        if number not in chosen:
            continue
        given = [(y, u) if system.m else (y,) for y, u in zip(ys, us, strict=True)]
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # of starts that are far away, which is the point
            for sample in given[:-1]:
                made[0].update(*sample)
            made[1].load_state_dict(made[0].state_dict())
            estimate = made[1].update(*given[-1])
            candidate = estimate.candidate
            data = np.concatenate((candidate[0], ys.ravel(), us.ravel()))
            known = np.isfinite(estimate.candidate_cost)
            found = _judged(program, estimate, data) if known else (np.inf,) * 7
        yield Compared(number, distance, *found, estimate.qps, str(estimate.status))


def _judged(program: Program, estimate: Any, data: Array) -> tuple[float, ...]:
    candidate, found = estimate.candidate, estimate.trajectory
    others = []
    for way in (program.ipopt, program.minpack):
        try:
            others.append(way(candidate, data))
        except (RuntimeError, ValueError):  # where the model is not finite
            others.append(candidate)
    costs = [program.cost(x, data) for x in (candidate, found, *others)]
    best = others[int(np.argmin(costs[2:]))]
    costs.insert(1, estimate.cost)
    return *costs, program.left(found, data), program.left(best, data)


VERDICTS = {
    "same": "the same J", "below": "a lower one", "other": "another stationary point",
    "short": "above a stationary point", "none": "nobody at one",
}


def row(model: str, found: Sequence[Compared]) -> list[str]:
    """A model's line of the table: windows by their verdicts, the others' windows, and QPs."""
    found = [one for one in found if one.verdict != "no candidate"]
    verdicts = [one.verdict for one in found]
    numbers = [len(found), *(verdicts.count(name) for name in VERDICTS)]
    least = [min(one.ours, one.ipopt, one.minpack) * (1.0 + SAME) for one in found]
    for name in ("ipopt", "minpack"):
        at = [getattr(one, name) <= J for one, J in zip(found, least, strict=True)]
        numbers += [sum(at)]
    qps = [one.qps for one in found]
    return [model, *map(str, numbers), f"{np.median(qps):g}", str(max(qps))]


HEAD = ("model", "windows", *VERDICTS.values(), "Ipopt at the lowest", "MINPACK at the lowest",
        "QPs, median", "QPs, most")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="*", metavar="NAME", help="models of the zoo; all")
    parser.add_argument("--windows", type=int, default=200, help="windows of each")
    parser.add_argument("--seed", type=int, default=0, help="of windows and records")
    parser.add_argument("--show", action="store_true", help="windows that are not the same")
    given = parser.parse_args(arguments)
    print(f"| {' | '.join(HEAD)} |\n|{' --- |' * len(HEAD)}", flush=True)
    catalogue = qpmhe.models.catalogue()
    for name in given.models or catalogue:
        found = list(compared(catalogue[name](), range(given.windows), given.seed))
        print(f"| {' | '.join(row(name, found))} |", flush=True)
        if given.show:
            for one in found:
                if one.verdict not in ("same", "below"):
                    print(one.verdict, one, file=sys.stderr, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
