/* The output, and Jacobians by rows, from the functions of CasADi above. */

/* The nonzeros of a Jacobian, spread out by rows. */
static void mhe_spread(int size, int count, const int *place, const real *nonzeros, real *dense)
{
    for (int i = 0; i < size; i++) dense[i] = 0;
    for (int i = 0; i < count; i++) dense[place[i]] = nonzeros[i];
}

static void $value(const real *x, const real *u, real *y) { mhe_call_h(x, u, y); }

/* h and its Jacobian with respect to x, by rows. */
static void $slope(const real *x, const real *u, real *y, real *C)
{
    real nonzeros[SIZE(MHE_H_NONZEROS)];
    mhe_call_h_jacobian(x, u, y, nonzeros);
    mhe_spread(NY * $width, MHE_H_NONZEROS, mhe_h_place, nonzeros, C);
}
