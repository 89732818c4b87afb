/* No loss is widened. */

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
