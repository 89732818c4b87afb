/* The metric in which an observer without a covariance is projected: its own, or one that settles. */

/* E^(2^k) of a stable matrix has vanished by then, unless its spectral radius is 1 within 1e-12. */
#define DOUBLINGS 40

/* Whether a power of E halves every vector: all eigenvalues are within the unit circle. */
static int mhe_is_stable(int n, const real *E)
{
    real power[NX * NX], square[NX * NX];
    memcpy(power, E, sizeof(real) * (size_t)(n * n));
    for (int i = 0; i < DOUBLINGS; i++) {
        real size = 0;
        for (int r = 0; r < n; r++) {
            real sum = 0;
            for (int c = 0; c < n; c++) sum += fabs(power[r * n + c]);
            if (!isfinite(sum)) return 0;
            size = mhe_max(sum, size);
        }
        if (size <= (real)0.5) return 1;
        mhe_multiply(n, n, n, power, power, square);
        memcpy(power, square, sizeof(real) * (size_t)(n * n));
    }
    return 0;
}

/* M := the sum over k of E'^k M E^k, by doubling: 2^j terms after j products. E is overwritten. */
static void mhe_lyapunov(int n, real *E, real *M)
{
    real left[NX * NX], added[NX * NX];
    const int size = n * n;
    for (int i = 0; i < DOUBLINGS; i++) {
        real change = 0, most = 0;
        mhe_multiply(n, n, n, M, E, left);
        memset(added, 0, sizeof added);
        mhe_add_product(n, n, n, E, left, added);
        for (int j = 0; j < size; j++) {
            M[j] += added[j];
            change = mhe_max(fabs(added[j]), change);
            most = mhe_max(fabs(M[j]), most);
        }
        mhe_multiply(n, n, n, E, E, left);
        memcpy(E, left, sizeof(real) * (size_t)size);
        if (!(change > EPSILON * most)) break;
    }
    mhe_symmetrise(n, M);
}

/* Take the Lyapunov matrix of the error E = A - K C at a stage for the metric, M = E'ME + Gamma, if E
 * is stable. Parameters that the observer does not correct are left out of E, and keep their
 * block of Gamma. `covariance` gets the inverse; whether it did. */
static int mhe_settle(const mhe_settings *s, const real *K, const mhe_terms *t, real *covariance)
{
    const real *A = t->f_jacobian, *C = t->h_jacobian;
    real E[NX * NX], M[NX * NX], metric[NX * NX], scale[NX];
    int moving[NX], count = NX;
    if (!mhe_all_finite(NX * NX, A) || !mhe_all_finite(NY * NX, C) || !mhe_all_finite(NX * NY, K))
        return 0;
    for (int j = 0; j < NX; j++) moving[j] = j, scale[j] = sqrt(s->metric_weight[j * (NX + 1)]);
    for (int stage = 0; stage < 2; stage++) {
        for (int r = 0; r < count; r++)
            for (int c = 0; c < count; c++) {
                const int i = moving[r], j = moving[c];
                real sum = A[i * NX + j];
                for (int q = 0; q < NY; q++) sum -= K[i * NY + q] * C[q * NX + j];
                E[r * count + c] = scale[i] * sum / scale[j];
            }
        if (mhe_is_stable(count, E)) break;
        if (stage) return 0;
        count = 0;
        for (int i = 0; i < NX; i++) {
            int moves = 0;
            for (int q = 0; q < NY; q++) moves |= K[i * NY + q] != 0;
            for (int j = 0; j < NX; j++) moves |= A[i * NX + j] != (i == j);
            if (moves) moving[count++] = i;
        }
        if (count == 0 || count >= NX) return 0;
    }
    for (int r = 0; r < count; r++)
        for (int c = 0; c < count; c++)
            M[r * count + c] = s->metric_weight[moving[r] * NX + moving[c]] /
                               (scale[moving[r]] * scale[moving[c]]);
    mhe_lyapunov(count, E, M);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++)
            metric[i * NX + j] = s->metric_weight[i * NX + j] / (scale[i] * scale[j]);
    for (int r = 0, i = 0; i < NX; i++) {
        const int own = r < count && moving[r] == i;
        for (int c = 0, j = 0; j < NX; j++) {
            const int other = c < count && moving[c] == j;
            if (own && other) metric[i * NX + j] = M[r * count + c];
            else if (own != other) metric[i * NX + j] = 0;
            c += other;
        }
        r += own;
    }
    if (!mhe_invert(NX, metric, M)) return 0;
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) M[i * NX + j] /= scale[i] * scale[j];
    if (!mhe_all_finite(NX * NX, M)) return 0;
    memcpy(covariance, M, sizeof M);
    return 1;
}

/* The metric behind stage i. */
static void mhe_metric_behind(const mhe_estimator *e, int i, mhe_metric *m)
{
    (void)i;
    mhe_take_metric(e, e->metric, 0, m);
}

/* Whether the metric needs the slope of the observer's error. */
static int mhe_needs_slope(const mhe_estimator *e)
{
    return e->settings->project && !e->metric_settled;
}

/* Settle the metric by the Jacobians of a stage, unless it has. */
static void mhe_settle_metric(mhe_estimator *e, const mhe_stage *stage)
{
    real slope[NX * NY];
    if (e->metric_settled) return;
    mhe_correction_slope(e->settings, stage, slope);
    e->metric_settled = mhe_settle(e->settings, slope, &stage->terms, e->metric);
}

/* The observer's own estimate of x(t) that has used y(t), which has no metric. */
static void mhe_filter_inside(mhe_estimator *e, const mhe_stage *stage, real *out)
{
    mhe_filter(e->settings, stage, out, 0);
    mhe_enter_turn(e->settings, out);
}
