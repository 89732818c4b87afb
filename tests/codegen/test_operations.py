"""The bound of a step's operations: kernels counted by hand, whole steps as they are executed."""

import math
import sys

import numpy as np
import pytest

from qpmhe import codegen
from qpmhe.codegen.operations import FLOPS
from qpmhe.codegen.templates import template
from qpmhe.codegen.worst_case import Known, UnboundedError, WorstCase

from .cases import case
from .clean import wild
from .counting import COMPILER, OTHERS, counted
from .test_write import linear

HEAD = "typedef double real;\n#define NX 5\nstatic const int columns[] = {0, 2, 3};\n"
NOTHING = Known({}, {}, {})


def operations(text, function="f", known=NOTHING):
    """Additions, multiplications, divisions, square roots; and calls of libm, if there are any."""
    found = WorstCase(HEAD + text, "mhe", known).operations(function)
    others = {name: found[name] for name in found if name not in FLOPS}
    flops = tuple(found[one] for one in FLOPS)
    return (*flops, others) if others else flops


def called(call, text=""):
    """Those of a call of one of the algebra's functions, with matrices and vectors at hand."""
    arrays = "real A[999], B[999], C[999], D[999];"
    return operations(f"{template('algebra.c')}\n{text}\nvoid mhe_f(void) {{ {arrays} {call} }}\n")


@pytest.mark.parametrize(("call", "expected"), [
    ("mhe_dot(4, A, B);", (4, 4, 0, 0)),
    ("mhe_times(6, A, B, C);", (36, 36, 0, 0)),
    ("mhe_multiply(2, 3, 4, A, B, C);", (24, 24, 0, 0)),
    ("mhe_multiply_transposed(2, 3, 4, A, B, C);", (24, 24, 0, 0)),
    ("mhe_add_product(2, 3, 4, A, B, C);", (24, 24, 0, 0)),
    # For i, j < i: one sum and its half.
    ("mhe_symmetrise(4, A);", (6, 6, 0, 0)),
    # 2 + 1 quotients; below them 2 + 1 and 1 entries of what is left of the triangle.
    ("mhe_decompose(3, A);", (4, 4, 3, 0)),
    # 3 quotients and 3 entries of one column forwards; 3 and 3 quotients backwards.
    ("mhe_solve_for(3, A, 1, B);", (6, 6, 6, 0)),
])
def test_algebra_by_hand(call, expected):
    assert called(call) == expected


CHOLESKY = """
static void mhe_cholesky(int n, real *A)
{
    for (int j = 0; j < n; j++) {
        real *row = A + j * n;
        for (int k = 0; k < j; k++) row[j] -= row[k] * row[k];
        row[j] = sqrt(row[j]);
        for (int i = j + 1; i < n; i++) {
            real sum = A[i * n + j];
            for (int k = 0; k < j; k++) sum -= A[i * n + k] * row[k];
            A[i * n + j] = sum / row[j];
        }
    }
}
"""


@pytest.mark.parametrize("n", [1, 2, 3, 7, 40])
def test_a_triangular_factorisation_is_exact(n):
    """n (n - 1) (n + 1) / 6 products, n (n - 1) / 2 quotients, n roots."""
    products, quotients = n * (n - 1) * (n + 1) // 6, n * (n - 1) // 2
    assert called(f"mhe_cholesky({n}, A);", CHOLESKY) == (products, products, quotients, n)


def test_long_loops_take_their_dearest_iteration():
    """A bound, by a factor of two for a triangle of more rows than are summed."""
    text = "void mhe_f(const real *x, real *s) { for (int i = 0; i < %d; i++) "
    text += "for (int j = 0; j < i; j++) *s += x[j]; }"
    assert operations(text % 600)[0] == 600 * 599 // 2
    assert operations(text % 5000)[0] == 5000 * 4999


@pytest.mark.parametrize(("body", "expected"), [
    # Conditions that constants decide, and those that nothing decides.
    ("if (NX > 4) s += 1; else s *= 2;", (1, 0, 0, 0)),
    ("if (s > 0) s += s + 1; else s *= 2;", (2, 1, 0, 0)),
    ("s = s > 0 ? s + 1 : s * s * 2;", (1, 2, 0, 0)),
    ("if (!NX || n == 3) s /= 2;", (0, 0, 1, 0)),
    # What ends a function is an alternative of all behind it.
    ("if (s > 0) { s = s * s * s * s; return; } s = s * 2 + 1;", (1, 3, 0, 0)),
    # Integers, signs and tests are no operations.
    ("n = n * 2 + 1; s = -s; s = fabs(s); n = isfinite(s) && s < 2;", (0, 0, 0, 0)),
    ("s = 2 * sqrt(s) - sin(s) * pow(s, 3);", (1, 2, 0, 1, {"sin": 1, "pow": 1})),
    ("float t = sqrtf(2) + cosf(1);", (1, 0, 0, 1, {"cos": 1})),
    # Loops by other steps, by several conditions, and backwards.
    ("for (int i = 0; i + 2 <= NX; i += 2) s += 1;", (2, 0, 0, 0)),
    ("for (int i = NX - 1; i >= 0 && s > 0; i--) s += 1;", (5, 0, 0, 0)),
    ("int i = 7; while (s > 0 && i-- > 0) s += 1;", (7, 0, 0, 0)),
    ("int i = 7; while (i >= 0 && s > 0) i--, s += 1;", (8, 0, 0, 0)),
    ("do { s += 1; } while (0);", (1, 0, 0, 0)),
    ("for (int i = 0; i < n && i < 4; i++) s += 1;", (4, 0, 0, 0)),
    ("for (int i = 0; i < (n < 4 ? n : 4); i++) s += 1;", (4, 0, 0, 0)),
    ("if (n > 6) return; for (int i = 0; i < n; i++) s += 1;", (6, 0, 0, 0)),
    # As often as an entry has been counted.
    ("int m = 0; for (int i = 0; i < NX; i++) if (s > i) m++; "
     "for (int i = 0; i < m; i++) s *= 2;", (0, 5, 0, 0)),
    ("for (int i = 0; i < 2; i++) for (int j = columns[i]; j != columns[i + 1]; j++) s += 1;",
     (3, 0, 0, 0)),
    ("switch (n) { case 0: s += 1; break; case 1: s *= 2; }", (1, 1, 0, 0)),
    # Counters that the body moves, too, are not at every step.
    ("for (int i = 0; i < 10; i += 2) { for (int j = 0; j < i; j++) s += 1; if (s > 1) i += 1; }",
     (45, 0, 0, 0)),
    ("for (int i = 0; i < 010; i++) s += 1;", (8, 0, 0, 0)),
])
def test_statements(body, expected):
    assert operations(f"void mhe_f(int n, real s) {{ {body} }}\n") == expected


@pytest.mark.parametrize("body", [
    "for (;;) s += 1;", "while (s > 0) s /= 2;", "for (int i = 0; i < n; i++) s += 1;",
    "for (int i = 0; i < 3; i++) { s += 1; i -= 1; }", "again: s += 1; goto again;",
    "int i = 3; while (i > 0) { if (s > 0) i--; s += 1; }",
    "int i = 3; while (i > 0) { if (s > 0) continue; i--; }",
    "int again = 0; do { s += 1; again = s > 0; } while (again);",
    "int i = 3; do { s += 1; } while (i-- > 0);",
    # Which case ends a switch, only the data know; in each, only those before may have run.
    "int k = 2; switch (n) { case 0: k = 9; break; case 1: k = 5; } "
    "for (int i = 0; i < k; i++) s += 1;",
    "int k = 9; switch (n) { case 0: k = 5; break; case 1: for (int i = 0; i < k; i++) s += 1; }",
])
def test_what_has_no_bound_is_said(body):
    with pytest.raises(UnboundedError, match=r"mhe_f has a (loop without a bound|label|goto)"):
        operations(f"void mhe_f(int n, real s) {{ {body} }}\n")


def test_an_address_that_is_kept_is_said():
    """What is written by it is not followed."""
    text = "void mhe_f(real s) { int m = 2; int *p = &m; *p = 9; "
    text += "for (int i = 0; i < m; i++) s += 1; }"
    with pytest.raises(UnboundedError, match="mhe_f keeps the address of m"):
        operations(text)


def test_what_pointers_and_structures_say():
    """Results by pointers, functions by pointers, members by the arrays that they count."""
    text = """
typedef struct { int count; real at[7]; } mhe_list;
static void count(int limit, int *found) { for (*found = 0; *found < limit; ++*found) ; }
static real twice(real x) { return 2 * x; }
static real each(real (*f)(real), int n, real x) { for (int i = 0; i < n; i++) x = f(x); return x; }
static const int sizes[] = {2, 4, 3};
static void inner(real *x) { *x += 1; }
void mhe_f(mhe_list *list, real x)
{
    int n;
    count(3, &n);
    for (int i = 0; i < n; i++) x += 1;
    each(twice, 6, x);
    for (int i = 0; i < list->count; i++) x /= list->at[i];
    for (int i = 0; i < 3; i++) for (int j = 0; j < sizes[i]; j++) x = sqrt(x);
    for (int i = 0; i < 100; i++) inner(&x);
}
"""
    known = Known({("list", "count"): ("at",)}, {}, {"inner": 5})
    text = text.replace("inner(", "mhe_inner(")
    assert operations(text, known=known) == (3 + 5, 6, 7, 9)


# Of these, hostile samples come so near to the bound.
WITHOUT_SETS = ["inputs", "mixed losses", "extended", "unscented prior", "graduated reinitialized"]
WITH_SETS = ["restored", "held in sets", "soft states", "fewer disturbances in sets",
             "angles across the seam"]
NEAR = 4


@pytest.mark.slow
@pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")
@pytest.mark.filterwarnings("ignore::qpmhe.errors.ObserverWarning")
@pytest.mark.parametrize("name", [*WITHOUT_SETS, *WITH_SETS])
def test_no_step_executes_more(name, tmp_path):
    """The C computes with numbers that count, over samples with anything in them."""
    one = case(name)
    samples = [
        sample | {"y": np.resize(sample["y"], one.system.p)}
        for sample in (*one.samples, *wild(one))
    ]
    needs = codegen.write(one.estimator("python"), tmp_path).needs
    assert set(needs.operations) <= {*FLOPS, *OTHERS}
    found = counted(tmp_path, one.start, samples)
    for kind in found.dtype.names:
        assert found[kind].max() <= needs.operations.get(kind, 0), kind
    most = sum(found[kind] for kind in FLOPS).max()
    if name in WITHOUT_SETS:
        assert needs.flops < NEAR * most


def test_the_header_says_so(tmp_path):
    written = codegen.write(linear(horizon=4, max_qps=2), tmp_path)
    needs, text = written.needs, " ".join(written[0].read_text().replace("\n *", "").split())
    counts = ", ".join(f"{needs.operations[one]} {one.replace('_', ' ')}" for one in FLOPS)
    assert f"Operations in floating point with the settings below: at most {counts}." in text
    assert f"#define MHE_MOST_FLOPS {needs.flops} " in text
    assert needs.flops == sum(needs.operations.values())
    assert math.isfinite(needs.flops)
    assert codegen.write(linear(horizon=4, max_qps=0), tmp_path).needs.flops < needs.flops / 10


def test_the_header_says_why_not(tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "qpmhe.codegen.worst_case", raising=False)
    monkeypatch.setitem(sys.modules, "pycparser", None)
    written = codegen.write(linear(), tmp_path)
    assert written.needs.operations is None
    assert written.needs.flops is None
    assert written.needs.unbounded == "pycparser is not installed"
    header = " ".join(written[0].read_text().replace("\n *", "").split())
    assert "no bound of its operations in floating point: pycparser is not installed." in header
    assert "MOST_FLOPS" not in header
