/* Soft rows that are missed, beside elimination.c: where they have no quadratic penalty, they pull with a
 * constant force, which no row of a least-squares problem has. With R y = s for the rows without it,
 *
 *     R y = s + R'^-1 pull
 *
 * minimises |R y - s|^2 / 2 - pull'y; what is left of the pull beside the disturbances of a stage goes on
 * to the state before them. */

@mhe_workspace
    mhe_real pulls[(MHE_HORIZON + 1) * MHE_NX]; /* on the increments, as if all were free */
    int32_t has_pulls;
@
/* Set the pulls of the rows that have loads, but no weights. */
static void mhe_set_pulls(const mhe_estimator *e, mhe_workspace *k)
{
    mhe_rows *q = &k->rows;
    const int rows = mhe_row_stages(e) * ROWS;
    for (int i = 0; i < rows; i++) {
        q->missed[i] = q->load[i];
        if (q->weight[i] != 0) q->load[i] = 0;
        if (q->load[i] != 0) k->has_pulls = 1;
    }
    memset(k->pulls, 0, sizeof k->pulls);
    if (k->has_pulls) mhe_add_loads(e, k, k->pulls);
    memcpy(q->load, q->missed, sizeof(real) * (size_t)rows);
}

/* The loads of missed rows become 0. */
static void mhe_unload_missed(const mhe_estimator *e, mhe_workspace *k)
{
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++)
        if (mhe_is_violated(&k->rows, i)) k->rows.load[i] = 0;
}

static void mhe_forget_pulls(mhe_workspace *k) { k->has_pulls = 0; }

/* side += R'^-1 pull in the disturbances of stage i; `pull` is on the state behind it, and then on its
 * own. */
static void mhe_pull_side(const mhe_estimator *e, const mhe_workspace *k, int i, real *side, real *pull)
{
    const mhe_block *b = k->blocks + i;
    const real *F = e->settings->elimination.free;
    real later[NX], share[SIZE(MHE_FREE)];
    if (!k->has_pulls) return;
    memcpy(later, pull, sizeof later);
    memcpy(pull, k->pulls + i * NX, sizeof later);
    if (i == e->length) return;
    mhe_add_product(NX, NX, 1, k->at[i]->f_jacobian, later, pull);
    for (int j = 0; j < b->free; j++) {
        const real *row = b->rows + j * COLUMNS;
        const int c = b->lead[j];
        share[j] = 0;
        for (int l = 0; l < NX; l++) share[j] += F[l * MHE_FREE + c] * later[l];
        for (int l = 0; l < j; l++) share[j] -= mhe_entry(b, l, c) * share[l];
        share[j] /= row[c];
        side[j] += share[j];
        for (int l = 0; l < NX; l++) pull[l] -= row[MHE_FREE + l] * share[j];
    }
}

/* The same in the first state. */
static void mhe_pull_first(const mhe_workspace *k, real *side, const real *pull)
{
    const real *rows = k->start.rows;
    real share[NX];
    if (!k->has_pulls) return;
    for (int j = 0; j < NX; j++) {
        share[j] = pull[k->order[j]];
        for (int l = 0; l < j; l++) share[j] -= rows[l * COLUMNS + j] * share[l];
        share[j] /= rows[j * COLUMNS + j];
        side[j] += share[j];
    }
}

/* The derivative, but for its sign, of a row of stage i by component j of d(i), or of d(i+1). */
static real mhe_slope_of(const mhe_estimator *e, const mhe_workspace *k, int i, int r, int following,
                         int j)
{
    const mhe_settings *s = e->settings;
    const int v = r - W_COUNT, x = v - V_COUNT;
    real slope = 0;
    (void)s; (void)x;
    if (r >= G_AT) return mhe_value_slope(k, i, r - G_AT, following, j);
    if (MHE_W_SET && v < 0) {
        for (int q = 0; q < NX; q++) {
            const real share = r < NX ? r == q : s->disturbances.rows[(r - NX) * NX + q];
            if (share != 0) slope += share * (following ? q == j : k->at[i]->f_jacobian[q * NX + j]);
        }
    }
    if (following || v < 0) return slope;
    if (MHE_V_SET && x < 0) {
        for (int q = 0; q < NY; q++) {
            const real share = v < NY ? v == q : s->noises.rows[(v - NY) * NY + q];
            if (share != 0) slope += share * k->at[i]->h_jacobian[q * NX + j];
        }
    }
    if (MHE_X_SET && x >= 0) slope = x < NX ? x == j : s->states.rows[(x - NX) * NX + j];
    return slope;
}

/* diagonal += what the quadratic penalties of missed rows add to the Hessian's block of d(i): an active
 * row's weight has to be more. */
static void mhe_add_missed_curvature(const mhe_estimator *e, const mhe_workspace *k, int i, real *diagonal)
{
    const mhe_rows *q = &k->rows;
    for (int following = 0; following < 2; following++) {
        const int stage = i - following;
        for (int r = 0; r < ROWS && stage >= 0 && stage < mhe_row_stages(e); r++) {
            if (!mhe_is_violated(q, stage * ROWS + r)) continue;
            for (int j = 0; j < NX; j++) {
                const real slope = mhe_slope_of(e, k, stage, r, following, j);
                diagonal[j] += q->bend[stage * ROWS + r] * slope * slope;
            }
        }
    }
}
