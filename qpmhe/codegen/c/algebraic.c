/* A model with algebraic states z: f has their equations' residuals g below the rate, and f and h
 * are functions of w = (x, z). qpmhe/model/algebraic.py says the same in Python. */

#define NZ $count
#define NW (NX + NZ)
static const real mhe_algebraic_guess[NZ] = {$guess};

/* f, linearised at some w, as a rate of x alone: the rate at the z that solves the linearised
 * equations, its Jacobian, Newton's correction of z, and the derivative of z by x. */
typedef struct {
    real rate[NX], jacobian[SIZE(MHE_FLOW_NONZEROS)], step[NZ], slope[NZ * NX];
    real full[NW * NW], factors[NZ * NZ];
    real values[NW];
    int pivot[NZ], side; /* the sign of det(dg/dz), which changes where solutions meet */
} mhe_reduced;

/* Newton's correction -(dg/dz)^-1 g, from values of f. */
static void mhe_algebraic_step(const mhe_reduced *r, const real *values, real *step)
{
    for (int i = 0; i < NZ; i++) step[i] = -values[NX + i];
    mhe_solve_equations(NZ, r->factors, r->pivot, step);
}

/* Linearise f at w; whether it is finite and dg/dz regular there. */
static int mhe_reduce(const real *w, const real *u, mhe_reduced *r)
{
    real nonzeros[SIZE(MHE_F_NONZEROS)], per[NZ];
    mhe_call_f_jacobian(w, u, r->values, nonzeros);
    for (int i = 0; i < NW; i++)
        if (!isfinite(r->values[i])) return 0;
    mhe_spread(NW * NW, MHE_F_NONZEROS, mhe_f_place, nonzeros, r->full);
    for (int i = 0; i < NZ; i++) {
        const real *row = r->full + (NX + i) * NW;
        for (int j = 0; j < NX; j++) r->slope[i * NX + j] = -row[j];
        for (int j = 0; j < NZ; j++) r->factors[j * NZ + i] = row[NX + j];
        per[i] = 0;
        for (int j = 0; j < NW; j++) per[i] += (real)fabs(row[j] * w[j]);
    }
    mhe_reciprocals(NZ, per);
    if (!mhe_factor_equations(NZ, r->factors, per, r->pivot)) return 0;
    mhe_solve_columns(NZ, r->factors, r->pivot, NX, r->slope);
    mhe_algebraic_step(r, r->values, r->step);
    r->side = 1;
    for (int i = 0; i < NZ; i++)
        if ((r->pivot[i] != i) != (r->factors[i * NZ + i] < 0)) r->side = -r->side;
    for (int i = 0; i < NX; i++) {
        const real *row = r->full + i * NW;
        r->rate[i] = r->values[i];
        for (int l = 0; l < NZ; l++) r->rate[i] += row[NX + l] * r->step[l];
    }
    for (int q = 0; q < MHE_FLOW_NONZEROS; q++) {
        const int i = mhe_flow_row[q], j = mhe_flow_column[q];
        const real *row = r->full + i * NW;
        r->jacobian[q] = row[j];
        for (int l = 0; l < NZ; l++) r->jacobian[q] += row[NX + l] * r->slope[l * NX + j];
    }
    return 1;
}

/* What rounding amounts to in z, from the sizes of x and of z. */
static void mhe_algebraic_sizes(const mhe_reduced *r, const real *z, const real *sizes, real *out)
{
    real inverse[NZ * NZ];
    for (int i = 0; i < NZ * NZ; i++) inverse[i] = i / NZ == i % NZ;
    mhe_solve_columns(NZ, r->factors, r->pivot, NZ, inverse);
    for (int i = 0; i < NZ; i++) out[i] = z[i];
    for (int j = 0; j < NZ; j++) {
        const real *row = r->full + (NX + j) * NW;
        real term = 0;
        for (int l = 0; l < NX; l++) term += (real)fabs(row[l]) * sizes[l];
        for (int l = 0; l < NZ; l++) term += (real)fabs(row[NX + l]) * z[l];
        for (int i = 0; i < NZ; i++) out[i] += (real)fabs(inverse[i * NZ + j]) * term;
    }
}

/* The largest share that a correction of z has of what rounding amounts to, from the sizes of x. */
static real mhe_algebraic_share(const mhe_reduced *r, const real *z, const real *sizes,
                                const real *step)
{
    real moved[NZ], own[NZ];
    for (int i = 0; i < NZ; i++) moved[i] = (real)fabs(z[i] + step[i]);
    mhe_algebraic_sizes(r, moved, sizes, own);
    return mhe_share(NZ, step, own);
}

/* Let a correction of z, step = (dx, dz), follow that of x. */
static void mhe_follow(const mhe_reduced *r, real *step)
{
    for (int i = 0; i < NZ; i++)
        for (int j = 0; j < NX; j++) step[NX + i] += r->slope[i * NX + j] * step[j];
}

/* The correction of z behind one of x, step = (dx, dz); its largest share. */
static real mhe_move_algebraic(const mhe_reduced *r, const real *w, const real *sizes, real *step)
{
    for (int i = 0; i < NZ; i++) step[NX + i] = r->step[i];
    mhe_follow(r, step);
    return mhe_algebraic_share(r, w + NX, sizes, step + NX);
}

/* The rate at another point, from values of f and by the Jacobian of r, and Newton's correction of z
 * in step = (dx, dz). */
static void mhe_freeze(const mhe_reduced *r, const real *values, real *rate, real *step)
{
    mhe_algebraic_step(r, values, step + NX);
    for (int i = 0; i < NX; i++) {
        rate[i] = values[i];
        for (int l = 0; l < NZ; l++) rate[i] += r->full[i * NW + NX + l] * step[NX + l];
    }
}

/* w = (x, z(x, u)) by Newton steps from the guess, damped so that f is nearly linear along them;
 * whether they converge. `last_r` gets f, linearised before the last correction, unless it is null. */
static int mhe_complete(const real *x, const real *u, real *w, mhe_reduced *last_r)
{
    MHE_LARGE mhe_reduced both[2];
    real trial[NW], sizes[NX], scale[NZ], again[NZ], last = INFINITY;
    int now = 0;
    for (int j = 0; j < NX; j++) {
        w[j] = trial[j] = x[j];
        sizes[j] = (real)fabs(x[j]);
    }
    for (int i = 0; i < NZ; i++) w[NX + i] = mhe_algebraic_guess[i];
    if (!mhe_reduce(w, u, both)) return 0;
    for (int iteration = 0; iteration < $iterations; iteration++) {
        const mhe_reduced *r = both + now;
        mhe_reduced *next = both + !now;
        real factor = 1;
        int good = 0;
        const real length = mhe_algebraic_share(r, w + NX, sizes, r->step);
        if (isnan(length)) return 0;
        const int done = mhe_converged(length, last);
        for (int i = 0; i < NZ; i++) scale[i] = (real)(fabs(w[NX + i]) + fabs(r->step[i]));
        const real before = mhe_share(NZ, r->step, scale);
        for (int halving = 0; halving < $halvings && !good; halving++) {
            real curved = NAN;
            for (int i = 0; i < NZ; i++) trial[NX + i] = w[NX + i] + factor * r->step[i];
            good = done;
            if (!done && mhe_reduce(trial, u, next) && next->side == r->side) {
                mhe_algebraic_step(r, next->values, again);
                for (int i = 0; i < NZ; i++) again[i] -= (1 - factor) * r->step[i];
                curved = mhe_share(NZ, again, scale);
                good = mhe_straight(curved, factor, before, length);
            }
            if (!good) factor = mhe_shorter(curved, factor, before);
        }
        if (!good) return 0;
        for (int i = 0; i < NZ; i++) w[NX + i] = trial[NX + i];
        if (done) {
            if (last_r) *last_r = *r;
            return 1;
        }
        last = length;
        now = !now;
    }
    return 0;
}

static void mhe_h(const real *x, const real *u, real *y)
{
    real w[NW];
    if (mhe_complete(x, u, w, 0)) {
        mhe_output(w, u, y);
        return;
    }
    for (int i = 0; i < NY; i++) y[i] = NAN;
}

/* h and its Jacobian with respect to x, with z following, by rows. */
static void mhe_h_jacobian(const real *x, const real *u, real *y, real *C)
{
    MHE_LARGE mhe_reduced r;
    real w[NW], full[NY * NW];
    if (!mhe_complete(x, u, w, 0) || !mhe_reduce(w, u, &r)) {
        for (int i = 0; i < NY; i++) y[i] = NAN;
        for (int i = 0; i < NY * NX; i++) C[i] = NAN;
        return;
    }
    mhe_output_jacobian(w, u, y, full);
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NX; j++) {
            real sum = full[i * NW + j];
            for (int l = 0; l < NZ; l++) sum += full[i * NW + NX + l] * r.slope[l * NX + j];
            C[i * NX + j] = sum;
        }
}
