/* A step of the classical Runge-Kutta method of a rate. */

static void $value(const real *x, const real *u, real dt, real *next)
{
    real k1[NX], k2[NX], k3[NX], k4[NX], at[NX];
    const real half = (real)0.5 * dt, sixth = dt / 6;
    mhe_call_f(x, u, k1);
    for (int j = 0; j < NX; j++) at[j] = x[j] + half * k1[j];
    mhe_call_f(at, u, k2);
    for (int j = 0; j < NX; j++) at[j] = x[j] + half * k2[j];
    mhe_call_f(at, u, k3);
    for (int j = 0; j < NX; j++) at[j] = x[j] + dt * k3[j];
    mhe_call_f(at, u, k4);
    for (int j = 0; j < NX; j++)
        next[j] = x[j] + sixth * (k1[j] + 2 * (k2[j] + k3[j]) + k4[j]);
}

/* product = J (I + factor S), with the sparse Jacobian J of the rate and a dense S. */
static void mhe_chain(const real *nonzeros, real factor, const real *S, real *product)
{
    for (int i = 0; i < NX * NX; i++) product[i] = 0;
    for (int i = 0; i < MHE_F_NONZEROS; i++) {
        const int row = mhe_f_place[i] / NX, column = mhe_f_place[i] % NX;
        const real *from = S + column * NX;
        real *to = product + row * NX;
        const real value = nonzeros[i], scaled = value * factor;
        for (int j = 0; j < NX; j++) to[j] += scaled * from[j];
        to[column] += value;
    }
}

/* f and its Jacobian with respect to x, by rows. */
static void $slope(const real *x, const real *u, real dt, real *next, real *A)
{
    real k1[NX], k2[NX], k3[NX], k4[NX], at[NX], nonzeros[SIZE(MHE_F_NONZEROS)];
    real odd[NX * NX], even[NX * NX]; /* slopes of the stages */
    const real half = (real)0.5 * dt, sixth = dt / 6;
    mhe_call_f_jacobian(x, u, k1, nonzeros);
    mhe_spread(NX * NX, MHE_F_NONZEROS, mhe_f_place, nonzeros, odd);
    for (int i = 0; i < NX * NX; i++) A[i] = odd[i];
    for (int j = 0; j < NX; j++) at[j] = x[j] + half * k1[j];
    mhe_call_f_jacobian(at, u, k2, nonzeros);
    mhe_chain(nonzeros, half, odd, even);
    for (int i = 0; i < NX * NX; i++) A[i] += 2 * even[i];
    for (int j = 0; j < NX; j++) at[j] = x[j] + half * k2[j];
    mhe_call_f_jacobian(at, u, k3, nonzeros);
    mhe_chain(nonzeros, half, even, odd);
    for (int i = 0; i < NX * NX; i++) A[i] += 2 * odd[i];
    for (int j = 0; j < NX; j++) at[j] = x[j] + dt * k3[j];
    mhe_call_f_jacobian(at, u, k4, nonzeros);
    mhe_chain(nonzeros, dt, odd, even);
    for (int j = 0; j < NX; j++)
        next[j] = x[j] + sixth * (k1[j] + 2 * (k2[j] + k3[j]) + k4[j]);
    for (int i = 0; i < NX * NX; i++) A[i] = sixth * (A[i] + even[i]);
    for (int j = 0; j < NX; j++) A[j * NX + j] += 1;
}
