/* Rows of a QP: their limits, and products with them. */

/* Limits of all rows about a trajectory x with the residuals and values of a trial. */
static void mhe_set_limits(mhe_estimator *e, mhe_workspace *k, const real *x, const mhe_trial *trial)
{
    real low[ROWS], high[ROWS];
    for (int i = 0; i < mhe_row_stages(e); i++) {
        mhe_stage_scales(e, i, k->rows.scale + i * ROWS, k->rows.deviation + i * ROWS);
        mhe_stage_distances(e, i, x, trial->w, trial, low, high);
        mhe_leave_out(k, i, high + G_AT);
        for (int r = 0; r < ROWS; r++) {
            const int at = i * ROWS + r, out = k->left_out[at];
            k->rows.low[at] = out & MHE_LOWER ? -INFINITY : low[r];
            k->rows.high[at] = out & MHE_UPPER ? INFINITY : high[r];
            if (!mhe_is_eliminated(e->settings, r)) continue;
            k->rows.low[at] = -INFINITY;
            k->rows.high[at] = INFINITY;
        }
    }
    mhe_set_limits_about(k, trial->w);
}

static void mhe_values_of(int n, int count, const real *q, const real *rows, real *out)
{
    for (int j = 0; j < n; j++) out[j] = q[j];
    for (int i = 0; i < count; i++) out[n + i] = mhe_dot(n, rows + i * n, q);
}

/* rows.value = c(d). */
static void mhe_rows_times(const mhe_estimator *e, mhe_workspace *k, const real *d)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        real *value = k->rows.value + i * ROWS;
        const real *own = d + i * NX;
        (void)own;
        if (MHE_X_SET) {
            mhe_values_of(NX, MHE_X_ROWS, own, s->states.rows, value + W_COUNT + V_COUNT);
        }
        mhe_slopes_times(e, k, i, d, value + G_AT);
        if (MHE_END_ROWS && i == e->length) {
            for (int r = 0; r < W_COUNT + V_COUNT; r++) value[r] = 0;
            break;
        }
        if (MHE_W_SET) {
            real q[NX];
            for (int j = 0; j < NX; j++)
                q[j] = own[NX + j] - mhe_dot(NX, k->at[i]->f_jacobian + j * NX, own);
            mhe_values_of(NX, MHE_W_ROWS, q, s->disturbances.rows, value);
            value += W_COUNT;
        }
        if (MHE_V_SET) {
            real r[NY];
            for (int j = 0; j < NY; j++) r[j] = -mhe_dot(NX, k->at[i]->h_jacobian + j * NX, own);
            mhe_values_of(NY, MHE_V_ROWS, r, s->noises.rows, value);
        }
    }
    (void)s;
}

static void mhe_loads_of(int n, int count, const real *rows, const real *load, real *out)
{
    for (int j = 0; j < n; j++) out[j] = load[j];
    for (int i = 0; i < count; i++)
        for (int j = 0; j < n; j++) out[j] += load[n + i] * rows[i * n + j];
}

/* out += c' load. */
static void mhe_add_loads(const mhe_estimator *e, const mhe_workspace *k, real *out)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        const real *load = k->rows.load + i * ROWS;
        real *own = out + i * NX;
        (void)own;
        if (MHE_X_SET) {
            real x[NX];
            mhe_loads_of(NX, MHE_X_ROWS, s->states.rows, load + W_COUNT + V_COUNT, x);
            for (int j = 0; j < NX; j++) own[j] += x[j];
        }
        mhe_add_slope_loads(e, k, i, load + G_AT, out);
        if (MHE_END_ROWS && i == e->length) break;
        if (MHE_W_SET) {
            real w[NX];
            const real *A = k->at[i]->f_jacobian;
            mhe_loads_of(NX, MHE_W_ROWS, s->disturbances.rows, load, w);
            for (int r = 0; r < NX; r++) {
                if (w[r] == 0) continue;
                own[NX + r] += w[r];
                for (int j = 0; j < NX; j++) own[j] -= w[r] * A[r * NX + j];
            }
            load += W_COUNT;
        }
        if (MHE_V_SET) {
            real v[NY];
            const real *C = k->at[i]->h_jacobian;
            mhe_loads_of(NY, MHE_V_ROWS, s->noises.rows, load, v);
            for (int r = 0; r < NY; r++)
                for (int j = 0; j < NX; j++) own[j] -= v[r] * C[r * NX + j];
        }
    }
    (void)s;
}

/* The place of a row in the active set: at its lower or upper limit, or between them. Of an
 * equation, the limits are the same. */
enum { AT_LOWER = -1, BETWEEN = 0, AT_UPPER = 1, EQUATION = 2 };
