/* No sensors whose innovations are tested. */

static void mhe_keep_rejections(mhe_estimator *e, int i)
{
    (void)e; (void)i;
}

static void mhe_forget_rejections(mhe_estimator *e, int i)
{
    (void)e; (void)i;
}

static int mhe_rejection(mhe_estimator *e, int i)
{
    (void)e; (void)i;
    return 0;
}

static void mhe_fill_sensors(mhe_estimator *e, mhe_estimate *out)
{
    (void)e; (void)out;
}

static void mhe_log_sensors(mhe_estimator *e, const mhe_log *log, int64_t at)
{
    (void)e; (void)log; (void)at;
}
