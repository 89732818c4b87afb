/* Steps that curvature takes out of a set. */

/* Shift the limits by what the linearisation missed at the spare trial, and a little beyond:
 * a second-order correction. */
static void mhe_bend(mhe_estimator *e, mhe_workspace *k, const mhe_outcome *o)
{
    const int count = e->length;
    real *w = k->bent.w, *v = k->bent.v, *d = k->product;
    for (int j = 0; j < (count + 1) * NX; j++) d[j] = o->spare->x[j] - o->best->x[j];
    for (int i = 0; i <= count; i++) mhe_wrap_state(e->settings, o->spare->x + i * NX, d + i * NX);
    mhe_rows_times(e, k, d);
    mhe_bend_values(e, k, o->best, o->spare);
    mhe_rows *rows = &k->rows;
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++)
        rows->load[i] = 2 * mhe_max(mhe_max(rows->low[i] - rows->value[i],
                                            rows->value[i] - rows->high[i]), 0);
    /* Trials are clipped to the bounds of X. */
    for (int i = 0; MHE_X_SET && i <= count; i++)
        memset(rows->load + i * ROWS + W_COUNT + V_COUNT, 0, sizeof(real) * NX);
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
    mhe_set_limits(e, k, o->best->x, &k->bent);
    memset(rows->value, 0, sizeof rows->value); /* X has no curvature */
    for (int i = 0; i < count; i++) {
        real *value = rows->value + i * ROWS;
        if (MHE_W_SET) {
            real disturbance[NX];
            for (int j = 0; j < NX; j++) disturbance[j] = w[i * NX + j] - o->best->w[i * NX + j];
            mhe_values_of(NX, MHE_W_ROWS, disturbance, e->settings->disturbances.rows, value);
        }
        if (MHE_V_SET) {
            real noise[NY];
            for (int j = 0; j < NY; j++) noise[j] = v[i * NY + j] - o->best->v[i * NY + j];
            mhe_values_of(NY, MHE_V_ROWS, noise, e->settings->noises.rows, value + W_COUNT);
        }
        (void)value;
    }
    for (int i = 0; i < mhe_row_stages(e); i++) mhe_missed_values(k, i, o->best);
    mhe_bend_soft(e, k);
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
        if (!isfinite(o->spare->violation)) break;
        if (isfinite(o->spare->cost) && !mhe_is_bent(o)) break;
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

/* After a step that curvature may take out of a set: corrections of the second order. Whether the search
 * along it is over. */
static int mhe_try_curved(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, real target,
                          int useless)
{
    o->is_curved = o->spare->violation > 0 && isfinite(o->spare->violation);
    memcpy(k->bent.x, k->step, sizeof k->step); /* other QPs overwrite it */
    if (o->is_curved) {
        const int nearly = o->spare->violation <= MHE_NEARLY;
        static const real lengths[] = MHE_LENGTHS;
        if (nearly) mhe_try(e, k, o, lengths[0]);
        /* If the shortened step leaves the set, too, curvature is the reason. */
        if (!(o->spare->cost < target) && !useless) {
            if (nearly) mhe_try(e, k, o, 1);
            mhe_correct(e, k, o);
            if (!isfinite(o->spare->cost)) mhe_feasible_near(e, k, o, o->spare);
            memcpy(k->step, k->bent.x, sizeof k->step);
        }
        if (o->spare->cost < target) return 1;
    }
    if (!o->is_curved && mhe_is_bent(o) && !useless) {
        mhe_correct(e, k, o);
        memcpy(k->step, k->bent.x, sizeof k->step);
        if (o->spare->cost < target) return 1;
    }
    /* Between two infeasible points there is no feasible one of a convex set. */
    return o->best->violation > MHE_FEASIBLE;
}

/* Along the boundary of a curved set: of a step's length, what it lowers the cost by shrinks in
 * proportion, and how far it leaves the set by the square. */
static void mhe_try_along(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, real target)
{
    static const real lengths[] = MHE_ALONG;
    const int along = (int)(sizeof lengths / sizeof *lengths);
    const int is_bent = mhe_is_bent(o); /* of the shortest step so far */
    for (int i = 0; i < along && (o->is_curved || is_bent); i++) {
        memcpy(k->step, k->bent.x, sizeof k->step);
        mhe_try(e, k, o, lengths[i]);
        if (!o->is_curved) mhe_correct(e, k, o);
        else if (!isfinite(o->spare->cost)) mhe_feasible_near(e, k, o, o->spare);
        if (o->spare->cost < target) return;
    }
}
