/* Nonlinear constraints beside elimination.c. Their curvature at a stage is R'R of its state and the next
 * one, which are columns in this order: more rows of the least-squares problem. */

@mhe_workspace
    mhe_real bends[(MHE_HORIZON + 1) * MHE_BENDS * MHE_BENDS], bend_targets[(MHE_HORIZON + 1) * MHE_BENDS];
    int32_t bending; /* whether the present QP has them */
@
static void mhe_clear_bends(mhe_workspace *k) { memset(k->bends, 0, sizeof k->bends); }

/* R'R += the curvature `bend` of stage i, along a direction by its state and the next one: rotations take
 * a new row into R. */
static void mhe_keep_bend(const mhe_estimator *e, mhe_workspace *k, int i, real bend, const real *by_state,
                          const real *by_next)
{
    real row[MHE_BENDS], *R = k->bends + i * MHE_BENDS * MHE_BENDS;
    for (int j = 0; j < NX; j++) {
        row[j] = sqrt(bend) * by_state[j];
        row[NX + j] = i < e->length ? sqrt(bend) * by_next[j] : 0;
    }
    for (int j = 0; j < MHE_BENDS; j++) {
        real *own = R + j * MHE_BENDS;
        const real norm = hypot(own[j], row[j]);
        if (row[j] == 0) continue;
        const real c = own[j] / norm, s = row[j] / norm;
        for (int l = j; l < MHE_BENDS; l++) {
            const real old = own[l];
            own[l] = c * old + s * row[l];
            row[l] = c * row[l] - s * old;
        }
    }
}

static void mhe_use_bends(mhe_workspace *k, int nearest) { k->bending = k->has_bends && !nearest; }

/* Row l of the curvature of stage i; a null pointer where there is none. */
static const real *mhe_bend_row(const mhe_workspace *k, int i, int l)
{
    const real *row = k->bends + (i * MHE_BENDS + l) * MHE_BENDS;
    return k->bending && row[l] != 0 ? row : 0;
}

/* A row on the state and the next one becomes one of the disturbances and the state. */
static void mhe_add_joint_row(const mhe_estimator *e, const mhe_workspace *k, int i, real scale,
                              const real *own, const real *next, mhe_block *b)
{
    const real *F = e->settings->elimination.free;
    real *row = b->rows + b->count++ * COLUMNS;
    for (int c = 0; c < COLUMNS; c++) row[c] = 0;
    for (int c = 0; c < NX; c++) row[MHE_FREE + c] = scale * own[c];
    for (int l = 0; i < e->length && l < NX; l++) {
        const real value = scale * next[l];
        if (value == 0) continue;
        for (int c = 0; c < MHE_FREE; c++) row[c] += value * F[l * MHE_FREE + c];
        for (int c = 0; c < NX; c++) row[MHE_FREE + c] += value * k->at[i]->f_jacobian[l * NX + c];
    }
}

static void mhe_add_bend_rows(const mhe_estimator *e, const mhe_workspace *k, int i, mhe_block *b)
{
    for (int l = 0; l < MHE_BENDS; l++) {
        const real *row = mhe_bend_row(k, i, l);
        if (row) mhe_add_joint_row(e, k, i, 1, row, row + NX, b);
    }
}

/* Rows of stage i that have weights. */
static void mhe_add_value_rows(const mhe_estimator *e, const mhe_workspace *k, int i, mhe_block *b)
{
    for (int r = 0; r < MHE_G_ROWS; r++) {
        const int at = (i * MHE_G_ROWS + r) * NX, place = i * ROWS + G_AT + r;
        const real weight = k->rows.weight[place];
        if (weight == 0) continue;
        b->source[b->inequalities] = place;
        b->root[b->inequalities++] = sqrt(weight);
        mhe_add_joint_row(e, k, i, sqrt(weight), k->own_slopes + at,
                          i < e->length ? k->next_slopes + at : 0, b);
    }
}

/* What the drift of stage i is to a row. */
static real mhe_value_drift(const mhe_estimator *e, const mhe_workspace *k, int place)
{
    const int i = place / ROWS, r = place % ROWS - G_AT;
    if (r < 0 || i == e->length) return 0;
    return mhe_dot(NX, k->next_slopes + (i * MHE_G_ROWS + r) * NX, k->drift + i * NX);
}

/* What the curvature asks for beside increments `step`, 0 for none, and the drift. */
static void mhe_set_bend_targets(const mhe_estimator *e, mhe_workspace *k, const real *step)
{
    for (int i = 0; k->bending && i <= e->length; i++)
        for (int l = 0; l < MHE_BENDS; l++) {
            const real *row = mhe_bend_row(k, i, l), *own = step + i * NX;
            real sum = 0;
            if (row && step) sum = mhe_dot(NX, row, own);
            if (row && i < e->length) {
                if (step) sum += mhe_dot(NX, row + NX, own + NX);
                sum += mhe_dot(NX, row + NX, k->drift + i * NX);
            }
            k->bend_targets[i * MHE_BENDS + l] = -sum;
        }
}

/* Right-hand sides of the curvature's rows; the number of rows up to them. */
static int mhe_bend_sides(const mhe_workspace *k, int i, int push, int at, real *side)
{
    for (int l = 0; l < MHE_BENDS; l++)
        if (mhe_bend_row(k, i, l)) side[at++] = push ? 0 : k->bend_targets[i * MHE_BENDS + l];
    return at;
}

/* forces += those of the curvature on all increments, as if they were free. */
static void mhe_add_bend_forces(const mhe_estimator *e, const mhe_workspace *k, real *forces)
{
    for (int i = 0; k->bending && i <= e->length; i++)
        for (int l = 0; l < MHE_BENDS; l++) {
            const real *row = mhe_bend_row(k, i, l), target = k->bend_targets[i * MHE_BENDS + l];
            for (int j = 0; row && j < (i < e->length ? 2 : 1) * NX; j++)
                forces[i * NX + j] += row[j] * target;
        }
}

/* diagonal += that of the curvature in d(i). */
static void mhe_add_bend_curvature(const mhe_workspace *k, int i, real *diagonal)
{
    for (int next = 0; next < 2; next++)
        for (int l = 0; l < MHE_BENDS && i >= next; l++) {
            const real *row = mhe_bend_row(k, i - next, l);
            for (int j = 0; row && j < NX; j++) diagonal[j] += row[next * NX + j] * row[next * NX + j];
        }
}

/* Twice what the curvature adds to the objective at the step. */
static real mhe_bend_objective(const mhe_estimator *e, const mhe_workspace *k)
{
    real sum = 0;
    for (int i = 0; k->bending && i <= e->length; i++)
        for (int l = 0; l < MHE_BENDS; l++) {
            const real *row = mhe_bend_row(k, i, l);
            const int size = (i < e->length ? 2 : 1) * NX;
            const real value = row ? mhe_dot(size, row, k->step + i * NX) : 0;
            sum += value * value;
        }
    return sum;
}
