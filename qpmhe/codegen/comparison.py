"""Compiled models compared with CasADi's interpreter, before their use.

A compiler's mistake changes numbers silently. The interpreter's results for arguments that differ
in their last digits show how far rounding alone can go.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ..model.evaluation import Buffers, fixed_call, machine
from ..model.expressions import CasadiModel, import_casadi
from ..model.points import Magnitude, states_at
from ..model.sets import ConvexSet

Array = NDArray[np.float64]

# A difference by this share of what a result is made of is rounding.
ROUNDING = 1e-9
# Relative change of the arguments that shows how rounding spreads, and its weight.
_NUDGE, _WEIGHT = 1e-11, 300.0
# States at once: vectorised loops treat remainders in code of their own.
_COUNTS = (1, 2, 3, 4, 5, 8, 11)
# Positive ones first, where most models are defined.
_MAGNITUDES = tuple(Magnitude(*one) for one in (
    (1.0, 0.2), (1.0, -1.0), (10.0, 0.2), (0.1, 0.2), (10.0, -1.0), (100.0, 0.2), (0.01, 0.2),
    (1e3, 0.2), (1e-3, -1.0), (1e5, 0.2), (1e-5, 0.2),
))
_ALL = ("f", "h", "f_jacobian", "h_jacobian")


class Interpreter:
    """A model by CasADi's virtual machine; NaN where it breaks off."""

    def __init__(self, model: CasadiModel) -> None:
        self.model = model
        # Relative changes without a pattern: equal ones would leave differences as they are.
        self._nudge = 1 + _NUDGE * np.random.default_rng(0).uniform(-1.0, 1.0, model.n)
        self._calls: dict[str, tuple[Callable[[], object], Array]] = {}
        self._at = np.zeros(model.n), np.zeros(max(model.m, 1)), np.zeros(1)
        if model.is_implicit:
            self._call_equations()
        else:
            self._call_expressions()

    def _call_equations(self) -> None:
        """Have the steps solved by Newton's method."""
        model, (x, u, dt) = self.model, self._at
        make = machine(model, True)
        for name in _ALL:
            states, inputs, results, evaluate = make(1, (name,))

            def call(
                states: Array = states, inputs: Array = inputs,
                evaluate: Callable[[], object] = evaluate,
            ) -> bool:
                states[0] = x
                inputs[0, : model.m], inputs[0, model.m] = u[: model.m], dt[0]
                with np.errstate(all="ignore"):
                    evaluate()
                return True

            self._calls[name] = call, results[name][0]

    def _call_expressions(self) -> None:
        """Have CasADi's virtual machine evaluate the expressions."""
        ca, model = import_casadi(), self.model
        n, p, step = model.n, model.p, model.step()
        kind = ca.SX if step.is_a("SXFunction") and model.h.is_a("SXFunction") else ca.MX
        x, u, dt = kind.sym("x", n), kind.sym("u", model.m), kind.sym("dt")
        f, h = step(x, u, dt), model.h(x, u)
        # Transposed: CasADi stores by columns, NumPy by rows.
        values = {
            "f": (f, (n,)), "h": (h, (p,)),
            "f_jacobian": (model.slope("f", f, x, u, dt).T, (n, n)),
            "h_jacobian": (model.slope("h", h, x, u, dt).T, (p, n)),
        }
        for name, (value, shape) in values.items():
            function, result = ca.Function(name, [x, u, dt], [ca.densify(value)]), np.zeros(shape)
            self._calls[name] = fixed_call(function, self._at, (result,)), result

    def value(self, name: str, x: Array, u: Array, dt: float) -> Array:
        """The map f, h or the Jacobian of either, at one state; good until the next call."""
        at, inputs, step = self._at
        at[:], inputs[: u.size], step[0] = x, u, dt
        call, result = self._calls[name]
        if not call():
            result[...] = np.nan
        return result

    def stages(self, xs: Array, us: Array, steps: Array, jacobians: bool) -> dict[str, Array]:
        """All at many states, and under ``spread_f`` etc. how far rounding may spread."""
        found = {}
        for name in _ALL if jacobians else _ALL[:2]:
            middle, other = (
                np.array([
                    self.value(name, *one).copy() for one in zip(states, us, steps, strict=True)
                ]).reshape(len(xs), *self._calls[name][1].shape)
                for states in (xs, xs * self._nudge)
            )
            found[name] = middle
            found[f"spread_{name}"] = _WEIGHT * np.nan_to_num(abs(other - middle), posinf=0.0)
        return found


# States, inputs, lengths of steps, and what the interpreter makes of them.
Batch = tuple[Array, Array, Array, dict[str, Array]]


def points(interpreter: Interpreter, states: ConvexSet | None, seed: int) -> Iterator[Batch]:
    """Batches of states within bounds, inputs and steps, with all functions' values.

    Each has one magnitude. Where the model is not finite, other magnitudes are tried.
    """
    model, generator = interpreter.model, np.random.default_rng(seed)
    last = 0
    for batch, count in enumerate(_COUNTS):
        best: Batch | None = None
        most = -1
        for trial in range(len(_MAGNITUDES)):
            last = (last + (trial > 0)) % len(_MAGNITUDES)
            one = _MAGNITUDES[last]
            xs = states_at(generator, one, (count, model.n), states)
            us = generator.uniform(one.least, 1.0, (count, model.m))
            steps = np.full(count, model.dt or 0.0)
            if batch % 2:
                steps *= generator.uniform(0.3, 1.0, count)
            found = interpreter.stages(xs, us, steps, True)
            finite = int(sum(
                np.isfinite(value).reshape(count, -1).all(axis=1).sum() for value in found.values()
            ))
            if finite > most:
                best, most = (xs, us, steps, found), finite
            if finite == count * len(found):
                break
        assert best is not None
        yield best
        last = (last + 1) % 5  # of the usual magnitudes


def differs(got: Array, true: Array, allowed: Array) -> bool:
    """Whether numbers differ by more than allowed, or are finite where others are not."""
    finite = np.isfinite(true)
    if (np.isfinite(got) != finite).any():
        return True
    return bool((abs(got - true)[finite] > allowed[finite]).any())


def _allowed(name: str, xs: Array, found: dict[str, Array]) -> Array:
    """By how much a result may differ: components are compared with their own magnitude."""
    true = found[name]
    size = np.where(np.isfinite(true), abs(true), 0.0).max(axis=0)
    if name == "f":
        size = np.maximum(size, abs(xs).max(axis=0))
    elif name.endswith("jacobian"):
        # An entry may vanish by cancellation.
        size = np.broadcast_to(size.max(axis=1, keepdims=True), size.shape).copy()
        if name == "f_jacobian":
            np.fill_diagonal(size, np.maximum(np.diag(size), 1.0))
    allowed: Array = ROUNDING * size + found[f"spread_{name}"]
    return allowed


def model_fault(
    interpreter: Interpreter, maker: Callable[[bool, int, tuple[str, ...]], Buffers],
    batches: Sequence[Batch],
) -> str:
    """Where a model's machine code differs from the interpreter; empty where it does not."""
    for xs, us, steps, found in batches:
        count = len(xs)
        usual = interpreter.model.dt
        timed = usual is not None and bool((steps != usual).any())
        given = np.column_stack((us, steps)) if timed else us
        calls: list[tuple[str, ...]] = [(name,) for name in _ALL]
        if count == 1:  # all at once are asked of single states only
            calls.append(_ALL)
        for names in calls:
            at, inputs, results, evaluate = maker(timed, count, names)
            at[...], inputs[...] = xs, given
            evaluate()
            for name in names:
                got, true = results[name].reshape(found[name].shape), found[name]
                allowed = _allowed(name, xs, found)
                if name.endswith("jacobian"):
                    # Of a Jacobian that is not finite, some entries depend on the order.
                    whole = np.isfinite(true).all(axis=(1, 2))
                    got, true, allowed = got[whole], true[whole], allowed[whole]
                if differs(got, true, allowed):
                    return f"{name} of {count} states at once differs from CasADi's interpreter"
        fault = _residual_fault(maker, timed, xs, given, found)
        if fault:
            return fault
    return ""


def _residual_fault(
    maker: Callable[[bool, int, tuple[str, ...]], Buffers], timed: bool, xs: Array,
    given: Array, found: dict[str, Array],
) -> str:
    count, n = xs.shape
    trajectory = np.vstack((xs, xs[:1]))
    at, inputs, results, evaluate = maker(timed, count, ("residuals",))
    ys = found["h"] * np.linspace(0.5, 2.0, found["h"].size).reshape(found["h"].shape)
    at[...], inputs[...], results["y"][...] = trajectory, given, ys
    evaluate()
    for name, part, target in (("f", slice(None, n), trajectory[1:]), ("h", slice(n, None), ys)):
        size = np.where(np.isfinite(target), abs(target), 0.0)
        if differs(
            results["residuals"][:, part], target - found[name],
            _allowed(name, xs, found) + ROUNDING * size,
        ):
            return f"the residuals of {count} stages differ from those of CasADi's interpreter"
    return ""
