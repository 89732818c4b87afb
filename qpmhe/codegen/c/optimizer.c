/* The sequence of QPs; only what the true cost approves is accepted. */

/* The share of a damping that is left after a step that has lowered the cost. */
static real mhe_damping_left(real lowered, real promised)
{
    const real share = promised > 0 ? lowered / promised : 1;
    const real missed = 2 * (share < 1 ? share : 1) - 1;
    return mhe_max(MHE_LESS_DAMPING, 1 - missed * missed * missed);
}

/* Solve one QP and take its step; whether another QP is worth while. Where its step has not lowered
 * the cost, that is one around the same trajectory, with more damping. */
static int mhe_improve_once(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    const int is_damped = o->present > 0;
    /* Second-order corrections and searches for feasible points overwrite a QP with rows. */
    if ((!is_damped || CONSTRAINED) && !mhe_linearize(e, k, o, o->best)) {
        o->events |= MHE_MODEL_FAILED;
        return 0;
    }
    mhe_set_bends(e, k, o->best);
    if (is_damped && !o->has_seen) {
        mhe_set_seen(e, k);
        o->has_seen = 1;
    }
    const int status = mhe_solve_qp(e, k, o, o->best, 0, 0), solved = status == SOLVED;
    o->qps++;
    if (status == FAILED) {
        o->events |= MHE_SOLVER_FAILED;
        return 0;
    }
    o->unsolved = solved ? 0 : o->unsolved + 1;
    if (!solved) o->events |= MHE_SOLVER_STOPPED;
    const real before = mhe_best_cost(o), target = mhe_target(o);
    /* Where the cost is infinite, no decrease is negligible. */
    const real negligible = isfinite(before) ? e->settings->tolerance * before : -1;
    const real promised = mhe_promised(e, k, o);
    const int useless = solved && promised <= negligible;
    mhe_lower(e, k, o, promised, useless);
    if (o->spare->cost < target) {
        const real lowered = before - o->spare->cost;
        if (!useless && !is_damped) mhe_follow_region(e, k, o, lowered);
        mhe_take(k, o);
        if (is_damped) {
            o->damping = o->present * mhe_damping_left(lowered, promised);
            o->present = 0;
            o->growth = MHE_MORE_DAMPING;
            o->has_seen = 0;
            mhe_forget_region(k, o);
            return 1;
        }
        o->damping *= MHE_OLD_DAMPING;
        if (solved && lowered <= negligible && !o->is_shortened) {
            o->events |= MHE_CONVERGED;
            return 0;
        }
        if (!e->settings->patience || o->unsolved < e->settings->patience) return 1;
        o->events |= MHE_UNCONVERGED;
        return 0;
    }
    mhe_note_trial(e, k, o->spare);
    const real rounding = isfinite(before) ? mhe_rounding_cost(e, k, o->best) : -1;
    if (!is_damped && solved && promised <= mhe_max(rounding, MHE_STALLED * negligible)) {
        o->events |= MHE_CONVERGED;
        return 0;
    }
    /* Rounding hides a decrease this small, and more damping promises less. */
    if (!isfinite(before) || o->present > MHE_MOST_DAMPING ||
        ((solved || is_damped) && !(promised > mhe_max(rounding, MHE_ROUNDING * before)))) {
        o->events |= MHE_NO_DECREASE;
        o->damping = 0;
        return 0;
    }
    if (is_damped) {
        o->damping = o->growth * o->present;
        o->growth *= 2;
    }
    o->present = mhe_max(MHE_DAMPING, o->damping);
    return 1;
}

/* Make the spare trial the previous estimate, moved on by one step of the model. `before`: stages
 * of the window that it belongs to. */
static void mhe_shift(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before)
{
    const int count = e->length, skipped = before + 2 - (count + 1);
    mhe_stage *last = mhe_stage_at(e, count - 1);
    real *x = o->spare->x;
    memcpy(x, e->trajectory + skipped * NX, sizeof(real) * (size_t)count * NX);
    mhe_f(x + (count - 1) * NX, last->u, last->u[NU], x + count * NX);
    mhe_clip_trial(e, k, o->spare);
    mhe_evaluate(e, k, o->spare);
}

/* At most so many QPs, each around the best trajectory so far. `before`: as for the shift, -1 not
 * to start there. */
static void mhe_descend(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int before, int limit)
{
    if (before >= 0) {
        mhe_shift(e, k, o, before);
        if (o->spare->cost < mhe_target(o)) mhe_take(k, o);
    }
    o->unsolved = 0;
    o->events &= ~MHE_UNCONVERGED;
    o->present = 0;
    o->growth = MHE_MORE_DAMPING;
    o->has_seen = 0;
    mhe_forget_region(k, o);
    int is_open = 1;
    while (is_open && limit-- > 0) is_open = !mhe_is_late(k, o) && mhe_improve_once(e, k, o);
    if (is_open && o->present > 0 && !e->settings->uncapped) o->events |= MHE_CAP_REACHED;
    o->present = 0;
}
