/* A candidate outside of the sets. */

/* The sequence from a candidate outside of the sets. */
static void mhe_restore(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before)
{
    const int limit = e->settings->max_qps, start = e->settings->start_at_best ? before : -1;
    real nearest = INFINITY;
    o->outside = 1;
    mhe_search(e, k, o, start, limit);
    if (!isfinite(mhe_best_cost(o))) {
        int found = mhe_feasible_near(e, k, o, o->candidate);
        if (found) nearest = o->spare->cost;
        if (!found && before >= 0) {
            mhe_shift(e, k, o, before);
            found = isfinite(o->spare->cost) || mhe_feasible_near(e, k, o, o->spare);
        }
        if (found) {
            mhe_take(k, o);
            mhe_search(e, k, o, -1, limit - o->qps);
        }
    }
    const int is_done =
        mhe_best_cost(o) < o->candidate->cost || mhe_enter_sets(e, k, o, nearest, before);
    o->outside = 0;
    (void)nearest; /* where nothing is restored, nobody asks for it */
    if (is_done) return;
    if (o->best != o->candidate) o->spare = o->best;
    o->best = o->candidate;
    if (mhe_is_late(k, o)) return;
    o->events &= ~OUTDATED;
    const real *w = mhe_candidate_disturbances(e, k);
    mhe_violation(e, o->candidate, w, 0, k->left_out);
    o->candidate->violation = mhe_violation(e, o->candidate, w, k->left_out, 0);
    mhe_search(e, k, o, start, limit > o->qps + 1 ? limit - o->qps : 1);
    memset(k->left_out, 0, sizeof k->left_out);
    if (o->best == o->candidate || !(mhe_violation(e, o->best, o->best->w, 0, k->left_out) > MHE_FEASIBLE))
        return;
    o->rows_dropped = 1;
    o->events |= MHE_ROWS_DROPPED;
}

/* The last QP's active set goes on from step to step. */
static void mhe_recall_places(const mhe_estimator *e, mhe_workspace *k)
{
    memcpy(k->rows.place, e->places, sizeof e->places);
    memset(k->left_out, 0, sizeof k->left_out);
}

static void mhe_keep_places(mhe_estimator *e, const mhe_workspace *k)
{
    memcpy(e->places, k->rows.place, sizeof e->places);
}
