/* An observer whose correction is a function of its state and the fitting error. */

/* L(z, v) at stage i. */
static int mhe_correction(mhe_estimator *e, int i, real *out)
{
    const mhe_stage *stage = mhe_stage_at(e, i);
    mhe_call_correction(stage->z, stage->v, out);
    return 0;
}

/* It has no estimate of x(t) that has used y(t). */
static void mhe_filter(const mhe_settings *s, const mhe_stage *stage, real *out, real *covariance)
{
    memcpy(out, stage->z, sizeof stage->z);
    (void)s; (void)covariance;
}

/* The slope of L(z, v) at v = 0, by steps of the noise's deviations. */
static void mhe_correction_slope(const mhe_settings *s, const mhe_stage *stage, real *slope)
{
    for (int j = 0; j < NY; j++) {
        real v[NY] = {0}, value[NX];
        v[j] = s->noise_deviations[j];
        mhe_call_correction(stage->z, v, value);
        for (int i = 0; i < NX; i++) slope[i * NY + j] = value[i] / v[j];
    }
}
