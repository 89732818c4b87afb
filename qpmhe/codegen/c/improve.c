/* The best trajectory of a window. */

/* The candidate as a trial: its cost is known already. */
static void mhe_set_candidate(mhe_estimator *e, mhe_workspace *k, mhe_trial *trial)
{
    const int count = e->length;
    trial->cost = 0;
    trial->violation = 0;
    for (int i = 0; i < count; i++) {
        const mhe_stage *stage = mhe_stage_at(e, i);
        memcpy(trial->x + i * NX, stage->z, sizeof stage->z);
        memcpy(trial->w + i * NX, stage->w, sizeof stage->w);
        memcpy(trial->v + i * NY, stage->v, sizeof stage->v);
        trial->cost += k->factors[i + 1] * stage->cost;
    }
    memcpy(trial->x + count * NX, e->z_end, sizeof e->z_end);
    mhe_set_values(e, trial);
    trial->cost += mhe_further_cost(e, k, trial);
    trial->cost += mhe_move_prior(e, k);
    trial->violation = mhe_violation(e, trial, mhe_candidate_disturbances(e, k), 0, 0);
}

/* Solve the window's problem as it stands. `before`: stages of the window that the kept
 * trajectory belongs to, -1 if there is none. */
static void mhe_improve(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before)
{
    const mhe_settings *s = e->settings;
    real factor = 1;
    for (int i = e->length; i > 0; i--) {
        k->factors[i] = factor;
        factor = mhe_max(factor * s->discount, MHE_LEAST_DISCOUNT);
    }
    k->factors[0] = factor;
    mhe_set_prior(e, k);
    mhe_begin_further(e, k);
    memset(o, 0, sizeof *o);
    o->restored_cost = NAN;
    o->damping = e->damping;
    mhe_set_widening(k, s, 0);
    mhe_recall_places(e, k);
    mhe_forget_pushes(k);
    o->candidate = o->best = k->trials;
    o->spare = k->trials + 1;
    o->other = k->trials + 2;
    mhe_set_candidate(e, k, o->candidate);
    mhe_roll_candidate_out(e, k, o);
    const int feasible = o->candidate->violation <= MHE_FEASIBLE;
    if (!feasible) o->events |= MHE_CANDIDATE_OUTSIDE;
    if (!feasible && s->max_qps > 0)
        mhe_restore(e, k, o, before);
    else if (s->max_qps == 0)
        o->events |= MHE_NO_QPS;
    else
        mhe_search(e, k, o, s->start_at_best ? before : -1, s->max_qps);
    mhe_search_from_rolled_out(e, k, o);
    mhe_keep_places(e, k);
    e->damping = o->damping;
    if (s->uncapped && o->qps >= s->max_qps && !(o->events & ENDS)) o->events |= MHE_UNCONVERGED;
    if (o->best == o->candidate)
        o->events |= MHE_CANDIDATE;
    else if (!(o->events & MHE_RESTORED)) /* better than no candidate, but in the sets */
        o->events |= MHE_IMPROVED;
}
