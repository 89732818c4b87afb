/* A constant gain, with the covariance of its error. */

/* The columns of a gain of the outputs that are there, as rows. */
static void mhe_seen_gain(const mhe_seen *seen, const real *gain, real *out)
{
    for (int i = 0; i < seen->count; i++)
        for (int j = 0; j < NX; j++) out[i * NX + j] = gain[j * NY + seen->at[i]];
}

/* L(z, v) = K v at stage i, and the covariance behind it. */
static int mhe_correction(mhe_estimator *e, int i, real *out)
{
    const mhe_settings *s = e->settings;
    const mhe_stage *stage = mhe_stage_at(e, i);
    real *following = mhe_next_covariance(e, i), gain[NY * NX], rows[NY * NX];
    mhe_seen seen;
    for (int j = 0; j < NX; j++) out[j] = mhe_dot(NY, s->observer.gain + j * NY, stage->v);
    mhe_see(s, stage, &seen);
    mhe_rows_of(&seen, s->observer.h_jacobian, rows);
    mhe_seen_gain(&seen, s->observer.gain, gain);
    mhe_propagate(stage->covariance, &seen, s->observer.f_jacobian, rows, gain, following);
    mhe_add_disturbance(s, stage, following);
    return 0;
}

/* Its estimate of x(t) that has used y(t), and its covariance if asked for. */
static void mhe_filter(const mhe_settings *s, const mhe_stage *stage, real *out, real *covariance)
{
    real gain[NY * NX], rows[NY * NX];
    mhe_seen seen;
    for (int j = 0; j < NX; j++)
        out[j] = stage->z[j] + mhe_dot(NY, s->observer.filter_gain + j * NY, stage->v);
    if (!covariance) return;
    mhe_see(s, stage, &seen);
    mhe_rows_of(&seen, s->observer.h_jacobian, rows);
    mhe_seen_gain(&seen, s->observer.filter_gain, gain);
    mhe_propagate(stage->covariance, &seen, 0, rows, gain, covariance);
}
