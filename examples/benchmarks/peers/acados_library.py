"""C that calls acados, compiled with a model's functions where acados is installed."""

from __future__ import annotations

import ctypes
import os
import tempfile
from contextlib import chdir
from pathlib import Path
from typing import Any

from .base import UnavailableError
from .casadi_program import compile_library

__all__ = ["acados_library"]

_HERE = Path(__file__).parent
# How acados takes a function of CasADi; kind ends the name of the structure that holds it.
_PRELUDE = r"""
#include "acados_c/external_function_interface.h"

#define TAKE(made, name, kind, options) do { \
        (made)->casadi_fun = (int (*)(const double **, double **, int *, double *, void *))name; \
        (made)->casadi_work = &name##_work; \
        (made)->casadi_sparsity_in = &name##_sparsity_in; \
        (made)->casadi_sparsity_out = &name##_sparsity_out; \
        (made)->casadi_n_in = &name##_n_in; \
        (made)->casadi_n_out = &name##_n_out; \
        external_function_##kind##_create(made, options); \
    } while (0)
"""


def acados_library(functions: list[Any], source: str) -> ctypes.CDLL:
    """CasADi functions and a file of this folder that calls acados, as one library.

    Raises
    ------
    UnavailableError
        If ``ACADOS_SOURCE_DIR`` is not set or nothing is installed there.
    """
    named = os.environ.get("ACADOS_SOURCE_DIR")
    if not named:
        raise UnavailableError("ACADOS_SOURCE_DIR is not set")
    root = Path(named).absolute()
    include, libraries = root / "include", root / "lib"
    if not (libraries / "libacados.so").exists():
        raise UnavailableError(f"no lib/libacados.so in {root}; build acados and install it there")
    for name in ("blasfeo", "hpipm"):  # where libacados.so does not know their place
        ctypes.CDLL(str(libraries / f"lib{name}.so"), mode=ctypes.RTLD_GLOBAL)
    import casadi as ca

    with tempfile.TemporaryDirectory(prefix="mhe_") as folder, chdir(folder):
        written = ca.CodeGenerator("model", {"casadi_int": "int"})
        for function in functions:
            written.add(function)
        written.generate()
        whole = Path("whole.c").absolute()
        parts = Path("model.c").read_text(encoding="ascii"), _PRELUDE, (_HERE / source).read_text()
        whole.write_text("".join(parts), encoding="ascii")
        return ctypes.CDLL(str(compile_library(whole, (
            f"-I{include}", f"-I{include / 'blasfeo' / 'include'}",
            f"-I{include / 'hpipm' / 'include'}", f"-L{libraries}", f"-Wl,-rpath,{libraries}",
            "-lacados", "-lhpipm", "-lblasfeo",
        ))))
