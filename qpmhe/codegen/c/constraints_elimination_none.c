/* There are no nonlinear constraints. */

static void mhe_use_bends(mhe_workspace *k, int nearest)
{
    (void)k; (void)nearest;
}

static void mhe_add_bend_rows(const mhe_estimator *e, const mhe_workspace *k, int i, mhe_block *b)
{
    (void)e; (void)k; (void)i; (void)b;
}

static void mhe_add_value_rows(const mhe_estimator *e, const mhe_workspace *k, int i, mhe_block *b)
{
    (void)e; (void)k; (void)i; (void)b;
}

static real mhe_value_drift(const mhe_estimator *e, const mhe_workspace *k, int place)
{
    (void)e; (void)k; (void)place;
    return 0;
}

static void mhe_set_bend_targets(const mhe_estimator *e, mhe_workspace *k, const real *step)
{
    (void)e; (void)k; (void)step;
}

static int mhe_bend_sides(const mhe_workspace *k, int i, int push, int at, real *side)
{
    (void)k; (void)i; (void)push; (void)side;
    return at;
}

static void mhe_add_bend_forces(const mhe_estimator *e, const mhe_workspace *k, real *forces)
{
    (void)e; (void)k; (void)forces;
}

static void mhe_add_bend_curvature(const mhe_workspace *k, int i, real *diagonal)
{
    (void)k; (void)i; (void)diagonal;
}

static real mhe_bend_objective(const mhe_estimator *e, const mhe_workspace *k)
{
    (void)e; (void)k;
    return 0;
}
