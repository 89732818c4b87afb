/* What an observer with a covariance does at a stage, and remembers behind it. */

/* L(z, v) of stage i, and the observer's covariance behind it with its sensors' counts. Where the
 * covariance is lost, the first one takes its place, without a correction by it; a bit of the status
 * says so. */
static int mhe_correct_observer(mhe_estimator *e, int i, real *out)
{
    const mhe_settings *s = e->settings;
    if (!(mhe_correct_with_pivot(e, i, out) < 0)) return 0;
    memcpy(mhe_next_covariance(e, i), s->covariances.initial, sizeof s->covariances.initial);
    mhe_forget_rejections(e, i);
    if (!MHE_CONSTANT_GAIN)
        for (int j = 0; j < NX; j++) out[j] = 0;
    return MHE_OBSERVER_RESET;
}

/* Stage i, where the model fails: what the observer remembered where it last did not, at a stage of the
 * window or, where that is negative, before it. */
static void mhe_hold_observer(mhe_estimator *e, int i, int good)
{
    const real *kept = good >= 0 ? mhe_stage_at(e, good)->covariance : e->last_good_covariance;
    memcpy(mhe_next_covariance(e, i), kept, sizeof e->last_good_covariance);
    mhe_forget_root(e, i);
    mhe_keep_rejections(e, i);
}

/* Keep what it remembers at a stage that leaves the window. */
static void mhe_keep_good(mhe_estimator *e, const mhe_stage *leaving)
{
    memcpy(e->last_good_covariance, leaving->covariance, sizeof leaving->covariance);
}

/* Before the first sample. */
static void mhe_start_observer(mhe_estimator *e)
{
    const real *initial = e->settings->covariances.initial;
    memcpy(e->last_good_covariance, initial, sizeof e->covariance_end);
    memcpy(e->covariance_end, initial, sizeof e->covariance_end);
}

/* At the window's first state. */
static void mhe_start_observer_again(mhe_estimator *e)
{
    memcpy(mhe_next_covariance(e, -1), e->settings->covariances.initial, sizeof e->covariance_end);
    mhe_forget_root(e, -1);
    mhe_forget_rejections(e, -1);
}
