"""What is certified of an estimator: constants, their evidence, and bounds of its error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import count, numbers, vector
from ..costs import Cost
from ..errors import InvalidInputError, OptionError
from ..observers import Observer
from ..run import Run
from ..system import System
from .arguments import checked_length
from .audit import Audit
from .horizon_bounds import HorizonBounds, Kind, window_bound
from .choices import Sizes
from .errors import CertificateError
from .evidence import Evidence, weakest
from .observer import constant_gain
from .provenance import fitting
from .regions import Region
from .properties import Detectability, ObserverStability
from .signals import signals
from .sources import checked_costs
from .telling import certificate_dict, certificate_text

if TYPE_CHECKING:
    from ..estimator import MovingHorizonEstimator
    from .monitor import Monitor

__all__ = ["Certificate", "Kind"]

Array = NDArray[np.float64]

# The constants are upper bounds, what is computed from them is not: this covers its rounding.
_OUTWARD = 1.0 + 1e-9


@dataclass(frozen=True, eq=False)
class Certificate:
    """The theorem's constants for a system, an observer and a cost on a set of states.

    Made by `certify`.

    Parameters
    ----------
    system, observer, cost
        What the estimator is made of.
    audit : Audit
        The assumptions, one by one.
    detectabilities, stabilities : tuple
        What was certified of system and observer, at several rates; each bound uses those
        that make it tightest.
    bounds : mapping of int to HorizonBounds
        For each horizon.
    sizes : Sizes
        For which errors the bounds are tight.
    origin : tuple
        What `certify` made it of. A certificate whose parts are others, or that was made by
        hand, is assumed.

    Raises
    ------
    MismatchError
        If a part is of another system or gain, or does not hold on the whole region.
    """

    system: System
    observer: Observer
    cost: Cost
    audit: Audit
    detectabilities: tuple[Detectability, ...]
    stabilities: tuple[ObserverStability, ...]
    bounds: Mapping[int, HorizonBounds]
    sizes: Sizes
    origin: tuple[Any, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        for detected in self.detectabilities:
            fitting(detected, self.system, self.region, self.gain, thorough=False)
        for observed in self.stabilities:
            fitting(observed, self.system, self.region, self.gain, thorough=False)

    @cached_property
    def gain(self) -> Array | None:
        """The observer's constant gain, if it has one."""
        try:
            return constant_gain(self.observer, self.system)
        except CertificateError:
            return None

    @property
    def ingredients(self) -> tuple[Any, ...]:
        """All that a certificate is made of, to be compared with its origin."""
        return (
            self.system, self.observer, self.cost, self.audit, self.bounds, self.sizes,
            *self.detectabilities, *self.stabilities,
        )

    @property
    def region(self) -> Region:
        """Where it holds."""
        return self.audit.region

    @cached_property
    def evidence(self) -> Evidence:
        """What the bounds rest on: the weakest evidence among their ingredients'."""
        mine = self.ingredients
        if len(mine) != len(self.origin) or any(
            one is not other for one, other in zip(mine, self.origin, strict=True)
        ):
            return Evidence.ASSUMED
        used = [self.audit[name].evidence for name in (
            "output Lipschitz", "no correction without error", "correction bound", "cost bounds"
        )]
        return weakest([
            *(each for each in used if each is not None),
            *(each.evidence for each in self.detectabilities),
            *(each.evidence for each in self.stabilities),
        ])

    @property
    def horizons(self) -> tuple[int, ...]:
        """The horizons that there are bounds for."""
        return tuple(self.bounds)

    @cached_property
    def diameter(self) -> float:
        """The largest distance of two states of the region, or a little more."""
        return self.region.diameter

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of bounds that there are, the sharpest last."""
        first = self.bounds[self.horizons[0]]
        kinds: list[Kind] = ["paper"]
        if first.summed is not None:
            kinds.append("summed")
        if first.weighted is not None:
            kinds.append("weighted")
        if len(kinds) > 1:
            kinds.append("measured")
        return tuple(kinds)

    def bound(
        self,
        run: Run | None,
        disturbances: ArrayLike,
        noises: ArrayLike,
        *,
        initial_error: ArrayLike,
        horizon: int | None = None,
        kind: Kind = "paper",
        source: MovingHorizonEstimator | Monitor | None = None,
    ) -> Array:
        """The bound of the error |x(t) - x_hat(t)| along a run.

        Parameters
        ----------
        run : Run or None
            The run, whose costs ``kind="measured"`` uses. None where there is none; then
            disturbances or noises tell the length.
        disturbances, noises : array_like
            w(t) and v(t) as (T, n) and (T, p), their Euclidean lengths (T,), or a number:
            a bound on the length at all times.
        initial_error : (n,) array_like or float
            x_0 - z_0, or a bound on its length.
        horizon : int, optional
            N; that of the source, or the only one, if left out.
        kind : {"paper", "summed", "weighted", "measured"}
            The right-hand side of (eq:RGES_result) with the paper's constants, or beyond the
            paper: with the proof's sums kept, with its norms kept as well, or with the
            estimates' own costs in place of their bound.
        source : MovingHorizonEstimator or Monitor, optional
            The estimator that made the run, as the run left it, or the monitor that checked
            all its estimates: a run does not tell of which horizon and cost it is. Checked
            where given, and needed for ``kind="measured"``; without one, the bound is that
            of an estimator with this certificate's cost and this horizon, whatever the run.

        Returns
        -------
        (T + 1,) array
            At t = 0, ..., T.

        Raises
        ------
        ShapeError, OptionError, InvalidInputError
            If an argument does not fit, or there is no such bound.
        MismatchError
            If the source is of another system, observer, cost or horizon, or did not make
            the run.
        """
        w, v = signals(self.system, run, disturbances, noises)
        start = numbers("initial_error", initial_error)
        if start.ndim:
            start = vector("initial_error", start, self.system.n)
        else:
            checked_length("initial_error", start)
        if source is not None and horizon is None:
            horizon = getattr(source, "horizon", None)
        chosen = self.of(horizon)
        costs = None
        if source is not None:
            costs = checked_costs(self, source, run, chosen.paper.horizon)
        elif kind == "measured":
            raise InvalidInputError(
                "the measured bound has no source, and a run does not tell of which horizon and "
                "cost it is; pass the estimator that made it (source=estimator), or the monitor "
                "that checked it (source=monitor)."
            )
        if kind == "paper":
            lengths = [x if x.ndim == 1 else np.linalg.norm(x, axis=1) for x in (w, v)]
            return _OUTWARD * chosen.paper.result.bound(
                float(np.linalg.norm(np.atleast_1d(start))), *lengths
            )
        if kind != "measured":
            costs = None
        return _OUTWARD * window_bound(chosen, kind, self.kinds).bound(start, w, v, costs=costs)

    def funnel(
        self,
        w_max: float,
        v_max: float,
        *,
        initial_error: float,
        steps: int,
        horizon: int | None = None,
        kind: Kind = "paper",
    ) -> Array:
        """The bound before anything is measured, for all |w| <= w_max and |v| <= v_max.

        Parameters
        ----------
        w_max, v_max : float
            Bounds on the lengths of w(t) and v(t).
        initial_error : float
            A bound on |x_0 - z_0|.
        steps : int
            T.
        horizon, kind
            As of `bound`; not "measured".

        Returns
        -------
        (T + 1,) array

        Raises
        ------
        OptionError
            If a length is negative or not finite, the steps are no integer, or there is no
            such bound.
        """
        w, v = checked_length("w_max", w_max), checked_length("v_max", v_max)
        start = checked_length("initial_error", initial_error)
        if kind == "measured":
            raise OptionError(
                "kind is 'measured', but nothing is measured yet; expected one of "
                f"{[each for each in self.kinds if each != 'measured']}."
            )
        length = count("steps", steps, 1)
        return self.bound(
            None, np.full(length, w), np.full(length, v), initial_error=start, horizon=horizon,
            kind=kind,
        )

    def limit(
        self, w_max: float, v_max: float, *, horizon: int | None = None, kind: Kind = "paper"
    ) -> float:
        """What the funnel tends to as t grows.

        Parameters
        ----------
        w_max, v_max, horizon, kind
            As of `funnel`.

        Raises
        ------
        OptionError
            As of `funnel`.
        """
        w, v = checked_length("w_max", w_max), checked_length("v_max", v_max)
        chosen = self.of(horizon)
        if kind == "paper":
            return _OUTWARD * chosen.paper.result.limit(w, v)
        return _OUTWARD * window_bound(chosen, kind, self.kinds).limit(w, v)

    def vacuous(
        self,
        w_max: float | None = None,
        v_max: float | None = None,
        *,
        horizon: int | None = None,
        kind: Kind = "paper",
    ) -> bool:
        """Whether the bound tells nothing: its limit is no less than the region's diameter.

        State and estimate are both in the region, so that their distance is never more.

        Parameters
        ----------
        w_max, v_max : float, optional
            As of `funnel`; left out, the certificate's `sizes`.
        horizon, kind
            As of `funnel`.

        Raises
        ------
        OptionError
            As of `funnel`.
        """
        w = self.sizes.disturbance if w_max is None else w_max
        v = self.sizes.noise if v_max is None else v_max
        return not self.limit(w, v, horizon=horizon, kind=kind) < self.diameter

    def of(self, horizon: int | None = None) -> HorizonBounds:
        """The constants for a horizon.

        Parameters
        ----------
        horizon : int, optional
            N; may be left out if there is only one.

        Raises
        ------
        OptionError
            If there are none for it.
        """
        if horizon is None and len(self.bounds) == 1:
            return next(iter(self.bounds.values()))
        if horizon is None or horizon not in self.bounds:
            raise OptionError(
                f"horizon is {horizon!r}; expected one of {list(self.bounds)}, for which there "
                "are constants. Certify again with this horizon."
            )
        return self.bounds[horizon]

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows; infinite numbers become None."""
        return certificate_dict(self)

    def summary(self) -> str:
        """The certificate in some lines of text."""
        return certificate_text(self)
