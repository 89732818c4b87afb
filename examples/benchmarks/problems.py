"""The estimation problems of the benchmark, each as NumPy and as CasADi model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import qpmhe
from qpmhe.model.discretize import Discretization, discretize
from qpmhe.models.batch_reactor import batch_reactor
from qpmhe.models.batch_reactor import casadi_output as reactor_output
from qpmhe.models.batch_reactor import casadi_rate as reactor_rate
from qpmhe.models.chain import casadi_output as chain_output
from qpmhe.models.chain import casadi_rate as chain_rate
from qpmhe.models.chain import chain_of_masses
from qpmhe.models.quadrotor import quadrotor
from qpmhe.models.scenario import Scenario

__all__ = ["NAMES", "Problem", "chain_problem", "named", "reactor_problem"]


@dataclass(frozen=True)
class Problem:
    """One estimation problem, without sets: (eq:optiMHE) with quadratic cost.

    Parameters
    ----------
    name : str
        What ``--problem`` calls it.
    system : qpmhe.System
        The NumPy model with its analytical Jacobians.
    observer : qpmhe.observers.Observer
        The auxiliary observer, whose trajectory is candidate and prior.
    cost : qpmhe.QuadraticCost
        Weights, the prior's constant.
    scenario : Scenario
        How records are simulated, and where the estimation starts.
    horizon : int
        N.
    rate, output : callable
        The same continuous-time model for CasADi: x, and u where there are inputs, to (n);
        x to (p).
    method : {"euler", "rk4"}
        Its discretisation.
    """

    name: str
    system: qpmhe.System
    observer: Any
    cost: qpmhe.QuadraticCost
    scenario: Scenario
    horizon: int
    rate: Callable[..., Any]
    output: Callable[[Any], Any]
    method: str

    @property
    def n(self) -> int:
        """Number of states."""
        return self.system.n

    @property
    def p(self) -> int:
        """Number of outputs."""
        return self.system.p

    @property
    def m(self) -> int:
        """Number of inputs."""
        return self.system.m

    @property
    def title(self) -> str:
        """Name and sizes."""
        return f"{self.name}: n = {self.n}, p = {self.p}, N = {self.horizon}"

    def step(self, x: Any, u: Any) -> Any:
        """One step of the discretised model for CasADi columns (n) and (m)."""
        step, _ = discretize(self.rate, None, Discretization(self.method))
        return step(self.scenario.dt, x, *([u] if self.m else []))

    def casadi_system(self) -> qpmhe.System:
        """The same system made from the CasADi model."""
        return qpmhe.from_casadi(
            self.rate, self.output, n=self.n, p=self.p, m=self.m, dt=self.scenario.dt,
            method=self.method,
        )


def reactor_problem(horizon: int | None = None) -> Problem:
    """The paper's batch reactor, n = 2, with an Euler step as in its simulation."""
    system, observer, cost, scenario = batch_reactor("euler")
    return Problem(
        "reactor", system, observer, cost, scenario, horizon or scenario.horizon,
        reactor_rate, reactor_output, "euler",
    )


def chain_problem(masses: int, dimension: int, horizon: int | None = None) -> Problem:
    """A chain of masses, n = 2 masses dimension, with Runge-Kutta steps of order 4."""
    system, observer, cost, scenario = chain_of_masses(masses, dimension, "rk4")
    return Problem(
        f"chain-{system.n}", system, observer, cost, scenario, horizon or scenario.horizon,
        chain_rate(masses, dimension), chain_output(masses, dimension), "rk4",
    )


def quadrotor_problem() -> Problem:
    """A quadrotor in flight, n = 12 with four inputs; its CasADi model is the trace of NumPy's."""
    system, observer, cost, scenario = quadrotor("rk4")
    traced, nothing = system.symbolic, np.zeros(system.m)
    return Problem(
        "quadrotor", system, observer, cost, scenario, scenario.horizon,
        lambda x, u: traced.f(x, u), lambda x: traced.h(x, nothing), "rk4",
    )


_MAKERS: dict[str, Callable[[], Problem]] = {
    "reactor": reactor_problem,
    "chain-12": lambda: chain_problem(2, 3),
    "chain-18": lambda: chain_problem(3, 3),
    "quadrotor": quadrotor_problem,
}
NAMES = tuple(_MAKERS)


def named(name: str) -> Problem:
    """A problem of `NAMES`; its NumPy and CasADi models are compared first."""
    problem = _MAKERS[name]()
    _agree(problem)
    return problem


def _agree(problem: Problem) -> None:
    import casadi as ca

    x, u = ca.SX.sym("x", problem.n), ca.SX.sym("u", problem.m)
    both = ca.Function("model", [x, u], [problem.step(x, u), problem.output(x)])
    at, held = problem.scenario.initial_state, np.linspace(1.0, 0.0, problem.m)
    ours = (problem.system.f(at, held), problem.system.h(at, held))
    for theirs, value in zip(both(at, held), ours, strict=True):
        if not np.allclose(theirs.full().ravel(), value, rtol=1e-12, atol=1e-12):
            raise RuntimeError(f"{problem.name}: its NumPy and CasADi models are not the same.")
