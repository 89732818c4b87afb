/* An observer with a covariance is projected in its inverse. */

/* The metric behind stage i, as a covariance. */
static const real *mhe_metric(mhe_estimator *e, int i) { return mhe_next_covariance(e, i); }

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
    if (isfinite(stage->cost))
        mhe_put_inside(e, mhe_x_set_at(e->settings, stage), covariance, out);
}
