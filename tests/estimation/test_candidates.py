"""The prior's mean at the former estimate; `properties/independent.py` has the other candidates."""

import warnings

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler

from .plain import spd
from .systems import swing

ENGINES = ["python"] + (["compiled"] if find_compiler() else [])
GENERATOR = np.random.default_rng(1)
P, Q, R = 0.05 * spd(GENERATOR, 2), 5.0 * spd(GENERATOR, 2), spd(GENERATOR, 1)
START, HORIZON, LATE = np.array([2.0, -1.0]), 6, 12


def seen(x):
    return x[..., :1] + 0.05 * x[..., 1:] ** 2


def record(count):
    generator, x, ys = np.random.default_rng(5), np.array([0.3, 0.8]), []
    for _ in range(count):
        ys.append(seen(x) + 0.05 * generator.standard_normal(1))
        x = swing(x) + 0.01 * generator.standard_normal(2)
    return ys


@pytest.mark.parametrize("options", [
    {}, {"warm_start": True, "candidate": "reinitialized"},
], ids=["observer", "reinitialized"])
def test_ipopt_with_the_prior_update_of_other_toolboxes(options):
    """Their prior is x[1] of the solution before, Ipopt's own; costs and states agree.

    Late measurements and weights that are set keep the prior of the window.
    """
    ca = pytest.importorskip("casadi")
    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.tol": 1e-11}

    def program(count):
        x, y, before = ca.SX.sym("x", 2, count + 1), ca.SX.sym("y", 1, count), ca.SX.sym("b", 2)
        weights = ca.SX.sym("r", 1, count)
        cost = (x[:, 0] - before).T @ ca.DM(P) @ (x[:, 0] - before)
        for i in range(count):
            a, b = x[0, i], x[1, i]
            w = x[:, i + 1] - ca.vertcat(a + 0.2 * b, 0.9 * b - 0.2 * ca.sin(a))
            cost += w.T @ ca.DM(Q) @ w + weights[i] * (y[0, i] - (a + 0.05 * b**2)) ** 2
        given = ca.vertcat(before, ca.vec(y), ca.vec(weights))
        return ca.nlpsol("mhe", "ipopt", {"x": ca.vec(x), "p": given, "f": cost}, quiet)

    programs = [program(count) for count in range(1, HORIZON + 1)]
    prior, solution, data, weights, usual = np.array(START), None, [], [], float(R[0, 0])
    mhe = qpmhe.MovingHorizonEstimator(
        qpmhe.System(swing, seen, n=2, p=1), qpmhe.Luenberger([0.02, 0.01]),
        qpmhe.QuadraticCost(prior=P, disturbance=Q, noise=R), horizon=HORIZON,
        initial_state=START, max_qps=None, tolerance=1e-14, arrival="smoothed", **options,
    )

    def check(estimate):
        parameters = np.concatenate((prior, np.ravel(data), weights))
        found = programs[len(data) - 1](x0=estimate.candidate.ravel(), p=parameters)
        solution = np.array(found["x"]).reshape(-1, 2)
        assert estimate.cost == pytest.approx(float(found["f"]), rel=1e-6)
        np.testing.assert_allclose(estimate.trajectory, solution, atol=1e-5)
        return solution

    for t, y in enumerate(record(20)):
        if len(data) == HORIZON:
            prior = solution[1]
            del data[0], weights[0]
        # What comes late has no weight until then.
        data.append(y)
        weights.append(0.0 if t == LATE else usual)
        solution = check(mhe.update(None if t == LATE else y))
        if t == LATE + 1:
            weights[-2] = weights[-1]
            solution = check(mhe.amend(LATE, data[-2]))
            weights, usual = [3.0 * one for one in weights], 3.0 * usual
            solution = check(mhe.set(noise_weight=3.0 * R))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("observer", [
    qpmhe.Luenberger([[0.3]]),
    qpmhe.ExtendedKalman(prior=[[1.0]], disturbance=[[0.1]], noise=[[0.1]]),
], ids=["constant gain", "extended"])
def test_a_reinitialized_candidate_starts_in_the_states_of_its_own_sample(observer, engine):
    """The estimate that it starts from was made before the sample brought its X."""
    system = qpmhe.System(
        lambda x: 0.9 * x, lambda x: x, n=1, p=1, states=qpmhe.Box([-10.0], [np.inf])
    )
    cost = qpmhe.QuadraticCost(prior=[[1.0]], disturbance=[[10.0]], noise=[[10.0]])
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, cost, horizon=3, initial_state=[1.0], candidate="reinitialized",
        engine=engine,
    )
    rng, lower = np.random.default_rng(0), []
    for t in range(20):
        lower.append(0.3 if t % 4 == 1 else -10.0)
        own = {"bounds": {"states": qpmhe.Box([lower[t]], [np.inf])}} if t % 4 == 1 else {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", qpmhe.ObserverWarning)
            found = mhe.update([0.3 * rng.standard_normal() - 0.4], **own)
        least = [*lower[-len(found.candidate) + 1 :], lower[-1]]
        assert (found.candidate[:, 0] >= least).all()
        assert qpmhe.Status.CANDIDATE_OUTSIDE not in found.status
        assert (found.trajectory[:, 0] >= least).all()
