"""Units change nothing but the numbers' units.

Each problem is drawn once, and estimated in its own units and in others: of each state, output,
input, of the time and the cost, and of each inequality. Powers of two are exact, so that
estimates and statuses must agree in every bit; other units round, and must agree up to that.
"""

import warnings
from dataclasses import dataclass, field

import numpy as np
import pytest

import qpmhe
from qpmhe import Status
from qpmhe.errors import ObserverWarning

HORIZON, SAMPLES = 4, 14
NONE = np.zeros(0)


@dataclass
class Units:
    """Factors by which numbers grow in other units."""

    states: np.ndarray
    outputs: np.ndarray
    inputs: np.ndarray
    time: float = 1.0
    cost: float = 1.0
    rows: dict = field(default_factory=dict)
    own_disturbances: np.ndarray | None = None  # where they are not the states'

    @property
    def disturbances(self):
        return self.states if self.own_disturbances is None else self.own_disturbances


class Drawn:
    """A random problem that can be posed in any units."""

    matrix = None  # the system's disturbance_matrix

    def __init__(self, seed):
        self.seed = seed
        rng = self.rng = np.random.default_rng(seed)
        self.n, self.p = int(rng.integers(1, 5)), int(rng.integers(1, 4))
        self.m = int(rng.integers(0, 3))
        n, p, m = self.n, self.p, self.m
        self.a = rng.standard_normal((n, n)) * 0.3 / np.sqrt(n) - 0.4 * np.eye(n)
        self.bent = 0.2 * rng.standard_normal((n, n))
        self.b, self.d = 0.3 * rng.standard_normal((n, m)), 0.1 * rng.standard_normal((p, m))
        self.c, self.curve = rng.standard_normal((p, n)), 0.1 * rng.standard_normal((p, n))
        self.dt = float(rng.choice([0.3, 0.5]))
        self.method = str(rng.choice(["euler", "rk4", "discrete"]))
        self.derivative = str(rng.choice(["complex step", "differences", "given"]))
        self.kind = str(rng.choice(["luenberger", "ekf", "ukf", "steady", "injection"]))
        self.loss = str(rng.choice(["quadratic", "huber", "huber per component", "power"]))
        if rng.random() < 0.5:
            self.loss = "quadratic"
        self.from_observer = self.kind in ("ekf", "ukf", "steady") and bool(rng.random() < 0.5)
        self.gain = 0.2 * np.linalg.pinv(self.c) * rng.uniform(0.5, 1.5)
        self.prior, self.w = self.spd(n, 0.3), self.spd(n, 0.05)
        self.v = np.diag(rng.uniform(0.01, 0.1, p)) if "per" in self.loss else self.spd(p, 0.05)
        self.start = rng.standard_normal(n)
        self.sets = {
            name: self.draw_set(d, size) if rng.random() < share else None
            for name, d, size, share in (
                ("states", n, 2.0, 0.4), ("disturbances", n, 0.5, 0.3), ("noises", p, 0.5, 0.3)
            )
        }
        self.options = {
            "max_qps": [0, 1, 2, None][int(rng.integers(0, 4))],
            "warm_start": bool(rng.random() < 0.3),
            "candidate": "reinitialized" if rng.random() < 0.2 else "observer",
            "project_observer": bool(rng.random() < 0.7),
            "infeasible": str(rng.choice(["drop_rows", "keep_candidate"])),
            "delay": int(rng.integers(0, 3)),
        }
        self.discount = float(rng.choice([1.0, 0.9]))
        self.record()
        # Samples with a noise weight or a step length of their own, and a late measurement.
        self.weighted = rng.random(SAMPLES) < 0.1
        self.irregular = (rng.random(SAMPLES) < 0.1) & (self.method != "discrete")
        self.late = int(rng.integers(SAMPLES - HORIZON, SAMPLES)), rng.standard_normal(self.p)
        self.periods = self.draw_periods()

    def draw_periods(self):
        """Periods of the states and outputs that are angles, NaN of the others."""
        rng = np.random.default_rng([self.seed, 1])
        states, outputs = (
            np.where(rng.random(size) < share, rng.uniform(0.7, 4.0, size), np.nan)
            for size, share in ((self.n, 0.2), (self.p, 0.3))
        )
        if self.sets["states"] is not None:
            low, high, rows = self.sets["states"]
            bounded = np.isfinite(low) & np.isfinite(high)
            states = np.where(bounded, states, np.nan) if rows is None else np.full(self.n, np.nan)
        return {"state_residual": states, "output_residual": outputs}

    def residuals(self, units):
        made = {}
        for name, scale in (("state_residual", units.states), ("output_residual", units.outputs)):
            which = np.flatnonzero(np.isfinite(self.periods[name]))
            if which.size:
                made[name] = qpmhe.angles(which, (self.periods[name] * scale)[which])
        return made

    def spd(self, size, level):
        root = self.rng.standard_normal((size, size)) + 2.0 * np.eye(size)
        return level**2 * root @ root.T

    def draw_set(self, d, size):
        rng = self.rng
        low, high = -size * rng.uniform(0.3, 1.5, d), size * rng.uniform(0.3, 1.5, d)
        if rng.random() < 0.3:
            low[rng.integers(d)] = -np.inf
        if size < 1.0 and d > 1 and rng.random() < 0.2:
            low[0] = high[0] = 0.0
        rows = None
        if rng.random() < 0.3:
            rows = rng.standard_normal((2, d)), size * rng.uniform(0.5, 2.0, 2)
        return low, high, rows

    def rate(self, x, u):
        moved = x @ self.a.T + np.sin(x) @ self.bent.T + u @ self.b.T
        # The sum of both branches' values is the value: differences alone get through.
        return np.where(np.real(moved) == np.inf, 0.0, moved)

    def output(self, x, u):
        return x @ self.c.T + (x * x) @ self.curve.T + u @ self.d.T

    def record(self):
        rng, x = self.rng, self.start + 0.3 * self.rng.standard_normal(self.n)
        self.us = 0.5 * rng.standard_normal((SAMPLES, self.m))
        self.ys = np.empty((SAMPLES, self.p))
        for t, u in enumerate(self.us):
            self.ys[t] = self.output(x, u) + 0.1 * rng.standard_normal(self.p)
            x = x + self.dt * self.rate(x, u) + 0.05 * rng.standard_normal(self.n)
        self.ys[rng.random(self.ys.shape) < 0.1] = np.nan

    def units(self, base, most):
        """Random units, powers of the base."""
        rng = np.random.default_rng(self.seed + 1000003)

        def draw(*size):
            return float(base) ** rng.integers(-most, most + 1, size)

        units = Units(
            draw(self.n), draw(self.p), draw(self.m), float(draw(1)[0]), float(draw(1)[0]),
            {name: draw(2) for name in self.sets},
        )
        if not self.in_any_cost:
            units.cost = 1.0
        elif self.loss != "quadratic" and round(np.log(units.cost) / np.log(base)) % 2:
            units.cost *= base  # the threshold of a loss is in units of its root
        return units

    @property
    def own_units(self):
        return Units(
            np.ones(self.n), np.ones(self.p), np.ones(self.m), 1.0, 1.0,
            {name: np.ones(2) for name in self.sets},
        )

    @property
    def in_any_cost(self):
        """Whether the cost's unit is free: covariances of an observer fix it.

        So do sets, whose tolerances are shares of standard deviations, and difference steps,
        which are shares of the prior's.
        """
        return self.kind in ("luenberger", "injection") and self.loss != "power" and (
            self.derivative == "complex step" and not any(self.sets.values())
        )

    def system(self, units):
        states, outputs, inputs = units.states, units.outputs, units.inputs

        def plain(x, u):
            x, u = x / states, u / inputs
            if self.derivative == "differences":
                x = np.sign(x) * np.abs(x)
            return x, u

        def rate(x, u=NONE):
            return self.rate(*plain(x, u)) * states / units.time

        def h(x, u=NONE):
            return self.output(*plain(x, u)) * outputs

        def rate_jacobian(x, u=NONE):
            x = x / states
            slope = self.a + self.bent * np.cos(x)[..., None, :]
            return slope * states[:, None] / states / units.time

        def h_jacobian(x, u=NONE):
            x = x / states
            slope = self.c + 2.0 * self.curve * x[..., None, :]
            return slope * outputs[:, None] / states

        functions = [rate, h, rate_jacobian, h_jacobian]
        if not self.m:
            functions = [lambda x, one=one: one(x) for one in functions]
        rate_, h_, rate_jacobian_, h_jacobian_ = functions
        options = {"n": self.n, "p": self.p, "m": self.m, **self.convex_sets(units)}
        options |= self.residuals(units)
        if self.matrix is not None:
            options["disturbance_matrix"] = self.matrix * states[:, None] / units.disturbances
        given = self.derivative == "given"
        if given:
            options["h_jacobian"] = h_jacobian_
        dt = self.dt * units.time
        if self.method != "discrete":
            if given:
                options["rate_jacobian"] = rate_jacobian_
            return qpmhe.System.from_ode(rate_, h_, dt=dt, method=self.method, **options)
        if given:
            options["f_jacobian"] = lambda x, *u: np.eye(self.n) + dt * rate_jacobian_(x, *u)
        if self.m:
            return qpmhe.System(lambda x, u: x + dt * rate_(x, u), h_, **options)
        return qpmhe.System(lambda x: x + dt * rate_(x), h_, **options)

    def convex_sets(self, units):
        made = {}
        for name, drawn in self.sets.items():
            if drawn is None:
                continue
            low, high, rows = drawn
            scale = {
                "states": units.states, "disturbances": units.disturbances,
                "noises": units.outputs,
            }[name]
            made[name] = qpmhe.Box(low * scale, high * scale)
            if rows is not None:
                matrix, bound = rows
                per_row = units.rows[name]
                made[name] &= qpmhe.Polytope(matrix * per_row[:, None] / scale, bound * per_row)
        return made

    def observer(self, system, units):
        states, outputs = units.states, units.outputs
        gain = self.gain * states[:, None] / outputs
        covariances = {
            "prior": self.prior * np.outer(states, states),
            "disturbance": self.w * np.outer(units.disturbances, units.disturbances),
            "noise": self.v * np.outer(outputs, outputs),
        }
        if self.kind == "luenberger":
            return qpmhe.Luenberger(gain)
        if self.kind == "injection":
            return qpmhe.OutputInjection(
                lambda z, v: gain @ (v / (1.0 + 0.1 * np.abs(v / outputs)))
            )
        if self.kind == "ekf":
            return qpmhe.ExtendedKalman(**covariances)
        if self.kind == "ukf":
            return qpmhe.UnscentedKalman(**covariances)
        return qpmhe.SteadyStateKalman(
            system, self.start * states, np.zeros(self.m) if self.m else None, **covariances
        )

    def cost(self, units):
        inverse = np.linalg.inv
        per_state, per_output = 1.0 / units.states, 1.0 / units.outputs
        weights = {}
        for name, covariance, per in (
            ("prior", self.prior, per_state), ("disturbance", self.w, 1.0 / units.disturbances),
            ("noise", self.v, per_output),
        ):
            weight = inverse(covariance)
            weights[name] = units.cost * 0.5 * (weight + weight.T) * np.outer(per, per)
        if self.from_observer:
            weights["prior"] = qpmhe.ObserverPrior()
        if self.loss == "quadratic":
            return qpmhe.QuadraticCost(**weights, discount=self.discount)
        if self.loss == "power":
            weights["noise"] = qpmhe.Power(weights["noise"], 1.2)
        else:
            weights["noise"] = qpmhe.Huber(
                weights["noise"], 1.345 * np.sqrt(units.cost), per_component="per" in self.loss
            )
        return qpmhe.RobustCost(**weights, discount=self.discount)

    def estimates(self, units):
        """Estimates of the record in these units, and the last covariances in its own."""
        system, cost = self.system(units), self.cost(units)
        noise = cost.noise
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ObserverWarning)
            mhe = qpmhe.MovingHorizonEstimator(
                system, self.observer(system, units), cost, horizon=HORIZON,
                initial_state=self.start * units.states, **self.options,
            )
            estimates = [
                mhe.update(
                    self.ys[t] * units.outputs, self.us[t] * units.inputs if self.m else None,
                    dt=1.5 * self.dt * units.time if self.irregular[t] else None,
                    noise_weight=0.5 * noise if self.weighted[t] else None,
                )
                for t in range(SAMPLES)
            ]
            time, late = self.late
            estimates.append(mhe.amend(time, late * units.outputs))
            scale = np.outer(units.states, units.states) / units.cost
            return estimates, mhe.covariances() / scale

    def in_own_units(self, estimate, units):
        """The numbers of an estimate, taken back to the units in which it was drawn."""
        states = {
            name: getattr(estimate, name) / units.states
            for name in ("state", "filtered", "delayed", "trajectory", "candidate")
            if getattr(estimate, name) is not None
        }
        return {
            **states, "noises": estimate.noises / units.outputs,
            "disturbances": estimate.disturbances / units.disturbances,
            "cost": estimate.cost / units.cost,
            "candidate_cost": estimate.candidate_cost / units.cost,
        }


class LowRank(Drawn):
    """A problem with a disturbance_matrix, or with a singular covariance of the disturbance."""

    def __init__(self, seed):
        super().__init__(seed)
        rng, n = np.random.default_rng(seed + 77), self.n
        r = int(rng.integers(1, n)) if n > 1 else 1
        matrix = rng.standard_normal((n, r))
        if rng.random() < 0.4 and r < n:
            matrix[rng.integers(n)] = 0.0
            matrix[np.argmin(np.abs(matrix).sum(axis=1)) - 1] += 1.0
        if self.loss == "quadratic" and rng.random() < 0.4:
            # Of rank r to the last bit: rounding of a product would have its own units.
            keep = np.zeros(n, bool)
            keep[rng.choice(n, r, replace=False)] = True
            self.w = np.where(np.outer(keep, keep), self.w, 0.0)
        else:
            self.matrix, self.w = matrix, self.spd(r, 0.05)
            if self.sets["disturbances"] is not None:
                low, high, _ = self.sets["disturbances"]
                self.sets["disturbances"] = low[:r], high[:r], None

    def units(self, base, most):
        units = super().units(base, most)
        if self.matrix is not None:
            rng = np.random.default_rng(self.seed + 5)
            units.own_disturbances = float(base) ** rng.integers(
                -most, most + 1, self.matrix.shape[1]
            )
        return units

    @property
    def own_units(self):
        units = super().own_units
        if self.matrix is not None:
            units.own_disturbances = np.ones(self.matrix.shape[1])
        return units

    def cost(self, units):
        if self.matrix is not None:
            return super().cost(units)
        states, outputs = units.states, units.outputs
        return qpmhe.QuadraticCost.from_covariances(
            prior=(
                qpmhe.ObserverPrior() if self.from_observer
                else self.prior * np.outer(states, states) / units.cost
            ),
            disturbance=self.w * np.outer(states, states) / units.cost,
            noise=self.v * np.outer(outputs, outputs) / units.cost, discount=self.discount,
        )


class Soft(Drawn):
    """With soft sets and a nonlinear constraint, whose penalties follow."""

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


KINDS = [Drawn, LowRank, Soft]


def posed_twice(seed, kind, base, most):
    """Pairs of estimates in the drawn units and in others: time, both, and their numbers."""
    drawn = kind(seed)
    units = drawn.units(base, most)
    best, spread = drawn.estimates(drawn.own_units)
    found, other_spread = drawn.estimates(units)
    if base == 2.0:
        np.testing.assert_array_equal(other_spread, spread)
    for one, other in zip(best, found, strict=True):
        yield drawn, units, one, other, [
            (name, value, drawn.in_own_units(one, drawn.own_units)[name])
            for name, value in drawn.in_own_units(other, units).items()
        ]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(60))
def test_powers_of_two_change_not_a_bit(seed, kind):
    for _, units, one, other, numbers in posed_twice(seed, kind, 2.0, 30):
        # How far an observer may be is a number of standard deviations.
        ignored = Status.OBSERVER_FAR if units.cost != 1.0 else Status(0)
        assert other.status & ~ignored == one.status & ~ignored
        assert (other.qps, other.dropped) == (one.qps, one.dropped)
        for name, value, expected in numbers:
            np.testing.assert_array_equal(value, expected, err_msg=f"{name} at {one.time}")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(30))
def test_powers_of_ten_change_no_estimate(seed, kind):
    for drawn, _, one, other, numbers in posed_twice(seed, kind, 10.0, 9):
        if (one.status | other.status) & (Status.SOLVER_STOPPED | Status.NO_DECREASE):
            break  # where it stopped is a matter of rounding, and later estimates may start there
        # A sequence has converged where J hardly changes, and corrections end within a
        # tolerance of a set: states are less accurate.
        exact = drawn.options["max_qps"] is not None and not (one.corrections or one.nearest_points)
        accuracy = 1e-5 if exact and kind is not Soft else 1e-3
        for name, value, expected in numbers:
            if kind is not Soft or "cost" in name:
                np.testing.assert_allclose(
                    value, expected, rtol=accuracy, atol=accuracy, err_msg=f"{name} at {one.time}"
                )
