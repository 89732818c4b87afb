/* What a QP with rows needs of elimination.c. */

#define STIFFNESS (sizeof(real) == 8 ? (real)1e6 : (real)1e3)

/* Reflections bear more than what rounding leaves of sums. */
#define STIFFER STIFFNESS

/* Whether a row of a stage is one on a direction that has no disturbance in any trial. */
static int mhe_is_eliminated(const mhe_settings *s, int r)
{
    const mhe_w_set *set = &s->disturbances;
    return r < NX ? set->lower[r] == set->upper[r] : r < W_COUNT && set->row_fixed[r - NX];
}

/* Limits are about these disturbances. */
static void mhe_set_limits_about(mhe_workspace *k, const real *w) { k->limits_w = w; }

/* The diagonal of the Hessian's block of d(i). */
static void mhe_stage_curvature(mhe_estimator *e, const mhe_workspace *k, int i, real *diagonal)
{
    const mhe_settings *s = e->settings;
    for (int j = 0; j < NX; j++) diagonal[j] = 0;
    if (i == 0)
        for (int j = 0; j < NX; j++) diagonal[j] = k->factors[0] * k->prior.weight[j * NX + j];
    else
        for (int j = 0; j < NX; j++)
            diagonal[j] = k->factors[i] * mhe_scaled(mhe_disturbance_weight(
                s, mhe_stage_at(e, i - 1))[j * NX + j], k->at[i - 1]->disturbance_scale, j);
    if (i == e->length) return;
    const mhe_terms *t = k->at[i];
    const real *Q = mhe_disturbance_weight(s, mhe_stage_at(e, i));
    const real *R = mhe_stage_at(e, i)->noise_weight, next = k->factors[i + 1];
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < NX; c++) {
            const real weight = next * mhe_scaled(Q[r * NX + c], t->disturbance_scale, r);
            for (int j = 0; j < NX; j++)
                diagonal[j] += weight * t->f_jacobian[r * NX + j] * t->f_jacobian[c * NX + j];
        }
    for (int r = 0; r < NY; r++)
        for (int c = 0; c < NY; c++) {
            const real weight = next * mhe_scaled(R[r * NY + c], t->noise_scale, r);
            for (int j = 0; j < NX; j++)
                diagonal[j] += weight * t->h_jacobian[r * NX + j] * t->h_jacobian[c * NX + j];
        }
}

static void mhe_set_stiffness(mhe_estimator *e, mhe_workspace *k);
static void mhe_add_loads(const mhe_estimator *e, const mhe_workspace *k, real *out);

/* Factorise the QP around a trajectory, with the active rows' weights. */
static int mhe_factorise_weighted(mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest,
                                  int active)
{
    mhe_assemble(e, k, offset);
    if (nearest) memset(k->gradient, 0, sizeof k->gradient);
    if (active) mhe_set_stiffness(e, k);
    return mhe_factorise(e, k, active);
}

/* The increments that minimise the QP with the rows' loads, or these alone. */
static int mhe_solve_loaded(mhe_estimator *e, mhe_workspace *k, int nearest, int active)
{
    (void)active; /* there are no rows without weights */
    mhe_set_targets(e, k, 0, nearest);
    return mhe_solve(e, k, 0, k->step);
}

static int mhe_solve_loads(mhe_estimator *e, mhe_workspace *k)
{
    return mhe_solve(e, k, 1, k->direction);
}

/* Reflections leave nothing to refine. */
static real mhe_size(const mhe_estimator *e, const mhe_workspace *k, const real *d)
{
    (void)e; (void)k; (void)d;
    return 0;
}

/* The same steps of the interior point. */
static void mhe_begin_interior(mhe_estimator *e, mhe_workspace *k) { mhe_set_curvatures(e, k); }

static void mhe_build_again(mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest)
{
    (void)e; (void)k; (void)offset; (void)nearest; /* roots and gradient are in place */
}

static int mhe_factorise_rows(mhe_estimator *e, mhe_workspace *k) { return mhe_factorise(e, k, 1); }

static int mhe_solve_direction(mhe_estimator *e, mhe_workspace *k)
{
    return mhe_solve(e, k, 0, k->direction);
}

/* The largest square of a force on the increments that the rows' loads leave, by its curvature. The
 * forces are what `mhe_set_direction` balances. */
static real mhe_unbalanced(mhe_estimator *e, mhe_workspace *k, int nearest)
{
    const int size = (e->length + 1) * NX;
    mhe_set_targets(e, k, k->step, nearest);
    memset(k->residual, 0, sizeof(real) * (size_t)size);
    mhe_add_loads(e, k, k->residual);
    return mhe_largest_force(e, k);
}
