"""Models for implicit steps: algebraic states, stiff ODEs, and ODEs that are neither."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import casadi as ca
import fermentation
import numpy as np
import swing
from numpy.typing import NDArray

import qpmhe

__all__ = ["ESTIMATED", "MILD", "Model"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    """Equations of lists of the components of x, z and u, for NumPy or CasADi.

    Parameters
    ----------
    name : str
        In the tables.
    equations : callable
        (x, z, u, module) to lists of rates, algebraic residuals and outputs.
    dt, steps : float and int
        Time of a sample, and the steps in it.
    start, deviation : array
        A usual state (n,), and the deviations of others from it.
    held : array
        Usual inputs (m,).
    guess : tuple of float
        Where z is looked for; () without.
    disturbance, noise : array
        Standard deviations of w, a sample, and of v. Without noise nothing is estimated.
    """

    name: str
    equations: Callable[[list[Any], list[Any], list[Any], ModuleType], tuple[Any, Any, Any]]
    dt: float
    start: Array
    deviation: Array
    held: Array
    steps: int = 1
    guess: tuple[float, ...] = ()
    disturbance: Array | None = None
    noise: Array | None = None

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers n, k and m of states, algebraic states and inputs."""
        return len(self.start), len(self.guess), len(self.held)

    def system(self, method: str = "radau") -> qpmhe.System:
        """The model in NumPy."""
        n, k, m = self.sizes

        def part(index: int) -> Callable[..., Any]:
            def function(*given: Any) -> Any:
                x, z, u = given if k else (given[0], np.zeros((*given[0].shape[:-1], 0)), given[1])
                parts = (
                    [one[..., i] for i in range(size)] for one, size in ((x, n), (z, k), (u, m))
                )
                return np.stack(self.equations(*parts, np)[index], -1)

            return function

        _, _, outputs = self.expressions()
        options: dict[str, Any] = {
            "dt": self.dt, "n": n, "p": outputs.shape[0], "m": m, "method": method,
            "steps": self.steps,
        }
        if k:
            return qpmhe.System.from_dae(
                part(0), part(1), part(2), k=k, algebraic_guess=np.array(self.guess), **options
            )
        return qpmhe.System.from_ode(part(0), part(2), **options)

    def expressions(self) -> tuple[Any, Any, Any]:
        """Symbols (x and z, u), f and g below each other, and y, in CasADi."""
        n, k, m = self.sizes
        w, u = ca.SX.sym("w", n + k), ca.SX.sym("u", m)
        rates, rest, outputs = self.equations(
            ca.vertsplit(w[:n]), ca.vertsplit(w[n:]) if k else [], ca.vertsplit(u), ca
        )
        return (w, u), ca.vertcat(*rates, *rest), ca.vertcat(*outputs)


def _pendulum(x: Any, _: Any, u: Any, of: ModuleType) -> Any:
    """A damped pendulum."""
    return [x[1], u[0] - of.sin(x[0]) - 0.1 * x[1]], [], [x[0]]


def _reactor(x: Any, _: Any, u: Any, of: ModuleType) -> Any:
    """The reactor of van de Vusse: two concentrations, two temperatures."""
    a, b, inner, jacket = x
    first = 1.287e12 * of.exp(-9758.3 / (inner + 273.15))
    second = 9.043e9 * of.exp(-8560.0 / (inner + 273.15))
    heat = first * a * 4.2 - first * b * 11.0 - second * a * a * 41.85
    return [
        u[0] * (5.1 - a) - first * a - second * a * a, first * (a - b) - u[0] * b,
        u[0] * (130.0 - inner) + 30.8 * (jacket - inner) - heat / 2.81,
        86.7 * (inner - jacket) - 113.0,
    ], [], [b]


def _chain(x: Any, _: Any, u: Any, __: ModuleType) -> Any:
    """Cells in a row that exchange and decay."""
    left, right = [u[0], *x[:-1]], [*x[1:], x[-1]]
    return [
        3.0 * (a - 2.0 * b + c) - 0.5 * b**3 for a, b, c in zip(left, x, right, strict=True)
    ], [], [x[0]]


def _front(x: Any, _: Any, u: Any, __: ModuleType) -> Any:
    """Cells in a row between which a substance that makes itself spreads, fast; four are seen."""
    left, right = [u[0], *x[:-1]], [*x[1:], x[-1]]
    return [
        600.0 * (a - 2.0 * b + c) + 20.0 * b * (1.0 - b)
        for a, b, c in zip(left, x, right, strict=True)
    ], [], x[2::6]


def _penicillin(x: Any, _: Any, u: Any, of: ModuleType) -> Any:
    rates, outputs = fermentation.equations(x, u, 0.47, of)
    return rates, [], outputs


def _swing(x: Any, z: Any, u: Any, of: ModuleType) -> Any:
    return swing.equations(x, z, u, of)


_CELLS = 24
#: Models of which estimators are compared: algebraic states first, then stiff ODEs.
ESTIMATED = (
    Model(
        "two generators, n = 4, k = 4", _swing, 0.05, np.array([0.2, 0.0, 0.25, 0.0]),
        np.full(4, 0.1), np.array([0.65, 0.75]), guess=(0.0, 1.0, 0.0, 1.0),
        disturbance=np.array([0.002, 0.02, 0.002, 0.02]), noise=np.full(3, 0.01),
    ),
    Model(
        "penicillin, n = 4", _penicillin, 1.0, np.array([10.0, 1.0, 0.05, 7.5]),
        np.array([0.5, 0.1, 0.005, 0.1]), np.array([12.0]), steps=4,
        disturbance=np.array([0.05, 0.01, 1e-3, 5e-3]), noise=np.array([0.05, 0.02, 0.5, 0.1]),
    ),
    Model(
        f"reaction and diffusion, n = {_CELLS}", _front, 0.05, np.linspace(0.9, 0.4, _CELLS),
        np.full(_CELLS, 0.05), np.array([0.9]), disturbance=np.full(_CELLS, 0.01),
        noise=np.full(4, 0.02),
    ),
)
#: Models without stiffness, for steps alone.
MILD = (
    Model("pendulum, n = 2", _pendulum, 0.1, np.zeros(2), np.ones(2), np.array([0.4])),
    Model(
        "reactor, n = 4", _reactor, 0.005, np.array([1.2, 0.9, 134.0, 130.0]),
        np.array([0.036, 0.027, 4.0, 4.0]), np.array([0.4]),
    ),
    Model("chain, n = 8", _chain, 0.05, np.zeros(8), np.ones(8), np.array([0.4])),
    Model("chain, n = 20", _chain, 0.05, np.zeros(20), np.ones(20), np.array([0.4])),
)
