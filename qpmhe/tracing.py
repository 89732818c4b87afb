"""An array that notices when a function mixes the states of a batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["MixesStatesError", "mixes_states"]


class MixesStatesError(Exception):
    """A value was computed from several states of a batch at once."""


class _Traced(np.ndarray[Any, Any]):
    """A batch whose length must stay among the dimensions of everything made of it.

    A reduction over the batch, one of its rows, or the truth of a comparison has lost that
    dimension: the function would answer for the whole batch by some of its states.
    """

    batch: int = 0

    def __array_finalize__(self, source: Any) -> None:
        self.batch = getattr(source, "batch", 0)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        options = {key: _plain(value) for key, value in options.items()}
        return self._checked(getattr(ufunc, method)(*_plain(inputs), **options))

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return self._checked(function(*_plain(args), **_plain(kwargs)))

    def __getitem__(self, key: Any) -> Any:
        return self._checked(_plain(self)[_plain(key)])

    def __iter__(self) -> Iterator[Any]:
        return (self[i] for i in range(self.shape[0]))

    def __bool__(self) -> bool:
        raise MixesStatesError

    def _checked(self, result: Any) -> Any:
        if isinstance(result, (tuple, list)):
            return type(result)(self._checked(item) for item in result)
        if isinstance(result, (bool, np.generic)):
            raise MixesStatesError
        if isinstance(result, np.ndarray):
            if self.batch not in result.shape:
                raise MixesStatesError
            result = result.view(_Traced)
            result.batch = self.batch
        return result


def _plain(value: Any) -> Any:
    if isinstance(value, _Traced):
        return value.view(np.ndarray)
    if isinstance(value, (tuple, list)):
        return type(value)(_plain(item) for item in value)
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value


def mixes_states(function: Callable[..., Any], *batches: NDArray[Any], batch: int) -> bool:
    """Whether a function of batches is seen to mix their members.

    Parameters
    ----------
    function : callable
        The function.
    *batches : array
        Its arguments; their batches have the same length.
    batch : int
        That length, which must be no other dimension's.

    Returns
    -------
    bool
        False, too, where the function leaves NumPy and nothing is seen.
    """
    traced = []
    for values in batches:
        one = values.copy().view(_Traced)
        one.batch = batch
        traced.append(one)
    try:
        function(*traced)
    except MixesStatesError:
        return True
    except Exception:  # it does not take such arrays: nothing is seen
        return False
    return False
