/* QPs without rows. */

/* Solve the QP whose limits and terms are in place; the increments are in k->step. */
static int mhe_solve_rows(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, const real *offset,
                          int nearest, int again)
{
    (void)o; (void)again;
    return mhe_solve_free(e, k, offset, nearest) ? SOLVED : FAILED;
}

static void mhe_set_limits(mhe_estimator *e, mhe_workspace *k, const real *x, const real *w,
                           const real *v)
{
    (void)e; (void)k; (void)x; (void)w; (void)v;
}

static void mhe_clip_trial(mhe_estimator *e, const mhe_workspace *k, mhe_trial *trial)
{
    (void)e; (void)k; (void)trial;
}
