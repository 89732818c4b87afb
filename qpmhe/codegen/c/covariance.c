/* The covariance of the observer's error: for all observers that have one. */

/* No observer needs all of it. */
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#endif

/* The outputs of a stage that are there, with their fitting errors and noise covariance. */
typedef struct {
    int count, at[NY];
    real v[NY], noise[NY * NY];
} mhe_seen;

/* The covariance of a sample's own weight. One that only rounding makes other than the usual one
 * is the usual one. NaN where the weight has no inverse. */
static void mhe_covariance_of(int n, const real *weight, const real *usual, real *scratch,
                              real *out)
{
    int near = 1;
    for (int i = 0; i < n * n; i++) scratch[i] = weight[i];
    if (!mhe_invert(n, scratch, out)) {
        for (int i = 0; i < n * n; i++) out[i] = NAN;
        return;
    }
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            const real size = sqrt(usual[i * n + i]) * sqrt(usual[j * n + j]);
            const real change = fabs(out[i * n + j] - usual[i * n + j]);
            if (!(change <= MHE_SAME_COVARIANCE * size)) near = 0;
        }
    if (near) memcpy(out, usual, sizeof(real) * (size_t)(n * n));
}

static void mhe_see(const mhe_settings *s, const mhe_stage *stage, mhe_seen *seen)
{
    const real *noise = s->covariances.noise;
    real own[NY * NY], scratch[NY * NY];
    if (stage->has_own_noise) {
        mhe_covariance_of(NY, stage->own_noise_weight, noise, scratch, own);
        noise = own;
    }
    seen->count = 0;
    for (int i = 0; i < NY; i++)
        if (stage->is_observed[i]) seen->at[seen->count++] = i;
    for (int i = 0; i < seen->count; i++) {
        seen->v[i] = stage->v[seen->at[i]];
        for (int j = 0; j < seen->count; j++)
            seen->noise[i * seen->count + j] = noise[seen->at[i] * NY + seen->at[j]];
    }
}

/* Add K R K' to a covariance; the rows of `gain` are the columns of K. */
static void mhe_add_noise(const mhe_seen *seen, const real *gain, real *P)
{
    real weighted[NY * NX];
    mhe_multiply(seen->count, seen->count, NX, seen->noise, gain, weighted);
    mhe_add_product(seen->count, NX, NX, gain, weighted, P);
}

/* Q: the usual one, or a sample's own in `own`. */
static const real *mhe_disturbance_of(const mhe_settings *s, const mhe_stage *stage, real *own)
{
    real scratch[NX * NX];
    if (stage->has_own_disturbance) {
        mhe_covariance_of(NX, stage->own_disturbance_weight, s->covariances.disturbance, scratch,
                          own);
        mhe_keep_directions(s, own);
        return own;
    }
    return s->covariances.disturbance;
}

/* Add Q to a covariance. */
static void mhe_add_disturbance(const mhe_settings *s, const mhe_stage *stage, real *P)
{
    real own[NX * NX];
    const real *Q = mhe_disturbance_of(s, stage, own);
    for (int i = 0; i < NX * NX; i++) P[i] += Q[i];
    mhe_symmetrise(NX, P);
}

/* out = K v */
static void mhe_gained(const mhe_seen *seen, const real *gain, real *out)
{
    for (int j = 0; j < NX; j++) out[j] = 0;
    for (int i = 0; i < seen->count; i++)
        for (int j = 0; j < NX; j++) out[j] += gain[i * NX + j] * seen->v[i];
}

/* Joseph's form of (A - K C) P (A - K C)' + K R K', with the outputs' rows of C; A is the identity
 * where there is none. */
static void mhe_propagate(const real *P, const mhe_seen *seen, const real *A, const real *C,
                          const real *gain, real *following)
{
    real closed[NX * NX], product[NX * NX];
    for (int j = 0; j < NX; j++)
        for (int l = 0; l < NX; l++) {
            real sum = A ? A[j * NX + l] : j == l;
            for (int i = 0; i < seen->count; i++) sum -= gain[i * NX + j] * C[i * NX + l];
            closed[j * NX + l] = sum;
        }
    mhe_multiply(NX, NX, NX, closed, P, product);
    mhe_multiply_transposed(NX, NX, NX, product, closed, following);
    mhe_add_noise(seen, gain, following);
}

/* The rows of C of the outputs that are there. */
static void mhe_rows_of(const mhe_seen *seen, const real *C, real *rows)
{
    for (int i = 0; i < seen->count; i++)
        memcpy(rows + i * NX, C + seen->at[i] * NX, sizeof(real) * NX);
}

/* The least variance of a component given those before it, as a share of its variance; negative for
 * what is no covariance: not finite or, beyond rounding, not positive semidefinite. */
static real mhe_least_pivot(const real *P)
{
    const real least = sizeof(real) == 8 ? (real)1e-9 : (real)1e-4;
    real deviation[NX], root[NX * NX], found = INFINITY;
    if (!mhe_each_finite(NX * NX, P)) return -1;
    for (int j = 0; j < NX; j++) {
        const real variance = P[j * NX + j];
        if (!(variance >= 0)) return -1;
        deviation[j] = variance > 0 ? sqrt(variance) : 1;
    }
    for (int j = 0; j < NX; j++)
        for (int i = j; i < NX; i++) {
            real sum = i == j ? 1 + least : P[j * NX + i] / deviation[i] / deviation[j];
            for (int k = 0; k < j; k++) sum -= root[k * NX + j] * root[k * NX + i];
            if (i == j) {
                if (!(sum > 0)) return -1;
                if (sum < found) found = sum;
                root[j * NX + j] = sqrt(sum);
            } else
                root[j * NX + i] = sum / root[j * NX + j];
        }
    return found;
}

#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif
