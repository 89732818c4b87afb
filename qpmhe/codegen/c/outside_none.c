/* Without sets, no candidate is outside of them. */

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
