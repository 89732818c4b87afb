/* The Gauss-Newton QP without inequalities: one block-banded L D L' factorisation.
 *
 * Panel k holds, by rows, the upper half of the Hessian's diagonal block of d(k) and beside
 * it the block that couples d(k) with d(k+1). What lies left of the diagonal is not read for
 * its value. */

@mhe_terms
    mhe_real hessian[MHE_NX * MHE_NX];  /* A' Q A + C' R C */
    mhe_real coupling[MHE_NX * MHE_NX]; /* -A' Q: rows of x(i), columns of x(i+1) */
@mhe_workspace
    mhe_real panels[(MHE_HORIZON + 1) * MHE_NX * MHE_PANEL_WIDTH];
    mhe_real inverse_pivots[(MHE_HORIZON + 1) * MHE_NX];
    mhe_real first_weight[MHE_NX * MHE_NX]; /* of the first state, without the data */
    int32_t has_ridge;                /* on the diagonal of the panels */
@
#define WIDTH MHE_PANEL_WIDTH

/* hessian = A' Q A + C' R C (upper half), coupling = -A' Q, own = -(A' Q w + C' R v). */
static void mhe_set_own_terms(const real *Q, const real *R, const real *w, const real *v,
                              mhe_terms *t)
{
    const real *A = t->f_jacobian, *C = t->h_jacobian;
    real *H = t->hessian, *QA = t->coupling;
    if (MHE_LOSS || !mhe_dense_terms(Q, w, t)) {
        for (int i = 0; i < NX * NX; i++) H[i] = QA[i] = 0;
        for (int i = 0; i < NX; i++)
            for (int k = 0; k < NX; k++) {
                const real q = mhe_scaled(Q[i * NX + k], t->disturbance_scale, i);
                if (q == 0) continue; /* weights are diagonal more often than not */
                for (int j = 0; j < NX; j++) QA[i * NX + j] += q * A[k * NX + j];
            }
        for (int k = 0; k < NX; k++)
            for (int i = 0; i < NX; i++) {
                const real a = A[k * NX + i];
                if (a == 0) continue;
                for (int j = i & ~3; j < NX; j++) H[i * NX + j] += a * QA[k * NX + j];
            }
        for (int j = 0; j < NX; j++) t->own[j] = 0;
        for (int k = 0; k < NX; k++)
            for (int j = 0; j < NX; j++) t->own[j] -= w[k] * QA[k * NX + j];
        for (int i = 0; i < NX; i++)
            for (int k = 0; k <= i; k++) {
                const real other = QA[k * NX + i];
                QA[k * NX + i] = -QA[i * NX + k];
                QA[i * NX + k] = -other;
            }
    }
    for (int k = 0; k < NY; k++) {
        real RC[NX]; /* row k of it */
        for (int j = 0; j < NX; j++) RC[j] = 0;
        for (int l = 0; l < NY; l++) {
            const real r = mhe_scaled(R[k * NY + l], t->noise_scale, k);
            if (r == 0) continue;
            for (int j = 0; j < NX; j++) RC[j] += r * C[l * NX + j];
        }
        for (int i = 0; i < NX; i++) {
            const real c = C[k * NX + i];
            if (c == 0) continue;
            for (int j = i & ~3; j < NX; j++) H[i * NX + j] += c * RC[j];
        }
        for (int j = 0; j < NX; j++) t->own[j] -= v[k] * RC[j];
    }
}

/* A QP around a trial knows it by its terms. */
static void mhe_set_around(mhe_workspace *k, const mhe_trial *around)
{
    (void)k; (void)around;
}

/* Give the next QPs a ridge, or none; whether they can have one. */
static int mhe_set_ridge(mhe_workspace *k, int has_ridge)
{
    k->has_ridge = has_ridge;
    return 1;
}

/* All directions have disturbances. */
static real mhe_free_direction(const mhe_settings *s, int row, int column)
{
    (void)s;
    return row == column;
}

/* An entry of the diagonal of the first state's weight, without the data; and its form. */
static real mhe_first_diagonal(const mhe_workspace *k, int j) { return k->first_weight[j * NX + j]; }

static real mhe_first_form(const mhe_workspace *k, const real *d)
{
    return mhe_form(NX, k->first_weight, d);
}

/* Add damping to the panels. */
static void mhe_damp(mhe_estimator *e, mhe_workspace *k)
{
    const real mu = k->damping;
    for (int r = 0; r < NX; r++)
        k->panels[r * WIDTH + r] += mu * (k->first_weight[r * NX + r] + k->seen[r]);
    for (int i = 0; i < e->length; i++) {
        const mhe_terms *t = k->at[i];
        const real *Q = mhe_disturbance_weight(e->settings, mhe_stage_at(e, i));
        const real share = mu * k->factors[i + 1];
        real *panel = k->panels + i * NX * WIDTH, *next = panel + NX * WIDTH;
        for (int r = 0; r < NX; r++) {
            real *row = panel + r * WIDTH;
            for (int l = 0; l < NX; l++) {
                const real value = share * t->coupling[r * NX + l];
                row[NX + l] += value;
                for (int c = 0; c < NX; c++) row[c] -= value * t->f_jacobian[l * NX + c];
                next[r * WIDTH + l] += share * mhe_scaled(Q[r * NX + l], t->disturbance_scale, r);
            }
        }
    }
}

/* Fill panels and gradient from the terms in workspace->at, around a trajectory that starts
 * at the given offset from the prior. */
static void mhe_assemble(mhe_estimator *e, mhe_workspace *k, const real *offset)
{
    const mhe_settings *s = e->settings;
    const int count = e->length;
    const real *factors = k->factors;
    real prior_scale[NX];
    mhe_set_scale(&s->prior_loss, 1, NX, k->prior.weight, offset, prior_scale);
    for (int i = 0; i <= count; i++) {
        real *panel = k->panels + i * NX * WIDTH, *g = k->gradient + i * NX;
        const real *weight = i == 0 ? k->prior.weight
                                    : mhe_disturbance_weight(s, mhe_stage_at(e, i - 1));
        const real *scale = i == 0 ? prior_scale : k->at[i - 1]->disturbance_scale;
        const real factor = factors[i];
        for (int r = 0; r < NX; r++) {
            real *row = panel + r * WIDTH;
            const real scaled = mhe_scaled(factor, scale, r);
            for (int c = 0; c < NX; c++) row[c] = scaled * weight[r * NX + c];
            for (int c = NX; c < WIDTH; c++) row[c] = 0;
        }
        if (i == 0) {
            mhe_prior_force(&k->prior, offset, g);
            for (int j = 0; j < NX; j++) g[j] *= mhe_scaled(factor, scale, j);
            mhe_add_further(e, k, factor, k->panels, WIDTH);
            for (int r = 0; r < NX; r++)
                for (int c = 0; c < NX; c++) k->first_weight[r * NX + c] = panel[r * WIDTH + c];
        } else {
            for (int j = 0; j < NX; j++) g[j] = factor * k->at[i - 1]->following[j];
        }
        if (i == count) break;
        const mhe_terms *t = k->at[i];
        const real next = factors[i + 1];
        for (int r = 0; r < NX; r++) {
            real *row = panel + r * WIDTH;
            for (int c = 0; c < NX; c++) {
                row[c] += next * t->hessian[r * NX + c];
                row[NX + c] = next * t->coupling[r * NX + c];
            }
            g[r] += next * t->own[r];
        }
    }
    if (k->damping > 0) mhe_damp(e, k);
    for (int i = 0; k->has_ridge && i <= count; i++) {
        const real *weight = i == 0 ? k->prior.weight
                                    : mhe_disturbance_weight(s, mhe_stage_at(e, i - 1));
        for (int r = 0; r < NX; r++) {
            real *pivot = k->panels + (i * NX + r) * WIDTH + r;
            *pivot += MHE_RIDGE * *pivot + EPSILON * factors[i] * weight[r * NX + r];
        }
    }
}

/* b := H^-1 b; whether the result is finite. */
static int mhe_solve(const mhe_workspace *k, int count, real *restrict b)
{
    for (int i = 0; i <= count; i++) {
        const real *restrict panel = k->panels + i * NX * WIDTH;
        const real *restrict inverse = k->inverse_pivots + i * NX;
        real *own = b + i * NX, sums[NX];
        for (int c = 0; c < NX; c++) sums[c] = 0;
        for (int j = 0; j < NX; j++) {
            const real *row = panel + j * WIDTH, value = own[j] * inverse[j];
            own[j] = MHE_LAPACK ? value * inverse[j] : value;
            for (int c = j + 1; c < NX; c++) own[c] -= row[c] * value;
            for (int c = 0; c < NX; c++) sums[c] += row[NX + c] * value;
        }
        if (i == count) break;
        for (int c = 0; c < NX; c++) own[NX + c] -= sums[c];
    }
    for (int i = count; i >= 0; i--) {
        const real *restrict panel = k->panels + i * NX * WIDTH;
        const real *restrict inverse = k->inverse_pivots + i * NX;
        real *own = b + i * NX;
        for (int j = 0; i < count && j < NX; j++) {
            const real *row = panel + j * WIDTH + NX;
            real sums[4] = {0, 0, 0, 0}; /* four sums, so that they can be made side by side */
            int c = 0;
            for (; c + 4 <= NX; c += 4)
                for (int q = 0; q < 4; q++) sums[q] += row[c + q] * own[NX + c + q];
            for (; c < NX; c++) sums[0] += row[c] * own[NX + c];
            own[j] -= inverse[j] * ((sums[0] + sums[1]) + (sums[2] + sums[3]));
        }
        for (int j = NX - 1; j >= 0; j--) {
            const real *row = panel + j * WIDTH;
            real sum = 0;
            for (int c = j + 1; c < NX; c++) sum += row[c] * own[c];
            own[j] -= inverse[j] * sum;
        }
    }
    return mhe_all_finite((count + 1) * NX, b);
}

/* The QP, or that of the nearest point that satisfies the rows, in the metric of its Hessian. */
static void mhe_build(mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest)
{
    mhe_assemble(e, k, offset);
    if (nearest) memset(k->gradient, 0, sizeof k->gradient);
    else mhe_add_bends(e, k);
}

/* Factorise the QP and solve it without inequalities; the increments are in k->step. */
static int mhe_solve_free(mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest)
{
    mhe_build(e, k, offset, nearest);
    for (int j = 0; j < (e->length + 1) * NX; j++) k->step[j] = -k->gradient[j];
    return mhe_factorise(k, e->length) && mhe_solve(k, e->length, k->step);
}
