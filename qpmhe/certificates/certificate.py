"""What is certified of an estimator: constants, their evidence, and bounds of its error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import numbers, vector
from ..costs import Cost
from ..errors import InvalidInputError, OptionError, ShapeError
from ..observers import Observer
from ..run import Run
from ..system import System
from .audit import Audit
from .bounds import HorizonBounds
from .choices import Sizes
from .evidence import Evidence, weakest
from .regions import Region
from .results import Detectability, ObserverStability
from .sharper import WindowBound
from .telling import certificate_dict, certificate_text

__all__ = ["Certificate", "Kind"]

Array = NDArray[np.float64]
Kind = Literal["paper", "summed", "weighted", "measured"]

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
    """

    system: System
    observer: Observer
    cost: Cost
    audit: Audit
    detectabilities: tuple[Detectability, ...]
    stabilities: tuple[ObserverStability, ...]
    bounds: Mapping[int, HorizonBounds]
    sizes: Sizes

    @property
    def region(self) -> Region:
        """Where it holds."""
        return self.audit.region

    @cached_property
    def evidence(self) -> Evidence:
        """What the bounds rest on: the weakest evidence among their ingredients'."""
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
        return float(np.linalg.norm((self.region.upper - self.region.lower)[: self.region.n]))

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
            N; the only one, if left out.
        kind : {"paper", "summed", "weighted", "measured"}
            The right-hand side of (eq:RGES_result) with the paper's constants, or beyond the
            paper: with the proof's sums kept, with its norms kept as well, or with the
            estimates' own costs in place of their bound.

        Returns
        -------
        (T + 1,) array
            At t = 0, ..., T.

        Raises
        ------
        ShapeError, OptionError, InvalidInputError
            If an argument does not fit, or there is no such bound.
        """
        w, v = self._along(run, disturbances, noises)
        start = numbers("initial_error", initial_error)
        if start.ndim:
            start = vector("initial_error", start, self.system.n)
        chosen = self.of(horizon)
        if kind == "paper":
            lengths = [x if x.ndim == 1 else np.linalg.norm(x, axis=1) for x in (w, v)]
            return _OUTWARD * chosen.paper.result.bound(
                float(np.linalg.norm(np.atleast_1d(start))), *lengths
            )
        costs = None
        if kind == "measured":
            if run is None:
                raise InvalidInputError("the measured bound needs a run, for its costs.")
            costs = run.costs
        return _OUTWARD * self._window_bound(chosen, kind).bound(start, w, v, costs=costs)

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
        """
        return self.bound(
            None, np.full(steps, float(w_max)), np.full(steps, float(v_max)),
            initial_error=initial_error, horizon=horizon, kind=kind,
        )

    def limit(
        self, w_max: float, v_max: float, *, horizon: int | None = None, kind: Kind = "paper"
    ) -> float:
        """What the funnel tends to as t grows.

        Parameters
        ----------
        w_max, v_max, horizon, kind
            As of `funnel`.
        """
        chosen = self.of(horizon)
        if kind == "paper":
            return _OUTWARD * chosen.paper.result.limit(w_max, v_max)
        return _OUTWARD * self._window_bound(chosen, kind).limit(w_max, v_max)

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

    def _along(
        self, run: Run | None, disturbances: ArrayLike, noises: ArrayLike
    ) -> tuple[Array, Array]:
        w, v = numbers("disturbances", disturbances), numbers("noises", noises)
        steps = len(run) if run is not None else next(
            (len(x) for x in (w, v) if x.ndim), None
        )
        if steps is None:
            raise ShapeError(
                "disturbances and noises are numbers and there is no run; expected a sequence "
                "for one of them, to tell how many steps there are."
            )
        for name, x, width in (
            ("disturbances", w, self.system.n), ("noises", v, self.system.p)
        ):
            if x.ndim and x.shape not in ((steps,), (steps, width)):
                raise ShapeError(
                    f"{name} has shape {x.shape}; expected ({steps}, {width}), their lengths "
                    f"({steps},), or a number."
                )
        return (
            w if w.ndim else np.full(steps, float(w)), v if v.ndim else np.full(steps, float(v))
        )

    def _window_bound(self, chosen: HorizonBounds, kind: Kind) -> WindowBound:
        if kind not in get_args(Kind):
            raise OptionError(f"kind is {kind!r}; expected one of {list(get_args(Kind))}.")
        bound: WindowBound | None = chosen.sharpest() if kind == "measured" else (
            chosen.weighted if kind == "weighted" else chosen.summed
        )
        if bound is None:
            raise OptionError(
                f"kind is {kind!r}, for which there is no bound here; expected one of "
                f"{list(self.kinds)}. The weighted one needs a quadratic cost and constants "
                "that were certified, not assumed."
            )
        return bound
