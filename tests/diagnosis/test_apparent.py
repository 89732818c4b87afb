"""Information that the points of linearisation seem to give."""

import numpy as np
import pytest

import qpmhe
from qpmhe.diagnosis.apparent import apparent_information
from qpmhe.diagnosis.bank import FilterBank, Hypothesis

P0, Q = np.diag([16.0, 16.0, 0.1225]), 1e-4 * np.eye(3)
SPREADS = np.array([0.2, 0.05, 0.2])


def unicycle(x, u):
    heading, v = x[..., 2], 0.1 * u[..., 0]
    moved = np.stack([v * np.cos(heading), v * np.sin(heading), 0.1 * u[..., 1]], axis=-1)
    return x + moved


def beacon(x):
    """Range and bearing of a beacon at the origin: turning all about it changes neither."""
    distance = np.sqrt(x[..., 0] ** 2 + x[..., 1] ** 2)
    return np.stack([distance, np.arctan2(-x[..., 1], -x[..., 0]) - x[..., 2]], axis=-1)


def beacons(x):
    second = np.sqrt((x[..., 0] - 10.0) ** 2 + x[..., 1] ** 2)
    return np.concatenate([beacon(x), second[..., None]], axis=-1)


def simulated(h, steps=200, seed=0):
    generator, spreads = np.random.default_rng(seed), SPREADS[: len(h(np.ones(3)))]
    x, system = np.array([5.0, 0.0, 1.2]), qpmhe.System(
        unicycle, h, n=3, p=len(spreads), m=2, output_residual=qpmhe.angles(1))
    start = x + np.sqrt(P0.diagonal()) * generator.standard_normal(3)
    y, u = [], [[1.0, 0.2 + 0.3 * np.sin(0.05 * t)] for t in range(steps)]
    for t in range(steps):
        y.append(h(x) + spreads * generator.standard_normal(len(spreads)))
        x = unicycle(x, np.array(u[t])) + 0.01 * generator.standard_normal(3)
    return system, np.array(y), np.array(u), start, np.diag(spreads**2)


def judged(system, y, u, start, noise, disturbance=Q, prior=P0):
    bank = FilterBank(system, None)
    found = bank.run([Hypothesis(y, u, noise, disturbance, start, prior)])
    return apparent_information(bank, found, u, noise, prior)


def test_turning_about_the_only_beacon_seems_to_be_seen_and_a_second_one_shows_it():
    growth, direction = judged(*simulated(beacon))
    assert growth > 4.0
    assert abs(direction[2]) > 0.1
    assert judged(*simulated(beacons)) is None


@pytest.mark.parametrize(("factor", "vague", "turned"), [
    (1.0, 1.0, True), (1e6, 1.0, False), (1.0, 1e5, True), (1.0, 1e10, False)])
def test_a_linear_filter_invents_nothing_in_any_unit(factor, vague, turned):
    """Of two integrators and a state that decays, the output shows the difference of two."""
    generator = np.random.default_rng(0)
    axes = np.linalg.qr(generator.standard_normal((3, 3)))[0] if turned else np.eye(3)
    a, c = axes @ np.diag([1.0, 1.0, 0.7]) @ axes.T, np.array([[1.0, -1.0, 0.0]]) @ axes.T
    system = qpmhe.System(lambda x: x @ a.T, lambda x: x @ c.T / factor, n=3, p=1)
    y, known = generator.standard_normal((80, 1)), np.diag([1.0, 4.0, 9.0]) * factor**2
    found = judged(system, y, np.zeros((80, 0)), np.zeros(3), np.eye(1), 1e-3 * known,
                   vague**2 * known)
    if vague > 1e9:  # no digits are left
        assert found is None
        return
    growth, direction = found
    assert 0.9 < growth <= 1.0 + 1e-3
    assert np.isfinite(direction).all()


def test_the_finding_says_that_covariances_are_too_small():
    system, y, u, start, noise = simulated(beacon, seed=3)
    mhe = qpmhe.MovingHorizonEstimator(
        system, qpmhe.ExtendedKalman(prior=P0, disturbance=Q, noise=noise),
        qpmhe.QuadraticCost.from_covariances(disturbance=Q, noise=noise), horizon=5,
        initial_state=start, max_qps=0,
    )
    found = qpmhe.diagnose(mhe.run(y, u), labels=["east", "north", "heading"])
    (one,) = [one for one in found.findings if one.kind == "apparent"]
    assert "its standard deviation there is too small by a factor of" in one.text
    assert "east" in one.text or "north" in one.text
    assert one.severity == "warning"
