/* The candidate's roll-out, where some directions have no disturbances. */

/* Whether the candidate has a correction in a direction without disturbances: it has no cost then,
 * and its J is that of its roll-out. */
static void mhe_roll_candidate_out(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    int is_quiet = 1;
    for (int i = 0; i < e->length; i++)
        for (int q = 0; q < MHE_QUIET; q++) {
            const real *direction = e->settings->quiet + q * NX, *w = o->candidate->w + i * NX;
            real share = 0, size = 0;
            for (int j = 0; j < NX; j++) {
                share += direction[j] * w[j];
                size += fabs(direction[j] * w[j]);
            }
            if (!(fabs(share) <= MHE_IN_RANGE * size)) is_quiet = 0;
        }
    if (is_quiet || !isfinite(o->candidate->cost)) return;
    memcpy(o->spare->x, o->candidate->x, sizeof o->spare->x);
    mhe_judge(e, k, o->spare, 1);
    o->candidate->cost = o->spare->cost;
    if (!isfinite(o->candidate->cost)) o->events |= MHE_MODEL_FAILED;
    o->rolled_out = 1;
}

/* Search on from the trajectory of which the candidate's cost is, after a search in vain: no step
 * from the candidate itself need lower this cost, however short. */
static void mhe_search_from_rolled_out(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    const int left = e->settings->max_qps - o->qps;
    if (!o->rolled_out || o->events & MHE_CANDIDATE_OUTSIDE || o->best != o->candidate) return;
    if (e->settings->max_qps == 0) return;
    memcpy(o->spare->x, o->candidate->x, sizeof o->spare->x);
    mhe_evaluate(e, k, o->spare);
    const real before = o->spare->cost;
    if (!isfinite(before) || left <= 0) return;
    mhe_take(k, o);
    o->events &= ~OUTDATED;
    mhe_search(e, k, o, -1, left);
    if (o->best->cost < before) return;
    o->spare = o->best;
    o->best = o->candidate;
}
