/* An implicit step of a rate: next = x + sum_i d_i Z_i. The derivative is that of the implicit
 * function theorem at the converged stages. qpmhe/model/implicit_steps.py says the same in Python. */

static const real mhe_step_weights[MHE_STAGES] = {$ends};

/* The stages W of a step, by whichever iteration converges first; whether one does. Rates at them
 * come in r where they are wanted, and where there are algebraic states: another solution for z is no
 * stage of this step. */
static int mhe_solve_stages(const real *x, const real *u, real h, int wanted, real *W,
                            mhe_reduced *r)
{
    mhe_reduced first;
    real w[NW];
    if (!mhe_complete(x, u, w, &first)) return 0;
    wanted = wanted || NW > NX;
    if (mhe_keep_jacobian(w, u, h, &first, W)) {
        int same = !wanted || mhe_stage_rates(x, u, W, r);
        for (int i = 0; i < MHE_STAGES; i++)
            same = same && (!wanted || r[i].side == first.side);
        if (same) return 1;
    }
    int found = 0;
    for (int damped = 0; damped < 2 && !found; damped++) {
        mhe_start_stages(w, W);
        found = mhe_iterate_stages(w, u, h, damped, damped ? $iterations : $whole, W);
    }
    if (!found) {
        /* Follow them as h grows. */
        mhe_start_stages(w, W);
        found = 1;
        for (int part = 1; part <= $parts && found; part++)
            found = mhe_iterate_stages(w, u, (real)part * h / $parts, 0, $following, W);
    }
    return found && (!wanted || mhe_stage_rates(x, u, W, r));
}

static void mhe_step_end(const real *x, const real *W, real *next)
{
    for (int a = 0; a < NX; a++) {
        next[a] = x[a];
        for (int i = 0; i < MHE_STAGES; i++) next[a] += mhe_step_weights[i] * W[i * NW + a];
    }
}

static void $value(const real *x, const real *u, real dt, real *next)
{
    real W[MHE_STAGES * NW];
    mhe_reduced r[MHE_STAGES];
    if (mhe_solve_stages(x, u, dt, 0, W, r)) {
        mhe_step_end(x, W, next);
        return;
    }
    for (int a = 0; a < NX; a++) next[a] = NAN;
}

/* The derivative of x + sum_i d_i Z_i by x, from the Jacobians at all stages; whether it exists. With
 * B = 1/A, (B_ii - h J_i) S_i + sum_(j != i) B_ij S_j = (sum_j B_ij) I for S_i = d(x + Z_i)/dx. The
 * states' reciprocal sizes are in `per`. */
static int mhe_step_slope(real h, const mhe_reduced *r, real *per, real *S)
{
    enum { BLOCK = MHE_STAGES * MHE_STAGES };
    real M[NX * NX * BLOCK], z[MHE_UNKNOWNS * NX];
    int pivot[MHE_UNKNOWNS], stride = NX, between = MHE_STAGES * NX;
    for (int i = 0; i < NX * NX * BLOCK; i++) M[i] = 0;
    for (int i = 0; i < MHE_UNKNOWNS * NX; i++) z[i] = 0;
    for (int a = 0; a < NX; a++)
        for (int i = 0; i < MHE_STAGES; i++)
            for (int j = 0; j < MHE_STAGES; j++) {
                M[(a * NX + a) * BLOCK + i * MHE_STAGES + j] = mhe_stage_inverse[i][j];
                z[(a * MHE_STAGES + i) * NX + a] += mhe_stage_inverse[i][j];
            }
    for (int q = 0; q < MHE_FLOW_NONZEROS; q++) {
        real *block = M + (mhe_flow_row[q] * NX + mhe_flow_column[q]) * BLOCK;
        for (int i = 0; i < MHE_STAGES; i++) block[i * (MHE_STAGES + 1)] -= h * r[i].jacobian[q];
    }
    if (mhe_factor_blocks(MHE_STAGES, M, per)) {
        mhe_solve_blocks(MHE_STAGES, M, z);
    } else {
        if (!mhe_stage_factor(h, r, per, M, pivot)) return 0;
        for (int i = 0; i < MHE_UNKNOWNS * NX; i++) z[i] = i / NX % NX == i % NX;
        mhe_solve_columns(MHE_UNKNOWNS, M, pivot, NX, z);
        stride = NX * NX;
        between = NX;
    }
    for (int a = 0; a < NX; a++)
        for (int b = 0; b < NX; b++) {
            real sum = a == b ? $rest : 0;
            for (int i = 0; i < MHE_STAGES; i++)
                sum += mhe_step_weights[i] * z[a * between + i * stride + b];
            S[a * NX + b] = sum;
        }
    return 1;
}

/* f and its Jacobian with respect to x, by rows. */
static void $slope(const real *x, const real *u, real dt, real *next, real *A)
{
    real W[MHE_STAGE_VALUES], per[NX];
    mhe_reduced r[MHE_STAGES];
    if (mhe_solve_stages(x, u, dt, 1, W, r)) {
        mhe_state_reciprocals(x, dt, W, MHE_STAGES, r, per);
        mhe_step_end(x, W, next);
        if (mhe_step_slope(dt, r, per, A)) return;
    }
    for (int a = 0; a < NX; a++) next[a] = NAN;
    for (int i = 0; i < NX * NX; i++) A[i] = NAN;
}
