"""Step lengths, tolerances and thresholds that the steps in Python and in C share."""

from __future__ import annotations

from ..observers.base import SAME_COVARIANCE
from ..observers.innovation import GROWTH, LONGEST, MOST_GROWTH
from ..observers.roots import VAGUE
from ..terms.prior import KNOWN, NO_VARIANCE
from ..terms.soft import BEYOND

#: Step lengths, tried in turn after the full step: the first for a step that leaves a set by
#: the solver's tolerance, the last short enough for any useful direction of descent.
LENGTHS = (0.9999, 0.5, 0.25, 0.125, 0.0625, 0.015625, 0.00390625)

#: Step lengths along the boundary of a curved set, tried where none of these helps.
ALONG = (0.5, 0.125, 0.03125)

#: A decrease of J by less than this share of it is rounding, and no improvement.
ROUNDING = 1e-12

#: A step that misses a row by less than this share of its scale is shortened before it is
#: corrected.
NEARLY = 1e-6

#: On curved sets, FEASIBLE limits how far J can be lowered. If no step length lowers it, the
#: sequence has converged if the QP predicted less than this many times the tolerance.
STALLED = 1e3

#: Largest number of second-order corrections of a step that leaves a curved set.
CORRECTIONS = 2

#: Damping of the first damped QP, unless an earlier rejection has left a larger one; by what it
#: grows at the first rejection, and by twice as much at each further one; the least share of it
#: that is left by a step as good as predicted (Nielsen, IMM-REP-1999-05), and the share that is
#: left by a step without damping.
DAMPING, MORE_DAMPING, LESS_DAMPING, OLD_DAMPING = 1e-4, 4.0, 1.0 / 3.0, 0.1

#: The region in which a QP is trusted: the share of its length that a rejected step leaves to it,
#: and how many times its length an accepted one, where J falls well, by more than this share of
#: what is predicted; where it falls poorly, by less than the next, its length. At most this many
#: shorter steps are tried.
SMALLER_REGION, LARGER_REGION, WELL, POOR, SHORTER = 1.0 / 3.0, 4.0, 0.75, 0.25, 30

#: The ridge of a Hessian that is singular up to rounding, as a share of its diagonal: above
#: rounding, and far below what a useful step depends on.
RIDGE = 1e-10

#: With more damping than this, a step is rounding beside the one without.
MOST_DAMPING = 1e16

#: A sequence without a cap ends at this many QPs in a row that the solver, at its own cap, has not
#: solved to its tolerance: further ones cost as much, and approach no minimum.
PATIENCE = 3

#: Largest number of QPs for one feasible trajectory near an infeasible one. A whole step solves at
#: most this many for each QP of its sequence, and this many more.
NEAREST_POINTS = 5

#: The search for a feasible trajectory ends at one that misses the rows by more than this share of
#: what the last one missed: it approaches no feasible one.
NEARER = 0.9

#: Largest number of QPs for a trajectory into which a candidate is restored, from each start.
RESTORING = 20

#: A step towards the sets is taken if it takes away this share, times its length, of the miss.
TOWARDS = 0.1

#: Largest miss of a row of a feasible trial, as a share of the row's scale: QP solvers end on the
#: boundary up to their tolerance.
FEASIBLE = 5e-9

#: An observer more than this many standard deviations of the prior from an estimate is far.
FAR = 10.0

#: With this probability, of two samples of equally large normal errors the first does not seem so
#: much larger that its observer is restarted.
LARGER = 0.99

#: A correction is in the range of the disturbances if less than this share of it is not.
IN_RANGE = 1e-12

#: Powers of the discount below it are taken for it: stages without weight make the QP singular.
LEAST_DISCOUNT = 1e-280

#: A larger measurement counts as missing: its square would not be finite.
LARGEST = 1e150

_SINGLE = {
    "RIDGE": 1e-4,
    "ROUNDING": 1e-6, "NEARLY": 1e-3, "FEASIBLE": 1e-5, "LARGEST": 1e15, "SAME_COVARIANCE": 1e-4,
    "IN_RANGE": 1e-4, "VAGUE": 2.0**-11, "LEAST_DISCOUNT": 1e-27,
}


def c_definitions(prefix: str, real: str) -> str:
    """The same as C macros, for reals of type "double" or "float"."""
    values = {
        "ROUNDING": ROUNDING, "NEARLY": NEARLY, "STALLED": STALLED, "BEYOND": BEYOND,
        "FEASIBLE": FEASIBLE, "LARGEST": LARGEST, "FAR": FAR, "NEARER": NEARER,
        "NO_VARIANCE": NO_VARIANCE, "KNOWN": KNOWN, "SAME_COVARIANCE": SAME_COVARIANCE,
        "IN_RANGE": IN_RANGE, "GROWTH": GROWTH, "VAGUE": VAGUE, "DAMPING": DAMPING,
        "MOST_DAMPING": MOST_DAMPING, "MORE_DAMPING": MORE_DAMPING,
        "LESS_DAMPING": LESS_DAMPING, "OLD_DAMPING": OLD_DAMPING, "TOWARDS": TOWARDS,
        "LEAST_DISCOUNT": LEAST_DISCOUNT, "SMALLER_REGION": SMALLER_REGION,
        "LARGER_REGION": LARGER_REGION, "WELL": WELL, "POOR": POOR, "RIDGE": RIDGE,
    }
    if real == "float":
        values |= _SINGLE
    lines = [f"#define {prefix}_{name} (({real}){value!r})" for name, value in values.items()]
    lines.append(f"#define {prefix}_CORRECTIONS {CORRECTIONS}")
    lines.append(f"#define {prefix}_MOST_GROWTH {MOST_GROWTH}")
    lines.append(f"#define {prefix}_LONGEST {LONGEST}")
    lines.append(f"#define {prefix}_NEAREST_POINTS {NEAREST_POINTS}")
    lines.append(f"#define {prefix}_RESTORING {RESTORING}")
    lines.append(f"#define {prefix}_SHORTER {SHORTER}")
    for name, lengths in (("LENGTHS", LENGTHS), ("ALONG", ALONG)):
        listed = ", ".join(f"({real}){length!r}" for length in lengths)
        lines.append(f"#define {prefix}_{name} {{{listed}}}")
    return "\n".join(lines)
