/* No loss is widened. */

/* By what the losses of w and of v are widened now. Without a workspace: not at all. */
static real mhe_w_widening(const mhe_workspace *k)
{
    (void)k;
    return 1;
}

static real mhe_v_widening(const mhe_workspace *k)
{
    (void)k;
    return 1;
}

static void mhe_set_widening(mhe_workspace *k, const mhe_settings *s, real rest)
{
    (void)k; (void)s; (void)rest;
}

static void mhe_search(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before, int limit)
{
    mhe_descend(e, k, o, before, limit);
}

/* Where the next step starts. */
static const real *mhe_next_start(const mhe_workspace *k, const mhe_outcome *o)
{
    (void)k;
    return o->best->x;
}
