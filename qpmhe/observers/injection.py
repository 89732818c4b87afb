"""An observer with a user-defined correction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qpmhe_solvers.values import shown

from .._checks import Array, positive_definite
from ..errors import ModelError
from ..model.residuals import difference
from ..model.system import System
from ..model.tracing import Traced, traced
from .base import Observer, ObserverForm, Sample


class OutputInjection(Observer):
    r"""Any correction :math:`L(z, v)` with :math:`L(\cdot, 0) = 0` (ass:observer_0).

    Parameters
    ----------
    correction : callable
        correction(z, v): maps z (n,) and the fitting error v (p,) to (n,). An estimator raises a
        `ModelError` if the value has the wrong shape, is not finite, or does not vanish for v = 0.
    metric : (n, n) array_like, optional
        As for `Luenberger`.
    """

    def __init__(
        self, correction: Callable[[Array, Array], Any], metric: ArrayLike | None = None
    ) -> None:
        if not callable(correction):
            raise ModelError(
                f"correction is {shown(correction)}; expected a function of z and v."
            )
        self._correction = correction
        self._expressions: dict[tuple[int, int], Traced] = {}
        self._metric = None if metric is None else positive_definite("metric", metric)

    def check(self, system: System, initial_state: Array) -> None:
        """Check that values have shape (n,), and that L(z, 0) = 0; see `Observer.check`."""
        self._check_metric(system)
        generator = np.random.default_rng(20210829)
        # Within the set, as the model and the correction may be defined nowhere else.
        near = initial_state * generator.uniform(0.5, 1.5, (3, system.n))
        if system.scales is not None:
            near += system.scales * generator.uniform(-0.1, 0.1, near.shape)
        if system.states is not None:
            near = np.clip(near, system.states.lower, system.states.upper)
        misfit = _change_of_output(system, initial_state, near[0])
        for z in (initial_state, *near):
            self._check_at(z, misfit)

    def _check_at(self, z: Array, misfit: Array) -> None:
        try:
            with np.errstate(all="ignore"):
                value = np.asarray(self._correction(z.copy(), np.zeros(misfit.size)), np.float64)
        except Exception as error:
            raise ModelError(
                f"correction raised {type(error).__name__}: {error} at z = {z.tolist()}, v = 0."
            ) from error
        if value.shape != z.shape:
            raise ModelError(f"correction returned shape {value.shape}; expected (n,) = {z.shape}.")
        state, fit = z.copy(), misfit.copy()
        try:
            with np.errstate(all="ignore"):
                self._correction(state, fit)
        except Exception:  # bad luck far from the data is for the run
            pass
        if not (np.array_equal(state, z) and np.array_equal(fit, misfit)):
            raise ModelError(
                "correction changes z or v in place; copy them before writing to them."
            )
        if not np.all(value == 0.0):
            raise ModelError(
                f"correction is {value.tolist()} at z = {z.tolist()} and v = 0; an "
                "observer in output-injection form must satisfy L(z, 0) = 0."
            )

    @property
    def c_form(self) -> ObserverForm | None:
        """The correction; of a derived class, which may correct otherwise, `Observer.c_form`."""
        if type(self) is not OutputInjection:
            return super().c_form
        return ObserverForm("injection", correction=self._expression)

    def _expression(self, n: int, p: int) -> Traced:
        """The correction as CasADi has it, compared with the function; found once."""
        if (n, p) not in self._expressions:
            self._expressions[n, p] = traced(self._correction, (n, p), name="correction")
        return self._expressions[n, p]

    def correct(self, z: Array, v: Array, sample: Sample) -> tuple[Array, None]:
        """L(z, v); see `Observer.correct`."""
        # Copies: a correction may write into what it gets in a branch that no check has seen.
        return np.asarray(self._correction(z.copy(), v.copy()), dtype=np.float64), None


def _change_of_output(system: System, one: Array, other: Array) -> Array:
    """The change of h from one state to another: a fitting error (p,) of a usual size."""
    try:
        with np.errstate(all="ignore"):
            first, second = (
                np.array(system.h(x, np.zeros(system.m)), np.float64) for x in (one, other)
            )
    except Exception:  # outside its domain
        return np.zeros(system.p)
    change = difference(system.output_residual, second, first)
    return change if np.isfinite(change).all() else np.zeros(system.p)
