/* The prior's weight is constant. */

static void mhe_weigh_prior(mhe_estimator *e, mhe_workspace *k)
{
    (void)e; (void)k;
}
