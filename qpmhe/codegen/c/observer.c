/* The observer: its correction, and its own measurement update. */

/* L(z, v) of a stage, from its residual v. */
static void mhe_correction(const mhe_settings *s, const mhe_stage *stage, real *out)
{
    for (int j = 0; j < NX; j++) out[j] = mhe_dot(NY, s->gain + j * NY, stage->v);
}

/* The observer's estimate of x(t) that has used y(t). */
static void mhe_filter(const mhe_settings *s, const mhe_stage *stage, real *out)
{
    for (int j = 0; j < NX; j++)
        out[j] = stage->z[j] + mhe_dot(NY, s->filter_gain + j * NY, stage->v);
}
