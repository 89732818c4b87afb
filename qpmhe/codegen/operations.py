"""An upper bound of the operations of one step of a written estimator."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .needs import Needs

#: What counts as one operation in floating point.
FLOPS = ("additions", "multiplications", "divisions", "square_roots")
# Numbers of entries that are in use, and the arrays in which these are.
_COUNTED = {
    ("estimator", "length"): ("stages",),
    ("nearest", "count"): ("active",), ("nearest", "active"): ("reach",),
    ("seen", "count"): ("at",),
    ("sensors", "size"): ("known",), ("sensors", "known_count"): ("known",),
    ("block", "count"): ("mirrors", "share"), ("block", "inequalities"): ("source",),
    ("block", "rank"): ("lead",), ("block", "free"): ("lead",), ("block", "lead"): ("lead",),
}


def bounded(text: str, name: str, needs: Needs) -> dict[str, Any]:
    """The operations of an update, or why they have no bound, as attributes of `Needs`.

    Parameters
    ----------
    text : str
        A written estimator: its header, then its source.
    name : str
        Its name.
    needs : Needs
        The largest numbers of its QPs.
    """
    try:
        from .worst_case import Known, UnboundedError, WorstCase
    except ImportError:
        return {"unbounded": "pycparser is not installed"}
    # A QP is solved in one function, each that counts as `qps` in another.
    solved = needs.qps + needs.corrections + needs.nearest_points
    calls = {"improve_once": needs.qps, "solve_qp": solved}
    try:
        known = Known(
            _COUNTED, {("outcome", "qps"): (0, needs.qps)}, calls, f"{name}_default_settings"
        )
        walk = WorstCase(text, name, known)
        operations = walk.operations("update")
    except UnboundedError as error:
        return {"unbounded": str(error)}
    except Exception as error:  # of C that the walk does not know: the estimator is written
        return {"unbounded": f"the walk of its syntax tree ended ({type(error).__name__}: {error})"}
    others = sorted(operations.keys() - set(FLOPS))
    return {"operations": {one: operations[one] for one in (*FLOPS, *others)}}
