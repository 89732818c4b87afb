"""C code to take away: a whole estimator as one file without dependencies."""

from __future__ import annotations

import re
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InvalidInputError, OptionError

if TYPE_CHECKING:
    from ..estimator import MovingHorizonEstimator

__all__ = ["write"]


def write(
    estimator: MovingHorizonEstimator,
    directory: str | PathLike[str],
    *,
    name: str = "mhe",
    real: str = "double",
) -> tuple[Path, Path]:
    """Write the estimator as a C99 header and source that need nothing but libm.

    The source holds observer, growing window, candidate, Gauss-Newton QPs by a
    block-banded factorisation (an interior-point method where inequalities bind), judgement
    by the true cost, and fallback, without allocation and with bounded loops. It is the text
    that ``engine="compiled"`` compiles. Weights, gain, sets and options of the estimator
    become ``<name>_default_settings``; how to call it stands at the top of the header.

    Parameters
    ----------
    estimator : MovingHorizonEstimator
        What to write: its system made by `System.from_casadi`, its observer of constant
        gain, its cost quadratic. What it has measured so far is not written.
    directory : str or path
        Where; made if need be.
    name : str
        Name of the files and prefix of all public names.
    real : {"double", "float"}
        Precision. In single precision sets are kept to 1e-5 and the tolerances are widened
        to what can be told apart.

    Returns
    -------
    header, source : Path
        ``<name>.h`` and ``<name>.c``.

    Raises
    ------
    OptionError
        If something has no C form, or an option is unknown; the text tells the remedy.
    CompilationError
        If CasADi has no C code for a part of the model.
    InvalidInputError
        If this is no estimator, or the directory cannot be written.
    """
    from ..estimator import MovingHorizonEstimator
    from .library import generated

    if not isinstance(estimator, MovingHorizonEstimator):
        raise InvalidInputError(
            f"estimator is {estimator!r}; expected a qpmhe.MovingHorizonEstimator."
        )
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise OptionError(
            f"name is {name!r}; expected a C identifier: letters, digits and underscores."
        )
    if real not in ("double", "float"):
        raise OptionError(f"real is {real!r}; expected 'double' or 'float'.")
    files, _, _, _ = generated(
        estimator.system, estimator.observer, estimator.cost, estimator.settings, name, real
    )
    try:
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        for file, text in files.items():
            (folder / file).write_text(text, encoding="ascii")
    except (OSError, TypeError, ValueError) as error:
        raise InvalidInputError(
            f"directory is {directory!r}, which cannot be written ({error})."
        ) from error
    return folder / f"{name}.h", folder / f"{name}.c"
