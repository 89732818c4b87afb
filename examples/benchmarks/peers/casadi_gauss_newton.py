"""CasADi's sqpmethod with the Gauss-Newton Hessian, as it can be generated in C as a whole."""

from __future__ import annotations

from typing import Any

from problems import Problem

from .casadi_program import CasadiProgram
from .casadi_sqp import CasadiSqp

__all__ = ["CasadiGaussNewton"]


class CasadiGaussNewton(CasadiSqp):
    """The states as variables, so that all terms of J are squares of residuals; converged."""

    label = "Gauss-Newton+qrqp"
    limitations = "Gauss-Newton: sqpmethod with its default options, and our Hessian."

    def __init__(self, compiled: bool = False, start: str = "shifted") -> None:
        CasadiProgram.__init__(self, "states", compiled, start)

    def options(self, problem: Problem) -> dict[str, Any]:
        """Those of sqpmethod, with the Hessian of J without second derivatives of the model."""
        import casadi as ca

        n, count, cost = problem.n, problem.horizon, problem.cost
        x = ca.SX.sym("x", (count + 1) * n)
        parameters = ca.SX.sym("p", n + (problem.p + problem.m) * count)
        inputs = ca.reshape(parameters[n + problem.p * count :], problem.m, count)
        states = ca.vertsplit(x, n)
        residuals, weights = [states[0]], [cost.prior]
        for i in range(count):
            moved = problem.step(states[i], inputs[:, i])
            residuals += [states[i + 1] - moved, problem.output(states[i])]
            weights += [cost.disturbance, cost.noise]
        slopes = ca.jacobian(ca.vertcat(*residuals), x)
        weight = ca.diagcat(*(ca.sparsify(ca.DM(one)) for one in weights))
        of_cost, of_rows = ca.SX.sym("of_cost"), ca.SX.sym("of_rows", 0)
        hessian = ca.Function(
            "gauss_newton", [x, parameters, of_cost, of_rows],
            [2 * of_cost * slopes.T @ weight @ slopes],
        )
        return {**super().options(problem), "hess_lag": hessian}
