/* Nonlinear constraints of which some are functions of the algebraic states, which follow x and u.
 * CasADi's code has z below the joint argument (x, w, v), and its columns last. */

static int mhe_join_algebraic(const real *joint, const real *u, real *full, real *w)
{
    const int found = mhe_complete(joint, u, w, 0);
    for (int j = 0; j < $joint; j++) full[j] = joint[j];
    for (int i = 0; i < NZ; i++) full[$joint + i] = found ? w[NX + i] : NAN;
    return found;
}

static void mhe_call_g(const real *joint, const real *u, real *values)
{
    real full[$joint + NZ], w[NW];
    (void)mhe_join_algebraic(joint, u, full, w);
    mhe_call_joined_g(full, u, values);
}

/* Behind the derivatives by (x, w, v), those by x of each row that is a function of z. */
static void mhe_call_g_jacobian(const real *joint, const real *u, real *values, real *slopes)
{
    MHE_LARGE mhe_reduced r;
    real full[$joint + NZ], w[NW], inner[$direct + $chained];
    const int regular = mhe_join_algebraic(joint, u, full, w) && mhe_reduce(w, u, &r);
    mhe_call_joined_g_jacobian(full, u, values, inner);
    for (int i = 0; i < $direct; i++) slopes[i] = inner[i];
    for (int i = $direct; i < MHE_G_NONZEROS; i++) slopes[i] = regular ? 0 : NAN;
    for (int q = 0; q < $chained && regular; q++)
        for (int j = 0; j < NX; j++)
            slopes[$direct + mhe_z_place[q] * NX + j] +=
                inner[$direct + q] * r.slope[mhe_z_column[q] * NX + j];
}
