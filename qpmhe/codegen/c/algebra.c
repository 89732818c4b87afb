/* Small dense algebra. Matrices are stored by rows. */

#define EPSILON (sizeof(real) == 8 ? (real)2.220446049250313e-16 : (real)1.1920929e-7)

static real mhe_dot(int n, const real *a, const real *b)
{
    real sum = 0;
    for (int i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

/* The larger one; b where a is NaN. Unlike fmax, it is no call. */
static real mhe_max(real a, real b) { return a > b ? a : b; }

static real mhe_min(real a, real b) { return a < b ? a : b; }

static int mhe_all_finite(int n, const real *a)
{
    return isfinite(mhe_dot(n, a, a));
}

/* out = M a for a square M, stored by rows. */
static void mhe_times(int n, const real *M, const real *a, real *out)
{
    for (int i = 0; i < n; i++) out[i] = mhe_dot(n, M + i * n, a);
}

static real mhe_form(int n, const real *M, const real *a)
{
    real sum = 0;
    for (int i = 0; i < n; i++) sum += a[i] * mhe_dot(n, M + i * n, a);
    return sum;
}

#if MHE_LAPACK
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
#endif

/* What follows is for features that an estimator may not have. */
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#endif

/* out = A B for A (m, k) and B (k, n). */
static void mhe_multiply(int m, int k, int n, const real *A, const real *B, real *out)
{
    for (int i = 0; i < m; i++) {
        real *row = out + i * n;
        for (int j = 0; j < n; j++) row[j] = 0;
        for (int l = 0; l < k; l++) {
            const real a = A[i * k + l], *other = B + l * n;
            for (int j = 0; j < n; j++) row[j] += a * other[j];
        }
    }
}

/* out += A' B for A (k, m) and B (k, n). */
static void mhe_add_product(int k, int m, int n, const real *A, const real *B, real *out)
{
    for (int l = 0; l < k; l++)
        for (int i = 0; i < m; i++) {
            const real a = A[l * m + i], *other = B + l * n;
            real *row = out + i * n;
            for (int j = 0; j < n; j++) row[j] += a * other[j];
        }
}

/* Both halves become their mean, and the matrix exactly symmetric. */
static void mhe_symmetrise(int n, real *M)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < i; j++)
            M[i * n + j] = M[j * n + i] = (real)0.5 * (M[i * n + j] + M[j * n + i]);
}

/* Overwrite a symmetric matrix by the rows of D L', with M = L D L'; whether it is positive
 * definite. No result depends on the units of its components. */
static int mhe_decompose(int n, real *M)
{
    for (int j = 0; j < n; j++) {
        const real *row = M + j * n, pivot = row[j];
        if (!(pivot > 0) || !isfinite(pivot)) return 0;
        for (int r = j + 1; r < n; r++) {
            const real factor = row[r] / pivot;
            real *below = M + r * n;
            for (int c = r; c < n; c++) below[c] -= factor * row[c];
        }
    }
    return 1;
}

/* B := M^-1 B for B (n, k), with M from `mhe_decompose`. */
static void mhe_solve_for(int n, const real *M, int k, real *B)
{
    for (int j = 0; j < n; j++) {
        const real *row = M + j * n, *from = B + j * k;
        for (int r = j + 1; r < n; r++) {
            const real factor = row[r] / row[j];
            real *to = B + r * k;
            for (int c = 0; c < k; c++) to[c] -= factor * from[c];
        }
    }
    for (int j = n - 1; j >= 0; j--) {
        const real *row = M + j * n;
        real *to = B + j * k;
        for (int r = j + 1; r < n; r++) {
            const real *from = B + r * k;
            for (int c = 0; c < k; c++) to[c] -= row[r] * from[c];
        }
        for (int c = 0; c < k; c++) to[c] /= row[j];
    }
}

/* out = M^-1, exactly symmetric; whether M is positive definite. M is overwritten. */
static int mhe_invert(int n, real *M, real *out)
{
    if (!mhe_decompose(n, M)) return 0;
    for (int i = 0; i < n * n; i++) out[i] = 0;
    for (int i = 0; i < n; i++) out[i * n + i] = 1;
    mhe_solve_for(n, M, n, out);
    mhe_symmetrise(n, out);
    return 1;
}

#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif
