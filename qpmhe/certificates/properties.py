"""Constants of detectability and of the observer's stability, with what they rest on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import numbers, positive
from ..errors import OptionError
from ..sets import ConvexSet
from .errors import CertificateError
from .evidence import Evidence
from .provenance import Subject, founded
from .regions import Region, stated_region

__all__ = ["Detectability", "ObserverStability"]

Array = NDArray[np.float64]


def discounted(
    initial: ArrayLike, first: Array, second: Array, rate: float
) -> Array:
    r"""The bound :math:`a \rho^t + \sum_{\tau=1}^t \rho^\tau (b(t-\tau) + c(t-\tau))`.

    Parameters
    ----------
    initial : float or (...) array
        a.
    first, second : (T, ...) array
        b and c.
    rate : float
        rho.

    Returns
    -------
    (T + 1, ...) array
        The bound at t = 0, ..., T.
    """
    bound = np.empty((first.shape[0] + 1, *first.shape[1:]))
    bound[0] = initial
    for t in range(first.shape[0]):
        bound[t + 1] = rate * (bound[t] + first[t] + second[t])
    return bound


def _rate(name: str, value: float) -> float:
    number = positive(name, value)
    if number >= 1.0:
        raise OptionError(f"{name} is {value!r}; expected a number in (0, 1).")
    return number


@dataclass(frozen=True, eq=False)
class Detectability:
    r"""Incremental exponential input/output-to-state stability, Definition def:eIOSS.

    For any two trajectories within the region, of the same inputs,

    .. math::
        |x_1(t) - x_2(t)| \le c_p |x_1 - x_2| \eta^t
        + c_w \sum_{\tau=1}^t \eta^\tau |\delta w(t-\tau)|
        + c_v \sum_{\tau=1}^t \eta^\tau |\delta h(t-\tau)|

    with :math:`\delta w = w_1 - w_2` and :math:`\delta h = h(x_1) - h(x_2)`. Where P is
    given, this follows from the sharper contraction, in norms :math:`|s|_M = \sqrt{s^\top M s}`,

    .. math::
        |x_1^+ - x_2^+|_P \le \eta |x_1 - x_2|_P + |\delta w|_W + |\delta h|_V .

    Parameters
    ----------
    eta : float
        The rate, in (0, 1).
    c_p, c_w, c_v : float
        The constants; c_v has units of the state per unit of the output.
    evidence : Evidence
        What they rest on.
    region : Region or None
        The set in which both trajectories must stay; None for constants assumed everywhere.
    notes : tuple of str
        What else there is to say.
    P : (n, n) array or None
        The norm in which the difference contracts.
    W, V : (n, n) and (p, p) array or None
        Norms of the differences of disturbances and of outputs; W is P.
    form : str
        Which inequality was shown: ``output weight``, ``output injection``, or ``assumed``.
    margin : float
        The smallest eigenvalue of the verified matrices with their diagonals scaled to one,
        rounded: what the solver's tolerance and rounding have left.
    cells : int
        In how many pieces of the region the inequality was verified; 0 if in none.
    subject : Subject or None
        What it was certified of; None for constants stated by hand, which are assumed
        whatever evidence is claimed, as are certified ones that were changed.
    """

    eta: float
    c_p: float
    c_w: float
    c_v: float
    evidence: Evidence
    region: Region | None
    notes: tuple[str, ...] = ()
    P: Array | None = None
    W: Array | None = None
    V: Array | None = None
    form: str = "assumed"
    margin: float = math.nan
    cells: int = 0
    subject: Subject | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "evidence", founded(self))

    @classmethod
    def assumed(
        cls, *, eta: float, c_p: float, c_w: float, c_v: float,
        region: ConvexSet | Region | None = None,
    ) -> Detectability:
        """Constants that the user answers for.

        Parameters
        ----------
        eta, c_p, c_w, c_v, region
            As above.

        Raises
        ------
        OptionError
            If a constant is not positive, or eta not below 1.
        SetError
            If the region is no set.
        """
        return cls(
            _rate("eta", eta), positive("c_p", c_p), positive("c_w", c_w), positive("c_v", c_v),
            Evidence.ASSUMED, stated_region(region),
        )

    def bound(
        self, initial: ArrayLike, disturbances: ArrayLike, outputs: ArrayLike
    ) -> Array:
        """The right-hand side of the definition along a pair of trajectories.

        Parameters
        ----------
        initial : (..., n) array_like
            Differences of the initial states.
        disturbances : (T, ..., n) array_like
            Differences of the disturbances.
        outputs : (T, ..., p) array_like
            Differences of h(x), at t = 0, ..., T - 1.

        Returns
        -------
        (T + 1, ...) array
            Bounds on the Euclidean norms of the differences at t = 0, ..., T.
        """
        x, w, h = (
            np.linalg.norm(numbers(name, value), axis=-1)
            for name, value in (
                ("initial", initial), ("disturbances", disturbances), ("outputs", outputs)
            )
        )
        return discounted(self.c_p * x, self.c_w * w, self.c_v * h, self.eta)

    def squared(self, rate: float) -> tuple[float, Array, Array]:
        r"""The dissipation inequality in squares, for a rate above eta.

        .. math::
            |x_1^+ - x_2^+|_P^2 \le r^2 |x_1 - x_2|_P^2 + |\delta w|_{W_2}^2
            + |\delta h|_{V_2}^2

        The verified inequality is :math:`|A \delta x|_P^2 \le \eta^2 |\delta x|_P^2
        + |\delta h|_V^2`; with :math:`1 + \epsilon = (r/\eta)^2` and Young's inequality for
        the disturbance, :math:`W_2 = (1 + 1/\epsilon) P` and :math:`V_2 = (1 + \epsilon) V`.

        Parameters
        ----------
        rate : float
            r, above eta and below 1.

        Returns
        -------
        rate_squared, W_2, V_2
            As above.

        Raises
        ------
        OptionError
            If the rate is out of range.
        CertificateError
            If there is no P.
        """
        if self.P is None or self.V is None:
            raise CertificateError("assumed constants have no dissipation inequality behind them.")
        if not self.eta < rate < 1.0:
            raise OptionError(f"rate is {rate!r}; expected a number in ({self.eta!r}, 1).")
        more = (rate / self.eta) ** 2
        return rate * rate, more / (more - 1.0) * self.P, more * self.V


@dataclass(frozen=True, eq=False)
class ObserverStability:
    r"""Robust global exponential stability of the auxiliary observer, Definition def:RGES.

    As long as state and observer state stay within the region,

    .. math::
        |x(t) - z(t)| \le C_p |x_0 - z_0| \rho^t
        + C_w \sum_{\tau=1}^t \rho^\tau |w(t-\tau)| + C_v \sum_{\tau=1}^t \rho^\tau |v(t-\tau)|

    Where P is given, this follows from the sharper contraction

    .. math::
        |x^+ - z^+|_P \le \rho |x - z|_P + |w|_W + |v|_V .

    Parameters
    ----------
    rho : float
        The rate, in (0, 1).
    C_p, C_w, C_v : float
        The constants; C_v has units of the state per unit of the output.
    kappa : float
        The constant of (eq:kappa), in units of the state per unit of the output.
    evidence : Evidence
        What they rest on.
    region : Region or None
        The set in which both must stay; None for constants assumed everywhere.
    notes : tuple of str
        What else there is to say.
    P : (n, n) array or None
        The norm in which the error contracts.
    W, V : (n, n) and (p, p) array or None
        Norms of disturbance and noise: W is P and V is L^T P L.
    gain : (n, p) array or None
        L, the observer's constant gain.
    margin, cells, subject
        As for `Detectability`.
    """

    rho: float
    C_p: float
    C_w: float
    C_v: float
    kappa: float
    evidence: Evidence
    region: Region | None
    notes: tuple[str, ...] = ()
    P: Array | None = None
    W: Array | None = None
    V: Array | None = None
    gain: Array | None = None
    margin: float = math.nan
    cells: int = 0
    subject: Subject | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "evidence", founded(self))

    @classmethod
    def assumed(
        cls,
        *,
        rho: float,
        C_p: float,
        C_w: float,
        C_v: float,
        kappa: float,
        region: ConvexSet | Region | None = None,
    ) -> ObserverStability:
        """Constants that the user answers for.

        Parameters
        ----------
        rho, C_p, C_w, C_v, kappa, region
            As above.

        Raises
        ------
        OptionError
            If a constant is not positive, or rho not below 1.
        SetError
            If the region is no set.
        """
        return cls(
            _rate("rho", rho), positive("C_p", C_p), positive("C_w", C_w), positive("C_v", C_v),
            positive("kappa", kappa), Evidence.ASSUMED, stated_region(region),
        )

    def bound(self, initial: ArrayLike, disturbances: ArrayLike, noises: ArrayLike) -> Array:
        """The right-hand side of (eq:RGES) along a run.

        Parameters
        ----------
        initial : (..., n) array_like
            The initial error.
        disturbances, noises : (T, ..., n) and (T, ..., p) array_like
            w and v at t = 0, ..., T - 1.

        Returns
        -------
        (T + 1, ...) array
            Bounds on the Euclidean norm of the error at t = 0, ..., T.
        """
        x, w, v = (
            np.linalg.norm(numbers(name, value), axis=-1)
            for name, value in (
                ("initial", initial), ("disturbances", disturbances), ("noises", noises)
            )
        )
        return discounted(self.C_p * x, self.C_w * w, self.C_v * v, self.rho)
