/* Huber's weights: innovations beyond a threshold count less. */

/* Let the outputs count by the tests of their sensors; P, its root and the spread, P's, have grown where
 * some are due. */
static void mhe_apply_tests(const mhe_settings *s, mhe_seen *seen, const mhe_sensors *sensors,
                            const real *spread, int32_t *next)
{
    for (int i = 0; i < seen->count; i++) {
        real *own = seen->noise + i * seen->count + i;
        const real variance = spread[i * seen->count + i] + *own;
        const real excess =
            fabs(seen->v[i]) / sqrt(variance) / sqrt(s->innovation.limits[0]) - 1;
        if (!(excess <= 0)) *own += variance * excess;
    }
    (void)sensors; (void)next;
}

/* No sensor is rejected. */
static int mhe_rejection(mhe_estimator *e, int i)
{
    (void)e; (void)i;
    return 0;
}
