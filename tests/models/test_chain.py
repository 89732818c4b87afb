"""The chain of masses: its forces and its derivatives."""

import numpy as np
import pytest

from qpmhe.models.chain import casadi_output, casadi_rate, chain_of_masses

MASS, STIFFNESS, LENGTH, DAMPING, GRAVITY, SPACING = 0.033, 1.0, 0.033, 0.04, 9.81, 0.25


def energy(x, masses, dimension):
    """By definition, with the squares of the rates of all links."""
    p, v = x.reshape(2, masses, dimension)
    still = np.zeros((1, dimension))
    end = still.copy()
    end[0, 0] = SPACING * (masses + 1)
    links = np.diff(np.vstack((still, p, end)), axis=0)
    rails = LENGTH if dimension == 1 else 0.0
    stretch = np.sqrt((links**2).sum(axis=1) + rails**2) - LENGTH
    height = p[:, -1].sum() if dimension > 1 else 0.0
    stored = 0.5 * STIFFNESS * (stretch**2).sum() + MASS * GRAVITY * height
    moves = np.diff(np.vstack((still, v, still)), axis=0)
    return 0.5 * MASS * (v**2).sum() + stored, (moves**2).sum()


@pytest.mark.parametrize(("masses", "dimension"), [(4, 1), (3, 2), (1, 3), (9, 3)])
def test_energy_is_lost_to_the_dampers_only_and_casadi_gives_the_same(masses, dimension):
    casadi = pytest.importorskip("casadi")
    system, _, _, scenario = chain_of_masses(masses, dimension)
    given, generator = system.__reduce__()[1][1], np.random.default_rng(5)
    rest, x = scenario.initial_estimate, casadi.SX.sym("x", system.n)
    # Random states, far from rest and from each other.
    points = rest + generator.uniform(0.1, 2.0, (20, 1)) * generator.standard_normal(
        (20, rest.size)
    )
    for point in points[:5]:
        direction = given["rate"](point)
        length, lost = np.linalg.norm(direction), DAMPING * energy(point, masses, dimension)[1]
        ends = (point + s * direction / length for s in (1e-6, -1e-6))
        ahead, behind = (energy(end, masses, dimension)[0] for end in ends)
        power = length * np.linalg.norm(point)
        assert length * (ahead - behind) / 2e-6 == pytest.approx(-lost, abs=1e-7 * power)
    expressions = [casadi_rate(masses, dimension)(x), casadi_output(masses, dimension)(x)]
    symbolic = casadi.Function(
        "expected", [x], [g for e in expressions for g in (e, casadi.jacobian(e, x))]
    )
    values = zip(*([np.array(one) for one in symbolic(point)] for point in points), strict=True)
    names = ("rate", "rate_jacobian", "h", "h_jacobian")
    for k, (name, expected) in enumerate(zip(names, values, strict=True)):
        expected = np.array(expected)[..., slice(None) if k % 2 else 0]
        tolerance = (1e-10 if k % 2 else 1e-12) * (1.0 + np.abs(expected).max())
        np.testing.assert_allclose(given[name](points), expected, rtol=0.0, atol=tolerance)
