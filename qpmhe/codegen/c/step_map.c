/* A discrete-time model: f itself. */

static void $value(const real *x, const real *u, real dt, real *next)
{
    (void)dt;
    mhe_call_f(x, u, next);
}

/* f and its Jacobian with respect to x, by rows. */
static void $slope(const real *x, const real *u, real dt, real *next, real *A)
{
    real nonzeros[SIZE(MHE_F_NONZEROS)];
    (void)dt;
    mhe_call_f_jacobian(x, u, next, nonzeros);
    mhe_spread(NX * NX, MHE_F_NONZEROS, mhe_f_place, nonzeros, A);
}
