/* z = M^-T z, with the factors of M, in place. */
static void mhe_solve_turned(int size, const real *M, const int *pivot, real *z)
{
    for (int c = 0; c < size; c++)
        z[c] = (z[c] - mhe_dot(c, M + c * size, z)) * M[c * size + c];
    for (int c = size - 1; c >= 0; c--)
        z[c] -= mhe_dot(size - c - 1, M + c * size + c + 1, z + c + 1);
    for (int c = size - 1; c >= 0; c--) mhe_exchange(z + c, z + pivot[c]);
}

/* Derivatives by w and u, from those by all values of CasADi's functions, and by their Jacobians, by
 * rows. */
static void mhe_pull_functions(const real *w, const real *u, const real *by_f, const real *by_F,
                               const real *by_h, const real *by_H, real *by_w, real *by_u)
{
    real given[2 * NW + MHE_RATE_NONZEROS + NY + MHE_SHOWN_NONZEROS], *to = given + 2 * NW;
    memcpy(given, w, sizeof(real) * NW);
    memcpy(given + NW, by_f, sizeof(real) * NW);
    for (int q = 0; q < MHE_RATE_NONZEROS; q++)
        *to++ = by_F[mhe_rate_row[q] * NW + mhe_rate_column[q]];
    memcpy(to, by_h, sizeof(real) * NY);
    to += NY;
    for (int q = 0; q < MHE_SHOWN_NONZEROS; q++)
        *to++ = by_H[mhe_shown_row[q] * NW + mhe_shown_column[q]];
    mhe_call_pull(given, u, by_w, by_u);
}
