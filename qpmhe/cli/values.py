"""Values of options: numbers, boxes, and models with arguments."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError, OptionError, QpmheError
from ..model.sets import Box
from ..plots.style import inches_of


def read_box(option: str, text: str, width: int | None = None, kind: str = "components") -> Box:
    """The box of an option; `width` is its number of components, if known."""
    pairs = [item.split(":") for item in text.split(",")]
    try:
        many = len(pairs) if width is None else width
        if len(pairs) != many or any(len(pair) != 2 for pair in pairs):
            raise ValueError("the number of components")
        low, high = zip(*[(float(a), float(b)) for a, b in pairs], strict=True)
    except ValueError as error:
        such = ",".join(["0.1:9", "-1:9", "0:1"][k % 3] for k in range(width or 2))
        raise OptionError(
            f"{option} is {text!r}; expected low:high for each of the {kind}"
            f"{'' if width is None else f' ({width})'}, separated by commas, as in {such}."
        ) from error
    for k, (least, most) in enumerate(zip(low, high, strict=True), start=1):
        if least > most:
            raise OptionError(
                f"pair {k} of {option} is {least:g}:{most:g}; expected low:high, the lower "
                "number first."
            )
    return Box(low, high)


def read_state(text: str) -> NDArray[np.float64]:
    """The numbers of --initial-state."""
    return read_numbers("--initial-state", text)


def read_numbers(option: str, text: str) -> NDArray[np.float64]:
    """Comma-separated numbers."""
    try:
        return np.array([float(item) for item in text.split(",")])
    except ValueError:
        raise OptionError(f"{option} is {text!r}; expected numbers separated by commas.") from None


def read_width(text: str | None) -> str | float | None:
    """The width of figures: a name, or inches."""
    width: str | float | None = text
    if text is not None:
        with suppress(ValueError):
            width = float(text)
    with named_as_options("width"):
        inches_of(width)
    return width


@contextmanager
def named_as_options(*names: str, **others: str) -> Iterator[None]:
    """Errors with a function's arguments as options: ``--name``, or what ``others`` say."""
    known = {name: f"--{name.replace('_', '-')}" for name in names} | others
    try:
        yield
    except QpmheError as error:
        text = str(error)
        for name, option in known.items():
            text = re.sub(rf"\b{name}=(['\"]?)(\w[\w.]*)\1", rf"{option} \2", text)
            text = re.sub(rf"\b{name}(?= is\b)", option, text)
        text = re.sub(r"\bparameters\['(\w+)'\]", r"--parameter \1", text)
        error.args = (text,)
        raise


def arguments_of(parameters: dict[str, float]) -> str:
    """Parameters as arguments of a model's function."""
    return ", ".join(f"{name}={float(value)!r}" for name, value in parameters.items())


def with_arguments(model: str, parameters: dict[str, float]) -> str:
    """The name of a model with these arguments of its function."""
    if not parameters:
        return model
    if model.endswith(")"):
        raise ModelError(
            f"model {model!r} has arguments already; give the tuned ones with --parameter only, "
            "and the others as defaults of the function."
        )
    return f"{model}({arguments_of(parameters)})"
