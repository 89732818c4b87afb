/* What a sample comes with in place of the usual: weights, sides of sets, sensors, a step's length. */

/* Complete a stage's own sets, in which only the sides are known. */
static void mhe_complete_own_sets(const mhe_settings *s, mhe_stage *stage)
{
    mhe_complete_own_w(s, stage);
    mhe_complete_own_v(s, stage);
    mhe_complete_own_x(s, stage);
}

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
    mhe_take_own_w(stage, sample);
    mhe_take_own_v(stage, sample);
    mhe_take_own_x(stage, sample);
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
