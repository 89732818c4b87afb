/* Trials, and the QPs around them. */

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
    mhe_linearize_constraints(e, k, around);
    mhe_set_limits(e, k, around->x, around);
    return 1;
}

/* Solve the QP around a trial, with its Hessian as it is or with a ridge. */
static int mhe_solve_as_is(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o,
                           const mhe_trial *around, int nearest, int again)
{
    const real *prior = k->prior.mean;
    real offset[NX];
    k->prior.first = around->x;
    mhe_set_around(k, around);
    for (int j = 0; j < NX; j++) offset[j] = around->x[j] - prior[j];
    mhe_wrap_state(e->settings, around->x, offset);
    return mhe_solve_rows(e, k, o, offset, nearest, again);
}

/* Solve the QP around a trial; the increments are in k->step. With `again`, only limits have changed
 * since the last one. Weights that a loss takes from outliers may leave a Hessian that is singular up
 * to rounding: it gets a ridge then. */
static int mhe_solve_qp(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o,
                        const mhe_trial *around, int nearest, int again)
{
    k->damping = nearest ? 0 : o->present;
    mhe_set_ridge(k, 0);
    int status = mhe_solve_as_is(e, k, o, around, nearest, again);
    if (status == FAILED && mhe_set_ridge(k, 1))
        status = mhe_solve_as_is(e, k, o, around, nearest, 0);
    return status;
}
