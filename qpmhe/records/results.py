"""Columns of the results, and a sample's row of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np

from ..errors import InvalidInputError, OptionError
from ..estimate import Estimate, Status
from ..estimator import MovingHorizonEstimator

__all__ = ["Covariances", "Results"]

Covariances = Literal["none", "std", "full"]

#: Columns whose values are no numbers with a fraction.
TEXTS, COUNTS = ("status",), ("qps", "inserted")


class Results:
    """What is written of each sample.

    Parameters
    ----------
    states : tuple of str
        Names of the states.
    covariances : {"none", "std", "full"}
        Standard deviations of the states, or the upper triangles of their covariances.
    step_time : bool
        Whether to write the seconds of each step, which are never the same twice.

    Attributes
    ----------
    header : list of str
        Names of the columns.

    Raises
    ------
    OptionError
        If covariances is none of the three.
    """

    def __init__(
        self, states: tuple[str, ...], covariances: str = "none", step_time: bool = True
    ) -> None:
        if covariances not in get_args(Covariances):
            raise OptionError(
                f"--covariances is {covariances!r}; expected {', '.join(get_args(Covariances))}."
            )
        n = len(states)
        self._covariances, self._step_time = covariances, step_time
        # No column for one matrix entry twice.
        self._rows, self._columns = np.triu_indices(n)
        uncertainties: list[str] = []
        for kind in ("filtered", "predicted"):
            if covariances == "std":
                uncertainties += [f"std_{kind}_{name}" for name in states]
            elif covariances == "full":
                uncertainties += [
                    f"cov_{kind}_{states[i]}_{states[j]}"
                    for i, j in zip(self._rows, self._columns, strict=True)
                ]
        self.header = [
            "time",
            *(f"filtered_{name}" for name in states),
            *(f"predicted_{name}" for name in states),
            *uncertainties,
            "cost", "candidate_cost", "status", "qps", "inserted",
        ]
        if step_time:
            self.header.append("step_time")

    def row(
        self, time: str, estimate: Estimate, estimator: MovingHorizonEstimator, inserted: int
    ) -> list[str]:
        """The fields of a sample; numbers with all their digits, blank where there is none.

        Parameters
        ----------
        time : str
            Its time.
        estimate : Estimate
            The estimate with this sample.
        estimator : MovingHorizonEstimator
            Where it comes from.
        inserted : int
            Samples without measurement since the row before.
        """
        numbers = [*estimate.filtered.tolist(), *estimate.state.tolist()]
        if self._covariances != "none":
            numbers += self._uncertainties(estimator)
        fields = [
            time, *map(_field, numbers), _field(estimate.cost), _field(estimate.candidate_cost),
            words(estimate.status), str(estimate.qps), str(inserted),
        ]
        if self._step_time:
            fields.append(f"{estimate.step_time:.3g}")
        return fields

    def _uncertainties(self, estimator: MovingHorizonEstimator) -> list[float]:
        full = self._covariances == "full"
        try:
            both = estimator.covariances()[-2:]
        except (InvalidInputError, np.linalg.LinAlgError):  # bad luck: the record goes on
            n = estimator.system.n
            both = np.full((2, n, n), np.nan)
        chosen: Callable[[Any], Any] = (
            (lambda one: one[self._rows, self._columns]) if full
            else (lambda one: np.sqrt(np.diagonal(one)))
        )
        with np.errstate(invalid="ignore"):
            return [value for one in both for value in chosen(one).tolist()]


def words(status: Status) -> str:
    """A status as results have it: its flags' names, with bars in between."""
    return str(status).removeprefix("Status.")


def _field(value: float) -> str:
    return "" if value != value else repr(value)
