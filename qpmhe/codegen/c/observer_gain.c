/* An observer with a constant gain. */

/* L(z, v) = K v at stage i. */
static int mhe_correction(mhe_estimator *e, int i, real *out)
{
    const real *gain = e->settings->observer.gain, *v = mhe_stage_at(e, i)->v;
    for (int j = 0; j < NX; j++) out[j] = mhe_dot(NY, gain + j * NY, v);
    return 0;
}

/* Its estimate of x(t) that has used y(t). */
static void mhe_filter(const mhe_settings *s, const mhe_stage *stage, real *out, real *covariance)
{
    for (int j = 0; j < NX; j++)
        out[j] = stage->z[j] + mhe_dot(NY, s->observer.filter_gain + j * NY, stage->v);
    (void)covariance;
}

/* The slope of L(z, v) at v = 0. */
static void mhe_correction_slope(const mhe_settings *s, const mhe_stage *stage, real *slope)
{
    memcpy(slope, s->observer.gain, sizeof s->observer.gain);
    (void)stage;
}
