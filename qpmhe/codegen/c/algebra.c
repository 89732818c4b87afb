/* Small dense algebra. Matrices are stored by rows. */

#define EPSILON (sizeof(real) == 8 ? (real)2.220446049250313e-16 : (real)1.1920929e-7)

static real mhe_dot(int n, const real *a, const real *b)
{
    real sum = 0;
    for (int i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

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

/* What follows is for features that an estimator may not have. */
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#endif

/* Whether all are finite, of numbers whose squares may overflow. */
static int mhe_each_finite(int n, const real *a)
{
    int others = 0; /* in no order, unlike a sum */
    for (int i = 0; i < n; i++) others |= !(0 * a[i] == 0);
    return !others;
}

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

/* out = A B' for A (m, k) and B (n, k). */
static void mhe_multiply_transposed(int m, int k, int n, const real *A, const real *B, real *out)
{
    for (int i = 0; i < m; i++)
        for (int j = 0; j < n; j++) out[i * n + j] = mhe_dot(k, A + i * k, B + j * k);
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

/* Whether all eigenvalues of a symmetric matrix are above low and below high. */
static int mhe_eigenvalues_within(int n, const real *M, real low, real high, real *scratch)
{
    for (int i = 0; i < n * n; i++) scratch[i] = M[i];
    for (int i = 0; i < n; i++) scratch[i * n + i] -= low;
    if (!mhe_decompose(n, scratch)) return 0;
    if (!isfinite(high)) return 1;
    for (int i = 0; i < n * n; i++) scratch[i] = -M[i];
    for (int i = 0; i < n; i++) scratch[i * n + i] += high;
    return mhe_decompose(n, scratch);
}

/* Sweeps of rotations: they converge quadratically, so that this many never are needed. */
#define MHE_SWEEPS 30

/* Eigenvalues on the diagonal of a symmetric M, which is overwritten, and eigenvectors in the rows
 * of V, by cyclic Jacobi rotations. */
static void mhe_eigen(int n, real *M, real *V)
{
    for (int i = 0; i < n * n; i++) V[i] = 0;
    for (int i = 0; i < n; i++) V[i * n + i] = 1;
    for (int sweep = 0; sweep < MHE_SWEEPS; sweep++) {
        int rotations = 0;
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++) {
                const real apart = M[q * n + q] - M[p * n + p], off = M[p * n + q];
                const real size = fabs(M[p * n + p]) + fabs(M[q * n + q]);
                if (!(fabs(off) > (real)0.1 * EPSILON * size)) continue;
                rotations++;
                const real ratio = apart / (2 * off);
                const real tangent =
                    (ratio < 0 ? -1 : 1) / (fabs(ratio) + sqrt(1 + ratio * ratio));
                const real cosine = 1 / sqrt(1 + tangent * tangent), sine = tangent * cosine;
                for (int j = 0; j < n; j++) {
                    const real a = M[p * n + j], b = M[q * n + j];
                    M[p * n + j] = cosine * a - sine * b;
                    M[q * n + j] = sine * a + cosine * b;
                }
                for (int j = 0; j < n; j++) {
                    const real a = M[j * n + p], b = M[j * n + q];
                    M[j * n + p] = cosine * a - sine * b;
                    M[j * n + q] = sine * a + cosine * b;
                }
                for (int j = 0; j < n; j++) {
                    const real a = V[p * n + j], b = V[q * n + j];
                    V[p * n + j] = cosine * a - sine * b;
                    V[q * n + j] = sine * a + cosine * b;
                }
                M[p * n + q] = M[q * n + p] = 0;
            }
        if (!rotations) return;
    }
}

/* A lower triangular S with S S' = M, positive semidefinite, by columns: row j of `out` is column
 * j of S. Pivots of the size of rounding give columns of zeros. */
static void mhe_root(int n, const real *M, real *out)
{
    for (int strict = 1; strict >= 0; strict--) {
        int failed = 0;
        for (int i = 0; i < n * n; i++) out[i] = 0;
        for (int j = 0; j < n && !failed; j++) {
            real *column = out + j * n;
            for (int i = j; i < n; i++) {
                real sum = M[j * n + i];
                for (int k = 0; k < j; k++) sum -= out[k * n + j] * out[k * n + i];
                column[i] = sum;
            }
            const real pivot = column[j];
            const real least = strict ? 0 : (real)n * EPSILON * M[j * n + j];
            if (strict) failed = !(pivot > 0);
            const real scale = pivot > least ? 1 / sqrt(pivot) : isnan(pivot) ? pivot : 0;
            for (int i = j; i < n; i++) column[i] *= scale;
        }
        if (!failed) return;
    }
}

/* later = (M^-1 + W)^-1 = S (I + S' W S)^-1 S' for an information M = S S' and a covariance W:
 * nothing is subtracted. The matrices between are scratch. */
static void mhe_through_disturbance(int n, const real *M, const real *W, real *root, real *moved,
                                    real *inner, real *later)
{
    mhe_root(n, M, root);
    mhe_multiply(n, n, n, root, W, moved);
    mhe_multiply_transposed(n, n, n, moved, root, inner);
    for (int j = 0; j < n; j++) inner[j * n + j] += 1;
    memcpy(moved, root, sizeof(real) * (size_t)(n * n));
    if (mhe_decompose(n, inner))
        mhe_solve_for(n, inner, n, moved);
    else
        moved[0] = NAN;
    for (int j = 0; j < n * n; j++) later[j] = 0;
    mhe_add_product(n, n, n, root, moved, later);
}

#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif
