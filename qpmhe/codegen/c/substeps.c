/* Several substeps of equal length. */

static void mhe_f(const real *x, const real *u, real dt, real *next)
{
    real at[NX];
    mhe_substep(x, u, dt / $steps, next);
    for (int k = 1; k < $steps; k++) {
        for (int j = 0; j < NX; j++) at[j] = next[j];
        mhe_substep(at, u, dt / $steps, next);
    }
}

/* f and its Jacobian with respect to x, by rows. */
static void mhe_f_jacobian(const real *x, const real *u, real dt, real *next, real *A)
{
    real at[NX], slope[NX * NX], before[NX * NX];
    mhe_substep_jacobian(x, u, dt / $steps, next, A);
    for (int k = 1; k < $steps; k++) {
        for (int j = 0; j < NX; j++) at[j] = next[j];
        for (int i = 0; i < NX * NX; i++) before[i] = A[i];
        mhe_substep_jacobian(at, u, dt / $steps, next, slope);
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NX; j++) {
                real sum = 0;
                for (int l = 0; l < NX; l++) sum += slope[i * NX + l] * before[l * NX + j];
                A[i * NX + j] = sum;
            }
    }
}
