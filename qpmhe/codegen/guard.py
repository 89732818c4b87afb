"""The guard of `qpmhe.certificates` in written C: an output map beside the estimator."""

from __future__ import annotations

import re
from dataclasses import dataclass
from string import Template
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from .._checks import Array
from ..model.sets import ConvexSet
from .templates import renamed, template

if TYPE_CHECKING:
    from ..estimation.estimator import MovingHorizonEstimator

# What the part for the nearest point has of X, and its macros: here of the set around the observer.
_OWN = re.compile(
    r"\bmhe_(?=(?:limit|row_of|is_lower|reading|reading_size|side_missed|is_inside|side_spread|"
    r"start_nearest|take_shares|orthogonalise|leave|join|move_along|reach|clip|nearest_in|"
    r"set_metric|project|nearest)\b)"
)
_MACROS = re.compile(r"\b(?=(?:SIDES|SINGULAR|SINGULAR_ROOT|REFINEMENTS)\b)")
_MEMBERS = """
/* Estimates within the set that is proved to hold the true state:
 *
 *     static mhe_guard guard;
 *     mhe_guard_start(&guard, &estimator);                   after mhe_reset
 *     mhe_guard_check(&guard, &estimator, &estimate);        after each mhe_update
 *
 * While guard.off is 0, |x_j - guard.state[j]| <= guard.error[j], at most twice the bound that was
 * proved in advance, if x is in the region of the proof, and disturbances, noises and e = x0 - z0
 * are within what was stated: $assumed. */
enum { MHE_GUARD_STATE = 1, MHE_GUARD_FILTERED = 2 };
enum {
    MHE_GUARD_OTHER_SAMPLE = 1,   /* a sample was left out, or estimated again */
    MHE_GUARD_EVENT = 2,          /* no measurement of an output, another step, or by the status */
    MHE_GUARD_OTHER_OBSERVER = 3, /* it was changed since, or has another gain */
    MHE_GUARD_OUTSIDE = 4,        /* the observer or the input is outside of the region */
    MHE_GUARD_EMPTY = 5           /* no state is in the set: something was larger than stated */
};
typedef struct {
    mhe_real state[MHE_NX], filtered[MHE_NX]; /* of x(t+1) and x(t); the estimate's own when off */
    mhe_real error[MHE_NX];                   /* NaN when off */
    int32_t moved;                            /* which of both were moved, as bits */
    int32_t off;                              /* why it is off, until it starts again; 0: on */
    int32_t projected;                        /* whether the observer was projected onto X so far */
    mhe_real observer_state[MHE_NX];          /* as it was left */
    int64_t time;
} mhe_guard;

/* Start behind mhe_reset, and take the next estimate. Nothing of the estimator is changed. */
void mhe_guard_start(mhe_guard *guard, const mhe_estimator *estimator);
void mhe_guard_check(mhe_guard *guard, const mhe_estimator *estimator,
                     const mhe_estimate *estimate);
"""
_SET = """
/* Of the states of K: bounds and rows. */
#define MHE_GUARD_ROWS $rows
typedef struct {
    real lower[NX], upper[NX];
    real rows[SIZE(MHE_GUARD_ROWS) * NX];
    real row_lower[SIZE(MHE_GUARD_ROWS)], row_upper[SIZE(MHE_GUARD_ROWS)];
} mhe_guard_set;

"""
_WITHIN = """
/* Whether a point is in a set, without any room for rounding. */
static int mhe_guard_is_within(const mhe_guard_set *set, const real *s)
{
    for (int j = 0; j < NX; j++)
        if (!(set->lower[j] <= s[j] && s[j] <= set->upper[j])) return 0;
    for (int r = 0; r < MHE_GUARD_ROWS; r++) {
        const real value = mhe_dot(NX, set->rows + r * NX, s);
        if (!(set->row_lower[r] <= value && value <= set->row_upper[r])) return 0;
    }
    return 1;
}

"""


@dataclass(frozen=True)
class GuardForm:
    r"""The numbers of a guard, for an estimator from its first sample on.

    Parameters
    ----------
    metric, covariance : (n, n) array
        P and its inverse.
    gain : (n, p) array
        The certified gain.
    lower, upper : (n + m,) array
        Bounds on states and inputs that were certified.
    region, states : ConvexSet
        The region, and the region within X.
    radius, box : (k, T) and (k, T, n) array
        Bounds on |x - z|_P and on each component, as long as the observer has not been projected,
        and behind its first projection, if the bound holds for a projected one (k = 2). The last
        ones hold at all later times.
    assumed : str
        The sizes that were stated, in words.
    """

    metric: Array
    covariance: Array
    gain: Array
    lower: Array
    upper: Array
    region: ConvexSet
    states: ConvexSet
    radius: Array
    box: Array
    assumed: str


class Guarding(Protocol):
    """What knows a guard, such as a `qpmhe.certificates.Monitor`."""

    def c_form(self, estimator: MovingHorizonEstimator) -> GuardForm:
        """The numbers of its guard for an estimator, or an error that says why there are none."""


def guarded_files(files: dict[str, str], name: str, form: GuardForm) -> dict[str, str]:
    """Header and source of an estimator with its guard.

    Parameters
    ----------
    files : dict of str
        Header and source without it.
    name : str
        Their name.
    form : GuardForm
        The guard's numbers.
    """
    header, source = f"{name}.h", f"{name}.c"
    rows = len(form.states.matrix)
    data: dict[str, Any] = {
        one: _numbers(getattr(form, one))
        for one in ("metric", "covariance", "gain", "lower", "upper")
    }
    kinds, samples = form.radius.shape
    data |= {
        "samples": samples, "kinds": kinds, "projects": int(kinds > 1),
        "radius": _nested(form.radius), "box": _nested(form.box),
        "states": _set(form.states, rows), "region": _set(form.region, rows),
    }
    nearest = _MACROS.sub("GUARD_", _OWN.sub("mhe_guard_", template("nearest.c")))
    for theirs, own in (
        ("mhe_x_set", "mhe_guard_set"), ("MHE_X_ROWS", "MHE_GUARD_ROWS"),
        ("mhe_metric", "mhe_guard_spread"),
    ):
        nearest = nearest.replace(theirs, own)
    text = "\n".join((
        Template(_SET).substitute(rows=rows), nearest, _WITHIN,
        Template(template("guard.c")).substitute(data),
    ))
    members = Template(_MEMBERS).substitute(assumed=form.assumed)
    mark = "\n#ifdef __cplusplus\n}\n#endif\n"
    before, after = files[header].rsplit(mark, 1)
    return files | {
        header: f"{before}{renamed(members, name)}{mark}{after}",
        source: files[source] + renamed(text, name),
    }


def _set(states: ConvexSet, rows: int) -> str:
    """The initialiser of a set, with as many rows as asked for: those that are missing are free."""
    n, own = states.dimension, len(states.matrix)
    missing = max(rows, 1) - own
    free = np.full(missing, np.inf)
    matrix = np.vstack((states.matrix.reshape(own, n), np.zeros((missing, n))))
    return ", ".join(f"{{{_numbers(each)}}}" for each in (
        states.lower, states.upper, matrix, np.append(states.row_lower, -free),
        np.append(states.row_upper, free),
    ))


def _nested(values: Array) -> str:
    """The initialiser of an array of arrays."""
    if values.ndim < 2:
        return _numbers(values)
    return ", ".join(f"{{{_nested(each)}}}" for each in values)


def _numbers(values: Array) -> str:
    """Numbers as C has them."""
    words = {np.inf: "INFINITY", -np.inf: "-INFINITY"}
    return ", ".join(words.get(each) or repr(each) for each in np.ravel(values).tolist())
