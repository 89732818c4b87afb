/* The Gauss-Newton QP without inequalities: one block-banded Cholesky factorisation.
 *
 * Panel k holds, by rows, the upper half of the Hessian's diagonal block of d(k) and beside
 * it the block that couples d(k) with d(k+1). What lies left of the diagonal is not read for
 * its value. */

#define WIDTH MHE_WIDTH

/* Fill panels and gradient from the terms in workspace->at, around a trajectory that starts
 * at the given offset from the prior. */
static void mhe_assemble(const mhe_estimator *e, mhe_workspace *k, const real *offset)
{
    const mhe_settings *s = e->settings;
    const int count = e->length;
    const real *factors = k->factors;
    for (int i = 0; i <= count; i++) {
        real *panel = k->panels + i * NX * WIDTH, *g = k->gradient + i * NX;
        const real *weight = i == 0 ? s->prior_weight : s->disturbance_weight;
        const real factor = factors[i];
        for (int r = 0; r < NX; r++) {
            real *row = panel + r * WIDTH;
            for (int c = 0; c < NX; c++) row[c] = factor * weight[r * NX + c];
            for (int c = NX; c < WIDTH; c++) row[c] = 0;
        }
        if (i == 0) {
            mhe_times(NX, s->prior_weight, offset, g);
            for (int j = 0; j < NX; j++) g[j] *= factor;
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
}

/* Overwrite the panels by their Cholesky factor; whether they were positive definite. */
static int mhe_factorise(mhe_workspace *k, int count)
{
    for (int i = 0; i <= count; i++) {
        real *panel = k->panels + i * NX * WIDTH, *inverse = k->inverse_pivots + i * NX;
        for (int j = 0; j < NX; j++) {
            real *row = panel + j * WIDTH;
            const real pivot = row[j];
            if (!(pivot > 0) || !isfinite(pivot)) return 0;
            const real scale = 1 / sqrt(pivot);
            inverse[j] = scale;
            for (int c = j & ~3; c < WIDTH; c++) row[c] *= scale;
            for (int r = j + 1; r < NX; r++) {
                real *other = panel + r * WIDTH;
                const real factor = row[r];
                for (int c = r & ~3; c < WIDTH; c++) other[c] -= factor * row[c];
            }
        }
        if (i == count) break;
        real *next = panel + NX * WIDTH;
        for (int r = 0; r < NX; r++) {
            real sums[NX];
            for (int c = 0; c < NX; c++) sums[c] = 0;
            for (int j = 0; j < NX; j++) {
                const real *row = panel + j * WIDTH + NX, factor = row[r];
                for (int c = r & ~3; c < NX; c++) sums[c] += factor * row[c];
            }
            for (int c = r; c < NX; c++) next[r * WIDTH + c] -= sums[c];
        }
    }
    return 1;
}

/* b := H^-1 b; whether the result is finite. */
static int mhe_solve(const mhe_workspace *k, int count, real *b)
{
    for (int i = 0; i <= count; i++) {
        const real *panel = k->panels + i * NX * WIDTH, *inverse = k->inverse_pivots + i * NX;
        real *own = b + i * NX;
        for (int j = 0; j < NX; j++) {
            const real *row = panel + j * WIDTH, value = own[j] * inverse[j];
            own[j] = value;
            const int last = i < count ? 2 * NX : NX;
            for (int c = j + 1; c < last; c++) own[c] -= row[c] * value;
        }
    }
    for (int i = count; i >= 0; i--) {
        const real *panel = k->panels + i * NX * WIDTH, *inverse = k->inverse_pivots + i * NX;
        real *own = b + i * NX;
        const int last = i < count ? 2 * NX : NX;
        for (int j = NX - 1; j >= 0; j--) {
            const real *row = panel + j * WIDTH;
            real sums[4] = {0, 0, 0, 0}; /* four sums, so that they can be made side by side */
            int c = j + 1;
            for (; c + 4 <= last; c += 4)
                for (int q = 0; q < 4; q++) sums[q] += row[c + q] * own[c + q];
            for (; c < last; c++) sums[0] += row[c] * own[c];
            own[j] = (own[j] - ((sums[0] + sums[1]) + (sums[2] + sums[3]))) * inverse[j];
        }
    }
    return mhe_all_finite((count + 1) * NX, b);
}

/* The QP of the point nearest to the trajectory: H = I, g = 0. */
static void mhe_assemble_nearest(const mhe_estimator *e, mhe_workspace *k)
{
    memset(k->panels, 0, sizeof k->panels);
    memset(k->gradient, 0, sizeof k->gradient);
    for (int j = 0; j < (e->length + 1) * NX; j++) k->panels[j * WIDTH + j % NX] = 1;
}

static void mhe_build(const mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest)
{
    if (nearest)
        mhe_assemble_nearest(e, k);
    else
        mhe_assemble(e, k, offset);
}
