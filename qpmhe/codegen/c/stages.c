/* The stages Z_i = h sum_j A_ij f(x + Z_j, z_j) of an implicit step of a rate, with algebraic states
 * z_i where there are any, by Newton's method from Z = 0 and z at x, to rounding, with whole steps or,
 * where these fail, damped ones. qpmhe/model/implicit_steps.py says the same in Python. A stage is
 * Z_i, and z_i below. */

#define MHE_STAGES $stages
#define MHE_UNKNOWNS (MHE_STAGES * NX)
static const real mhe_stage_weights[MHE_STAGES][MHE_STAGES] = {$weights};

static void mhe_stage_state(const real *x, const real *stage, real *at)
{
    for (int j = 0; j < NX; j++) at[j] = x[j] + stage[j];
    for (int j = NX; j < NW; j++) at[j] = stage[j];
}

/* Rates and Jacobians at all stages W; whether f is finite there, and dg/dz regular. */
static int mhe_stage_rates(const real *x, const real *u, const real *W, mhe_reduced *r)
{
    real at[NW];
    for (int i = 0; i < MHE_STAGES; i++) {
        mhe_stage_state(x, W + i * NW, at);
        if (!mhe_reduce(at, u, r + i)) return 0;
    }
    return 1;
}

/* The negative residual h A f(x + Z) - Z of the linearised rates. */
static void mhe_stage_residual(const real *rates, real h, const real *W, real *residual)
{
    for (int i = 0; i < MHE_STAGES; i++)
        for (int a = 0; a < NX; a++) {
            real sum = 0;
            for (int j = 0; j < MHE_STAGES; j++) sum += mhe_stage_weights[i][j] * rates[j * NX + a];
            residual[i * NX + a] = -(W[i * NW + a] - h * sum);
        }
}

/* The largest of an entry of the Jacobians at the first few stages. */
static real mhe_largest_slope(const mhe_reduced *r, int known, int q)
{
    real most = 0;
    for (int i = 0; i < known; i++) most = mhe_max((real)fabs(r[i].jacobian[q]), most);
    return most;
}

/* Reciprocal sizes of the states' equations in a step: of x, of what the stages W add, and of the terms
 * of the flows at them, of which the first few are known. At rest these cancel. */
static void mhe_state_reciprocals(const real *x, real h, const real *W, int known,
                                  const mhe_reduced *r, real *per)
{
    real states[NX];
    for (int a = 0; a < NX; a++) {
        real most = 0;
        for (int i = 0; i < MHE_STAGES; i++) most = mhe_max((real)fabs(W[i * NW + a]), most);
        for (int i = 0; i < known; i++) most = mhe_max(h * (real)fabs(r[i].rate[a]), most);
        states[a] = (real)fabs(x[a]) + most;
    }
    for (int a = 0; a < NX; a++) per[a] = states[a];
    for (int q = 0; q < MHE_FLOW_NONZEROS; q++)
        per[mhe_flow_row[q]] += h * mhe_largest_slope(r, known, q) * states[mhe_flow_column[q]];
    mhe_reciprocals(NX, per);
}

/* LU factors of M = I - h A_ij J_j, with the states' reciprocal sizes; whether M is regular. */
static int mhe_stage_factor(real h, const mhe_reduced *r, const real *per, real *M, int *pivot)
{
    real all[MHE_UNKNOWNS];
    for (int i = 0; i < MHE_UNKNOWNS; i++) all[i] = per[i % NX];
    for (int i = 0; i < MHE_UNKNOWNS * MHE_UNKNOWNS; i++)
        M[i] = i / MHE_UNKNOWNS == i % MHE_UNKNOWNS;
    for (int j = 0; j < MHE_STAGES; j++)
        for (int q = 0; q < MHE_FLOW_NONZEROS; q++) {
            real *column = M + (j * NX + mhe_flow_column[q]) * MHE_UNKNOWNS + mhe_flow_row[q];
            for (int i = 0; i < MHE_STAGES; i++)
                column[i * NX] -= h * mhe_stage_weights[i][j] * r[j].jacobian[q];
        }
    return mhe_factor_equations(MHE_UNKNOWNS, M, all, pivot);
}

/* What rounding of the states and of their flows amounts to in each equation, or what the inverse of M
 * leaves of it in the stages, if that is less; whether rounding does not decide where `step` leads. */
static int mhe_stage_sizes(const real *x, real h, const real *W, const real *step,
                            const mhe_reduced *r, const real *M, const int *pivot, real *sizes)
{
    real states[NX], equations[NX], reach[NX], own[NX];
    MHE_LARGE real inverse[MHE_UNKNOWNS * MHE_UNKNOWNS];
    for (int a = 0; a < NX; a++) {
        real most = 0;
        for (int i = 0; i < MHE_STAGES; i++)
            most = mhe_max((real)fabs(W[i * NW + a] + step[i * NX + a]), most);
        states[a] = (real)fabs(x[a]) + most;
    }
    for (int a = 0; a < NX; a++) {
        equations[a] = states[a];
        own[a] = 1;
    }
    for (int q = 0; q < MHE_FLOW_NONZEROS; q++) {
        const int a = mhe_flow_row[q], b = mhe_flow_column[q];
        const real flow = h * mhe_largest_slope(r, MHE_STAGES, q);
        equations[a] += flow * states[b];
        if (a == b) own[a] += flow;
    }
    /* By single terms: also a state that is 0, at rest, has a size. */
    for (int a = 0; a < NX; a++) reach[a] = states[a] + (equations[a] - states[a]) / own[a];
    for (int i = 0; i < MHE_UNKNOWNS * MHE_UNKNOWNS; i++)
        inverse[i] = i / MHE_UNKNOWNS == i % MHE_UNKNOWNS;
    mhe_solve_columns(MHE_UNKNOWNS, M, pivot, MHE_UNKNOWNS, inverse);
    for (int i = 0; i < MHE_UNKNOWNS; i++) {
        real left = 0;
        for (int j = 0; j < MHE_UNKNOWNS; j++)
            left += (real)fabs(inverse[i * MHE_UNKNOWNS + j]) * equations[j % NX];
        sizes[i] = left < equations[i % NX] ? left : equations[i % NX];
        if (left > (real)$spread * reach[i % NX]) return 0;
    }
    return 1;
}

/* The corrections of the stages W, from those of Z; the largest share of one. */
static real mhe_stage_moves(const mhe_reduced *r, const real *W, const real *sizes,
                            const real *step, real *moves)
{
    real length = 0;
    (void)r; (void)W;
    for (int i = 0; i < MHE_STAGES; i++) {
        for (int a = 0; a < NX; a++) {
            const real moved = (real)fabs(step[i * NX + a]);
            if (!isfinite(moved)) return NAN;
            if (moved > 0) length = mhe_max(moved / sizes[i * NX + a], length);
            moves[i * NW + a] = step[i * NX + a];
        }
        const real share = mhe_move_algebraic(r + i, W + i * NW, sizes + i * NX, moves + i * NW);
        if (isnan(share)) return NAN;
        length = mhe_max(share, length);
    }
    return length;
}

/* How far the correction behind a step of this factor is from that of linear equations, by the
 * Jacobians r and the factors M at its start: a share of the sizes in scale. */
static real mhe_stage_curved(const mhe_reduced *r, const mhe_reduced *next, real h, const real *M,
                             const int *pivot, const real *trial, const real *moves, real factor,
                             const real *scale)
{
    real rates[MHE_UNKNOWNS], step[MHE_UNKNOWNS], again[MHE_STAGES * NW];
    for (int i = 0; i < MHE_STAGES; i++) mhe_freeze(r + i, next[i].values, rates + i * NX, again + i * NW);
    mhe_stage_residual(rates, h, trial, step);
    mhe_solve_equations(MHE_UNKNOWNS, M, pivot, step);
    for (int i = 0; i < MHE_STAGES; i++) {
        for (int a = 0; a < NX; a++) again[i * NW + a] = step[i * NX + a];
        mhe_follow(r + i, again + i * NW);
    }
    for (int i = 0; i < MHE_STAGES * NW; i++) again[i] -= (1 - factor) * moves[i];
    return mhe_share(MHE_STAGES * NW, again, scale);
}

/* Where iterations start: Z = 0, and z at x. */
static void mhe_start_stages(const real *w, real *W)
{
    for (int i = 0; i < MHE_STAGES; i++)
        for (int j = 0; j < NW; j++) W[i * NW + j] = j < NX ? 0 : w[j];
}

/* The stages W of a step from w = (x, z), by whole Newton steps or by damped ones, along which f is
 * nearly linear; whether they converge. */
static int mhe_iterate_stages(const real *w, const real *u, real h, int damped, int most, real *W)
{
    MHE_LARGE mhe_reduced both[2][MHE_STAGES];
    real rates[MHE_UNKNOWNS], step[MHE_UNKNOWNS], moves[MHE_STAGES * NW], trial[MHE_STAGES * NW];
    real scale[MHE_STAGES * NW], sizes[MHE_UNKNOWNS];
    MHE_LARGE real M[MHE_UNKNOWNS * MHE_UNKNOWNS];
    real per[NX], last = INFINITY;
    int pivot[MHE_UNKNOWNS], now = 0;
    if (!mhe_stage_rates(w, u, W, both[0])) return 0;
    const int side = both[0][0].side;
    for (int iteration = 0; iteration < most; iteration++) {
        const mhe_reduced *r = both[now];
        mhe_reduced *next = both[!now];
        mhe_state_reciprocals(w, h, W, MHE_STAGES, r, per);
        if (!mhe_stage_factor(h, r, per, M, pivot)) return 0;
        for (int i = 0; i < MHE_UNKNOWNS; i++) rates[i] = r[i / NX].rate[i % NX];
        mhe_stage_residual(rates, h, W, step);
        mhe_solve_equations(MHE_UNKNOWNS, M, pivot, step);
        if (!mhe_stage_sizes(w, h, W, step, r, M, pivot, sizes)) return 0;
        const real length = mhe_stage_moves(r, W, sizes, step, moves);
        if (isnan(length)) return 0;
        const int done = mhe_converged(length, last);
        real factor = 1, before = NAN;
        if (damped) {
            for (int i = 0; i < MHE_STAGES * NW; i++)
                scale[i] =
                    (real)(fabs(W[i]) + fabs(moves[i]) + (i % NW < NX ? fabs(w[i % NW]) : 0));
            before = mhe_share(MHE_STAGES * NW, moves, scale);
        }
        int good = 0;
        for (int halving = 0; halving < $halvings && !good; halving++) {
            real curved = NAN;
            for (int i = 0; i < MHE_STAGES * NW; i++) trial[i] = W[i] + factor * moves[i];
            good = done || mhe_stage_rates(w, u, trial, next);
            if (good && damped && !done) {
                curved = mhe_stage_curved(r, next, h, M, pivot, trial, moves, factor, scale);
                good = mhe_straight(curved, factor, before, length);
            }
            if (!good) factor = mhe_shorter(curved, factor, before);
        }
        if (!good) return 0;
        for (int i = 0; i < MHE_STAGES * NW; i++) W[i] = trial[i];
        if (done) {
            /* Another solution for z is no stage of this step. */
            for (int i = 0; i < MHE_STAGES; i++) good = good && r[i].side == side;
            return good;
        }
        last = length;
        now = !now;
    }
    return 0;
}

