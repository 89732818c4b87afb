/* Projection of the observer onto X: the nearest point in the observer's own metric. */

/* Whether a point is farther from the set than any two points of the set are apart. */
static int mhe_is_beyond(const mhe_x_set *set, const mhe_metric *P, const real *point,
                         const real *nearest)
{
    real back[NX * NX] = {0}, widths[NX], most = 0, distance = 0; /* U^-1 */
    for (int j = 0; j < NX; j++) {
        widths[j] = set->upper[j] - set->lower[j];
        if (!isfinite(widths[j]) || !(fabs(P->root[j * (NX + 1)]) > 0)) return 0;
    }
    for (int c = 0; c < NX; c++)
        for (int i = c; i >= 0; i--) {
            real sum = i == c;
            for (int l = i + 1; l <= c; l++) sum -= P->root[i * NX + l] * back[l * NX + c];
            back[i * NX + c] = sum / P->root[i * (NX + 1)];
        }
    for (int i = 0; i < NX; i++) {
        real along = 0;
        for (int j = 0; j <= i; j++) along += (point[j] - nearest[j]) * back[j * NX + i];
        distance += along * along;
        for (int j = 0; j < NX; j++)
            most += widths[i] * fabs(mhe_dot(NX, back + i * NX, back + j * NX)) * widths[j];
    }
    return distance > most;
}

/* Keep the observer's next state in X, and set its correction w to match; bits of the status.
 * `predicted`: without the correction. */
static int mhe_keep_inside(const mhe_x_set *set, const mhe_metric *P, const real *predicted, real *next,
                           real *w)
{
    real point[NX];
    int events = MHE_OBSERVER_PROJECTED, reached = mhe_project(set, P, next, point);
    if (!mhe_is_inside(set, predicted)) {
        events |= MHE_PREDICTION_OUTSIDE;
        if (reached && mhe_is_beyond(set, P, next, point)) {
            /* Every point of X is nearer to the truth than `next` is. The prediction is then so far
             * off that it would hide the correction: correct its projection instead. */
            real inside[NX];
            mhe_project(set, P, predicted, inside);
            for (int j = 0; j < NX; j++) inside[j] += w[j];
            reached = mhe_project(set, P, inside, point);
        }
    }
    for (int j = 0; j < NX; j++) {
        next[j] = point[j];
        w[j] = point[j] - predicted[j];
    }
    return reached ? events : events | MHE_METRIC_SINGULAR;
}

/* The metric in which the observer is projected. With `project` of 2 it is the diagonal of the
 * observer's own covariance. */
static void mhe_take_metric(const mhe_estimator *e, const real *covariance, const real *root,
                            mhe_metric *m)
{
    if (e->settings->project < 2) {
        mhe_set_metric(m, covariance, root);
        return;
    }
    m->singular = SINGULAR;
    memset(m->root, 0, sizeof m->root);
    for (int j = 0; j < NX; j++) m->root[j * (NX + 1)] = sqrt(mhe_max(covariance[j * (NX + 1)], 0));
}

/* Put a state of the observer into a set to which no correction leads. */
static void mhe_put_inside(const mhe_estimator *e, const mhe_x_set *set, const mhe_metric *metric,
                           real *state)
{
    real point[NX];
    if (!e->settings->project || mhe_is_inside(set, state)) return;
    mhe_project(set, metric, state, point);
    memcpy(state, point, sizeof point);
}
