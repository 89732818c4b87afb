/* The window: samples, the observer along them, and what is computed once on each. */

#define EPSILON (sizeof(real) == 8 ? (real)2.220446049250313e-16 : (real)1.1920929e-7)

static real mhe_dot(int n, const real *a, const real *b)
{
    real sum = 0;
    for (int i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

/* The larger one; b where a is NaN. Unlike fmax, it is no call. */
static real mhe_max(real a, real b) { return a > b ? a : b; }

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

static mhe_stage *mhe_stage_at(mhe_estimator *e, int i)
{
    const int k = e->first + i;
    return e->stages + (k < MHE_HORIZON ? k : k - MHE_HORIZON);
}

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

/* hessian = A' Q A + C' R C (upper half), coupling = -A' Q, own = -(A' Q w + C' R v),
 * following = Q w; A and C are in place. */
static void mhe_set_terms(const mhe_settings *s, const real *R, const real *w, const real *v,
                          mhe_terms *t)
{
    const real *A = t->f_jacobian, *C = t->h_jacobian, *Q = s->disturbance_weight;
    real RC[NY * NX], QA[NX * NX];
    mhe_times(NX, Q, w, t->following);
    for (int i = 0; i < NX * NX; i++) t->hessian[i] = QA[i] = 0;
    for (int i = 0; i < NX; i++)
        for (int k = 0; k < NX; k++) {
            const real q = Q[i * NX + k];
            if (q == 0) continue; /* weights are diagonal more often than not */
            for (int j = 0; j < NX; j++) QA[i * NX + j] += q * A[k * NX + j];
        }
    for (int i = 0; i < NX; i++)
        for (int k = 0; k < NX; k++) t->coupling[i * NX + k] = -QA[k * NX + i];
    for (int k = 0; k < NX; k++)
        for (int i = 0; i < NX; i++) {
            const real a = A[k * NX + i];
            if (a == 0) continue;
            for (int j = i & ~3; j < NX; j++) t->hessian[i * NX + j] += a * QA[k * NX + j];
        }
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NX; j++) {
            real sum = 0;
            for (int k = 0; k < NY; k++) sum += R[i * NY + k] * C[k * NX + j];
            RC[i * NX + j] = sum;
        }
    for (int k = 0; k < NY; k++)
        for (int i = 0; i < NX; i++) {
            const real c = C[k * NX + i];
            if (c == 0) continue;
            for (int j = i & ~3; j < NX; j++) t->hessian[i * NX + j] += c * RC[k * NX + j];
        }
    for (int j = 0; j < NX; j++) t->own[j] = 0;
    for (int k = 0; k < NX; k++)
        for (int j = 0; j < NX; j++) t->own[j] -= w[k] * QA[k * NX + j];
    for (int k = 0; k < NY; k++)
        for (int j = 0; j < NX; j++) t->own[j] -= v[k] * RC[k * NX + j];
}

/* Evaluate the stage at its z and step the observer to `next`; the cost, or infinity. */
static real mhe_advance(const mhe_settings *s, mhe_stage *stage, int linear, real *next)
{
    real *v = stage->v, *w = stage->w, predicted[NX], output[NY];
    if (linear) {
        mhe_f_jacobian(stage->z, stage->u, stage->step, predicted, stage->terms.f_jacobian);
        mhe_h_jacobian(stage->z, stage->u, output, stage->terms.h_jacobian);
    } else {
        mhe_f(stage->z, stage->u, stage->step, predicted);
        mhe_h(stage->z, stage->u, output);
    }
    for (int j = 0; j < NY; j++) v[j] = stage->is_observed[j] ? stage->y[j] - output[j] : 0;
    for (int j = 0; j < NX; j++) {
        w[j] = mhe_dot(NY, s->gain + j * NY, v);
        next[j] = predicted[j] + w[j];
    }
    if (!mhe_all_finite(NX, next)) return INFINITY;
    const real cost =
        mhe_form(NX, s->disturbance_weight, w) + mhe_form(NY, stage->noise_weight, v);
    return isfinite(cost) ? cost : INFINITY;
}

/* Compute stage i of the window from z(i) and its sample; 0, MODEL_FAILED where the model has
 * no finite values (held) or only no finite Jacobians. */
static int mhe_enter(mhe_estimator *e, int i)
{
    const mhe_settings *s = e->settings;
    mhe_stage *stage = mhe_stage_at(e, i);
    mhe_terms *t = &stage->terms;
    const int linear = s->max_qps > 0;
    real *next = i + 1 < e->length ? mhe_stage_at(e, i + 1)->z : e->z_end;
    stage->cost = mhe_advance(s, stage, linear, next);
    const int held = !isfinite(stage->cost);
    if (held) {
        /* z(i) is where the model does not work: go on where it last did. */
        int good = i - 1;
        while (good >= 0 && !isfinite(mhe_stage_at(e, good)->cost)) good--;
        memcpy(next, good >= 0 ? mhe_stage_at(e, good)->z : e->last_good,
               sizeof e->last_good);
        memset(stage->w, 0, sizeof stage->w);
        memset(stage->v, 0, sizeof stage->v);
    }
    if (!linear) return held ? MHE_MODEL_FAILED : 0;
    const int finite = mhe_all_finite(NX * NX, t->f_jacobian) &&
                       mhe_all_finite(NY * NX, t->h_jacobian);
    if (held || !finite) {
        memset(t->f_jacobian, 0, sizeof t->f_jacobian);
        memset(t->h_jacobian, 0, sizeof t->h_jacobian);
        for (int j = 0; j < NX; j++) t->f_jacobian[j * NX + j] = 1;
    }
    mhe_set_terms(s, stage->noise_weight, stage->w, stage->v, t);
    return held || !finite ? MHE_MODEL_FAILED : 0;
}

/* Redo all stages from i on. */
static int mhe_replay(mhe_estimator *e, int i)
{
    int outcome = 0;
    for (; i < e->length; i++) outcome = mhe_enter(e, i);
    return outcome;
}

/* Take a sample in; MHE_MODEL_FAILED where the model could not be evaluated. */
static int mhe_push(mhe_estimator *e, const real *y, const real *u, real step,
                    const real *noise_weight)
{
    const mhe_settings *s = e->settings;
    if (e->length == MHE_HORIZON) {
        const mhe_stage *leaving = mhe_stage_at(e, 0);
        if (isfinite(leaving->cost)) memcpy(e->last_good, leaving->z, sizeof e->last_good);
        e->first = e->first + 1 < MHE_HORIZON ? e->first + 1 : 0;
    } else {
        e->length++;
    }
    mhe_stage *stage = mhe_stage_at(e, e->length - 1);
    memcpy(stage->z, e->z_end, sizeof stage->z);
    for (int j = 0; j < NU; j++) stage->u[j] = u[j];
    stage->step = step > 0 ? step : s->sample_time;
    stage->is_irregular = step > 0;
    stage->has_own_noise = noise_weight != 0;
    if (noise_weight) memcpy(stage->own_noise_weight, noise_weight, sizeof stage->noise_weight);
    for (int j = 0; j < NY; j++) {
        stage->y[j] = y[j];
        stage->is_observed[j] = y[j] < MHE_LARGEST && y[j] > -MHE_LARGEST; /* false for NaN */
    }
    mhe_set_noise_weight(s, stage);
    const int outcome = mhe_enter(e, e->length - 1);
    e->time++;
    return outcome;
}

#define CONSTRAINED (MHE_W_SET || MHE_V_SET)

#if CONSTRAINED
#define ROWS MHE_STAGE_ROWS
#define W_COUNT (MHE_W_SET * (NX + MHE_W_ROWS))
#define V_COUNT (MHE_V_SET * (NY + MHE_V_ROWS))

/* How far a point q is from each side of a set: low <= 0 <= high where it is inside. */
static void mhe_distances(int n, int count, const real *q, const real *lower, const real *upper,
                          const real *rows, const real *row_lower, const real *row_upper,
                          const uint8_t *known, real *low, real *high)
{
    for (int j = 0; j < n; j++) {
        const int there = !known || known[j];
        low[j] = there ? lower[j] - q[j] : -INFINITY;
        high[j] = there ? upper[j] - q[j] : INFINITY;
    }
    for (int i = 0; i < count; i++) {
        const real value = mhe_dot(n, rows + i * n, q);
        int there = 1;
        for (int j = 0; j < n; j++)
            if (known && !known[j] && rows[i * n + j] != 0) there = 0;
        low[n + i] = there ? row_lower[i] - value : -INFINITY;
        high[n + i] = there ? row_upper[i] - value : INFINITY;
    }
}

#define DISTANCES(set, n, count, q, known, low, high) \
    mhe_distances(n, count, q, (set).lower, (set).upper, (set).rows, (set).row_lower, \
                  (set).row_upper, known, low, high)

/* The same for all rows of stage i, about residuals w and v of a trajectory. */
static void mhe_stage_distances(mhe_estimator *e, int i, const real *w, const real *v, real *low,
                                real *high)
{
#if MHE_W_SET
    DISTANCES(e->settings->disturbances, NX, MHE_W_ROWS, w + i * NX, 0, low, high);
#endif
#if MHE_V_SET
    const mhe_stage *stage = mhe_stage_at(e, i);
    DISTANCES(e->settings->noises, NY, MHE_V_ROWS, v + i * NY,
              stage->is_complete ? 0 : stage->is_observed, low + W_COUNT, high + W_COUNT);
#endif
    (void)w; (void)v;
}

/* The largest miss among rows of one set, in their scales. `sizes`: of the numbers whose
 * differences the rows are of, for rounding. `missed` gets the sides that are. */
static real mhe_missed(int n, int count, const real *low, const real *high, const real *rows,
                       const real *scale, const real *row_scale, const real *sizes,
                       const uint8_t *left_out, uint8_t *missed)
{
    real worst = 0;
    for (int r = 0; r < n + count; r++) {
        const int side = low[r] > 0 ? MHE_LOWER : high[r] < 0 ? MHE_UPPER : 0;
        if (isnan(low[r]) || isnan(high[r])) return INFINITY;
        if (!side || (left_out && left_out[r] & side)) continue;
        real size = 0;
        if (r < n)
            size = fabs(sizes[r]);
        else
            for (int j = 0; j < n; j++) size += fabs(rows[(r - n) * n + j] * sizes[j]);
        const real miss = (side == MHE_LOWER ? low[r] : -high[r]) - 8 * EPSILON * size;
        const real share = miss / (r < n ? scale[r] : row_scale[r - n]);
        if (isnan(share)) return INFINITY;
        worst = mhe_max(share, worst);
        if (missed && share > MHE_FEASIBLE) missed[r] = (uint8_t)side;
    }
    return worst;
}

#define MISSED(set, n, count, low, high, sizes, left_out, missed) \
    mhe_missed(n, count, low, high, (set).rows, (set).scale, (set).row_scale, sizes, left_out, \
               missed)

/* The largest miss of a trial in the rows' scales, without the sides that are left out. */
static real mhe_violation(mhe_estimator *e, const mhe_trial *trial, const uint8_t *left_out,
                          uint8_t *missed)
{
    real worst = 0, low[ROWS], high[ROWS];
    for (int i = 0; i < e->length; i++) {
        const uint8_t *out = left_out ? left_out + i * ROWS : 0;
        uint8_t *in = missed ? missed + i * ROWS : 0;
        mhe_stage_distances(e, i, trial->w, trial->v, low, high);
#if MHE_W_SET
        worst = mhe_max(worst, MISSED(e->settings->disturbances, NX, MHE_W_ROWS, low, high,
                                      trial->x + (i + 1) * NX, out, in));
#endif
#if MHE_V_SET
        worst = mhe_max(worst, MISSED(e->settings->noises, NY, MHE_V_ROWS, low + W_COUNT,
                                      high + W_COUNT, mhe_stage_at(e, i)->y,
                                      out ? out + W_COUNT : 0, in ? in + W_COUNT : 0));
#endif
    }
    return worst;
}
#endif

/* Judge the trajectory of a trial by the true model: infinite cost where the model is not
 * finite or a row is missed. */
static void mhe_evaluate(mhe_estimator *e, const mhe_workspace *k, mhe_trial *trial)
{
    const mhe_settings *s = e->settings;
    const real *prior = mhe_stage_at(e, 0)->z, *factors = k->factors;
    real offset[NX], cost = 0;
    for (int i = 0; i < e->length; i++) {
        const mhe_stage *stage = mhe_stage_at(e, i);
        const real *x = trial->x + i * NX;
        real *w = trial->w + i * NX, *v = trial->v + i * NY, predicted[NX], output[NY];
        mhe_f(x, stage->u, stage->step, predicted);
        mhe_h(x, stage->u, output);
        for (int j = 0; j < NX; j++) w[j] = x[NX + j] - predicted[j];
        /* A model that fails in a missing output fails, as it does everywhere. */
        for (int j = 0; j < NY; j++) v[j] = stage->y[j] - output[j];
        cost += factors[i + 1] * (mhe_form(NX, s->disturbance_weight, w) +
                                  mhe_form(NY, stage->noise_weight, v));
    }
    for (int j = 0; j < NX; j++) offset[j] = trial->x[j] - prior[j];
    cost += factors[0] * mhe_form(NX, s->prior_weight, offset);
    trial->cost = cost;
    trial->violation = 0;
    if (!isfinite(cost)) {
        trial->cost = trial->violation = INFINITY;
        return;
    }
#if CONSTRAINED
    trial->violation = mhe_violation(e, trial, k->left_out, 0);
    if (trial->violation > MHE_FEASIBLE) trial->cost = INFINITY;
#endif
}

/* What rounding of the residuals of a trial can contribute to its cost. */
static real mhe_rounding_cost(mhe_estimator *e, const mhe_workspace *k, const mhe_trial *trial)
{
    real cost = 0;
    for (int i = 0; i < e->length; i++) {
        const mhe_stage *stage = mhe_stage_at(e, i);
        const real *Q = e->settings->disturbance_weight, *R = stage->noise_weight;
        const real *x = trial->x + (i + 1) * NX, *y = stage->y;
        real sum = 0;
        for (int j = 0; j < NX; j++)
            for (int l = 0; l < NX; l++) sum += fabs(x[j] * Q[j * NX + l] * x[l]);
        for (int j = 0; j < NY; j++)
            for (int l = 0; l < NY; l++) sum += fabs(y[j] * R[j * NY + l] * y[l]);
        cost += k->factors[i + 1] * sum;
    }
    return 64 * EPSILON * EPSILON * cost;
}
