/* An observer that has run away, and the one that starts at an estimate and takes its place. */

@mhe_workspace
    mhe_estimator second; /* with an observer that starts at the window's first estimate */
@
/* Whether the next sample may restart the observer. */
static int mhe_is_due(const mhe_estimator *e)
{
    return e->time - e->restarted >= MHE_HORIZON;
}

/* The squared weighted errors y - h(z) of stage i; infinity where the model has failed. */
static real mhe_prediction_error(mhe_estimator *e, int i)
{
    const mhe_stage *stage = mhe_stage_at(e, i);
    return isfinite(stage->cost) ? mhe_form(NY, stage->noise_weight, stage->v) : INFINITY;
}

/* Behind a new sample: let an observer that starts now at the window's first estimate, as the first one
 * did, take a worse one's place. Both have predicted the window's measurements, none of which this
 * estimate has used: the errors decide, by an F-test of their sizes. `events` are bits of the status. */
static void mhe_challenge(mhe_estimator *e, mhe_workspace *k, int *events)
{
    mhe_estimator *second = &k->second;
    real before = 0, after = 0;
    int count = 0, replayed = 0, nearby = 0;
    if (e->settings->reinitialize || e->time - 1 - e->restarted < MHE_HORIZON) return;
    for (int i = 0; i < e->length; i++) {
        before += mhe_prediction_error(e, i);
        for (int j = 0; j < NY; j++) count += mhe_stage_at(e, i)->is_observed[j] != 0;
    }
    const real larger = e->settings->restart.larger[count];
    *second = *e;
    mhe_stage *oldest = mhe_stage_at(second, 0);
    memcpy(oldest->z, oldest->history, sizeof oldest->z);
    mhe_start_observer_again(second);
    mhe_put_first_inside(second);
    for (int i = 0; i < e->length && before > larger * after; i++) {
        replayed = mhe_enter(second, i, 0);
        nearby |= replayed & MHE_DERIVATIVE_NEARBY;
        after += mhe_prediction_error(second, i);
    }
    *events |= nearby;
    if (!(before > larger * after)) return;
    *e = *second;
    e->restarted = e->time;
    *events = (*events & MHE_DERIVATIVE_NEARBY) | replayed | MHE_RESTARTED;
}
