/* Blocks of the Gauss-Newton QP by LAPACK and BLAS. */

@functions
/* Call this first: dpotrf, dtrsm, dsyrk and dgemm, by Fortran's convention with 32-bit integers. */
void mhe_set_lapack(void *const *functions);
@
/* SciPy's LAPACK and BLAS, as their callers in C see them; the caller hands them over. */
static struct {
    void (*dpotrf)(const char *uplo, const int *n, real *a, const int *lda, int *info);
    void (*dtrsm)(const char *side, const char *uplo, const char *trans, const char *diag,
                  const int *m, const int *n, const real *alpha, const real *a, const int *lda,
                  real *b, const int *ldb);
    void (*dsyrk)(const char *uplo, const char *trans, const int *n, const int *k,
                  const real *alpha, const real *a, const int *lda, const real *beta, real *c,
                  const int *ldc);
    void (*dgemm)(const char *transa, const char *transb, const int *m, const int *n,
                  const int *k, const real *alpha, const real *a, const int *lda, const real *b,
                  const int *ldb, const real *beta, real *c, const int *ldc);
} mhe_lapack;

void mhe_set_lapack(void *const *functions)
{
    memcpy(&mhe_lapack, functions, sizeof mhe_lapack);
}

/* The terms of f by BLAS, where enough of its Jacobian is not zero; whether they were made. What
 * BLAS reads by columns is the transpose of what is stored by rows. */
static int mhe_dense_terms(const real *Q, const real *w, mhe_terms *t)
{
    const int n = NX;
    const real *A = t->f_jacobian, minus = -1, zero = 0;
    int count = 0;
    for (int i = 0; i < NX * NX; i++) count += A[i] != 0;
    if (count < NX * NX / 4) return 0;
    mhe_lapack.dgemm("N", "T", &n, &n, &n, &minus, Q, &n, A, &n, &zero, t->coupling, &n);
    mhe_lapack.dgemm("N", "N", &n, &n, &n, &minus, A, &n, t->coupling, &n, &zero, t->hessian,
                     &n);
    mhe_times(NX, t->coupling, w, t->own);
    return 1;
}

/* Overwrite the panels by the rows of L', with H = L L'; whether H was positive definite. By
 * columns, as LAPACK reads them, a panel is the lower half of a block above its coupling. */
static int mhe_factorise(mhe_workspace *k, int count)
{
    const int n = NX, width = WIDTH;
    const real one = 1, minus = -1;
    for (int i = 0; i <= count; i++) {
        real *panel = k->panels + i * NX * WIDTH, *inverse = k->inverse_pivots + i * NX;
        int info = 0;
        mhe_lapack.dpotrf("L", &n, panel, &width, &info);
        if (info) return 0;
        for (int r = 0; r < NX; r++) {
            const real pivot = panel[r * WIDTH + r];
            if (!(pivot > 0) || !isfinite(pivot)) return 0; /* some LAPACKs let NaN through */
            inverse[r] = 1 / pivot;
        }
        if (i == count) break;
        mhe_lapack.dtrsm("R", "L", "T", "N", &n, &n, &one, panel, &width, panel + NX, &width);
        mhe_lapack.dsyrk("L", "N", &n, &n, &minus, panel + NX, &width, &one,
                         panel + NX * WIDTH, &width);
    }
    return 1;
}
