/* An observer with a covariance is projected in its inverse. */

/* The metric behind stage i. */
static void mhe_metric_behind(mhe_estimator *e, int i, mhe_metric *m)
{
    mhe_take_metric(e, mhe_next_covariance(e, i), mhe_known_root(e, i), m);
}

static int mhe_needs_slope(const mhe_estimator *e)
{
    (void)e;
    return 0;
}

static void mhe_settle_metric(mhe_estimator *e, const mhe_stage *stage)
{
    (void)e; (void)stage;
}

/* The observer's own estimate of x(t) that has used y(t), in X. */
static void mhe_filter_inside(mhe_estimator *e, const mhe_stage *stage, real *out)
{
    real covariance[NX * NX];
    mhe_filter(e->settings, stage, out, covariance);
    mhe_enter_turn(e->settings, out);
    if (isfinite(stage->cost)) {
        mhe_metric m;
        mhe_take_metric(e, covariance, 0, &m);
        mhe_put_inside(e, mhe_x_set_at(e->settings, stage), &m, out);
    }
}
