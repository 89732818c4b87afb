"""Certificates of systems with a disturbance_matrix: sizes are of w, by closed forms."""

import json

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates import (
    Evidence,
    Monitor,
    Sizes,
    certify,
    certify_detectability,
    certify_observer,
)
from qpmhe.certificates.inequalities import congruence
from qpmhe.certificates.measured_cost import MeasuredCost
from qpmhe.certificates.observer_bound import bound_observer
from qpmhe.errors import ShapeError

from .helpers import box, linear, unit_box

STEPS = 300  # after which all that acted has decayed
T = 10.0  # seconds between two scans


def spun(n, seed):
    """A matrix with the spectral radius 0.9, turned."""
    A = np.random.default_rng(seed).standard_normal((n, n))
    return 0.9 * A / np.abs(np.linalg.eigvals(A)).max()


# A, G and the gain: n > r in usual units and in odd ones, and a G that has as many columns.
CASES = {
    "radar": (
        np.array([[1.0, T], [0.0, 1.0]]), np.array([[T * T / 2], [T]]), np.array([[1.2], [0.05]])
    ),
    "odd units": (spun(4, 1), np.eye(4)[:, :2] @ np.diag([1e-3, 1e4]), np.zeros((4, 1))),
    "square": (spun(2, 2), 25.0 * np.array([[0.6, -0.8], [0.8, 0.6]]), 0.1 * np.ones((2, 1))),
}
SIZES = {"radar": [0.1], "odd units": [2e3, 3e-4], "square": [0.02, 0.01]}


def made(name):
    A, G, gain = CASES[name]
    system = linear(A, np.eye(1, len(A)), disturbance_matrix=G)
    wide = 1e6 * np.ones(len(A))
    return system, gain, np.array(SIZES[name]), box(-wide, wide)


def responses(name):
    """E^k G and E^k L, (K, n, r) and (K, n, p), of the error e+ = E e + G w - L v."""
    A, G, gain = CASES[name]
    E, found = A - gain @ np.eye(1, len(A)), [np.eye(len(A))]
    for _ in range(STEPS - 1):
        found.append(E @ found[-1])
    return np.array(found) @ G, np.array(found) @ gain


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("kind", ["box", "length"])
def test_the_bound_is_above_the_reachable_error_and_near_it(name, kind):
    """With |w_j| <= d_j the largest e_i is the sum of |E^k G|_ij d_j; with |w| <= d, of norms."""
    system, gain, d, region = made(name)
    H, K = responses(name)
    noise = 0.5
    if kind == "box":
        w, most = box(-d, d), np.abs(H) @ d
    else:
        w, most = float(d.max()), np.linalg.norm(H, axis=2) * d.max()
    reachable = most.sum(axis=0) + np.abs(K).sum(axis=(0, 2)) * noise
    bound = bound_observer(
        system, qpmhe.Luenberger(gain), qpmhe.QuadraticCost(
            prior=np.eye(system.n), disturbance=np.diag(1.0 / d**2), noise=4.0
        ), region, sizes=Sizes(w, noise),
    )
    assert bound.evidence is Evidence.PROVED
    ratio = bound.components(bound.limit()) / reachable
    assert (ratio >= 1.0).all()
    # The worst of all disturbances is another for each component; one P serves them all.
    assert ratio.max() < 2.0
    # From no error on, the worst w and v of each component, sample by sample.
    radii = bound.radii(STEPS, 0.0)
    for i in range(system.n):
        row = H[::-1, i]
        worst = d * np.sign(row) if kind == "box" else d.max() * row / (
            np.linalg.norm(row, axis=1, keepdims=True) + np.finfo(float).tiny
        )
        pushed = noise * np.sign(K[::-1, i])
        A, G, _ = CASES[name]
        E, e = A - gain @ np.eye(1, system.n), np.zeros(system.n)
        for t in range(STEPS):
            e = E @ e + G @ worst[t] + gain @ pushed[t]
            assert float(bound.length(e)) <= radii[t + 1] * (1.0 + 1e-9)
        assert e[i] == pytest.approx(reachable[i], rel=1e-6)
        # The sums of (eq:RGES), for the lengths that acted.
        sums = bound.stability.sums.bound(
            0.0, np.linalg.norm(worst, axis=1), np.abs(pushed[:, 0])
        )
        assert np.linalg.norm(e) <= sums[-1]


@pytest.mark.slow
def test_no_true_state_leaves_the_box_of_the_monitor():
    system, gain, d, region = made("radar")
    H, K = responses("radar")
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=[[1.0 / d[0] ** 2]], noise=4.0)
    certificate = certify(
        system, qpmhe.Luenberger(gain), cost, horizon=5, region=region, sizes=Sizes(d[0], 0.5)
    )
    A, G, _ = CASES["radar"]
    for i in range(2):
        mhe = qpmhe.MovingHorizonEstimator(
            system, certificate.observer, cost, horizon=5, initial_state=[0.0, 0.0], max_qps=1
        )
        watch, x, steps, near = Monitor(certificate, mhe, initial_error=0.0), np.zeros(2), 60, 0.0
        for k in range(steps):
            y = x[:1] - 0.5 * np.sign(K[steps - 1 - k, i])
            reading = watch.check(mhe.update(y))
            x = A @ x + G @ (d * np.sign(H[steps - 1 - k, i]))
            assert reading.lost is None
            assert ((reading.lower <= x) & (x <= reading.upper)).all()
            middle, half = 0.5 * (reading.upper + reading.lower), reading.upper - reading.lower
            near = max(near, np.abs(x - middle)[i] / (0.5 * half[i]))
        assert near > 0.8  # it comes near the side


def test_the_systems_w_counts_where_sizes_are_left_out():
    A, G, gain = CASES["radar"]
    W, V, region = box(-0.1, 0.1), box(-0.5, 0.5), box([-2000.0, -200.0], [2000.0, 200.0])
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=[[9.0]], noise=4.0)
    found = {}
    for name, sets, sizes in (
        ("own", {"disturbances": W, "noises": V}, None), ("stated", {}, Sizes(W, V)),
        ("weights", {}, None),
    ):
        system = linear(A, np.eye(1, 2), disturbance_matrix=G, **sets)
        certificate = certify(
            system, qpmhe.Luenberger(gain), cost, horizon=5, region=region, sizes=sizes
        )
        found[name] = certificate.observer_bound
        text = str(certificate)
        assert "disturbance_matrix" in str(certificate.errors["the theorem"])
        assert text.startswith("|x1 - z1| <= ")
        assert "not proved that x stays in the region: f and the disturbances reach x1 = " in text
        json.dumps(certificate.to_dict(), allow_nan=False)
    assert "the system's W and the system's V" in str(found["own"].sizes)
    assert found["own"].limit() == pytest.approx(found["stated"].limit(), rel=1e-9)
    # Three standard deviations of w, not of G w.
    np.testing.assert_allclose(found["weights"].sizes.disturbance.upper, [1.0], rtol=1e-12)
    # A singular covariance: w has the zero width there.
    spread = np.array([[0.04, 0.0], [0.0, 0.0]])
    singular = qpmhe.QuadraticCost.from_covariances(
        prior=np.eye(2), disturbance=spread, noise=[[0.25]]
    )
    sizes = Sizes.of(None, linear(A, np.eye(1, 2)), singular)
    np.testing.assert_allclose(sizes.disturbance.upper, [0.6, 0.0], rtol=1e-12)


def test_the_region_is_examined_for_g_w():
    system = linear(0.5 * np.eye(2), np.eye(1, 2), disturbance_matrix=[[1.0], [2.0]])
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=[[1.0]], noise=1.0)
    for size, stays in ((0.24, True), (0.26, False)):  # 0.5 + 2 |w| <= 1
        certificate = certify(
            system, qpmhe.Luenberger([[0.1], [0.0]]), cost, horizon=2, region=unit_box(2),
            sizes=Sizes(box(-size, size), 0.1),
        )
        assert certificate.observer_bound.invariance.holds is stays


@pytest.mark.slow
def test_detectability_and_the_measured_cost_take_w():
    """x1 - x2 of two trajectories with the same outputs is what G w makes, and no more."""
    G = np.array([[30.0], [40.0]])
    system = linear(0.5 * np.eye(2), np.zeros((1, 2)), disturbance_matrix=G)
    found = certify_detectability(system, unit_box(2), eta=0.6)
    np.testing.assert_allclose(found.W, G.T @ found.P @ G, rtol=1e-12)
    # |G w| = 50 |w|, which lasts: the difference tends to 100 |w|.
    limit = found.sums.limit(0.01, 0.0)
    assert 1.0 <= limit <= 1.6
    stability = certify_observer(system, qpmhe.Luenberger([[0.0], [0.0]]), unit_box(2), rho=0.6)
    assert 1.0 <= stability.sums.limit(0.01, 0.0) <= 1.6
    bound = bound_observer(
        system, qpmhe.Luenberger([[0.0], [0.0]]),
        cost := qpmhe.QuadraticCost(prior=np.eye(2), disturbance=[[1e4]], noise=1.0), unit_box(2),
        sizes=Sizes(0.01, 0.1),
    )
    measured = MeasuredCost(found, cost, bound, Sizes(0.01, 0.1), np.eye(2))
    # The truth is 1 away after long; J = 0 says that the estimate had no disturbance.
    assert measured.error(0.0, 60, 0.0) >= 1.0


def test_sets_of_another_dimension_are_refused_by_name():
    system, gain, _, region = made("radar")
    cost = qpmhe.QuadraticCost(prior=np.eye(2), disturbance=[[1.0]], noise=1.0)
    two = box([-1.0, -1.0], [1.0, 1.0])
    for sizes, words in (
        (Sizes(two, 1.0), r"disturbance \(as stated\) is a set of dimension 2; expected 1, as .* w,"
                          " which its disturbance_matrix takes"),
        (Sizes(1.0, two), "noise .* of dimension 2; expected 1, as the system's v has"),
    ):
        with pytest.raises(ShapeError, match=words):
            certify(system, qpmhe.Luenberger(gain), cost, horizon=2, region=region, sizes=sizes)
    bound = bound_observer(
        system, qpmhe.Luenberger(gain), cost, region, sizes=Sizes(0.1, 0.1)
    )
    for given in (two, np.zeros((3, 2))):  # G w in place of w
        with pytest.raises(ShapeError, match=r"disturbances .*; expected"):
            bound.entering(given)


@pytest.mark.parametrize("unit", [1.0, 1e-7, 1e9])
def test_the_weight_of_w_is_outward_and_tight_in_any_unit(unit):
    rng = np.random.default_rng(0)
    for n, r in ((1, 1), (4, 2), (6, 6)):
        root, G = rng.standard_normal((n, n)), rng.standard_normal((n, r))
        G = G * unit ** np.linspace(0.0, 1.0, r)
        P = root @ root.T + np.eye(n)
        W, exact = congruence(P, G), G.T.astype(np.longdouble) @ P @ G
        scale = 1.0 / np.sqrt(W.diagonal())
        rest = np.outer(scale, scale) * (W - exact).astype(float)
        assert np.linalg.eigvalsh(0.5 * (rest + rest.T))[0] > 0.0
        assert np.abs(rest).max() < 1e-12
