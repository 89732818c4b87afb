"""Whether the model's integration step is too long, as the record judges it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..model.residuals import difference
from ..model.system import System
from .bank import Array, FilterBank, Filtered, Hypothesis
from .findings import Finding, Names, number
from .search import explains

# A step that is off by less than this share of a standard deviation of w does no harm.
_HARMLESS = 0.1
# At so many states along the record it is compared with two of half the length.
_COMPARED = 200
# Substeps of Radau IIA that take its place.
_METHOD, _SUBSTEPS = "radau", 4


class Finer(NamedTuple):
    """The same model by shorter steps, what filters it, the result, and the finding."""

    system: System
    bank: FilterBank
    filtered: Filtered
    finding: Finding


def finer(
    bank: FilterBank, base: Hypothesis, null: Filtered, steps: Array | None, names: Names
) -> Finer | None:
    """The model by shorter steps, if its own are too long and the record is likelier with those.

    An Euler map that is meant as such is off, too, but its record is no likelier with others.

    Parameters
    ----------
    bank : FilterBank
        Filters of the model as it is.
    base, null : Hypothesis, Filtered
        The record, and its filter.
    steps : (T,) array or None
        Lengths of the steps, as of the bank.
    names : Names
        Names of the states.
    """
    system = bank.system
    if not system.has_timed or system.dt is None:
        return None
    error, component = _error(bank, base, null)
    if error <= _HARMLESS:
        return None
    count = _SUBSTEPS * (system.steps if system.method == _METHOD else 1)
    other = system.discretized(_METHOD, count)
    if other is None:
        return None
    other_bank = FilterBank(other, steps, bank.before)
    found = other_bank.run([base])
    if not explains(base, null.logs[:, 0], found.logs[:, 0]):
        return None
    substeps = f"{system.steps} substeps" if system.steps > 1 else "one step"
    size = (
        f"differs from steps of half the length by up to {number(error)} standard deviations of "
        f"the disturbance in {names.states[component]}" if np.isfinite(error)
        else "is not finite along the record"
    )
    return Finer(other, other_bank, found, Finding(
        "discretization",
        f"The integration step is too long: {substeps} of {system.method} in dt = {system.dt:g} "
        f"{size}, and the record is far more likely with shorter ones.",
        f"Discretise the model with method={_METHOD!r} and steps={count}, or with more steps of "
        f"{system.method}. What follows was found with that.",
    ))


def _error(bank: FilterBank, base: Hypothesis, null: Filtered) -> tuple[float, int]:
    """The largest difference of one step and two of half the length, and of which state."""
    with np.errstate(all="ignore"):
        deviations = np.sqrt(base.disturbance.diagonal())
        units = np.where(deviations > 0.0, deviations, np.sqrt(base.prior.diagonal()))
        known = np.flatnonzero(np.isfinite(null.corrected).all(axis=1))
        if not known.size:
            return np.inf, 0
        at = known[:: max(1, known.size // _COMPARED)]
        x, full = null.corrected[at], bank.full_inputs(base.inputs)[at]
        half = full.copy()
        half[:, -1] *= 0.5
        f = bank.model.f.batch
        try:
            shares = np.abs(difference(
                bank.system.state_residual, f(x, full), f(f(x, half), half)
            )) / units
        except Exception:  # outside of the model's domain
            return np.inf, 0
    shares[~np.isfinite(shares)] = np.inf
    k, j = np.unravel_index(int(np.argmax(shares)), shares.shape)
    return float(shares[k, j]), int(j)
