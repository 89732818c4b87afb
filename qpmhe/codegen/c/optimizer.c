/* The sequence of QPs; only what the true cost approves is accepted. */

static const real mhe_lengths[] = MHE_LENGTHS;
#if CONSTRAINED
static const real mhe_along[] = MHE_ALONG;
#endif

typedef struct {
    mhe_trial *candidate, *best, *spare, *other; /* best may be the candidate */
    int outside; /* the candidate misses rows: as a trial, it has no finite cost */
    int events, qps, iterations, corrections, nearest_points, rows_dropped;
    int unsolved;   /* the last QPs that were not solved to the tolerance */
    int followed;   /* the next step starts from a surrogate's minimiser */
    real damping;   /* with which a search for a shorter step begins, at least */
    real present, growth; /* that of the present QP, and what it is multiplied with next */
    int has_seen;   /* its scale is known */
    int factorised; /* the QP's matrix, with its active rows, is in the panels */
} mhe_outcome;

/* Other reasons for the end of a sequence than its cap, and what no longer holds in another one. */
#define ENDS (MHE_CONVERGED | MHE_NO_DECREASE | MHE_SOLVER_FAILED | MHE_MODEL_FAILED | MHE_TIME_UP)
#define OUTDATED (MHE_CONVERGED | MHE_NO_DECREASE | MHE_SOLVER_FAILED | MHE_CAP_REACHED)

/* Whether no time is left; it is an event then. */
static int mhe_is_late(const mhe_workspace *k, mhe_outcome *o)
{
    if (!mhe_time_is_up(k)) return 0;
    o->events |= MHE_TIME_UP;
    return 1;
}

/* Cost of the best trajectory as a trial. */
static real mhe_best_cost(const mhe_outcome *o)
{
    return o->outside && o->best == o->candidate ? INFINITY : o->best->cost;
}

/* The cost below which a trial is better than the best one. */
static real mhe_target(const mhe_outcome *o)
{
    const real cost = mhe_best_cost(o);
    return isfinite(cost) ? cost - MHE_ROUNDING * fabs(cost) : INFINITY;
}

/* Clip a trial to the bounds of X, in the turns of its angles. */
static void mhe_clip_trial(mhe_estimator *e, const mhe_workspace *k, mhe_trial *trial)
{
#if MHE_X_SET
    for (int i = 0; i <= e->length; i++) {
        const mhe_x_set *set = mhe_x_set_at(e->settings, mhe_stage_of_state(e, i));
        const uint8_t *out = k->left_out + i * ROWS + W_COUNT + V_COUNT;
        real *x = trial->x + i * NX;
        mhe_enter_turn(e->settings, x);
        for (int j = 0; j < NX; j++) {
            if (x[j] < set->lower[j] && !(out[j] & MHE_LOWER)) x[j] = set->lower[j];
            if (x[j] > set->upper[j] && !(out[j] & MHE_UPPER)) x[j] = set->upper[j];
        }
    }
#endif
    (void)e; (void)k; (void)trial;
}

/* Make a trial, and judge it: another one + length * step. */
static void mhe_step_from(mhe_estimator *e, mhe_workspace *k, const mhe_trial *around, real length,
                          mhe_trial *trial)
{
    for (int j = 0; j < (e->length + 1) * NX; j++)
        trial->x[j] = around->x[j] + length * k->step[j];
    mhe_clip_trial(e, k, trial);
    mhe_evaluate(e, k, trial);
}

/* Make the spare trial best + length * step. */
static void mhe_try(mhe_estimator *e, mhe_workspace *k, const mhe_outcome *o, real length)
{
    mhe_step_from(e, k, o->best, length, o->spare);
}

/* The spare trial becomes the best one. */
static void mhe_take(mhe_workspace *k, mhe_outcome *o)
{
    mhe_trial *free = o->best;
    if (free == o->candidate)
        for (int i = 0; i < 4; i++) {
            mhe_trial *one = k->trials + i;
            if (one != o->candidate && one != o->spare && one != o->other) free = one;
        }
    o->best = o->spare;
    o->spare = free;
}

/* Terms and limits of the QP around a trial, where the candidate's terms are known; whether the
 * model has finite Jacobians there. */
static int mhe_linearize(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o,
                         const mhe_trial *around)
{
    for (int i = 0; i < e->length; i++) {
        mhe_stage *stage = mhe_stage_at(e, i);
        mhe_terms *t = k->terms + i;
        real next[NX], output[NY];
        k->at[i] = around == o->candidate ? &stage->terms : t;
        if (around == o->candidate) continue;
        o->events |= mhe_linear(e->settings, around->x + i * NX, stage, next, output, t);
        if (!mhe_all_finite(NX * NX, t->f_jacobian) || !mhe_all_finite(NY * NX, t->h_jacobian))
            return 0;
        mhe_set_terms(e->settings, k, stage, around->w + i * NX, around->v + i * NY, t);
    }
#if CONSTRAINED
    mhe_set_limits(e, k, around->x, around->w, around->v);
#endif
    return 1;
}

/* Solve the QP around a trial, with its Hessian as it is or with a ridge. */
static int mhe_solve_as_is(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o,
                           const mhe_trial *around, int nearest, int again)
{
    const real *prior = k->prior.mean;
    real offset[NX];
    k->prior.first = around->x;
#if MHE_ROLLED
    k->around = around;
#endif
    for (int j = 0; j < NX; j++) offset[j] = around->x[j] - prior[j];
    mhe_wrap_state(e->settings, around->x, offset);
#if CONSTRAINED
    const int limit = e->settings->max_iterations;
    int guesses = 0, iterations = 0;
    int status = mhe_active_set(e, k, offset, nearest, limit, again && o->factorised, &guesses);
    o->factorised = status == SOLVED;
    if (status == STOPPED) {
        if (!mhe_solve_free(e, k, offset, nearest)) return FAILED;
        if (guesses < limit && !mhe_time_is_up(k))
            status = mhe_interior_point(e, k, offset, nearest, limit - guesses, &iterations);
        if (status == SOLVED && guesses + iterations < limit) {
            /* Its active set gives the solution up to rounding. */
            const int left = limit - guesses - iterations;
            int more = 0;
            memcpy(k->residual, k->step, sizeof k->step);
            o->factorised = mhe_active_set(e, k, offset, nearest, left, 0, &more) == SOLVED;
            if (!o->factorised) memcpy(k->step, k->residual, sizeof k->step);
            guesses += more;
        }
    }
    if (status != SOLVED) memset(k->rows.place, 0, sizeof k->rows.place);
    o->iterations += guesses + iterations;
    return status == EXCLUDED ? STOPPED : status;
#else
    (void)o; (void)again;
    return mhe_solve_free(e, k, offset, nearest) ? SOLVED : FAILED;
#endif
}

/* Solve the QP around a trial; the increments are in k->step. With `again`, only limits have changed
 * since the last one. Weights that a loss takes from outliers may leave a Hessian that is singular up
 * to rounding: it gets a ridge then. */
static int mhe_solve_qp(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o,
                        const mhe_trial *around, int nearest, int again)
{
    k->damping = nearest ? 0 : o->present;
#if MHE_ROLLED
    return mhe_solve_as_is(e, k, o, around, nearest, again);
#else
    k->has_ridge = 0;
    const int status = mhe_solve_as_is(e, k, o, around, nearest, again);
    if (status != FAILED) return status;
    k->has_ridge = 1;
    return mhe_solve_as_is(e, k, o, around, nearest, 0);
#endif
}

#if CONSTRAINED
/* Shift the limits by what the linearisation missed at the spare trial, and a little beyond:
 * a second-order correction. */
static void mhe_bend(mhe_estimator *e, mhe_workspace *k, const mhe_outcome *o)
{
    const int count = e->length;
    real *w = k->bent.w, *v = k->bent.v, *d = k->product;
    for (int j = 0; j < (count + 1) * NX; j++) d[j] = o->spare->x[j] - o->best->x[j];
    for (int i = 0; i <= count; i++) mhe_wrap_state(e->settings, o->spare->x + i * NX, d + i * NX);
    mhe_rows_times(e, k, d);
    mhe_rows *rows = &k->rows;
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++)
        rows->load[i] = 2 * mhe_max(mhe_max(rows->low[i] - rows->value[i],
                                            rows->value[i] - rows->high[i]), 0);
#if MHE_X_SET
    /* Trials are clipped to the bounds of X. */
    for (int i = 0; i <= count; i++)
        memset(rows->load + i * ROWS + W_COUNT + V_COUNT, 0, sizeof(real) * NX);
#endif
    for (int i = 0; i < count; i++) {
        const mhe_terms *t = k->at[i];
        const int own = i * NX, out = i * NY;
        /* First the curvature, then where it leads from the best trajectory. */
        for (int j = 0; j < NX; j++) {
            const int at = own + j;
            const real linear = o->best->w[at] + d[at + NX] -
                                mhe_dot(NX, t->f_jacobian + j * NX, d + own);
            w[at] = o->spare->w[at] - linear;
        }
        for (int j = 0; j < NY; j++) {
            const int at = out + j;
            const real linear = o->best->v[at] - mhe_dot(NX, t->h_jacobian + j * NX, d + own);
            v[at] = o->spare->v[at] - linear;
        }
        mhe_wrap_state(e->settings, o->spare->x + own + NX, w + own);
        mhe_wrap_output(e->settings, mhe_stage_at(e, i)->y, v + out);
        for (int j = 0; j < NX; j++) w[own + j] += o->best->w[own + j];
        for (int j = 0; j < NY; j++) v[out + j] += o->best->v[out + j];
    }
    mhe_set_limits(e, k, o->best->x, w, v);
    memset(rows->value, 0, sizeof rows->value); /* X has no curvature */
    for (int i = 0; i < count; i++) {
        real *value = rows->value + i * ROWS;
#if MHE_W_SET
        real disturbance[NX];
        for (int j = 0; j < NX; j++) disturbance[j] = w[i * NX + j] - o->best->w[i * NX + j];
        mhe_values_of(NX, MHE_W_ROWS, disturbance, e->settings->disturbances.rows, value);
#endif
#if MHE_V_SET
        real noise[NY];
        for (int j = 0; j < NY; j++) noise[j] = v[i * NY + j] - o->best->v[i * NY + j];
        mhe_values_of(NY, MHE_V_ROWS, noise, e->settings->noises.rows, value + W_COUNT);
#endif
        (void)value;
    }
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++) {
        rows->load[i] += MHE_BEYOND * fabs(rows->value[i]);
        if (rows->high[i] - rows->low[i] > 4 * rows->load[i]) {
            rows->low[i] += rows->load[i];
            rows->high[i] -= rows->load[i];
        }
    }
}

/* Second-order corrections of the spare trial, which curvature takes out of a set. */
static void mhe_correct(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    for (int i = 0; i < MHE_CORRECTIONS && !mhe_is_late(k, o); i++) {
        mhe_bend(e, k, o);
        const int failed = mhe_solve_qp(e, k, o, o->best, 0, 1) == FAILED;
        o->corrections++;
        if (failed) break;
        mhe_try(e, k, o, 1);
        if (isfinite(o->spare->cost) || !isfinite(o->spare->violation)) break;
    }
}

/* Look for a feasible trajectory near a trial outside of the sets, by QPs in the metric of the
 * Hessian; whether one was found. It is the spare trial then. */
static int mhe_feasible_near(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o,
                             const mhe_trial *around)
{
    for (int i = 0; i < MHE_NEAREST_POINTS; i++) {
        mhe_trial *trial = around == o->spare ? o->other : o->spare;
        if (!isfinite(around->violation) || o->nearest_points >= MHE_NEAREST_POINTS * (1 + o->qps))
            break;
        if (!mhe_linearize(e, k, o, around)) break;
        if (mhe_is_late(k, o)) break;
        const int status = mhe_solve_qp(e, k, o, around, 1, 0);
        o->nearest_points++;
        if (status == FAILED) break;
        mhe_step_from(e, k, around, 1, trial);
        if (isfinite(trial->cost)) {
            if (trial == o->other) o->other = o->spare;
            o->spare = trial;
            return 1;
        }
        if (!(trial->violation < MHE_NEARER * around->violation)) break;
        around = trial;
    }
    o->spare->cost = INFINITY;
    return 0;
}
#endif

/* Make the spare trial the first one along the step whose cost is below the best so far, or the
 * last one. A useless step, whose promised decrease is negligible, is not shortened: at a minimum
 * none lowers the cost by more than rounding. Nor is a damped one. */
static void mhe_lower(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int useless)
{
    const int count = (int)(sizeof mhe_lengths / sizeof *mhe_lengths);
    const real target = mhe_target(o);
    const int shorten = !useless && !(o->present > 0);
    mhe_try(e, k, o, 1);
    if (o->spare->cost < target) return;
#if CONSTRAINED
    const int along = (int)(sizeof mhe_along / sizeof *mhe_along);
    const int curved = o->spare->violation > 0 && isfinite(o->spare->violation);
    memcpy(k->bent.x, k->step, sizeof k->step); /* other QPs overwrite it */
    if (curved) {
        const int nearly = o->spare->violation <= MHE_NEARLY;
        if (nearly) mhe_try(e, k, o, mhe_lengths[0]);
        /* If the shortened step leaves the set, too, curvature is the reason. */
        if (!(o->spare->cost < target) && !useless) {
            if (nearly) mhe_try(e, k, o, 1);
            mhe_correct(e, k, o);
            if (!isfinite(o->spare->cost)) mhe_feasible_near(e, k, o, o->spare);
            memcpy(k->step, k->bent.x, sizeof k->step);
        }
        if (o->spare->cost < target) return;
    }
    /* Between two infeasible points there is no feasible one of a convex set. */
    if (o->best->violation > MHE_FEASIBLE) return;
#endif
    for (int i = 0; i < count && shorten; i++) {
        mhe_try(e, k, o, mhe_lengths[i]);
        if (o->spare->cost < target) return;
    }
#if CONSTRAINED
    /* Along the boundary of a curved set: of a step's length, what it lowers the cost by shrinks
     * in proportion, and how far it leaves the set by the square. */
    for (int i = 0; i < along && curved && shorten; i++) {
        memcpy(k->step, k->bent.x, sizeof k->step);
        mhe_try(e, k, o, mhe_along[i]);
        if (!isfinite(o->spare->cost)) mhe_feasible_near(e, k, o, o->spare);
        if (o->spare->cost < target) return;
    }
#endif
}

/* The share of a damping that is left after a step that has lowered the cost. */
static real mhe_damping_left(real lowered, real promised)
{
    const real share = promised > 0 ? lowered / promised : 1;
    const real missed = 2 * (share < 1 ? share : 1) - 1;
    return mhe_max(MHE_LESS_DAMPING, 1 - missed * missed * missed);
}

/* Solve one QP and take its step; whether another QP is worth while. Where its step has not lowered
 * the cost, that is one around the same trajectory, with more damping. */
static int mhe_improve_once(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    const int is_damped = o->present > 0;
    /* Second-order corrections and searches for feasible points overwrite a QP with rows. */
    if ((!is_damped || CONSTRAINED) && !mhe_linearize(e, k, o, o->best)) {
        o->events |= MHE_MODEL_FAILED;
        return 0;
    }
    if (is_damped && !o->has_seen) {
        mhe_set_seen(e, k);
        o->has_seen = 1;
    }
    const int status = mhe_solve_qp(e, k, o, o->best, 0, 0), solved = status == SOLVED;
    o->qps++;
    if (status == FAILED) {
        o->events |= MHE_SOLVER_FAILED;
        return 0;
    }
    o->unsolved = solved ? 0 : o->unsolved + 1;
    if (!solved) o->events |= MHE_SOLVER_STOPPED;
    const real before = mhe_best_cost(o), target = mhe_target(o);
    /* Where the cost is infinite, no decrease is negligible. */
    const real negligible = isfinite(before) ? e->settings->tolerance * before : -1;
    const real promised = fabs(mhe_dot((e->length + 1) * NX, k->gradient, k->step));
    mhe_lower(e, k, o, solved && promised <= negligible);
    if (o->spare->cost < target) {
        const real lowered = before - o->spare->cost;
        mhe_take(k, o);
        if (is_damped) {
            o->damping = o->present * mhe_damping_left(lowered, promised);
            o->present = 0;
            o->growth = MHE_MORE_DAMPING;
            o->has_seen = 0;
            return 1;
        }
        o->damping *= MHE_OLD_DAMPING;
        if (solved && lowered <= negligible) {
            o->events |= MHE_CONVERGED;
            return 0;
        }
        if (!e->settings->patience || o->unsolved < e->settings->patience) return 1;
        o->events |= MHE_UNCONVERGED;
        return 0;
    }
    const real rounding = isfinite(before) ? mhe_rounding_cost(e, k, o->best) : -1;
    if (!is_damped && solved && promised <= mhe_max(rounding, MHE_STALLED * negligible)) {
        o->events |= MHE_CONVERGED;
        return 0;
    }
    /* Rounding hides a decrease this small, and more damping promises less. */
    if (!isfinite(before) || o->present > MHE_MOST_DAMPING ||
        ((solved || is_damped) && !(promised > mhe_max(rounding, MHE_ROUNDING * before)))) {
        o->events |= MHE_NO_DECREASE;
        o->damping = 0;
        return 0;
    }
    if (is_damped) {
        o->damping = o->growth * o->present;
        o->growth *= 2;
    }
    o->present = mhe_max(MHE_DAMPING, o->damping);
    return 1;
}

/* Make the spare trial the previous estimate, moved on by one step of the model. `before`: stages
 * of the window that it belongs to. */
static void mhe_shift(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before)
{
    const int count = e->length, skipped = before + 2 - (count + 1);
    mhe_stage *last = mhe_stage_at(e, count - 1);
    real *x = o->spare->x;
    memcpy(x, e->trajectory + skipped * NX, sizeof(real) * (size_t)count * NX);
    mhe_f(x + (count - 1) * NX, last->u, last->u[NU], x + count * NX);
    mhe_clip_trial(e, k, o->spare);
    mhe_evaluate(e, k, o->spare);
}

/* At most so many QPs, each around the best trajectory so far. `before`: as for the shift, -1 not
 * to start there. */
static void mhe_descend(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before, int limit)
{
    if (before >= 0) {
        mhe_shift(e, k, o, before);
        if (o->spare->cost < mhe_target(o)) mhe_take(k, o);
    }
    o->unsolved = 0;
    o->events &= ~MHE_UNCONVERGED;
    o->present = 0;
    o->growth = MHE_MORE_DAMPING;
    o->has_seen = 0;
    int is_open = 1;
    while (is_open && limit-- > 0) is_open = !mhe_is_late(k, o) && mhe_improve_once(e, k, o);
    if (is_open && o->present > 0 && !e->settings->uncapped) o->events |= MHE_CAP_REACHED;
    o->present = 0;
}

#if MHE_WIDENED
/* The cost of a trial, from its residuals: of a surrogate, or the cost itself again. */
static void mhe_weigh(mhe_estimator *e, const mhe_workspace *k, mhe_trial *trial)
{
    real offset[NX], cost = 0;
    if (!isfinite(trial->cost)) return;
    for (int i = 0; i < e->length; i++)
        cost += k->factors[i + 1] * mhe_stage_cost(e->settings, k, mhe_stage_at(e, i),
                                                   trial->w + i * NX, trial->v + i * NY);
    for (int j = 0; j < NX; j++) offset[j] = trial->x[j] - k->prior.mean[j];
    mhe_wrap_state(e->settings, trial->x, offset);
    cost += k->factors[0] * mhe_prior_cost(e->settings, k, offset);
    cost += mhe_further_cost(e, k, trial->x);
    trial->cost = cost >= 0 && isfinite(cost) ? cost : INFINITY;
}

static void mhe_set_widening(mhe_workspace *k, const mhe_settings *s, real rest)
{
    k->w_widening = pow(s->disturbance_loss.graduation, 2 * rest);
    k->v_widening = pow(s->noise_loss.graduation, 2 * rest);
}

/* Lower the cost with widened losses as long as the first window is not full. What is found counts
 * where the cost itself is lower; the next step starts from it in any case. */
static void mhe_search(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before, int limit)
{
    if (e->time >= MHE_HORIZON) {
        mhe_descend(e, k, o, before, limit);
        return;
    }
    const real target = mhe_target(o);
    const int from_candidate = o->best == o->candidate;
    const size_t size = sizeof(real) * (size_t)(e->length + 1) * NX;
    k->kept = *o->best;
    if (from_candidate) {
        *o->spare = *o->candidate;
        if (o->outside) o->spare->cost = INFINITY;
        mhe_take(k, o);
    }
    mhe_set_widening(k, e->settings, 1 - (real)e->time / (real)MHE_HORIZON);
    mhe_weigh(e, k, o->best);
    mhe_descend(e, k, o, before, limit);
    mhe_set_widening(k, e->settings, 0);
    /* Where nothing was found, the true cost is known. That of the candidate may be of a roll-out,
     * and its own trajectory none of the model's. */
    const int found = memcmp(o->best->x, k->kept.x, size) != 0;
    if (found) mhe_weigh(e, k, o->best);
    else o->best->cost = k->kept.cost;
    o->events |= MHE_GRADUATED;
    if (isfinite(o->best->cost)) {
        memcpy(k->followed, o->best->x, size);
        o->followed = 1;
    }
    if (found && o->best->cost < target) return;
    if (from_candidate) {
        o->spare = o->best;
        o->best = o->candidate;
    } else
        *o->best = k->kept;
}
#else
#define mhe_search mhe_descend
#endif

#if CONSTRAINED
/* The candidate's disturbances: its corrections, as far as they are in directions that have some. */
static const real *mhe_candidate_disturbances(const mhe_estimator *e, mhe_workspace *k)
{
    const real *w = k->trials->w;
#if MHE_QUIET
    for (int i = 0; i < e->length; i++)
        mhe_times(NX, e->settings->candidate_keep, w + i * NX, k->bent.w + i * NX);
    w = k->bent.w;
#endif
    (void)e;
    return w;
}

/* The sequence from a candidate outside of the sets. */
static void mhe_restore(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before)
{
    const int limit = e->settings->max_qps, start = e->settings->start_at_best ? before : -1;
    o->outside = 1;
    mhe_search(e, k, o, start, limit);
    if (!isfinite(mhe_best_cost(o))) {
        int found = mhe_feasible_near(e, k, o, o->candidate);
        if (!found && before >= 0) {
            mhe_shift(e, k, o, before);
            found = isfinite(o->spare->cost) || mhe_feasible_near(e, k, o, o->spare);
        }
        if (found) {
            mhe_take(k, o);
            mhe_search(e, k, o, -1, limit - o->qps);
        }
    }
    o->outside = 0;
    if (o->best != o->candidate && o->best->cost < o->candidate->cost) return;
    if (o->best != o->candidate) o->spare = o->best;
    o->best = o->candidate;
    if (mhe_is_late(k, o)) return;
    o->events &= ~OUTDATED;
    const real *w = mhe_candidate_disturbances(e, k);
    mhe_violation(e, o->candidate, w, 0, k->left_out);
    o->candidate->violation = mhe_violation(e, o->candidate, w, k->left_out, 0);
    mhe_search(e, k, o, start, limit > o->qps + 1 ? limit - o->qps : 1);
    memset(k->left_out, 0, sizeof k->left_out);
    if (o->best == o->candidate || !(mhe_violation(e, o->best, o->best->w, 0, k->left_out) > MHE_FEASIBLE))
        return;
    o->rows_dropped = 1;
    o->events |= MHE_ROWS_DROPPED;
}
#endif

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
    trial->cost += mhe_further_cost(e, k, trial->x);
    trial->cost += mhe_move_prior(e, k);
    memcpy(trial->x + count * NX, e->z_end, sizeof e->z_end);
#if CONSTRAINED
    memset(k->left_out, 0, sizeof k->left_out);
    trial->violation = mhe_violation(e, trial, mhe_candidate_disturbances(e, k), 0, 0);
#endif
}

#if MHE_QUIET
/* Whether the candidate has a correction in a direction without disturbances: it has no cost then,
 * and its J is that of its roll-out. */
static int mhe_roll_candidate_out(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    int is_quiet = 1;
    for (int i = 0; i < e->length; i++)
        for (int q = 0; q < MHE_QUIET; q++) {
            const real *direction = e->settings->quiet + q * NX, *w = o->candidate->w + i * NX;
            real share = 0, size = 0;
            for (int j = 0; j < NX; j++) {
                share += direction[j] * w[j];
                size += fabs(direction[j] * w[j]);
            }
            if (!(fabs(share) <= MHE_IN_RANGE * size)) is_quiet = 0;
        }
    if (is_quiet || !isfinite(o->candidate->cost)) return 0;
    memcpy(o->spare->x, o->candidate->x, sizeof o->spare->x);
    mhe_judge(e, k, o->spare, 1);
    o->candidate->cost = o->spare->cost;
    if (!isfinite(o->candidate->cost)) o->events |= MHE_MODEL_FAILED;
    return 1;
}

/* Search on from the trajectory of which the candidate's cost is, after a search in vain: no step
 * from the candidate itself need lower this cost, however short. */
static void mhe_search_from_rolled_out(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    const int left = e->settings->max_qps - o->qps;
    memcpy(o->spare->x, o->candidate->x, sizeof o->spare->x);
    mhe_evaluate(e, k, o->spare);
    const real before = o->spare->cost;
    if (!isfinite(before) || left <= 0) return;
    mhe_take(k, o);
    o->events &= ~OUTDATED;
    mhe_search(e, k, o, -1, left);
    if (o->best->cost < before) return;
    o->spare = o->best;
    o->best = o->candidate;
}
#endif

/* Solve the window's problem as it stands. `before`: stages of the window that the kept
 * trajectory belongs to, -1 if there is none. */
static void mhe_improve(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before)
{
    const mhe_settings *s = e->settings;
    real factor = 1;
    for (int i = e->length; i > 0; i--) {
        k->factors[i] = factor;
        factor *= s->discount;
    }
    k->factors[0] = factor;
    mhe_set_prior(e, k);
    mhe_begin_further(e, k);
    memset(o, 0, sizeof *o);
    o->damping = e->damping;
#if MHE_WIDENED
    mhe_set_widening(k, s, 0);
#endif
#if CONSTRAINED
    memcpy(k->rows.place, e->places, sizeof e->places);
#endif
    o->candidate = o->best = k->trials;
    o->spare = k->trials + 1;
    o->other = k->trials + 2;
    mhe_set_candidate(e, k, o->candidate);
#if MHE_QUIET
    const int rolled_out = mhe_roll_candidate_out(e, k, o);
#endif
#if CONSTRAINED
    const int feasible = o->candidate->violation <= MHE_FEASIBLE;
    if (!feasible) o->events |= MHE_CANDIDATE_OUTSIDE;
    if (!feasible && s->max_qps > 0) mhe_restore(e, k, o, before);
    else
#endif
    if (s->max_qps == 0)
        o->events |= MHE_NO_QPS;
    else
        mhe_search(e, k, o, s->start_at_best ? before : -1, s->max_qps);
#if MHE_QUIET /* implies CONSTRAINED */
    if (rolled_out && feasible && s->max_qps > 0 && o->best == o->candidate)
        mhe_search_from_rolled_out(e, k, o);
#endif
#if CONSTRAINED
    memcpy(e->places, k->rows.place, sizeof e->places);
#endif
    e->damping = o->damping;
    if (s->uncapped && o->qps >= s->max_qps && !(o->events & ENDS)) o->events |= MHE_UNCONVERGED;
    o->events |= o->best != o->candidate ? MHE_IMPROVED : MHE_CANDIDATE;
}
