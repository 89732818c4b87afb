/* What a sample comes with in place of the usual: weights, sides of sets, sensors, a step's length. */

#if MHE_W_SET || MHE_V_SET || MHE_X_SET
/* A miss of a row counts as a share of its width, or of a standard deviation if that is less. */
static void mhe_set_scales(int count, const real *lower, const real *upper, const real *deviation,
                           real *scale)
{
    for (int i = 0; i < count; i++) {
        const real width = upper[i] - lower[i];
        scale[i] = width > 0 && width < deviation[i] ? width : deviation[i];
    }
}

/* The settings' set with the sides of another. */
#define TAKE_SIDES(own, set, n, count) do { \
        memcpy((own).rows, (set).rows, sizeof (own).rows); \
        memcpy((own).deviation, (set).deviation, sizeof (own).deviation); \
        memcpy((own).row_deviation, (set).row_deviation, sizeof (own).row_deviation); \
        memcpy((own).row_fixed, (set).row_fixed, sizeof (own).row_fixed); \
        mhe_set_scales(n, (own).lower, (own).upper, (own).deviation, (own).scale); \
        mhe_set_scales(count, (own).row_lower, (own).row_upper, (own).row_deviation, \
                       (own).row_scale); \
    } while (0)
#endif

/* Complete a stage's own sets, in which only the sides are known. */
static void mhe_complete_own_sets(const mhe_settings *s, mhe_stage *stage)
{
#if MHE_W_SET
    if (stage->has_own_w) TAKE_SIDES(stage->own_w, s->disturbances, NX, MHE_W_ROWS);
#endif
#if MHE_V_SET
    if (stage->has_own_v) TAKE_SIDES(stage->own_v, s->noises, NY, MHE_V_ROWS);
#endif
#if MHE_X_SET
    if (stage->has_own_x) TAKE_SIDES(stage->own_x, s->states, NX, MHE_X_ROWS);
#endif
    (void)s; (void)stage;
}

/* The sets that hold at a stage. */
#if MHE_W_SET
static const mhe_w_set *mhe_w_set_at(const mhe_settings *s, const mhe_stage *stage)
{
    return stage->has_own_w ? &stage->own_w : &s->disturbances;
}
#endif
#if MHE_V_SET
static const mhe_v_set *mhe_v_set_at(const mhe_settings *s, const mhe_stage *stage)
{
    return stage->has_own_v ? &stage->own_v : &s->noises;
}
#endif
#if MHE_X_SET
static const mhe_x_set *mhe_x_set_at(const mhe_settings *s, const mhe_stage *stage)
{
    return stage->has_own_x ? &stage->own_x : &s->states;
}
#endif

/* Take a sample's measurement and what it comes with. */
static void mhe_take_conditions(const mhe_settings *s, mhe_stage *stage, const mhe_sample *sample)
{
    stage->u[NU] = sample->step > 0 ? sample->step : s->sample_time;
    stage->is_irregular = sample->step > 0;
    stage->has_own_noise = sample->noise_weight != 0;
    if (stage->has_own_noise)
        memcpy(stage->own_noise_weight, sample->noise_weight, sizeof stage->own_noise_weight);
    stage->has_own_disturbance = sample->disturbance_weight != 0;
    if (stage->has_own_disturbance)
        memcpy(stage->own_disturbance_weight, sample->disturbance_weight,
               sizeof stage->own_disturbance_weight);
#if MHE_W_SET
    stage->has_own_w = sample->disturbances != 0;
    if (stage->has_own_w) stage->own_w = *sample->disturbances;
#endif
#if MHE_V_SET
    stage->has_own_v = sample->noises != 0;
    if (stage->has_own_v) stage->own_v = *sample->noises;
#endif
#if MHE_X_SET
    stage->has_own_x = sample->states != 0;
    if (stage->has_own_x) stage->own_x = *sample->states;
#endif
    mhe_complete_own_sets(s, stage);
    for (int j = 0; j < NY; j++) {
        const real y = sample->y[j];
        stage->y[j] = y;
        stage->is_sampled[j] = !sample->sampled || sample->sampled[j];
        stage->is_observed[j] =
            stage->is_sampled[j] && y < MHE_LARGEST && y > -MHE_LARGEST; /* false for NaN */
    }
}

/* Forget what a stage has in place of what changes. */
static void mhe_forget(mhe_stage *stage, int32_t changes)
{
    if (changes & MHE_NOISE_WEIGHT) stage->has_own_noise = 0;
    if (changes & MHE_DISTURBANCE_WEIGHT) stage->has_own_disturbance = 0;
    if (changes & MHE_DISTURBANCES) stage->has_own_w = 0;
    if (changes & MHE_NOISES) stage->has_own_v = 0;
    if (changes & MHE_STATES) stage->has_own_x = 0;
}

/* Whether a component that was sampled is missing. */
static int mhe_is_missing(const mhe_stage *stage)
{
    if (stage->is_complete) return 0;
    for (int j = 0; j < NY; j++)
        if (stage->is_sampled[j] && !stage->is_observed[j]) return 1;
    return 0;
}
