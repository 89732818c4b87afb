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

/* The same by elimination without exchanges; whether it may do without. */
static int mhe_invert_blocks(real h, const real *J, const real *per, mhe_modes *modes)
{
    real one[NX * NX], z[NX * NX];
    for (int i = 0; i < NX * NX; i++) one[i] = z[i] = 0;
    for (int a = 0; a < NX; a++) {
        one[a * NX + a] = $real;
        z[a * NX + a] = 1;
    }
    for (int q = 0; q < MHE_FLOW_NONZEROS; q++)
        one[mhe_flow_row[q] * NX + mhe_flow_column[q]] -= h * J[q];
    if (!mhe_factor_blocks(1, one, per)) return 0;
    mhe_solve_blocks(1, one, z);
    for (int i = 0; i < NX * NX; i++) modes->one[i % NX * NX + i / NX] = z[i];
    if (MHE_PAIR) {
        real pair[4 * NX * NX], both[2 * NX * NX];
        for (int i = 0; i < 4 * NX * NX; i++) pair[i] = 0;
        for (int i = 0; i < 2 * NX * NX; i++) both[i] = 0;
        for (int a = 0; a < NX; a++) {
            real *block = pair + 4 * (a * NX + a);
            block[0] = block[3] = $real + $shift;
            block[1] = -$turning;
            block[2] = $turning;
            both[2 * a * NX + a] = 1;
        }
        for (int q = 0; q < MHE_FLOW_NONZEROS; q++) {
            real *block = pair + 4 * (mhe_flow_row[q] * NX + mhe_flow_column[q]);
            block[0] -= h * J[q];
            block[3] -= h * J[q];
        }
        if (!mhe_factor_blocks(2, pair, per)) return 0;
        mhe_solve_blocks(2, pair, both);
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NX; j++) {
                modes->parts[j * NX + i] = both[2 * i * NX + j];
                modes->parts[NX * NX + j * NX + i] = -both[(2 * i + 1) * NX + j];
            }
    }
    return 1;
}

/* Whether the matrices are regular, by the states' reciprocal sizes. */
static int mhe_invert_modes(real h, const real *J, real *per, mhe_modes *modes)
{
    enum { WIDE = 2 * NX };
    real block[NX * NX], wide[SIZE(NX * WIDE * MHE_PAIR)], *P = modes->one;
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

/* to += weights from, of values at all stages. */
static void mhe_add_stages(const real (*weights)[MHE_STAGES], const real *from, real *to)
{
    for (int i = 0; i < MHE_STAGES; i++)
        for (int j = 0; j < MHE_STAGES; j++)
            for (int a = 0; a < NX; a++) to[i * NX + a] += weights[i][j] * from[j * NX + a];
}

/* The corrections of Z, in place of the residuals h f_i - sum_j (1/A)_ij Z_j. */
static void mhe_solve_modes(const mhe_modes *modes, real *stages)
{
    real right[MHE_STAGES * NX], found[MHE_STAGES * NX];
    for (int i = 0; i < MHE_STAGES * NX; i++) right[i] = 0;
    mhe_add_stages(mhe_to_modes, stages, right);
    for (int i = 0; i < NX; i++) {
        real sum = 0;
        for (int j = 0; j < NX; j++) sum += modes->one[j * NX + i] * right[j];
        found[i] = sum;
    }
    for (int i = 0; i < NX * MHE_PAIR; i++) {
        const real *direct = modes->parts + i, *across = direct + NX * NX;
        const real *a = right + NX, *b = a + NX;
        real first = 0, second = 0;
        for (int j = 0; j < NX; j++) {
            first += direct[j * NX] * a[j] + across[j * NX] * b[j];
            second += direct[j * NX] * b[j] - across[j * NX] * a[j];
        }
        found[NX + i] = first;
        found[2 * NX + i] = second;
    }
    for (int i = 0; i < MHE_STAGES * NX; i++) stages[i] = 0;
    mhe_add_stages(mhe_from_modes, found, stages);
}

/* Newton's corrections of the stages W by the frozen r. */
static void mhe_kept_moves(const real *x, const real *u, real h, const mhe_reduced *r,
                          const mhe_modes *modes, const real *W, int first, real *moves)
{
    real at[NW], values[NW], stages[MHE_STAGES * NX], rates[MHE_STAGES * NX];
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
    for (int i = 0; i < MHE_STAGES; i++)
        for (int a = 0; a < NX; a++) {
            real sum = h * rates[i * NX + a];
            for (int j = 0; j < MHE_STAGES; j++) sum -= mhe_stage_inverse[i][j] * W[j * NW + a];
            stages[i * NX + a] = sum;
        }
    mhe_solve_modes(modes, stages);
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

/* The stages W of a step from w = (x, z), at which f is linearised; whether they converge fast. */
static int mhe_keep_jacobian(const real *w, const real *u, real h, const mhe_reduced *r, real *W)
{
    mhe_modes modes;
    real moves[MHE_STAGE_VALUES], sizes[MHE_STAGE_VALUES], per[MHE_STAGE_VALUES];
    real rounding[NW], last = INFINITY;
    real made[$kept][MHE_STAGE_VALUES], squares[$kept]; /* the corrections, as shares of the sizes */
    int sized = 1;
    mhe_start_stages(w, W);
    mhe_state_reciprocals(w, h, W, 1, r, sizes);
    if (!mhe_invert_modes(h, r->jacobian, sizes, &modes)) return 0;
    for (int k = 0; k < $kept; k++) {
        real *share = made[k], length = 0;
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
        for (int i = 0; i < MHE_STAGE_VALUES; i++) length = mhe_max((real)fabs(share[i]), length);
        const real square = mhe_stage_product(share, share);
        squares[k] = 1 / square;
        const real rate = length / last;
        if (!isfinite(square)) return 0;
        if (length <= (real)$rounding || (k > 0 && length * rate <= (real)$rounding)) return 1;
        if (rate > (real)$contraction) {
            real most = 0;
            for (int i = 0; i < MHE_STAGE_VALUES; i++)
                most = mhe_max((real)fabs(share[i]) * rounding[i % NW], most);
            return length <= (real)$few * (real)$rounding || most <= (real)$rounding;
        }
        last = length;
    }
    return 0;
}
