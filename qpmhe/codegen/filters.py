"""Extended Kalman filters over whole records, compiled."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ..errors import CompilationError
from ..model.expressions import CasadiModel, import_casadi
from ..model.products import MOST_OPERATIONS, in_scalars
from .compiler import compiled_library
from .model_source import filter_files

Array = NDArray[np.float64]

# Shares of the prior with which a library is compared, until one of them agrees.
_SHARES = 1.0, 1e-4, 1e-8
# Bytes that the adjoint may keep of all samples; of longer records it filters stretches again.
_MOST_BYTES = 2**27


class LikelihoodInput(NamedTuple):
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


# What is no array in the structures.
_NUMBERS = dict.fromkeys(
    ("threshold", "scale", "far", "width", "extreme", "inlying"), ctypes.c_double
) | dict.fromkeys(("changes", "doubts"), ctypes.c_int64)


class _Record(ctypes.Structure):
    _fields_ = [(name, _NUMBERS.get(name, ctypes.c_void_p)) for name in LikelihoodInput._fields]


class FilterLibrary:
    """Filters of one model in C, whose f and h are scalar expressions.

    ``check`` says what is wrong with a library that was not checked before.
    """

    #: The part of C that filters.
    part: str

    def __init__(self, model: CasadiModel, check: Callable[[Self], str]) -> None:
        self._n, self._m, self._p = model.n, model.m, model.p

        def fault(library: ctypes.CDLL) -> str:
            self._bind(library)
            return check(self)

        self._bind(compiled_library(self._files(model), f"{self.part}.c", check=fault))

    def _bind(self, library: ctypes.CDLL) -> None:
        self._library = library

    def _files(self, model: CasadiModel) -> dict[str, str]:
        """Functions of (z, u with the step's length) to f or h and the nonzeros of its Jacobian.

        An implicit step is C: then of (w, u) to the rate or h, for the adjoint alone.
        """
        ca, m, implicit = import_casadi(), model.m, model.is_implicit
        z, u = ca.SX.sym("z", model.width), ca.SX.sym("u", m if implicit else m + 1)
        values = (
            {"rate": model.f(z, u), "shown": model.h(z, u)} if implicit
            else {"step": model.step()(z, u[:m], u[m]), "output": model.h(z, u[:m])}
        )
        functions, slopes = {}, {}
        letters = values if implicit else "AC"
        for (name, value), letter in zip(values.items(), letters, strict=True):
            slope = slopes[letter] = ca.jacobian(value, z)
            entries = ca.sparsity_cast(slope, ca.Sparsity.dense(slope.nnz(), 1))
            results = [ca.densify(value), ca.densify(entries)]
            functions[name] = ca.Function(f"mhe_casadi_{name}", [z, u], results)
        further = self._further(functions)
        operations = sum(one.n_instructions() for one in (*functions.values(), *further.values()))
        if operations > MOST_OPERATIONS:
            raise CompilationError(
                f"the filter's model has {operations} operations, more than {MOST_OPERATIONS}, "
                "which would keep a compiler busy for longer than they save."
            )
        if implicit:
            functions = {}
        return filter_files(model, self.part, functions | further, slopes)

    def _further(self, functions: dict[str, Any]) -> dict[str, Any]:
        """Further functions of the model."""
        return {}


class LikelihoodLibrary(FilterLibrary):
    """The negative log likelihood of records, and its adjoint."""

    part = "likelihood"

    def _bind(self, library: ctypes.CDLL) -> None:
        super()._bind(library)
        library.mhe_kept_size.restype = ctypes.c_size_t
        self._size, self._kept = library.mhe_kept_size(), np.empty(0, np.uint8)

    def _further(self, functions: dict[str, Any]) -> dict[str, Any]:
        """The derivative by z and u of all values and nonzeros, times what follows z."""
        ca = import_casadi()
        first = next(iter(functions.values()))
        z, u = (ca.SX.sym(name, first.numel_in(k)) for k, name in enumerate("zu"))
        results = [one for each in functions.values() for one in each(z, u)]
        seeds = [ca.SX.sym("by", one.numel()) for one in results]
        total = sum((ca.dot(*pair) for pair in zip(seeds, results, strict=True)), ca.SX(0))
        back = [ca.densify(ca.gradient(total, one)) for one in (z, u)]
        name = "back" if "step" in functions else "pull"
        return {name: ca.Function(f"mhe_casadi_{name}", [ca.vertcat(z, *seeds), u], back)}

    def costs(self, given: LikelihoodInput) -> Array:
        """The cost of each sample (T,)."""
        record, _held = _structure(_Record, given)
        costs, kept = np.empty(len(given.y)), np.empty(self._size, np.uint8)
        self._library.mhe_filter_record(
            ctypes.byref(record), len(costs), len(costs), None, _at(kept), _at(costs))
        return costs

    def follow(self, x: Array, inputs: Array) -> Array:
        """States (K, n) an implicit step behind x, with inputs (K, m + 1), its length the last."""
        x, inputs = (np.ascontiguousarray(one, np.float64) for one in (x, inputs))
        reached = np.empty_like(x)
        self._library.mhe_steps(ctypes.c_int64(len(x)), *map(_at, (x, inputs, reached)))
        return reached

    def adjoint(
        self, given: LikelihoodInput, weights: Array
    ) -> tuple[float, Array, Array, Array, Array]:
        """The sum of costs with these weights (T,), and its derivatives.

        They are by P(0), Q, R, and u in all samples; where the sum is not finite, they are not
        computed.
        """
        n, m, p, samples = self._n, self._m, self._p, len(given.y)
        record, _held = _structure(_Record, given)
        by = [np.zeros(shape) for shape in ((n, n), (n, n), (p, p), (m,))]
        # As few numbers as possible where the record is too long to keep all.
        length = max(1, samples)
        if samples * self._size > _MOST_BYTES:
            length = int(np.sqrt(samples)) + 1
        if self._kept.size < length * self._size:  # new pages take time
            self._kept = np.empty(length * self._size, np.uint8)
        costs, kept = np.empty(samples), self._kept
        points = np.empty((-(-samples // length), n + n * n))
        common = ctypes.byref(record), samples, length, _at(points), _at(kept)
        self._library.mhe_filter_record(*common, _at(costs))
        chosen = np.ascontiguousarray(weights, np.float64)
        used = chosen != 0.0  # others may be infinite
        total = float(costs[used] @ chosen[used])
        if np.isfinite(total):
            self._library.mhe_filter_record_back(*common, _at(chosen), *map(_at, by))
        return total, by[0], by[1], by[2], by[3]


class HypothesisInput(NamedTuple):
    """A record and the filter's numbers: those of ``mhe_hypothesis`` in C, in its order."""

    start: Array  # (n,), and its covariance (n, n)
    prior: Array
    disturbance: Array  # (n, n), of what enters the state
    noise: Array  # (p, p) or (T, p, p), in units
    y: Array  # (T, p), anything where missing
    inputs: Array  # (T, m + 1), the length of each step behind u
    there: NDArray[np.bool_]  # (T, p)
    unit: Array  # (p,)
    low: Array  # (n,), bounds of the state, or infinite
    high: Array
    periods: Array  # (p,), of outputs that are angles, else 0
    repeats: NDArray[np.int64]  # (T,), steps of the model behind each sample
    changes: int  # whether the noise has samples
    doubts: int  # whether single measurements may be outliers
    scale: float  # of each step, where its length is no input
    far: float  # of outliers: deviations, the width of their density, and logarithms of shares
    width: float
    extreme: float
    inlying: float


class _Hypothesis(ctypes.Structure):
    _fields_ = [(name, _NUMBERS.get(name, ctypes.c_void_p)) for name in HypothesisInput._fields]


class HypothesisLibrary(FilterLibrary):
    """Log likelihoods of a record under hypotheses: `qpmhe.diagnosis.bank.FilterBank`."""

    part = "hypothesis"

    def _bind(self, library: ctypes.CDLL) -> None:
        super()._bind(library)
        library.mhe_filter_hypothesis.restype = ctypes.c_int64

    def run(
        self, given: HypothesisInput, results: Sequence[Array] = ()
    ) -> tuple[Array, NDArray[np.int64]] | None:
        """Log likelihoods (T,), and how many measurements were left out (p,); None if it fails.

        ``results`` are filled: the arrays of ``mhe_filtered`` in C, in its order.
        """
        record, _held = _structure(_Hypothesis, given)
        logs, left_out = np.empty(len(given.y)), np.empty(self._p, np.int64)
        out = (ctypes.c_void_p * len(results))(*map(_at, results)) if results else None
        done = self._library.mhe_filter_hypothesis(
            ctypes.byref(record), ctypes.c_int64(len(logs)), _at(logs), _at(left_out), out)
        return (logs, left_out) if done == len(logs) else None


def first_fault(compared: Callable[[float], str]) -> str:
    """What is wrong with a library, with the prior or with shares of it; blank if nothing.

    Where a prior is vague, rounding differs between filters by more than the data say.
    """
    faults = []
    for share in _SHARES:
        faults.append(compared(share))
        if not faults[-1]:
            return ""
    return faults[0]


def _at(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _structure(kind: Any, given: Any) -> tuple[Any, list[Any]]:
    """The structure in C, and the arrays that it points to."""
    types = {"there": np.uint8, "repeats": np.int64}
    values, arrays = [], []
    for name, one in zip(given._fields, given, strict=True):
        if isinstance(one, np.ndarray):
            arrays.append(np.ascontiguousarray(one, types.get(name, np.float64)))
            one = _at(arrays[-1])
        values.append(one)
    return kind(*values), arrays


def scalar_model(model: CasadiModel | None) -> CasadiModel | None:
    """The model with f and h as scalar expressions; None where they are none.

    With implicit steps, f is the rate.
    """
    if model is None:
        return None
    model = replace(model, f=in_scalars(model.f), h=in_scalars(model.h))
    return model if model.f.is_a("SXFunction") and model.h.is_a("SXFunction") else None
