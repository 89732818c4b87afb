/* Losses that are widened while the first window fills, and the search with them. */

@mhe_workspace
    mhe_trial kept;                   /* the best trial by the cost itself */
    mhe_real w_widening, v_widening;  /* of the losses; 1 of the cost itself */
    mhe_real followed[(MHE_HORIZON + 1) * MHE_NX]; /* where the next step starts */
@
/* By what the losses of w and of v are widened now. Without a workspace: not at all. */
static real mhe_w_widening(const mhe_workspace *k)
{
    return k ? k->w_widening : 1;
}

static real mhe_v_widening(const mhe_workspace *k)
{
    return k ? k->v_widening : 1;
}

/* The cost of a trial, from its residuals: of a surrogate, or the cost itself again. */
static void mhe_weigh(mhe_estimator *e, const mhe_workspace *k, mhe_trial *trial)
{
    real offset[NX], cost = 0;
    if (!isfinite(trial->cost)) return;
    for (int i = 0; i < e->length; i++)
        cost += k->factors[i + 1] * mhe_stage_cost(e->settings, k, mhe_stage_at(e, i),
                                                   trial->w + i * NX, trial->v + i * NY);
    for (int j = 0; j < NX; j++) offset[j] = trial->x[j] - k->prior.mean[j];
    mhe_wrap_state(e->settings, trial->x, offset);
    cost += k->factors[0] * mhe_prior_cost(e->settings, k, offset);
    cost += mhe_further_cost(e, k, trial);
    trial->cost = cost >= 0 && isfinite(cost) ? cost : INFINITY;
}

static void mhe_set_widening(mhe_workspace *k, const mhe_settings *s, real rest)
{
    k->w_widening = pow(s->disturbance_loss.graduation, 2 * rest);
    k->v_widening = pow(s->noise_loss.graduation, 2 * rest);
}

/* Lower the cost with widened losses as long as the first window is not full. What is found counts
 * where the cost itself is lower; the next step starts from it in any case. */
static void mhe_search(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before, int limit)
{
    if (e->time >= MHE_HORIZON) {
        mhe_descend(e, k, o, before, limit);
        return;
    }
    const real target = mhe_target(o);
    const int from_candidate = o->best == o->candidate;
    const size_t size = sizeof(real) * (size_t)(e->length + 1) * NX;
    k->kept = *o->best;
    if (from_candidate) {
        *o->spare = *o->candidate;
        if (o->outside) o->spare->cost = INFINITY;
        mhe_take(k, o);
    }
    mhe_set_widening(k, e->settings, 1 - (real)e->time / (real)MHE_HORIZON);
    mhe_weigh(e, k, o->best);
    mhe_descend(e, k, o, before, limit);
    mhe_set_widening(k, e->settings, 0);
    /* Where nothing was found, the true cost is known. That of the candidate may be of a roll-out,
     * and its own trajectory none of the model's. */
    const int found = memcmp(o->best->x, k->kept.x, size) != 0;
    if (found) mhe_weigh(e, k, o->best);
    else o->best->cost = k->kept.cost;
    o->events |= MHE_GRADUATED;
    if (isfinite(o->best->cost)) {
        memcpy(k->followed, o->best->x, size);
        o->followed = 1;
    }
    if (found && o->best->cost < target) return;
    if (from_candidate) {
        o->spare = o->best;
        o->best = o->candidate;
    } else
        *o->best = k->kept;
}

/* Where the next step starts. */
static const real *mhe_next_start(const mhe_workspace *k, const mhe_outcome *o)
{
    return o->followed ? k->followed : o->best->x;
}
