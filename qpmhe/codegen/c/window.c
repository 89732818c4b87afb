/* The window: samples, the observer along them, and what is computed once on each. */

static mhe_stage *mhe_stage_at(mhe_estimator *e, int i)
{
    const int k = e->first + i;
    return e->stages + (k < MHE_HORIZON ? k : k - MHE_HORIZON);
}

/* The observer behind stage i of the window: its state, and its covariance if it has one. */
static real *mhe_next_state(mhe_estimator *e, int i)
{
    return i + 1 < e->length ? mhe_stage_at(e, i + 1)->z : e->z_end;
}

static real *mhe_next_covariance(mhe_estimator *e, int i)
{
#if MHE_COVARIANCE
    return i + 1 < e->length ? mhe_stage_at(e, i + 1)->covariance : e->covariance_end;
#else
    (void)e; (void)i;
    return 0;
#endif
}

#if MHE_X_SET
/* The root of that covariance, where the observer has one. */
static const real *mhe_next_root(const mhe_estimator *e, int i)
{
#if MHE_ROOTS
    if (i + 1 >= e->length) return e->is_vague_end ? e->root_end : 0;
    const mhe_stage *behind = e->stages + (e->first + i + 1) % MHE_HORIZON;
    return behind->is_vague ? behind->root : 0;
#else
    (void)e; (void)i;
    return 0;
#endif
}
#endif

/* How often in a row each sensor has failed behind stage i. */
static int32_t *mhe_next_rejections(mhe_estimator *e, int i)
{
#if MHE_SENSORS
    return i + 1 < e->length ? mhe_stage_at(e, i + 1)->rejections : e->rejections_end;
#else
    (void)e; (void)i;
    return 0;
#endif
}

#if MHE_INNOVATION == MHE_GATED
/* Bits of the status: whether sensors, or all that are there, were rejected at a stage. */
static int mhe_rejection(const mhe_settings *s, const mhe_stage *stage, const int32_t *next)
{
    int any = 0, all = 1;
    for (int k = 0; k < MHE_SENSORS; k++) any |= next[k] > stage->rejections[k];
    for (int j = 0; j < NY; j++) {
        const int k = s->innovation.sensor_of[j];
        if (stage->is_observed[j] && !(next[k] > stage->rejections[k])) all = 0;
    }
    return any ? MHE_SENSORS_REJECTED | (all ? MHE_ALL_REJECTED : 0) : 0;
}
#endif

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

#if MHE_COVARIANCE
/* The least variance of a component given those before it, as a share of its variance; negative for
 * what is no covariance: not finite or, beyond rounding, not positive semidefinite. */
static real mhe_least_pivot(const real *P)
{
    const real least = sizeof(real) == 8 ? (real)1e-9 : (real)1e-4;
    real deviation[NX], root[NX * NX], found = INFINITY;
    if (!mhe_each_finite(NX * NX, P)) return -1;
    for (int j = 0; j < NX; j++) {
        const real variance = P[j * NX + j];
        if (!(variance >= 0)) return -1;
        deviation[j] = variance > 0 ? sqrt(variance) : 1;
    }
    for (int j = 0; j < NX; j++)
        for (int i = j; i < NX; i++) {
            real sum = i == j ? 1 + least : P[j * NX + i] / deviation[i] / deviation[j];
            for (int k = 0; k < j; k++) sum -= root[k * NX + j] * root[k * NX + i];
            if (i == j) {
                if (!(sum > 0)) return -1;
                if (sum < found) found = sum;
                root[j * NX + j] = sqrt(sum);
            } else
                root[j * NX + i] = sum / root[j * NX + j];
        }
    return found;
}
#endif

/* L(z, v) of a stage, and the observer's covariance behind it with its root and its sensors' counts. A
 * covariance that has lost digits is computed again by roots. Where it is lost all the same, the first one
 * takes its place, without a correction by it; a bit of the status says so. */
static int mhe_correct_observer(mhe_estimator *e, int i, real *out)
{
    const mhe_settings *s = e->settings;
    mhe_stage *stage = mhe_stage_at(e, i);
    real *following = mhe_next_covariance(e, i);
    int32_t *rejections = mhe_next_rejections(e, i);
#if MHE_ROOTS
    const int last = i + 1 == e->length;
    mhe_stage *behind = last ? 0 : mhe_stage_at(e, i + 1);
    real *next_root = last ? e->root_end : behind->root;
    int has_root = mhe_correction(s, stage, out, following, next_root, rejections);
    real found = mhe_least_pivot(following);
    if (found < MHE_VAGUE && !has_root) {
        mhe_root(NX, stage->covariance, stage->root);
        stage->is_vague = 1;
        has_root = mhe_correction(s, stage, out, following, next_root, rejections);
        found = mhe_least_pivot(following);
    }
    *(last ? &e->is_vague_end : &behind->is_vague) = has_root && found >= 0 && found < MHE_VAGUE;
#else
    mhe_correction(s, stage, out, following, 0, rejections);
#endif
#if MHE_COVARIANCE
#if !MHE_ROOTS
    const real found = mhe_least_pivot(following);
#endif
    if (!(found < 0)) return 0;
    memcpy(following, s->covariances.initial, sizeof s->covariances.initial);
#if MHE_SENSORS
    memset(rejections, 0, sizeof stage->rejections);
#endif
#if MHE_OBSERVER != MHE_GAIN
    for (int j = 0; j < NX; j++) out[j] = 0;
#endif
    return MHE_OBSERVER_RESET;
#else
    return 0;
#endif
}

/* Evaluate stage i at its z and step the observer to `next`, with all that goes with it, in X or, if
 * there is one, `onto`; the cost, or infinity. `events` gets bits of the status. */
static real mhe_advance(mhe_estimator *e, int i, int linear, real *next, const mhe_x_set *onto,
                        int *events)
{
    const mhe_settings *s = e->settings;
    mhe_stage *stage = mhe_stage_at(e, i);
    real *v = stage->v, *w = stage->w, predicted[NX], output[NY];
#if MHE_X_SET
    if (s->project && !e->metric_settled) linear = 1;
#endif
    if (linear) {
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
#if MHE_X_SET
    if (s->project) *events |= mhe_stay_inside(e, stage, onto, predicted, next,
                                               mhe_next_covariance(e, i), mhe_next_root(e, i));
#else
    (void)onto;
#endif
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
    const int linear = s->max_qps > 0, derived = linear || MHE_OBSERVER == MHE_EXTENDED;
    real *next = mhe_next_state(e, i), *following = mhe_next_covariance(e, i);
    int32_t *rejections = mhe_next_rejections(e, i);
    int events = 0;
    (void)following; (void)rejections; /* an observer may have neither */
    stage->cost = mhe_advance(e, i, derived, next, onto, &events);
    const int held = !isfinite(stage->cost);
    if (held) {
        events &= ~MHE_OBSERVER_RESET;
        /* z(i) is where the model does not work: go on where it last did. */
        int good = i - 1;
        while (good >= 0 && !isfinite(mhe_stage_at(e, good)->cost)) good--;
        memcpy(next, good >= 0 ? mhe_stage_at(e, good)->z : e->last_good,
               sizeof e->last_good);
#if MHE_COVARIANCE
        memcpy(following, good >= 0 ? mhe_stage_at(e, good)->covariance : e->last_good_covariance,
               sizeof e->last_good_covariance);
#endif
#if MHE_ROOTS
        *(i + 1 < e->length ? &mhe_stage_at(e, i + 1)->is_vague : &e->is_vague_end) = 0;
#endif
#if MHE_SENSORS
        memcpy(rejections, stage->rejections, sizeof stage->rejections);
#endif
        memset(stage->w, 0, sizeof stage->w);
        memset(stage->v, 0, sizeof stage->v);
    }
#if MHE_INNOVATION == MHE_GATED
    events |= mhe_rejection(s, stage, rejections);
#endif
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

#if MHE_X_SET
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
        mhe_put_inside(e, &set, mhe_next_covariance(e, e->length - 1),
                       mhe_next_root(e, e->length - 1), e->z_end);
        return 0;
    }
    const int events = mhe_enter(e, e->length - 1, &set);
    return events & (MHE_OBSERVER_PROJECTED | MHE_PREDICTION_OUTSIDE | MHE_METRIC_SINGULAR |
                     MHE_DERIVATIVE_NEARBY);
}
#endif

/* Take a sample in; bits of the status. */
static int mhe_push(mhe_estimator *e, const mhe_sample *sample)
{
    const mhe_settings *s = e->settings;
    int events = 0;
#if MHE_X_SET
    events = mhe_move_state(e, sample);
#endif
    if (e->length == MHE_HORIZON) {
        const mhe_stage *leaving = mhe_stage_at(e, 0);
        if (isfinite(leaving->cost)) {
            memcpy(e->last_good, leaving->z, sizeof e->last_good);
#if MHE_COVARIANCE
            memcpy(e->last_good_covariance, leaving->covariance, sizeof leaving->covariance);
#endif
        }
        e->first = e->first + 1 < MHE_HORIZON ? e->first + 1 : 0;
    } else {
        e->length++;
    }
    mhe_stage *stage = mhe_stage_at(e, e->length - 1);
    memcpy(stage->z, e->z_end, sizeof stage->z);
    memcpy(stage->history, e->history_end, sizeof stage->history);
#if MHE_COVARIANCE
    memcpy(stage->covariance, e->covariance_end, sizeof stage->covariance);
#endif
#if MHE_ROOTS
    if (e->is_vague_end) memcpy(stage->root, e->root_end, sizeof stage->root);
    stage->is_vague = e->is_vague_end;
#endif
#if MHE_SENSORS
    memcpy(stage->rejections, e->rejections_end, sizeof stage->rejections);
#endif
    for (int j = 0; j < NU; j++) stage->u[j] = sample->u[j];
    mhe_take_conditions(s, stage, sample);
    mhe_set_noise_weight(s, stage);
    events |= mhe_enter(e, e->length - 1, 0);
    e->time++;
    return events;
}
