/* Nonlinear constraints in the panels of factor.c. */

@mhe_workspace
    /* What their curvature adds to a Hessian: blocks of each state, and of the next one below it. */
    mhe_real own_bends[(MHE_HORIZON + 1) * MHE_NX * MHE_NX], bends_below[MHE_HORIZON * MHE_NX * MHE_NX];
@
/* Panels of stage i += slopes' diag(weight) slopes. */
static void mhe_add_slope_weights(const mhe_estimator *e, mhe_workspace *k, int i, const real *weight)
{
    real *panel = k->panels + i * NX * MHE_PANEL_WIDTH;
    for (int r = 0; r < MHE_G_ROWS; r++) {
        const int at = (i * MHE_G_ROWS + r) * NX;
        const real *own = k->own_slopes + at;
        if (weight[r] == 0) continue;
        mhe_add_square(panel, weight[r], own);
        if (i == e->length || e->settings->constraints.on_state[r]) continue;
        const real *next = k->next_slopes + at;
        mhe_add_square(panel + NX * MHE_PANEL_WIDTH, weight[r], next);
        for (int j = 0; j < NX; j++)
            for (int l = 0; l < NX; l++)
                panel[j * MHE_PANEL_WIDTH + NX + l] += weight[r] * own[j] * next[l];
    }
}

static void mhe_clear_bends(mhe_workspace *k)
{
    memset(k->own_bends, 0, sizeof k->own_bends);
    memset(k->bends_below, 0, sizeof k->bends_below);
}

/* Keep the curvature `bend` of stage i, along a direction by its state and the next one. */
static void mhe_keep_bend(const mhe_estimator *e, mhe_workspace *k, int i, real bend, const real *by_state,
                          const real *by_next)
{
    real *own = k->own_bends + i * NX * NX;
    for (int j = 0; j < NX; j++)
        for (int m = 0; m < NX; m++) {
            own[j * NX + m] += bend * by_state[j] * by_state[m];
            if (i == e->length) continue;
            k->bends_below[(i * NX + j) * NX + m] += bend * by_next[j] * by_state[m];
            own[NX * NX + j * NX + m] += bend * by_next[j] * by_next[m];
        }
}

/* Panels += curvature. */
static void mhe_add_bends(const mhe_estimator *e, mhe_workspace *k)
{
    if (!k->has_bends) return;
    for (int i = 0; i <= e->length; i++)
        for (int r = 0; r < NX; r++) {
            real *row = k->panels + (i * NX + r) * MHE_PANEL_WIDTH;
            for (int c = r; c < NX; c++) row[c] += k->own_bends[(i * NX + r) * NX + c];
            for (int c = 0; i < e->length && c < NX; c++)
                row[NX + c] += k->bends_below[(i * NX + c) * NX + r];
        }
}
