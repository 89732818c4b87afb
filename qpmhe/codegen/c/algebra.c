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
