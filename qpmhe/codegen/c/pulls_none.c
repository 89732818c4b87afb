/* No row has a load without a weight. */

static void mhe_set_pulls(const mhe_estimator *e, mhe_workspace *k)
{
    (void)e; (void)k;
}

static void mhe_unload_missed(const mhe_estimator *e, mhe_workspace *k)
{
    (void)e; (void)k;
}

static void mhe_forget_pulls(mhe_workspace *k)
{
    (void)k;
}

static void mhe_pull_side(const mhe_estimator *e, const mhe_workspace *k, int i, real *side, real *pull)
{
    (void)e; (void)k; (void)i; (void)side; (void)pull;
}

static void mhe_pull_first(const mhe_workspace *k, real *side, const real *pull)
{
    (void)k; (void)side; (void)pull;
}

static void mhe_add_missed_curvature(const mhe_estimator *e, const mhe_workspace *k, int i, real *diagonal)
{
    (void)e; (void)k; (void)i; (void)diagonal;
}
