/* No candidate is restored at a cost above its own. */

static int mhe_enter_sets(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, real nearest, int before)
{
    (void)e; (void)k; (void)o; (void)nearest; (void)before;
    return 0;
}

static void mhe_fill_missed(const mhe_workspace *k, const mhe_outcome *o, mhe_estimate *out)
{
    (void)k; (void)o; (void)out;
}
