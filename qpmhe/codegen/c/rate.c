/* The rate of a model without algebraic states, at a stage of a step. */

#define NW NX

typedef struct {
    real rate[NX], values[NW], jacobian[SIZE(MHE_FLOW_NONZEROS)];
    int side;
} mhe_reduced;

static int mhe_reduce(const real *w, const real *u, mhe_reduced *r)
{
    mhe_call_f_jacobian(w, u, r->values, r->jacobian);
    r->side = 1;
    for (int i = 0; i < NX; i++) {
        r->rate[i] = r->values[i];
        if (!isfinite(r->rate[i])) return 0;
    }
    return 1;
}

/* w = x, and the rate, linearised there. */
static int mhe_complete(const real *x, const real *u, real *w, mhe_reduced *r)
{
    for (int j = 0; j < NX; j++) w[j] = x[j];
    return mhe_reduce(w, u, r);
}

static void mhe_algebraic_sizes(const mhe_reduced *r, const real *z, const real *sizes, real *out)
{
    (void)r; (void)z; (void)sizes; (void)out;
}

static real mhe_move_algebraic(const mhe_reduced *r, const real *w, const real *sizes, real *step)
{
    (void)r; (void)w; (void)sizes; (void)step;
    return 0;
}

static void mhe_follow(const mhe_reduced *r, real *step)
{
    (void)r; (void)step;
}

static void mhe_freeze(const mhe_reduced *r, const real *values, real *rate, real *step)
{
    (void)r; (void)step;
    for (int i = 0; i < NX; i++) rate[i] = values[i];
}
