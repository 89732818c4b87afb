"""The estimators that are compared, one a file."""

from __future__ import annotations

from problems import Problem

from .acados_window import Acados
from .base import Array, Peer, UnavailableError, WindowData
from .casadi_fatrop import CasadiFatrop
from .casadi_gauss_newton import CasadiGaussNewton
from .casadi_ipopt import CasadiIpopt
from .casadi_sqp import CasadiSqp
from .do_mpc_mhe import DoMpc
from .filterpy_ekf import FilterpyEkf
from .gekko_program import Gekko
from .qpmhe_variants import Qpmhe

__all__ = ["GROUPS", "Array", "Peer", "UnavailableError", "WindowData", "make"]

#: What ``--peers`` takes.
GROUPS = (
    "ipopt", "sqpmethod", "gauss-newton", "fatrop", "acados", "do-mpc", "gekko", "filterpy",
    "qpmhe",
)

# With few states w is better eliminated; with many, derivatives stage by stage are cheaper.
_FEW_STATES = 4


def make(groups: tuple[str, ...], problem: Problem, compiled: bool, start: str) -> list[Peer]:
    """The estimators of these groups, Ipopt's always first: it is the reference.

    Parameters
    ----------
    groups : tuple of str
        Of `GROUPS`.
    problem : Problem
        Its size decides which form of the program is compiled.
    compiled : bool
        Whether the peers also run with functions compiled in C.
    start : {"shifted", "candidate"}
        Where CasADi's solvers start.

    Returns
    -------
    list of Peer
        Not set up yet.
    """
    form = "states" if problem.n <= _FEW_STATES else "shooting"
    table: dict[str, list[Peer]] = {
        "ipopt": [CasadiIpopt("states", start=start), CasadiIpopt("shooting", start=start)],
        "sqpmethod": [CasadiSqp("states", start=start), CasadiSqp("shooting", start=start)],
        "gauss-newton": [CasadiGaussNewton(start=start)],
        "fatrop": [CasadiFatrop(start=start)],
        "acados": [Acados(1, start), Acados(None, start)],
        "do-mpc": [DoMpc()],
        "gekko": [Gekko()],
        "filterpy": [FilterpyEkf()],
        "qpmhe": [
            Qpmhe("numpy", 0), Qpmhe("numpy", 1), Qpmhe("numpy", 2), Qpmhe("numpy", None),
            Qpmhe("casadi", 1), Qpmhe("casadi", None), Qpmhe("numpy compiled", 1),
            Qpmhe("compiled", 1), Qpmhe("compiled", 1, "best"), Qpmhe("compiled", 2),
            Qpmhe("compiled", None), Qpmhe("extended", 1),
        ],
    }
    if compiled:
        table["ipopt"].append(CasadiIpopt(form, True, start))
        table["sqpmethod"].append(CasadiSqp(form, True, start))
        table["gauss-newton"].append(CasadiGaussNewton(True, start))
        table["fatrop"].append(CasadiFatrop(True, start))
        table["do-mpc"].append(DoMpc(True))
    return [peer for group in GROUPS if group in groups for peer in table[group]]
