/* What filters call of a model with implicit steps: Jacobians have all entries, by rows. */

/* The states behind a step from some others. */
void mhe_steps(int64_t count, const real *x, const real *u, real *next)
{
    for (int64_t k = 0; k < count; k++)
        mhe_f(x + k * NX, u + k * (NU + 1), u[k * (NU + 1) + NU], next + k * NX);
}

static void mhe_call_step(const real *x, const real *u, real *next, real *A)
{
    mhe_f_jacobian(x, u, u[NU], next, A);
}

static void mhe_call_output(const real *x, const real *u, real *y, real *C)
{
    mhe_h_jacobian(x, u, y, C);
}
