/* An explicit Euler step of a rate. */

static void $value(const real *x, const real *u, real dt, real *next)
{
    real k[NX];
    mhe_call_f(x, u, k);
    for (int j = 0; j < NX; j++) next[j] = x[j] + dt * k[j];
}

/* f and its Jacobian with respect to x, by rows. */
static void $slope(const real *x, const real *u, real dt, real *next, real *A)
{
    real nonzeros[SIZE(MHE_F_NONZEROS)];
    mhe_call_f_jacobian(x, u, next, nonzeros);
    mhe_spread(NX * NX, MHE_F_NONZEROS, mhe_f_place, nonzeros, A);
    for (int i = 0; i < NX * NX; i++) A[i] *= dt;
    for (int j = 0; j < NX; j++) {
        A[j * NX + j] += 1;
        next[j] = x[j] + dt * next[j];
    }
}
