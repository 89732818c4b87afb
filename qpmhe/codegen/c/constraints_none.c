/* There are no nonlinear constraints. */

static void mhe_set_values(mhe_estimator *e, mhe_trial *trial)
{
    (void)e; (void)trial;
}

static int mhe_has_values(const mhe_estimator *e, const mhe_trial *trial)
{
    (void)e; (void)trial;
    return 1;
}

static void mhe_value_distances(mhe_estimator *e, int i, const mhe_trial *trial, real *low, real *high)
{
    (void)e; (void)i; (void)trial; (void)low; (void)high;
}

static void mhe_value_scales(const mhe_settings *s, real *scale, real *deviation)
{
    (void)s; (void)scale; (void)deviation;
}

static real mhe_values_missed(const mhe_settings *s, const real *high, const uint8_t *left_out,
                              uint8_t *missed)
{
    (void)s; (void)high; (void)left_out; (void)missed;
    return 0;
}

static void mhe_linearize_constraints(mhe_estimator *e, mhe_workspace *k, const mhe_trial *around)
{
    (void)e; (void)k; (void)around;
}

static real mhe_value_slope(const mhe_workspace *k, int i, int r, int following, int j)
{
    (void)k; (void)i; (void)r; (void)following; (void)j;
    return 0;
}

static void mhe_leave_out(const mhe_workspace *k, int i, real *high)
{
    (void)k; (void)i; (void)high;
}

static void mhe_slopes_times(const mhe_estimator *e, const mhe_workspace *k, int i, const real *d,
                             real *value)
{
    (void)e; (void)k; (void)i; (void)d; (void)value;
}

static void mhe_add_slope_loads(const mhe_estimator *e, const mhe_workspace *k, int i,
                                const real *load, real *out)
{
    (void)e; (void)k; (void)i; (void)load; (void)out;
}

static void mhe_add_slope_weights(const mhe_estimator *e, mhe_workspace *k, int i, const real *weight)
{
    (void)e; (void)k; (void)i; (void)weight;
}

static void mhe_slope_stiffness(mhe_estimator *e, const mhe_workspace *k, int i, const int8_t *place,
                                real *pliancy)
{
    (void)e; (void)k; (void)i; (void)place; (void)pliancy;
}

static void mhe_sharpen_values(mhe_estimator *e, mhe_workspace *k, int i, real least)
{
    (void)e; (void)k; (void)i; (void)least;
}

static void mhe_bend_values(mhe_estimator *e, mhe_workspace *k, const mhe_trial *best,
                            const mhe_trial *spare)
{
    (void)e; (void)k; (void)best; (void)spare;
}

static void mhe_missed_values(mhe_workspace *k, int i, const mhe_trial *best)
{
    (void)k; (void)i; (void)best;
}

static void mhe_forget_pushes(mhe_workspace *k)
{
    (void)k;
}

static void mhe_note_trial(const mhe_estimator *e, mhe_workspace *k, const mhe_trial *trial)
{
    (void)e; (void)k; (void)trial;
}

static void mhe_fill_trial_failed(const mhe_workspace *k, mhe_estimate *out)
{
    (void)k; (void)out;
}

static void mhe_keep_pushes(mhe_estimator *e, mhe_workspace *k, int is_solved, int is_exact)
{
    (void)e; (void)k; (void)is_solved; (void)is_exact;
}

static void mhe_set_bends(mhe_estimator *e, mhe_workspace *k, const mhe_trial *around)
{
    (void)e; (void)k; (void)around;
}

static void mhe_add_bends(const mhe_estimator *e, mhe_workspace *k)
{
    (void)e; (void)k;
}
