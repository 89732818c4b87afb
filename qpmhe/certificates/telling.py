"""A certificate in words, and in types that JSON knows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .properties import Detectability, ObserverStability

if TYPE_CHECKING:
    from .certificate import Certificate
    from .regions import Region

__all__ = ["ASSUMED", "certificate_dict", "certificate_text", "region_dict", "result_dict"]

#: What no check can see.
ASSUMED = (
    "the true state stays in the region, and follows the model",
    "the bounds on disturbances and noises that are passed are true",
)


def certificate_dict(certificate: Certificate) -> dict[str, Any]:
    """Everything about a certificate in types that JSON knows; infinite numbers become None.

    Parameters
    ----------
    certificate : Certificate
        The certificate.
    """
    told = {
        "system": {"n": certificate.system.n, "p": certificate.system.p, "m": certificate.system.m},
        "region": region_dict(certificate.region),
        "evidence": certificate.evidence.value,
        "assumed": list(ASSUMED),
        "assumptions": certificate.audit.to_dict(),
        "detectability": [result_dict(each) for each in certificate.detectabilities],
        "observer": [result_dict(each) for each in certificate.stabilities],
        "sizes": vars(certificate.sizes),
        "horizons": [each.to_dict(certificate.sizes) for each in certificate.bounds.values()],
        "vacuous": {
            kind: {N: certificate.vacuous(horizon=N, kind=kind) for N in certificate.bounds}
            for kind in certificate.kinds if kind != "measured"
        },
    }
    cleaned: dict[str, Any] = _finite(told)
    return cleaned


def region_dict(region: Region) -> dict[str, Any]:
    """A region in types that JSON knows.

    Parameters
    ----------
    region : Region
        The region.
    """
    return {
        "lower": region.lower.tolist(), "upper": region.upper.tolist(), "box": region.is_box,
        "diameter": region.diameter,
    }


def certificate_text(certificate: Certificate) -> str:
    """A certificate in some lines of text.

    Parameters
    ----------
    certificate : Certificate
        The certificate.
    """
    sizes = certificate.sizes
    lines = [
        f"On {certificate.region.states!r}: {certificate.evidence}.",
        *(f"Assumed: {each}." for each in ASSUMED),
        *(
            f"Violated{'' if each.needed else ', but the bounds need no sets'}: {each.text} "
            f"({each.label})." for each in certificate.audit.violated
        ),
        f"Bounds of the error for |w| <= {sizes.disturbance:.3g} and |v| <= "
        f"{sizes.noise:.3g} for all times:",
    ]
    for N, bounds in certificate.bounds.items():
        C, lam = bounds.paper.C, bounds.paper.lam
        lines.append(
            f"N = {N}: C_1 = {C[0]:.4g}, C_2 = {C[1]:.4g}, C_3 = {C[2]:.4g}, "
            f"lambda = {lam:.4g}"
        )
        for kind in certificate.kinds:
            if kind == "measured":
                continue
            limit = certificate.limit(sizes.disturbance, sizes.noise, horizon=N, kind=kind)
            verdict = ""
            if certificate.vacuous(horizon=N, kind=kind):
                verdict = f", vacuous: the region's diameter is {certificate.diameter:.4g}"
            lines.append(f"  {kind}: {limit:.4g}{verdict}")
    return "\n".join(lines)


def result_dict(result: Detectability | ObserverStability) -> dict[str, Any]:
    """What was certified in types that JSON knows.

    Parameters
    ----------
    result : Detectability or ObserverStability
        The result.
    """
    told = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in vars(result).items()
        if name not in ("region", "evidence", "subject")
    }
    cleaned: dict[str, Any] = _finite(told | {"evidence": result.evidence.value})
    return cleaned


def _finite(value: Any) -> Any:
    """JSON has no infinities."""
    if isinstance(value, Mapping):
        return {str(key): _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value
