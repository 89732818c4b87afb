"""The observer's proved bound in the rows of a record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._checks import Array
from ..certificates.monitor import Monitor
from ..certificates.observer_bound import ObserverBound, bound_observer
from ..certificates.report import initial_error, region_of, sizes_of
from ..certificates.sizes import Size, stated_size
from ..errors import OptionError
from ..estimation.estimate import Estimate
from ..model.sets import Box
from .record_model import RecordModel

_SECONDS = 30.0


@dataclass(frozen=True)
class BoundOptions:
    """Sets and sizes for the bound; the model and its scenario supply what is left out.

    Parameters
    ----------
    box, input_box : Box, optional
        The sets in which state and observer stay, and in which the inputs stay.
    initial_error, max_disturbance, max_noise : float or array_like, optional
        Bounds of x_0 - z_0, w and v: one number for the length, or one for each component.
    """

    box: Box | None = None
    input_box: Box | None = None
    initial_error: ArrayLike | None = None
    max_disturbance: ArrayLike | None = None
    max_noise: ArrayLike | None = None

    def identity(self) -> dict[str, Any]:
        """What a resumed run must share, as plain numbers."""
        found: dict[str, Any] = {}
        for name in (each.name for each in fields(self)):
            value = getattr(self, name)
            if isinstance(value, Box):
                value = [value.lower.tolist(), value.upper.tolist()]
            found[name] = None if value is None else np.asarray(value).tolist()
        return found


class RowBounds:
    """Follows the bound through a record, and provides the columns of each row.

    A `NotCertifiedError` or `CertificateError` is raised if nothing is certified, an `OptionError`
    if the model does not give what the options leave out.
    """

    def __init__(
        self, model: RecordModel, options: BoundOptions,
        report: Callable[[str], None] | None = None,
    ) -> None:
        mhe, scenario = model.estimator, model.scenario
        system, n = mhe.system, mhe.system.n
        region = region_of(
            system, scenario, options.box, options.input_box, option="--bound-box"
        )
        sizes = sizes_of(
            system, mhe.cost, scenario, options.max_disturbance, options.max_noise
        )
        start: Size | None = None if scenario is None else initial_error(scenario)
        if options.initial_error is not None:
            start = stated_size("--initial-error", options.initial_error, n)
        if start is None:
            raise OptionError(
                "--initial-error is missing, and the model has no scenario that states how far the "
                "first state is from the first estimate; give one number for each state."
            )
        self.proved: ObserverBound = bound_observer(
            system, mhe.observer, mhe.cost, region, sizes=sizes, seconds=_SECONDS
        )
        self._watch = Monitor(self.proved, mhe, initial_error=start, sizes=sizes)
        self._report, self._estimator = report, mhe
        self._fields = np.empty(2 * n + 1)

    @staticmethod
    def header(states: tuple[str, ...]) -> list[str]:
        """Names of the columns."""
        return [
            *(f"{side}_predicted_{name}" for side in ("lower", "upper") for name in states),
            "bound_predicted",
        ]

    def check(self, estimate: Estimate, u: Array, dt: float | None, time: str) -> None:
        """Process an estimate; report once what ends the bound."""
        held = self._watch.lost is None
        usual = self._estimator.usual.parameters
        full = u if usual is None else np.append(u, usual)
        reading = self._watch.check(estimate, full, dt=dt)
        if held and reading.lost is not None and self._report is not None:
            self._report(
                f"the observer's bound ends at the sample of time {time}: {reading.reason}. Its "
                "columns are empty from there on."
            )
        self._fields = np.array([*reading.lower, *reading.upper, reading.error])

    @property
    def numbers(self) -> list[float]:
        """The columns of the newest row; NaN once the bound has ended."""
        return self._fields.tolist()

    @property
    def note(self) -> str:
        """What was proved, and how far it held."""
        until = "" if self._watch.lost is None else f"; it ended: {self._watch.reason}"
        return f"{self.proved.headline} for {self.proved.sizes}{until}"

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` restores."""
        return self._watch.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where another run stopped."""
        self._watch.load_state_dict(state)

