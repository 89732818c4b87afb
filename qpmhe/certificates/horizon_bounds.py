"""The bounds for one horizon: the paper's, and the sharper one beyond it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from .._checks import choice
from ..costs import Cost, CostConstants
from ..errors import OptionError
from .decay import Sizes
from .inequalities import Matrices
from .properties import Detectability, ObserverStability
from .theorem import TheoremConstants, theorem
from .window_bounds import SummedBound, WeightedBound, WindowBound, fit_weight, largest

Kind = Literal["paper", "summed", "weighted", "measured"]

# Covers the rounding of a few products and roots.
_OUTWARD = 1.0 + 1e-9


@dataclass(frozen=True, eq=False)
class HorizonBounds:
    """What bounds the error for one horizon.

    Parameters
    ----------
    paper : TheoremConstants
    window : WeightedBound, SummedBound or None
        The sharper bound: with norms for a quadratic cost and certified constants, with sums
        for other costs and assumed constants, none for costs whose exponent is below 1.
    """

    paper: TheoremConstants
    window: WindowBound | None

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of bounds at hand, the sharpest last."""
        return ("paper",) if self.window is None else ("paper", self.window.kind, "measured")

    def beyond(self, kind: Kind) -> WindowBound:
        """The bound beyond the paper that a kind asks for."""
        choice("kind", kind, get_args(Kind))
        if self.window is None or kind not in self.kinds:
            raise OptionError(
                f"kind is {kind!r}, for which there is no bound here; expected one of "
                f"{list(self.kinds)}. The weighted one is there for a quadratic cost and constants "
                "that were certified, the summed one where the weighted one is not."
            )
        return self.window

    def to_dict(self, sizes: Sizes) -> dict[str, Any]:
        """All constants in types that JSON knows."""
        c = self.paper
        content: dict[str, Any] = {
            "horizon": c.horizon,
            "paper": {
                "L_bar": c.L_bar, "c_bar": c.c_bar, "eta_bar": c.eta_bar,
                "rho_bar_1": c.rho_bar_1, "rho_bar_2": c.rho_bar_2, "C_bar": list(c.C_bar),
                "C_prime": list(c.C_prime), "C_double_prime": list(c.C_double_prime),
                "C": list(c.C), "lambda": c.lam,
                "limit": c.result.limit(sizes.disturbance, sizes.noise),
            },
        }
        if self.window is not None:
            content[self.window.kind] = {
                "beyond_the_paper": True, "alpha": self.window.alphas.tolist(),
                "limit": self.window.limit(sizes.disturbance, sizes.noise),
            }
        return content


def bounds_for(
    horizon: int, detectability: Detectability, stability: ObserverStability, cost: Cost,
    constants: CostConstants, *, lipschitz: float, output: Matrices | None = None,
) -> HorizonBounds:
    """The bounds that follow from what was certified."""
    plain = theorem(
        detectability.sums, stability.sums, constants, kappa=stability.kappa,
        lipschitz=lipschitz, horizon=horizon,
    )
    paper = plain
    if lipschitz > 0.0:  # a larger C_v holds as well, and from 1 / L_h on L_bar is L_h
        larger = max(plain.observer.noise, 1.0 / lipschitz)
        paper = replace(plain, observer=replace(plain.observer, noise=larger))
    window: WindowBound | None = None
    if cost.quadratic and cost.discount == 1.0:
        window = _weighted(cost, detectability, stability, lipschitz, horizon, output)
    if window is None and constants.exponent >= 1.0:
        window = SummedBound(plain)
    return HorizonBounds(paper, window)


def _weighted(
    cost: Cost, detectability: Detectability, stability: ObserverStability,
    lipschitz: float, horizon: int, output: Matrices | None,
) -> WeightedBound | None:
    P, V, O, gain = detectability.P, detectability.V, stability.P, stability.gain  # noqa: E741
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
        rho=stability.rho, gain=gain, slope=slope,
    )
