/* The Gauss-Newton QP where some directions of x(i+1) - f have no disturbance. No weight stands in
 * for what is exact there: the increments follow
 *
 *     d(i+1) = A d(i) + F e(i) + c(i)
 *
 * with the disturbances e(i) in the free directions F, and all terms are rows of a least-squares
 * problem in d(0) and the e(i). Householder reflections with row interchanges turn the rows that
 * d(i+1), ..., d(K) are in into rows S(i+1) of d(i+1) alone, from the last stage to the first; the prior
 * comes last. So nothing is squared, and a prior may be as vague as it likes beside the noise (Powell
 * and Reid, IFIP Congress 1968; Cox and Higham, BIT 38, 1998).
 *
 * Of the settings: x(i+1) - f = free e + shift, and e = free_inverse (x(i+1) - f). */

@types
/* Rows of a least-squares problem, and the reflections that turn them into `rank` rows, each with zeros
 * before its column `lead`; the first `free` of these are of disturbances. Columns are padded. */
#define MHE_COLUMNS ((MHE_FREE + MHE_NX + 3) / 4 * 4)
#define MHE_BENDS (MHE_G_ROWS > 0 ? 2 * MHE_NX : 0) /* rows of the curvature of constraints */
#define MHE_EQUATIONS (MHE_FREE + 2 * MHE_NX + MHE_NY + MHE_BENDS + MHE_STAGE_ROWS)
typedef struct {
    mhe_real rows[MHE_EQUATIONS * MHE_COLUMNS];
    mhe_real mirrors[MHE_COLUMNS * MHE_EQUATIONS], share[MHE_COLUMNS];
    mhe_real root[MHE_SIZE(MHE_STAGE_ROWS)];
    int32_t lead[MHE_COLUMNS], other[MHE_COLUMNS], source[MHE_SIZE(MHE_STAGE_ROWS)];
    int32_t count, rank, free, inequalities;
} mhe_block;
@mhe_workspace
    mhe_block blocks[MHE_HORIZON + 1];
    mhe_block start;                  /* of the first state alone */
    int32_t order[MHE_NX];            /* of its columns */
    mhe_real sides_of[(MHE_HORIZON + 1) * MHE_EQUATIONS]; /* right-hand sides of the blocks' rows */
    mhe_real targets[MHE_HORIZON * (MHE_FREE + MHE_NY)], drift[(MHE_HORIZON + 1) * MHE_NX];
    mhe_real free_root[MHE_SIZE(MHE_FREE * MHE_FREE)], noise_root[MHE_NY * MHE_NY];
    mhe_real free_roots[MHE_HORIZON * MHE_SIZE(MHE_FREE * MHE_FREE)];
    mhe_real noise_roots[MHE_HORIZON * MHE_NY * MHE_NY];
    mhe_real prior_root[MHE_NX * MHE_NX], prior_gradient[MHE_NX], first_target[MHE_NX];
    mhe_real curvature[MHE_NX + MHE_HORIZON * MHE_FREE];
    const mhe_real *limits_w;         /* disturbances about which the limits are */
    const mhe_trial *around;          /* the trial that the QP is around */
@
#define COLUMNS MHE_COLUMNS
#define EQUATIONS MHE_EQUATIONS

/* Shorter columns are zeros: the inverse of their square would not be finite. */
#define LEAST_NORM (sizeof(real) == 8 ? (real)1e-150 : (real)1e-18)

/* Entry c of the row that reflection j has made. */
static real mhe_entry(const mhe_block *b, int j, int c)
{
    return c < b->lead[j] ? 0 : b->rows[j * COLUMNS + c];
}

/* a'b in four sums side by side: one after the other, the latency of each addition would be most of
 * the time. */
static real mhe_sum_of_products(int n, const real *restrict a, const real *restrict b)
{
    real sums[4] = {0, 0, 0, 0};
    int i = 0;
    for (; i + 4 <= n; i += 4)
        for (int l = 0; l < 4; l++) sums[l] += a[i + l] * b[i + l];
    for (int l = 0; i < n; i++, l++) sums[l] += a[i] * b[i];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

/* Reflection of the rows from j on, to zeros in column c below row j, which are not written. 0 where
 * there are zeros only. Rows are updated by fours of columns, so that a compiler can keep them in
 * registers; what lies left of column c is not read again. */
static int mhe_reflect(mhe_block *b, int j, int c)
{
    real *restrict row = b->rows + j * COLUMNS, *restrict mirror = b->mirrors + j * EQUATIONS;
    real largest = 0;
    const int last = b->count;
    int at = j;
    for (int i = j; i < last; i++) {
        const real value = b->rows[i * COLUMNS + c];
        mirror[i] = value;
        if (fabs(value) > largest) largest = fabs(value), at = i;
    }
    const real norm = sqrt(mhe_sum_of_products(last - j, mirror + j, mirror + j));
    if (norm < LEAST_NORM) return 0; /* not where it is NaN */
    b->lead[j] = c;
    b->other[j] = at;
    if (at != j) {
        real *restrict other = b->rows + at * COLUMNS;
        const real value = mirror[j];
        mirror[j] = mirror[at], mirror[at] = value;
        for (int q = 0; q < COLUMNS; q++) {
            const real moved = row[q];
            row[q] = other[q], other[q] = moved;
        }
    }
    const real first = mirror[j], pivot = first > 0 ? -norm : norm;
    const real share = 1 / (norm * (norm + fabs(first)));
    b->share[j] = share;
    mirror[j] -= pivot;
    real sums[COLUMNS];
    const int start = c / 4 * 4;
    for (int q = start; q < COLUMNS; q++) sums[q] = 0;
    for (int i = j; i < last; i++) {
        const real *restrict own = b->rows + i * COLUMNS, value = share * mirror[i];
        if (value == 0) continue; /* most rows have few numbers */
        for (int q = start; q < COLUMNS; q += 4)
            for (int l = 0; l < 4; l++) sums[q + l] += value * own[q + l];
    }
    for (int i = j; i < last; i++) {
        real *restrict own = b->rows + i * COLUMNS;
        const real value = mirror[i];
        if (value == 0) continue;
        for (int q = start; q < COLUMNS; q += 4)
            for (int l = 0; l < 4; l++) own[q + l] -= value * sums[q + l];
    }
    row[c] = pivot;
    return 1;
}

/* Apply a block's reflections to the right-hand side of its rows. */
static void mhe_apply(const mhe_block *b, real *restrict side)
{
    for (int j = 0; j < b->rank; j++) {
        const real *restrict mirror = b->mirrors + j * EQUATIONS;
        const real first = side[j];
        side[j] = side[b->other[j]];
        side[b->other[j]] = first;
        const real sum = b->share[j] * mhe_sum_of_products(b->count - j, mirror + j, side + j);
        for (int i = j; i < b->count; i++) side[i] -= sum * mirror[i];
    }
}

/* rows = U B for an upper triangular U (n, n) and B (n, k). */
static void mhe_weigh_rows(int n, const real *U, int k, const real *B, int width, real *rows)
{
    for (int i = 0; i < n; i++) {
        real *row = rows + i * width;
        for (int c = 0; c < k; c++) row[c] = 0;
        for (int j = i; j < n; j++) {
            const real u = U[i * n + j];
            if (u == 0) continue;
            for (int c = 0; c < k; c++) row[c] += u * B[j * k + c];
        }
    }
}

/* side := U'^-1 side, 0 where U has no pivot. */
static void mhe_solve_transposed(int n, const real *U, real *side)
{
    for (int j = 0; j < n; j++) {
        const real pivot = U[j * n + j];
        side[j] = pivot == 0 ? 0 : side[j] / pivot;
        for (int i = j + 1; i < n; i++) side[i] -= U[j * n + i] * side[j];
    }
}

/* own = -(A' Q w + C' R v). */
static void mhe_set_own_terms(const real *Q, const real *R, const real *w, const real *v,
                              mhe_terms *t)
{
    const real *A = t->f_jacobian, *C = t->h_jacobian;
    (void)Q; (void)w;
    for (int j = 0; j < NX; j++) t->own[j] = 0;
    for (int k = 0; k < NX; k++)
        for (int j = 0; j < NX; j++) t->own[j] -= t->following[k] * A[k * NX + j];
    for (int k = 0; k < NY; k++) {
        const real force = mhe_scaled(mhe_dot(NY, R + k * NY, v), t->noise_scale, k);
        for (int j = 0; j < NX; j++) t->own[j] -= force * C[k * NX + j];
    }
}

/* An entry of F, whose columns are the directions that have disturbances. */
static real mhe_free_direction(const mhe_settings *s, int row, int column)
{
    return s->elimination.free[row * MHE_FREE + column];
}

/* Roots of the weights of stage i: of e, and of the observed outputs. */
static void mhe_set_roots(mhe_estimator *e, mhe_workspace *k, int i)
{
    const mhe_settings *s = e->settings;
    const mhe_stage *stage = mhe_stage_at(e, i);
    const real *F = s->elimination.free, *Q = mhe_disturbance_weight(s, stage), *R = stage->noise_weight;
    real scaled[NX * NX], product[SIZE(NX * MHE_FREE)], weight[SIZE(MHE_FREE * MHE_FREE)], V[NY * NY];
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < NX; c++)
            scaled[r * NX + c] = mhe_scaled(Q[r * NX + c], k->at[i]->disturbance_scale, r);
    mhe_multiply(NX, NX, MHE_FREE, scaled, F, product);
    for (int j = 0; j < MHE_FREE * MHE_FREE; j++) weight[j] = 0;
    mhe_add_product(NX, MHE_FREE, MHE_FREE, F, product, weight);
    mhe_root(MHE_FREE, weight, k->free_root);
    for (int r = 0; r < NY; r++)
        for (int c = 0; c < NY; c++)
            V[r * NY + c] = mhe_scaled(R[r * NY + c], k->at[i]->noise_scale, r);
    mhe_root(NY, V, k->noise_root);
}

/* The gradient, in the increments as if all of them were free, around a trajectory that starts at
 * the given offset from the prior; and the root of the first state's weight. */
static void mhe_assemble(mhe_estimator *e, mhe_workspace *k, const real *offset)
{
    const mhe_settings *s = e->settings;
    const int count = e->length;
    const real factor = k->factors[0], *weight = k->prior.weight;
    real scale[NX], first[NX * NX];
    mhe_set_scale(&s->prior_loss, 1, NX, weight, offset, scale);
    const real *root = mhe_root_of_prior(&k->prior);
    (void)s;
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < NX; c++)
            first[r * NX + c] = root ? 0 : mhe_scaled(factor, scale, r) * weight[r * NX + c];
    if (root) {
        mhe_prior_force(&k->prior, offset, k->gradient);
        for (int j = 0; j < NX; j++) k->gradient[j] *= factor;
    } else
        mhe_times(NX, first, offset, k->gradient);
    mhe_add_further(e, k, factor, first, NX);
    memcpy(k->prior_gradient, k->gradient, sizeof k->prior_gradient);
    for (int j = 0; k->damping > 0 && j < NX; j++)
        first[j * NX + j] += k->damping * (first[j * NX + j] + k->seen[j]);
    mhe_root(NX, first, k->prior_root);
    if (root) mhe_join_prior_root(root, factor, k->prior_root);
    for (int i = 0; i < count; i++) {
        const real next = k->factors[i + 1];
        const mhe_terms *t = k->at[i];
        for (int j = 0; j < NX; j++) {
            k->gradient[i * NX + j] += next * t->own[j];
            k->gradient[(i + 1) * NX + j] = next * t->following[j];
        }
    }
}

/* An entry of the diagonal of the first state's weight, without the data; and its form. */
static real mhe_first_diagonal(const mhe_workspace *k, int j)
{
    real square = 0;
    for (int r = 0; r <= j; r++) square += k->prior_root[r * NX + j] * k->prior_root[r * NX + j];
    return square;
}

static real mhe_first_form(const mhe_workspace *k, const real *d)
{
    real square = 0;
    for (int r = 0; r < NX; r++) {
        const real one = mhe_dot(NX - r, k->prior_root + r * NX + r, d + r);
        square += one * one;
    }
    return square;
}

/* Another row of an inequality. */
static void mhe_add_row(mhe_block *b, int at, real weight, int first, int n, const real *row, real sign)
{
    if (weight == 0) return;
    real *out = b->rows + b->count * COLUMNS;
    const real root = sqrt(weight);
    for (int c = 0; c < COLUMNS; c++) out[c] = 0;
    for (int c = 0; c < n; c++) out[first + c] = sign * root * row[c];
    b->source[b->inequalities] = at;
    b->root[b->inequalities++] = root;
    b->count++;
}

/* Rows of the inequalities of stage i that have weights. */
static void mhe_add_inequalities(const mhe_estimator *e, mhe_workspace *k, int i)
{
    const mhe_settings *s = e->settings;
    mhe_block *b = k->blocks + i;
    int at = i * ROWS;
    const real *weights = k->rows.weight + at;
    const real *F = s->elimination.free;
    real row[NX > NY ? NX : NY];
    (void)s; (void)F; (void)row;
    if (MHE_W_SET) {
        for (int r = 0; r < NX + MHE_W_ROWS && i < e->length; r++) {
            if (weights[r] == 0) continue;
            for (int c = 0; c < MHE_FREE; c++) {
                row[c] = r < NX ? F[r * MHE_FREE + c] : 0;
                for (int j = 0; r >= NX && j < NX; j++)
                    row[c] += s->disturbances.rows[(r - NX) * NX + j] * F[j * MHE_FREE + c];
            }
            mhe_add_row(b, at + r, weights[r], 0, MHE_FREE, row, 1);
        }
        weights += W_COUNT, at += W_COUNT;
    }
    if (MHE_V_SET) {
        for (int r = 0; r < NY + MHE_V_ROWS && i < e->length; r++) {
            const real *C = k->at[i]->h_jacobian;
            if (weights[r] == 0) continue;
            for (int c = 0; c < NX; c++) {
                row[c] = r < NY ? C[r * NX + c] : 0;
                for (int j = 0; r >= NY && j < NY; j++)
                    row[c] += s->noises.rows[(r - NY) * NY + j] * C[j * NX + c];
            }
            mhe_add_row(b, at + r, weights[r], MHE_FREE, NX, row, -1);
        }
        weights += V_COUNT, at += V_COUNT;
    }
    if (MHE_X_SET) {
        for (int r = 0; r < NX; r++) {
            const real one = 1;
            mhe_add_row(b, at + r, weights[r], MHE_FREE + r, 1, &one, 1);
        }
        for (int r = 0; r < MHE_X_ROWS; r++)
            mhe_add_row(b, at + NX + r, weights[NX + r], MHE_FREE, NX, s->states.rows + r * NX, 1);
    }
    mhe_add_value_rows(e, k, i, b);
    (void)at; (void)weights;
}

/* Make all rows and eliminate; `weighted`: with the rows of inequalities that have weights. 0 where
 * a number is not finite or the first state is not determined. */
static int mhe_factorise(mhe_estimator *e, mhe_workspace *k, int weighted)
{
    const real *F = e->settings->elimination.free;
    const int count = e->length;
    int is_usual = 0; /* whether the roots are those of the usual weights */
    for (int i = count; i >= 0; i--) {
        mhe_block *b = k->blocks + i;
        const mhe_block *later = b + 1;
        b->count = b->rank = b->free = b->inequalities = 0;
        if (i < count) {
            const real *A = k->at[i]->f_jacobian, next = sqrt(k->factors[i + 1]);
            const mhe_stage *stage = mhe_stage_at(e, i);
            real *root = k->free_roots + i * SIZE(MHE_FREE * MHE_FREE);
            real *noise = k->noise_roots + i * NY * NY;
            const int is_special = MHE_LOSS || stage->has_own_disturbance ||
                                   stage->has_own_noise || !stage->is_complete;
            if (is_special || !is_usual) mhe_set_roots(e, k, i);
            is_usual = !is_special;
            const real damped = next * sqrt(1 + k->damping);
            for (int j = 0; j < MHE_FREE * MHE_FREE; j++) root[j] = damped * k->free_root[j];
            for (int j = 0; j < NY * NY; j++) noise[j] = next * k->noise_root[j];
            for (int r = 0; r < MHE_FREE; r++) {
                real *row = b->rows + r * COLUMNS;
                for (int c = 0; c < MHE_FREE; c++) row[c] = root[r * MHE_FREE + c];
                for (int c = MHE_FREE; c < COLUMNS; c++) row[c] = 0;
            }
            b->count = MHE_FREE;
            mhe_weigh_rows(NY, noise, NX, k->at[i]->h_jacobian, COLUMNS,
                           b->rows + MHE_FREE * COLUMNS + MHE_FREE);
            for (int r = 0; r < NY; r++)
                for (int c = 0; c < MHE_FREE; c++) b->rows[(MHE_FREE + r) * COLUMNS + c] = 0;
            b->count += NY;
            mhe_add_bend_rows(e, k, i, b);
            if (weighted) mhe_add_inequalities(e, k, i);
            for (int j = later->free; j < later->rank; j++) {
                real *row = b->rows + b->count++ * COLUMNS;
                for (int c = 0; c < COLUMNS; c++) row[c] = 0;
                for (int l = later->lead[j] - MHE_FREE; l < NX; l++) {
                    const real value = mhe_entry(later, j, MHE_FREE + l);
                    for (int c = 0; c < MHE_FREE; c++) row[c] += value * F[l * MHE_FREE + c];
                    for (int c = 0; c < NX; c++) row[MHE_FREE + c] += value * A[l * NX + c];
                }
            }
        }
        else {
            mhe_add_bend_rows(e, k, i, b);
            if (MHE_END_ROWS && weighted) mhe_add_inequalities(e, k, i);
        }
        for (int c = 0; c < MHE_FREE + NX && b->rank < b->count; c++) {
            b->rank += mhe_reflect(b, b->rank, c);
            if (c < MHE_FREE) b->free = b->rank;
        }
    }
    /* The first state: what all samples say, and the prior; the largest columns first. */
    mhe_block *b = &k->start;
    const mhe_block *data = k->blocks;
    b->count = 0;
    for (int j = 0; j < NX; j++) k->order[j] = j;
    memset(b->rows, 0, sizeof(real) * (size_t)(data->rank - data->free + NX) * COLUMNS);
    for (int j = data->free; j < data->rank; j++, b->count++)
        for (int c = 0; c < NX; c++)
            b->rows[b->count * COLUMNS + c] = mhe_entry(data, j, MHE_FREE + c);
    for (int j = 0; j < NX; j++, b->count++)
        for (int c = j; c < NX; c++)
            b->rows[b->count * COLUMNS + c] = k->prior_root[j * NX + c];
    for (int j = 0; j < NX; j++) {
        real most = -1;
        int at = j;
        for (int c = j; c < NX; c++) {
            real square = 0;
            for (int i = j; i < b->count; i++)
                square += b->rows[i * COLUMNS + c] * b->rows[i * COLUMNS + c];
            if (square > most) most = square, at = c;
        }
        if (at != j) {
            const int other = k->order[j];
            k->order[j] = k->order[at], k->order[at] = other;
            for (int i = 0; i < b->count; i++) {
                real *row = b->rows + i * COLUMNS;
                const real value = row[j];
                row[j] = row[at], row[at] = value;
            }
        }
        if (!mhe_reflect(b, j, j) || !isfinite(b->rows[j * COLUMNS + j])) return 0;
    }
    b->rank = NX;
    return 1;
}

/* What the rows of the cost ask for, and by how much the increments `step` (0 for none) miss the
 * roll-out: right-hand sides for the rest of the way. */
static void mhe_set_targets(mhe_estimator *e, mhe_workspace *k, const real *step, int nearest)
{
    const mhe_settings *s = e->settings;
    const real *F = s->elimination.free, *inverse = s->elimination.free_inverse;
    for (int i = 0; i < e->length; i++) {
        const mhe_terms *t = k->at[i];
        const real *Q = mhe_disturbance_weight(s, mhe_stage_at(e, i));
        const real *own = step + i * NX, next = k->factors[i + 1];
        real *drift = k->drift + i * NX, *target = k->targets + i * (MHE_FREE + NY);
        real w[NX], v[NY], moved[NX], free_part[SIZE(MHE_FREE)], weighed[NX];
        for (int j = 0; j < NX; j++) {
            moved[j] = step ? own[NX + j] - mhe_dot(NX, t->f_jacobian + j * NX, own) : 0;
            w[j] = k->limits_w[i * NX + j] + moved[j];
        }
        for (int c = 0; c < MHE_FREE; c++) free_part[c] = mhe_dot(NX, inverse + c * NX, w);
        for (int j = 0; j < NX; j++) {
            drift[j] = s->elimination.shift[j] - w[j] + mhe_dot(MHE_FREE, F + j * MHE_FREE, free_part);
            w[j] = (moved[j] + drift[j]) * (1 + k->damping) +
                   (nearest ? 0 : k->around->w[i * NX + j]);
        }
        mhe_times(NX, Q, w, weighed);
        for (int c = 0; c < MHE_FREE; c++) target[c] = 0;
        for (int j = 0; j < NX; j++) {
            const real force = next * mhe_scaled(weighed[j], t->disturbance_scale, j);
            for (int c = 0; c < MHE_FREE; c++) target[c] -= force * F[j * MHE_FREE + c];
        }
        mhe_solve_transposed(MHE_FREE, k->free_roots + i * SIZE(MHE_FREE * MHE_FREE), target);
        for (int j = 0; j < NY; j++) {
            v[j] = nearest ? 0 : k->around->v[i * NY + j];
            if (step) v[j] -= mhe_dot(NX, t->h_jacobian + j * NX, own);
        }
        mhe_times(NY, k->noise_roots + i * NY * NY, v, target + MHE_FREE);
    }
    for (int j = 0; j < NX; j++) k->first_target[j] = nearest ? 0 : -k->prior_gradient[j];
    mhe_solve_transposed(NX, k->prior_root, k->first_target);
    if (step)
        for (int j = 0; j < NX; j++) k->first_target[j] -= mhe_dot(NX, k->prior_root + j * NX, step);
    mhe_set_bend_targets(e, k, step);
}

/* The increments that come closest to the targets and to the loads of inequalities, or with `push` to
 * these loads alone; whether they are finite. */
static int mhe_solve(mhe_estimator *e, mhe_workspace *k, int push, real *out)
{
    const mhe_settings *s = e->settings;
    const int count = e->length;
    real pull[NX] = {0};
    (void)pull; /* no row pulls */
    for (int i = count; i >= 0; i--) {
        const mhe_block *b = k->blocks + i, *later = b + 1;
        const real *drift = k->drift + i * NX, *target = k->targets + i * (MHE_FREE + NY);
        real *side = k->sides_of + i * EQUATIONS;
        int at = 0;
        for (; i < count && at < MHE_FREE + NY; at++) side[at] = push ? 0 : target[at];
        at = mhe_bend_sides(k, i, push, at, side);
        for (int j = 0; j < b->inequalities; j++, at++) {
            const int row = b->source[j];
            side[at] = k->rows.load[row] / b->root[j];
            if (!push) side[at] -= b->root[j] * mhe_value_drift(e, k, row);
            if (MHE_W_SET) {
                const int r = row - i * ROWS;
                if (push || r >= W_COUNT) continue;
                side[at] -= b->root[j] *
                            (r < NX ? drift[r]
                                    : mhe_dot(NX, s->disturbances.rows + (r - NX) * NX, drift));
            }
        }
        for (int j = later->free; i < count && j < later->rank; j++, at++) {
            side[at] = side[EQUATIONS + j];
            for (int l = later->lead[j] - MHE_FREE; l < NX && !push; l++)
                side[at] -= mhe_entry(later, j, MHE_FREE + l) * drift[l];
        }
        mhe_apply(b, side);
        mhe_pull_side(e, k, i, side, pull);
    }
    const mhe_block *start = &k->start, *data = k->blocks;
    real side[2 * NX], first[NX];
    int at = 0;
    for (int j = data->free; j < data->rank; j++) side[at++] = k->sides_of[j];
    for (int j = 0; j < NX; j++) side[at++] = push ? 0 : k->first_target[j];
    mhe_apply(start, side);
    mhe_pull_first(k, side, pull);
    for (int j = NX - 1; j >= 0; j--) {
        real sum = side[j];
        for (int c = j + 1; c < NX; c++) sum -= start->rows[j * COLUMNS + c] * first[c];
        first[j] = sum / start->rows[j * COLUMNS + j];
    }
    for (int j = 0; j < NX; j++) out[k->order[j]] = first[j];
    for (int i = 0; i < count; i++) {
        const mhe_block *b = k->blocks + i;
        const real *own = out + i * NX, *given = k->sides_of + i * EQUATIONS;
        real *next = out + (i + 1) * NX, disturbance[SIZE(MHE_FREE)] = {0};
        for (int j = b->free - 1; j >= 0; j--) {
            const real *row = b->rows + j * COLUMNS;
            real sum = given[j] - mhe_dot(NX, row + MHE_FREE, own);
            for (int c = b->lead[j] + 1; c < MHE_FREE; c++) sum -= row[c] * disturbance[c];
            disturbance[b->lead[j]] = sum / b->rows[j * COLUMNS + b->lead[j]];
        }
        for (int j = 0; j < NX; j++)
            next[j] = mhe_dot(NX, k->at[i]->f_jacobian + j * NX, own) +
                      mhe_dot(MHE_FREE, s->elimination.free + j * MHE_FREE, disturbance) +
                      (push ? 0 : k->drift[i * NX + j]);
    }
    return mhe_all_finite((count + 1) * NX, out);
}

/* The curvatures of d(0) and of each e(i), from the rows without inequalities. */
static void mhe_set_curvatures(const mhe_estimator *e, mhe_workspace *k)
{
    for (int c = 0; c < NX; c++) {
        real *square = k->curvature + k->order[c];
        *square = 0;
        for (int j = 0; j <= c; j++) {
            const real value = mhe_entry(&k->start, j, c);
            *square += value * value;
        }
    }
    for (int i = 0; i < e->length; i++)
        for (int c = 0; c < MHE_FREE; c++) {
            real *square = k->curvature + NX + i * MHE_FREE + c;
            *square = 0;
            for (int j = 0; j < k->blocks[i].free; j++) {
                const real value = mhe_entry(k->blocks + i, j, c);
                *square += value * value;
            }
        }
}

static real mhe_squared_share(real force, real curvature)
{
    return curvature > 0 ? force * force / curvature : 0;
}

/* The largest square of a force on d(0) or an e(i), by its curvature, where k->residual holds the
 * forces of inequalities on all d, as if they were free; these are overwritten. */
static real mhe_largest_force(mhe_estimator *e, mhe_workspace *k)
{
    const real *F = e->settings->elimination.free;
    real worst = 0;
    mhe_add_bend_forces(e, k, k->residual);
    for (int i = e->length - 1; i >= 0; i--) {
        const real *later = k->residual + (i + 1) * NX, *A = k->at[i]->f_jacobian;
        const real *C = k->at[i]->h_jacobian, *target = k->targets + i * (MHE_FREE + NY);
        const real *root = k->free_roots + i * SIZE(MHE_FREE * MHE_FREE);
        const real *noise = k->noise_roots + i * NY * NY;
        real *own = k->residual + i * NX;
        for (int c = 0; c < MHE_FREE; c++) {
            real force = 0;
            for (int j = 0; j < NX; j++) force += F[j * MHE_FREE + c] * later[j];
            for (int j = 0; j <= c; j++) force += root[j * MHE_FREE + c] * target[j];
            worst = mhe_max(mhe_squared_share(force, k->curvature[NX + i * MHE_FREE + c]), worst);
        }
        mhe_add_product(NX, NX, 1, A, later, own);
        for (int j = 0; j < NY; j++) {
            real force = 0;
            for (int l = 0; l <= j; l++) force += noise[l * NY + j] * target[MHE_FREE + l];
            for (int c = 0; c < NX; c++) own[c] += C[j * NX + c] * force;
        }
    }
    for (int c = 0; c < NX; c++) {
        real force = k->residual[c];
        for (int j = 0; j <= c; j++) force += k->prior_root[j * NX + c] * k->first_target[j];
        worst = mhe_max(mhe_squared_share(force, k->curvature[c]), worst);
    }
    return worst;
}

/* Factorise the QP and solve it without inequalities; the increments are in k->step. */
static int mhe_solve_free(mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest)
{
    mhe_assemble(e, k, offset);
    mhe_use_bends(k, nearest);
    if (!mhe_factorise(e, k, 0)) return 0;
    mhe_set_targets(e, k, 0, nearest);
    if (nearest) memset(k->gradient, 0, sizeof k->gradient);
    return mhe_solve(e, k, 0, k->step);
}

/* The trial that the QP is around. */
static void mhe_set_around(mhe_workspace *k, const mhe_trial *around) { k->around = around; }

/* Roots need no ridge. */
static int mhe_set_ridge(mhe_workspace *k, int has_ridge)
{
    (void)k; (void)has_ridge;
    return 0;
}
