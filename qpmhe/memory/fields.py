"""The table of what an estimator remembers; the records of both engines are made from it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np


class Field(NamedTuple):
    """One field of the memory.

    Attributes
    ----------
    name : str
        Its name, in Python and in C.
    rows : {"stage", "state", "once"}
        Whether there is one for each stage of the window, one for each state (a last one more than
        there are stages), or a single one, which is replaced and never changed in place.
    shape : str
        Names of its dimensions, which `MemorySizes` has.
    kind : str
        What its entries are: real numbers, flags, counts, times, or a structure of C.
    engine : {"both", "python", "c"}
        Which engine has it.
    when : str
        The feature without which there is no such field; blank for a field that is always there.
    about : str
        What it is, for the header in C.
    is_finite : bool
        Whether a number in it that is not finite can only be damage.
    """

    name: str
    rows: str
    shape: str = ""
    kind: str = "real"
    engine: str = "both"
    when: str = ""
    about: str = ""
    is_finite: bool = True

    @property
    def of_window(self) -> bool:
        """Whether it has a row for each state of a window; a short window uses the first ones."""
        return self.shape.startswith("states")

    @property
    def may_be_missing(self) -> bool:
        """Whether a single value is None at first; C has a flag for it."""
        return any(one.name == f"has_{self.name}" for one in FIELDS)


#: All fields. Both engines have the samples, the observer along them and the last estimates; each
#: has the linearised stages in the form in which it computes with them.
FIELDS = (
    Field("time", "once", kind="time", about="samples taken"),
    Field("watched", "once", "2", "count",
          about="samples in a row with a far observer, with rows dropped"),
    Field("damping", "once",
          about="with which a search for a shorter step begins, at least; 0 for none"),
    Field("restarted", "once", kind="time", when="restarts",
          about="samples taken when the observer was last restarted"),
    Field("trajectory", "once", "states n", about="of the last estimate"),
    Field("smoothed_prior", "once", "n", about="the prior in place of the window's first z"),
    Field("trusted", "once", "2 held", when="held",
          about="values of held parameters: for this window and the next"),
    Field("last_good", "once", "n", about="z of the stages that have left the window"),
    Field("last_good_covariance", "once", "n n", when="covariance"),
    Field("z", "state", "n", about="the observer's state"),
    Field("history", "state", "n", about="estimate of the state, made at its own time"),
    Field("covariance", "state", "n n", when="covariance", about="of the observer's error at z"),
    Field("root", "state", "n n", when="roots", is_finite=False,
          about="upper triangular U, with U'U the covariance where that is vague"),
    Field("is_vague", "state", kind="flag", when="roots"),
    Field("rejections", "state", "sensors", "count", when="sensors",
          about="how often in a row each sensor has failed before"),
    Field("y", "stage", "p", about="any number where it is missing"),
    Field("u", "stage", "inputs", is_finite=False, about="the input, then the step's length"),
    Field("is_irregular", "stage", kind="flag", about="whether that is not the usual length"),
    Field("is_observed", "stage", "p", "flag"),
    Field("cost", "stage", is_finite=False,
          about="infinite where the model could not be evaluated"),
    Field("memory", "state", "memory", engine="python", when="memory",
          about="what a user's observer remembers"),
    # In Python: W, and M = [r, -G] with what it adds to a QP; see `StageTerms`.
    Field("is_special", "stage", kind="flag", engine="python"),
    Field("weight", "stage", "q q", engine="python"),
    Field("majorising_weight", "stage", "q q", engine="python", when="majorised"),
    Field("linear", "stage", "q wide", engine="python", is_finite=False),
    Field("panel", "stage", "n pair", engine="python", is_finite=False),
    Field("gradient", "stage", "n", engine="python", is_finite=False),
    Field("next_gradient", "stage", "n", engine="python", is_finite=False),
    # In C: where the ring of stages begins, and what a sample has of its own.
    Field("first", "once", kind="count", engine="c", about="stage of the window in the ring"),
    Field("length", "once", kind="count", engine="c", about="stages in the window"),
    # A single value that may be missing has a flag, has_NAME.
    Field("has_trajectory", "once", kind="flag", engine="c"),
    Field("has_smoothed_prior", "once", kind="flag", engine="c"),
    Field("metric_settled", "once", kind="flag", engine="c",
          about="whether the metric is for good"),
    Field("metric", "once", "metric", engine="c", about="of the observer, as a covariance"),
    Field("places", "once", "row_stages stage_rows", "place", engine="c",
          about="of the window's rows in the last QP's active set"),
    Field("w", "stage", "n", engine="c", about="residuals of the candidate"),
    Field("v", "stage", "p", engine="c"),
    Field("noise_weight", "stage", "p p", engine="c",
          about="of the components that are observed"),
    Field("is_complete", "stage", kind="flag", engine="c", about="whether these are all"),
    Field("is_sampled", "stage", "p", "flag", engine="c"),
    Field("has_own_noise", "stage", kind="flag", engine="c"),
    Field("has_own_disturbance", "stage", kind="flag", engine="c"),
    Field("has_own_w", "stage", kind="flag", engine="c"),
    Field("has_own_v", "stage", kind="flag", engine="c"),
    Field("has_own_x", "stage", kind="flag", engine="c"),
    Field("own_noise_weight", "stage", "p p", engine="c", is_finite=False),
    Field("own_disturbance_weight", "stage", "n n", engine="c", is_finite=False),
    Field("own_w", "stage", kind="w_set", engine="c", when="w_set"),
    Field("own_v", "stage", kind="v_set", engine="c", when="v_set"),
    Field("own_x", "stage", kind="x_set", engine="c", when="x_set"),
    Field("terms", "stage", kind="terms", engine="c"),
)

_ALIGNED = 64  # bytes

_KINDS: dict[str, Any] = {
    "real": np.float64, "flag": np.bool_, "count": np.int64, "time": np.int64,
}
# The same in C, where a flag alone is an integer; structures have names of their own.
_C_KINDS: dict[str, tuple[str, Any]] = {
    "flag": ("uint8_t", np.uint8), "count": ("int32_t", np.int32), "time": ("int64_t", np.int64),
    "place": ("int8_t", np.int8),
}
_C_FLAG = "int32_t", np.int32
# Dimensions in C.
_C_DIMENSIONS = {
    "n": "MHE_NX", "p": "MHE_NY", "inputs": "(MHE_NU + 1)", "states": "(MHE_HORIZON + 1)",
    "sensors": "MHE_SENSORS", "held": "MHE_HELD", "2": "2",
    "metric": "MHE_SIZE(MHE_X_SET * MHE_NX * MHE_NX)",
    "row_stages": "(MHE_HORIZON + MHE_END_ROWS)", "stage_rows": "MHE_SIZE(MHE_STAGE_ROWS)",
}


class MemorySizes(NamedTuple):
    """Dimensions by name, and the features that an estimator has.

    ``shapes`` are those of fields that Python holds in another form.
    """

    dimensions: dict[str, int]
    features: frozenset[str]
    shapes: Mapping[str, tuple[int, ...]] = {}

    @classmethod
    def of(
        cls, n: int, p: int, m: int, horizon: int, *, sensors: int = 0, held: int = 0,
        memory: int = 0, rows: tuple[int, int] = (0, 0), **features: bool,
    ) -> MemorySizes:
        """The sizes of an estimator with n states, p outputs, m inputs and this horizon.

        ``memory`` is the size of what a user's observer remembers; ``rows`` are the stages of a
        full window with rows in C, and the rows of each.
        """
        features |= {"sensors": sensors > 0, "held": held > 0, "memory": memory > 0}
        return cls(
            {"n": n, "p": p, "inputs": m + 1, "q": n + p, "wide": 1 + n, "pair": 2 * n,
             "N": horizon, "states": horizon + 1, "sensors": sensors, "held": held, "2": 2,
             "memory": memory,
             "metric": n * n if features.get("x_set") else 1,
             "row_stages": rows[0], "stage_rows": rows[1]},
            frozenset(name for name, is_there in features.items() if is_there),
        )

    def fields(self, engine: str, *rows: str) -> tuple[Field, ...]:
        """The fields that an engine has, with these rows; of "both", those that both have."""
        return tuple(
            one for one in FIELDS
            if one.rows in rows and one.engine in ("both", engine)
            and (not one.when or one.when in self.features)
        )

    def shape(self, field: Field) -> tuple[int, ...]:
        """The shape of one row of a field."""
        usual = tuple(self.dimensions[name] for name in field.shape.split())
        return self.shapes.get(field.name, usual)

    def first_value(self, field: Field) -> Any:
        """A single value before the first sample; None where there is none yet, or never."""
        if field.kind in ("count", "time"):
            return (0,) * self.shape(field)[0] if field.shape else 0
        if not field.shape:
            return 0.0
        is_there = not field.when or field.when in self.features
        return np.zeros(self.shape(field)) if is_there and not field.may_be_missing else None

    def arrays(self, engine: str, room: int) -> tuple[Any, dict[str, Any]]:
        """A block of memory, and the fields of a record in Python in it, with ``room`` stages."""
        places, end = {}, 0
        for one in self.fields(engine, "stage", "state"):
            shape = room + (one.rows == "state"), *self.shape(one)
            size = math.prod(shape) * np.dtype(_KINDS[one.kind]).itemsize
            places[one.name] = slice(end, end + size), _KINDS[one.kind], shape
            end += -(-size // _ALIGNED) * _ALIGNED
        block = np.zeros(end, np.uint8)  # no structure: these end at 2 GiB
        return block, {
            name: block[place].view(kind).reshape(shape)
            for name, (place, kind, shape) in places.items()
        }

    def c_fields(self, of_stage: bool) -> list[tuple[str, Field]]:
        """The members of ``mhe_stage``, or those of ``mhe_estimator`` before its stages.

        The estimator has the last state, behind all stages, by a name that ends in ``_end``.
        """
        if of_stage:
            return [(one.name, one) for one in self.fields("c", "state", "stage")]
        single = [(one.name, one) for one in self.fields("c", "once")]
        return single + [(f"{one.name}_end", one) for one in self.fields("c", "state")]

    def c_type(self, of_stage: bool, kinds: dict[str, Any]) -> list[tuple[Any, ...]]:
        """These members as NumPy sees them; ``kinds`` has reals and structures."""
        return [
            (name, kinds.get(one.kind) or _c_kind(one)[1], self.shape(one))
            for name, one in self.c_fields(of_stage)
        ]

    def c_text(self, of_stage: bool) -> str:
        """These members as declared in C."""
        lines = []
        for name, one in self.c_fields(of_stage):
            kind = f"mhe_{one.kind}" if one.kind not in _C_KINDS else _c_kind(one)[0]
            size = " * ".join(_C_DIMENSIONS[dimension] for dimension in one.shape.split())
            size = size.strip("()") if " * " not in size and "MHE_SIZE" not in size else size
            note = f" /* {one.about} */" if one.about and name == one.name else ""
            lines.append(f"    {kind} {name}{f'[{size}]' if size else ''};{note}")
        return "\n".join(lines)

    def c_functions(self) -> str:
        """What C needs to find the stages of a window, and the state behind each."""
        places, copies = [], []
        for one in self.fields("c", "state"):
            kind = f"mhe_{one.kind}" if one.kind not in _C_KINDS else _c_kind(one)[0]
            at = "" if one.shape else "&"
            places.append(
                f"static {kind} *mhe_next_{one.name}(mhe_estimator *e, int i)\n{{\n"
                f"    return i + 1 < e->length ? {at}mhe_stage_at(e, i + 1)->{one.name} : "
                f"{at}e->{one.name}_end;\n}}\n"
            )
            copies.append(
                f"    memcpy(stage->{one.name}, e->{one.name}_end, sizeof stage->{one.name});\n"
                if one.shape else f"    stage->{one.name} = e->{one.name}_end;\n"
            )
        return _C_FUNCTIONS.format(places="\n".join(places), copies="".join(copies))


_C_FUNCTIONS = """/* What the estimator remembers, by stages of the window. */

static mhe_stage *mhe_stage_at(mhe_estimator *e, int i)
{{
    const int k = e->first + i;
    return e->stages + (k < MHE_HORIZON ? k : k - MHE_HORIZON);
}}

/* Behind stage i. No estimator needs all of these. */
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#endif

{places}
#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif

/* A new stage, the newest, begins where the last one ended. */
static void mhe_begin_stage(const mhe_estimator *e, mhe_stage *stage)
{{
{copies}}}
"""


def _c_kind(field: Field) -> tuple[str, Any]:
    return _C_FLAG if field.kind == "flag" and not field.shape else _C_KINDS[field.kind]
