/* A gate: sensors that fail are rejected. */

/* Let the outputs count by the tests of their sensors; P, its root and the spread, P's, have grown where
 * some are due. */
static void mhe_apply_tests(const mhe_settings *s, mhe_seen *seen, const mhe_sensors *sensors,
                            const real *spread, int32_t *next)
{
    const int count = seen->count;
    real noise[NY * NY];
    memcpy(noise, seen->noise, sizeof(real) * (size_t)(count * count));
    int kept = 0, from[NY];
    for (int i = 0; i < count; i++) {
        const int k = s->innovation.sensor_of[seen->at[i]];
        if (sensors->due[k]) next[k] = 0;
        if (sensors->passes[k] || sensors->due[k]) from[kept++] = i;
    }
    seen->count = kept;
    for (int i = 0; i < kept; i++) {
        seen->at[i] = seen->at[from[i]];
        seen->v[i] = seen->v[from[i]];
        for (int j = 0; j < kept; j++) seen->noise[i * kept + j] = noise[from[i] * count + from[j]];
    }
    (void)spread;
}

/* Bits of the status: whether sensors, or all that are there, were rejected at stage i. */
static int mhe_rejection(mhe_estimator *e, int i)
{
    const mhe_settings *s = e->settings;
    const mhe_stage *stage = mhe_stage_at(e, i);
    const int32_t *next = mhe_next_rejections(e, i);
    int any = 0, all = 1;
    for (int k = 0; k < MHE_SENSORS; k++) any |= next[k] > stage->rejections[k];
    for (int j = 0; j < NY; j++) {
        const int k = s->innovation.sensor_of[j];
        if (stage->is_observed[j] && !(next[k] > stage->rejections[k])) all = 0;
    }
    return any ? MHE_SENSORS_REJECTED | (all ? MHE_ALL_REJECTED : 0) : 0;
}
