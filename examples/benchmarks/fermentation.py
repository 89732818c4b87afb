"""A fed-batch fermentation of penicillin, for a benchmark and the gallery.

Cuthrell and Biegler, Simultaneous optimization and solution methods for batch reactor control
profiles, Computers and Chemical Engineering 13 (1989). The substrate follows the feed within
minutes; samples are an hour apart.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any


def equations(
    x: list[Any], u: list[Any], biomass_yield: Any, of: ModuleType
) -> tuple[list[Any], list[Any]]:
    """Rates of biomass, product and substrate (g/L) and volume (L); and what is measured.

    The feed (g/h) has 500 g/L. Measured are volume, growth, biomass and product.
    """
    biomass, product, substrate, volume = x
    # Stages of a step may have some less than none: there, these rates would have poles.
    size = of.fabs(substrate)
    growing = 0.11 * substrate / (0.006 * biomass + size) * biomass
    making = 0.0055 * substrate / (1e-4 + size * (1.0 + size / 0.1)) * biomass
    living = 0.029 * substrate / (1e-4 + size) * biomass
    diluting = u[0] / (500.0 * volume)
    used = growing / biomass_yield + making / 1.2 + living
    return (
        [growing - diluting * biomass, making - (0.01 + diluting) * product,
         (500.0 - substrate) * diluting - used, u[0] / 500.0],
        [volume, growing, biomass, product],
    )
