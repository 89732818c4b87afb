"""The bounds for one horizon: the paper's, and those beyond it, with the best free choices."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Literal, get_args

import numpy as np

from .._checks import choice
from ..costs import Cost, CostConstants
from ..errors import OptionError
from .decay import DecayingSums
from .inequalities import Matrices
from .properties import Detectability, ObserverStability
from .theorem import TERMS, Sizes, TheoremConstants, level, theorem, tighten
from .window_bounds import SummedBound, WeightedBound, WindowBound, fit_weight, largest

__all__ = ["HorizonBounds", "Kind", "Pairs", "bounds_for", "window_bound", "window_level"]

Pair = tuple[int, int]

Kind = Literal["paper", "summed", "weighted", "measured"]

# Steps after which what is left of the initial error no longer matters for a comparison.
_MOST_STEPS = 400
# Covers the rounding of a few products and roots.
_OUTWARD = 1.0 + 1e-9
# Pairs kept of each kind, from each horizon at which all of them were tried.
_KEPT = 3
# Pairs in whose rates and constants `tighten` searches, with and without a choice before.
_SEARCHED, _SEARCHED_AGAIN = 4, 2


@dataclass(frozen=True, eq=False)
class HorizonBounds:
    """What bounds the error for one horizon."""

    paper: TheoremConstants
    summed: SummedBound | None
    weighted: WeightedBound | None

    def sharpest(self) -> WindowBound | None:
        """The sharpest bound beyond the paper that there is."""
        return self.summed if self.weighted is None else self.weighted

    def to_dict(self, sizes: Sizes) -> dict[str, Any]:
        """All constants in types that JSON knows."""
        c = self.paper
        content: dict[str, Any] = {
            "horizon": c.horizon,
            "paper": {
                "choices": {
                    "eta": c.detectability.rate, "c": list(c.detectability.constants),
                    "rho": c.observer.rate, "C": list(c.observer.constants),
                },
                "L_bar": c.L_bar, "c_bar": c.c_bar, "eta_bar": c.eta_bar,
                "rho_bar_1": c.rho_bar_1, "rho_bar_2": c.rho_bar_2, "C_bar": list(c.C_bar),
                "C_prime": list(c.C_prime), "C_double_prime": list(c.C_double_prime),
                "C": list(c.C), "lambda": c.lam,
                "terms": {
                    "names": list(TERMS), "C_prime": c.terms().tolist(),
                    "C_double_prime": c.terms(full=False).tolist(),
                },
                "dominating": list(c.dominating()),
                "level": level(c.result, sizes),
                "limit": c.result.limit(sizes.disturbance, sizes.noise),
            },
        }
        for name, bound in (("summed", self.summed), ("weighted", self.weighted)):
            if bound is not None:
                result = bound.result()
                content[name] = {
                    "beyond_the_paper": True, "eta": bound.eta, "rho": bound.rho,
                    "alpha": bound.alphas.tolist(), "C": list(result.constants),
                    "lambda": result.rate, "level": window_level(bound, sizes),
                    "limit": bound.limit(sizes.disturbance, sizes.noise),
                }
        return content


def bounds_for(
    horizon: int, detectabilities: Sequence[Detectability], observers: Sequence[ObserverStability],
    cost: Cost, constants: CostConstants, *, lipschitz: float, sizes: Sizes,
    output: Matrices | None = None, pairs: Pairs | None = None,
) -> HorizonBounds:
    """The best bounds of each kind that follow from what was certified."""
    kappa = max(each.kappa for each in observers)
    plain = [DecayingSums(d.eta, d.c_p, d.c_w, d.c_v) for d in detectabilities]
    observing = [DecayingSums(o.rho, o.C_p, o.C_w, o.C_v) for o in observers]
    tried = Pairs() if pairs is None else pairs
    every = list(product(range(len(plain)), range(len(observing))))
    paper = tighten(
        plain, observing, constants, kappa=kappa, lipschitz=lipschitz, horizon=horizon,
        sizes=sizes, searched=tried.searched,
    )
    summed: list[tuple[float, SummedBound]] = []
    if constants.exponent >= 1.0:
        for i, j in tried.of("summed", every):
            bound = SummedBound(theorem(
                plain[i], observing[j], constants, kappa=kappa, lipschitz=lipschitz,
                horizon=horizon,
            ))
            summed.append((window_level(bound, sizes), bound))
            tried.note("summed", (i, j), summed[-1][0])
    weighted: list[tuple[float, WeightedBound]] = []
    if cost.quadratic and cost.discount == 1.0:
        for i, j in tried.of("weighted", every):
            sharper = _weighted(cost, detectabilities[i], observers[j], lipschitz, horizon, output)
            if sharper is not None:
                weighted.append((window_level(sharper, sizes), sharper))
                tried.note("weighted", (i, j), weighted[-1][0])
    return HorizonBounds(
        paper,
        min(summed, key=lambda pair: pair[0], default=(0.0, None))[1],
        min(weighted, key=lambda pair: pair[0], default=(0.0, None))[1],
    )


def _weighted(
    cost: Cost, detectability: Detectability, observer: ObserverStability,
    lipschitz: float, horizon: int, output: Matrices | None,
) -> WeightedBound | None:
    P, V, O, gain = detectability.P, detectability.V, observer.P, observer.gain  # noqa: E741
    if P is None or V is None or O is None or gain is None:
        return None
    fit = fit_weight(cost, gain)
    # |h(x) - h(z)|_M <= sqrt(max eig M) L_h |x - z|, and |x - z| in the norm O.
    plain = math.sqrt(float(np.linalg.eigvalsh(fit)[-1]) * largest(np.eye(cost.n), O))
    slope = plain * lipschitz * _OUTWARD
    if output is not None:
        C, radius = output.middle[0], float(np.linalg.norm(output.radius[0]))
        own = math.sqrt(largest(C.T @ fit @ C, O)) + plain * radius
        slope = min(slope, own * _OUTWARD)
    return WeightedBound(
        cost, horizon=horizon, P=P, eta=detectability.eta, noise_weight=V, observer_norm=O,
        rho=observer.rho, gain=gain, slope=slope,
    )


def window_level(bound: WindowBound, sizes: Sizes) -> float:
    """The largest value that the bound takes for errors of these sizes."""
    settled = math.ceil(math.log(1e-3) / math.log(bound.rho))
    steps = bound.horizon + min(_MOST_STEPS, settled)
    funnel = bound.funnel(sizes.initial, sizes.disturbance, sizes.noise, steps)
    return max(float(funnel.max()), bound.limit(sizes.disturbance, sizes.noise))


def window_bound(chosen: HorizonBounds, kind: Kind, kinds: Sequence[Kind]) -> WindowBound:
    """The bound beyond the paper that a kind asks for."""
    choice("kind", kind, get_args(Kind))
    bound: WindowBound | None = chosen.sharpest() if kind == "measured" else (
        chosen.weighted if kind == "weighted" else chosen.summed
    )
    if bound is None:
        raise OptionError(
            f"kind is {kind!r}, for which there is no bound here; expected one of "
            f"{list(kinds)}. The weighted one needs a quadratic cost and constants "
            "that were certified, not assumed."
        )
    return bound


@dataclass
class Pairs:
    """What was best at other horizons.

    Any pair gives a bound that holds; fewer of them make it less tight, hardly so where those
    that were best at a smaller and at a larger horizon are among them.
    """

    allowed: dict[str, list[Pair]] = field(default_factory=dict)
    _levels: dict[str, dict[Pair, float]] = field(default_factory=dict)

    @property
    def searched(self) -> int:
        """In how many pairs the theorem's free choices are searched."""
        return _SEARCHED_AGAIN if self.allowed else _SEARCHED

    def of(self, kind: str, every: Sequence[Pair]) -> Sequence[Pair]:
        """The pairs to try."""
        return self.allowed.get(kind, every)

    def note(self, kind: str, pair: Pair, level: float) -> None:
        """Remember the value that a pair reaches."""
        self._levels.setdefault(kind, {})[pair] = level

    def best(self, *others: Pairs) -> Pairs:
        """The best pairs of these, to be tried at other horizons."""
        allowed: dict[str, list[Pair]] = {}
        for each in (self, *others):
            for kind, levels in each._levels.items():
                for pair in sorted(levels, key=levels.__getitem__)[:_KEPT]:
                    if pair not in allowed.setdefault(kind, []):
                        allowed[kind].append(pair)
        return Pairs(allowed)
