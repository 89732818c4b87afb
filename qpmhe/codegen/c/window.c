/* The window: samples, the observer along them, and what is computed once on each. */

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

enum { DISTURBANCES = 1, NOISES = 2, ALL_SETS = 3 };

#define CONSTRAINED (MHE_W_SET || MHE_V_SET)

#if CONSTRAINED
/* The largest amount by which s leaves a set, less the rounding of a box's component. */
static real mhe_missed(int n, int count, const real *point, const real *lower,
                       const real *upper, const real *rows, const real *row_lower,
                       const real *row_upper, const uint8_t *known, real rounding)
{
    real worst = 0;
    for (int j = 0; j < n; j++) {
        if (known && !known[j]) continue;
        const real low = lower[j] - point[j] - rounding, high = point[j] - upper[j] - rounding;
        if (!(low <= worst)) worst = low;
        if (isnan(worst)) return INFINITY;
        if (!(high <= worst)) worst = high;
        if (isnan(worst)) return INFINITY;
    }
    for (int i = 0; i < count; i++) {
        int touched = 0;
        real value = 0;
        for (int j = 0; j < n; j++) {
            value += rows[i * n + j] * point[j];
            touched |= known && !known[j] && rows[i * n + j] != 0;
        }
        if (touched) continue;
        const real low = row_lower[i] - value - rounding, high = value - row_upper[i] - rounding;
        if (!(low <= worst)) worst = low;
        if (isnan(worst)) return INFINITY;
        if (!(high <= worst)) worst = high;
        if (isnan(worst)) return INFINITY;
    }
    return worst;
}

#define MISSED(set, n, count, point, known, rounding) \
    mhe_missed(n, count, point, (set).lower, (set).upper, (set).rows, (set).row_lower, \
               (set).row_upper, known, rounding)

/* How far a trial is outside of the sets of the mask; `violated` names those that it leaves. */
static real mhe_violation(mhe_estimator *e, const mhe_trial *trial, int sets, int *violated)
{
    const mhe_settings *s = e->settings;
    real worst[2] = {0, 0};
    for (int i = 0; i < e->length; i++) {
#if MHE_W_SET
        if (sets & DISTURBANCES) {
            real rounding = 0;
            for (int j = 0; j < NX; j++) rounding = fmax(rounding, fabs(trial->x[(i + 1) * NX + j]));
            /* Of a candidate L is known itself, not as a difference of states. */
            rounding *= violated ? 0 : 8 * EPSILON;
            worst[0] = fmax(worst[0], MISSED(s->disturbances, NX, MHE_W_ROWS,
                                             trial->w + i * NX, 0, rounding));
        }
#endif
#if MHE_V_SET
        if (sets & NOISES) {
            const mhe_stage *stage = mhe_stage_at(e, i);
            worst[1] = fmax(worst[1],
                            MISSED(s->noises, NY, MHE_V_ROWS, trial->v + i * NY,
                                   stage->is_complete ? 0 : stage->is_observed, 0));
        }
#endif
    }
    if (violated) {
        *violated = 0;
        for (int i = 0; i < 2; i++)
            if (worst[i] > MHE_FEASIBLE) *violated |= 1 << i;
    }
    return fmax(worst[0], worst[1]);
}
#endif

/* Judge the trajectory of a trial by the true model: infinite cost where the model is not
 * finite or a set of the mask is missed. */
static void mhe_evaluate(mhe_estimator *e, const real *factors, int sets, mhe_trial *trial)
{
    const mhe_settings *s = e->settings;
    const real *prior = mhe_stage_at(e, 0)->z;
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
    trial->violation = mhe_violation(e, trial, sets, 0);
    if (trial->violation > MHE_FEASIBLE) trial->cost = INFINITY;
#else
    (void)sets;
#endif
}
