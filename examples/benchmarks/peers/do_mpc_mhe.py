"""do-mpc's MHE class."""

from __future__ import annotations

import tempfile
import warnings
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
from problems import Problem

from .base import Array, Peer, UnavailableError, WindowData
from .casadi_program import compile_library

__all__ = ["DoMpc"]


class DoMpc(Peer):
    r"""do-mpc on the same problem, through its documented interface.

    do-mpc pairs y_k with x_{k+1}, and its prior is the second state of its previous
    solution. Neither need be: w(t) = 0 is optimal for the newest stage, which no measurement
    follows, so that N - 1 of its stages are enough; and the arrival cost may use
    parameters, among them our prior and the oldest measurement.

    Parameters
    ----------
    compiled : bool
        Whether the program's functions are compiled, as its ``compile_nlp`` does.
    """

    package = "do-mpc"
    limitations = (
        "do-mpc: same problem, by N-1 stages, prior and oldest y in a custom arrival cost. "
        "Starts at its own previous solution, not shifted. Records of multipliers and of "
        "solver statistics switched off."
    )

    def __init__(self, compiled: bool = False) -> None:
        self.compiled = compiled
        self.name = "do-mpc (C)" if compiled else "do-mpc"
        if compiled:
            self.limitations = (
                "do-mpc (C): its compile_nlp raises a NameError after compiling with CasADi "
                "3.8, so what it does is done by hand."
            )
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._started = False

    def setup(self, problem: Problem) -> None:
        """Model, objective and program."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it misses ONNX, which is of no use here
            try:
                import do_mpc
            except ImportError as error:
                raise UnavailableError("not installed: pip install do-mpc") from error
            self._build(do_mpc, problem)
        if self.compiled:
            self._compile()

    def _build(self, do_mpc: Any, problem: Problem) -> None:
        n, p, cost = problem.n, problem.p, problem.cost
        self._stages, self._problem = problem.horizon - 1, problem
        if not self._stages:
            raise UnavailableError("needs N > 1")
        model = do_mpc.model.Model("discrete", "SX")
        x = model.set_variable("_x", "x", shape=(n, 1))
        model.set_variable("_p", "prior", shape=(n, 1))
        model.set_variable("_p", "oldest", shape=(p, 1))
        u = model.set_variable("_tvp", "u", shape=(problem.m, 1)) if problem.m else None
        model.set_rhs("x", problem.step(x, u), process_noise=True)
        model.set_meas("y", problem.output(x), meas_noise=True)
        model.setup()
        mhe = do_mpc.estimator.MHE(model, [])
        mhe.set_param(
            n_horizon=self._stages, t_step=problem.scenario.dt, meas_from_data=False,
            store_full_solution=False, store_lagr_multiplier=False, store_solver_stats=[],
        )
        mhe.settings.supress_ipopt_output()
        w, v, first = mhe._w.cat, mhe._v.cat, mhe._x.cat  # as in its own set_default_objective
        offset, oldest = first - model.p["prior"], model.p["oldest"] - problem.output(first)
        mhe.set_objective(
            w.T @ cost.disturbance @ w + v.T @ cost.noise @ v,
            offset.T @ cost.prior @ offset + oldest.T @ cost.noise @ oldest,
        )
        self._parameters, self._measurements = mhe.get_p_template(), mhe.get_y_template()
        mhe.set_p_fun(lambda _: self._parameters)
        mhe.set_y_fun(lambda _: self._measurements)
        if problem.m:
            self._inputs = mhe.get_tvp_template()
            mhe.set_tvp_fun(lambda _: self._inputs)
        mhe.setup()
        self._mhe = mhe

    def _compile(self) -> None:
        import casadi as ca

        self._folder = tempfile.TemporaryDirectory(prefix="mhe_")
        with chdir(self._folder.name):
            source = self._mhe.S.generate_dependencies("mhe.c")
            library = str(compile_library(Path(source).absolute()))
        self._mhe.S = ca.nlpsol("mhe", "ipopt", library, self._mhe.settings.nlpsol_opts)

    def restart(self) -> None:
        """Forget the former record."""
        self._mhe.reset_history()
        self._started = False

    def update(self, window: WindowData) -> Array:
        """One ``make_step``, from parameters in to trajectory out."""
        mhe, y = self._mhe, window.measurements
        if not self._started:
            mhe.x0 = window.candidate[0]
            mhe.set_initial_guess()
            self._started = True
        self._parameters["prior"] = window.prior
        self._parameters["oldest"] = y[0]
        for k in range(self._stages):
            self._measurements["y_meas", k] = y[k + 1]
            if self._problem.m:
                self._inputs["_tvp", k, "u"] = window.inputs[k]
        mhe.make_step(window.newest)
        states = [state.full().ravel() for state in mhe.opt_x_num["_x", :, -1]]
        states.append(self._problem.system.f(states[-1], window.newest_input))
        return np.array(states)

    def close(self) -> None:
        """Remove generated files."""
        if self._folder is not None:
            self._folder.cleanup()
