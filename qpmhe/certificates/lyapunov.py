r"""Weights, discount and horizon from a Lyapunov function of detectability, and their bounds.

`docs/explanation/lyapunov.md` derives every inequality.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import Array, choice, count, numbers
from ..costs import QuadraticCost
from ..errors import OptionError, ShapeError
from ..estimation.estimate import Status
from ..estimation.estimator import MovingHorizonEstimator
from ..estimation.run import Run
from ..model.sets import Box, ConvexSet
from ..model.system import System, checked_system
from ..terms.hold import Hold
from ..terms.sum import further_terms
from .contraction import _undetectable
from .deadline import DEFAULT_SECONDS, Deadline
from .evidence import Evidence, MismatchError, json_ready
from .inequalities import Form
from .invariance import supports
from .model_values import ModelValues
from .norms import initial_length, largest_ratio
from .regions import Region, bounded_region
from .sdp import started
from .search import Search
from .sizes import OUTWARD, Size, Sizes, lengths_of

_SUMS = 1.0 + 1e-9  # covers the rounding of a sum over a horizon, and of roots
_TOO_SHORT = 1e6
_ROOM = 1.1  # how far the proposed horizon's limit may be above the one of endless horizons
_BROKEN = Status.MISSING | Status.MODEL_FAILED | Status.FAILED_STAGE  # J is another cost


@dataclass(frozen=True, eq=False)
class Design:
    r"""A discounted cost that fits a Lyapunov function of detectability, made by `design`.

    With the weights P, Q, R and the discount :math:`\gamma`, for any two states of the region,

    .. math::
        |f(x_1) + w_1 - f(x_2) - w_2|_P^2 \le \gamma |x_1 - x_2|_P^2 + |w_1 - w_2|_Q^2
        + |h(x_1) - h(x_2)|_R^2 .

    So :math:`|\hat x - x|_P \le \sqrt{J(\hat x)} + \sqrt{J(x)}` at the end of a window whose prior
    is the estimate N samples before, as with ``candidate="reinitialized"``. Bounds are of
    :math:`|\hat x - x|_P`; `components` converts them to the states' units. They hold while truth
    and estimates stay in the region.

    Parameters
    ----------
    system, region
        The system, and the region where the design holds.
    form : Form
        The inequality that was verified.
    discount : float
        gamma.
    sizes : Sizes
        The largest disturbances and noises.
    horizon : int
        The given one, or the least one whose limit for a minimiser is at most a tenth above the
        limit of infinite horizons.
    evidence : Evidence
        The evidence for the inequality.
    notes : tuple of str
        Further remarks.
    model : ModelValues or None
        Values of f and h when it was made, of which `along` refuses others.
    """

    system: System
    region: Region
    form: Form
    discount: float
    sizes: Sizes
    horizon: int
    evidence: Evidence
    notes: tuple[str, ...] = ()
    model: ModelValues | None = None

    @property
    def prior(self) -> Array:
        """P, the weight of the prior, (n, n)."""
        return self.form.P

    @property
    def disturbance(self) -> Array:
        """Q, the weight of the disturbance, (r, r)."""
        return self.form.Q

    @property
    def noise(self) -> Array:
        """R, the weight of the noise, (p, p)."""
        return self.form.R

    def cost(self) -> QuadraticCost:
        """The cost of the design, for an estimator with ``candidate="reinitialized"``."""
        return QuadraticCost(
            prior=self.prior, disturbance=self.disturbance, noise=self.noise,
            discount=self.discount,
        )

    def contraction(self, horizon: int | None = None) -> float:
        """The factor on a minimiser's error over a window whose prior is an estimate."""
        return 2.0 * math.sqrt(self.discount ** self._horizon(horizon))

    def least_horizon(self) -> int:
        """The least N for which a minimiser's error contracts."""
        return _least(self.discount, 0.25)

    def limit(self, horizon: int | None = None) -> float:
        """Limit of a minimiser's bound for the design's largest disturbances and noises.

        Infinite where its error does not contract.
        """
        (supply,) = self._supply(None, None, 1)
        factor = growth(self.discount, self._horizon(horizon))
        return math.sqrt(float(supply) * factor) * OUTWARD if supply else 0.0

    def _horizon(self, horizon: int | None) -> int:
        return self.horizon if horizon is None else count("horizon", horizon, 1)

    def components(self, bound: ArrayLike) -> Array:
        """Bounds of each component's error, (..., n), from bounds in the design's norm."""
        slopes = supports(self.prior, np.eye(len(self.prior)))
        return np.multiply.outer(numbers("bound", bound, finite=False), slopes) * OUTWARD

    def length(self, bound: ArrayLike) -> Array:
        """Bounds of the error's Euclidean length, from bounds in the design's norm."""
        found: Array = numbers("bound", bound, finite=False)
        return found * largest_ratio(np.eye(len(self.prior)), self.prior)

    def along(
        self, run: Run, source: MovingHorizonEstimator, *, initial_error: Size,
        disturbances: Size | None = None, noises: Size | None = None,
        kind: Literal["measured", "minimiser"] = "measured",
    ) -> Array:
        r"""The bound of :math:`|\hat x(t) - x(t)|_P` along a run at t = 0, ..., T, (T + 1,).

        NaN where something in the window broke it: a missing measurement, a failed model, an input
        or step that is not certified. A window after that starts from the region's size.

        Parameters
        ----------
        run : Run
            The run, with its costs and flags.
        source : MovingHorizonEstimator
            The estimator that made it, with the design's `cost` and
            ``candidate="reinitialized"``. Its horizon is the bound's.
        initial_error : (n,) array_like, float or set
            x(0) minus the first guess, a bound on its length, or a set that contains it.
        disturbances, noises : optional
            w(t) and v(t), as in `ObserverBound.along`; left out, `sizes`.
        kind : {"measured", "minimiser"}
            The bound on the estimate's cost: its known value, for any number of QPs; or J(x), as
            for a global minimiser, which converged QPs do not prove.

        Raises
        ------
        MismatchError
            If the estimator has another system, cost, candidate or arrival than the bound, or the
            system has changed since.
        ShapeError, OptionError, SetError
            If an argument does not fit.
        """
        choice("kind", kind, ("minimiser", "measured"))
        self._check(source)
        steps, N, gamma = len(run), source.horizon, self.discount
        supply, spoilt = self._supply(disturbances, noises, steps), np.zeros(steps, np.bool_)
        for k in np.flatnonzero(self._unusual(run)).tolist():
            spoilt[k : k + N] = True
        width = (self.region.upper - self.region.lower)[: self.system.n]
        widest = float(lengths_of("the region", Box(-width, width), self.prior))
        bound = np.full(steps + 1, math.nan)
        bound[0] = initial_length(initial_error, self.prior)
        for t in (np.flatnonzero(~spoilt) + 1).tolist():
            first: int = max(t - N, 0)
            own = float(np.fmin(bound[first], widest)) if first else float(bound[0])
            ages = gamma ** np.arange(t - first - 1.0, -1.0, -1.0)
            truth = math.sqrt(gamma ** (t - first) * own**2 + float(ages @ supply[first:t]))
            estimate = truth if kind == "minimiser" else math.sqrt(run.costs[t - 1])
            bound[t] = (truth + estimate) * _SUMS
        return bound

    def _unusual(self, run: Run) -> NDArray[np.bool_]:
        """The samples with another cost, an input outside of the region, or an unusual step."""
        found, source, n = (run.flags & _BROKEN.value).astype(np.bool_), run.source, self.system.n
        if source is not None and source.inputs is not None:
            low, high = self.region.lower[n:], self.region.upper[n:]
            found |= ((source.inputs < low) | (source.inputs > high)).any(axis=1)
        if source is not None and source.steps is not None:
            found |= np.asarray(source.steps) != source.system.dt
        return found

    def _supply(self, w: Size | None, v: Size | None, steps: int) -> Array:
        """What the truth costs at each sample, (T,)."""
        w, v = self.sizes.disturbance if w is None else w, self.sizes.noise if v is None else v
        parts = (
            lengths_of("disturbances", w, self.disturbance), lengths_of("noises", v, self.noise)
        )
        if any(each.shape not in ((), (steps,)) for each in parts):
            raise ShapeError(
                f"disturbances or noises do not have {steps} samples, as the run has; expected as "
                "many vectors, or bounds for all times."
            )
        return np.broadcast_to(parts[0] ** 2 + parts[1] ** 2, (steps,))

    def _check(self, source: MovingHorizonEstimator) -> None:
        """Raise a `MismatchError` unless the bound is of this estimator."""
        cost, settings = source.cost, source.settings
        same = isinstance(cost, QuadraticCost) and cost.discount == self.discount and all(
            np.array_equal(getattr(cost, name), getattr(self, name))
            for name in ("prior", "disturbance", "noise")
        )
        further = further_terms(source.system, cost, (Hold,))
        for differs, text in (
            (source.system is not self.system, "has another system; make a design for that"),
            (not same or source.has_changed or settings.arrival != "observer",
             "has other weights, another discount, or arrival='smoothed'; make it with "
             "cost=design.cost() and leave arrival out"),
            (source.system.held, "holds parameters, a term of J that the bound does not have; make "
             "its system without hold"),
            (further, f"has a term of J for {further}, which the bound does not have; make it "
             "without"),
            (settings.candidate != "reinitialized",
             f"has candidate={settings.candidate!r}, whose prior is the running observer's; make "
             "it with candidate='reinitialized', or take the observer's bound"),
        ):
            if differs:
                raise MismatchError(f"the estimator {text}.")
        changed = "" if self.model is None else self.model.difference(source.system)
        if changed:
            raise MismatchError(
                f"the estimator's system is another than was certified: {changed}; make a design "
                "for the system as it is now."
            )

    def code(self) -> str:
        """Python code that makes the cost, with the horizon and candidate that belong to it."""

        def text(matrix: Array) -> str:
            rows = (", ".join(f"{value:.8g}" for value in row) for row in matrix)
            return f"[{', '.join(f'[{row}]' for row in rows)}]"

        return (
            f"cost = qpmhe.QuadraticCost(\n    prior={text(self.prior)},\n"
            f"    disturbance={text(self.disturbance)},\n    noise={text(self.noise)},\n"
            f"    discount={self.discount!r},\n)\n"
            "mhe = qpmhe.MovingHorizonEstimator(\n"
            f'    system, observer, cost, horizon={self.horizon}, candidate="reinitialized",\n'
            "    initial_state=initial_state,\n)\n"
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything in types that JSON knows; infinite numbers become None."""
        names = (
            "prior", "disturbance", "noise", "discount", "horizon", "region", "sizes", "evidence",
            "notes",
        )
        content: dict[str, Any] = json_ready({name: getattr(self, name) for name in names} | {
            "contraction": self.contraction(), "least_horizon": self.least_horizon(),
            "limit": self.components(self.limit()),
        })
        return content


def _least(gamma: float, share: float) -> int:
    """The least horizon N with gamma^N < share."""
    return math.floor(math.log(share) / math.log(gamma)) + 1


def growth(gamma: float, horizon: int | None) -> float:
    r"""The square of the limit for a supply of 1: :math:`4 S / (1 - 4 \gamma^N)`, S its sum."""
    left = 0.0 if horizon is None else gamma**horizon
    if 4.0 * left >= 1.0:
        return math.inf
    return 4.0 * (1.0 - left) / ((1.0 - gamma) * (1.0 - 4.0 * left))


def design(
    system: System, region: ConvexSet | Region | None = None, *, inputs: Box | None = None,
    sizes: Sizes | None = None, horizon: int | None = None,
    discount: float | None = None, seconds: float | Deadline = DEFAULT_SECONDS,
) -> Design:
    """Find weights, discount and horizon for which the discounted cost bounds the error.

    Parameters
    ----------
    system, region, inputs
        As for `certify`.
    sizes : Sizes, optional
        Largest disturbances and noises, for which the limit is to be small; W and V of the
        system if left out.
    horizon : int, optional
        N, for which the limit is to be small; proposed if left out.
    discount : float, optional
        gamma in (0, 1); left out, the one with the smallest limit of a minimiser's error.
    seconds : float or Deadline
        Approximate time limit, after the solvers are loaded. It then returns the best weights found
        so far, proved or sampled, as their notes say.

    Raises
    ------
    SetError, OptionError, ShapeError, ModelError
        If an argument does not fit, or there are no sizes.
    NotCertifiedError
        If the system is not shown detectable with a Lyapunov function of this kind. An
        `OutOfTimeError` means that no weights were found in time.
    """
    checked_system(system)
    place, known = bounded_region(system, region, inputs), Sizes.of(sizes, system)
    if horizon is not None:
        count("horizon", horizon, 1)
    if discount is not None and not 0.0 < discount < 1.0:
        raise OptionError(f"discount is {discount!r}; expected a number in (0, 1).")

    def measure(rate: float) -> float:
        found = growth(rate * rate, horizon)
        # Where the horizon is too short for a rate, the search must find its way to smaller ones.
        return found if math.isfinite(found) else _TOO_SHORT * growth(rate * rate, None)

    search = Search(system, place, None, known.extent, seconds=started(seconds), growth=measure)
    rate = None if discount is None else math.sqrt(discount) * (1.0 - 1e-12)
    found = search.answer("the root of the discount", rate, (), _undetectable)
    form = found.form
    gamma = discount if discount is not None else _short(form.rate**2)
    # From this share on, (1 - left) / (1 - 4 left) of `growth` is at most _ROOM^2.
    proposed = _least(gamma, (_ROOM**2 - 1.0) / (4.0 * _ROOM**2 - 1.0))
    return Design(
        system, place, form, gamma, known, horizon or proposed, found.evidence,
        found.notes, ModelValues.of(system, place),
    )


def _short(gamma: float) -> float:
    """A number a little above, with few digits; any discount above gamma will do."""
    for digits in (4, 6, 8, 10):
        short = math.ceil(gamma * 10.0**digits) / 10.0**digits
        if short < 1.0 and short >= gamma:
            return short
    return math.nextafter(gamma, 1.0)
