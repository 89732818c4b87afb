"""The block factorisation in C, by loops and by vectors, beside a dense Cholesky factorisation."""

import ctypes
import subprocess

import numpy as np
import pytest

from qpmhe.codegen.compiler import find_compiler, has_vectors
from qpmhe.codegen.templates import template

COMPILER = find_compiler()
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
COUNT = 3
PARTS = {"loops": ["factor_loops"], "vectors": ["factor_vectors", "factor_loops"]}
KINDS = [
    "loops",
    pytest.param("vectors", marks=pytest.mark.skipif(
        not has_vectors(), reason="the processor has no vectors of four numbers")),
]
# All numbers of rows that a last tile may have, and all numbers of vectors.
SIZES = [4, 5, 6, 7, 8, 11, 13, 14, 18, 24, 25, 35]


def width(n):
    """Of a panel, as the header has it."""
    return (2 * n + 3) // 4 * 4 if n < 24 else (2 * n + 31) // 32 * 32


def factorisation(n, kind, folder):
    """The function, as users compile it, of panels and the inverse pivots."""
    text = "".join(template(f"{part}.c") for part in PARTS[kind])
    (folder / "factor.c").write_text(
        "#include <math.h>\ntypedef double real;\ntypedef struct { real *panels, *inverse_pivots; }"
        f" mhe_workspace;\ntypedef int mhe_terms;\n#define NX {n}\n#define WIDTH {width(n)}\n{text}"
        "int factorise(real *panels, real *inverse_pivots, int count)\n"
        "{ mhe_workspace k = {panels, inverse_pivots}; return mhe_factorise(&k, count); }\n"
    )
    subprocess.run(
        [*COMPILER, "-std=c99", "-O3", "-march=native", "-fPIC", "-shared", "-Wall", "-Wextra",
         "-Werror", "-Wno-unused-function", "-o", "factor.so", "factor.c"], cwd=folder, check=True,
    )
    call = ctypes.CDLL(str(folder / "factor.so")).factorise
    array = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    call.argtypes = [array, array, ctypes.c_int]
    return call


def hessian(n, seed=0):
    """A random one, positive definite and block tridiagonal, and its panels."""
    rng, size = np.random.default_rng(seed), n * (COUNT + 1)
    H = np.zeros((size, size))
    for i in range(COUNT):
        rows = rng.normal(size=(2 * n, 2 * n))
        at = slice(i * n, (i + 2) * n)
        H[at, at] += rows.T @ rows + 0.1 * np.eye(2 * n)
    panels = np.full((COUNT + 1, n, width(n)), 1e3)
    for i in range(COUNT + 1):
        block = H[i * n : (i + 1) * n, i * n : (i + 2) * n]
        panels[i, :, : block.shape[1]] = block
    return H, panels


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", SIZES)
def test_it_is_that_of_the_dense_hessian(n, kind, tmp_path):
    """D L' is the triangle of a Cholesky factor, times its diagonal."""
    H, panels = hessian(n)
    inverse = np.zeros((COUNT + 1, n))
    assert factorisation(n, kind, tmp_path)(panels, inverse, COUNT)
    upper = np.linalg.cholesky(H).T
    expected = upper * np.diag(upper)[:, None]
    assert inverse.ravel() == pytest.approx(1 / np.diag(expected), rel=1e-9)
    scale = np.abs(H).max()
    for i in range(COUNT + 1):
        rows = expected[i * n : (i + 1) * n, i * n : (i + 2) * n]
        found = panels[i, :, : rows.shape[1]]
        assert np.abs(np.triu(found - rows)).max() < 1e-12 * scale


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [-1e6, 0.0, np.nan, np.inf])
@pytest.mark.parametrize("row", [0, 1, 6])
def test_a_pivot_that_is_not_positive_ends_it(row, value, kind, tmp_path):
    n = 7
    _, panels = hessian(n)
    panels[1, row, row] = value
    if value == 0.0:
        panels[:2, :, n:], panels[1, : row + 1] = 0.0, 0.0
    assert not factorisation(n, kind, tmp_path)(panels, np.zeros((COUNT + 1, n)), COUNT)


@pytest.mark.skipif(not has_vectors(), reason="the processor has no vectors of four numbers")
@pytest.mark.parametrize("n", SIZES)
def test_vectors_leave_what_loops_leave(n, tmp_path):
    """Each entry is the same sum in the same order; compilers may round its products at will."""
    _, by_loops = hessian(n, seed=1)
    by_vectors = by_loops.copy()
    for kind, panels in (("loops", by_loops), ("vectors", by_vectors)):
        (tmp_path / kind).mkdir()
        assert factorisation(n, kind, tmp_path / kind)(panels, np.zeros((COUNT + 1, n)), COUNT)
    for i in range(COUNT + 1):
        end = 2 * n if i < COUNT else n
        assert np.abs(np.triu(by_loops[i, :, :end] - by_vectors[i, :, :end])).max() < (
            1e-13 * np.abs(by_loops[i]).max())
        # No tile writes into the next block's coupling, nor behind the end of rows.
        assert (by_vectors[i, :, 2 * n + 3 :] == 1e3).all()
