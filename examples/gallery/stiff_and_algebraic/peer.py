"""do-mpc's moving horizon estimation on the same model: collocation, solved by Ipopt."""

from __future__ import annotations

import contextlib
import io
import warnings
from importlib import import_module
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from ..problem import Array
from .plants import Plant


class DoMpc:
    """An estimator of do-mpc: Radau's collocation of the same order and substeps.

    The prior is around the second state of the last solution, with a constant weight. The parameter
    is constant in each window, and the disturbance is a rate. do-mpc has neither missing
    measurements nor windows shorter than N. Parameters that vary in time take their place: a
    missing measurement has weight zero, and before the first sample the state stands still.

    Parameters
    ----------
    plant : Plant
        The model and its covariances.
    start : (n,) array
        The first estimate, with the parameters behind it.
    horizon : int
        N.
    prior : (n, n) array
        Covariance of the first state of a window, with the parameters behind it.
    rates : (n, n) array
        Covariance of the disturbance.
    """

    engine = "Ipopt"

    def __init__(
        self, plant: Plant, start: Array, horizon: int, prior: Array, rates: Array
    ) -> None:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")  # it misses ONNX, which is of no use here
            do_mpc: Any = import_module("do_mpc")

            self._plant, self._horizon = plant, horizon
            model = do_mpc.model.Model("continuous", "SX")
            counts = {"_x": plant.n, "_z": len(plant.algebraic), "_u": len(plant.inputs[0]),
                      "_p": plant.parameters}
            parts = [
                [model.set_variable(kind, f"{kind[1]}{i}") for i in range(size)]
                for kind, size in counts.items()
            ]
            moving, rest, outputs = plant.equations(*parts, ca)
            runs = model.set_variable("_tvp", "runs")
            for i, one in enumerate(moving):
                model.set_rhs(f"x{i}", runs * one, process_noise=True)
            for i, one in enumerate(rest):
                model.set_alg(f"g{i}", one)
            for i, one in enumerate(outputs):
                model.set_meas(f"y{i}", one, meas_noise=True)
            for i, one in enumerate(parts[2]):
                model.set_meas(f"u{i}", one, meas_noise=False)
            seen = model.set_variable("_tvp", "seen", shape=(len(outputs), 1))
            model.setup()
            names = [f"p{i}" for i in range(plant.parameters)]
            self._mhe = mhe = do_mpc.estimator.MHE(model, names)
            mhe.set_param(
                n_horizon=horizon, t_step=plant.dt, meas_from_data=True,
                store_full_solution=False, state_discretization="collocation",
                collocation_type="radau", collocation_deg=3, collocation_ni=plant.substeps,
                store_solver_stats=[],
            )
            mhe.settings.supress_ipopt_output()
            n = plant.n
            mhe.set_default_objective(
                P_x=np.linalg.inv(prior[:n, :n]),
                P_w=ca.DM(np.linalg.inv(rates)) * (1 + 1e4 * (1 - runs)),
                P_v=ca.diag(seen / ca.DM(np.square(plant.noise))),
                P_p=np.linalg.inv(prior[n:, n:]) if names else None,
            )
            self._template = mhe.get_tvp_template()
            self._seen, self._now = np.ones((1, len(outputs)), dtype=bool), 0
            mhe.set_tvp_fun(self._weights)
            for kind, first, least in (
                ("_x", "x", plant.least[:n]), ("_p_est", "p", plant.least[n:])
            ):
                for i, bound in enumerate(least):
                    if np.isfinite(bound):
                        mhe.bounds["lower", kind, f"{first}{i}"] = bound
            mhe.setup()
        self.reset(start)

    def reset(self, start: Array) -> None:
        """Begin again."""
        plant, mhe, n = self._plant, self._mhe, self._plant.n
        mhe.reset_history()
        mhe.x0, mhe.u0 = start[:n], np.mean(plant.inputs, axis=0)
        if plant.algebraic:
            mhe.z0 = np.array(plant.algebraic)
        if plant.parameters:
            mhe.p_est0 = start[n:]
        mhe.set_initial_guess()

    def run(self, measurements: Array, inputs: Array) -> SimpleNamespace:
        """Estimates and times of a record, as the gallery reads them."""
        self._seen = ~np.isnan(measurements)
        last, found, times = np.zeros(measurements.shape[1]), [], []
        for t, y in enumerate(measurements):
            last = np.where(self._seen[t], y, last)
            self._now = t
            # A sample has the input before it.
            sample = np.concatenate((last, inputs[max(t - 1, 0)]))
            began = perf_counter()
            x = self._mhe.make_step(sample[:, None]).ravel()
            times.append(perf_counter() - began)
            found.append(np.concatenate((x, self._mhe.p_est0.cat.full().ravel())))
        return SimpleNamespace(filtered=np.array(found), times=np.array(times))

    def _weights(self, _: float) -> Any:
        """Which outputs each sample of the window has, and whether time runs towards it."""
        for i in range(self._horizon):
            t = self._now - self._horizon + 1 + i
            self._template["_tvp", i, "seen"] = 1.0 * (self._seen[max(t, 0)] & (t >= 0))
            self._template["_tvp", i, "runs"] = float(t > 0)
        return self._template
