/* The sets W, V and X: their rows, and by how much a trajectory misses them. */

#define ROWS MHE_STAGE_ROWS
#define W_COUNT (MHE_W_SET * (NX + MHE_W_ROWS))
#define V_COUNT (MHE_V_SET * (NY + MHE_V_ROWS))
#define X_COUNT (MHE_X_SET * (NX + MHE_X_ROWS))
#define G_AT (W_COUNT + V_COUNT + X_COUNT)

/* How far a point q is from each side of a set: low <= 0 <= high where it is inside. */
static void mhe_distances(int n, int count, const real *q, const real *lower, const real *upper,
                          const real *rows, const real *row_lower, const real *row_upper,
                          const uint8_t *known, real *low, real *high)
{
    for (int j = 0; j < n; j++) {
        const int there = !known || known[j];
        low[j] = there ? lower[j] - q[j] : -INFINITY;
        high[j] = there ? upper[j] - q[j] : INFINITY;
    }
    for (int i = 0; i < count; i++) {
        const real value = mhe_dot(n, rows + i * n, q);
        int there = 1;
        for (int j = 0; j < n; j++)
            if (known && !known[j] && rows[i * n + j] != 0) there = 0;
        low[n + i] = there ? row_lower[i] - value : -INFINITY;
        high[n + i] = there ? row_upper[i] - value : INFINITY;
    }
}

#define DISTANCES(set, n, count, q, known, low, high) \
    mhe_distances(n, count, q, (set).lower, (set).upper, (set).rows, (set).row_lower, \
                  (set).row_upper, known, low, high)

/* Stages that have rows: behind the last sample, there is a state. */
static int mhe_row_stages(const mhe_estimator *e) { return e->length + MHE_END_ROWS; }

/* Move the active set of the last QP on with the window, when its first stage leaves it. */
static void mhe_shift_places(mhe_estimator *e)
{
    const size_t kept = sizeof e->places - ROWS;
    memmove(e->places, e->places + ROWS, kept);
    memset(e->places + kept, 0, ROWS);
}

/* The stage whose X state i has to be in: the state behind the last sample has that sample's. */
static mhe_stage *mhe_stage_of_state(mhe_estimator *e, int i)
{
    return mhe_stage_at(e, i < e->length ? i : i - 1);
}

/* The scales of some rows, and their deviations where these are larger. */
static void mhe_copy_scales(int count, const real *scales, const real *deviations, real *scale,
                            real *deviation)
{
    for (int j = 0; j < count; j++) {
        scale[j] = scales[j];
        deviation[j] = mhe_max(deviations[j], scale[j]);
    }
}

#define COPY_SCALES(set, n, count, to, beside) do { \
        mhe_copy_scales(n, (set)->scale, (set)->deviation, to, beside); \
        mhe_copy_scales(count, (set)->row_scale, (set)->row_deviation, (to) + (n), (beside) + (n)); \
    } while (0)

/* The same of all rows of stage i. */
static void mhe_stage_scales(mhe_estimator *e, int i, real *scale, real *deviation)
{
    const mhe_settings *s = e->settings;
    const mhe_stage *stage = mhe_stage_of_state(e, i);
    if (MHE_W_SET) COPY_SCALES(mhe_w_set_at(s, stage), NX, MHE_W_ROWS, scale, deviation);
    scale += W_COUNT, deviation += W_COUNT;
    if (MHE_V_SET) COPY_SCALES(mhe_v_set_at(s, stage), NY, MHE_V_ROWS, scale, deviation);
    scale += V_COUNT, deviation += V_COUNT;
    if (MHE_X_SET) COPY_SCALES(mhe_x_set_at(s, stage), NX, MHE_X_ROWS, scale, deviation);
    mhe_value_scales(s, scale + X_COUNT, deviation + X_COUNT);
    (void)s; (void)stage;
}

/* The distances of all rows of stage i, about a trajectory x with disturbances w, and noises and values
 * of a trial. */
static void mhe_stage_distances(mhe_estimator *e, int i, const real *x, const real *w,
                                const mhe_trial *trial, real *low, real *high)
{
    const mhe_settings *s = e->settings;
    const mhe_stage *stage = mhe_stage_of_state(e, i);
    if (MHE_X_SET) {
        DISTANCES(*mhe_x_set_at(s, stage), NX, MHE_X_ROWS, x + i * NX, 0, low + W_COUNT + V_COUNT,
                  high + W_COUNT + V_COUNT);
    }
    mhe_value_distances(e, i, trial, low + G_AT, high + G_AT);
    if (MHE_END_ROWS && i == e->length) {
        for (int r = 0; r < W_COUNT + V_COUNT; r++) low[r] = -INFINITY, high[r] = INFINITY;
        return;
    }
    if (MHE_W_SET) {
        DISTANCES(*mhe_w_set_at(s, stage), NX, MHE_W_ROWS, w + i * NX, 0, low, high);
    }
    if (MHE_V_SET) {
        DISTANCES(*mhe_v_set_at(s, stage), NY, MHE_V_ROWS, trial->v + i * NY,
                  stage->is_complete ? 0 : stage->is_observed, low + W_COUNT, high + W_COUNT);
    }
    (void)x; (void)w; (void)trial; (void)s; (void)stage;
}

/* The largest miss among rows of one set, in their scales. `sizes`: of the numbers whose
 * differences the rows are of, for rounding. `missed` gets the sides that are, but for
 * components without width in the usual set and other rows that are not dropped. */
static real mhe_missed(const mhe_settings *s, int first, int n, int count, const real *low, const real *high, const real *lower,
                       const real *upper, const uint8_t *row_fixed, const real *rows,
                       const real *scale, const real *row_scale, const real *sizes,
                       const uint8_t *left_out, uint8_t *missed)
{
    real worst = 0;
    for (int r = 0; r < n + count; r++) {
        const int side = low[r] > 0 ? MHE_LOWER : high[r] < 0 ? MHE_UPPER : 0;
        if (isnan(low[r]) || isnan(high[r])) return INFINITY;
        if (!side || mhe_is_soft(s, first + r) || (left_out && left_out[r] & side)) continue;
        real size = 0;
        if (r < n)
            size = fabs(sizes[r]);
        else
            for (int j = 0; j < n; j++) size += fabs(rows[(r - n) * n + j] * sizes[j]);
        const real miss = (side == MHE_LOWER ? low[r] : -high[r]) - 8 * EPSILON * size;
        const real share = miss / (r < n ? scale[r] : row_scale[r - n]);
        const int fixed = r < n ? lower[r] == upper[r] : row_fixed[r - n];
        if (isnan(share)) return INFINITY;
        worst = mhe_max(share, worst);
        if (missed && !fixed && share > MHE_FEASIBLE) missed[r] = (uint8_t)side;
    }
    (void)s; (void)first;
    return worst;
}

#define MISSED(set, usual, first, n, count, low, high, sizes, left_out, missed) \
    mhe_missed(s, first, n, count, low, high, (usual).lower, (usual).upper, (usual).row_fixed, \
               (set).rows, (set).scale, (set).row_scale, sizes, left_out, missed)

/* The largest miss of a trial with disturbances w in the rows' scales, without the sides that are
 * left out. */
static real mhe_violation(mhe_estimator *e, const mhe_trial *trial, const real *w,
                          const uint8_t *left_out, uint8_t *missed)
{
    real worst = 0, low[ROWS], high[ROWS];
    const mhe_settings *s = e->settings;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        const uint8_t *out = left_out ? left_out + i * ROWS : 0;
        uint8_t *in = missed ? missed + i * ROWS : 0;
        const mhe_stage *stage = mhe_stage_of_state(e, i);
        (void)stage;
        mhe_stage_distances(e, i, trial->x, w, trial, low, high);
        worst = mhe_max(worst, mhe_values_missed(s, high + G_AT, out ? out + G_AT : 0,
                                                 in ? in + G_AT : 0));
        if (MHE_X_SET) {
            worst = mhe_max(worst, MISSED(*mhe_x_set_at(s, stage), s->states, W_COUNT + V_COUNT, NX, MHE_X_ROWS,
                                          low + W_COUNT + V_COUNT, high + W_COUNT + V_COUNT,
                                          trial->x + i * NX,
                                          out ? out + W_COUNT + V_COUNT : 0,
                                          in ? in + W_COUNT + V_COUNT : 0));
        }
        if (MHE_END_ROWS && i == e->length) break;
        if (MHE_W_SET) {
            worst = mhe_max(worst, MISSED(*mhe_w_set_at(s, stage), s->disturbances, 0, NX, MHE_W_ROWS,
                                          low, high, trial->x + (i + 1) * NX, out, in));
        }
        if (MHE_V_SET) {
            worst = mhe_max(worst, MISSED(*mhe_v_set_at(s, stage), s->noises, W_COUNT, NY, MHE_V_ROWS,
                                          low + W_COUNT, high + W_COUNT, stage->y,
                                          out ? out + W_COUNT : 0, in ? in + W_COUNT : 0));
        }
    }
    return worst;
}

/* Put a state behind w into the components of W that have no width. */
static void mhe_keep_equations(const mhe_settings *s, const real *predicted, real *next)
{
    const mhe_w_set *set = &s->disturbances;
    if (!MHE_W_SET) return;
    for (int j = 0; j < NX; j++)
        if (set->lower[j] == set->upper[j] && !mhe_is_soft(s, j)) next[j] = predicted[j] + set->lower[j];
    mhe_enter_turn(s, next);
}

static void mhe_fill_dropped(const mhe_workspace *k, int rows_dropped, mhe_estimate *out)
{
    if (rows_dropped)
        memcpy(out->dropped, k->left_out, sizeof out->dropped);
    else
        memset(out->dropped, 0, sizeof out->dropped);
}
