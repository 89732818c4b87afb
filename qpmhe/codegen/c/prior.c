/* The prior of a window: its mean, and its weight. */

/* The prior of the present window, before the candidate's cost is known. */
static void mhe_set_prior(mhe_estimator *e, mhe_workspace *k)
{
    const mhe_stage *first = mhe_stage_at(e, 0);
    mhe_prior *prior = &k->prior;
    prior->mean = first->z;
    prior->weight = prior->distance_weight = e->settings->prior_weight;
    mhe_weigh_prior(e, k);
}

/* Take the smoothed prior in place of the observer's state, unless the candidate has no finite
 * cost about it; by how much the candidate's cost rises. */
static real mhe_move_prior(mhe_estimator *e, mhe_workspace *k)
{
    real offset[NX];
    if (!e->has_smoothed_prior) return 0;
    for (int j = 0; j < NX; j++) offset[j] = mhe_stage_at(e, 0)->z[j] - e->smoothed_prior[j];
    mhe_wrap_state(e->settings, mhe_stage_at(e, 0)->z, offset);
    const real cost = mhe_prior_cost(e->settings, k, offset);
    if (!isfinite(cost)) return 0;
    k->prior.mean = e->smoothed_prior;
    return k->factors[0] * cost;
}
