"""CasADi's forms of NumPy's elementwise functions, which give the same numbers, NaN included."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

Form = Callable[..., Any]


@functools.cache
def forms() -> dict[str, Form]:
    """CasADi's forms of NumPy's elementwise functions, by name."""
    import casadi as ca

    def maximum(a: Any, b: Any) -> Any:
        if a.is_constant():
            a, b = b, a
        # NaN if either is, as NumPy has it; fmax has not.
        rest = a if b.is_constant() else ca.if_else(a < b, b, a + b)
        return ca.if_else(a < b, b, a) if b.is_constant() else ca.if_else(a >= b, a, rest)

    def minimum(a: Any, b: Any) -> Any:
        if a.is_constant():
            a, b = b, a
        rest = a if b.is_constant() else ca.if_else(a > b, b, a + b)
        return ca.if_else(a > b, b, a) if b.is_constant() else ca.if_else(a <= b, a, rest)

    def remainder(a: Any, b: Any) -> Any:
        rest = ca.fmod(a, b)
        moves = ca.logic_and(rest != 0, ca.logic_not((b < 0) == (rest < 0)))
        return ca.if_else(moves, rest + b, rest)

    def floor_divide(a: Any, b: Any) -> Any:
        # As NumPy computes it: 1 // 0.1 is 9.
        whole = (a - remainder(a, b)) / b
        floored = ca.floor(whole)
        return ca.if_else(whole - floored > 0.5, floored + 1, floored)

    def rint(a: Any) -> Any:
        low = ca.floor(a)
        up = ca.logic_or(
            a - low > 0.5, ca.logic_and(a - low == 0.5, ca.logic_not(ca.fmod(low, 2) == 0))
        )
        return ca.if_else(up, low + 1, low)

    def trunc(a: Any) -> Any:
        return ca.if_else(a < 0, ca.ceil(a), ca.floor(a))

    def cbrt(a: Any) -> Any:
        return ca.sign(a) * ca.fabs(a) ** (1.0 / 3.0)

    def logaddexp(a: Any, b: Any) -> Any:
        return maximum(a, b) + ca.log1p(ca.exp(-ca.fabs(a - b)))

    def heaviside(a: Any, b: Any) -> Any:
        return ca.if_else(a > 0, 1, ca.if_else(a < 0, 0, ca.if_else(a == 0, b, a)))

    def truth(a: Any) -> Any:
        return a != 0

    return {
        "add": lambda a, b: a + b, "subtract": lambda a, b: a - b, "multiply": lambda a, b: a * b,
        "divide": lambda a, b: a / b, "negative": lambda a: -a, "positive": lambda a: a,
        "power": lambda a, b: a**b, "float_power": lambda a, b: a**b,
        "reciprocal": lambda a: 1 / a, "square": lambda a: a * a, "conjugate": lambda a: a,
        "absolute": ca.fabs, "fabs": ca.fabs, "sign": ca.sign, "sqrt": ca.sqrt, "cbrt": cbrt,
        "exp": ca.exp, "expm1": ca.expm1, "exp2": lambda a: ca.SX(2) ** a,
        "log": ca.log, "log1p": ca.log1p, "log10": ca.log10,
        "log2": lambda a: ca.log(a) / math.log(2.0),
        "sin": ca.sin, "cos": ca.cos, "tan": ca.tan, "arcsin": ca.asin, "arccos": ca.acos,
        "arctan": ca.atan, "arctan2": ca.atan2, "sinh": ca.sinh, "cosh": ca.cosh,
        "tanh": ca.tanh, "arcsinh": ca.asinh, "arccosh": ca.acosh, "arctanh": ca.atanh,
        "hypot": lambda a, b: ca.sqrt(a * a + b * b), "copysign": ca.copysign,
        "degrees": lambda a: a * (180.0 / math.pi), "rad2deg": lambda a: a * (180.0 / math.pi),
        "radians": lambda a: a * (math.pi / 180.0), "deg2rad": lambda a: a * (math.pi / 180.0),
        "floor": ca.floor, "ceil": ca.ceil, "trunc": trunc, "rint": rint,
        "fmod": ca.fmod, "remainder": remainder, "floor_divide": floor_divide,
        "maximum": maximum, "minimum": minimum, "fmax": ca.fmax, "fmin": ca.fmin,
        "heaviside": heaviside,
        "logaddexp": logaddexp,
        "less": lambda a, b: a < b, "less_equal": lambda a, b: a <= b,
        "greater": lambda a, b: a > b, "greater_equal": lambda a, b: a >= b,
        "equal": lambda a, b: a == b, "not_equal": lambda a, b: a != b,
        "logical_and": lambda a, b: ca.logic_and(truth(a), truth(b)),
        "logical_or": lambda a, b: ca.logic_or(truth(a), truth(b)),
        "logical_xor": lambda a, b: truth(a) != truth(b),
        "logical_not": lambda a: ca.logic_not(truth(a)),
        "expit": lambda a: 1 / (1 + ca.exp(-a)), "logit": lambda a: ca.log(a / (1 - a)),
        "erf": ca.erf,
        "clip": lambda a, low, high: minimum(maximum(a, low), high),
    }
