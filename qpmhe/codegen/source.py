"""C source of a whole estimator, put together from parts around its model."""

from __future__ import annotations

import re
from collections.abc import Iterable
from string import Template
from textwrap import indent
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._version import __version__
from ..model.expressions import CasadiModel
from ..terms.soft import SOFT
from .layout import SET_NAMES, Layout
from .model_source import model_source, own_losses
from .single import in_single_precision
from .templates import prologue, renamed, template

#: The file that holds a whole estimator.
MAIN = "mhe.c"


def estimator_files(
    model: CasadiModel, layout: Layout, settings: NDArray[Any], name: str = "mhe"
) -> dict[str, str]:
    """Header and source of a whole estimator."""
    members: dict[str, str] = {}
    parts = [_without_members(part, members) for part in _parts(layout)]
    single = layout.real == "float"
    body = prologue() + "\n".join((
        model_source(model, single), *([own_losses(model)] if layout.loss else []),
        *_declared(parts),
    ))
    data = (
        "\n/* Weights, gain, sets and options of the estimator that this was made from. */\n"
        f"const mhe_settings mhe_default_settings = {_initializer(settings)};\n"
    )
    if single:
        body, data = in_single_precision(body), in_single_precision(data)
    text = renamed(f'#include "mhe.h"\n{body}{data}', name).replace('"mhe.h"', f'"{name}.h"')
    head = _header(name, {**layout.header_values(name), "version": __version__}, members)
    return {f"{name}.h": head, f"{name}.c": text}


# What a part has in a structure of the header, or beside these: up to the next such line.
_MEMBERS = re.compile(r"^@(\w+)\n(.*?)(?=^@)", re.M | re.S)
_FUNCTION = re.compile(r"^(static [^;={]*?\b(mhe_\w+)\([^;{]*\))\s*\{", re.M)
_PROTOTYPE = re.compile(r"^static [^;={}]*?\b(mhe_\w+)\([^;{]*\);\n", re.M)


def _without_members(part: str, members: dict[str, str]) -> str:
    """The part's functions; ``members`` gets what it has in the header, by structures."""
    for place, text in _MEMBERS.findall(part):
        members[place] = members.get(place, "") + text
    return re.sub(r"^@\n", "", _MEMBERS.sub("", part), flags=re.M)


def _declared(parts: list[str]) -> list[str]:
    """The parts, each behind declarations of the functions of later parts that it calls."""
    heads: dict[str, tuple[int, str]] = {}
    for k, part in enumerate(parts):
        heads.update((name, (k, head)) for head, name in _FUNCTION.findall(part))
    declared: set[str] = set()
    for k, part in enumerate(parts):
        declared.update(_PROTOTYPE.findall(part))
        called = dict.fromkeys(re.findall(r"\bmhe_\w+(?=\()", part))
        later = [one for one in called if one in heads and heads[one][0] > k]
        later = [one for one in later if one not in declared]
        declared.update(later)
        parts[k] = "".join(f"{heads[one][1]};\n" for one in later) + "\n" * bool(later) + part
    return parts


def _header(name: str, values: dict[str, Any], members: dict[str, str]) -> str:
    """The estimator's header with its sizes filled in, and with what the parts add to it."""
    places = ("types", "functions", *(
        f"mhe_{one}" for one in (
            "settings", "terms", "estimate", "prior", "trial", "side", "rows", "workspace", "log",
        )
    ))
    unknown = members.keys() - set(places)
    assert not unknown, unknown
    ours = {f"in_{place.removeprefix('mhe_')}": members.get(place, "") for place in places}
    ours |= {key: text for key, text in values.items() if key.endswith("_members")}
    ours = {key: renamed(text, name) for key, text in ours.items()}
    text = Template(renamed(template("estimator.h"), name))
    return text.substitute(values | ours, name=name)


def _parts(layout: Layout) -> list[str]:
    """The parts of C that an estimator is put together from."""
    return [
        *_texts(("algebra",)), _residuals(layout), *_texts(["sides"] if layout.has_rows else []),
        *_own_sets(layout),
        *_texts(("conditions", _or_none("losses", layout.loss), "cost")),
        layout.sizes.c_functions(),
        *_texts((*_observer_parts(layout), "window", *_prior_parts(layout), *_first_terms(layout))),
        _further_terms(layout.terms),
        *_texts([] if layout.held else ["hold_none"]),
        *_texts((*_search_parts(layout), "step")),
    ]


def _texts(names: Iterable[str]) -> list[str]:
    """Text of these parts of the C."""
    return [template(f"{name}.c") for name in names]


def _observer_parts(layout: Layout) -> list[str]:
    """The parts of C that compute the observer, and keep it in X."""
    parts, rule = [], layout.innovation or "none"
    if layout.covariance:
        parts += ["covariance"]
    if layout.deviations:
        parts += ["kalman", *(["innovation"] if layout.innovation else []), f"innovation_{rule}"]
    parts += [f"observer_{layout.observer}", _or_none("sensors", layout.innovation)]
    if layout.covariance and not layout.deviations:
        parts += ["kalman_none"]
    parts += [_or_none("following", layout.covariance)]
    if not layout.projects:
        return [*parts, "inside_none"]
    metric = "metric_covariance" if layout.covariance else "metric_own"
    return [*parts, "nearest", "projection", metric, "inside"]


def _or_none(part: str, is_there: object) -> str:
    """The name of a part, or that of the one in its place."""
    return part if is_there else f"{part}_none"


def _residuals(layout: Layout) -> str:
    """The differences of outputs and of states: plain, of angles, or by the user's function."""
    calls = {
        name: (
            "", f"    mhe_turn({size}, s->{name}_periods, differences);\n",
            f"    mhe_turn_by(mhe_call_{name}_residual, {size}, {of}, differences);\n",
        )[kind]
        for (name, size, of), kind in zip(
            (("output", "NY", "y"), ("state", "NX", "x")), layout.residuals, strict=True
        )
    }
    return Template(template("residuals.c")).substitute(calls)


def _own_sets(layout: Layout) -> list[str]:
    """The parts of C by which samples may have sets of their own."""
    return [
        Template(template(f"{_or_none('own_set', is_there)}.c")).substitute(
            name=name, letter=letter, capital=letter.upper(), size="NY" if letter == "v" else "NX",
        )
        for letter, name, (is_there, _) in zip("wvx", SET_NAMES, layout.sets, strict=True)
    ]


def _prior_parts(layout: Layout) -> tuple[str, ...]:
    """The parts of C that set the prior of a window."""
    return (
        _or_none("prior_roots", layout.has_prior_roots),
        _or_none("prior_observer", layout.observer_prior), "prior",
    )


def _search_parts(layout: Layout) -> tuple[str, ...]:
    """The parts of C that look for an estimate."""
    soft, constrained = SOFT in layout.terms, layout.has_rows
    if layout.free is None:
        factor, blocks = "factor", ["factor_lapack" if layout.lapack else "factor_loops"]
        blocks = ["factor_vectors", *blocks] if layout.vectors else blocks
        blocks += ["constraints_factor"] if layout.constraints else []
    else:
        factor, bends = "elimination", _or_none("constraints_elimination", layout.constraints)
        blocks = [_or_none("pulls", soft), bends]
    rows = (
        f"rows_{factor}", "rows", "active_set", "interior_point", _or_none("soft", soft),
        "constrained", "curved",
    )
    return (
        *(["sets"] if constrained else []), _or_none("constraints", layout.constraints),
        "trial", "damping", factor, *blocks, "outcome", _or_none("budget", layout.clock), "trials",
        *((*rows, _or_none("restoring", layout.restores), "outside") if constrained
          else ["sets_none"]),
        "lengths" if layout.has_inequalities else "region",
        "optimizer", _or_none("graduated", layout.widened), _or_none("quiet", layout.quiet),
        "improve", _or_none("restarting", layout.restarts),
    )


def _first_terms(layout: Layout) -> list[str]:
    """The terms in the first state; soft rows are among the parts with rows."""
    return [name for name in layout.terms if name != SOFT]


def _further_terms(names: tuple[str, ...]) -> str:
    """C functions that call those of the terms that not every estimator has."""

    def body(call: str) -> str:
        return "".join(f"    {call.format(name)};\n" for name in names)

    return (
        "/* The terms of J that not every estimator has. */\n\n"
        "/* Before a step. */\n"
        "static void mhe_begin_further(mhe_estimator *e, mhe_workspace *k)\n"
        f"{{\n    (void)e; (void)k;\n{body('mhe_{}_begin(e, k)')}}}\n\n"
        "/* What they add to J of a trial. */\n"
        "static real mhe_further_cost(mhe_estimator *e, const mhe_workspace *k, "
        "mhe_trial *trial)\n"
        "{\n    real cost = 0;\n    (void)e; (void)k; (void)trial;\n"
        f"{body('cost += mhe_{}_cost(e, k, trial)')}    return cost;\n}}\n\n"
        "/* Add them to the first state's matrix, by rows of this width, and to the gradient. */\n"
        "static void mhe_add_further(const mhe_estimator *e, mhe_workspace *k, real factor,\n"
        "                            real *matrix, int width)\n"
        "{\n    (void)e; (void)k; (void)factor; (void)matrix; (void)width;\n"
        f"{body('mhe_{}_add(e, k, factor, matrix, width)')}}}\n"
    )


def _initializer(record: NDArray[Any]) -> str:
    names = record.dtype.names
    if names:
        inner = ",\n".join(f".{name} = {_initializer(record[name])}" for name in names)
        return f"{{\n{indent(inner, '    ')}\n}}"
    if record.shape:
        return "{" + ", ".join(_initializer(item) for item in record) + "}"
    value = record.item()
    if isinstance(value, int):
        return str(value)
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(value)
