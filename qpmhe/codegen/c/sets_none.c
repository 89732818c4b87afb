/* There are no sets W, V and X. */

static void mhe_shift_places(mhe_estimator *e)
{
    (void)e;
}

static real mhe_violation(mhe_estimator *e, const mhe_trial *trial, const real *w,
                          const uint8_t *left_out, uint8_t *missed)
{
    (void)e; (void)trial; (void)w; (void)left_out; (void)missed;
    return 0;
}

static void mhe_keep_equations(const mhe_settings *s, const real *predicted, real *next)
{
    (void)s; (void)predicted; (void)next;
}

static void mhe_fill_dropped(const mhe_workspace *k, int rows_dropped, mhe_estimate *out)
{
    (void)k; (void)rows_dropped; (void)out;
}

static void mhe_fill_missed(const mhe_workspace *k, const mhe_outcome *o, mhe_estimate *out)
{
    (void)k; (void)o; (void)out;
}

static void mhe_restore(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before)
{
    (void)e; (void)k; (void)o; (void)before;
}

static void mhe_recall_places(const mhe_estimator *e, mhe_workspace *k)
{
    (void)e; (void)k;
}

static void mhe_keep_places(mhe_estimator *e, const mhe_workspace *k)
{
    (void)e; (void)k;
}

/* Solve the QP whose limits and terms are in place; the increments are in k->step. */
static int mhe_solve_rows(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, const real *offset,
                          int nearest, int again)
{
    (void)o; (void)again;
    return mhe_solve_free(e, k, offset, nearest) ? SOLVED : FAILED;
}

static void mhe_set_limits(mhe_estimator *e, mhe_workspace *k, const real *x, const mhe_trial *trial)
{
    (void)e; (void)k; (void)x; (void)trial;
}

static void mhe_clip_trial(mhe_estimator *e, const mhe_workspace *k, mhe_trial *trial)
{
    (void)e; (void)k; (void)trial;
}

/* The decrease of J that the QP promises. */
static real mhe_promised(const mhe_estimator *e, const mhe_workspace *k, const mhe_outcome *o)
{
    (void)o;
    return fabs(mhe_dot((e->length + 1) * NX, k->gradient, k->step));
}
