/* What a QP with rows needs of elimination.c. */

#define STIFFNESS (sizeof(real) == 8 ? (real)1e6 : (real)1e3)

/* Reflections bear more than what rounding leaves of sums. */
#define STIFFER STIFFNESS

/* A round more than the tolerance asks for: of a soft row, each miss costs its linear penalty. */
#define MORE_ROUNDS 1

/* Whether a row of a stage is one on a direction that has no disturbance in any trial. */
static int mhe_is_eliminated(const mhe_settings *s, int r)
{
    const mhe_w_set *set = &s->disturbances;
    if (r < NX) return set->lower[r] == set->upper[r] && !mhe_is_soft(s, r);
    return r < W_COUNT && set->row_fixed[r - NX];
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
    mhe_add_missed_curvature(e, k, i, diagonal);
    mhe_add_bend_curvature(k, i, diagonal);
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
    mhe_use_bends(k, nearest);
    if (nearest) memset(k->gradient, 0, sizeof k->gradient);
    if (active) mhe_set_stiffness(e, k);
    return mhe_factorise(e, k, active);
}

/* The increments that minimise the QP with the rows' loads. */
static int mhe_solve_loaded(mhe_estimator *e, mhe_workspace *k, int nearest, int active)
{
    mhe_set_targets(e, k, 0, nearest);
    if (active) mhe_set_pulls(e, k);
    const int solved = mhe_solve(e, k, 0, k->step);
    mhe_forget_pulls(k);
    return solved;
}

/* What the active rows' new forces add to them; those of missed rows are all in the solution. */
static int mhe_solve_loads(mhe_estimator *e, mhe_workspace *k)
{
    mhe_unload_missed(e, k);
    return mhe_solve(e, k, 1, k->direction);
}

/* Reflections leave nothing to refine. */
static real mhe_size(const mhe_estimator *e, const mhe_workspace *k, const real *d)
{
    (void)e; (void)k; (void)d;
    return 0;
}

/* Twice the objective of the QP at its solution, which starts where no disturbance is as a roll-out has
 * it: forces that keep to the roll-out are not known. */
static real mhe_twice_objective(mhe_estimator *e, const mhe_workspace *k)
{
    real objective = 0, first[NX];
    for (int r = 0; r < NX; r++) {
        first[r] = 0;
        for (int c = r; c < NX; c++) first[r] += k->prior_root[r * NX + c] * k->step[c];
        objective += first[r] * first[r] + 2 * k->prior_gradient[r] * k->step[r];
    }
    for (int i = 0; i < e->length; i++) {
        const mhe_terms *t = k->at[i];
        const real *Q = mhe_disturbance_weight(e->settings, mhe_stage_at(e, i));
        const real *R = mhe_stage_at(e, i)->noise_weight, *own = k->step + i * NX;
        real w[NX], v[NY], sum = 0;
        for (int j = 0; j < NX; j++) w[j] = own[NX + j] - mhe_dot(NX, t->f_jacobian + j * NX, own);
        for (int j = 0; j < NY; j++) v[j] = -mhe_dot(NX, t->h_jacobian + j * NX, own);
        for (int r = 0; r < NX; r++)
            for (int c = 0; c < NX; c++)
                sum += w[r] * mhe_scaled(Q[r * NX + c], t->disturbance_scale, r) *
                       ((1 + k->damping) * w[c] + 2 * k->around->w[i * NX + c]);
        for (int r = 0; r < NY; r++)
            for (int c = 0; c < NY; c++)
                sum += v[r] * mhe_scaled(R[r * NY + c], t->noise_scale, r) *
                       (v[c] + 2 * k->around->v[i * NY + c]);
        objective += k->factors[i + 1] * sum;
    }
    return objective + mhe_bend_objective(e, k);
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
