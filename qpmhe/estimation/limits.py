"""Step lengths, tolerances and thresholds that both steps share.

Python's step imports them. The C header of a generated estimator is written from them, in
double or in single precision.
"""

from __future__ import annotations

__all__ = [
    "BEYOND", "CORRECTIONS", "FEASIBLE", "LARGEST", "LENGTHS", "NEARLY", "ROUNDING", "STALLED",
    "c_definitions",
]

#: Tried in turn where the full step fails: the first where it misses a set by the solver's
#: accuracy, the last short enough for any descent direction that is worth taking.
LENGTHS = (0.9999, 0.5, 0.25, 0.125, 0.0625, 0.015625, 0.00390625)

#: A decrease of J by less than this share is rounding, and no improvement.
ROUNDING = 1e-12

#: A set missed by less than this is for the first of the lengths, not for a correction.
NEARLY = 1e-6

#: On curved sets J can only be lowered as far as feasibility can be seen: where no length helps
#: and no more than this many times the tolerance was promised, that is convergence.
STALLED = 1e3

#: Second-order corrections of a trial that misses a curved set.
CORRECTIONS = 2

#: A second-order correction goes this share of itself further, to land inside.
BEYOND = 0.1

#: A trial lies on the boundary of its sets up to what QP solvers leave.
FEASIBLE = 5e-9

#: A measurement beyond this has no finite square: it is as good as missing.
LARGEST = 1e150

_SINGLE = {"ROUNDING": 1e-6, "NEARLY": 1e-3, "FEASIBLE": 1e-5, "LARGEST": 1e15}


def c_definitions(prefix: str, real: str) -> str:
    """The table as C, for reals of type "double" or "float"."""
    values = {
        "ROUNDING": ROUNDING, "NEARLY": NEARLY, "STALLED": STALLED, "BEYOND": BEYOND,
        "FEASIBLE": FEASIBLE, "LARGEST": LARGEST,
    }
    if real == "float":
        values |= _SINGLE
    lines = [f"#define {prefix}_{name} (({real}){value!r})" for name, value in values.items()]
    lines.append(f"#define {prefix}_CORRECTIONS {CORRECTIONS}")
    lengths = ", ".join(f"({real}){length!r}" for length in LENGTHS)
    lines.append(f"#define {prefix}_LENGTHS {{{lengths}}}")
    return "\n".join(lines)
