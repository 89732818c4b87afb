"""Detect indices out of range, for which JAX silently reads another entry."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Iterator
from typing import Any

from ..errors import ModelError
from ..model.points import Points

# What moves its window back into the array, or skips the entry, where an index is out of range.
_INDEXING = ("gather", "scatter", "dynamic_slice", "dynamic_update_slice")
_FOUND = re.compile(
    r"shape (\(.*?\)): index (-?\d+) is out of bounds for axis (\d+) with size (\d+)"
)


def check_indices(jax: Any, name: str, function: Callable[..., Any], probes: Points) -> None:
    """Reject a function that indexes an array out of range at a probe.

    Only indices in the user's code are checked, not those within compiled functions of JAX's
    libraries (``jnp.interp``, ``jnp.take``), nor those with a mode that defines such an index.
    Branches that no probe takes are not checked.
    """
    traced = jax.make_jaxpr(function)(*probes[0])
    if not _indexes(jax, traced.jaxpr):
        return
    checkify = importlib.import_module("jax.experimental.checkify")
    shown = importlib.import_module("jax.extend.core").jaxpr_as_fun(_shown(jax, traced))
    checked = jax.jit(checkify.checkify(shown, errors=checkify.index_checks))
    for x, u in probes:
        try:
            found = checked(x, u)[0].get()
        except Exception:  # checkify does not know every operation of JAX
            return
        if found is not None:
            at = f"x = {x.tolist()}" + (f", u = {u.tolist()}" if u.size else "")
            raise ModelError(
                f"{name} {_described(found)}, at {at}. JAX would read another entry without an "
                "error, or skip a write. Correct the index, n or m; limit an index that depends "
                "on the state with jnp.clip; compute constant indices with NumPy."
            )


def _described(found: str) -> str:
    match = _FOUND.search(found)
    if match is None:
        return f"indexes out of range: {found.splitlines()[0].rstrip('. ')}"
    index, axis, size = map(int, match.group(2, 3, 4))
    # JAX has added the size to a negative index once.
    index = index - size if index < 0 else index
    return f"uses index {index} on axis {axis}, of size {size}, of an array {match.group(1)}"


def _indexes(jax: Any, jaxpr: Any) -> bool:
    """Whether a program has indices to check."""
    return any(
        not _hidden(jax, equation)
        and (
            equation.primitive.name.startswith(_INDEXING)
            or any(_indexes(jax, inner.jaxpr) for inner in _inner(equation))
        )
        for equation in jaxpr.eqns
    )


def _shown(jax: Any, closed: Any) -> Any:
    """The program, with what is not to be checked in calls that checkify does not look into."""
    equations = []
    for equation in closed.jaxpr.eqns:
        if _hidden(jax, equation):
            equation = _opaque(jax, equation)
        elif any(True for _ in _inner(equation)):
            parameters = {
                key: tuple(_shown(jax, one) if _closed(one) else one for one in value)
                if isinstance(value, tuple)
                else (_shown(jax, value) if _closed(value) else value)
                for key, value in equation.params.items()
            }
            equation = equation.replace(params=parameters)
        equations.append(equation)
    return closed.replace(jaxpr=closed.jaxpr.replace(eqns=equations))


def _hidden(jax: Any, equation: Any) -> bool:
    """Whether the indices of an equation are JAX's own, or the user says what they mean."""
    kind, given = equation.primitive.name, equation.params
    if kind in ("jit", "pjit"):
        origin = str(getattr(given["jaxpr"].jaxpr.debug_info, "func_src_info", ""))
        return os.path.dirname(jax.__file__) + os.sep in origin
    if not kind.startswith(("gather", "scatter")):
        return False
    mode, numbers = str(given["mode"]), given["dimension_numbers"]
    if kind == "gather" and mode.endswith("FILL_OR_DROP"):
        return given["fill_value"] is not None
    # vmap makes this mode of x[i], too, but then keeps the dimension of the index.
    single = numbers.collapsed_slice_dims if kind == "gather" else numbers.inserted_window_dims
    return mode.endswith("CLIP") and len(single) > 0


def _opaque(jax: Any, equation: Any) -> Any:
    """The same equation within a call."""
    call = jax.custom_batching.custom_vmap(
        lambda *values: equation.primitive.bind(*values, **equation.params)
    )
    call.def_vmap(lambda *_: None)  # never used, but there must be one
    sizes = (jax.ShapeDtypeStruct(one.aval.shape, one.aval.dtype) for one in equation.invars)
    (made,) = jax.make_jaxpr(call)(*sizes).jaxpr.eqns
    return made.replace(invars=equation.invars, outvars=equation.outvars)


def _inner(equation: Any) -> Iterator[Any]:
    """The programs that an equation calls."""
    for value in equation.params.values():
        yield from filter(_closed, value if isinstance(value, tuple) else (value,))


def _closed(value: Any) -> bool:
    return hasattr(value, "jaxpr") and hasattr(value, "consts")
