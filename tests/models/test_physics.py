"""What each model must do by its physics, found by other means than its own equations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from qpmhe import models

NONE = np.zeros(0)


def rate_of(system):
    return system.__reduce__()[1][1]["rate"]


def states(count, n, low=-1.0, high=1.0, seed=11):
    return np.random.default_rng(seed).uniform(low, high, (count, n))


def test_van_der_pols_limit_cycle():
    system = models.van_der_pol().system
    x = [np.array([2.0, 0.0])]
    for _ in range(2000):
        x.append(system.f(x[-1], NONE))
    first = np.array(x)[1000:, 0]
    up = np.flatnonzero((first[:-1] < 0.0) & (first[1:] >= 0.0))
    crossings = up - first[up] / (first[up + 1] - first[up])
    # Period and amplitude for mu = 1.
    assert np.diff(crossings).mean() * system.dt == pytest.approx(6.6633, abs=2e-3)
    assert first.max() == pytest.approx(2.0086, abs=3e-3)


def test_the_tank_reactors_known_steady_state():
    system = models.cstr().system
    rate, x, u = rate_of(system), np.array([0.5, 350.0]), np.array([300.0])
    # Published to three digits: k(350) = 0.99992 1/min.
    assert np.all(np.abs(rate(x, u)) < [1e-4, 0.02])
    slope = system.__reduce__()[1][1]["rate_jacobian"](x)
    assert np.linalg.eigvals(slope).real.max() > 1.0
    # Mass and heat: what reacts heats by -dH / (rho C_p) a mole.
    for y in np.array([[0.2, 330.0], [0.7, 365.0]]):
        burnt = 1.0 - y[0] - rate(y, u)[0]
        other = 350.0 - y[1] + 50000.0 / 23900.0 * (u[0] - y[1])
        assert rate(y, u)[1] - other == pytest.approx(50000.0 / 239.0 * burnt, rel=1e-12)
        assert burnt / y[0] == pytest.approx(np.exp(np.log(7.2e10) - 8750.0 / y[1]), rel=1e-12)


def test_the_pendulum_loses_energy_to_its_damper_and_its_encoder_counts():
    _, _, _, scenario = models.pendulum()
    rate = rate_of(scenario.system)

    def energy(x):
        return 0.5 * x[1] ** 2 - 9.81 / 0.5 * np.cos(x[0])

    for x in states(20, 2, -3.0, 3.0):
        step = 1e-6 * rate(x)
        power = (energy(x + step) - energy(x - step)) / 2e-6
        assert power == pytest.approx(-0.2 * x[1] ** 2, abs=1e-7)
    counts = scenario.simulate(0).measurements[:, 0] / (2.0 * np.pi / 64)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.unique(np.round(counts)).size > 20


def test_the_vehicle_sees_the_beacons_and_drives_on_arcs():
    system, _, _, scenario = models.vehicle()
    record = scenario.simulate(0)
    position = record.states[:, 0] + 1j * record.states[:, 1]
    beacons = np.array([9.0 - 5.0j, 10.0 + 6.0j])
    seen = (beacons - position[:, None]) * np.exp(-1j * record.states[:, 2:])
    y = system.h.batch(record.states, np.zeros((len(position), 2)))
    np.testing.assert_allclose(y[:, :2], np.abs(seen), rtol=1e-12)
    np.testing.assert_allclose(np.exp(1j * (y[:, 2:] - np.angle(seen))), 1.0, atol=1e-12)
    # Heading and bearings are recorded in one turn, in which they jump; no beacon comes near.
    for angle in (record.states[:, 2], *record.measurements[:, 2:].T):
        assert -np.pi <= angle.min() <= angle.max() < np.pi
        assert (np.abs(np.diff(angle)) > np.pi).any()
    assert y[:, :2].min() > 3.0
    x, u = np.array([1.0, -2.0, 0.3]), np.array([1.5, 0.8])
    arc = 1.5 / 0.8 * np.array([
        np.sin(0.3 + 0.16) - np.sin(0.3), np.cos(0.3) - np.cos(0.3 + 0.16)
    ])
    np.testing.assert_allclose(system.f(x, u)[:2], x[:2] + arc, atol=1e-7)


def test_the_quadrotor_is_a_rigid_body_and_stays_in_flight():
    system, _, _, scenario = models.quadrotor()
    rate, mass, inertia = rate_of(system), 0.65, np.diag([7.5e-3, 7.5e-3, 1.3e-2])
    for x, u in zip(states(20, 12), states(20, 4, seed=12), strict=True):
        found = rate(x, u)
        body = Rotation.from_euler("ZYX", x[[8, 7, 6]])
        np.testing.assert_array_equal(found[:3], x[3:6])
        force = body.apply([0.0, 0.0, u[0]]) - [0.0, 0.0, 9.81 * mass]
        np.testing.assert_allclose(mass * found[3:6], force, atol=1e-13)
        # The angles' rates turn the body as its own rates do.
        step = 1e-6
        before, after = (
            Rotation.from_euler("ZYX", (x[6:9] + sign * step * found[6:9])[::-1])
            for sign in (-1.0, 1.0)
        )
        turned = (before.inv() * after).as_rotvec() / (2.0 * step)
        np.testing.assert_allclose(turned, x[9:], atol=1e-8)
        moment = inertia @ found[9:] + np.cross(x[9:], inertia @ x[9:])
        np.testing.assert_allclose(moment, u[1:], atol=1e-14)
    X = scenario.simulate(0, 600).states
    assert X[:, 2].min() > 0.5
    assert np.abs(X[:, 6:8]).max() < 0.6
    # It circles: after a whole turn it is near where it was.
    turn = round(2.0 * np.pi / scenario.dt)
    assert np.linalg.norm(X[turn:, :2] - X[:-turn, :2], axis=1).max() < 1.0 < np.ptp(X[:, 0])


def test_the_cell_is_its_circuit():
    system = models.battery_cell().system
    r, c = np.array([0.04669, 0.04984]), np.array([703.6, 4475.0])
    x, current, rest = np.array([0.6, 0.01, -0.02]), np.array([-0.7]), np.array([0.0])
    for step in range(1, 61):
        x = system.f(x, current)
        fading = np.exp(-5.0 * step / (r * c))
        exact = fading * [0.01, -0.02] + (1.0 - fading) * r * current
        np.testing.assert_allclose(x[1:], exact, atol=1e-7)
        assert x[0] == pytest.approx(0.6 - 0.7 * 5.0 * step / (3600.0 * 0.85), abs=1e-12)
    assert system.h(x, current)[0] < system.h(np.array([x[0], 0.0, 0.0]), rest)[0]
    charge = np.zeros((101, 3))
    charge[:, 0] = np.linspace(0.0, 1.0, 101)
    ocv = system.h.batch(charge, np.zeros((101, 1)))[:, 0]
    assert ocv[[0, -1]] == pytest.approx([2.654, 4.1029], abs=1e-6)
    assert np.all(np.diff(ocv) > 0.0)
