"""Units change nothing where sets are soft and constraints nonlinear, if penalties follow."""

import numpy as np
import pytest

import qpmhe
from qpmhe import Status

from .test_units import Drawn

SEEDS = [*range(8), *(pytest.param(k, marks=pytest.mark.slow) for k in range(8, 60))]


class SoftDrawn(Drawn):
    """The problems of `test_units` with soft sets, and with a nonlinear constraint."""

    def __init__(self, seed):
        super().__init__(seed)
        rng = self.rng
        self.sets = {
            name: (*self.draw_set(d, size)[:2], None if rng.random() < 0.6 else (
                rng.standard_normal((2, d)), size * rng.uniform(0.2, 1.0, 2)
            ))
            for name, d, size in (
                ("states", self.n, 1.0), ("disturbances", self.n, 0.05), ("noises", self.p, 0.2)
            )
        }
        if np.isfinite(self.periods["state_residual"]).any():
            self.sets["states"] = None  # no soft set bounds an angle
        self.soft = {name: rng.random() < 0.7 for name in self.sets}
        self.prices = {name: rng.uniform(1.0, 20.0, (2, 30)) for name in self.sets}
        self.only = str(rng.choice(["linear", "quadratic", "both"]))
        self.slopes = rng.standard_normal((2, 2 * self.n + self.p))
        self.level = rng.uniform(0.2, 2.0)
        self.hard = bool(rng.random() < 0.3)

    def penalties(self, prices, rows, cost):
        linear, quadratic = cost * prices[0] / rows, cost * prices[1] / rows**2
        if self.only == "linear":
            return {"linear": linear}
        return {"quadratic": quadratic} | ({} if self.only == "quadratic" else {"linear": linear})

    def convex_sets(self, units):
        made = super().convex_sets(units)
        for name in made:
            if self.soft[name]:
                rows = units.outputs if name == "noises" else units.states
                if self.sets[name][2] is not None:
                    rows = np.append(rows, units.rows[name])
                made[name] = made[name].soften(
                    **self.penalties(self.prices[name][:, : len(rows)], rows, units.cost)
                )
        states, outputs, rows = units.states, units.outputs, units.rows["states"]

        def g(x, w, v):
            s = np.concatenate((x / states, 10.0 * w / states, v / outputs), axis=-1)
            flat = s @ self.slopes.T
            return (flat + 0.2 * s[..., :1] ** 2 - self.level) * rows

        prices = self.prices["states"][:, :2]
        penalty = {} if self.hard else self.penalties(prices, rows, units.cost)
        made["constraints"] = [qpmhe.Constraint(g, 2, **penalty)]
        return made


@pytest.mark.parametrize("seed", SEEDS[:60])
def test_powers_of_two_change_not_a_bit(seed):
    drawn = SoftDrawn(seed)
    units = drawn.units(2.0, 30)
    best, _ = drawn.estimates(drawn.own_units)
    found, _ = drawn.estimates(units)
    for one, other in zip(best, found, strict=True):
        assert other.status == one.status
        assert (other.qps, other.dropped) == (one.qps, one.dropped)
        expected = drawn.in_own_units(one, drawn.own_units)
        for name, value in drawn.in_own_units(other, units).items():
            np.testing.assert_array_equal(value, expected[name], err_msg=f"{name} at {one.time}")


@pytest.mark.parametrize("seed", SEEDS[:30])
def test_powers_of_ten_change_no_estimate(seed):
    drawn = SoftDrawn(seed)
    units = drawn.units(10.0, 9)
    best, _ = drawn.estimates(drawn.own_units)
    found, _ = drawn.estimates(units)
    for one, other in zip(best, found, strict=True):
        if (one.status | other.status) & (Status.SOLVER_STOPPED | Status.NO_DECREASE):
            break  # where it stopped is a matter of rounding, and later estimates may start there
        expected = drawn.in_own_units(one, drawn.own_units)
        value = drawn.in_own_units(other, units)
        for name in ("cost", "candidate_cost"):
            np.testing.assert_allclose(value[name], expected[name], rtol=1e-4, err_msg=name)
