"""Constants of detectability and of the observer's stability, with their evidence."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from .._checks import Array, positive
from ..model.sets import ConvexSet
from ..model.system import System
from .content import Content
from .evidence import Evidence, MismatchError, json_ready
from .model_values import ModelValues
from .regions import Region, beyond, stated_region
from .theorem import DecayingSums, checked_rate


@dataclass(frozen=True, eq=False, kw_only=True)
class _Certified:
    """What both share: norms, and what they rest on; made or changed by hand, it is assumed."""

    region: Region | None = None
    notes: tuple[str, ...] = ()
    P: Array | None = None
    W: Array | None = None
    V: Array | None = None
    cells: int = 0
    compared: int = 0
    evidence: Evidence = field(default=Evidence.ASSUMED, init=False)
    system: System | None = field(default=None, init=False, repr=False)
    model: ModelValues | None = field(default=None, init=False, repr=False)
    content: Content | None = field(default=None, init=False, repr=False)

    def difference(self, system: System, by_values: bool = False) -> str:
        """In what a system differs from the certified one, in words; blank if it does not.

        Values of f and h at points of the region are compared, then the expressions and sets.
        Where a function has no expression, another System object differs unless values are to do
        (``by_values``).
        """
        found = "" if self.model is None else self.model.difference(system)
        if not found and self.content is not None:
            by_values = by_values or system is self.system
            found = self.content.difference(Content.of_system(system), by_values)
        return found

    @property
    def entry(self) -> Array | None:
        """The norm of disturbances: W, or P where they are of the states."""
        return self.P if self.W is None else self.W

    def __getstate__(self) -> dict[str, Any]:
        """Without the system, whose functions often cannot be pickled."""
        return vars(self) | {"system": None}

    def to_dict(self) -> dict[str, Any]:
        """All but region and model, in types that JSON knows; infinite numbers become None."""
        left_out = ("region", "system", "model", "content")
        content: dict[str, Any] = json_ready(
            {name: value for name, value in vars(self).items() if name not in left_out}
        )
        return content


@dataclass(frozen=True, eq=False)
class Detectability(_Certified):
    r"""Incremental exponential input/output-to-state stability, Definition def:eIOSS.

    For any two trajectories within the region, of the same inputs,

    .. math::
        |x_1(t) - x_2(t)| \le c_p |x_1 - x_2| \eta^t
        + c_w \sum_{\tau=1}^t \eta^\tau |\delta w(t-\tau)|
        + c_v \sum_{\tau=1}^t \eta^\tau |\delta h(t-\tau)|

    with :math:`\delta w = w_1 - w_2` and :math:`\delta h = h(x_1) - h(x_2)`. Where P is
    given, this follows from :math:`|x_1^+ - x_2^+|_P \le \eta |x_1 - x_2|_P + |\delta w|_W +
    |\delta h|_V`, in norms :math:`|s|_M = \sqrt{s^\top M s}`.

    Parameters
    ----------
    eta : float
        The rate, in (0, 1).
    c_p, c_w, c_v : float
        The constants; c_v has units of the state per unit of the output.
    evidence : Evidence
        The evidence for them; constants made or changed by hand are assumed.
    region : Region or None
        The set in which both trajectories must stay; None for constants assumed everywhere.
    notes : tuple of str
        Further remarks.
    P, W, V : (n, n), (r, r) and (p, p) array or None
        Norms of the differences of states, of disturbances, and of outputs. W is None where it is
        P, and :math:`G^\top P G` with the system's ``disturbance_matrix`` G.
    form : str
        Which inequality was shown: ``output weight``, ``output injection``, or ``assumed``.
    cells : int
        Number of pieces of the region on which the inequality was verified; 0 if none.
    compared : int
        At how many points of them f and h had the values of the traces that it was proved for; 0
        for functions that are symbolic already.
    system : System or None
        The certified system; None for constants made or changed by hand, or copied.
    model : ModelValues or None
        Values of f and h when it was certified; None for constants made or changed by hand.
    content : Content or None
        Digests of what was certified: expressions, sets and gain; None for constants made or
        changed by hand.
    """

    eta: float
    c_p: float
    c_w: float
    c_v: float
    form: str = field(default="assumed", kw_only=True)

    @classmethod
    def assumed(
        cls, *, eta: float, c_p: float, c_w: float, c_v: float,
        region: ConvexSet | Region | None = None,
    ) -> Detectability:
        """Constants that the user states without proof; without a region, everywhere."""
        _checked("eta", eta=eta, c_p=c_p, c_w=c_w, c_v=c_v)
        return cls(eta, c_p, c_w, c_v, region=stated_region(region))

    @property
    def sums(self) -> DecayingSums:
        """eta, c_p, c_w and c_v."""
        return DecayingSums(self.eta, self.c_p, self.c_w, self.c_v)


@dataclass(frozen=True, eq=False)
class ObserverStability(_Certified):
    r"""Robust global exponential stability of the auxiliary observer, Definition def:RGES.

    As long as state and observer state stay within the region,

    .. math::
        |x(t) - z(t)| \le C_p |x_0 - z_0| \rho^t
        + C_w \sum_{\tau=1}^t \rho^\tau |w(t-\tau)| + C_v \sum_{\tau=1}^t \rho^\tau |v(t-\tau)|

    Where P is given, this follows from :math:`|x^+ - z^+|_P \le \rho |x - z|_P + |w|_W + |v|_V`,
    and where Q and R are given, :math:`|x^+ - z^+|_P^2 \le \rho^2 |x - z|_P^2 + |w|_Q^2 +
    |v|_R^2` holds as well, whose limit is in general smaller.

    Parameters
    ----------
    rho : float
        The rate, in (0, 1).
    C_p, C_w, C_v : float
        The constants; C_v has units of the state per unit of the output.
    kappa : float
        The constant of (eq:kappa), in units of the state per unit of the output.
    gain : (n, p) array or None
        L, the observer's constant gain.
    P, W, V : (n, n), (r, r) and (p, p) array or None
        Norms of error, disturbance and noise: V is L^T P L; W is as for `Detectability`.
    Q, R : (r, r) and (p, p) array or None
        Weights of disturbance and noise in the sum of squares.
    room : (p,) array or None
        Below what each noise must be for angles among the outputs, so that no innovation wraps;
        infinite for other outputs, None without angles.
    evidence, region, notes, cells, compared, system, model, content
        As for `Detectability`.
    """

    rho: float
    C_p: float
    C_w: float
    C_v: float
    kappa: float
    gain: Array | None = field(default=None, kw_only=True)
    Q: Array | None = field(default=None, kw_only=True)
    R: Array | None = field(default=None, kw_only=True)
    room: Array | None = field(default=None, kw_only=True)

    @classmethod
    def assumed(
        cls, *, rho: float, C_p: float, C_w: float, C_v: float, kappa: float,
        region: ConvexSet | Region | None = None,
    ) -> ObserverStability:
        """Constants that the user states without proof; without a region, everywhere."""
        _checked("rho", rho=rho, C_p=C_p, C_w=C_w, C_v=C_v, kappa=kappa)
        return cls(rho, C_p, C_w, C_v, kappa, region=stated_region(region))

    @property
    def sums(self) -> DecayingSums:
        """rho, C_p, C_w and C_v."""
        return DecayingSums(self.rho, self.C_p, self.C_w, self.C_v)


def _checked(rate: str, **constants: float) -> None:
    """Raise an `OptionError` for one that is not positive, or a rate that is not below 1."""
    for name, value in constants.items():
        (checked_rate if name == rate else positive)(name, value)


Result = TypeVar("Result", "Detectability", "ObserverStability")


def sealed(result: Result, system: System, evidence: Evidence) -> Result:
    """The result itself, with its system, its values and evidence; its arrays are fixed."""
    for name, value in vars(result).items():
        if isinstance(value, np.ndarray):
            vars(result)[name] = value = value.copy()
            value.setflags(write=False)
    model = content = None
    if result.region is not None:
        model = ModelValues.of(system, result.region)
        content = Content.of(system, result.region, getattr(result, "gain", None))
    vars(result).update(system=system, model=model, content=content, evidence=evidence)
    return result


def fitting(part: Result, system: System, region: Region, gain: Array | None) -> Result:
    """A part of a certificate, if it is about this system, region and gain."""
    what = "detectability" if isinstance(part, Detectability) else "stability"
    difference = "" if part.region is None else beyond(region, part.region)
    if difference:
        raise MismatchError(
            f"the {what} that was passed does not hold on the whole region: {difference}. "
            "Certify it on this region, with these inputs, or pass a region within its own."
        )
    own = getattr(part, "gain", None)
    if own is not None and (gain is None or not np.array_equal(own, gain)):
        theirs = "not constant" if gain is None else str(gain.tolist())
        raise MismatchError(
            f"the {what} that was passed is for the gain {own.tolist()}; the observer's is "
            f"{theirs}. Certify this observer."
        )
    changed = part.difference(system)
    if changed and part.system is not system:
        raise MismatchError(
            f"the {what} that was passed is for another system: {changed}. Certify this system, or "
            f"state the constants: {type(part).__name__}.assumed(...)."
        )
    if changed:
        raise MismatchError(
            f"the system has changed since the {what} that was passed was certified: {changed}. "
            "Certify the system as it is now."
        )
    return part
