/* What an observer without a covariance does at a stage; it remembers nothing behind it. */

static int mhe_correct_observer(mhe_estimator *e, int i, real *out)
{
    mhe_correction(e, i, out);
    return 0;
}

static void mhe_hold_observer(mhe_estimator *e, int i, int good)
{
    (void)e; (void)i; (void)good;
}

static void mhe_keep_good(mhe_estimator *e, const mhe_stage *leaving)
{
    (void)e; (void)leaving;
}

static void mhe_start_observer(mhe_estimator *e)
{
    (void)e;
}

static void mhe_start_observer_again(mhe_estimator *e)
{
    (void)e;
}
