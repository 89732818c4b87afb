"""CasADi models evaluated on fixed arrays, by CasADi's virtual machine or other means."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .algebraic import AlgebraicStates
from .expressions import CasadiModel, functions_within, import_casadi
from .implicit_steps import ImplicitStep
from .quiet import quiet

Array = NDArray[np.float64]
# Fixed arrays for states, inputs and results, and what computes these from those.
Buffers = tuple[Array, Array, dict[str, Array], Callable[[], object]]
# Makes buffers for a number of states and the wanted results.
Maker = Callable[[int, tuple[str, ...]], Buffers]
Places = tuple[NDArray[np.intp], NDArray[np.intp]]

_MOST_KEPT = 64
# Kinds of CasADi's functions that print nothing where they fail.
_SILENT = {"SXFunction", "MXFunction", "Map", "MapSum", "Switch"}
# Estimators of several threads may share a system, and so the symbols of its expressions.
_MAKING = threading.RLock()
NAMES = ("f", "h", "f_jacobian", "h_jacobian")
VALUES = ("f", "h")
RESIDUALS = ("residuals",)
# The entries of both Jacobians that may be other than 0, by rows: see `VirtualMachine.pattern`.
ENTRIES = ("entries",)


class Evaluator:
    """Functions of (x, u) over (n,) or (B, n) that work on buffers kept between calls."""

    def __init__(self, maker: Maker) -> None:
        self._maker = maker
        self._local = threading.local()  # two threads must not share buffers

    def one(self, name: str, x: Array, u: Array | None = None) -> Array:
        """A fresh array of one of the four functions' values."""
        single = x.ndim == 1
        if not single and x.shape[0] == 0:  # the virtual machine cannot map over nothing
            return np.zeros_like(self._buffers(1, (name,))[2][name][:0])
        states, inputs, results, evaluate = self._buffers(
            1 if single else x.shape[0], (name,)
        )
        states[...] = x
        if u is not None:
            inputs[...] = u
        evaluate()
        result = results[name]
        value: Array = result[0].copy() if single else result.copy()
        return value

    def stage(
        self, x: Array, u: Array, by_entries: bool = False
    ) -> tuple[Array, Array, Array]:
        """f, h and their joint Jacobian, or its entries, at one state: good until the next call."""
        names = VALUES + ENTRIES if by_entries else NAMES
        states, inputs, results, evaluate = self._buffers(1, names)
        states[...] = x
        inputs[...] = u
        evaluate()
        if by_entries:
            return results["f"][0], results["h"][0], results["entries"][0]
        return results["f"], results["h"], results["joint"]

    @property
    def pattern(self) -> Places | None:
        """Rows and columns of the joint Jacobian's entries; None where they are not known."""
        found: Places | None = getattr(self._maker, "pattern", None)
        return found

    def residuals(self, trajectory: Array, y: Array, u: Array) -> Array:
        """A fresh array of w and v along a trajectory."""
        states, inputs, results, evaluate = self._buffers(y.shape[0], RESIDUALS)
        states[...] = trajectory
        inputs[...] = u
        results["y"][...] = y
        evaluate()
        value: Array = results["residuals"].copy()
        return value

    def prepare(self, horizon: int, by_entries: bool = False) -> None:
        """Make the buffers of the first window and of a full one, in this thread.

        Where Jacobians are evaluated ``by_entries``, none is kept as a matrix.
        """
        if by_entries:
            self._local.__dict__.pop("kept", None)
        self._buffers(1, VALUES + ENTRIES if by_entries else NAMES)
        for count in dict.fromkeys((1, horizon)):
            self._buffers(count, RESIDUALS)
            for name in VALUES + ENTRIES if by_entries else NAMES:
                self._buffers(count, (name,))

    def _buffers(self, count: int, names: tuple[str, ...]) -> Buffers:
        try:
            found: Buffers = self._local.kept[count, names]
        except (AttributeError, KeyError):
            kept = self._local.__dict__.setdefault("kept", {})
            if len(kept) >= _MOST_KEPT:  # of a caller whose batches have all sorts of lengths
                kept.clear()
            found = kept[count, names] = self._maker(count, names)
        return found


def may_fail(function: Any) -> bool:
    """Whether an evaluation can fail; purely scalar operations cannot."""
    call = import_casadi().OP_CALL
    return not function.is_a("SXFunction") or any(
        function.instruction_id(k) == call for k in range(function.n_instructions())
    )


def fixed_call(
    function: Any, arguments: Sequence[Array], results: Sequence[Array], fallible: bool = True
) -> Callable[[], bool]:
    """A call of a function on arrays in place, which returns whether it worked.

    Where it did not, the results are not written, or only in part.
    """
    buffer, run = function.buffer()
    for i, array in enumerate(arguments):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(results):
        buffer.set_res(i, array.data)
    kept = function, buffer, arguments, results  # `run` has no more than addresses
    if fallible and any(one.class_name() not in _SILENT for one in functions_within(function)):
        run = quiet()(run)  # of a solver, for one

    def call() -> bool:
        if not fallible:
            run()
            return bool(kept)
        try:
            run()
        except RuntimeError:  # of a solver or a callback within the function
            return False
        code: int = buffer.ret()
        return code == 0

    return call


def separate_calls(
    functions: dict[str, Any], states: Array, inputs: Array, results: dict[str, Array]
) -> Callable[[], None]:
    """Evaluation of each function at each state by itself, NaN where it fails."""
    calls = []
    for name, function in functions.items():
        rows = results[name].reshape(len(states), -1)  # a view
        calls += [
            (fixed_call(function, (x, u), (row,)), row)
            for x, u, row in zip(states, inputs, rows, strict=True)
        ]

    def evaluate() -> None:
        for call, row in calls:
            if not call():
                row.fill(np.nan)

    return evaluate


def results_of(
    model: CasadiModel, count: int, names: tuple[str, ...], entries: int = 0
) -> dict[str, Array]:
    """Arrays for the wanted results at so many states, by name."""
    n, p = model.n, model.p
    shapes: dict[str, tuple[int, ...]] = {
        "f": (n,), "h": (p,), "f_jacobian": (n, n), "h_jacobian": (p, n), "entries": (entries,),
    }
    if names == RESIDUALS:
        return {"residuals": np.zeros((count, n + p)), "y": np.zeros((count, p))}
    results = {name: np.zeros((count, *shapes[name])) for name in names}
    if names == NAMES:
        # One state alone: both Jacobians are parts of one array.
        joint = results["joint"] = np.zeros((n + p, n))
        results["f_jacobian"], results["h_jacobian"] = joint[None, :n], joint[None, n:]
        results["f"], results["h"] = results["f"][0], results["h"][0]
    return results


class ImplicitMachine:
    """Evaluation of a model whose steps solve equations, by Newton's method.

    Called like `VirtualMachine`, which evaluates its rate and output.
    """

    def __init__(self, model: CasadiModel, timed: bool) -> None:
        assert model.how is not None
        self._model, self._timed = model, timed
        self._evaluator = evaluator = Evaluator(VirtualMachine(model.equations, False))
        functions = partial(evaluator.one, "f"), partial(evaluator.one, "f_jacobian")
        self._algebraic: AlgebraicStates | None = None
        if model.guess:
            self._algebraic = AlgebraicStates(*functions, np.array(model.guess))
        self._step = ImplicitStep(*functions, *model.how, self._algebraic)

    def __call__(self, count: int, names: tuple[str, ...]) -> Buffers:
        """Make buffers for so many states and these results."""
        model, along = self._model, names == RESIDUALS
        n, m = model.n, model.m
        states, inputs = np.zeros((count + along, n)), np.zeros((count, m + self._timed))
        results, usual = results_of(model, count, names), np.full(count, model.dt or 0.0)
        one, x, algebraic = self._evaluator.one, states[:count], self._algebraic

        def evaluate() -> None:
            u = inputs[:, :m]
            dt = inputs[:, m] if self._timed else usual
            w = x if algebraic is None else algebraic.complete(x, u)
            if along:
                residuals = results["residuals"]
                np.subtract(states[1:], self._step.value(w, u, dt), out=residuals[:, :n])
                np.subtract(results["y"], one("h", w, u), out=residuals[:, n:])
                return
            if "f_jacobian" in names:
                following, results["f_jacobian"][...] = self._step.linear(w, u, dt)
            else:
                following = self._step.value(w, u, dt) if "f" in names else x
            if "f" in names:
                results["f"][...] = following.reshape(results["f"].shape)
            if "h" in names:
                results["h"][...] = one("h", w, u).reshape(results["h"].shape)
            if "h_jacobian" in names:
                slope = one("h_jacobian", w, u)
                if algebraic is not None:
                    slope = algebraic.chained(slope, w, u)
                results["h_jacobian"][...] = slope.reshape(results["h_jacobian"].shape)

        return states, inputs, results, evaluate


def machine(model: CasadiModel, timed: bool) -> Maker:
    """What evaluates a model without a compiler."""
    return (ImplicitMachine if model.is_implicit else VirtualMachine)(model, timed)


class VirtualMachine:
    """Evaluation by CasADi's virtual machine, mapped over the states.

    Called with a number of states and the wanted results, it makes buffers. With ``timed``, the
    step's length is one more input.
    """

    def __init__(self, model: CasadiModel, timed: bool) -> None:
        self._model, self._timed = model, timed
        self._made: dict[tuple[str, ...], tuple[Any, dict[str, Any]]] = {}
        self._expressions: dict[str, Any] = {}  # of the same symbols
        self._fallible = may_fail(model.f) or may_fail(model.h)

    def __call__(self, count: int, names: tuple[str, ...]) -> Buffers:
        """Make buffers for so many states and these results."""
        if names == RESIDUALS:
            return self._residuals(count)
        model, timed = self._model, self._timed
        with _MAKING:
            function, functions = self._functions(names)
            if count > 1:
                function = function.map(count)
        states, inputs = np.zeros((count, model.n)), np.zeros((count, model.m + timed))
        entries = self.pattern[0].size if "entries" in names else 0
        results = results_of(model, count, names, entries)
        all_inputs = inputs if timed else np.full((count, model.m + 1), model.dt or 0.0)
        run = fixed_call(
            function, (states, all_inputs), [results[name] for name in names], self._fallible
        )
        again: list[Callable[[], None]] = []

        def evaluate() -> None:
            if not timed:
                all_inputs[:, : model.m] = inputs
            if not run():
                if not again:
                    again.append(separate_calls(functions, states, all_inputs, results))
                again[0]()

        return states, inputs, results, evaluate

    @cached_property
    def pattern(self) -> Places:
        """Rows and columns, by rows, of the entries of [A; C] that may be other than 0.

        The diagonal of A is among them in any case.
        """
        with _MAKING:
            columns, rows = self._joint().sparsity().get_triplet()
        return np.array(rows, np.intp), np.array(columns, np.intp)

    def _joint(self) -> Any:
        """[A; C] with the diagonal of A, transposed: CasADi stores by columns, NumPy by rows."""
        if "joint" not in self._expressions:
            ca, (a, c) = import_casadi(), (self._slope(which) for which in VALUES)
            a = ca.project(a, a.sparsity() + ca.Sparsity.diag(self._model.n))
            self._expressions["joint"] = ca.vertcat(a, c).T
        return self._expressions["joint"]

    def _functions(self, names: tuple[str, ...]) -> tuple[Any, dict[str, Any]]:
        """A function of x and (u, dt) to all of these results, and one to each."""
        if names not in self._made:
            ca, found = import_casadi(), [self._expression(name) for name in names]
            arguments = [self._expressions["x"], self._expressions["given"]]
            function = ca.Function("model", arguments, found)
            functions = {
                name: ca.Function("model", arguments, [one])
                for name, one in zip(names, found, strict=True)
            }
            self._made[names] = function, functions
        return self._made[names]

    def _expression(self, name: str) -> Any:
        """One of the results as an expression of x and (u, dt), made once."""
        ca, model, made = import_casadi(), self._model, self._expressions
        if "x" not in made:
            kind = ca.SX if model.f.is_a("SXFunction") and model.h.is_a("SXFunction") else ca.MX
            made["given"], made["x"] = kind.sym("u", model.m + 1), kind.sym("x", model.n)
        if name not in made:
            u, dt = made["given"][: model.m], made["given"][model.m]
            if name == "f":
                made[name] = model.step()(made["x"], u, dt)
            elif name == "h":
                made[name] = model.h(made["x"], u)
            elif name == "entries":
                joint = self._joint()
                made[name] = ca.sparsity_cast(joint, ca.Sparsity.dense(joint.nnz(), 1))
            else:
                # Transposed: CasADi stores by columns, NumPy by rows.
                made[name] = ca.densify(self._slope(name.partition("_")[0]).T)
        return made[name]

    def _slope(self, which: str) -> Any:
        """The Jacobian of f or h by x."""
        value, made, m = self._expression(which), self._expressions, self._model.m
        return self._model.slope(which, value, made["x"], made["given"][:m], made["given"][m])

    def _residuals(self, count: int) -> Buffers:
        states, inputs, values, evaluate_values = self(count, VALUES)
        results, n = results_of(self._model, count, RESIDUALS), self._model.n
        trajectory, residuals = np.zeros((count + 1, n)), results["residuals"]

        def evaluate() -> None:
            states[...] = trajectory[:-1]
            evaluate_values()
            np.subtract(trajectory[1:], values["f"], out=residuals[:, :n])
            np.subtract(results["y"], values["h"], out=residuals[:, n:])

        return trajectory, inputs, results, evaluate
