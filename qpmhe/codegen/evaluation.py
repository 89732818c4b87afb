"""CasADi functions called on fixed arrays, with their failures told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .expressions import import_casadi

Array = NDArray[np.float64]


def may_fail(function: Any) -> bool:
    """Whether an evaluation can break off: one of scalar operations alone cannot."""
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
