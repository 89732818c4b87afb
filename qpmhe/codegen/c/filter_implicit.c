/* What filters call of a model with implicit steps: Jacobians have all entries, by rows. */

static void mhe_call_step(const real *x, const real *u, real *next, real *A)
{
    mhe_f_jacobian(x, u, u[NU], next, A);
}

static void mhe_call_output(const real *x, const real *u, real *y, real *C)
{
    mhe_h_jacobian(x, u, y, C);
}
