"""The likelihood of a record under an extended Kalman filter and its adjoint, compiled."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import CompilationError
from ..model.expressions import CasadiModel, import_casadi
from ..model.products import MOST_OPERATIONS, in_scalars
from .compiler import compiled_library
from .source import likelihood_files

Array = NDArray[np.float64]

# Bytes that the adjoint may keep of all samples; of longer records it filters stretches again.
_MOST_BYTES = 2**27


class FilterInput(NamedTuple):
    """A record and the filter's numbers: those of ``mhe_record`` in C, in its order."""

    start: Array  # (n,), z(0), and its covariance (n, n)
    prior: Array
    disturbance: Array  # (n, n), of what enters the state
    noise: Array  # (p, p)
    y: Array  # (T, p), anything where missing
    inputs: Array  # (T, m + 1), the length of each step behind u
    there: NDArray[np.bool_]  # (T, p)
    low: Array  # (n,), bounds of the state, or infinite
    high: Array
    periods: Array  # (p,), of outputs that are angles, else 0
    threshold: float = np.inf  # of innovations, and what divides the cost of each
    scale: float = 1.0


class _Record(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_double if name in ("threshold", "scale") else ctypes.c_void_p)
        for name in FilterInput._fields
    ]


class LikelihoodLibrary:
    """The filter of one model in C, whose f and h are scalar expressions.

    ``check`` says what is wrong with a library that was not checked before.
    """

    def __init__(
        self, model: CasadiModel, check: Callable[[LikelihoodLibrary], str]
    ) -> None:
        self._n, self._m, self._p = model.n, model.m, model.p
        self._kept = np.empty(0, np.uint8)

        def fault(library: ctypes.CDLL) -> str:
            self._bind(library)
            return check(self)

        self._bind(compiled_library(_files(model), "likelihood.c", check=fault))

    def _bind(self, library: ctypes.CDLL) -> None:
        library.mhe_kept_size.restype = ctypes.c_size_t
        self._library, self._size = library, library.mhe_kept_size()

    def costs(self, given: FilterInput) -> Array:
        """The cost of each sample (T,)."""
        record, _held = _record(given)
        costs, kept = np.empty(len(given.y)), np.empty(self._size, np.uint8)
        self._library.mhe_filter_record(
            ctypes.byref(record), len(costs), len(costs), None, _at(kept), _at(costs))
        return costs

    def adjoint(
        self, given: FilterInput, weights: Array
    ) -> tuple[float, Array, Array, Array, Array]:
        """The sum of costs with these weights (T,), and its derivatives.

        They are by P(0), Q, R, and u in all samples; where the sum is not finite, they are not
        computed.
        """
        n, m, p, samples = self._n, self._m, self._p, len(given.y)
        record, _held = _record(given)
        by = [np.zeros(shape) for shape in ((n, n), (n, n), (p, p), (m,))]
        # As few numbers as possible where the record is too long to keep all.
        length = samples
        if samples * self._size > _MOST_BYTES:
            length = int(np.sqrt(samples)) + 1
        if self._kept.size < length * self._size:  # new pages take time
            self._kept = np.empty(length * self._size, np.uint8)
        costs, kept = np.empty(samples), self._kept
        points = np.empty((-(-samples // length), n + n * n))
        common = ctypes.byref(record), samples, length, _at(points), _at(kept)
        self._library.mhe_filter_record(*common, _at(costs))
        chosen = np.ascontiguousarray(weights, np.float64)
        total = float(costs @ chosen)
        if np.isfinite(total):
            self._library.mhe_filter_record_back(*common, _at(chosen), *map(_at, by))
        return total, by[0], by[1], by[2], by[3]


def _at(array: NDArray[Any]) -> Any:
    return array.ctypes.data_as(ctypes.c_void_p)


def _record(given: FilterInput) -> tuple[_Record, list[Any]]:
    """The structure in C, and the arrays that it points to."""
    arrays = [
        np.ascontiguousarray(one, np.uint8 if name == "there" else np.float64)
        for name, one in zip(given._fields, given, strict=True) if isinstance(one, np.ndarray)
    ]
    return _Record(*map(_at, arrays), given.threshold, given.scale), arrays


def scalar_model(model: CasadiModel | None) -> CasadiModel | None:
    """The model with f and h as scalar expressions; None where a step is no such expression."""
    if model is None or model.is_implicit:
        return None
    model = replace(model, f=in_scalars(model.f), h=in_scalars(model.h))
    return model if model.f.is_a("SXFunction") and model.h.is_a("SXFunction") else None


def _files(model: CasadiModel) -> dict[str, str]:
    ca, m = import_casadi(), model.m
    z, u = ca.SX.sym("z", model.n), ca.SX.sym("u", m + 1)
    values = model.step()(z, u[:m], u[m]), model.h(z, u[:m])
    parts = []
    for value in values:
        slope = ca.jacobian(value, z)
        entries = ca.sparsity_cast(slope, ca.Sparsity.dense(slope.nnz(), 1))
        parts.append((value, slope, entries))
    results = [one for value, _, entries in parts for one in (value, entries)]
    seeds = [ca.SX.sym("by", one.numel()) for one in results]
    total = sum((ca.dot(*pair) for pair in zip(seeds, results, strict=True)), ca.SX(0))
    back = [ca.densify(ca.gradient(total, one)) for one in (z, u)]
    functions = {
        "ahead": ca.Function("mhe_casadi_ahead", [z, u], [ca.densify(one) for one in results]),
        "back": ca.Function("mhe_casadi_back", [ca.vertcat(z, *seeds), u], back),
    }
    operations = sum(one.n_instructions() for one in functions.values())
    if operations > MOST_OPERATIONS:
        raise CompilationError(
            f"the filter's model has {operations} operations, more than {MOST_OPERATIONS}, which "
            "would keep a compiler busy for longer than they save."
        )
    slopes = {name: slope for name, (_, slope, _) in zip("AC", parts, strict=True)}
    return likelihood_files(model, functions, slopes)
