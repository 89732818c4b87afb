/* An implicit step of a rate: next = x + sum_i d_i Z_i. The derivative is that of the implicit
 * function theorem at the converged stages. qpmhe/model/implicit_steps.py says the same in Python. */

static const real mhe_step_weights[MHE_STAGES] = {$ends};
#define MHE_FIRST_END (MHE_STAGES - 1) /* the others are 0 */

/* The stages W of a step, by whichever iteration converges first; 0 where none does, and 2 where a
 * correction by the Jacobians at the stages must follow, if it may be left to the caller: `rough`. Rates
 * at the stages come in r where they are wanted, and where there are algebraic states: another solution
 * for z is no stage of this step. */
static int mhe_solve_stages(const real *x, const real *u, real h, int wanted, int rough, real *W,
                            mhe_reduced *r)
{
    MHE_LARGE mhe_reduced first;
    real w[NW];
    if (!mhe_complete(x, u, w, &first)) return 0;
    wanted = wanted || NW > NX;
    if (mhe_keep_jacobian(w, u, h, &first, rough ? (real)$rough : (real)$rounding, W)) {
        int same = !wanted || mhe_stage_rates(x, u, W, r);
        for (int i = 0; i < MHE_STAGES; i++)
            same = same && (!wanted || r[i].side == first.side);
        if (same) return 1 + rough;
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
        for (int i = MHE_FIRST_END; i < MHE_STAGES; i++)
            next[a] += mhe_step_weights[i] * W[i * NW + a];
    }
}

static void $value(const real *x, const real *u, real dt, real *next)
{
    real W[MHE_STAGES * NW];
    MHE_LARGE mhe_reduced r[MHE_STAGES];
    if (mhe_solve_stages(x, u, dt, 0, 0, W, r)) {
        mhe_step_end(x, W, next);
        return;
    }
    for (int a = 0; a < NX; a++) next[a] = NAN;
}

/* The derivative of x + sum_i d_i Z_i by x, from the Jacobians at all stages W; whether it exists. With
 * B = 1/A, (B_ii - h J_i) S_i + sum_(j != i) B_ij S_j = (sum_j B_ij) I for S_i = d(x + Z_i)/dx. The
 * states' reciprocal sizes are in `per`. Of the same equations, Newton's corrections of Z, stage by
 * stage, unless the last is null. */
static int mhe_step_slope(real h, const mhe_reduced *r, real *per, const real *W, real *S,
                          real *correction)
{
    enum { BLOCK = MHE_STAGES * MHE_STAGES };
    MHE_LARGE real M[NX * NX * BLOCK], z[MHE_UNKNOWNS * NX];
    real rates[MHE_UNKNOWNS], moves[MHE_UNKNOWNS];
    int pivot[MHE_UNKNOWNS], stride = NX, between = MHE_STAGES * NX;
    mhe_clear_blocks(BLOCK, M);
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
    for (int i = 0; i < MHE_STAGES && correction; i++)
        for (int a = 0; a < NX; a++) rates[i * NX + a] = r[i].rate[a];
    if (mhe_factor_blocks(MHE_STAGES, M, per)) {
        mhe_solve_blocks(MHE_STAGES, M, z);
        if (correction) {
            mhe_stage_defect(rates, h, W, correction);
            for (int i = 0; i < MHE_STAGES; i++)
                for (int a = 0; a < NX; a++) moves[a * MHE_STAGES + i] = correction[i * NX + a];
            mhe_solve_one(MHE_STAGES, M, moves);
            for (int i = 0; i < MHE_STAGES; i++)
                for (int a = 0; a < NX; a++) correction[i * NX + a] = moves[a * MHE_STAGES + i];
        }
    } else {
        if (!mhe_stage_factor(h, r, per, M, pivot)) return 0;
        for (int i = 0; i < MHE_UNKNOWNS * NX; i++) z[i] = i / NX % NX == i % NX;
        mhe_solve_columns(MHE_UNKNOWNS, M, pivot, NX, z);
        stride = NX * NX;
        between = NX;
        if (correction) {
            mhe_stage_residual(rates, h, W, correction);
            mhe_solve_equations(MHE_UNKNOWNS, M, pivot, correction);
        }
    }
    for (int a = 0; a < NX; a++)
        for (int b = 0; b < NX; b++) {
            real sum = a == b ? $rest : 0;
            for (int i = MHE_FIRST_END; i < MHE_STAGES; i++)
                sum += mhe_step_weights[i] * z[a * between + i * stride + b];
            S[a * NX + b] = sum;
        }
    return 1;
}

/* Add corrections of Z to the stages W, at which r is, and z behind them; whether they are so small that
 * the Jacobians need not follow. */
static int mhe_correct_stages(const real *x, const mhe_reduced *r, const real *correction, real *W)
{
    int small = 1;
    real move[NW], most[NX], rate[NX];
    for (int a = 0; a < NX; a++) {
        most[a] = 0;
        for (int i = 0; i < MHE_STAGES; i++) most[a] = mhe_max((real)fabs(W[i * NW + a]), most[a]);
        most[a] = (real)$rough * ((real)fabs(x[a]) + most[a]);
    }
    for (int i = 0; i < MHE_STAGES; i++) {
        for (int a = 0; a < NX; a++) {
            move[a] = correction[i * NX + a];
            small = small && fabs(move[a]) <= most[a];
        }
        mhe_freeze(r + i, r[i].values, rate, move);
        mhe_follow(r + i, move);
        for (int j = 0; j < NW; j++) W[i * NW + j] += move[j];
    }
    return small;
}

/* f and its Jacobian with respect to x, by rows. */
static void $slope(const real *x, const real *u, real dt, real *next, real *A)
{
    real W[MHE_STAGE_VALUES], per[NX], correction[MHE_UNKNOWNS];
    MHE_LARGE mhe_reduced r[MHE_STAGES];
    for (int rough = 1; rough >= 0; rough--) {
        int found = mhe_solve_stages(x, u, dt, 1, rough, W, r);
        for (int k = 0; found && k < 1 + rough; k++) {
            mhe_state_reciprocals(x, dt, W, 1, r + MHE_STAGES - 1, per);
            if (!mhe_step_slope(dt, r, per, W, A, found == 2 ? correction : 0)) break;
            if (found < 2 || mhe_correct_stages(x, r, correction, W)) {
                mhe_step_end(x, W, next);
                return;
            }
            found *= mhe_stage_rates(x, u, W, r);
        }
    }
    for (int a = 0; a < NX; a++) next[a] = NAN;
    for (int i = 0; i < NX * NX; i++) A[i] = NAN;
}
