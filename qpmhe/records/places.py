"""Where in the user's own code an error arose."""

from __future__ import annotations

import traceback
from pathlib import Path

import qpmhe_solvers

__all__ = ["place"]

_OURS = (Path(__file__).parents[1], Path(qpmhe_solvers.__file__).parent)


def place(error: BaseException, file: Path | None) -> str:
    """File and line in the model, or in a file of its folder, as an error text begins with.

    Parameters
    ----------
    error : BaseException
        What was raised; what caused it is looked into first.
    file : Path or None
        Where the model is written down.
    """
    chain: list[BaseException] = []
    one: BaseException | None = error
    while one is not None and one not in chain:
        chain.append(one)
        one = one.__cause__
    for one in reversed(chain):
        if isinstance(one, SyntaxError) and one.filename and one.lineno:
            return f"{one.filename}, line {one.lineno}: "
        own = [
            frame for frame in traceback.extract_tb(one.__traceback__)
            if file is not None and _is_own(Path(frame.filename), file)
        ]
        if own:
            return f"{own[-1].filename}, line {own[-1].lineno}: "
    return ""


def _is_own(code: Path, file: Path) -> bool:
    if code == file:
        return True
    if any(code.is_relative_to(folder) for folder in _OURS):
        return False
    # A folder may have an environment with other people's packages in it.
    return code.is_relative_to(file.parent) and not (
        {"site-packages", "dist-packages"} & set(code.relative_to(file.parent).parts)
    )
