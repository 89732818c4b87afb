/* An implicit step of a rate: the stages Z_i = h sum_j A_ij f(x + Z_j) by Newton's method from
 * Z = 0, to rounding, and next = x + sum_i d_i Z_i. The derivative is that of the implicit function
 * theorem at the converged stages. qpmhe/model/implicit_steps.py says the same in Python. */

#define MHE_STAGES $stages
#define MHE_UNKNOWNS (MHE_STAGES * NX)
static const real mhe_stage_weights[MHE_STAGES][MHE_STAGES] = {$weights};
static const real mhe_step_weights[MHE_STAGES] = {$ends};

/* Jacobians J (s, n, n) of the rate at all stages. */
static void mhe_stage_slopes(const real *x, const real *u, const real *Z, real *J)
{
    real at[NX], k[NX], nonzeros[SIZE(MHE_F_NONZEROS)];
    for (int i = 0; i < MHE_STAGES; i++) {
        for (int j = 0; j < NX; j++) at[j] = x[j] + Z[i * NX + j];
        mhe_call_f_jacobian(at, u, k, nonzeros);
        mhe_spread(NX * NX, MHE_F_NONZEROS, mhe_f_place, nonzeros, J + i * NX * NX);
    }
}

/* The residual Z - h A f(x + Z); whether it is finite. */
static int mhe_stage_residual(const real *x, const real *u, real h, const real *Z, real *residual)
{
    real at[NX], k[MHE_UNKNOWNS];
    int finite = 1;
    for (int i = 0; i < MHE_STAGES; i++) {
        for (int j = 0; j < NX; j++) at[j] = x[j] + Z[i * NX + j];
        mhe_call_f(at, u, k + i * NX);
    }
    for (int i = 0; i < MHE_STAGES; i++)
        for (int a = 0; a < NX; a++) {
            real sum = 0;
            for (int j = 0; j < MHE_STAGES; j++) sum += mhe_stage_weights[i][j] * k[j * NX + a];
            residual[i * NX + a] = Z[i * NX + a] - h * sum;
            finite = finite && isfinite(residual[i * NX + a]);
        }
    return finite;
}

/* LU factors with row pivots of M = I - h A_ij J_j, in place; whether M is regular. */
static int mhe_stage_factor(real h, const real *J, real *M, int *pivot)
{
    for (int i = 0; i < MHE_STAGES; i++)
        for (int a = 0; a < NX; a++)
            for (int j = 0; j < MHE_STAGES; j++)
                for (int b = 0; b < NX; b++)
                    M[(i * NX + a) * MHE_UNKNOWNS + j * NX + b] =
                        (i == j && a == b) - h * mhe_stage_weights[i][j] * J[(j * NX + a) * NX + b];
    for (int c = 0; c < MHE_UNKNOWNS; c++) {
        int best = c;
        for (int r = c + 1; r < MHE_UNKNOWNS; r++)
            if (fabs(M[r * MHE_UNKNOWNS + c]) > fabs(M[best * MHE_UNKNOWNS + c])) best = r;
        pivot[c] = best;
        if (!(fabs(M[best * MHE_UNKNOWNS + c]) > 0) || !isfinite(M[best * MHE_UNKNOWNS + c]))
            return 0;
        if (best != c)
            for (int j = 0; j < MHE_UNKNOWNS; j++) {
                const real held = M[c * MHE_UNKNOWNS + j];
                M[c * MHE_UNKNOWNS + j] = M[best * MHE_UNKNOWNS + j];
                M[best * MHE_UNKNOWNS + j] = held;
            }
        for (int r = c + 1; r < MHE_UNKNOWNS; r++) {
            const real share = M[r * MHE_UNKNOWNS + c] /= M[c * MHE_UNKNOWNS + c];
            if (share != 0)
                for (int j = c + 1; j < MHE_UNKNOWNS; j++)
                    M[r * MHE_UNKNOWNS + j] -= share * M[c * MHE_UNKNOWNS + j];
        }
    }
    return 1;
}

/* The solution of M z = z of some columns, with the factors of M, in place. */
static void mhe_stage_solve(const real *M, const int *pivot, int columns, real *z)
{
    for (int c = 0; c < MHE_UNKNOWNS; c++)
        if (pivot[c] != c)
            for (int j = 0; j < columns; j++) {
                const real held = z[c * columns + j];
                z[c * columns + j] = z[pivot[c] * columns + j];
                z[pivot[c] * columns + j] = held;
            }
    for (int c = 0; c < MHE_UNKNOWNS; c++)
        for (int r = c + 1; r < MHE_UNKNOWNS; r++)
            for (int j = 0; j < columns; j++)
                z[r * columns + j] -= M[r * MHE_UNKNOWNS + c] * z[c * columns + j];
    for (int c = MHE_UNKNOWNS - 1; c >= 0; c--) {
        for (int j = 0; j < columns; j++) z[c * columns + j] /= M[c * MHE_UNKNOWNS + c];
        for (int r = 0; r < c; r++)
            for (int j = 0; j < columns; j++)
                z[r * columns + j] -= M[r * MHE_UNKNOWNS + c] * z[c * columns + j];
    }
}

/* The largest share of a correction in what rounding of states and flows amounts to. */
static real mhe_stage_length(const real *x, real h, const real *Z, const real *step, const real *J)
{
    real sizes[NX], length = 0;
    for (int a = 0; a < NX; a++) {
        real most = 0;
        for (int i = 0; i < MHE_STAGES; i++)
            most = (real)fmax(most, fabs(Z[i * NX + a] + step[i * NX + a]));
        sizes[a] = (real)fabs(x[a]) + most;
    }
    for (int a = 0; a < NX; a++) {
        real size = sizes[a];
        for (int b = 0; b < NX; b++) {
            real most = 0;
            for (int i = 0; i < MHE_STAGES; i++)
                most = (real)fmax(most, fabs(J[(i * NX + a) * NX + b]));
            size += h * most * sizes[b];
        }
        for (int i = 0; i < MHE_STAGES; i++) {
            const real moved = (real)fabs(step[i * NX + a]);
            if (!isfinite(moved)) return NAN;
            if (moved > 0) length = (real)fmax(length, moved / size);
        }
    }
    return length;
}

/* The stages Z of a step; whether the iteration has converged. */
static int mhe_solve_stages(const real *x, const real *u, real h, real *Z)
{
    real residual[MHE_UNKNOWNS], step[MHE_UNKNOWNS], trial[MHE_UNKNOWNS], last = INFINITY;
    real J[MHE_STAGES * NX * NX], M[MHE_UNKNOWNS * MHE_UNKNOWNS];
    int pivot[MHE_UNKNOWNS];
    for (int i = 0; i < MHE_UNKNOWNS; i++) Z[i] = 0;
    if (!mhe_stage_residual(x, u, h, Z, residual)) return 0;
    for (int iteration = 0; iteration < $iterations; iteration++) {
        mhe_stage_slopes(x, u, Z, J);
        if (!mhe_stage_factor(h, J, M, pivot)) return 0;
        for (int i = 0; i < MHE_UNKNOWNS; i++) step[i] = -residual[i];
        mhe_stage_solve(M, pivot, 1, step);
        const real length = mhe_stage_length(x, h, Z, step, J);
        if (!isfinite(length)) return 0;
        const int done = length <= (real)$rounding || (length <= (real)$small && length > last / 2);
        int inside = 0;
        for (int halving = 0; halving < $halvings && !inside; halving++) {
            for (int i = 0; i < MHE_UNKNOWNS; i++) trial[i] = Z[i] + step[i];
            inside = mhe_stage_residual(x, u, h, trial, residual) || done;
            for (int i = 0; i < MHE_UNKNOWNS && !inside; i++) step[i] /= 2;
        }
        if (!inside) return 0;
        for (int i = 0; i < MHE_UNKNOWNS; i++) Z[i] = trial[i];
        if (done) return 1;
        last = length;
    }
    return 0;
}

static void mhe_step_end(const real *x, const real *Z, real *next)
{
    for (int a = 0; a < NX; a++) {
        next[a] = x[a];
        for (int i = 0; i < MHE_STAGES; i++) next[a] += mhe_step_weights[i] * Z[i * NX + a];
    }
}

static void $value(const real *x, const real *u, real dt, real *next)
{
    real Z[MHE_UNKNOWNS];
    if (mhe_solve_stages(x, u, dt, Z)) {
        mhe_step_end(x, Z, next);
        return;
    }
    for (int a = 0; a < NX; a++) next[a] = NAN;
}

/* f and its Jacobian with respect to x, by rows. */
static void $slope(const real *x, const real *u, real dt, real *next, real *A)
{
    real Z[MHE_UNKNOWNS], J[MHE_STAGES * NX * NX], M[MHE_UNKNOWNS * MHE_UNKNOWNS];
    real dZ[MHE_UNKNOWNS * NX];
    int pivot[MHE_UNKNOWNS];
    int regular = mhe_solve_stages(x, u, dt, Z);
    if (regular) {
        mhe_stage_slopes(x, u, Z, J);
        regular = mhe_stage_factor(dt, J, M, pivot);
    }
    if (!regular) {
        for (int a = 0; a < NX; a++) next[a] = NAN;
        for (int i = 0; i < NX * NX; i++) A[i] = NAN;
        return;
    }
    mhe_step_end(x, Z, next);
    for (int i = 0; i < MHE_STAGES; i++)
        for (int a = 0; a < NX; a++)
            for (int b = 0; b < NX; b++) {
                real sum = 0;
                for (int j = 0; j < MHE_STAGES; j++)
                    sum += mhe_stage_weights[i][j] * J[(j * NX + a) * NX + b];
                dZ[(i * NX + a) * NX + b] = dt * sum;
            }
    mhe_stage_solve(M, pivot, NX, dZ);
    for (int a = 0; a < NX; a++)
        for (int b = 0; b < NX; b++) {
            real sum = a == b;
            for (int i = 0; i < MHE_STAGES; i++)
                sum += mhe_step_weights[i] * dZ[(i * NX + a) * NX + b];
            A[a * NX + b] = sum;
        }
}
