/* No states are held. */

static void mhe_trust(mhe_estimator *e, const mhe_workspace *k, const real *trajectory)
{
    (void)e; (void)k; (void)trajectory;
}

static void mhe_trust_on(mhe_estimator *e)
{
    (void)e;
}

static void mhe_trust_start(mhe_estimator *e)
{
    (void)e;
}
