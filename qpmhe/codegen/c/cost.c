/* The cost of the true problem, and the quadratic form by which a QP sees it: weights, values, terms. */

/* The weight of the components that are there: the inverse of their block of the noise
 * covariance is the Schur complement of the others in the weight. */
static void mhe_set_noise_weight(const mhe_settings *s, mhe_stage *stage)
{
    real *R = stage->noise_weight;
    memcpy(R, stage->has_own_noise ? stage->own_noise_weight : s->noise_weight,
           sizeof stage->noise_weight);
    stage->is_complete = 1;
    for (int m = 0; m < NY; m++) {
        if (stage->is_observed[m]) continue;
        stage->is_complete = 0;
        stage->y[m] = 0; /* any number: its weight is zero */
        const real pivot = R[m * NY + m];
        for (int i = 0; i < NY; i++) {
            if (i == m) continue;
            const real share = R[i * NY + m] / pivot;
            for (int j = 0; j < NY; j++)
                if (j != m) R[i * NY + j] -= share * R[m * NY + j];
        }
        for (int i = 0; i < NY; i++) {
            R[i * NY + m] = 0;
            R[m * NY + i] = 0;
        }
    }
}

/* The weight of w at a stage. */
static const real *mhe_disturbance_weight(const mhe_settings *s, const mhe_stage *stage)
{
    return stage->has_own_disturbance ? stage->own_disturbance_weight : s->disturbance_weight;
}

/* l(w, v) of a stage; without a workspace that of the losses themselves. */
static real mhe_stage_cost(const mhe_settings *s, const mhe_workspace *k, const mhe_stage *stage,
                           const real *w, const real *v)
{
    (void)k;
    return mhe_lost(&s->disturbance_loss, mhe_w_widening(k), NX, mhe_disturbance_weight(s, stage),
                    w) +
           mhe_lost(&s->noise_loss, mhe_v_widening(k), NY, stage->noise_weight, v);
}

#if MHE_LAPACK
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
#else
#define mhe_dense_terms(Q, w, t) 0
#endif

/* hessian = A' Q A + C' R C (upper half), coupling = -A' Q, which elimination.c does not need;
 * own = -(A' Q w + C' R v), following = Q w; A and C are in place. Q and R are of the form that touches the cost. */
static void mhe_set_terms(const mhe_settings *s, const mhe_workspace *work,
                          const mhe_stage *stage, const real *w, const real *v, mhe_terms *t)
{
    (void)work;
    const real *A = t->f_jacobian, *C = t->h_jacobian;
    const real *Q = mhe_disturbance_weight(s, stage), *R = stage->noise_weight;
    mhe_scale_weights(s, work, stage, Q, w, v, t);
    mhe_times(NX, Q, w, t->following);
    for (int i = 0; i < NX; i++)
        t->following[i] = mhe_scaled(t->following[i], t->disturbance_scale, i);
#if MHE_ROLLED
    for (int j = 0; j < NX; j++) t->own[j] = 0;
    for (int k = 0; k < NX; k++)
        for (int j = 0; j < NX; j++) t->own[j] -= t->following[k] * A[k * NX + j];
    for (int k = 0; k < NY; k++) {
        const real force = mhe_scaled(mhe_dot(NY, R + k * NY, v), t->noise_scale, k);
        for (int j = 0; j < NX; j++) t->own[j] -= force * C[k * NX + j];
    }
#else
    real *H = t->hessian, *QA = t->coupling;
    if (MHE_LOSS || !mhe_dense_terms(Q, w, t)) {
        for (int i = 0; i < NX * NX; i++) H[i] = QA[i] = 0;
        for (int i = 0; i < NX; i++)
            for (int k = 0; k < NX; k++) {
                const real q = mhe_scaled(Q[i * NX + k], t->disturbance_scale, i);
                if (q == 0) continue; /* weights are diagonal more often than not */
                for (int j = 0; j < NX; j++) QA[i * NX + j] += q * A[k * NX + j];
            }
        for (int k = 0; k < NX; k++)
            for (int i = 0; i < NX; i++) {
                const real a = A[k * NX + i];
                if (a == 0) continue;
                for (int j = i & ~3; j < NX; j++) H[i * NX + j] += a * QA[k * NX + j];
            }
        for (int j = 0; j < NX; j++) t->own[j] = 0;
        for (int k = 0; k < NX; k++)
            for (int j = 0; j < NX; j++) t->own[j] -= w[k] * QA[k * NX + j];
        for (int i = 0; i < NX; i++)
            for (int k = 0; k <= i; k++) {
                const real other = QA[k * NX + i];
                QA[k * NX + i] = -QA[i * NX + k];
                QA[i * NX + k] = -other;
            }
    }
    for (int k = 0; k < NY; k++) {
        real RC[NX]; /* row k of it */
        for (int j = 0; j < NX; j++) RC[j] = 0;
        for (int l = 0; l < NY; l++) {
            const real r = mhe_scaled(R[k * NY + l], t->noise_scale, k);
            if (r == 0) continue;
            for (int j = 0; j < NX; j++) RC[j] += r * C[l * NX + j];
        }
        for (int i = 0; i < NX; i++) {
            const real c = C[k * NX + i];
            if (c == 0) continue;
            for (int j = i & ~3; j < NX; j++) H[i * NX + j] += c * RC[j];
        }
        for (int j = 0; j < NX; j++) t->own[j] -= v[k] * RC[j];
    }
#endif
}
