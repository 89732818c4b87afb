"""Three models that explicit steps cannot take: their equations, and records of them.

- A fed-batch fermentation of penicillin: Cuthrell and Biegler, Simultaneous optimization and
  solution methods for batch reactor control profiles, Computers and Chemical Engineering 13 (1989).
  The substrate follows the feed within minutes, samples are an hour apart, and the yield of
  biomass is unknown. Volume and growth are measured each hour, biomass and product each 8 h.
- A polymerisation reactor: Maner, Doyle, Ogunnaike and Pearson, Nonlinear model predictive control
  of a simulated multivariable polymerization reactor using second-order Volterra models,
  Automatica 32 (1996), here with a rate for its radicals, which live for 0.04 s.
- Two generators at two buses with loads of constant power: swing equations, and angles and
  voltages of the buses that balance the flows of power at every instant. Nothing measures the
  angle that all have in common, so that the speed that is not measured is judged.

True states are simulated by SUNDIALS (CasADi's cvodes and idas) with tolerances of 1e-10, with
disturbances once a sample. Initial states are drawn from the estimators' prior.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from examples.benchmarks.fermentation import equations as fermentation
from examples.benchmarks.swing import equations as swing

from ..problem import Array

#: Rates, algebraic residuals and outputs, of lists of the components of x, z, u and of the
#: parameters, and of the module whose functions they take.
Equations = Callable[..., tuple[Any, ...]]


class Plant(NamedTuple):
    """A model, its covariances and its records.

    Attributes
    ----------
    name, title, unit : str
        Stem of its files, title, and unit of time.
    equations : callable
        See `Equations`.
    dt, steps, substeps : float, int and int
        Time between samples, how many there are, and steps of Radau's method in each.
    guess, prior, least : tuple
        The first estimate of x and of a parameter behind it, its standard deviations, and lower
        bounds.
    disturbance, noise : tuple
        Standard deviations of w, of one sample, and of v.
    every : tuple of int
        Samples from one measurement of each output to the next.
    inputs, held : tuple
        Least and largest inputs, and for how many samples they stay.
    algebraic : tuple
        Where z is looked for; () without.
    error : tuple of int
        The components of x that are judged.
    error_unit, lost : str and float
        Unit of this error, and how large it is where a run is lost.
    shown : tuple of (int, str)
        Components in the picture, and what they are.
    """

    name: str
    title: str
    unit: str
    equations: Equations
    dt: float
    steps: int
    guess: tuple[float, ...]
    prior: tuple[float, ...]
    least: tuple[float, ...]
    disturbance: tuple[float, ...]
    noise: tuple[float, ...]
    every: tuple[int, ...]
    inputs: tuple[tuple[float, ...], tuple[float, ...]]
    held: int
    algebraic: tuple[float, ...]
    error: tuple[int, ...]
    error_unit: str
    lost: float
    shown: tuple[tuple[int, str], ...]
    substeps: int = 1
    parameters: int = 0

    @property
    def n(self) -> int:
        """Number of states without the parameters."""
        return len(self.guess) - self.parameters


def penicillin(
    x: list[Any], _: list[Any], u: list[Any], parameters: list[Any], of: ModuleType
) -> tuple[Any, ...]:
    """Biomass, product and substrate (g/L) and volume (L); feed (g/h), of 500 g/L; the yield."""
    rates, outputs = fermentation(x, u, parameters[0], of)
    return rates, [], outputs


def polymerisation(
    x: list[Any], _: list[Any], u: list[Any], __: list[Any], ___: ModuleType
) -> tuple[Any, ...]:
    """Monomer and initiator (kmol/m3), radicals (1e-6 of it), chains (1e-3), polymer (kg/m3)."""
    monomer, initiator, radicals, chains, polymer = x
    live, leaving = 1e-6 * radicals, 1.0 / 0.1
    coupling, disproportion, growing, moving = 1.3281e10, 1.0930e11, 2.4952e6, 2.4522e3
    starting = 0.10225 * initiator
    used = (growing + moving) * monomer * live
    ending = (coupling + disproportion) * live**2
    dead = (0.5 * coupling + disproportion) * live**2 + moving * monomer * live
    return (
        [leaving * (6.0 - monomer) - used, (u[0] * 8.0 - initiator) * leaving - starting,
         1e6 * (2.0 * 0.58 * starting - ending) - leaving * radicals,
         1e3 * dead - leaving * chains, 100.12 * used - leaving * polymer],
        [], [monomer, polymer / chains],
    )


def grid(
    x: list[Any], z: list[Any], u: list[Any], _: list[Any], of: ModuleType
) -> tuple[Any, ...]:
    """Angle (rad) and speed of two generators; angle and voltage of their buses; their power."""
    return swing(x, z, u, of)


PLANTS = (
    Plant(
        "fermentation", "Penicillin", "h", penicillin, dt=1.0, steps=120,
        guess=(1.5, 0.0, 0.01, 7.0, 0.47), prior=(0.3, 0.02, 0.005, 0.1, 0.05),
        least=(0.1, 0.0, 0.0, 1.0, 0.1), disturbance=(0.05, 0.01, 3e-3, 5e-3, 1e-3),
        noise=(0.05, 0.02, 0.5, 0.1), every=(1, 1, 8, 8), inputs=((5.0,), (20.0,)), held=10,
        algebraic=(), error=(0,), error_unit="g/L of biomass", lost=5.0,
        shown=((0, "biomass (g/L)"), (4, "yield (g/g)")), substeps=4, parameters=1,
    ),
    Plant(
        "polymerisation", "Polymerisation", "h", polymerisation, dt=0.05, steps=100,
        guess=(5.5, 0.13, 0.35, 2.0, 49.0), prior=(0.3, 0.04, 0.1, 0.5, 10.0),
        least=(0.0, 0.0, 0.0, 0.2, 0.0), disturbance=(0.01, 3e-3, 1e-2, 0.02, 0.3),
        noise=(0.02, 0.3), every=(1, 1), inputs=((0.008,), (0.03,)), held=10,
        algebraic=(), error=(1,), error_unit="kmol/m³ of initiator", lost=0.13,
        shown=((1, "initiator (kmol/m³)"), (3, "chains (mol/m³)")),
    ),
    Plant(
        "grid", "Two generators", "s", grid, dt=0.05, steps=150,
        guess=(0.25, 0.0, 0.2, 0.0), prior=(0.1, 0.1, 0.1, 0.1), least=(-np.inf,) * 4,
        disturbance=(0.002, 0.02, 0.002, 0.02), noise=(0.01, 0.01, 0.01), every=(1, 1, 1),
        inputs=((0.6, 0.7), (0.7, 0.8)), held=20, algebraic=(0.0, 1.0, 0.0, 1.0),
        error=(3,), error_unit="rad/s of the second generator", lost=1.0,
        shown=((1, "first speed (rad/s)"), (3, "second speed (rad/s)")),
    ),
)


@cache
def _plant(plant: Plant) -> tuple[Any, Any]:
    """The integrator of a sample, with rates added to the model's, and the outputs."""
    kinds = {"x": plant.n, "z": len(plant.algebraic), "u": len(plant.inputs[0]),
             "p": plant.parameters}
    parts = {name: ca.SX.sym(name, size) for name, size in kinds.items()}
    rates, rest, outputs = plant.equations(*map(ca.vertsplit, parts.values()), ca)
    added = ca.SX.sym("w", plant.n)
    given = ca.vertcat(parts["u"], parts["p"], added)
    problem: Any = {"x": parts["x"], "p": given, "ode": ca.vertcat(*rates) + added}
    if rest:
        problem |= {"z": parts["z"], "alg": ca.vertcat(*rest)}
    kind = "idas" if rest else "cvodes"
    options = {"reltol": 1e-10, "abstol": 1e-12, "max_num_steps": 100_000}
    return (
        ca.integrator("sample", kind, problem, 0.0, plant.dt, options),
        ca.Function("outputs", list(parts.values()), [ca.vertcat(*outputs)]),
    )


def simulate(plant: Plant, seed: int, steps: int) -> tuple[Array, Array, Array]:
    """True states with the parameters behind them, measurements, NaN where missing, and inputs."""
    rng, n = np.random.default_rng(seed), plant.n
    sample, outputs = _plant(plant)
    least, drawn = np.array(plant.least), np.array(plant.guess)
    drawn = np.maximum(drawn + plant.prior * rng.standard_normal(drawn.size), least)
    pieces = rng.uniform(*plant.inputs, (-(-steps // plant.held), len(plant.inputs[0])))
    inputs = np.repeat(pieces, plant.held, axis=0)[:steps]
    states, measured, z = np.empty((steps, drawn.size)), [], np.array(plant.algebraic)
    x, parameters = drawn[:n], drawn[n:]
    for t, u in enumerate(inputs):
        states[t] = np.concatenate((x, parameters))
        if z.size:  # z solves the algebraic equations at this x and u
            z = _consistent(plant)(z, np.concatenate((x, u))).full().ravel()
        y = np.array(outputs(x, z, u, parameters)).ravel()
        y += plant.noise * rng.standard_normal(y.size)
        measured.append(np.where(t % np.array(plant.every) == 0, y, np.nan))
        given = {"z0": z} if z.size else {}
        given["p"] = np.concatenate((u, parameters, np.zeros(n)))
        x = np.array(sample(x0=x, **given)["xf"]).ravel()
        x = np.maximum(x + plant.disturbance[:n] * rng.standard_normal(n), least[:n])
    return states, np.array(measured), inputs


def effect_of_rates(plant: Plant, states: Array, inputs: Array) -> Array:
    """What a constant rate of one unit in each state adds to it in a sample (n,), the mean."""
    sample, n, found = _plant(plant)[0], plant.n, []
    # Differences of a step that is good to 1e-10; a sample adds no more than the disturbance does.
    sizes = np.array(plant.disturbance[:n]) / plant.dt
    for x, u in zip(states, inputs, strict=True):
        given = {}
        if plant.algebraic:
            given["z0"] = _consistent(plant)(plant.algebraic, np.concatenate((x, u)))
        ends = [
            np.array(sample(x0=x[:n], p=np.concatenate((u, x[n:], w)), **given)["xf"]).ravel()
            for w in (*np.diag(sizes), *np.diag(-sizes))
        ]
        found.append(np.diagonal(np.subtract(ends[:n], ends[n:])))
    effect: Array = np.mean(found, axis=0) / (2.0 * sizes)
    return effect


@cache
def _consistent(plant: Plant) -> Any:
    """A solver of the algebraic equations, for z at x and u."""
    x, z, u = (ca.SX.sym(name, size) for name, size in zip(
        "xzu", (plant.n, len(plant.algebraic), len(plant.inputs[0])), strict=True
    ))
    _, rest, _ = plant.equations(*map(ca.vertsplit, (x, z, u)), [], ca)
    program: Any = {"x": z, "p": ca.vertcat(x, u), "g": ca.vertcat(*rest)}
    return ca.rootfinder("consistent", "newton", program)
