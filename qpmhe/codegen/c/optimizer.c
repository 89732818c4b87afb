/* The sequence of QPs; only what the true cost approves is accepted. */

static const real mhe_lengths[] = MHE_LENGTHS;

typedef struct {
    mhe_trial *reference, *best, *spare; /* best may be the reference */
    int events, qps, iterations, corrections, dropped, sets;
} mhe_outcome;

static real mhe_target(const mhe_trial *best)
{
    return isfinite(best->cost) ? best->cost - MHE_ROUNDING * best->cost : INFINITY;
}

/* Judge best + length * step. */
static void mhe_try(mhe_estimator *e, mhe_workspace *k, const mhe_outcome *o, real length)
{
    for (int j = 0; j < (e->length + 1) * NX; j++)
        o->spare->x[j] = o->best->x[j] + length * k->step[j];
    mhe_evaluate(e, k->factors, o->sets, o->spare);
}

/* The spare trial becomes the best one. */
static void mhe_take(mhe_workspace *k, mhe_outcome *o)
{
    mhe_trial *free = o->best;
    if (free == o->reference)
        for (int i = 0; i < 3; i++)
            if (k->trials + i != o->reference && k->trials + i != o->spare) free = k->trials + i;
    o->best = o->spare;
    o->spare = free;
}

/* Terms along the best trajectory; whether the model has finite Jacobians there. */
static int mhe_linearize(mhe_estimator *e, mhe_workspace *k, const mhe_outcome *o, int candidate)
{
    for (int i = 0; i < e->length; i++) {
        mhe_stage *stage = mhe_stage_at(e, i);
        mhe_terms *t = k->terms + i;
        real next[NX], output[NY];
        k->at[i] = candidate ? &stage->terms : t;
        if (candidate) continue;
        mhe_f_jacobian(o->best->x + i * NX, stage->u, stage->step, next, t->f_jacobian);
        mhe_h_jacobian(o->best->x + i * NX, stage->u, output, t->h_jacobian);
        if (!mhe_all_finite(NX * NX, t->f_jacobian) || !mhe_all_finite(NY * NX, t->h_jacobian))
            return 0;
        mhe_set_terms(e->settings, stage->noise_weight, o->best->w + i * NX,
                      o->best->v + i * NY, t);
    }
    return 1;
}

/* Solve the QP around the best trajectory; the increments are in k->step. */
static int mhe_solve_qp(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, const real *offset,
                        int nearest)
{
    const int size = (e->length + 1) * NX;
    mhe_build(e, k, offset, nearest);
    for (int j = 0; j < size; j++) k->step[j] = -k->gradient[j];
    if (!mhe_factorise(k, e->length) || !mhe_solve(k, e->length, k->step)) return FAILED;
#if CONSTRAINED
    if (mhe_row_violation(e, k, k->step) > 0) {
        const int limit = e->settings->max_iterations;
        int iterations = 0;
        if (limit == 0) return UNCONSTRAINED;
        const real promise = fabs(mhe_dot(size, k->gradient, k->step));
        const int status =
            mhe_interior_point(e, k, offset, nearest, promise, limit, &iterations);
        o->iterations += iterations;
        return status;
    }
#else
    (void)o;
#endif
    return SOLVED;
}

#if CONSTRAINED
/* Shift the limits by what the linearisation missed at the spare trial, and a little beyond:
 * a second-order correction. */
static void mhe_bend(mhe_estimator *e, mhe_workspace *k, const mhe_outcome *o)
{
    const int count = e->length;
    real *w = k->bent.w, *v = k->bent.v, *d = k->product;
    for (int j = 0; j < (count + 1) * NX; j++) d[j] = o->spare->x[j] - o->best->x[j];
    const real missed = 2 * mhe_row_violation(e, k, d);
    for (int i = 0; i < count; i++) {
        const mhe_terms *t = k->at[i];
        for (int j = 0; j < NX; j++) {
            const int at = i * NX + j;
            const real linear = o->best->w[at] + d[at + NX] -
                                mhe_dot(NX, t->f_jacobian + j * NX, d + i * NX);
            w[at] = o->best->w[at] + (o->spare->w[at] - linear);
        }
        for (int j = 0; j < NY; j++) {
            const int at = i * NY + j;
            const real linear =
                o->best->v[at] - mhe_dot(NX, t->h_jacobian + j * NX, d + i * NX);
            v[at] = o->best->v[at] + (o->spare->v[at] - linear);
        }
    }
    mhe_set_limits(e, k, o->sets, w, v);
    for (int i = 0; i < count; i++) {
        mhe_row *rows = k->rows + i * ROWS;
        for (int r = 0; r < ROWS; r++) rows[r].load = missed;
#if MHE_W_SET
        real disturbance[NX];
        for (int j = 0; j < NX; j++) disturbance[j] = w[i * NX + j] - o->best->w[i * NX + j];
        mhe_values_of(NX, MHE_W_ROWS, disturbance, e->settings->disturbances.rows, rows);
        for (int r = 0; r < W_COUNT; r++) rows[r].load += MHE_BEYOND * fabs(rows[r].value);
#endif
#if MHE_V_SET
        mhe_row *own = rows + W_COUNT;
        real noise[NY];
        for (int j = 0; j < NY; j++) noise[j] = v[i * NY + j] - o->best->v[i * NY + j];
        mhe_values_of(NY, MHE_V_ROWS, noise, e->settings->noises.rows, own);
        for (int r = 0; r < V_COUNT; r++) own[r].load += MHE_BEYOND * fabs(own[r].value);
#endif
        for (int r = 0; r < ROWS; r++)
            if (rows[r].high - rows[r].low > 4 * rows[r].load) {
                rows[r].low += rows[r].load;
                rows[r].high -= rows[r].load;
            }
    }
}

/* The nearest trajectory that satisfies the linearised sets; whether it does the true ones. */
static int mhe_project(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, const real *offset)
{
    mhe_linearize(e, k, o, 1);
    mhe_set_limits(e, k, o->sets, o->best->w, o->best->v);
    for (int attempt = 0;; attempt++) {
        if (mhe_solve_qp(e, k, o, offset, 1) == FAILED) return 0;
        mhe_try(e, k, o, 1);
        if (isfinite(o->spare->cost)) return 1;
        if (!isfinite(o->spare->violation) || attempt == MHE_CORRECTIONS) return 0;
        mhe_bend(e, k, o);
        o->corrections++;
    }
}
#endif

/* Solve one QP and judge its iterate; whether another QP is worth while. */
static int mhe_improve_once(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int candidate)
{
    const mhe_settings *s = e->settings;
    const real *prior = mhe_stage_at(e, 0)->z;
    real offset[NX];
    if (!mhe_linearize(e, k, o, candidate)) {
        o->events |= MHE_MODEL_FAILED;
        return 0;
    }
    for (int j = 0; j < NX; j++) offset[j] = o->best->x[j] - prior[j];
#if CONSTRAINED
    mhe_set_limits(e, k, o->sets, o->best->w, o->best->v);
#endif
    const int status = mhe_solve_qp(e, k, o, offset, 0);
    o->qps++;
    if (status == FAILED) {
        o->events |= MHE_SOLVER_FAILED;
        return 0;
    }
    const int solved = status == SOLVED;
    const real before = o->best->cost, target = mhe_target(o->best);
    real enough = s->tolerance * (before + s->tolerance);
    if (!isfinite(enough)) enough = -1; /* nothing converges to what cannot be judged */
    if (!solved) o->events |= MHE_SOLVER_STOPPED;
    const real promised = fabs(mhe_dot((e->length + 1) * NX, k->gradient, k->step));
    mhe_try(e, k, o, 1);
#if CONSTRAINED
    if (!(o->spare->cost < target) && o->spare->violation > 0 &&
        isfinite(o->spare->violation)) {
        int bend = 1;
        if (o->spare->violation <= MHE_NEARLY) {
            mhe_try(e, k, o, mhe_lengths[0]);
            bend = !(o->spare->cost < target);
            if (bend) mhe_try(e, k, o, 1);
        }
        if (bend && !(solved && promised <= enough)) {
            memcpy(k->bent.x, k->step, sizeof k->step);
            for (int i = 0; i < MHE_CORRECTIONS; i++) {
                mhe_bend(e, k, o);
                const int failed = mhe_solve_qp(e, k, o, offset, 0) == FAILED;
                o->corrections++;
                if (failed) break;
                mhe_try(e, k, o, 1);
                if (isfinite(o->spare->cost) || !isfinite(o->spare->violation)) break;
            }
            memcpy(k->step, k->bent.x, sizeof k->step);
        }
    }
#endif
    if (!(o->spare->cost < target)) {
        const int count = (int)(sizeof mhe_lengths / sizeof *mhe_lengths);
        int i = 0;
        /* Near a minimum the cost cannot be lowered beyond its rounding: not a failure. */
        if (solved && promised <= enough) {
            o->events |= MHE_CONVERGED;
            return 0;
        }
        for (; i < count; i++) {
            mhe_try(e, k, o, mhe_lengths[i]);
            if (o->spare->cost < target) break;
        }
        if (i == count) {
            const int stalled = solved && promised <= MHE_STALLED * enough;
            o->events |= stalled ? MHE_CONVERGED : MHE_NO_DECREASE;
            return 0;
        }
    }
    mhe_take(k, o);
    o->events |= MHE_IMPROVED;
    if (solved && before - o->best->cost <= enough) {
        o->events |= MHE_CONVERGED;
        return 0;
    }
    return 1;
}

/* The candidate as a trial: its cost is known already. */
static void mhe_set_candidate(mhe_estimator *e, mhe_workspace *k, mhe_trial *trial)
{
    const int count = e->length;
    trial->cost = 0;
    trial->violation = 0;
    for (int i = 0; i < count; i++) {
        const mhe_stage *stage = mhe_stage_at(e, i);
        memcpy(trial->x + i * NX, stage->z, sizeof stage->z);
        memcpy(trial->w + i * NX, stage->w, sizeof stage->w);
        memcpy(trial->v + i * NY, stage->v, sizeof stage->v);
        trial->cost += k->factors[i + 1] * stage->cost;
    }
    /* No cost is NaN, but 0 times infinity is where a discount underflows. */
    if (isnan(trial->cost)) trial->cost = INFINITY;
    memcpy(trial->x + count * NX, e->z_end, sizeof e->z_end);
}

/* The previous estimate, moved on by one step of the model; whether it is worth a start. */
static int mhe_shift(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before)
{
    const int count = e->length, skipped = before + 2 - (count + 1);
    mhe_stage *last = mhe_stage_at(e, count - 1);
    real *x = o->spare->x;
    memcpy(x, e->trajectory + skipped * NX, sizeof(real) * (size_t)count * NX);
    mhe_f(x + (count - 1) * NX, last->u, last->step, x + count * NX);
    mhe_evaluate(e, k->factors, o->sets, o->spare);
    return o->spare->cost < mhe_target(o->best);
}

/* Solve the window's problem as it stands. `before`: stages of the window that the kept
 * trajectory belongs to, -1 if there is none to start at. */
static void mhe_improve(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before)
{
    const mhe_settings *s = e->settings;
    real factor = 1;
    for (int i = e->length; i > 0; i--) {
        k->factors[i] = factor;
        factor *= s->discount;
    }
    k->factors[0] = factor;
    o->reference = o->best = k->trials;
    o->spare = k->trials + 1;
    o->events = o->qps = o->iterations = o->corrections = o->dropped = 0;
    o->sets = ALL_SETS;
    mhe_set_candidate(e, k, o->reference);
    int candidate = 1;
#if CONSTRAINED
    int violated;
    mhe_violation(e, o->best, ALL_SETS, &violated);
    if (violated && s->outside == MHE_KEEP) {
        o->events |= MHE_CANDIDATE | MHE_CANDIDATE_OUTSIDE;
        return;
    }
    if (violated) {
        const real offset[NX] = {0};
        if (s->outside == MHE_PROJECT && s->max_qps > 0 && mhe_project(e, k, o, offset)) {
            o->reference = o->best = o->spare;
            o->spare = k->trials + 2;
            o->events |= MHE_CANDIDATE_OUTSIDE;
            candidate = 0;
        } else {
            o->sets &= ~violated;
            o->dropped = violated;
            o->events |= MHE_ROWS_DROPPED;
        }
    }
#endif
    if (s->max_qps == 0) {
        o->events |= MHE_CANDIDATE | MHE_NO_QPS;
        return;
    }
    if (before >= 0 && mhe_shift(e, k, o, before)) {
        mhe_take(k, o);
        o->events |= MHE_IMPROVED;
        candidate = 0;
    }
    while (o->qps < s->max_qps && mhe_improve_once(e, k, o, candidate)) candidate = 0;
    if (!(o->events & MHE_IMPROVED)) o->events |= MHE_CANDIDATE;
}
