"""Values of options: numbers and boxes, between commas."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from ..model.sets import Box


def read_box(option: str, text: str, width: int | None = None, kind: str = "components") -> Box:
    """The box of an option, of so many components where that is known."""
    pairs = [item.split(":") for item in text.split(",")]
    try:
        many = len(pairs) if width is None else width
        if len(pairs) != many or any(len(pair) != 2 for pair in pairs):
            raise ValueError("the number of components")
        low, high = zip(*[(float(a), float(b)) for a, b in pairs], strict=True)
    except ValueError as error:
        whom = "each component" if width is None else f"each of {width} {kind}"
        raise OptionError(
            f"{option} is {text!r}; expected low:high for {whom}, between commas, as in "
            "0.1:9,-1:9."
        ) from error
    return Box(low, high)


def read_state(text: str) -> NDArray[np.float64]:
    """The numbers of --initial-state."""
    return read_numbers("--initial-state", text)


def read_numbers(option: str, text: str) -> NDArray[np.float64]:
    """Numbers between commas."""
    try:
        return np.array([float(item) for item in text.split(",")])
    except ValueError:
        raise OptionError(f"{option} is {text!r}; expected numbers between commas.") from None
