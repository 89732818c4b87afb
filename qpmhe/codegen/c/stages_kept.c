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
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) out[j * NX + i] = a * (i == j) - h * J[i * NX + j];
}

/* Inverses of both matrices, by columns: of the real one, and both parts of the complex one. */
typedef struct {
    real one[NX * NX], parts[SIZE(2 * NX * NX * MHE_PAIR)];
} mhe_modes;

/* Whether the matrices are regular, by the states' reciprocal sizes. */
static int mhe_invert_modes(real h, const real *J, real *per, mhe_modes *modes)
{
    enum { WIDE = 2 * NX };
    real block[NX * NX], wide[SIZE(NX * WIDE * MHE_PAIR)], *P = modes->one;
    int pivot[NX];
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

/* The corrections of Z, in place of the residuals h f_i - sum_j (1/A)_ij Z_j. */
static void mhe_solve_modes(const mhe_modes *modes, real *stages)
{
    real right[MHE_STAGES * NX], found[MHE_STAGES * NX];
    for (int i = 0; i < MHE_STAGES; i++)
        for (int a = 0; a < NX; a++) {
            real sum = 0;
            for (int j = 0; j < MHE_STAGES; j++) sum += mhe_to_modes[i][j] * stages[j * NX + a];
            right[i * NX + a] = sum;
            found[i * NX + a] = 0;
        }
    for (int j = 0; j < NX; j++) {
        const real *one = modes->one + j * NX;
        for (int i = 0; i < NX; i++) found[i] += one[i] * right[j];
        if (!MHE_PAIR) continue;
        const real *direct = modes->parts + j * NX, *across = direct + NX * NX;
        const real a = right[NX + j], b = right[2 * NX + j];
        for (int i = 0; i < NX; i++) {
            found[NX + i] += direct[i] * a + across[i] * b;
            found[2 * NX + i] += direct[i] * b - across[i] * a;
        }
    }
    for (int i = 0; i < MHE_STAGES; i++)
        for (int a = 0; a < NX; a++) {
            real sum = 0;
            for (int j = 0; j < MHE_STAGES; j++) sum += mhe_from_modes[i][j] * found[j * NX + a];
            stages[i * NX + a] = sum;
        }
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
    real equations[NX], reach[NX];
    for (int j = 0; j < NW; j++) {
        real most = 0;
        for (int i = 0; i < MHE_STAGES; i++)
            most = mhe_max((real)fabs(moves[i * NW + j]), most);
        sizes[j] = (real)fabs(w[j]) + most;
    }
    for (int a = 0; a < NX; a++) {
        real flows = 0;
        for (int b = 0; b < NX; b++) flows += h * (real)fabs(r->jacobian[a * NX + b]) * sizes[b];
        equations[a] = $real * sizes[a] + flows;
        reach[a] = sizes[a] + flows / (1 + h * (real)fabs(r->jacobian[a * NX + a]));
    }
    for (int a = 0; a < NX; a++) {
        real left = 0;
        for (int b = 0; b < NX; b++) left += (real)fabs(modes->one[b * NX + a]) * equations[b];
        shares[a] = left < equations[a] ? left : equations[a];
        if (!(left <= (real)$spread * reach[a])) return 0;
    }
    mhe_algebraic_sizes(r, sizes + NX, shares, shares + NX);
    for (int j = 0; j < NW; j++) shares[j] = shares[j] > 0 ? sizes[j] / shares[j] : 1;
    return 1;
}

/* The stages W of a step from w = (x, z), at which f is linearised; whether they converge fast. */
static int mhe_keep_jacobian(const real *w, const real *u, real h, const mhe_reduced *r, real *W)
{
    mhe_modes modes;
    real moves[MHE_STAGE_VALUES], sizes[MHE_STAGE_VALUES], per[MHE_STAGE_VALUES];
    real rounding[NW], last = INFINITY;
    real made[$kept][MHE_STAGE_VALUES], squares[$kept]; /* the corrections, as shares of the sizes */
    mhe_start_stages(w, W);
    mhe_state_reciprocals(w, h, W, 1, r, sizes);
    if (!mhe_invert_modes(h, r->jacobian, sizes, &modes)) return 0;
    for (int k = 0; k < $kept; k++) {
        real *share = made[k], length = 0, square = 0;
        mhe_kept_moves(w, u, h, r, &modes, W, k == 0, moves);
        if (k == 0) {
            if (!mhe_kept_sizes(w, h, r, &modes, moves, sizes, rounding)) return 0;
            for (int i = 0; i < MHE_STAGE_VALUES; i++) {
                sizes[i] = sizes[i % NW];
                per[i] = sizes[i] > 0 ? 1 / sizes[i] : 1;
            }
        }
        for (int i = 0; i < MHE_STAGE_VALUES; i++) share[i] = moves[i] * per[i];
        for (int q = 1; q < k; q++) {
            real part = 0;
            for (int i = 0; i < MHE_STAGE_VALUES; i++) part += made[q - 1][i] * share[i];
            part *= squares[q - 1];
            for (int i = 0; i < MHE_STAGE_VALUES; i++) share[i] += part * made[q][i];
        }
        if (k) {
            real part = 0;
            for (int i = 0; i < MHE_STAGE_VALUES; i++) part += made[k - 1][i] * share[i];
            part = 1 / (1 - part * squares[k - 1]);
            for (int i = 0; i < MHE_STAGE_VALUES; i++) share[i] *= part;
        }
        for (int i = 0; i < MHE_STAGE_VALUES; i++) {
            /* What stays 0 in linear equations has no size. */
            if (!(sizes[i] > 0) && share[i] != 0) return 0;
            length = mhe_max((real)fabs(share[i]), length);
            square += share[i] * share[i];
            W[i] += share[i] * sizes[i];
        }
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
