"""Random functions of two numbers: in NumPy, and in 40 digits."""

from __future__ import annotations

import math

import mpmath
import numpy as np

# As the expressions have it, in double precision.
_LOG10 = 0.43429448190325176
_SAME = "sin", "cos", "tan", "exp", "expm1", "log", "log1p", "sqrt", "sinh", "cosh", "tanh"
_INVERSE = "sin", "cos", "tan", "sinh", "cosh", "tanh"

# A function of NumPy, and the same of numbers with 40 digits.
ONE = {name: (getattr(np, name), getattr(mpmath, name)) for name in _SAME}
ONE |= {f"arc{name}": (getattr(np, f"arc{name}"), getattr(mpmath, f"a{name}")) for name in _INVERSE}
ONE |= {
    "log2": (np.log2, lambda s: mpmath.log(s) / math.log(2.0)),
    "log10": (np.log10, lambda s: mpmath.log(s) * _LOG10),
    "cbrt": (np.cbrt, lambda s: mpmath.sign(s) * mpmath.cbrt(abs(s))),
    "deg2rad": (lambda s: np.deg2rad(40.0 * s), lambda s: s * 40 * (math.pi / 180)),
    "expit": (lambda s: 1.0 / (1.0 + np.exp(-s)), lambda s: 1 / (1 + mpmath.exp(-s))),
    "abs": (np.abs, abs), "clip": (lambda s: np.clip(s, -0.5, 0.75),
                                   lambda s: min(max(s, mpmath.mpf(-0.5)), mpmath.mpf(0.75))),
    "leaky": (lambda s: np.where(s > 0.0, s, 0.1 * s),
              lambda s: s if s > 0 else mpmath.mpf(0.1) * s),
    "square": (lambda s: s**2, lambda s: s**2), "cube": (lambda s: s**3, lambda s: s**3),
    "power": (lambda s: s**1.5, lambda s: s ** mpmath.mpf(1.5)),
    "inverse square": (lambda s: s**-2.0, lambda s: s**-2),
    "exp2": (np.exp2, lambda s: mpmath.mpf(2) ** s),
}
TWO = {
    "add": (np.add, lambda a, b: a + b), "subtract": (np.subtract, lambda a, b: a - b),
    "multiply": (np.multiply, lambda a, b: a * b), "divide": (np.divide, lambda a, b: a / b),
    "maximum": (np.maximum, max), "minimum": (np.minimum, min),
    "hypot": (np.hypot, mpmath.hypot), "arctan2": (np.arctan2, mpmath.atan2),
    "where": (lambda a, b: np.where(a > b, 2.0 * a - b, a), lambda a, b: 2 * a - b if a > b else a),
    "norm": (lambda a, b: np.sqrt(a * a + b * b + 0.25),
             lambda a, b: mpmath.sqrt(a * a + b * b + mpmath.mpf(0.25))),
}


def made(generator, depth):
    """A random expression: nested tuples of names, variables and constants."""
    kind = generator.random()
    if depth == 0 or kind < 0.1:
        return int(generator.integers(2))
    if kind < 0.55:
        return str(generator.choice(list(ONE))), made(generator, depth - 1)
    # NumPy itself would round functions of constants, and CasADi knows x / x.
    first = second = made(generator, depth - 1)
    while second == first:
        second = (
            made(generator, depth - 1) if generator.random() < 0.8
            else float(np.round(generator.uniform(-2.0, 2.0), 2))
        )
    return str(generator.choice(list(TWO))), first, second


def value(expression, x, column):
    """An expression at a point: with NumPy (column 0) or in 40 digits (column 1)."""
    if isinstance(expression, int):
        return x[expression]
    if isinstance(expression, float):
        return mpmath.mpf(expression) if column else expression
    name, *parts = expression
    parts = [value(part, x, column) for part in parts]
    return (ONE if len(parts) == 1 else TWO)[name][column](*parts)
