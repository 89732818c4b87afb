/* The stages of an implicit step by the simplified Newton method: one Jacobian for all stages and
 * iterations, that at x, with rank-one corrections by what the rate did along each step (Broyden's
 * method in scaled unknowns; Kelley, Iterative Methods for Linear and Nonlinear Equations, section
 * 7.3). It goes on only while each correction is a small part of the one before.
 * qpmhe/model/implicit_steps.py does the same in Python. */

/* By the eigenvectors of the inverse of A, Newton's equations fall apart into real ones,
 * (a - h J) w = r, and, for three stages, complex ones, (a + c - h J) w = r with a complex c. Their
 * inverses are P and H (P + c* P P), with H = (1 + 2 Re(c) P + |c|^2 P P)^-1, which has no large or small
 * eigenvalues where J has none to the right. */
#define MHE_PAIR (MHE_STAGES > 1)
#define MHE_STAGE_VALUES (MHE_STAGES * NW)
static const real mhe_stage_inverse[MHE_STAGES][MHE_STAGES] = {$inverse};
static const real mhe_to_modes[MHE_STAGES][MHE_STAGES] = {$to_modes};
static const real mhe_from_modes[MHE_STAGES][MHE_STAGES] = {$from_modes};

/* a I - h J, by columns. */
static void mhe_shifted(real a, real h, const real *J, real *out)
{
    for (int i = 0; i < NX * NX; i++) out[i] = i / NX == i % NX ? a : 0;
    for (int q = 0; q < MHE_FLOW_NONZEROS; q++)
        out[mhe_flow_column[q] * NX + mhe_flow_row[q]] -= h * J[q];
}

/* Inverses of both matrices, by columns: of the real one, and both parts of the complex one. */
typedef struct {
    real one[NX * NX], parts[SIZE(2 * NX * NX * MHE_PAIR)];
} mhe_modes;

/* Row `to` of all three minus a real and a complex factor times row `from`. */
static void mhe_subtract_modes(const real *factor, real *restrict one, real *restrict direct,
                               real *restrict across, int from, int to)
{
    const real plain = factor[0], first = factor[MHE_PAIR], second = factor[2 * MHE_PAIR];
    for (int j = 0; j < NX; j++) one[to + j] -= plain * one[from + j];
    for (int j = 0; j < NX * MHE_PAIR; j++) {
        const real a = direct[from + j], b = across[from + j];
        direct[to + j] -= first * a - second * b;
        across[to + j] -= first * b + second * a;
    }
}

/* The same by elimination without exchanges, of the transposed matrices, so that rows of the result are
 * columns of the inverses; whether it may do without: see `mhe_factor_blocks`. */
static int mhe_invert_blocks(real h, const real *J, const real *per, mhe_modes *modes)
{
    enum { PARTS = 1 + 2 * MHE_PAIR };
    MHE_LARGE real M[NX * NX * PARTS];
    real squares = 0;
    mhe_clear_blocks(PARTS, M);
    for (int a = 0; a < NX; a++) {
        real *own = M + (a * NX + a) * PARTS;
        own[0] = $real;
        if (MHE_PAIR) {
            own[MHE_PAIR] = $real + $shift;
            own[2 * MHE_PAIR] = $turning;
        }
    }
    for (int q = 0; q < MHE_FLOW_NONZEROS; q++) {
        real *entry = M + (mhe_flow_column[q] * NX + mhe_flow_row[q]) * PARTS;
        entry[0] -= h * J[q];
        if (MHE_PAIR) entry[MHE_PAIR] -= h * J[q];
    }
    for (int p = 0; p < NX; p++) {
        const int c = mhe_order[p];
        real *pivot = M + (c * NX + c) * PARTS;
        pivot[0] = 1 / pivot[0];
        squares += 0 * pivot[0]; /* no number if it is none */
        if (MHE_PAIR) {
            real *pair = pivot + MHE_PAIR;
            const int longer = fabs(pair[0]) >= fabs(pair[1]); /* squares may be out of range */
            const real large = pair[!longer], share = pair[longer] / large;
            const real size = 1 / (large + pair[longer] * share);
            pair[!longer] = longer ? size : -size;
            pair[longer] = longer ? -size * share : size * share;
            squares += 0 * size;
        }
        for (int q = mhe_near_start[p]; q < mhe_near_start[p + 1]; q++) {
            const int r = mhe_near[q];
            const real ratio = per[c] / per[r];
            real *left = M + (r * NX + c) * PARTS;
            left[0] *= pivot[0];
            real most = left[0] * left[0];
            if (MHE_PAIR) {
                const real *own = pivot + MHE_PAIR;
                real *both = left + MHE_PAIR;
                const real product = both[0] * own[0] - both[1] * own[1];
                both[1] = both[0] * own[1] + both[1] * own[0];
                both[0] = product;
                most += both[0] * both[0] + both[1] * both[1];
            }
            squares += most * ratio * ratio;
            for (int o = mhe_near_start[p]; o < mhe_near_start[p + 1]; o++) {
                const real *right = M + (c * NX + mhe_near[o]) * PARTS;
                real *to = M + (r * NX + mhe_near[o]) * PARTS;
                to[0] -= left[0] * right[0];
                if (MHE_PAIR) {
                    const real first = left[MHE_PAIR], second = left[2 * MHE_PAIR];
                    const real a = right[MHE_PAIR], b = right[2 * MHE_PAIR];
                    to[MHE_PAIR] -= first * a - second * b;
                    to[2 * MHE_PAIR] -= first * b + second * a;
                }
            }
        }
    }
    if (!(squares <= (real)$multipliers)) return 0;
    real *one = modes->one, *direct = modes->parts, *across = direct + NX * NX * MHE_PAIR;
    for (int i = 0; i < NX * NX; i++) one[i] = 0;
    for (int i = 0; i < 2 * NX * NX * MHE_PAIR; i++) direct[i] = 0;
    for (int a = 0; a < NX; a++) {
        one[a * NX + a] = 1;
        if (MHE_PAIR) direct[a * NX + a] = 1;
    }
    for (int p = 0; p < NX; p++)
        for (int q = mhe_near_start[p]; q < mhe_near_start[p + 1]; q++) {
            const int c = mhe_order[p] * NX, r = mhe_near[q] * NX;
            mhe_subtract_modes(M + (r + mhe_order[p]) * PARTS, one, direct, across, c, r);
        }
    for (int p = NX - 1; p >= 0; p--) {
        const int c = mhe_order[p] * NX;
        const real *pivot = M + (c + mhe_order[p]) * PARTS;
        for (int q = mhe_near_start[p]; q < mhe_near_start[p + 1]; q++)
            mhe_subtract_modes(M + (c + mhe_near[q]) * PARTS, one, direct, across, mhe_near[q] * NX, c);
        for (int j = 0; j < NX; j++) one[c + j] *= pivot[0];
        for (int j = c; j < (c + NX) * MHE_PAIR; j++) {
            const real a = direct[j], b = across[j];
            direct[j] = a * pivot[MHE_PAIR] - b * pivot[2 * MHE_PAIR];
            across[j] = a * pivot[2 * MHE_PAIR] + b * pivot[MHE_PAIR];
        }
    }
    for (int i = 0; i < NX * NX * MHE_PAIR; i++) across[i] = -across[i];
    return 1;
}

/* Whether the matrices are regular, by the states' reciprocal sizes. */
static int mhe_invert_modes(real h, const real *J, real *per, mhe_modes *modes)
{
    enum { WIDE = 2 * NX };
    MHE_LARGE real block[NX * NX], wide[SIZE(NX * WIDE * MHE_PAIR)];
    real *P = modes->one;
    int pivot[NX];
    if (mhe_invert_blocks(h, J, per, modes)) return 1;
    mhe_shifted($real, h, J, block);
    if (!mhe_factor_equations(NX, block, per, pivot)) return 0;
    for (int i = 0; i < NX * NX; i++) P[i] = i / NX == i % NX;
    mhe_solve_columns(NX, block, pivot, NX, P);
    for (int i = 0; i < NX * MHE_PAIR; i++) {
        real *row = wide + i * WIDE;
        for (int j = 0; j < NX; j++) row[NX + j] = 0;
        for (int l = 0; l < NX; l++)
            for (int j = 0; j < NX; j++) row[NX + j] += P[i * NX + l] * P[l * NX + j];
        for (int j = 0; j < NX; j++) {
            const real once = P[i * NX + j], twice = row[NX + j];
            block[j * NX + i] = (i == j) + 2 * $shift * once + $square * twice;
            row[j] = once + $shift * twice;
            row[NX + j] = $turning * twice;
        }
    }
    if (MHE_PAIR) {
        if (!mhe_factor_equations(NX, block, per, pivot)) return 0;
        mhe_solve_columns(NX, block, pivot, WIDE, wide);
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < WIDE; j++) modes->parts[j * NX + i] = wide[i * WIDE + j];
    }
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < i; j++) mhe_exchange(P + i * NX + j, P + j * NX + i);
    return 1;
}

/* to = weights from, of values at all stages. */
static void mhe_mix_stages(const real (*weights)[MHE_STAGES], const real *restrict from,
                           real *restrict to)
{
    for (int i = 0; i < MHE_STAGES; i++)
        for (int a = 0; a < NX; a++) {
            real sum = 0;
            for (int j = 0; j < MHE_STAGES; j++) sum += weights[i][j] * from[j * NX + a];
            to[i * NX + a] = sum;
        }
}

/* to = M from, with a matrix by columns. */
static void mhe_times_columns(const real *restrict M, const real *restrict from, real *restrict to)
{
    for (int i = 0; i < NX; i++) {
        real sum = 0;
        for (int j = 0; j < NX; j++) sum += M[j * NX + i] * from[j];
        to[i] = sum;
    }
}

/* The same of complex numbers, both parts one behind the other. */
static void mhe_times_pair(const real *restrict M, const real *restrict from, real *restrict to)
{
    for (int i = 0; i < NX; i++) {
        const real *direct = M + i, *across = direct + NX * NX;
        real first = 0, second = 0;
        for (int j = 0; j < NX; j++) {
            first += direct[j * NX] * from[j] + across[j * NX] * from[NX + j];
            second += direct[j * NX] * from[NX + j] - across[j * NX] * from[j];
        }
        to[i] = first;
        to[NX + i] = second;
    }
}

/* The corrections of Z by the residuals h f_i - sum_j (1/A)_ij Z_j. */
static void mhe_solve_modes(const mhe_modes *modes, const real *defect, real *stages)
{
    real right[MHE_STAGES * NX], found[MHE_STAGES * NX];
    mhe_mix_stages(mhe_to_modes, defect, right);
    mhe_times_columns(modes->one, right, found);
    if (MHE_PAIR) mhe_times_pair(modes->parts, right + NX * MHE_PAIR, found + NX * MHE_PAIR);
    mhe_mix_stages(mhe_from_modes, found, stages);
}

/* What is missing to the stages' equations, h f(x + Z) - Z / A. */
static void mhe_stage_defect(const real *restrict rates, real h, const real *restrict W,
                             real *restrict defect)
{
    for (int i = 0; i < MHE_STAGES; i++)
        for (int a = 0; a < NX; a++) {
            real sum = h * rates[i * NX + a];
            for (int j = 0; j < MHE_STAGES; j++) sum -= mhe_stage_inverse[i][j] * W[j * NW + a];
            defect[i * NX + a] = sum;
        }
}

/* Newton's corrections of the stages W by the frozen r. */
static void mhe_kept_moves(const real *x, const real *u, real h, const mhe_reduced *r,
                          const mhe_modes *modes, const real *W, int first, real *moves)
{
    real at[NW], values[NW], defect[MHE_UNKNOWNS], stages[MHE_UNKNOWNS], rates[MHE_UNKNOWNS];
    for (int i = 0; i < MHE_STAGES; i++) {
        real *move = moves + i * NW;
        if (first) {
            for (int a = 0; a < NX; a++) rates[i * NX + a] = r->rate[a];
            for (int j = NX; j < NW; j++) move[j] = 0;
            continue;
        }
        mhe_stage_state(x, W + i * NW, at);
        mhe_call_f(at, u, values);
        mhe_freeze(r, values, rates + i * NX, move);
    }
    mhe_stage_defect(rates, h, W, defect);
    mhe_solve_modes(modes, defect, stages);
    for (int i = 0; i < MHE_STAGES; i++) {
        for (int a = 0; a < NX; a++) moves[i * NW + a] = stages[i * NX + a];
        mhe_follow(r, moves + i * NW);
    }
}

/* The sizes of a stage's unknowns, behind the first corrections, and how small a share these are of what
 * rounding amounts to in the equations, or what the real inverse leaves of it, if that is less; whether
 * rounding does not decide where the corrections lead. */
static int mhe_kept_sizes(const real *w, real h, const mhe_reduced *r, const mhe_modes *modes,
                           const real *moves, real *sizes, real *shares)
{
    real equations[NX], reach[NX], flows[NX], own[NX], left[NX];
    for (int j = 0; j < NW; j++) {
        real most = 0;
        for (int i = 0; i < MHE_STAGES; i++)
            most = mhe_max((real)fabs(moves[i * NW + j]), most);
        sizes[j] = (real)fabs(w[j]) + most;
    }
    for (int a = 0; a < NX; a++) {
        flows[a] = left[a] = 0;
        own[a] = 1;
    }
    for (int q = 0; q < MHE_FLOW_NONZEROS; q++) {
        const int a = mhe_flow_row[q], b = mhe_flow_column[q];
        const real flow = h * (real)fabs(r->jacobian[q]);
        flows[a] += flow * sizes[b];
        if (a == b) own[a] += flow;
    }
    for (int a = 0; a < NX; a++) {
        equations[a] = $real * sizes[a] + flows[a];
        reach[a] = sizes[a] + flows[a] / own[a];
    }
    for (int b = 0; b < NX; b++)
        for (int a = 0; a < NX; a++) left[a] += (real)fabs(modes->one[b * NX + a]) * equations[b];
    for (int a = 0; a < NX; a++) {
        shares[a] = left[a] < equations[a] ? left[a] : equations[a];
        if (!(left[a] <= (real)$spread * reach[a])) return 0;
    }
    mhe_algebraic_sizes(r, sizes + NX, shares, shares + NX);
    for (int j = 0; j < NW; j++) shares[j] = shares[j] > 0 ? sizes[j] / shares[j] : 1;
    return 1;
}

/* The product of two rows of all stages' values: in four sums, which are added up at the same time. */
static real mhe_stage_product(const real *a, const real *b)
{
    real sums[4] = {0, 0, 0, 0};
    for (int i = 0; i < MHE_STAGE_VALUES / 4; i++)
        for (int j = 0; j < 4; j++) sums[j] += a[4 * i + j] * b[4 * i + j];
    for (int i = MHE_STAGE_VALUES - MHE_STAGE_VALUES % 4; i < MHE_STAGE_VALUES; i++)
        sums[0] += a[i] * b[i];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

/* The stages W of a step from w = (x, z), at which f is linearised; whether they converge fast, so far
 * that the next correction is likely to be less than `rough`, a share of the sizes. */
static int mhe_keep_jacobian(const real *w, const real *u, real h, const mhe_reduced *r, real rough,
                             real *W)
{
    MHE_LARGE mhe_modes modes;
    real moves[MHE_STAGE_VALUES], sizes[MHE_STAGE_VALUES], per[MHE_STAGE_VALUES];
    real rounding[NW], last = INFINITY;
    real made[$kept][MHE_STAGE_VALUES], squares[$kept]; /* the corrections, as shares of the sizes */
    int sized = 1;
    mhe_start_stages(w, W);
    mhe_state_reciprocals(w, h, W, 1, r, sizes);
    if (!mhe_invert_modes(h, r->jacobian, sizes, &modes)) return 0;
    for (int k = 0; k < $kept; k++) {
        real *share = made[k];
        mhe_kept_moves(w, u, h, r, &modes, W, k == 0, moves);
        if (k == 0) {
            if (!mhe_kept_sizes(w, h, r, &modes, moves, sizes, rounding)) return 0;
            for (int i = 0; i < MHE_STAGE_VALUES; i++) {
                sizes[i] = sizes[i % NW];
                per[i] = sizes[i] > 0 ? 1 / sizes[i] : 1;
                sized = sized && sizes[i] > 0;
            }
        }
        for (int i = 0; i < MHE_STAGE_VALUES; i++) share[i] = moves[i] * per[i];
        for (int q = 1; q < k; q++) {
            const real part = mhe_stage_product(made[q - 1], share) * squares[q - 1];
            for (int i = 0; i < MHE_STAGE_VALUES; i++) share[i] += part * made[q][i];
        }
        if (k) {
            const real part = 1 / (1 - mhe_stage_product(made[k - 1], share) * squares[k - 1]);
            for (int i = 0; i < MHE_STAGE_VALUES; i++) share[i] *= part;
        }
        for (int i = 0; i < MHE_STAGE_VALUES; i++) W[i] += share[i] * sizes[i];
        for (int i = 0; i < MHE_STAGE_VALUES && !sized; i++)
            /* What stays 0 in linear equations has no size. */
            if (!(sizes[i] > 0) && share[i] != 0) return 0;
        const real square = mhe_stage_product(share, share), rate = square / last;
        squares[k] = 1 / square;
        if (!isfinite(square)) return 0;
        if (square <= (real)$rounding * (real)$rounding || (k > 0 && square * rate <= rough * rough))
            return 1;
        if (rate > (real)$contraction * (real)$contraction) {
            const real few = (real)$few * (real)$rounding;
            real most = 0;
            for (int i = 0; i < MHE_STAGE_VALUES; i++)
                most = mhe_max((real)fabs(share[i]) * rounding[i % NW], most);
            return square <= few * few || most <= (real)$rounding;
        }
        last = square;
    }
    return 0;
}
