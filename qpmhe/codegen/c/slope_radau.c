/* The derivatives of the last of three stages x + Z_3 by x, from the Jacobians at all. With B = 1/A,
 *     (B_ii - h J_i) S_i + sum_(j != i) B_ij S_j = (sum_j B_ij) I
 * for S_i = d(x + Z_i)/dx: one block is eliminated after the other, and right sides beside S_3 are
 * multiples of I. Whether all blocks are regular, by the states' reciprocal
 * sizes in `per`. */
static int mhe_step_slope(real h, const mhe_reduced *r, real *per, real *S)
{
    enum { WIDE = 2 * NX };
    const real(*B)[MHE_STAGES] = mhe_stage_inverse;
    real first[NX * NX], block[NX * NX], wide[NX * WIDE], product[NX * WIDE], sums[3];
    int pivot[NX];
    for (int i = 0; i < 3; i++) sums[i] = B[i][0] + B[i][1] + B[i][2];
    /* S_1 = first (sums_1 - B_12 S_2 - B_13 S_3). */
    mhe_shifted(B[0][0], h, r[0].jacobian, block);
    for (int i = 0; i < NX * NX; i++) first[i] = i / NX == i % NX;
    if (!mhe_factor_equations(NX, block, per, pivot)) return 0;
    mhe_solve_columns(NX, block, pivot, NX, first);
    /* S_2 = G_b - G_a S_3, with (G_a, G_b) in wide. */
    mhe_shifted(B[1][1], h, r[1].jacobian, block);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            const real share = B[1][0] * first[i * NX + j], same = i == j;
            block[j * NX + i] -= share * B[0][1];
            wide[i * WIDE + j] = B[1][2] * same - share * B[0][2];
            wide[i * WIDE + NX + j] = sums[1] * same - share * sums[0];
        }
    if (!mhe_factor_equations(NX, block, per, pivot)) return 0;
    mhe_solve_columns(NX, block, pivot, WIDE, wide);
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < WIDE; j++) product[i * WIDE + j] = 0;
        for (int l = 0; l < NX; l++)
            for (int j = 0; j < WIDE; j++)
                product[i * WIDE + j] += first[i * NX + l] * wide[l * WIDE + j];
    }
    mhe_shifted(B[2][2], h, r[2].jacobian, block);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            const int at = i * NX + j, a = i * WIDE + j, b = a + NX;
            block[j * NX + i] -= B[2][1] * wide[a] +
                                 B[2][0] * (B[0][2] * first[at] - B[0][1] * product[a]);
            S[at] = sums[2] * (i == j) - B[2][1] * wide[b] -
                    B[2][0] * (sums[0] * first[at] - B[0][1] * product[b]);
        }
    if (!mhe_factor_equations(NX, block, per, pivot)) return 0;
    mhe_solve_columns(NX, block, pivot, NX, S);
    return 1;
}
