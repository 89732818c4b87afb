/* The derivative of x + d Z by x, of a single stage, from the Jacobian there; whether it exists.
 * The states' reciprocal sizes are in `per`. */
static int mhe_step_slope(real h, const mhe_reduced *r, real *per, real *S)
{
    real block[NX * NX];
    int pivot[NX];
    mhe_shifted(mhe_stage_inverse[0][0], h, r->jacobian, block);
    if (!mhe_factor_equations(NX, block, per, pivot)) return 0;
    for (int i = 0; i < NX * NX; i++) S[i] = h * mhe_step_weights[0] * r->jacobian[i];
    mhe_solve_columns(NX, block, pivot, NX, S);
    for (int i = 0; i < NX; i++) S[i * NX + i] += 1;
    return 1;
}
