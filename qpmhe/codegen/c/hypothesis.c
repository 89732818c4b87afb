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

/* out = A P A' + Q. */
static void mhe_moved_covariance(const real *A, const real *P, const real *Q, real *out)
{
    real half[NX * NX], turned[NX * NX];
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) turned[j * NX + i] = A[i * NX + j];
    mhe_multiply(NX, NX, NX, A, P, half);
    mhe_multiply(NX, NX, NX, half, turned, out);
    for (int i = 0; i < NX * NX; i++) out[i] += Q[i];
}

/* Correct x and P by a sample, and add to its log likelihood; 0 where that fails. */
static int mhe_hypothesis_update(const mhe_hypothesis *r, int t, real *x, real *P, real *log_,
                                 int64_t *left_out, const mhe_filtered *out)
{
    const unsigned char *there = r->there + (size_t)t * NY;
    const real *noise = r->noise + (r->changes ? (size_t)t * NY * NY : 0);
    const real *y = r->y + (size_t)t * NY;
    real expected[NY], nonzeros[SIZE(MHE_C_NONZEROS)], C[NY * NX] = {0}, seen[NY * NX] = {0};
    real e[NY], S[NY * NY] = {0}, gain[NY * (NX + 1)], closed[NX * NX], weighed[NY * NX];
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
            gain[i * (NX + 1) + j] = seen[i * NX + j];
        }
        gain[i * (NX + 1) + NX] = e[i];
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
    mhe_solve_for(NY, S, NX + 1, gain);
    real cost = 0, *K = weighed; /* by columns */
    for (int i = 0; i < NY; i++) {
        cost += (real)0.5 * (e[i] * gain[i * (NX + 1) + NX] + log(S[i * NY + i]));
        for (int j = 0; j < NX; j++) {
            K[i * NX + j] = gain[i * (NX + 1) + j];
            x[j] += K[i * NX + j] * e[i];
        }
    }
    *log_ = log_likelihood - cost;
    for (int j = 0; j < NX; j++)
        x[j] = x[j] < r->low[j] ? r->low[j] : x[j] > r->high[j] ? r->high[j] : x[j];
    real used[NY * NX], KR[NY * NX], turned[NX * NY], none[NX * NX], later[NX * NX];
    memcpy(used, K, sizeof used);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NY; j++) turned[i * NY + j] = used[j * NX + i];
    mhe_multiply(NX, NY, NX, turned, C, closed);
    for (int i = 0; i < NX * NX; i++) closed[i] = (real)(i % (NX + 1) == 0) - closed[i];
    mhe_multiply(NY, NY, NX, noise, used, KR);
    mhe_multiply(NX, NY, NX, turned, KR, none);
    mhe_moved_covariance(closed, P, none, later);
    memcpy(P, later, sizeof later);
    if (out) {
        memcpy(out->gains + (size_t)t * NX * NY, turned, sizeof turned);
        memcpy(out->corrected + (size_t)t * NX, x, sizeof(real) * NX);
        memcpy(out->covariances + (size_t)t * NX * NX, P, sizeof later);
    }
    return 1;
}

/* Take x and P on by the steps behind a sample. */
static void mhe_hypothesis_move(const mhe_hypothesis *r, int t, real *x, real *P,
                                const mhe_filtered *out)
{
    real A[NX * NX], all[NX * NX], next[NX], nonzeros[SIZE(MHE_A_NONZEROS)], later[NX * NX];
    for (int i = 0; i < NX * NX; i++) all[i] = (real)(i % (NX + 1) == 0);
    for (int64_t step = 0; step < r->repeats[t]; step++) {
        mhe_call_step(x, r->u + (size_t)t * (NU + 1), next, nonzeros);
        for (int i = 0; i < NX * NX; i++) A[i] = 0;
        for (int a = 0; a < MHE_A_NONZEROS; a++)
            A[mhe_A_row[a] * NX + mhe_A_column[a]] = nonzeros[a];
        if (step == 0 && r->scale != 1) {
            for (int j = 0; j < NX; j++) next[j] = x[j] + r->scale * (next[j] - x[j]);
            for (int i = 0; i < NX * NX; i++) {
                const real one = (real)(i % (NX + 1) == 0);
                A[i] = one + r->scale * (A[i] - one);
            }
        }
        memcpy(x, next, sizeof next);
        mhe_moved_covariance(A, P, r->disturbance, later);
        memcpy(P, later, sizeof later);
        if (out) {
            mhe_multiply(NX, NX, NX, A, all, later);
            memcpy(all, later, sizeof later);
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
