/* The adjoint of an implicit step and of its derivative. */

#include <stdlib.h>

/* Derivatives by x of by_next' next + <by_A, A>, with the step next(x, u) and its derivative A by x;
 * those by u are added. For T_i = d(x + Z_i)/dx and M = I - h (A_ij J_j), M T = (1, ..., 1), so that
 *
 *     <L, dT> = h sum_j <sum_i A_ij (M^-T L)_i T_j', dJ_j>.
 *
 * This moves the stages, too: then it is an adjoint of first order. */
static void mhe_step_back(const real *x, const real *u, real h, const real *by_next,
                          const real *by_A, real *by_x, real *by_u)
{
    MHE_LARGE real M[MHE_UNKNOWNS * MHE_UNKNOWNS], T[MHE_UNKNOWNS * NX], by_J[MHE_STAGES * NX * NX];
    real W[MHE_STAGES * NW], per[NX], turned[MHE_UNKNOWNS], at[MHE_STAGES * NW];
    real rate[NX] = {0}, moved[NX], inputs[NU + 1];
    const real output[NY] = {0}, slope[NY * NX] = {0};
    MHE_LARGE mhe_reduced r[MHE_STAGES];
    int pivot[MHE_UNKNOWNS];
    for (int j = 0; j < NX; j++) by_x[j] = NAN;
    for (int i = 0; i < MHE_STAGES * NX * NX; i++) by_J[i] = 0;
    if (!mhe_solve_stages(x, u, h, 1, 0, W, r)) return;
    mhe_state_reciprocals(x, h, W, MHE_STAGES, r, per);
    if (!mhe_stage_factor(h, r, per, M, pivot)) return;
    for (int i = 0; i < MHE_UNKNOWNS * NX; i++) T[i] = i / NX % NX == i % NX;
    mhe_solve_columns(MHE_UNKNOWNS, M, pivot, NX, T);
    for (int b = 0; b < NX; b++) {
        for (int i = 0; i < MHE_UNKNOWNS; i++)
            turned[i] = mhe_step_weights[i / NX] * by_A[i % NX * NX + b];
        mhe_solve_turned(MHE_UNKNOWNS, M, pivot, turned);
        for (int j = 0; j < MHE_STAGES; j++)
            for (int a = 0; a < NX; a++) {
                real sum = 0;
                for (int i = 0; i < MHE_STAGES; i++)
                    sum += h * mhe_stage_weights[i][j] * turned[i * NX + a];
                for (int c = 0; c < NX; c++)
                    by_J[(j * NX + a) * NX + c] += sum * T[(j * NX + c) * NX + b];
            }
    }
    for (int i = 0; i < MHE_STAGES; i++) {
        mhe_stage_state(x, W + i * NW, at + i * NW);
        mhe_pull(r + i, at + i * NW, u, rate, by_J + i * NX * NX, output, slope, moved, inputs);
        for (int a = 0; a < NX; a++)
            turned[i * NX + a] = mhe_step_weights[i] * by_next[a] + moved[a];
    }
    mhe_solve_turned(MHE_UNKNOWNS, M, pivot, turned);
    memcpy(by_x, by_next, sizeof(real) * NX);
    for (int j = 0; j < MHE_STAGES; j++) {
        for (int a = 0; a < NX; a++) {
            rate[a] = 0;
            for (int i = 0; i < MHE_STAGES; i++)
                rate[a] += h * mhe_stage_weights[i][j] * turned[i * NX + a];
        }
        mhe_pull(r + j, at + j * NW, u, rate, by_J + j * NX * NX, output, slope, moved, inputs);
        for (int a = 0; a < NX; a++) by_x[a] += moved[a];
        for (int k = 0; k < NU; k++) by_u[k] += inputs[k];
    }
}

/* Derivatives by z and u, from those by f, A, h and C, which lie behind z. What it keeps of many
 * substeps of many states is more than a stack holds. */
static void mhe_call_back(const real *given, const real *u, real *by_z, real *by_u)
{
    enum { STEPS = $steps };
    const real *by_A = given + 2 * NX, *by_h = by_A + NX * NX, *by_C = by_h + NY, dt = u[NU] / STEPS;
    /* Before each substep: the state, and its derivative by z. Then the substep's own. */
    real *at = malloc(sizeof(real) * ((STEPS + 1) * (NX + NX * NX) + STEPS * NX * NX));
    real *reached = at + (STEPS + 1) * NX, *slopes = reached + (STEPS + 1) * NX * NX;
    MHE_LARGE real held[NX * NX], own[NX * NX];
    MHE_LARGE mhe_reduced r;
    static const real nothing[NX * NX] = {0};
    real ahead[NX], moved[NX], inputs[NU + 1], w[NW];
    for (int k = 0; k <= NU; k++) by_u[k] = 0;
    for (int j = 0; j < NX; j++) by_z[j] = NAN;
    if (!at) return;
    memcpy(at, given, sizeof(real) * NX);
    for (int i = 0; i < NX * NX; i++) reached[i] = i / NX == i % NX;
    for (int k = 0; k < STEPS; k++) {
        real *slope = slopes + k * NX * NX, *before = reached + k * NX * NX;
        $slope(at + k * NX, u, dt, at + (k + 1) * NX, slope);
        mhe_multiply(NX, NX, NX, slope, before, before + NX * NX);
    }
    memcpy(ahead, given + NX, sizeof ahead);
    memcpy(held, by_A, sizeof held);
    for (int k = STEPS - 1; k >= 0; k--) {
        mhe_multiply_transposed(NX, NX, NX, held, reached + k * NX * NX, own);
        mhe_step_back(at + k * NX, u, dt, ahead, own, moved, by_u);
        memcpy(ahead, moved, sizeof ahead);
        for (int i = 0; i < NX * NX; i++) own[i] = 0;
        mhe_add_product(NX, NX, NX, slopes + k * NX * NX, held, own);
        memcpy(held, own, sizeof held);
    }
    free(at);
    for (int j = 0; j < NX; j++) moved[j] = NAN;
    for (int k = 0; k < NU; k++) inputs[k] = NAN;
    if (mhe_complete(given, u, w, &r) && mhe_reduce(w, u, &r))
        mhe_pull(&r, w, u, nothing, nothing, by_h, by_C, moved, inputs);
    for (int j = 0; j < NX; j++) by_z[j] = ahead[j] + moved[j];
    for (int k = 0; k < NU; k++) by_u[k] += inputs[k];
}
