/* A candidate outside of the sets that is restored into them, whatever that costs. */

@mhe_estimate
    /* As `dropped`: sides that the nearest trajectory to the candidate misses, where none is in the sets. */
    uint8_t missed[MHE_ROWS];
@mhe_workspace
    uint8_t missed[MHE_ROWS];
@

/* Approach the sets from a trial, by QPs in the metric of the Hessian, with shorter steps where a full
 * one does not lower the miss; the last trial on the way. */
static mhe_trial *mhe_approach(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o,
                               mhe_trial *around)
{
    static const real lengths[] = MHE_LENGTHS;
    const int count = (int)(sizeof lengths / sizeof *lengths);
    for (int i = 0; i < MHE_RESTORING && (around == o->candidate || !isfinite(around->cost)); i++) {
        mhe_trial *ahead = around == o->spare ? o->other : o->spare;
        int is_nearer = 0;
        if (!mhe_linearize(e, k, o, around) || mhe_is_late(k, o)) break;
        const int status = mhe_solve_qp(e, k, o, around, 1, 0);
        o->nearest_points++;
        if (status == FAILED) break;
        for (int j = 0; j < count && !is_nearer; j++) {
            const real length = j ? lengths[j] : 1;
            mhe_step_from(e, k, around, length, ahead);
            is_nearer = ahead->violation < (1 - MHE_TOWARDS * length) * around->violation;
        }
        if (!is_nearer) break;
        around = ahead;
    }
    return around;
}

/* Note the sides that a trial misses. */
static void mhe_note_missed(mhe_estimator *e, mhe_workspace *k, const mhe_outcome *o,
                            const mhe_trial *trial)
{
    const real *w = trial == o->candidate ? mhe_candidate_disturbances(e, k) : trial->w;
    memset(k->missed, 0, sizeof k->missed);
    mhe_violation(e, trial, w, 0, k->missed);
}

static void mhe_fill_missed(const mhe_workspace *k, const mhe_outcome *o, mhe_estimate *out)
{
    if (o->unreached)
        memcpy(out->missed, k->missed, sizeof out->missed);
    else
        memset(out->missed, 0, sizeof out->missed);
}

/* Improve the nearest feasible trajectory to the candidate; whether there is one. `nearest`: the cost of
 * that which the search has started from, infinite if there is none. */
static int mhe_enter_sets(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, real nearest, int before)
{
    const int left = e->settings->max_qps - o->qps;
    const real found = mhe_best_cost(o);
    mhe_trial *trial = o->candidate;
    if (!isfinite(nearest)) trial = mhe_approach(e, k, o, trial);
    if (trial == o->candidate || !isfinite(trial->cost)) {
        const real missed = trial->violation;
        mhe_note_missed(e, k, o, trial);
        trial = 0;
        if (!isfinite(nearest) && !isfinite(found) && before >= 0) {
            mhe_shift(e, k, o, before);
            trial = mhe_approach(e, k, o, o->spare);
            if (trial->violation < missed) mhe_note_missed(e, k, o, trial);
            if (!isfinite(trial->cost)) trial = 0;
        }
    }
    if (trial) nearest = trial->cost;
    if (!isfinite(nearest)) nearest = found;
    o->unreached = !isfinite(nearest);
    if (o->unreached) return 0;
    o->restored_cost = nearest;
    o->events |= MHE_RESTORED;
    if (nearest <= found) {
        if (trial == o->other) {
            o->other = o->spare;
            o->spare = trial;
        }
        if (trial) mhe_take(k, o);
        o->events &= ~OUTDATED;
        mhe_search(e, k, o, -1, left > 1 ? left : 1);
    }
    if (mhe_best_cost(o) < o->candidate->cost) {
        o->restored_cost = NAN;
        o->events &= ~MHE_RESTORED;
    }
    return 1;
}
