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
