/* What the caller sees. */

/* Count consecutive samples in which the observer was far from the estimate, or rows dropped. */
static void mhe_watch(mhe_estimator *e, const mhe_workspace *k, mhe_outcome *o)
{
    real offset[NX];
    for (int j = 0; j < NX; j++)
        offset[j] = o->best->x[e->length * NX + j] - o->candidate->x[e->length * NX + j];
    mhe_wrap_state(e->settings, o->best->x + e->length * NX, offset);
    const int far = mhe_prior_distance(&k->prior, offset) > MHE_FAR * MHE_FAR;
    const int counted[] = {far, o->rows_dropped};
    for (int i = 0; i < 2; i++)
        e->watched[i] = counted[i] ? e->watched[i] + (e->watched[i] < INT32_MAX) : 0;
    if (e->watched[0] >= MHE_HORIZON) o->events |= MHE_OBSERVER_FAR;
}

/* Estimate on the window as it stands, and keep what the next step needs. */
static void mhe_estimate_now(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, int events,
                             int before)
{
    const mhe_stage *newest = mhe_stage_at(e, e->length - 1);
    const size_t size = sizeof(real) * (size_t)(e->length + 1) * NX;
    mhe_improve(e, k, o, before);
    if (mhe_is_missing(newest)) o->events |= MHE_MISSING;
    o->events |= events;
    if (!mhe_has_values(e, o->candidate)) o->events |= MHE_MODEL_FAILED;
    if (!isfinite(o->candidate->cost)) {
        o->events &= ~MHE_NO_DECREASE; /* the model failed, not the solver */
        if (!(o->events & MHE_MODEL_FAILED)) o->events |= MHE_FAILED_STAGE;
    }
    mhe_watch(e, k, o);
    memcpy(e->trajectory, mhe_next_start(k, o), size);
    mhe_trust(e, k, o->best != o->candidate ? o->best->x : 0);
    e->has_trajectory = 1;
    if (!isfinite(newest->cost) && o->best != o->candidate)
        memcpy(e->z_end, o->best->x + e->length * NX, sizeof e->z_end);
}

/* The estimate of x(t) that has used y(t): of a kept candidate, the observer's own. */
static void mhe_filtered(mhe_estimator *e, const mhe_outcome *o, real *out)
{
    const mhe_stage *newest = mhe_stage_at(e, e->length - 1);
    if (o->best == o->candidate) {
        mhe_filter_inside(e, newest, out);
    } else
        memcpy(out, o->best->x + (e->length - 1) * NX, sizeof(real) * NX);
}

static void mhe_step(mhe_estimator *e, mhe_workspace *k, const mhe_sample *sample,
                     mhe_outcome *o)
{
    const int before = e->has_trajectory ? e->length : -1;
    mhe_begin(e, k);
    if (e->settings->smooth && e->has_trajectory && e->length == MHE_HORIZON) {
        memcpy(e->smoothed_prior, e->trajectory + NX, sizeof e->smoothed_prior);
        e->has_smoothed_prior = 1;
    }
    mhe_trust_on(e);
    if (before == MHE_HORIZON) mhe_shift_places(e);
    int events = mhe_push(e, sample);
    if (e->settings->reinitialize) {
        mhe_stage *oldest = mhe_stage_at(e, 0);
        memcpy(oldest->z, oldest->history, sizeof oldest->z);
        mhe_put_first_inside(e); /* that estimate was made before its sample brought an X */
        events = (events & MHE_DERIVATIVE_NEARBY) | mhe_replay(e, 0);
    }
    mhe_challenge(e, k, &events);
    mhe_estimate_now(e, k, o, events, before);
    memcpy(e->history_end, o->best->x + e->length * NX, sizeof e->history_end);
}

static void mhe_fill(mhe_estimator *e, const mhe_workspace *k, const mhe_outcome *o,
                     mhe_estimate *out)
{
    const int count = e->length;
    const mhe_trial *best = o->best;
    const size_t states = sizeof(real) * (size_t)(count + 1) * NX;
    memcpy(out->trajectory, best->x, states);
    memcpy(out->candidate, o->candidate->x, states);
    memcpy(out->disturbances, best->w, sizeof(real) * (size_t)count * NX);
    memcpy(out->noises, best->v, sizeof(real) * (size_t)count * NY);
    for (int i = 0; i < count; i++) {
        const mhe_stage *stage = mhe_stage_at(e, i);
        if (stage->is_complete) continue;
        for (int j = 0; j < NY; j++)
            if (!stage->is_observed[j]) out->noises[i * NY + j] = NAN;
    }
    out->cost = best->cost;
    out->candidate_cost = o->candidate->cost;
    out->restored_cost = o->restored_cost;
    out->time = e->time - 1;
    out->length = count;
    out->status = o->events;
    out->qps = o->qps;
    out->iterations = o->iterations;
    out->corrections = o->corrections;
    out->nearest_points = o->nearest_points;
    memcpy(out->observer_state, e->z_end, sizeof e->z_end);
    mhe_filtered(e, o, out->filtered);
    mhe_fill_sensors(e, out);
    mhe_fill_dropped(k, o->rows_dropped, out);
    mhe_fill_missed(k, o, out);
    mhe_fill_trial_failed(k, out);
    (void)k;
}

void mhe_reset(mhe_estimator *e, const mhe_settings *settings, const real *x0)
{
    memset(e, 0, sizeof *e);
    e->settings = settings;
    memcpy(e->z_end, x0, sizeof e->z_end);
    mhe_enter_turn(settings, e->z_end);
    mhe_start_inside(e);
    memcpy(e->last_good, e->z_end, sizeof e->last_good);
    memcpy(e->history_end, e->z_end, sizeof e->z_end);
    mhe_trust_start(e);
    mhe_start_observer(e);
}

static mhe_sample mhe_usual_sample(const real *y, const real *u)
{
    mhe_sample sample = {0};
    sample.y = y;
    sample.u = u;
    return sample;
}

void mhe_update_special(mhe_estimator *e, mhe_workspace *k, const mhe_sample *sample,
                        mhe_estimate *out)
{
    mhe_outcome outcome;
    mhe_step(e, k, sample, &outcome);
    mhe_fill(e, k, &outcome, out);
}

void mhe_update(mhe_estimator *e, mhe_workspace *k, const real *y, const real *u,
                mhe_estimate *out)
{
    const mhe_sample sample = mhe_usual_sample(y, u);
    mhe_update_special(e, k, &sample, out);
}

/* Copy what a step changes: the stage that the new sample overwrites, and all that is not a stage.
 * Only an observer that is re-initialised, or may be restarted, goes through the other stages again, and
 * one that comes into another X through the newest. */
static void mhe_keep(mhe_estimator *to, const mhe_estimator *from, int overwritten)
{
    if (MHE_X_SET) {
        const int newest = (overwritten + MHE_HORIZON - 1) % MHE_HORIZON;
        to->stages[newest] = from->stages[newest];
    }
    memcpy(to, from, offsetof(mhe_estimator, stages));
    if (from->settings->reinitialize || mhe_is_due(from))
        memcpy(to->stages, from->stages, sizeof to->stages);
    else
        to->stages[overwritten] = from->stages[overwritten];
}

void mhe_update_undoable(mhe_estimator *e, mhe_estimator *before, mhe_workspace *k,
                         const mhe_sample *sample, mhe_estimate *out)
{
    mhe_keep(before, e, (e->first + e->length) % MHE_HORIZON);
    mhe_update_special(e, k, sample, out);
}

void mhe_undo(mhe_estimator *e, const mhe_estimator *before)
{
    mhe_keep(e, before, (before->first + before->length) % MHE_HORIZON);
}

void mhe_update_members(mhe_estimator *estimators, int64_t members, mhe_workspace *k,
                        const real *y, const real *u, mhe_estimate *estimates)
{
    for (int64_t i = 0; i < members; i++)
        mhe_update(estimators + i, k, y + i * NY, NU ? u + i * NU : 0, estimates + i);
}

/* Estimate the same state again, of samples that have changed. */
static void mhe_estimate_again(mhe_estimator *e, mhe_workspace *k, int failed, mhe_estimate *out)
{
    mhe_outcome outcome;
    int32_t watched[2];
    memcpy(watched, e->watched, sizeof watched);
    /* The kept trajectory does not belong to the window before this one. */
    mhe_estimate_now(e, k, &outcome, failed, -1);
    memcpy(e->watched, watched, sizeof watched); /* no sample more */
    memcpy(e->history_end, outcome.best->x + e->length * NX, sizeof e->history_end);
    mhe_fill(e, k, &outcome, out);
}

int mhe_amend(mhe_estimator *e, mhe_workspace *k, int64_t time, const real *y,
              mhe_estimate *out)
{
    const int64_t age = e->time - time;
    if (age < 1 || age > e->length) return -1;
    mhe_begin(e, k);
    const int i = e->length - (int)age;
    mhe_stage *stage = mhe_stage_at(e, i);
    for (int j = 0; j < NY; j++)
        if (y[j] < MHE_LARGEST && y[j] > -MHE_LARGEST) {
            stage->y[j] = y[j];
            stage->is_observed[j] = 1;
        }
    mhe_set_noise_weight(e->settings, stage);
    mhe_estimate_again(e, k, mhe_replay(e, i), out);
    return 0;
}

void mhe_set(mhe_estimator *e, mhe_workspace *k, const mhe_settings *settings, int32_t changes,
             const real *parameters, int32_t count, mhe_estimate *out)
{
    e->settings = settings;
    mhe_begin(e, k);
    for (int i = 0; i < e->length; i++) {
        mhe_stage *stage = mhe_stage_at(e, i);
        mhe_forget(stage, changes);
        for (int j = 0; j < NU; j++)
            if (parameters && j >= NU - count) stage->u[j] = parameters[j - (NU - count)];
        mhe_set_noise_weight(settings, stage);
        mhe_complete_own_sets(settings, stage);
    }
    mhe_put_first_inside(e);
    if (e->length) mhe_estimate_again(e, k, mhe_replay(e, 0), out);
}

void mhe_run(mhe_estimator *estimators, int64_t members, mhe_workspace *k, int64_t samples,
             const real *y, const real *u, const mhe_log *log)
{
    int64_t at = 0;
    for (int64_t member = 0; member < members; member++) {
        mhe_estimator *e = estimators + member;
        for (int64_t t = 0; t < samples; t++, at++) {
            mhe_outcome o;
            const mhe_sample sample = mhe_usual_sample(y + at * NY, u ? u + at * NU : 0);
            mhe_step(e, k, &sample, &o);
            if (log->states)
                memcpy(log->states + at * NX, o.best->x + e->length * NX, NX * sizeof(real));
            if (log->observer_states)
                memcpy(log->observer_states + at * NX, e->z_end, sizeof e->z_end);
            if (log->filtered) mhe_filtered(e, &o, log->filtered + at * NX);
            if (log->costs) log->costs[at] = o.best->cost;
            if (log->candidate_costs) log->candidate_costs[at] = o.candidate->cost;
            if (log->status) log->status[at] = o.events;
            if (log->qps) log->qps[at] = o.qps;
            if (log->iterations) log->iterations[at] = o.iterations;
            mhe_log_sensors(e, log, at);
        }
    }
}

void mhe_recompute(mhe_estimator *e)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < e->length; i++) {
        mhe_stage *stage = mhe_stage_at(e, i);
        real next[NX], output[NY];
        mhe_linear(s, stage->z, stage, next, output, &stage->terms);
        mhe_enter_terms(s, stage);
    }
}

void mhe_sizes(int64_t *sizes)
{
    sizes[0] = (int64_t)sizeof(mhe_estimator);
    sizes[1] = (int64_t)sizeof(mhe_workspace);
    sizes[2] = (int64_t)sizeof(mhe_estimate);
    sizes[3] = (int64_t)sizeof(mhe_settings);
    sizes[4] = (int64_t)sizeof(mhe_sample);
}
