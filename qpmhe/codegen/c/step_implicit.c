/* An implicit step of a rate: next = x + sum_i d_i Z_i. The derivative is that of the implicit
 * function theorem at the converged stages. qpmhe/model/implicit_steps.py says the same in Python. */

static const real mhe_step_weights[MHE_STAGES] = {$ends};

/* The stages W of a step; whether one of the iterations has converged. */
static int mhe_solve_stages(const real *x, const real *u, real h, real *W)
{
    mhe_reduced r;
    real w[NW];
    int found = mhe_complete(x, u, w, &r);
    if (!found || mhe_keep_jacobian(w, u, h, &r, W)) return found;
    found = 0;
    for (int damped = 0; damped < 2 && !found; damped++)
        found = mhe_iterate_stages(w, u, h, damped, W);
    return found;
}

static void mhe_step_end(const real *x, const real *W, real *next)
{
    for (int a = 0; a < NX; a++) {
        next[a] = x[a];
        for (int i = 0; i < MHE_STAGES; i++) next[a] += mhe_step_weights[i] * W[i * NW + a];
    }
}

static void $value(const real *x, const real *u, real dt, real *next)
{
    real W[MHE_STAGES * NW];
    if (mhe_solve_stages(x, u, dt, W)) {
        mhe_step_end(x, W, next);
        return;
    }
    for (int a = 0; a < NX; a++) next[a] = NAN;
}

$step_slope
/* f and its Jacobian with respect to x, by rows. */
static void $slope(const real *x, const real *u, real dt, real *next, real *A)
{
    real W[MHE_STAGE_VALUES], per[NX];
    mhe_reduced r[MHE_STAGES];
    if (mhe_solve_stages(x, u, dt, W) && mhe_stage_rates(x, u, W, r)) {
        mhe_state_reciprocals(x, dt, W, 0, r, per);
        mhe_step_end(x, W, next);
        if (mhe_step_slope(dt, r, per, A)) return;
    }
    for (int a = 0; a < NX; a++) next[a] = NAN;
    for (int i = 0; i < NX * NX; i++) A[i] = NAN;
}
