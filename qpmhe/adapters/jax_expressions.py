"""Convert a JAX function to NumPy operations, which also accept the symbols of a trace."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..model.stand_ins import without_symbols
from ..model.symbols import NotTraceableError, Symbol, SymbolArray

# A loop with more turns, all together, is not unrolled.
_MOST_TURNS = 1000

_ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "abs": np.abs, "acos": np.arccos, "acosh": np.arccosh, "add": np.add, "and": np.logical_and,
    "asin": np.arcsin, "asinh": np.arcsinh, "atan": np.arctan, "atan2": np.arctan2,
    "atanh": np.arctanh, "cbrt": np.cbrt, "ceil": np.ceil, "cos": np.cos, "cosh": np.cosh,
    "div": np.divide, "eq": np.equal, "exp": np.exp, "exp2": np.exp2, "expm1": np.expm1,
    "floor": np.floor, "ge": np.greater_equal, "gt": np.greater, "le": np.less_equal,
    "log": np.log, "log1p": np.log1p, "lt": np.less, "max": np.maximum, "min": np.minimum,
    "mul": np.multiply, "ne": np.not_equal, "neg": np.negative, "not": np.logical_not,
    "or": np.logical_or, "pow": np.power, "rem": np.fmod, "sign": np.sign, "sin": np.sin,
    "sinh": np.sinh, "sqrt": np.sqrt, "square": np.square, "sub": np.subtract, "tan": np.tan,
    "tanh": np.tanh, "xor": np.logical_xor, "add_any": np.add, "copy": lambda a: a,
    "copy_p": lambda a: a, "stop_gradient": lambda a: a, "optimization_barrier": lambda *a: a,
    "rsqrt": lambda a: 1.0 / np.sqrt(a), "logistic": lambda a: 1.0 / (1.0 + np.exp(-a)),
    "clamp": lambda low, a, high: np.minimum(np.maximum(a, low), high),
}
_REDUCTIONS: dict[str, Any] = {
    "reduce_sum": np.sum, "reduce_prod": np.prod, "reduce_max": np.max, "reduce_min": np.min,
    "reduce_and": np.all, "reduce_or": np.any,
}
_CUMULATIVE: dict[str, Any] = {
    "cumsum": np.add, "cumprod": np.multiply, "cummax": np.maximum, "cummin": np.minimum
}
# These move entries about and compute nothing: JAX itself says where each one comes from.
_MOVING = frozenset({
    "gather", "dynamic_slice", "pad", "dynamic_update_slice", "scatter", "stack", "expand_dims",
})
_SHAPING: dict[str, Callable[[list[Any], dict[str, Any]], Any]] = {
    "reshape": lambda values, options: np.reshape(values[0], options["new_sizes"]),
    "squeeze": lambda values, options: np.squeeze(values[0], axis=options["dimensions"]),
    "transpose": lambda values, options: np.transpose(values[0], options["permutation"]),
    "rev": lambda values, options: np.flip(values[0], options["dimensions"]),
    "concatenate": lambda values, options: np.concatenate(values, axis=options["dimension"]),
    "slice": lambda values, options: values[0][tuple(
        slice(*three) for three in zip(
            options["start_indices"], options["limit_indices"],
            options["strides"] or [None] * values[0].ndim, strict=True,
        )
    )],
    "broadcast_in_dim": lambda values, options: _broadcast(
        values[0], options["shape"], options["broadcast_dimensions"]
    ),
}
# Programs within programs, under the names that they have had.
_CALLS = ("jaxpr", "call_jaxpr", "fun_jaxpr")


class NoExpressionError(NotTraceableError):
    """A JAX program has no expression; the message gives the reason."""


def numpy_function(program: Any) -> Callable[..., Any]:
    """Convert a program (a closed jaxpr) to a function of NumPy arrays, one per argument.

    It raises `NoExpressionError` for what is not a fixed sequence of NumPy's operations.
    """
    core = importlib.import_module("jax.extend.core")

    @without_symbols
    def evaluate(*arguments: Any) -> Any:
        return _run(core, program.jaxpr, program.consts, arguments)[0]

    return evaluate


def _run(core: Any, jaxpr: Any, constants: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    known: dict[Any, Any] = dict(zip(jaxpr.constvars, map(np.asarray, constants), strict=True))
    known.update(zip(jaxpr.invars, arguments, strict=True))

    def read(one: Any) -> Any:
        return np.asarray(one.val) if isinstance(one, core.Literal) else known[one]

    for step in jaxpr.eqns:
        values = _step(core, step, [read(one) for one in step.invars])
        known.update(zip(step.outvars, values, strict=True))
    return [read(one) for one in jaxpr.outvars]


def _step(core: Any, step: Any, values: list[Any]) -> list[Any]:
    name, options = step.primitive.name, step.params
    if not any(_is_symbolic(one) for one in values):
        return _constant(step, values)
    if name in _ELEMENTWISE:
        return [_ELEMENTWISE[name](*values)]
    if name in _REDUCTIONS:
        return [_REDUCTIONS[name](values[0], axis=tuple(options["axes"]))]
    if name in _CUMULATIVE:
        axis, ufunc = options["axis"], _CUMULATIVE[name]
        if options.get("reverse"):
            return [np.flip(ufunc.accumulate(np.flip(values[0], axis), axis=axis), axis)]
        return [ufunc.accumulate(values[0], axis=axis)]
    if name == "integer_pow":
        return [values[0] ** options["y"]]
    if name == "select_n":
        return [_selected(values[0], values[1:])]
    if name == "convert_element_type":
        kind = np.dtype(options["new_dtype"])
        if kind.kind == "f" or step.invars[0].aval.dtype == np.bool_:
            return [values[0] * 1.0]
        raise NoExpressionError(f"it converts to {kind}")
    if name == "dot_general":
        return [_contracted(values[0], values[1], options["dimension_numbers"])]
    if name in _SHAPING:
        return [_SHAPING[name](values, options)]
    if name in _MOVING:
        return _moved(step, values)
    if name == "scan":
        return _unrolled(core, options, values)
    if name == "cond":
        return _branched(core, options, values)
    for key in _CALLS:
        inner = options.get(key)
        if inner is not None and name != "while":
            if hasattr(inner, "consts"):
                return _run(core, inner.jaxpr, inner.consts, values)
            return _run(core, inner, [], values)
    raise NoExpressionError(f"its operation {name} has no CasADi form here")


def _is_symbolic(value: Any) -> bool:
    return isinstance(value, (Symbol, SymbolArray)) or (
        getattr(value, "dtype", None) == np.object_
    )


def _constant(step: Any, values: list[Any]) -> list[Any]:
    """The result of an operation on numbers, by JAX."""
    found = step.primitive.bind(*values, **step.params)
    return [np.asarray(one) for one in (found if step.primitive.multiple_results else [found])]


def _selected(which: Any, cases: list[Any]) -> Any:
    found = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        found = np.where(np.less_equal(which, k), cases[k], found)
    return found


def _broadcast(value: Any, shape: Sequence[int], dimensions: Sequence[int]) -> Any:
    widened = [1] * len(shape)
    for place, size in zip(dimensions, np.shape(value), strict=True):
        widened[place] = size
    return np.broadcast_to(np.reshape(value, widened), shape)


def _contracted(left: Any, right: Any, numbers: Any) -> Any:
    (along_left, along_right), (batch_left, batch_right) = numbers
    if batch_left or batch_right:
        letters = "abcdefghijklmnopqrstuvwxyz"
        one, two = list(letters[: np.ndim(left)]), list(letters[13 : 13 + np.ndim(right)])
        for i, j in (*zip(along_left, along_right, strict=True),
                     *zip(batch_left, batch_right, strict=True)):
            two[j] = one[i]
        free = [a for i, a in enumerate(one) if i not in (*along_left, *batch_left)]
        free += [b for j, b in enumerate(two) if j not in (*along_right, *batch_right)]
        out = [one[i] for i in batch_left] + free
        return np.einsum(f"{''.join(one)},{''.join(two)}->{''.join(out)}", left, right)
    return np.tensordot(left, right, axes=(list(along_left), list(along_right)))


def _moved(step: Any, values: list[Any]) -> list[Any]:
    """The result of an operation that moves entries, or copies them."""
    places, entries, count = [], [], 0
    for one, variable in zip(values, step.invars, strict=True):
        if np.dtype(variable.aval.dtype).kind in "iu":
            if _is_symbolic(one):
                raise NoExpressionError("it has an index that depends on the state")
            places.append(one)
            continue
        flat = np.asarray(one, np.object_).ravel()
        places.append(np.arange(count, count + flat.size, dtype=np.float64).reshape(np.shape(one)))
        entries.append(flat)
        count += flat.size
    found = step.primitive.bind(*places, **step.params)
    everything = np.concatenate(entries)
    results = []
    for one in found if step.primitive.multiple_results else [found]:
        index = np.asarray(one)
        # Other numbers are fillings, of what is out of range or padded.
        if not (np.isin(index, np.arange(count)).all() and np.isfinite(index).all()):
            raise NoExpressionError(f"its operation {step.primitive.name} fills in numbers")
        array = np.empty(index.shape, np.object_)
        array[...] = everything[index.astype(int)]
        results.append(_like(values, array))
    return results


def _like(values: list[Any], array: Any) -> Any:
    """An array of objects as one of the trace that the values belong to."""
    symbolic = next(one for one in values if _is_symbolic(one))
    return symbolic.record.array(array)


def _unrolled(core: Any, options: Any, values: list[Any]) -> list[Any]:
    """A loop of known length, turn by turn."""
    length, inner = options["length"], options["jaxpr"]
    if length > _MOST_TURNS:
        raise NoExpressionError(f"it has a loop of {length} turns, more than {_MOST_TURNS}")
    fixed, carried = options["num_consts"], options["num_carry"]
    constants, state = values[:fixed], list(values[fixed : fixed + carried])
    series, collected = values[fixed + carried :], []
    turns = range(length)
    for k in reversed(turns) if options["reverse"] else turns:
        found = _run(
            core, inner.jaxpr, inner.consts, [*constants, *state, *(one[k] for one in series)]
        )
        state = found[:carried]
        collected.append(found[carried:])
    if options["reverse"]:
        collected.reverse()
    return [*state, *(np.stack(one) for one in zip(*collected, strict=True))]


def _branched(core: Any, options: Any, values: list[Any]) -> list[Any]:
    """One of several programs by an index: all of them, and a choice of their results."""
    which, arguments = values[0], values[1:]
    if not _is_symbolic(which):
        one = options["branches"][int(np.clip(which, 0, len(options["branches"]) - 1))]
        return _run(core, one.jaxpr, one.consts, arguments)
    results = [_run(core, one.jaxpr, one.consts, arguments) for one in options["branches"]]
    return [_selected(which, list(cases)) for cases in zip(*results, strict=True)]
