"""Converged J with angles that wrap against Ipopt's, on random problems."""

import numpy as np
import pytest

import qpmhe
from qpmhe.codegen.compiler import find_compiler
from qpmhe.studies.ipopt import IpoptEstimator

ca = pytest.importorskip("casadi")

PI = np.pi
SETS = {
    "free": {},
    "X": {"states": qpmhe.Box([-4.0, -4.0, -np.inf, 1.65], [4.0, 4.0, np.inf, 1.75])},
    "W and V": {
        "disturbances": qpmhe.Box([-0.4, -0.4, -0.03, -0.02], [0.4, 0.4, 0.03, 0.02]),
        "noises": qpmhe.Polytope([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, -1.0]], [0.16, 0.16]),
    },
}


class Rover:
    """A rover of unknown turn rate about 1.7 rad per sample among beacons anywhere."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.beacons = rng.uniform(2.0, 6.0, (2, 2)) * rng.choice([-1.0, 1.0], (2, 2))
        self.speed = rng.uniform(0.2, 0.6)
        self.start = np.append(rng.uniform(-0.5, 0.5, 2), [rng.uniform(-PI, PI), 1.7])
        self.rng = rng
        self.deviations = {
            "prior": [0.5, 0.5, 0.4, 0.1], "disturbance": [0.1, 0.1, 0.03, 0.02],
            "noise": [0.2, 0.2, 0.1, 0.1],
        }
        self.cost = qpmhe.QuadraticCost.from_covariances(
            **{name: np.diag(np.square(one)) for name, one in self.deviations.items()})

    def f(self, x, m=np):
        x, y, heading, rate = (x[j] for j in range(4))
        heading, old = heading + rate, heading
        return [x + self.speed * m.cos(old), y + self.speed * m.sin(old),
                m.arctan2(m.sin(heading), m.cos(heading)), rate]

    def h(self, x, m=np):
        """Ranges and bearings; these wrap in another way than f's heading."""
        seen = [(east - x[0], north - x[1]) for east, north in self.beacons]
        angles = [m.arctan2(n, e) - x[2] for e, n in seen]
        return [
            *(m.sqrt(e * e + n * n) for e, n in seen),
            *(a - 2.0 * PI * m.floor(a / (2.0 * PI) + 0.5) for a in angles),
        ]

    def system(self, engine="python", **sets):
        sets |= {"state_residual": qpmhe.angles([2]), "output_residual": qpmhe.angles([2, 3])}
        if engine == "compiled":
            return qpmhe.from_casadi(
                lambda x: self.f(x, ca), lambda x: self.h(x, ca), n=4, compiled=False, **sets
            )
        return qpmhe.System(self.f, self.h, n=4, p=4, **sets)

    def record(self, system, steps):
        x, y = self.start, []
        for _ in range(steps):
            noise = self.rng.normal(0.0, self.deviations["noise"])
            y.append(system.output_residual(system.h(x, np.zeros(0)) + noise, np.zeros(4)))
            x = np.array(self.f(x)) + self.rng.normal(0.0, self.deviations["disturbance"])
        return np.array(y)


@pytest.mark.parametrize("sets", SETS)
@pytest.mark.parametrize(
    ("seed", "engine"), [*((seed, "python") for seed in range(6)), (0, "compiled")]
)
def test_converged_cost_is_ipopts(seed, engine, sets):
    if engine == "compiled" and find_compiler() is None:
        pytest.skip("there is no C compiler")
    rover = Rover(seed)
    system = rover.system(engine, **SETS[sets])
    y = rover.record(rover.system(), 25)
    assert (np.abs(np.diff(y[:, 2:], axis=0)) > PI).sum() > 5
    common = {"horizon": 6, "initial_state": rover.start + np.array([0.3, -0.3, 0.3, 0.0])}
    observer = qpmhe.ExtendedKalman(
        **{name: np.diag(np.square(one)) for name, one in rover.deviations.items()})
    mhe = qpmhe.MovingHorizonEstimator(
        system, observer, rover.cost, max_qps=None, engine=engine, **common)
    ipopt = IpoptEstimator(
        system, observer, rover.cost, tolerance=1e-10, **common,
        f=lambda x: ca.vertcat(*rover.f(x, ca)),
        h=lambda x: ca.vertcat(*rover.h(x, ca)),
    )
    compared = 0
    for one in y:
        ours, theirs = mhe.update(one), ipopt.update(one)
        assert ours.candidate_cost == pytest.approx(theirs.candidate_cost, rel=1e-9)
        if qpmhe.Status.IMPROVED in ours.status & theirs.status and not ours.dropped:
            assert ours.cost == pytest.approx(theirs.cost, rel=1e-6)
            compared += 1
    assert compared > (20 if sets == "free" else 8)


def test_ipopt_takes_no_other_residual_function():
    rover = Rover(0)
    system = qpmhe.System(rover.f, rover.h, n=4, p=4, output_residual=lambda a, b: a - b)
    ipopt = IpoptEstimator(
        system, qpmhe.Luenberger(np.zeros((4, 4))), rover.cost, horizon=3,
        initial_state=rover.start, f=lambda x: x, h=lambda x: x,
    )
    with pytest.raises(qpmhe.errors.InvalidInputError, match=r"qpmhe\.angles only"):
        ipopt.update(np.zeros(4))
