"""Disturbances of lower dimension than the state, and singular covariances."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status, errors
from qpmhe.certificates import CertificateError
from qpmhe.certificates.audit import checked_ingredients

from . import spoil
from .spoil import check

A = np.array([[1.0, 0.1, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.8]])
C = np.array([[1.0, 0.0, 0.5]])
G = np.array([[0.1, 0.0], [1.0, 0.3], [0.0, 1.0]])
P, Q, R = np.diag([1.0, 2.0, 0.5]), np.array([[0.2, 0.05], [0.05, 0.1]]), np.array([[0.1]])
GAIN = np.array([[0.3], [0.2], [0.1]])
Y = np.random.default_rng(0).standard_normal((12, 1))


def f(x):
    return x @ A.T + 0.05 * np.sin(x)


def h(x):
    return x @ C.T


def system(matrix=G, **options):
    return qpmhe.System(f, h, n=3, p=1, disturbance_matrix=matrix, **options)


def cost(disturbance=Q):
    return qpmhe.QuadraticCost.from_covariances(prior=P, disturbance=disturbance, noise=R)


def kalman(disturbance=Q):
    return qpmhe.ExtendedKalman(prior=P, disturbance=disturbance, noise=R)


def estimator(model=None, observer=None, price=None, **options):
    options = {"horizon": 4, "initial_state": np.zeros(3), "max_qps": None} | options
    return spoil.estimator(
        model or system(), observer or qpmhe.Luenberger(GAIN), price or cost(), **options
    )


def test_the_bound_of_the_candidates_cost():
    """c(N) of docs/explanation/guarantees.md, in the norm of typical squares of the states."""
    roots = np.sqrt(np.maximum(P.diagonal(), np.diag(G @ Q @ G.T)))
    inverse = np.linalg.pinv(G / roots[:, None]) / roots
    L_f = np.linalg.norm(A * roots / roots[:, None], 2) + 0.05
    L_h = np.linalg.norm(C * roots, 2)
    c_w = np.linalg.norm(np.linalg.cholesky(np.linalg.inv(Q)).T @ inverse * roots, 2) ** 2
    c_v = 1.0 / R[0, 0]
    for N in (1, 2, 5, 12):
        S = sum(L_f**k for k in range(N - 1))
        c = 2.0 * max(c_w + (c_w * L_f**2 + c_v * L_h**2) * S**2, c_v)
        mhe = estimator(max_qps=0, horizon=N)
        for t, y in enumerate(Y):
            estimate = mhe.update(y)
            v = Y[max(0, t + 1 - N) : t + 1] - h(estimate.candidate[:-1])
            corrections = v @ GAIN.T / roots
            assert estimate.candidate_cost <= c * (np.sum(corrections**2) + np.sum(v**2))


@pytest.mark.parametrize("fixed", [0.0, 0.02])
def test_a_component_of_w_may_be_fixed(fixed):
    W = qpmhe.Box([-np.inf, fixed], [np.inf, fixed])
    mhe = estimator(system(disturbances=W), qpmhe.Luenberger(G @ [[0.2], [0.0]]))
    for y in Y:
        estimate = mhe.update(y)
        w = estimate.disturbances[:, 1]
        assert not estimate.improved or np.abs(w - fixed).max() <= 1e-13
    assert estimate.improved


@pytest.mark.parametrize("raises", [False, True])
def test_a_roll_out_that_fails_is_named(raises):
    def falling(x):
        if raises and (x[..., 0] < -2.5).any():
            raise ValueError("too low")
        return np.where(x[..., :1] < -2.5, np.nan, x - np.array([1.0, 0.0]))

    mhe = spoil.estimator(
        spoil.system_of(falling, disturbance_matrix=[[0.0], [1.0]]),
        qpmhe.Luenberger([[0.5], [0.0]]), spoil.cost_of(disturbance=1.0),
        horizon=6, initial_state=[0.0, 0.0],
    )
    estimate = [mhe.update(3.0) for _ in range(6)][-1]
    assert estimate.candidate_cost == np.inf
    assert np.isfinite(estimate.candidate).all()
    assert Status.MODEL_FAILED in estimate.status
    assert ("too low" if raises else "roll-out") in estimate.message


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("seed", [39, 72])
def test_where_no_step_from_the_observer_helps_the_search_goes_on_from_its_roll_out(seed):
    rng = np.random.default_rng(seed)
    a, bent, c = (rng.standard_normal((2, 2)) for _ in range(3))
    a *= 0.8 / np.abs(np.linalg.eigvals(a)).max()
    mhe = spoil.estimator(
        qpmhe.System(
            lambda x: x @ a.T + np.sin(x) @ bent.T, lambda x: x @ c.T, n=2, p=2,
            disturbance_matrix=[[1.0], [0.3]],
        ),
        qpmhe.Luenberger(0.5 * rng.standard_normal((2, 2))),
        spoil.cost_of(2, 2, disturbance=1.0), horizon=8, initial_state=[0.0, 0.0], max_qps=None,
    )
    for y in rng.standard_normal((30, 2)):
        estimate = mhe.update(y)
        assert estimate.improved
        assert estimate.cost < estimate.candidate_cost


def test_designed_gains_take_the_matrix():
    start = np.zeros(3)
    full = qpmhe.design_luenberger(system(None), start, disturbance=G @ Q @ G.T, noise=R).gain
    for design in (qpmhe.design_luenberger, qpmhe.SteadyStateKalman):
        found = design(system(), start, disturbance=Q, noise=R).gain
        np.testing.assert_allclose(found, full, rtol=1e-9)


def test_what_does_not_fit_is_refused():
    for matrix, kind, text in (
        ([1.0, 2.0, 3.0], errors.ShapeError, ["shape (3,)", "(3, r)", "column for each"]),
        ([[1e9, 2e-9], [1.0, 2e-18], [0.0, 0.0]], errors.ModelError, ["dependent", "rank 2"]),
        ([[1.0], [np.nan], [0.0]], errors.InvalidInputError, ["disturbance_matrix", "finite"]),
    ):
        check(kind, text, system, matrix)
    assert system(np.eye(3)).disturbance_matrix is None
    # Columns in units far apart are independent.
    assert system([[1e9, 0.0], [0.0, 1e-9], [1e9, 1e-9]]).r == 2
    check(errors.ShapeError, ["for 3 disturbances; expected 2"], estimator, price=cost(np.eye(3)))
    text = ["disturbance covariance has shape (3, 3)", "expected (2, 2)"]
    check(errors.ShapeError, text, estimator, observer=kalman(np.eye(3)))
    W = qpmhe.Box([-np.inf, 0.5, -np.inf], [np.inf, 0.5, np.inf])
    fixed, price = system(None, disturbances=W), cost(np.diag([0.2, 0.0, 0.1]))
    check(errors.SetError, ["component 1", "0.5", "variance"], estimator, fixed, price=price)
    assert "disturbance_covariance=[[0.2, 0. , 0. ]" in repr(price)
    mhe, text = estimator(system(None), price=price), ["disturbance_weight", "singular"]
    check(errors.OptionError, text, mhe.update, 0.1, disturbance_weight=np.eye(3))
    walk = qpmhe.System(lambda x: x, lambda x: x, n=2, p=2)
    noises = {"disturbance": np.diag([1.0, 0.0]), "noise": np.eye(2)}
    text = ["eigenvalue 1", "small variance"]
    check(errors.ModelError, text, qpmhe.design_luenberger, walk, [0.0, 0.0], **noises)
    for build in (cost, kalman):
        text = ["disturbance covariance", "semidefinite"]
        check(errors.WeightError, text, build, np.diag([1.0, -1e-9]))


def test_certificates_refuse_it_by_name():
    model = qpmhe.from_casadi(lambda x: x, lambda x: x, n=2, p=2, disturbance_matrix=[[1], [2]])
    parts = qpmhe.Luenberger(0.5 * np.eye(2)), spoil.cost_of(2, 2, disturbance=1.0)
    with pytest.raises(CertificateError, match="disturbance_matrix"):
        checked_ingredients(model, *parts)
