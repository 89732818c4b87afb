/* Without sets, no step leaves one. */

static int mhe_try_curved(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, real target,
                          int useless)
{
    (void)e; (void)k; (void)o; (void)target; (void)useless;
    return 0;
}

static void mhe_try_along(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, real target)
{
    (void)e; (void)k; (void)o; (void)target;
}
