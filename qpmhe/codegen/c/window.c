/* The window: samples, the observer along them, and what is computed once on each. */

/* Take the rows that are not finite from another Jacobian; whether it is finite then. */
static int mhe_fill_rows(int count, real *jacobian, const real *other)
{
    for (int r = 0; r < count; r++)
        if (!mhe_all_finite(NX, jacobian + r * NX))
            memcpy(jacobian + r * NX, other + r * NX, sizeof(real) * NX);
    return mhe_all_finite(count * NX, jacobian);
}

/* f and h at a state, and their Jacobians: rows that are not finite from a small step inside the
 * bounds of X, and rows that are not finite there from a tiny step aside; a bit of the status where
 * that helps. */
static int mhe_linear(const mhe_settings *s, const real *x, const mhe_stage *stage, real *next,
                       real *output, mhe_terms *t)
{
    mhe_f_jacobian(x, stage->u, stage->u[NU], next, t->f_jacobian);
    mhe_h_jacobian(x, stage->u, output, t->h_jacobian);
    int helped = 0;
    for (int aside = !MHE_X_SET; aside < 2; aside++) {
        const int f = mhe_all_finite(NX * NX, t->f_jacobian);
        const int h = mhe_all_finite(NY * NX, t->h_jacobian);
        if (f && h) break;
        real at[NX], unused[NX + NY], f_there[NX * NX], h_there[NY * NX];
        for (int j = 0; j < NX; j++) {
            const real moved = aside ? x[j] + s->aside[j] : x[j];
            const real above = mhe_max(s->inner_lower[j], moved);
            at[j] = above < s->inner_upper[j] ? above : s->inner_upper[j];
        }
        if (!f) {
            mhe_f_jacobian(at, stage->u, stage->u[NU], unused, f_there);
            helped |= mhe_fill_rows(NX, t->f_jacobian, f_there);
        }
        if (!h) {
            mhe_h_jacobian(at, stage->u, unused, h_there);
            helped |= mhe_fill_rows(NY, t->h_jacobian, h_there);
        }
    }
    return helped ? MHE_DERIVATIVE_NEARBY : 0;
}

/* Evaluate stage i at its z and step the observer to `next`, with all that goes with it, in X or, if
 * there is one, `onto`; the cost, or infinity. `events` gets bits of the status. */
static real mhe_advance(mhe_estimator *e, int i, int linear, real *next, const mhe_x_set *onto,
                        int *events)
{
    const mhe_settings *s = e->settings;
    mhe_stage *stage = mhe_stage_at(e, i);
    real *v = stage->v, *w = stage->w, predicted[NX], output[NY];
    if (linear || mhe_needs_slope(e)) {
        *events |= mhe_linear(s, stage->z, stage, predicted, output, &stage->terms);
    } else {
        mhe_f(stage->z, stage->u, stage->u[NU], predicted);
        mhe_h(stage->z, stage->u, output);
    }
    for (int j = 0; j < NY; j++) v[j] = stage->y[j] - output[j];
    mhe_wrap_output(s, stage->y, v);
    for (int j = 0; j < NY; j++)
        if (!stage->is_observed[j]) v[j] = 0;
    *events |= mhe_correct_observer(e, i, w);
    for (int j = 0; j < NX; j++) next[j] = predicted[j] + w[j];
    mhe_wrap_state(s, next, w);
    mhe_enter_turn(s, next);
    mhe_enter_turn(s, predicted);
    if (!mhe_all_finite(NX, next)) return INFINITY;
    *events |= mhe_stay_inside(e, i, onto, predicted, next);
    (void)onto; /* without X there is nothing to go onto */
    const real cost = mhe_stage_cost(s, 0, stage, w, v);
    return isfinite(cost) ? cost : INFINITY;
}

/* Set a stage's terms from its residuals and Jacobians; whether the model had finite ones. */
static int mhe_enter_terms(const mhe_settings *s, mhe_stage *stage)
{
    mhe_terms *t = &stage->terms;
    const int finite = isfinite(stage->cost) && mhe_all_finite(NX * NX, t->f_jacobian) &&
                       mhe_all_finite(NY * NX, t->h_jacobian);
    if (!finite) {
        memset(t->f_jacobian, 0, sizeof t->f_jacobian);
        memset(t->h_jacobian, 0, sizeof t->h_jacobian);
        for (int j = 0; j < NX; j++) t->f_jacobian[j * NX + j] = 1;
    }
    mhe_set_terms(s, 0, stage, stage->w, stage->v, t);
    return finite;
}

/* Compute stage i of the window from z(i) and its sample; bits of the status: MODEL_FAILED where the
 * model has no finite values (held) or only no finite Jacobians. The observer goes on in X, or in
 * `onto` if there is one. */
static int mhe_enter(mhe_estimator *e, int i, const mhe_x_set *onto)
{
    const mhe_settings *s = e->settings;
    mhe_stage *stage = mhe_stage_at(e, i);
    const int linear = s->max_qps > 0, derived = linear || MHE_NEEDS_JACOBIANS;
    real *next = mhe_next_z(e, i);
    int events = 0;
    stage->cost = mhe_advance(e, i, derived, next, onto, &events);
    const int held = !isfinite(stage->cost);
    if (held) {
        events &= ~MHE_OBSERVER_RESET;
        /* z(i) is where the model does not work: go on where it last did. */
        int good = i - 1;
        while (good >= 0 && !isfinite(mhe_stage_at(e, good)->cost)) good--;
        memcpy(next, good >= 0 ? mhe_stage_at(e, good)->z : e->last_good,
               sizeof e->last_good);
        mhe_hold_observer(e, i, good);
        memset(stage->w, 0, sizeof stage->w);
        memset(stage->v, 0, sizeof stage->v);
    }
    events |= mhe_rejection(e, i);
    const int failed = linear ? !mhe_enter_terms(s, stage) : held;
    return failed ? events | MHE_MODEL_FAILED : events;
}

/* Redo all stages from i on; bits of the status: of the last one, and whether a derivative of any was
 * taken nearby. */
static int mhe_replay(mhe_estimator *e, int i)
{
    int events = 0;
    for (; i < e->length; i++) events = (events & MHE_DERIVATIVE_NEARBY) | mhe_enter(e, i, 0);
    return events;
}

/* Take a sample in; bits of the status. */
static int mhe_push(mhe_estimator *e, const mhe_sample *sample)
{
    const mhe_settings *s = e->settings;
    int events = mhe_move_state(e, sample);
    if (e->length == MHE_HORIZON) {
        const mhe_stage *leaving = mhe_stage_at(e, 0);
        if (isfinite(leaving->cost)) {
            memcpy(e->last_good, leaving->z, sizeof e->last_good);
            mhe_keep_good(e, leaving);
        }
        e->first = e->first + 1 < MHE_HORIZON ? e->first + 1 : 0;
    } else {
        e->length++;
    }
    mhe_stage *stage = mhe_stage_at(e, e->length - 1);
    mhe_begin_stage(e, stage);
    for (int j = 0; j < NU; j++) stage->u[j] = sample->u[j];
    mhe_take_conditions(s, stage, sample);
    mhe_set_noise_weight(s, stage);
    events |= mhe_enter(e, e->length - 1, 0);
    e->time++;
    return events;
}
