"""C source of a model: CasADi's code for its functions, and the discretisation around it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CompilationError
from ..model.algebraic import (
    CURVED,
    FOLLOWED,
    LESS,
    MOST_HALVINGS,
    MOST_ITERATIONS,
    ROUNDING,
    SMALL,
)
from ..model.expressions import CasadiModel, import_casadi
from ..model.flows import few_fill_ins, flow_pattern
from ..model.implicit_steps import (
    COLLOCATIONS,
    CONTRACTION,
    FEW_ROUNDINGS,
    LARGEST_SPREAD,
    MOST_FOLLOWING,
    MOST_KEPT,
    MOST_WHOLE,
    Collocation,
)
from .layout import TERMS
from .templates import filled, prologue, template

# Four (n, n) arrays of them fit on any usual stack.
_MOST_STATES = 256
# The matrices of an implicit step are 30 to 60 times (n, n): with more states than this, those of a
# library are the thread's. A macro of the compiler's command says how.
_MOST_ON_STACK = 16
_LARGE = """/* What keeps large matrices from the stack, where the compiler's command says how. */
#ifdef THREAD_LOCAL
#define MHE_LARGE static THREAD_LOCAL
#else
#define MHE_LARGE
#endif
"""
# Stages whose next correction is at most such a share of the states' sizes have Jacobians that are
# accurate enough for the derivative, whose equations make this correction.
_ROUGH = 1e-12
# Rows need not be exchanged where the sum of the squares of all multipliers is at most this.
_LARGEST_MULTIPLIERS = 100.0


def model_source(model: CasadiModel, single: bool = False) -> str:
    """The model in C: CasADi's code for f, h and their Jacobians, and the discretisation."""
    if model.width > _MOST_STATES:
        raise CompilationError(
            f"the model has {model.width} states; compiled code keeps (n, n) arrays on the stack "
            f"and allows at most {_MOST_STATES}. Take engine='python'."
        )
    _check_solvers(model)
    ca = import_casadi()
    generator = _generator("mhe_model.c")
    calls = _function_calls(ca, generator, model)
    for which, *sizes in (
        ("output_residual", model.p, model.p), ("state_residual", model.n, model.n),
        ("correction", model.n, model.p),
    ):
        function = getattr(model, which)
        if function is None:
            continue
        name = f"mhe_casadi_{which}"
        named = _named(ca, function, name, *sizes)
        generator.add(named)
        calls.append(_call(f"mhe_call_{which}", name, named))
    if model.constraints is not None:
        calls += _constraint_calls(ca, generator, model)
    for which, function in zip(TERMS, model.losses, strict=True):
        if function is None:
            continue
        q, nothing = ca.SX.sym("q"), ca.SX.sym("nothing", 0)
        name = f"mhe_casadi_{which}_loss"
        named = ca.Function(name, [q, nothing], function.call([q]))
        generator.add(named)
        calls.append(_call(f"mhe_call_{which}_loss", name, named))
    code = _bare(generator.dump())
    if "#error" in code:
        line = next(line for line in code.splitlines() if "#error" in line)
        raise CompilationError(
            f"CasADi writes no C code for a part of the model ({line.strip()}); write it with "
            "functions that it supports, or use engine='python'."
        )
    if re.search(r"\bcasadi_newton\(", code):
        raise CompilationError(
            "CasADi's code for a rootfinder 'fast_newton' silently accepts an iterate that has not "
            "converged as a root; use engine='python', which reports a failure."
        )
    return "\n".join((
        *_quieted(code, single), *calls, *_model_parts(model, single), *_algebraic_set(model),
    ))


def _function_calls(ca: Any, generator: Any, model: CasadiModel) -> list[str]:
    """C functions of (x, u) to f and h, and to their Jacobians."""
    calls = []
    for which in ("f", "h"):
        function = getattr(model, which)
        name = f"mhe_casadi_{which}"
        named = _named(ca, function, name, model.width, model.m)
        generator.add(named)
        calls.append(_call(f"mhe_call_{which}", name, named))
        slopes, places = model.with_jacobian(which)
        name = f"mhe_casadi_{which}_jacobian"
        named = _named(ca, slopes, name, model.width, model.m)
        generator.add(named)
        calls.append(_call(f"mhe_call_{which}_jacobian", name, named))
        if which == "f" and model.is_implicit and not model.guess:
            continue  # its nonzeros are those of the flows
        listed = ", ".join(str(place) for place in places) or "0"
        calls.append(
            f"#define MHE_{which.upper()}_NONZEROS {len(places)}\n"
            f"static const int mhe_{which}_place[] = {{{listed}}};\n"
        )
    return calls


def _quieted(code: str, single: bool) -> tuple[str, ...]:
    """CasADi's code without the compiler's warnings of it."""
    return (
        # CasADi writes out some functions that are not called, and arguments without use.
        "#if defined(__GNUC__)\n#pragma GCC diagnostic push\n"
        '#pragma GCC diagnostic ignored "-Wunused-function"\n'
        '#pragma GCC diagnostic ignored "-Wunused-parameter"\n'
        # Its tables compute with indices, which are exact in double precision alone.
        + '#pragma GCC diagnostic ignored "-Wconversion"\n' * single + "#endif",
        "#define casadi_real mhe_real", code,
        "#if defined(__GNUC__)\n#pragma GCC diagnostic pop\n#endif\n",
    )


def _constraint_calls(ca: Any, generator: Any, model: CasadiModel) -> list[str]:
    """C functions of (x, w, v), one below the other, and u to the nonlinear constraints.

    Where some are functions of z, too, z is below: see `_algebraic_set`.
    """
    s, u, value, slopes = _constraint_slopes(model)
    joined = "joined_" * _has_algebraic(model)
    nonzeros = ca.sparsity_cast(slopes, ca.Sparsity.dense(slopes.nnz(), 1))
    calls = []
    for which, results in (("g", [value]), ("g_jacobian", [value, nonzeros])):
        named = ca.Function(f"mhe_casadi_{which}", [s, u], results)
        generator.add(named)
        calls.append(_call(f"mhe_call_{joined}{which}", named.name(), named))
    if joined:
        return calls
    return [*calls, *_tables("g", *slopes.sparsity().get_triplet())]


def _tables(name: str, rows: list[int], columns: list[int]) -> list[str]:
    """The places of nonzeros in C."""
    return [f"#define MHE_{name.upper()}_NONZEROS {len(rows)}\n", *(
        f"static const int mhe_{name}_{word}[] = {{{', '.join(map(str, table)) or '0'}}};\n"
        for word, table in (("row", rows), ("column", columns))
    )]


def _by_rows(name: str, rows: list[int], count: int) -> list[str]:
    """The order of nonzeros by their rows in C, and where those of each row begin."""
    order = np.argsort(rows, kind="stable").tolist()
    first = np.searchsorted(np.sort(rows), range(count + 1)).tolist()
    return [
        f"static const int mhe_{name}_{word}[] = {{{', '.join(map(str, table)) or '0'}}};\n"
        for word, table in (("order", order), ("first", first))
    ]


def _constraint_slopes(model: CasadiModel) -> tuple[Any, Any, Any, Any]:
    """Arguments, values and derivatives of the nonlinear constraints."""
    ca, function = import_casadi(), model.constraints
    joint, inputs, algebraic = (function.numel_in(i) for i in range(3))
    s, u = ca.SX.sym("s", joint + algebraic), ca.SX.sym("u", inputs)
    value = function(s[:joint], u, s[joint:])
    return s, u, value, ca.jacobian(value, s)


def _has_algebraic(model: CasadiModel) -> bool:
    """Whether nonlinear constraints are functions of z."""
    return model.constraints is not None and bool(model.constraints.numel_in(2))


def _algebraic_set(model: CasadiModel) -> list[str]:
    """The part of C by which z follows x in nonlinear constraints, where they are functions of z.

    Rows that are functions of z are functions of nothing else.
    """
    if not _has_algebraic(model):
        return []
    joint = model.constraints.numel_in(0)
    rows, columns = _constraint_slopes(model)[3].sparsity().get_triplet()
    direct = sum(column < joint for column in columns)
    places = {row: k for k, row in enumerate(dict.fromkeys(rows[direct:]))}
    listed = {
        "place": [places[row] for row in rows[direct:]],
        "column": [column - joint for column in columns[direct:]],
    }
    return [
        *_tables(
            "g", [*rows[:direct], *(row for row in places for _ in range(model.n))],
            [*columns[:direct], *list(range(model.n)) * len(places)],
        ),
        *(
            f"static const int mhe_z_{name}[] = {{{', '.join(map(str, table))}}};\n"
            for name, table in listed.items()
        ),
        filled("algebraic_set", {
            "joint": joint, "direct": direct, "chained": len(rows) - direct,
        }),
    ]


def own_losses(model: CasadiModel) -> str:
    """The C function that calls users' losses."""
    names = [which for which, own in zip(TERMS, model.losses, strict=True) if own is not None]
    calls = "".join(
        f"    if (loss->kind == MHE_OWN_{name.upper()})\n"
        f"        mhe_call_{name}_loss(&q, 0, value, slope);\n" for name in names
    )
    return (
        "/* rho(q) and rho'(q) of a user's loss. */\n"
        "static void mhe_own_loss(const mhe_loss *loss, real q, real *value, real *slope)\n"
        f"{{\n    *value = *slope = NAN;\n    (void)loss; (void)q;\n{calls}}}\n"
    )


def _model_parts(model: CasadiModel, single: bool) -> list[str]:
    """The parts of C that make f and h of CasADi's functions: see `_step_parts`."""
    output = {"value": "mhe_h", "slope": "mhe_h_jacobian", "width": "NX"}
    if model.guess:
        output = {
            "value": "mhe_output", "slope": "mhe_output_jacobian",
            "width": f"(NX + {len(model.guess)})",
        }
    return [filled("model", output), *_step_parts(model, single)]


def _step_parts(model: CasadiModel, single: bool) -> list[str]:
    """The parts of C that make a map of f: f itself, or substeps of a method."""
    how = model.how
    if how is None:
        return [filled("step_map", {"value": "mhe_f", "slope": "mhe_f_jacobian"})]
    names = {
        "value": "mhe_f" if how.steps == 1 else "mhe_substep",
        "slope": "mhe_f_jacobian" if how.steps == 1 else "mhe_substep_jacobian",
    }
    substeps = [] if how.steps == 1 else [filled("substeps", {"steps": how.steps})]
    if not how.is_implicit:
        return [filled(f"step_{how.method}", names), *substeps]
    pattern = flow_pattern(model)
    columns, rows = np.nonzero(pattern.T)
    tables = "".join(_tables("flow", rows.tolist(), columns.tolist()))
    coarser = 2.0**29 if single else 1.0  # rounding, in that of double precision
    values = {
        "iterations": MOST_ITERATIONS, "halvings": MOST_HALVINGS,
        "rounding": repr(coarser * ROUNDING), "small": repr(math.sqrt(coarser) * SMALL),
        "curved": repr(CURVED), "least": repr(LESS[0]), "most": repr(LESS[1]),
        "count": len(model.guess), "guess": ", ".join(map(repr, model.guess)),
        "kept": MOST_KEPT, "contraction": repr(CONTRACTION), "few": repr(FEW_ROUNDINGS),
        "rough": repr(max(_ROUGH, 4.0 * coarser * ROUNDING)),
        "spread": repr(LARGEST_SPREAD / coarser), "parts": FOLLOWED, "whole": MOST_WHOLE,
        "following": MOST_FOLLOWING,
    } | names | _elimination(pattern) | _collocation(COLLOCATIONS[how.method])
    rate = filled("algebraic", values) if model.guess else template("rate.c")
    parts = "equations", "blocks", "stages", "stages_kept", "step_implicit"
    first, blocks, *others = (filled(part, values) for part in parts)
    large = _LARGE if model.width > _MOST_ON_STACK else "#define MHE_LARGE\n"
    return [large, tables, first, blocks, rate, *others, *substeps]


def _elimination(pattern: NDArray[np.bool_]) -> dict[str, object]:
    """In which order the states are eliminated, and the others that each one then is beside."""
    order, near = few_fill_ins(pattern)
    ends = np.cumsum([0, *map(len, near)]).tolist()
    return {
        "order": ", ".join(map(str, order)), "start": ", ".join(map(str, ends)),
        "near": ", ".join(str(one) for some in near for one in some) or "0",
        "multipliers": repr(_LARGEST_MULTIPLIERS),
        "full": int(2 * sum(map(len, near)) == len(near) * (len(near) - 1)),
    }


def _collocation(method: Collocation) -> dict[str, object]:
    """The coefficients of an implicit method in C, and the eigenvectors of the inverse of A."""
    count, inverse = len(method.A), np.linalg.inv(method.A)
    eigenvalues, vectors = np.linalg.eig(inverse)
    real = int(np.argmin(np.abs(eigenvalues.imag)))
    columns, pair = [vectors[:, real].real], 0.0j
    if count > 1:
        one = int(np.argmax(eigenvalues.imag))
        pair = eigenvalues[one]
        columns += [vectors[:, one].real, -vectors[:, one].imag]
    modes = np.column_stack(columns)

    def matrix(one: NDArray[Any]) -> str:
        return ", ".join(f"{{{', '.join(map(repr, row))}}}" for row in one.tolist())

    first, shift = method.real, pair - method.real
    return {
        "stages": count, "weights": matrix(method.A), "inverse": matrix(inverse),
        "ends": ", ".join(map(repr, method.d.tolist())),
        "from_modes": matrix(modes), "to_modes": matrix(np.linalg.inv(modes)), "real": repr(first),
        "shift": repr(float(shift.real)), "turning": repr(float(pair.imag)),
        "square": repr(float(abs(shift) ** 2)), "rest": repr(float(1.0 - method.d.sum())),
    }


# Classes of CasADi that have no C code, in words. CasADi itself prints a warning for each call.
_WITHOUT_CODE = {
    "CvodesInterface": "integrator 'cvodes'", "IdasInterface": "integrator 'idas'",
    "Newton": "rootfinder 'newton'", "KinsolInterface": "rootfinder 'kinsol'",
    "ImplicitToNlp": "rootfinder 'nlpsol'",
}


def _check_solvers(model: CasadiModel) -> None:
    """Raise where a solver within the model has no C code: before CasADi prints that."""
    for which in ("f", "h", "output_residual", "state_residual", "correction"):
        function = getattr(model, which)
        for inner in () if function is None else function.find_functions():
            kind = _WITHOUT_CODE.get(inner.class_name())
            if kind is not None:
                raise CompilationError(
                    f"CasADi writes no C code for the {kind}, which {which} calls by the name "
                    f"{inner.name()!r}; use engine='python', or hand the ODE's rate over with "
                    "dt and method='radau', which has C code."
                )


# A function that other programs would call, on one line or on several.
_EXPORTED = re.compile(
    r"^CASADI_SYMBOL_EXPORT (?P<head>[^\n]*?)\{(?:[^\n]*\}\n|\n.*?^\}\n)", re.M | re.S
)


# CasADi's own product adds up each entry by itself, with steps of a column's length in the memory.
_PRODUCT = re.compile(r"(?<=^void )casadi_mtimes_dense\(.*?^}\n", re.M | re.S)
_BY_COLUMNS = """casadi_mtimes_dense(const casadi_real* x, casadi_int nrow_x, casadi_int ncol_x,
    const casadi_real* y, casadi_int ncol_y, casadi_real* restrict z, casadi_int tr) {
  casadi_int i, j, k;
  if (tr) {
    for (i=0; i<ncol_y; ++i)
      for (j=0; j<ncol_x; ++j)
        for (k=0; k<nrow_x; ++k)
          z[j + i*ncol_x] += x[k + j*nrow_x] * y[k + i*nrow_x];
    return;
  }
  for (i=0; i<ncol_y; ++i) {
    for (k=0; k<ncol_x; ++k) {
      const casadi_real *column = x + k*nrow_x, factor = y[k + i*ncol_x];
      for (j=0; j<nrow_x; ++j) z[j + i*nrow_x] += column[j] * factor;
    }
  }
}
"""


def _bare(text: str) -> str:
    """CasADi's code without what only a caller from outside needs, all of it static."""
    text = _PRODUCT.sub(_BY_COLUMNS, text)

    def kept(match: re.Match[str]) -> str:
        wanted = "casadi_real** arg" in match["head"]
        return match[0].replace("CASADI_SYMBOL_EXPORT", "static") if wanted else ""

    text = _EXPORTED.sub(kept, text)
    text = re.sub(r"^(casadi_real|casadi_int|void|int) casadi_", r"static \1 casadi_", text,
                  flags=re.M)
    for line in re.findall(r"^static const casadi_int casadi_s\d+.*\n", text, re.M):
        name = re.search(r"casadi_s\d+", line)
        assert name is not None
        if len(re.findall(rf"\b{name[0]}\b", text)) <= 2:  # here and where it is renamed
            text = text.replace(line, "")
    return text


def _named(ca: Any, function: Any, name: str, *sizes: int) -> Any:
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    given = [kind.sym(f"x{k}", size) for k, size in enumerate(sizes)]
    return ca.Function(name, given, function.call(given))


def _call(name: str, inner: str, function: Any) -> str:
    """A C function of plain arrays around one with CasADi's calling convention."""
    sizes = [function.nnz_out(i) for i in range(function.n_out())]
    results = ", ".join(f"real *out{i}" for i in range(len(sizes)))
    return (
        f"static void {name}(const real *x, const real *u, {results})\n{{\n"
        f"    const real *arg[{max(function.sz_arg(), 2) + 2}];\n"
        f"    real *res[{function.sz_res() + 2}];\n"
        f"    int iw[{function.sz_iw() + 1}];\n"
        f"    real w[{function.sz_w() + 1}];\n"
        "    arg[0] = x;\n    arg[1] = u;\n"
        + "".join(f"    res[{i}] = out{i};\n" for i in range(len(sizes)))
        + f"    if ({inner}(arg, res, iw, w, 0)) {{\n"
        + "".join(
            f"        for (int i = 0; i < {size}; i++) out{i}[i] = NAN;\n" if size
            else f"        (void)out{i};\n"
            for i, size in enumerate(sizes)
        )
        + "    }\n}\n"
    )


def model_files(model: CasadiModel) -> dict[str, str]:
    """Source of a library that evaluates a model, in double precision."""
    return {"model.c": _sizes(model) + model_source(model) + template("model_api.c")}


def filter_files(
    model: CasadiModel, part: str, functions: Mapping[str, Any], slopes: Mapping[str, Any]
) -> dict[str, str]:
    """Source of a library that filters records, in double precision.

    Of the functions and the Jacobians whose nonzeros they have, by name; `FilterLibrary` makes
    them, and names the part. Those of a model with implicit steps are the derivatives alone, if
    any: the rest is C.
    """
    ca, generator = import_casadi(), _generator("mhe_filter.c")
    calls, parts = [], []
    if model.is_implicit:
        calls, parts = _function_calls(ca, generator, model), _implicit_filter_parts(model)
    for name, function in functions.items():
        generator.add(function)
        calls.append(_call(f"mhe_call_{name}", function.name(), function))
    for name, slope in slopes.items():
        calls += _tables(name, *slope.sparsity().get_triplet())
        calls += _by_rows(name, slope.sparsity().get_triplet()[0], slope.size1())
    if model.is_implicit and functions:
        assert model.how is not None
        name = "mhe_f_jacobian" if model.how.steps == 1 else "mhe_substep_jacobian"
        parts += [
            template("back_functions.c"),
            template("back_algebraic.c" if model.guess else "back_rate.c"),
            filled("back_implicit", {"steps": model.how.steps, "slope": name}),
        ]
    return {f"{part}.c": "\n".join((
        _sizes(model), *_quieted(_bare(generator.dump()), False), *calls, template("algebra.c"),
        *parts, template(f"{part}.c"),
    ))}


def _implicit_filter_parts(model: CasadiModel) -> list[str]:
    """The steps and outputs of a model with implicit steps, as filters call them."""
    n, p = model.n, model.p
    tables = [
        line for name, rows in (("A", n), ("C", p))
        for line in _tables(name, np.repeat(np.arange(rows), n).tolist(), [*range(n)] * rows)
    ]
    tables += _by_rows("A", np.repeat(np.arange(n), n).tolist(), n)
    return [*tables, *_model_parts(model, False), template("filter_implicit.c")]


def _generator(name: str) -> Any:
    # Without comments, which would have the numbers of large matrices again.
    options = {"casadi_int": "int", "include_math": False, "verbose": False}
    return import_casadi().CodeGenerator(name, options)


def _sizes(model: CasadiModel) -> str:
    """What stands before a library without a header."""
    return (
        "#include <stdint.h>\ntypedef double mhe_real;\n"
        f"#define MHE_NX {model.n}\n#define MHE_NY {model.p}\n#define MHE_NU {model.m}\n"
        + prologue()
    )
