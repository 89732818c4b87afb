/* What a QP with rows needs of factor.c. */

@mhe_workspace
    /* The panels before they are factorised, where rows are active, and their diagonal. */
    mhe_real plain[(MHE_HORIZON + 1) * MHE_NX * MHE_PANEL_WIDTH];
    mhe_real diagonal[(MHE_HORIZON + 1) * MHE_NX];
@
/* The largest weight of an equation in the interior point. */
#define STIFFNESS (sizeof(real) == 8 ? (real)1e6 : (real)1e3)

/* Weights of active rows in the active-set method, beside what opposes them. Rounds refine what the
 * sums have lost to them. */
#define STIFFER (sizeof(real) == 8 ? (real)1e3 : (real)1e2)

/* Rounds beside those: the size of a change says when they are done. */
#define MORE_ROUNDS 0

/* No row is one on a direction that has no disturbance in any trial. */
static int mhe_is_eliminated(const mhe_settings *s, int r)
{
    (void)s; (void)r;
    return 0;
}

static void mhe_set_limits_about(mhe_workspace *k, const real *w)
{
    (void)k; (void)w;
}

/* The diagonal of the Hessian's block of d(i). */
static void mhe_stage_curvature(mhe_estimator *e, const mhe_workspace *k, int i, real *diagonal)
{
    for (int j = 0; j < NX; j++) diagonal[j] = k->diagonal[i * NX + j];
    (void)e;
}

static void mhe_set_stiffness(mhe_estimator *e, mhe_workspace *k);
static void mhe_add_loads(const mhe_estimator *e, const mhe_workspace *k, real *out);

/* panel += weight a a' (upper half). */
static void mhe_add_square(real *panel, real weight, const real *a)
{
    for (int i = 0; i < NX; i++) {
        const real scaled = weight * a[i];
        if (scaled == 0) continue;
        for (int j = i & ~3; j < NX; j++) panel[i * WIDTH + j] += scaled * a[j];
    }
}

/* panels += c' diag(weight) c. */
static void mhe_add_weights(const mhe_estimator *e, mhe_workspace *k)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        const real *weights = k->rows.weight + i * ROWS;
        real *panel = k->panels + i * NX * WIDTH;
        (void)panel;
        if (MHE_X_SET) {
            const real *bounds = weights + W_COUNT + V_COUNT;
            for (int j = 0; j < NX; j++) panel[j * WIDTH + j] += bounds[j];
            for (int r = 0; r < MHE_X_ROWS; r++)
                if (bounds[NX + r] != 0) mhe_add_square(panel, bounds[NX + r], s->states.rows + r * NX);
        }
        mhe_add_slope_weights(e, k, i, weights + G_AT);
        if (MHE_END_ROWS && i == e->length) break;
        if (MHE_W_SET) {
            const real *A = k->at[i]->f_jacobian;
            real *next = panel + NX * WIDTH;
            for (int r = 0; r < NX; r++) {
                const real weight = weights[r];
                if (weight == 0) continue;
                mhe_add_square(panel, weight, A + r * NX);
                next[r * WIDTH + r] += weight;
                for (int j = 0; j < NX; j++) panel[j * WIDTH + NX + r] -= weight * A[r * NX + j];
            }
            for (int r = 0; r < MHE_W_ROWS; r++) {
                const real weight = weights[NX + r], *row = s->disturbances.rows + r * NX;
                real a[NX];
                if (weight == 0) continue;
                for (int j = 0; j < NX; j++) {
                    a[j] = 0;
                    for (int q = 0; q < NX; q++) a[j] -= row[q] * A[q * NX + j];
                }
                mhe_add_square(panel, weight, a);
                mhe_add_square(next, weight, row);
                for (int j = 0; j < NX; j++)
                    for (int q = 0; q < NX; q++)
                        panel[j * WIDTH + NX + q] += weight * a[j] * row[q];
            }
            weights += W_COUNT;
        }
        if (MHE_V_SET) {
            const real *C = k->at[i]->h_jacobian;
            for (int r = 0; r < NY; r++)
                if (weights[r] != 0) mhe_add_square(panel, weights[r], C + r * NX);
            for (int r = 0; r < MHE_V_ROWS; r++) {
                const real *row = s->noises.rows + r * NY;
                real c[NX];
                if (weights[NY + r] == 0) continue;
                for (int j = 0; j < NX; j++) {
                    c[j] = 0;
                    for (int q = 0; q < NY; q++) c[j] += row[q] * C[q * NX + j];
                }
                mhe_add_square(panel, weights[NY + r], c);
            }
        }
    }
    (void)s;
}

/* out = H d, from panels that are not factorised. */
static void mhe_hessian_times(const real *panels, int count, const real *d, real *out)
{
    for (int j = 0; j < (count + 1) * NX; j++) out[j] = 0;
    for (int i = 0; i <= count; i++) {
        const real *panel = panels + i * NX * WIDTH;
        const int last = i < count ? 2 * NX : NX;
        for (int r = 0; r < NX; r++) {
            const real *row = panel + r * WIDTH, own = d[i * NX + r];
            real *target = out + i * NX;
            real sum = row[r] * own;
            for (int c = r + 1; c < last; c++) {
                sum += row[c] * d[i * NX + c];
                target[c] += row[c] * own;
            }
            target[r] += sum;
        }
    }
}

/* Factorise the QP around a trajectory, with the active rows' weights. */
static int mhe_factorise_weighted(mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest,
                                  int active)
{
    mhe_build(e, k, offset, nearest);
    const size_t size = sizeof(real) * (size_t)((e->length + 1) * NX * WIDTH);
    int missed = 0;
    if (active) {
        memcpy(k->plain, k->panels, size);
        /* What a missed row opposes to active ones may be far more than the Hessian. */
        missed = mhe_set_missed_weights(e, k);
        if (missed) mhe_add_weights(e, k);
    }
    for (int j = 0; j < (e->length + 1) * NX; j++) k->diagonal[j] = k->panels[j * WIDTH + j % NX];
    if (missed) memcpy(k->panels, k->plain, size);
    if (active) {
        mhe_set_stiffness(e, k);
        mhe_add_weights(e, k);
    }
    return mhe_factorise(k, e->length);
}

/* The increments that minimise the QP with the rows' loads. */
static int mhe_solve_loaded(mhe_estimator *e, mhe_workspace *k, int nearest, int active)
{
    (void)nearest; /* the gradient is zero then */
    for (int j = 0; j < (e->length + 1) * NX; j++) k->step[j] = -k->gradient[j];
    if (active) mhe_add_loads(e, k, k->step);
    return mhe_solve(k, e->length, k->step);
}

/* What these loads add to the increments, and what rounding has left of them: forces that are not
 * balanced. */
static int mhe_solve_loads(mhe_estimator *e, mhe_workspace *k)
{
    const int rows = mhe_row_stages(e) * ROWS;
    mhe_rows *q = &k->rows;
    mhe_hessian_times(k->plain, e->length, k->step, k->product);
    for (int j = 0; j < (e->length + 1) * NX; j++) k->direction[j] = -k->product[j] - k->gradient[j];
    for (int i = 0; i < rows; i++) q->load[i] -= q->force[i];
    mhe_add_loads(e, k, k->direction);
    return mhe_solve(k, e->length, k->direction);
}

/* The length of increments, in the units of the Hessian's diagonal. */
static real mhe_size(const mhe_estimator *e, const mhe_workspace *k, const real *d)
{
    real sum = 0;
    for (int j = 0; j < (e->length + 1) * NX; j++)
        sum += k->diagonal[j] * d[j] * d[j];
    return sqrt(sum);
}

/* Twice the objective of the QP at its solution: g'd - force'c(d), with H d + g + c' force = 0. */
static real mhe_twice_objective(const mhe_estimator *e, const mhe_workspace *k)
{
    const mhe_rows *q = &k->rows;
    real objective = mhe_dot((e->length + 1) * NX, k->gradient, k->step);
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++) objective -= mhe_whole_force(q, i) * q->value[i];
    return objective;
}

/* The same steps of the interior point. */
static void mhe_begin_interior(mhe_estimator *e, mhe_workspace *k)
{
    (void)e; (void)k;
}

static void mhe_build_again(mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest)
{
    mhe_build(e, k, offset, nearest);
}

static int mhe_factorise_rows(mhe_estimator *e, mhe_workspace *k)
{
    mhe_add_weights(e, k);
    return mhe_factorise(k, e->length);
}

static int mhe_solve_direction(mhe_estimator *e, mhe_workspace *k)
{
    memcpy(k->direction, k->residual, sizeof(real) * (size_t)(e->length + 1) * NX);
    mhe_add_loads(e, k, k->direction);
    return mhe_solve(k, e->length, k->direction);
}

/* The largest square of a force on the increments that the rows' loads leave, by its curvature. The
 * forces are what `mhe_set_direction` balances. */
static real mhe_unbalanced(mhe_estimator *e, mhe_workspace *k, int nearest)
{
    const int size = (e->length + 1) * NX;
    real worst = 0;
    (void)nearest; /* the gradient is zero then */
    mhe_hessian_times(k->panels, e->length, k->step, k->product);
    for (int j = 0; j < size; j++) k->residual[j] = -k->product[j] - k->gradient[j];
    mhe_add_loads(e, k, k->residual);
    for (int j = 0; j < size; j++) {
        const real curvature = k->panels[j * WIDTH + j % NX];
        worst = mhe_max(k->residual[j] * k->residual[j] / curvature, worst);
    }
    return worst;
}
