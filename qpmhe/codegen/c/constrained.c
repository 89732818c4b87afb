/* A QP with rows: by its active set, and where that does not settle by an interior-point method. */

/* Solve the QP whose limits and terms are in place; the increments are in k->step. */
static int mhe_solve_rows(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, const real *offset,
                          int nearest, int again)
{
    const int limit = e->settings->max_iterations;
    mhe_begin_soft(e, k, nearest, again);
    int guesses = 0, iterations = 0;
    int status = mhe_active_set(e, k, offset, nearest, limit, again && o->factorised, &guesses);
    o->factorised = status == SOLVED;
    if (status == STOPPED) {
        if (!mhe_solve_free(e, k, offset, nearest)) return FAILED;
        if (guesses < limit && !mhe_time_is_up(k))
            status = mhe_interior_point(e, k, offset, nearest, limit - guesses, &iterations);
        if ((status == SOLVED || status == NEARLY) && guesses + iterations < limit) {
            /* Its active set gives the solution up to rounding. */
            const int left = limit - guesses - iterations;
            int more = 0;
            memcpy(k->residual, k->step, sizeof k->step);
            o->factorised = mhe_active_set(e, k, offset, nearest, left, 0, &more) == SOLVED;
            if (!o->factorised) {
                memcpy(k->step, k->residual, sizeof k->step);
                mhe_recall_forces(e, k);
            } else
                status = SOLVED;
            guesses += more;
        }
        if (status == NEARLY) status = STOPPED;
    }
    if (!nearest) mhe_keep_pushes(e, k, status == SOLVED, o->factorised);
    if (status != SOLVED) memset(k->rows.place, 0, sizeof k->rows.place);
    o->iterations += guesses + iterations;
    return status == EXCLUDED ? STOPPED : status;
}

/* Clip a trial to the bounds of X, in the turns of its angles. */
static void mhe_clip_trial(mhe_estimator *e, const mhe_workspace *k, mhe_trial *trial)
{
    for (int i = 0; MHE_X_SET && i <= e->length; i++) {
        const mhe_x_set *set = mhe_x_set_at(e->settings, mhe_stage_of_state(e, i));
        const uint8_t *out = k->left_out + i * ROWS + W_COUNT + V_COUNT;
        real *x = trial->x + i * NX;
        mhe_enter_turn(e->settings, x);
        for (int j = 0; j < NX; j++) {
            if (mhe_is_soft(e->settings, W_COUNT + V_COUNT + j)) continue;
            if (x[j] < set->lower[j] && !(out[j] & MHE_LOWER)) x[j] = set->lower[j];
            if (x[j] > set->upper[j] && !(out[j] & MHE_UPPER)) x[j] = set->upper[j];
        }
    }
}
