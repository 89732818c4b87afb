/* The observer goes on from where it is. */

static int mhe_is_due(const mhe_estimator *e)
{
    (void)e;
    return 0;
}

static void mhe_challenge(mhe_estimator *e, mhe_workspace *k, int *events)
{
    (void)e; (void)k; (void)events;
}
