/* The observer stays in X. */

/* X of the state behind a stage: that of the next sample, if it has come. */
static const mhe_x_set *mhe_x_set_behind(const mhe_estimator *e, const mhe_stage *stage)
{
    const int at = (int)(stage - e->stages), newest = (e->first + e->length - 1) % MHE_HORIZON;
    return mhe_x_set_at(e->settings, e->stages + (at == newest ? at : (at + 1) % MHE_HORIZON));
}

/* Keep the observer's next state behind stage i in X, or in another set; bits of the status. */
static int mhe_stay_inside(mhe_estimator *e, int i, const mhe_x_set *onto, const real *predicted,
                           real *next)
{
    const mhe_settings *s = e->settings;
    mhe_stage *stage = mhe_stage_at(e, i);
    if (!s->project) return 0;
    const mhe_x_set *set = onto ? onto : mhe_x_set_behind(e, stage);
    mhe_settle_metric(e, stage);
    if (mhe_is_inside(set, next)) return 0;
    real other[NX * NX];
    const real *P = mhe_metric_taken(e, mhe_metric(e, i), other);
    const int events = mhe_keep_inside(set, P, predicted, next, stage->w);
    mhe_wrap_state(s, next, stage->w);
    return events;
}

static int mhe_has_sides_of(const mhe_x_set *one, const mhe_x_set *other)
{
    int same = 1;
    for (int j = 0; j < NX; j++)
        same &= one->lower[j] == other->lower[j] && one->upper[j] == other->upper[j];
    for (int r = 0; r < MHE_X_ROWS; r++)
        same &= one->row_lower[r] == other->row_lower[r] && one->row_upper[r] == other->row_upper[r];
    return same;
}

/* Compute stage i again. */
static int mhe_enter(mhe_estimator *e, int i, const mhe_x_set *onto);

/* Put z(t) into the X that comes with its sample, where it is another than that of the last sample; bits
 * of the status. */
static int mhe_move_state(mhe_estimator *e, const mhe_sample *sample)
{
    const mhe_settings *s = e->settings;
    mhe_stage *newest = e->length ? mhe_stage_at(e, e->length - 1) : 0;
    const mhe_x_set *before = newest ? mhe_x_set_at(s, newest) : &s->states;
    const mhe_x_set *after = sample->states ? sample->states : &s->states;
    if (!s->project || mhe_has_sides_of(before, after)) return 0;
    mhe_x_set set = *after;
    TAKE_SIDES(set, s->states, NX, MHE_X_ROWS);
    if (!newest || !isfinite(newest->cost)) {
        mhe_put_inside(e, &set, mhe_metric(e, e->length - 1), e->z_end);
        return 0;
    }
    const int events = mhe_enter(e, e->length - 1, &set);
    return events & (MHE_OBSERVER_PROJECTED | MHE_PREDICTION_OUTSIDE | MHE_METRIC_SINGULAR |
                     MHE_DERIVATIVE_NEARBY);
}

/* Put the state before the first sample into X. */
static void mhe_start_inside(mhe_estimator *e)
{
    const mhe_settings *s = e->settings;
    real inside[NX];
    memcpy(e->metric, s->metric, sizeof e->metric);
    e->metric_settled = s->metric_settled;
    if (mhe_is_inside(&s->states, e->z_end)) return;
    mhe_project(&s->states, s->metric, e->z_end, inside);
    memcpy(e->z_end, inside, sizeof inside);
}

/* Put the window's first state, or the only one there is, into X. */
static void mhe_put_first_inside(mhe_estimator *e)
{
    const mhe_settings *s = e->settings;
    mhe_put_inside(e, e->length ? mhe_x_set_at(s, mhe_stage_at(e, 0)) : &s->states,
                   mhe_metric(e, -1), mhe_next_z(e, -1));
    if (!e->length) memcpy(e->history_end, e->z_end, sizeof e->z_end);
}
