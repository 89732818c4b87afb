/* The QP with inequalities: a primal-dual interior-point method of Mehrotra's kind, whose
 * Newton matrices have the block-banded form of factor.c.
 *
 *     min d'H d / 2 + g'd   s.t.   low <= c(d) <= high
 *
 * The rows c of stage i are those of W (on d(i+1) - A d(i)) and of V (on -C d(i)): each set's
 * components first, then its general inequalities. */

enum { SOLVED, STOPPED, UNCONSTRAINED, FAILED };

/* Iterations after which rows are compared with what they were. */
#define STALL 8

#if CONSTRAINED

/* Limits of all rows about a trajectory with residuals w and v. */
static void mhe_set_limits(mhe_estimator *e, mhe_workspace *k, const real *w, const real *v)
{
    const mhe_settings *s = e->settings;
    real low[ROWS], high[ROWS];
    for (int i = 0; i < e->length; i++) {
        mhe_row *rows = k->rows + i * ROWS;
        mhe_stage_distances(e, i, w, v, low, high);
        for (int r = 0; r < ROWS; r++) {
            const int out = k->left_out[i * ROWS + r];
            rows[r].low = out & MHE_LOWER ? -INFINITY : low[r];
            rows[r].high = out & MHE_UPPER ? INFINITY : high[r];
        }
#if MHE_W_SET
        for (int j = 0; j < NX; j++) rows[j].scale = s->disturbances.scale[j];
        for (int j = 0; j < MHE_W_ROWS; j++) rows[NX + j].scale = s->disturbances.row_scale[j];
        rows += W_COUNT;
#endif
#if MHE_V_SET
        for (int j = 0; j < NY; j++) rows[j].scale = s->noises.scale[j];
        for (int j = 0; j < MHE_V_ROWS; j++) rows[NY + j].scale = s->noises.row_scale[j];
#endif
    }
}

static void mhe_values_of(int n, int count, const real *q, const real *rows, mhe_row *out)
{
    for (int j = 0; j < n; j++) out[j].value = q[j];
    for (int i = 0; i < count; i++) out[n + i].value = mhe_dot(n, rows + i * n, q);
}

/* rows.value = c(d). */
static void mhe_rows_times(const mhe_estimator *e, mhe_workspace *k, const real *d)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < e->length; i++) {
        mhe_row *rows = k->rows + i * ROWS;
        const real *own = d + i * NX;
#if MHE_W_SET
        real q[NX];
        for (int j = 0; j < NX; j++)
            q[j] = own[NX + j] - mhe_dot(NX, k->at[i]->f_jacobian + j * NX, own);
        mhe_values_of(NX, MHE_W_ROWS, q, s->disturbances.rows, rows);
        rows += W_COUNT;
#endif
#if MHE_V_SET
        real r[NY];
        for (int j = 0; j < NY; j++) r[j] = -mhe_dot(NX, k->at[i]->h_jacobian + j * NX, own);
        mhe_values_of(NY, MHE_V_ROWS, r, s->noises.rows, rows);
#endif
    }
    (void)s;
}

static void mhe_loads_of(int n, int count, const real *rows, const mhe_row *in, real *out)
{
    for (int j = 0; j < n; j++) out[j] = in[j].load;
    for (int i = 0; i < count; i++)
        for (int j = 0; j < n; j++) out[j] += in[n + i].load * rows[i * n + j];
}

/* out += c' load. */
static void mhe_add_loads(const mhe_estimator *e, const mhe_workspace *k, real *out)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < e->length; i++) {
        const mhe_row *rows = k->rows + i * ROWS;
        real *own = out + i * NX;
#if MHE_W_SET
        real w[NX];
        const real *A = k->at[i]->f_jacobian;
        mhe_loads_of(NX, MHE_W_ROWS, s->disturbances.rows, rows, w);
        for (int r = 0; r < NX; r++) {
            own[NX + r] += w[r];
            for (int j = 0; j < NX; j++) own[j] -= w[r] * A[r * NX + j];
        }
        rows += W_COUNT;
#endif
#if MHE_V_SET
        real v[NY];
        const real *C = k->at[i]->h_jacobian;
        mhe_loads_of(NY, MHE_V_ROWS, s->noises.rows, rows, v);
        for (int r = 0; r < NY; r++)
            for (int j = 0; j < NX; j++) own[j] -= v[r] * C[r * NX + j];
#endif
    }
    (void)s;
}

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
    for (int i = 0; i < e->length; i++) {
        const mhe_row *rows = k->rows + i * ROWS;
        real *panel = k->panels + i * NX * WIDTH;
#if MHE_W_SET
        const real *A = k->at[i]->f_jacobian;
        real *next = panel + NX * WIDTH;
        for (int r = 0; r < NX; r++) {
            const real weight = rows[r].weight;
            if (weight == 0) continue;
            mhe_add_square(panel, weight, A + r * NX);
            next[r * WIDTH + r] += weight;
            for (int j = 0; j < NX; j++) panel[j * WIDTH + NX + r] -= weight * A[r * NX + j];
        }
        for (int r = 0; r < MHE_W_ROWS; r++) {
            const real weight = rows[NX + r].weight, *row = s->disturbances.rows + r * NX;
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
        rows += W_COUNT;
#endif
#if MHE_V_SET
        const real *C = k->at[i]->h_jacobian;
        for (int r = 0; r < NY; r++)
            if (rows[r].weight != 0) mhe_add_square(panel, rows[r].weight, C + r * NX);
        for (int r = 0; r < MHE_V_ROWS; r++) {
            const real *row = s->noises.rows + r * NY;
            real c[NX];
            if (rows[NY + r].weight == 0) continue;
            for (int j = 0; j < NX; j++) {
                c[j] = 0;
                for (int q = 0; q < NY; q++) c[j] += row[q] * C[q * NX + j];
            }
            mhe_add_square(panel, rows[NY + r].weight, c);
        }
#endif
    }
    (void)s;
}

/* The largest miss of a row in its scale; rows.value = c(d) afterwards. */
static real mhe_row_violation(const mhe_estimator *e, mhe_workspace *k, const real *d)
{
    real worst = 0;
    mhe_rows_times(e, k, d);
    for (int i = 0; i < e->length * ROWS; i++) {
        const mhe_row *row = k->rows + i;
        worst = fmax(worst, fmax(row->low - row->value, row->value - row->high) / row->scale);
    }
    return worst;
}

/* out = H d, from the panels before they are factorised. */
static void mhe_hessian_times(const mhe_workspace *k, int count, const real *d, real *out)
{
    for (int j = 0; j < (count + 1) * NX; j++) out[j] = 0;
    for (int i = 0; i <= count; i++) {
        const real *panel = k->panels + i * NX * WIDTH;
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

/* The largest ratio of a decrease to its variable, kept as a fraction: no division each. */
typedef struct {
    real decrease, variable;
} mhe_ratio;

static void mhe_meet(mhe_ratio *worst, real variable, real change)
{
    if (-change * worst->variable > worst->decrease * variable) {
        worst->decrease = -change;
        worst->variable = variable;
    }
}

/* Right-hand side of the Newton equations for a target of the complementarity products. */
static void mhe_set_loads(const mhe_estimator *e, mhe_workspace *k, real target)
{
    for (int i = 0; i < e->length * ROWS; i++) {
        mhe_row *q = k->rows + i;
        q->load = 0;
        if (q->dual_low > 0)
            q->load += (target - q->correction_low - q->dual_low * q->residual_low) *
                           q->inverse_low - q->dual_low;
        if (q->dual_high > 0)
            q->load -= (target - q->correction_high - q->dual_high * q->residual_high) *
                           q->inverse_high - q->dual_high;
    }
    memcpy(k->direction, k->residual, sizeof(real) * (size_t)(e->length + 1) * NX);
    mhe_add_loads(e, k, k->direction);
}

/* Changes of one row's variables along the direction, whose c is in `value`. */
static void mhe_changes(const mhe_row *q, real target, real *changes)
{
    for (int side = 0; side < 4; side++) changes[side] = 0;
    if (q->dual_low > 0) {
        changes[0] = q->value + q->residual_low;
        changes[1] = (target - q->correction_low - q->dual_low * changes[0]) * q->inverse_low -
                     q->dual_low;
    }
    if (q->dual_high > 0) {
        changes[2] = q->residual_high - q->value;
        changes[3] = (target - q->correction_high - q->dual_high * changes[2]) * q->inverse_high -
                     q->dual_high;
    }
}

/* Solve the QP whose limits and terms are in place; `step` holds the minimiser without
 * inequalities and `promise` its |g'd|. A dual variable of 0 marks a side that is not there.
 * No unit matters: rows are compared with their scales, products of slacks and duals with what
 * the objective has to gain or to pay, gradients with the roots of the Hessian's diagonal. */
static int mhe_interior_point(const mhe_estimator *e, mhe_workspace *k, const real *offset,
                              int nearest, real promise, int limit, int *iterations)
{
    const mhe_settings *s = e->settings;
    const int count = e->length, size = (count + 1) * NX, rows = count * ROWS;
    const real missed = mhe_row_violation(e, k, k->step);
    real products = 0, far = INFINITY;
    int sides = 0;
    memset(k->step, 0, sizeof(real) * (size_t)size);
    const real outside = mhe_row_violation(e, k, k->step);
    const real scale = fmax(promise, outside * outside);
    /* Generous products: from smaller ones it creeps on some QPs. */
    const real start = fmax(scale, EPSILON * EPSILON);
    for (int i = 0; i < rows; i++) {
        mhe_row *q = k->rows + i;
        q->dual_low = q->dual_high = 0;
        q->slack_low = q->slack_high = 1;
        q->residual_low = q->residual_high = 0;
        if (isfinite(q->low)) {
            q->slack_low = fmax(-q->low, missed * q->scale);
            q->dual_low = start / q->slack_low;
            sides++;
        }
        if (isfinite(q->high)) {
            q->slack_high = fmax(q->high, missed * q->scale);
            q->dual_high = start / q->slack_high;
            sides++;
        }
    }
    if (!sides) return SOLVED;
    for (*iterations = 0;; ++*iterations) {
        real infeasible = 0, unbalanced = 0, length = 1, after = 0;
        mhe_build(e, k, offset, nearest);
        mhe_hessian_times(k, count, k->step, k->product);
        mhe_rows_times(e, k, k->step);
        products = 0;
        for (int i = 0; i < rows; i++) {
            mhe_row *q = k->rows + i;
            q->correction_low = q->correction_high = 0;
            q->weight = 0;
            if (q->dual_low > 0) {
                q->residual_low = q->value - q->low - q->slack_low;
                infeasible = fmax(infeasible, fabs(q->residual_low) / q->scale);
                products += q->slack_low * q->dual_low;
                q->inverse_low = 1 / q->slack_low;
                q->weight += q->dual_low * q->inverse_low;
            }
            if (q->dual_high > 0) {
                q->residual_high = q->high - q->value - q->slack_high;
                infeasible = fmax(infeasible, fabs(q->residual_high) / q->scale);
                products += q->slack_high * q->dual_high;
                q->inverse_high = 1 / q->slack_high;
                q->weight += q->dual_high * q->inverse_high;
            }
            q->load = q->dual_low - q->dual_high;
        }
        for (int j = 0; j < size; j++) k->residual[j] = -k->product[j] - k->gradient[j];
        mhe_add_loads(e, k, k->residual);
        for (int j = 0; j < size; j++) {
            const real curvature = k->panels[j * WIDTH + j % NX];
            unbalanced = fmax(unbalanced, k->residual[j] * k->residual[j] / curvature);
        }
        if (infeasible <= s->solver_tolerance / 100 &&
            unbalanced <= s->solver_tolerance * s->solver_tolerance * scale &&
            products <= s->solver_tolerance / 1000 * scale)
            return SOLVED;
        if (*iterations >= limit) return STOPPED;
        /* Of rows that exclude each other, residuals hardly shrink. */
        if (*iterations % STALL == 0) {
            if (infeasible > s->solver_tolerance / 100 && infeasible > far / 2) return STOPPED;
            far = infeasible;
        }
        mhe_add_weights(e, k);
        if (!mhe_factorise(k, count)) return *iterations ? STOPPED : FAILED;
        real target = 0;
        for (int corrector = 0; corrector < 2; corrector++) {
            mhe_set_loads(e, k, target);
            if (!mhe_solve(k, count, k->direction)) return *iterations ? STOPPED : FAILED;
            mhe_rows_times(e, k, k->direction);
            mhe_ratio worst = {1, 1};
            for (int i = 0; i < rows; i++) {
                const mhe_row *q = k->rows + i;
                real change[4];
                mhe_changes(q, target, change);
                mhe_meet(&worst, q->slack_low, change[0]);
                mhe_meet(&worst, q->dual_low, change[1]);
                mhe_meet(&worst, q->slack_high, change[2]);
                mhe_meet(&worst, q->dual_high, change[3]);
            }
            length = worst.variable / worst.decrease;
            if (corrector) break;
            after = 0;
            for (int i = 0; i < rows; i++) {
                mhe_row *q = k->rows + i;
                real change[4];
                mhe_changes(q, target, change);
                if (q->dual_low > 0)
                    after += (q->slack_low + length * change[0]) *
                             (q->dual_low + length * change[1]);
                if (q->dual_high > 0)
                    after += (q->slack_high + length * change[2]) *
                             (q->dual_high + length * change[3]);
                /* Of a step that was cut short, the second order would be misleading:
                 * with the whole of it there are QPs on which it cycles. */
                q->correction_low = length * length * change[0] * change[1];
                q->correction_high = length * length * change[2] * change[3];
            }
            const real ratio = after / products;
            target = ratio * ratio * ratio * products / sides;
        }
        length *= (real)0.995;
        if (!(length > 1e-10)) return STOPPED;
        for (int j = 0; j < size; j++) k->step[j] += length * k->direction[j];
        for (int i = 0; i < rows; i++) {
            mhe_row *q = k->rows + i;
            real change[4];
            mhe_changes(q, target, change);
            if (q->dual_low > 0) {
                q->slack_low += length * change[0];
                q->dual_low += length * change[1];
            }
            if (q->dual_high > 0) {
                q->slack_high += length * change[2];
                q->dual_high += length * change[3];
            }
        }
    }
}

#endif
