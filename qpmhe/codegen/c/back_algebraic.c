/* Derivatives by x and u of by_f' f + <by_J, J> + by_h' h + <by_C, C>, with the rate f and the output
 * h at w = (x, z(x, u)), and their Jacobians J and C with z following; matrices lie by rows. With the
 * equations g(x, z, u) = 0, J = f_x + f_z Z and Z = -g_z^-1 g_x, the change of J is
 *
 *     df_x + df_z Z - f_z g_z^-1 (dg_x + dg_z Z),
 *
 * and multipliers of g take the place of the derivative by z. */
static void mhe_pull(const mhe_reduced *r, const real *w, const real *u, const real *by_f,
                     const real *by_J, const real *by_h, const real *by_C, real *by_x, real *by_u)
{
    real values[NW], F[NW * NW], H[NY * NW], y[NY], shown[NY * NW], by_w[NW], held[NZ];
    mhe_output_jacobian(w, u, y, shown);
    for (int i = 0; i < NX * NX; i++) F[i / NX * NW + i % NX] = by_J[i];
    for (int i = 0; i < NY * NX; i++) H[i / NX * NW + i % NX] = by_C[i];
    for (int j = 0; j < NX; j++) {
        for (int l = 0; l < NZ; l++) {
            held[l] = 0;
            for (int i = 0; i < NX; i++) held[l] -= r->full[i * NW + NX + l] * by_J[i * NX + j];
            for (int i = 0; i < NY; i++) held[l] -= shown[i * NW + NX + l] * by_C[i * NX + j];
        }
        mhe_solve_turned(NZ, r->factors, r->pivot, held);
        for (int l = 0; l < NZ; l++) F[(NX + l) * NW + j] = held[l];
    }
    for (int l = 0; l < NZ; l++) {
        for (int i = 0; i < NW; i++)
            F[i * NW + NX + l] = mhe_dot(NX, F + i * NW, r->slope + l * NX);
        for (int i = 0; i < NY; i++)
            H[i * NW + NX + l] = mhe_dot(NX, H + i * NW, r->slope + l * NX);
    }
    for (int j = 0; j < NW; j++) values[j] = j < NX ? by_f[j] : 0;
    mhe_pull_functions(w, u, values, F, by_h, H, by_w, by_u);
    for (int l = 0; l < NZ; l++) values[NX + l] = -by_w[NX + l];
    mhe_solve_turned(NZ, r->factors, r->pivot, values + NX);
    mhe_pull_functions(w, u, values, F, by_h, H, by_w, by_u);
    memcpy(by_x, by_w, sizeof(real) * NX);
}
