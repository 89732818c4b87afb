"""Dumped QPs as a test set of qpbenchmark, whose own runner and report work on it."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from qpmhe_solvers import QP
from qpmhe_solvers.dispatch import qpsolvers_arguments
from qpmhe_solvers.files import StoredQP, load, qp_files
from qpmhe_solvers.layout import QPLayout, QPStructure, QPStyle

from ..errors import InvalidInputError, OptionError

if TYPE_CHECKING:
    import qpsolvers

Matrices = Literal["sparse", "dense"]

# qpbenchmark derives the name of the class from the name of the file.
_SCRIPT = "mhe_qpbenchmark.py"
_CODE = '''"""A test set of qpbenchmark: qpbenchmark {script} --results-path results.csv run."""

from pathlib import Path

import qpbenchmark

PROBLEMS = Path(__file__).parent / "problems"


class MheQpbenchmark(qpbenchmark.TestSet):
    title = {title!r}
    description = {description!r}
    sparse_only = {sparse}

    def __iter__(self):
        for path in sorted(PROBLEMS.glob("*.npz")):
            yield qpbenchmark.Problem.load(str(path)).to_{matrices}()
'''


_DESCRIPTION = (
    "{} QPs from the steps of qpmhe's moving horizon estimators: increments of a state trajectory, "
    "with a block-tridiagonal Hessian. Every solver starts cold here."
)


class ExportedSet(NamedTuple):
    """The script that qpbenchmark takes, the ``.npz`` problems, and why files were left out."""

    script: Path
    problems: list[Path]
    skipped: dict[Path, str]


def export_qpbenchmark(
    files_or_folder: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    out: str | os.PathLike[str], *, matrices: Matrices = "sparse",
    title: str = "QPs of moving horizon estimation",
) -> ExportedSet:
    r"""Write dumped QPs as a test set for the runner of qpbenchmark.

    Each becomes

    .. math::
        \min_x \tfrac12 x^\top P x + q^\top x \quad \text{s.t.} \quad
        G x \le h, \quad A x = b, \quad l \le x \le u

    without infinite entries: a side of the bounds that is finite throughout is l or u, and one
    that is finite in part goes to the rows of G. Data that are not finite, on which some solvers
    hang, and bounds that exclude each other are left out.

    Parameters
    ----------
    files_or_folder : path, or iterable of paths
        Files of `qpmhe.solvers.dump`, or folders of them.
    out : str or path
        The folder for ``mhe_qpbenchmark.py`` and a folder of problems.
    matrices : {"sparse", "dense"}
        Matrices for solvers that take both kinds. With ``sparse``, solvers without a sparse
        interface do not take part. The files are dense in any case, of (K n)^2 numbers and more.
    title : str
        Title of the report.

    Returns
    -------
    ExportedSet
        What was written, and what was left out.

    Raises
    ------
    InvalidInputError, OptionError
        If there is nothing to export, a file was not written by `dump`, ``out`` holds problems
        already or cannot be written, or ``matrices`` is neither.
    """
    if matrices not in get_args(Matrices):
        raise OptionError(f"matrices is {matrices!r}; expected 'sparse' or 'dense'.")
    single = isinstance(files_or_folder, (str, os.PathLike))
    paths: Any = [files_or_folder] if single else files_or_folder
    stored = [load(path) for path in qp_files(paths)]
    skipped = {one.path: why for one in stored if (why := _unfit(one.qp))}
    chosen = [one for one in stored if one.path not in skipped]
    if not chosen:
        reasons = ", ".join(sorted(set(skipped.values()))) or "no file was given"
        raise InvalidInputError(f"there is no QP to export: {reasons}; give other files.")
    folder = Path(out)
    try:
        problems = _write(chosen, folder / "problems")
        script = folder / _SCRIPT
        code = _CODE.format(
            script=_SCRIPT, title=title, description=_DESCRIPTION.format(len(chosen)),
            matrices=matrices, sparse=matrices == "sparse",
        )
        script.write_text(code, encoding="utf-8")
    except OSError as error:
        raise InvalidInputError(
            f"cannot write the test set to {folder}: {error.strerror or error}; give a folder "
            "that can be written to and has space left."
        ) from error
    return ExportedSet(script, problems, skipped)


def _unfit(qp: QP) -> str:
    if not qp.finite():
        return "its data are not finite"
    if (qp.lower > qp.upper).any() or (qp.row_lower > qp.row_upper).any():
        return "a lower bound is above its upper bound"
    return ""


def _write(chosen: list[StoredQP], folder: Path) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.glob("*.npz")):
        raise InvalidInputError(
            f"the folder {folder} holds problems already; give another one, or remove it."
        )
    problems: list[Path] = []
    names: Counter[str] = Counter()
    for one in chosen:
        name = one.path.stem
        names[name] += 1
        if names[name] > 1:  # the same name in several folders
            name = f"{name}_{names[name]}"
        path = folder / f"{name}.npz"
        _problem(one.qp).save(str(path))
        problems.append(path)
    return problems


def _problem(qp: QP) -> qpsolvers.Problem:
    """The QP in the form of qpsolvers, with dense matrices and finite entries only."""
    import qpsolvers  # late: it imports every solver that is installed

    sides = [np.isfinite(side) for side in (qp.lower, qp.upper)]
    box = all(side.all() or not side.any() for side in sides)
    style = QPStyle("dense", bounds="box" if box else "rows", sides=1)
    layout = QPLayout(style, QPStructure.of(qp, exact=True), *qp.sizes)
    layout.fill(qp, None)
    P, q, G, h, A, b, lower, upper = qpsolvers_arguments(layout)
    return qpsolvers.Problem(
        P, q, G, h, A, b,
        lower if lower is not None and sides[0].all() else None,
        upper if upper is not None and sides[1].all() else None,
    )
