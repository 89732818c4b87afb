/* A record under a hypothesis: the extended Kalman filter of qpmhe/diagnosis/bank.py, which is
 * linearised behind its measurement update for the step, in units of the usual noise. */

/* A hypothesis: the record as it has it, and the filter's numbers. */
typedef struct {
    const real *start, *prior, *disturbance, *noise; /* R in units: one, or one of each sample */
    const real *y, *u;                               /* by samples; behind u, the step's length */
    const unsigned char *there;                      /* which outputs are not missing */
    const real *unit, *low, *high, *periods;
    const int64_t *repeats;                          /* steps behind each sample */
    int64_t changes, doubts;                         /* whether R does, and single measurements */
    real scale;                                      /* of each step, where it is no input */
    real far, width, extreme, inlying;               /* of outliers: see the bank */
} mhe_hypothesis;

/* Where results go, by samples. */
typedef struct {
    real *states, *corrected, *innovations, *spreads, *weights, *covariances, *transitions;
    real *outputs, *gains;
} mhe_filtered;

/* out += (I + scale (A - I)) B, by the nonzeros of A: each row is summed up in registers. */
static void mhe_add_moved(const real *A, real scale, const real *restrict B, real *restrict out)
{
    for (int i = 0; i < NX; i++) {
        real row[NX];
        for (int j = 0; j < NX; j++) row[j] = out[i * NX + j];
        for (int j = 0; scale != 1 && j < NX; j++) row[j] += (1 - scale) * B[i * NX + j];
        for (int k = mhe_A_first[i]; k < mhe_A_first[i + 1]; k++) {
            const int a = mhe_A_order[k];
            const real factor = scale * A[a], *from = B + mhe_A_column[a] * NX;
            for (int j = 0; j < NX; j++) row[j] += factor * from[j];
        }
        for (int j = 0; j < NX; j++) out[i * NX + j] = row[j];
    }
}

/* P = A P A' + Q, with A as above; P is symmetric. */
static void mhe_move_covariance(const real *A, real scale, const real *Q, real *P)
{
    real half[NX * NX] = {0}, turned[NX * NX];
    mhe_add_moved(A, scale, P, half);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) turned[j * NX + i] = half[i * NX + j];
    memcpy(P, Q, sizeof half);
    mhe_add_moved(A, scale, turned, P);
}

/* P = (I - K C) P (I - K C)' + K R K', with C P in `seen` and K by columns. */
static void mhe_correct_covariance(const real *C, const real *restrict seen,
                                   const real *restrict K, const real *noise, real *restrict P)
{
    real weighed[NY * NX]; /* K R - (I - K C) P C', by columns */
    for (int j = 0; j < NX; j++) {
        real row[NX];
        for (int l = 0; l < NX; l++) row[l] = P[j * NX + l];
        for (int i = 0; i < NY; i++)
            for (int l = 0; l < NX; l++) row[l] -= seen[i * NX + j] * K[i * NX + l];
        for (int l = 0; l < NX; l++) P[j * NX + l] = row[l];
    }
    for (int i = 0; i < NY; i++) {
        real row[NX] = {0};
        for (int l = 0; l < NY; l++)
            for (int j = 0; j < NX; j++) row[j] += noise[i * NY + l] * K[l * NX + j];
        for (int j = 0; j < NX; j++) weighed[i * NX + j] = row[j];
    }
    for (int a = 0; a < MHE_C_NONZEROS; a++) {
        const int i = mhe_C_row[a], l = mhe_C_column[a];
        for (int j = 0; j < NX; j++)
            weighed[i * NX + j] -= C[i * NX + l] * P[l * NX + j];
    }
    for (int j = 0; j < NX; j++) {
        real row[NX];
        for (int l = 0; l < NX; l++) row[l] = P[j * NX + l];
        for (int i = 0; i < NY; i++)
            for (int l = 0; l < NX; l++) row[l] += K[i * NX + j] * weighed[i * NX + l];
        for (int l = 0; l < NX; l++) P[j * NX + l] = row[l];
    }
    mhe_symmetrise(NX, P);
}

/* Correct x and P by a sample, and add to its log likelihood; 0 where that fails. */
static int mhe_hypothesis_update(const mhe_hypothesis *r, int t, real *x, real *P, real *log_,
                                 int64_t *left_out, const mhe_filtered *out)
{
    const unsigned char *there = r->there + (size_t)t * NY;
    const real *noise = r->noise + (r->changes ? (size_t)t * NY * NY : 0);
    const real *y = r->y + (size_t)t * NY;
    real expected[NY], nonzeros[SIZE(MHE_C_NONZEROS)], C[NY * NX] = {0}, seen[NY * NX] = {0};
    real e[NY], S[NY * NY] = {0}, solved[NY], K[NY * NX]; /* K by columns */
    unsigned char kept[NY];
    mhe_call_output(x, r->u + (size_t)t * (NU + 1), expected, nonzeros);
    for (int a = 0; a < MHE_C_NONZEROS; a++)
        C[mhe_C_row[a] * NX + mhe_C_column[a]] = nonzeros[a] / r->unit[mhe_C_row[a]];
    for (int i = 0; i < NY; i++) {
        e[i] = y[i] - expected[i];
        if (r->periods[i] > 0)
            e[i] -= floor(e[i] / r->periods[i] + (real)0.5) * r->periods[i];
        e[i] /= r->unit[i];
        kept[i] = there[i];
    }
    for (int a = 0; a < MHE_C_NONZEROS; a++) { /* C P */
        const int i = mhe_C_row[a], l = mhe_C_column[a];
        for (int j = 0; j < NX; j++) seen[i * NX + j] += C[i * NX + l] * P[l * NX + j];
    }
    for (int a = 0; a < MHE_C_NONZEROS; a++) { /* C P C' */
        const int j = mhe_C_row[a], l = mhe_C_column[a];
        for (int i = 0; i < NY; i++) S[i * NY + j] += seen[i * NX + l] * C[j * NX + l];
    }
    real log_likelihood = 0;
    for (int i = 0; r->doubts && i < NY; i++) {
        const real own = S[i * NY + i] + noise[i * NY + i], square = e[i] * e[i];
        if (!there[i]) continue;
        if (square > r->far * r->far * own) {
            kept[i] = 0;
            left_out[i]++;
            log_likelihood +=
                r->extreme - log1p(square / own / (r->width * r->width)) - (real)0.5 * log(own);
        } else
            log_likelihood += r->inlying;
    }
    for (int i = 0; i < NY; i++) {
        for (int j = 0; j < NY; j++)
            S[i * NY + j] = kept[i] && kept[j] ? S[i * NY + j] + noise[i * NY + j] : (real)(i == j);
        if (!kept[i]) e[i] = 0;
        for (int j = 0; j < NX; j++) {
            if (!kept[i]) C[i * NX + j] = seen[i * NX + j] = 0;
            K[i * NX + j] = seen[i * NX + j];
        }
        solved[i] = e[i];
    }
    if (!mhe_all_finite(NX, x) || !mhe_all_finite(NY, e) || !mhe_each_finite(NY * NY, S) ||
        !mhe_each_finite(NY * NX, C))
        return 0;
    if (out) {
        memcpy(out->states + (size_t)t * NX, x, sizeof(real) * NX);
        memcpy(out->outputs + (size_t)t * NY * NX, C, sizeof C);
        memcpy(out->spreads + (size_t)t * NY * NY, S, sizeof S);
        for (int i = 0; i < NY; i++)
            out->innovations[(size_t)t * NY + i] = kept[i] ? e[i] : NAN;
        real copy[NY * NY];
        memcpy(copy, S, sizeof S);
        if (!mhe_invert(NY, copy, out->weights + (size_t)t * NY * NY)) return 0;
    }
    if (!mhe_decompose(NY, S)) return 0;
    mhe_solve_for(NY, S, NX, K);
    mhe_solve_for(NY, S, 1, solved);
    real cost = 0;
    for (int i = 0; i < NY; i++) {
        cost += (real)0.5 * (e[i] * solved[i] + log(S[i * NY + i]));
        for (int j = 0; j < NX; j++) x[j] += K[i * NX + j] * e[i];
    }
    *log_ = log_likelihood - cost;
    for (int j = 0; j < NX; j++)
        x[j] = x[j] < r->low[j] ? r->low[j] : x[j] > r->high[j] ? r->high[j] : x[j];
    mhe_correct_covariance(C, seen, K, noise, P);
    if (out) {
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NY; j++)
                out->gains[((size_t)t * NX + i) * NY + j] = K[j * NX + i];
        memcpy(out->corrected + (size_t)t * NX, x, sizeof(real) * NX);
        memcpy(out->covariances + (size_t)t * NX * NX, P, sizeof(real) * NX * NX);
    }
    return 1;
}

/* Take x and P on by the steps behind a sample. */
static void mhe_hypothesis_move(const mhe_hypothesis *r, int t, real *x, real *P,
                                const mhe_filtered *out)
{
    real all[NX * NX], moved[NX * NX], next[NX], A[SIZE(MHE_A_NONZEROS)];
    for (int i = 0; i < NX * NX; i++) all[i] = (real)(i % (NX + 1) == 0);
    for (int64_t step = 0; step < r->repeats[t]; step++) {
        const real scale = step == 0 ? r->scale : 1;
        mhe_call_step(x, r->u + (size_t)t * (NU + 1), next, A);
        for (int j = 0; scale != 1 && j < NX; j++) next[j] = x[j] + scale * (next[j] - x[j]);
        memcpy(x, next, sizeof next);
        mhe_move_covariance(A, scale, r->disturbance, P);
        if (out) {
            for (int i = 0; i < NX * NX; i++) moved[i] = 0;
            mhe_add_moved(A, scale, all, moved);
            memcpy(all, moved, sizeof all);
        }
    }
    if (out) memcpy(out->transitions + (size_t)t * NX * NX, all, sizeof all);
}

/* Log likelihoods of all samples, how many measurements of each output were left out, and the rest
 * where out is not 0. The number of samples before which the filter failed. */
int64_t mhe_filter_hypothesis(const mhe_hypothesis *r, int64_t samples, real *logs,
                              int64_t *left_out, const mhe_filtered *out)
{
    real x[NX], P[NX * NX];
    memcpy(x, r->start, sizeof x);
    memcpy(P, r->prior, sizeof P);
    for (int i = 0; i < NY; i++) left_out[i] = 0;
    for (int64_t t = 0; t < samples; t++) {
        if (!mhe_hypothesis_update(r, (int)t, x, P, logs + t, left_out, out)) return t;
        mhe_hypothesis_move(r, (int)t, x, P, out);
    }
    return samples;
}
