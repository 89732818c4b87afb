/* The likelihood of a record's innovations under an extended Kalman filter, and its adjoint.
 *
 * The filter is linearised at its predictions z: with the innovation e, its covariance
 * S = C P C' + R = L L', s = L^-1 e and the gain K = A P C' S^-1,
 *
 *     z+ = f(z) + A P C' L^-T psi(s),   P+ = (A - K C) P (A - K C)' + K R K' + Q,
 *     cost = sum rho(s) + log det L.
 *
 * An output that is missing has the innovation 0, a row of zeros in C, and the variance 1. */

/* A record, and how the filter reads it. */
typedef struct {
    const real *start, *prior, *disturbance, *noise; /* z(0), P(0), Q and R */
    const real *y, *u;                               /* by samples; behind u, the step's length */
    const unsigned char *there;                      /* which outputs are not missing */
    const real *low, *high, *periods;                /* bounds of z; periods of outputs, or 0 */
    real threshold, scale;                           /* of psi and rho, and what divides rho */
} mhe_record;

/* What the adjoint needs of a sample. */
typedef struct {
    real z[NX], P[NX * NX], A[SIZE(MHE_A_NONZEROS)], C[SIZE(MHE_C_NONZEROS)];
    real root[NY * NY], gain[NY * NX], white[NY], used[NY]; /* L, K by columns, s and psi(s) */
    unsigned char bounded[NX];
} mhe_kept;

/* P C' (n, p). */
static void mhe_seen_covariance(const mhe_kept *k, real *out)
{
    for (int i = 0; i < NX * NY; i++) out[i] = 0;
    for (int a = 0; a < MHE_C_NONZEROS; a++)
        for (int j = 0; j < NX; j++)
            out[j * NY + mhe_C_row[a]] += k->C[a] * k->P[mhe_C_column[a] * NX + j];
}

/* A - K C. */
static void mhe_closed_loop(const mhe_kept *k, real *out)
{
    for (int i = 0; i < NX * NX; i++) out[i] = 0;
    for (int a = 0; a < MHE_A_NONZEROS; a++) out[mhe_A_row[a] * NX + mhe_A_column[a]] = k->A[a];
    for (int a = 0; a < MHE_C_NONZEROS; a++)
        for (int j = 0; j < NX; j++)
            out[j * NX + mhe_C_column[a]] -= k->C[a] * k->gain[mhe_C_row[a] * NX + j];
}

/* R with the variance 1 for what is missing. */
static void mhe_noise_of(const mhe_record *r, const unsigned char *there, real *out)
{
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NY; j++)
            out[i * NY + j] = there[i] && there[j] ? r->noise[i * NY + j] : (real)(i == j);
}

/* out = A' B for A (k, m) and B (k, n), with the transposed matrix in `turned`: as a product of
 * rows it takes a sixth of the time of one of columns. */
static void mhe_turned_product(int k, int m, int n, const real *A, const real *B, real *turned,
                               real *out)
{
    for (int l = 0; l < k; l++)
        for (int i = 0; i < m; i++) turned[i * k + l] = A[l * m + i];
    mhe_multiply(m, k, n, turned, B, out);
}

/* One sample from k->z and k->P, which the rest of k is of; its cost. */
static real mhe_filter_step(const mhe_record *r, int t, mhe_kept *k, real *z, real *P)
{
    const unsigned char *there = r->there + (size_t)t * NY;
    const real *y = r->y + (size_t)t * NY;
    real output[NY], seen[NX * NY], cross[NX * NY] = {0}, noise[NY * NY], cost = 0;
    real *L = k->root, *gain = k->gain;
    mhe_call_step(k->z, r->u + (size_t)t * (NU + 1), z, k->A);
    mhe_call_output(k->z, r->u + (size_t)t * (NU + 1), output, k->C);
    for (int a = 0; a < MHE_C_NONZEROS; a++)
        if (!there[mhe_C_row[a]]) k->C[a] = 0;
    mhe_seen_covariance(k, seen);
    for (int a = 0; a < MHE_A_NONZEROS; a++)
        for (int i = 0; i < NY; i++)
            cross[mhe_A_row[a] * NY + i] += k->A[a] * seen[mhe_A_column[a] * NY + i];
    mhe_noise_of(r, there, noise);
    memcpy(L, noise, sizeof noise);
    for (int a = 0; a < MHE_C_NONZEROS; a++)
        for (int i = 0; i < NY; i++)
            L[mhe_C_row[a] * NY + i] += k->C[a] * seen[mhe_C_column[a] * NY + i];
    for (int i = 0; i < NY; i++) {
        real *row = L + i * NY, *into = gain + i * NX;
        for (int j = 0; j <= i; j++) {
            const real rest = row[j] - mhe_dot(j, row, L + j * NY);
            row[j] = i == j ? sqrt(rest) : rest / L[j * NY + j];
        }
        real e = there[i] ? y[i] - output[i] : 0;
        if (there[i] && r->periods[i] > 0)
            e -= r->periods[i] * floor(e / r->periods[i] + (real)0.5);
        const real s = k->white[i] = (e - mhe_dot(i, row, k->white)) / row[i], size = fabs(s);
        k->used[i] = size <= r->threshold ? s : s > 0 ? r->threshold : -r->threshold;
        if (isnan(s)) k->used[i] = s;
        cost += log(row[i]);
        cost += size > r->threshold ? r->threshold * r->threshold *
                                          ((real)0.5 + log(size / r->threshold)) / r->scale
                                    : (real)0.5 * s * s / r->scale;
        /* Here L^-1 C P A', by rows. */
        for (int j = 0; j < NX; j++) into[j] = cross[j * NY + i];
        for (int l = 0; l < i; l++)
            for (int j = 0; j < NX; j++) into[j] -= row[l] * gain[l * NX + j];
        for (int j = 0; j < NX; j++) into[j] /= row[i];
        for (int j = 0; j < NX; j++) z[j] += into[j] * k->used[i];
    }
    for (int i = NY - 1; i >= 0; i--) {
        real *into = gain + i * NX;
        for (int l = i + 1; l < NY; l++)
            for (int j = 0; j < NX; j++) into[j] -= L[l * NY + i] * gain[l * NX + j];
        for (int j = 0; j < NX; j++) into[j] /= L[i * NY + i];
    }
    for (int j = 0; j < NX; j++) {
        k->bounded[j] = z[j] < r->low[j] || z[j] > r->high[j];
        z[j] = z[j] < r->low[j] ? r->low[j] : z[j] > r->high[j] ? r->high[j] : z[j];
    }
    real closed[NX * NX], turned[NX * NX], moved[NX * NX], weighed[NY * NX], rows[NX * NY];
    mhe_closed_loop(k, closed);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) turned[j * NX + i] = closed[i * NX + j];
    mhe_multiply(NX, NX, NX, closed, k->P, moved);
    mhe_multiply(NX, NX, NX, moved, turned, P);
    mhe_multiply(NY, NY, NX, noise, gain, weighed);
    mhe_turned_product(NY, NX, NX, gain, weighed, rows, moved);
    for (int i = 0; i < NX * NX; i++) P[i] += moved[i] + r->disturbance[i];
    mhe_symmetrise(NX, P);
    return cost;
}

/* Filter samples first to last - 1 from z and P, which become those behind them. Their costs, and
 * what the adjoint needs of them: in one place for all where `one` is not 0. */
static void mhe_filter_samples(const mhe_record *r, int first, int last, int one, real *z, real *P,
                               mhe_kept *kept, real *costs)
{
    for (int t = first; t < last; t++) {
        mhe_kept *k = one ? kept : kept + (t - first);
        memcpy(k->z, z, sizeof k->z);
        memcpy(k->P, P, sizeof k->P);
        const real cost = mhe_filter_step(r, t, k, z, P);
        if (costs) costs[t] = cost;
    }
}

/* L^-1 a and L^-T a, in place. */
static void mhe_solve_lower(const real *L, real *a)
{
    for (int i = 0; i < NY; i++) a[i] = (a[i] - mhe_dot(i, L + i * NY, a)) / L[i * NY + i];
}

static void mhe_solve_upper(const real *L, real *a)
{
    for (int i = NY - 1; i >= 0; i--) {
        a[i] /= L[i * NY + i];
        for (int j = 0; j < i; j++) a[j] -= L[i * NY + j] * a[i];
    }
}

/* The derivative by S, from the one by its factor L, of which the lower half counts. */
static void mhe_factor_slope(const real *L, const real *by_root, real *out)
{
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NY; j++) {
            real sum = 0;
            for (int l = i; l < NY; l++) sum += L[l * NY + i] * by_root[l * NY + j];
            out[j * NY + i] = j > i ? 0 : i == j ? (real)0.5 * sum : sum; /* transposed */
        }
    for (int side = 0; side < 2; side++) { /* L^-T times it times L^-1 */
        for (int i = 0; i < NY; i++) mhe_solve_upper(L, out + i * NY);
        for (int i = 0; i < NY; i++)
            for (int j = 0; j < i; j++) {
                const real other = out[i * NY + j];
                out[i * NY + j] = out[j * NY + i];
                out[j * NY + i] = other;
            }
    }
    mhe_symmetrise(NY, out);
}

/* From derivatives by z and P behind a sample to those by z and P before it. The cost counts
 * `weight` times; derivatives by Q, R and u are added. By K they are 0: it minimises P+. */
static void mhe_filter_back(const mhe_record *r, int t, const mhe_kept *k, real weight, real *by_z,
                            real *by_P, real *by_Q, real *by_R, real *by_u)
{
    const unsigned char *there = r->there + (size_t)t * NY;
    /* z, then derivatives by f, A, h and C, as `mhe_call_back` reads them. */
    real given[NX + NX + MHE_A_NONZEROS + NY + MHE_C_NONZEROS];
    real *by_f = given + NX, *by_A = by_f + NX, *by_h = by_A + MHE_A_NONZEROS, *by_C = by_h + NY;
    const real *L = k->root;
    real closed[NX * NX], turned[NX * NX], moved[NX * NX], back[NX * NX];
    real seen[NX * NY], held[NY * NX];
    real gained[NY * NY];
    memcpy(given, k->z, sizeof k->z);
    for (int j = 0; j < NX; j++) by_f[j] = k->bounded[j] ? 0 : by_z[j];
    for (int i = 0; i < NX * NX; i++) by_Q[i] += by_P[i];
    mhe_closed_loop(k, closed);
    mhe_seen_covariance(k, seen);
    mhe_multiply(NX, NX, NX, by_P, closed, moved);
    mhe_multiply(NY, NX, NX, k->gain, by_P, held);
    mhe_multiply_transposed(NY, NX, NY, held, k->gain, gained);
    mhe_multiply(NY, NX, NX, k->gain, moved, held);
    mhe_turned_product(NX, NX, NX, closed, moved, turned, back);

    real ahead[NX] = {0}, seen_by[NX] = {0}, solved[NY], ahead_P[NX], seen_P[NX];
    for (int a = 0; a < MHE_A_NONZEROS; a++) ahead[mhe_A_column[a]] += k->A[a] * by_f[mhe_A_row[a]];
    memcpy(solved, k->used, sizeof solved);
    mhe_solve_upper(L, solved);
    for (int a = 0; a < MHE_C_NONZEROS; a++)
        seen_by[mhe_C_column[a]] += k->C[a] * solved[mhe_C_row[a]];
    mhe_times(NX, k->P, ahead, ahead_P);
    mhe_times(NX, k->P, seen_by, seen_P);
    real by_used[NY] = {0}, by_e[NY], by_root[NY * NY], by_S[NY * NY];
    for (int a = 0; a < MHE_C_NONZEROS; a++)
        by_used[mhe_C_row[a]] += k->C[a] * ahead_P[mhe_C_column[a]];
    mhe_solve_lower(L, by_used);
    for (int i = 0; i < NY; i++) {
        const real s = k->white[i], size = fabs(s);
        by_e[i] = size <= r->threshold
                      ? by_used[i] + weight * s / r->scale
                      : weight * r->threshold * r->threshold / (s * r->scale);
    }
    mhe_solve_upper(L, by_e);
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NY; j++)
            by_root[i * NY + j] = (i == j ? weight / L[i * NY + i] : 0) -
                                  solved[i] * by_used[j] - by_e[i] * k->white[j];
    mhe_factor_slope(L, by_root, by_S);

    for (int a = 0; a < MHE_A_NONZEROS; a++) {
        const int row = mhe_A_row[a], column = mhe_A_column[a];
        by_A[a] = by_f[row] * seen_P[column] +
                  2 * mhe_dot(NX, moved + row * NX, k->P + column * NX);
    }
    for (int a = 0; a < MHE_C_NONZEROS; a++) {
        const int row = mhe_C_row[a], column = mhe_C_column[a];
        by_C[a] = solved[row] * ahead_P[column] +
                  2 * (mhe_dot(NY, by_S + row * NY, seen + column * NY) -
                       mhe_dot(NX, held + row * NX, k->P + column * NX));
        if (!there[row]) by_C[a] = 0;
        for (int b = 0; b < MHE_C_NONZEROS; b++)
            back[column * NX + mhe_C_column[b]] +=
                k->C[a] * k->C[b] * by_S[row * NY + mhe_C_row[b]];
    }
    for (int i = 0; i < NY; i++) {
        by_h[i] = there[i] ? -by_e[i] : 0;
        for (int j = 0; j < NY; j++)
            if (there[i] && there[j])
                by_R[i * NY + j] += by_S[i * NY + j] + gained[i * NY + j];
    }
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++)
            by_P[i * NX + j] = back[i * NX + j] +
                               (real)0.5 * (ahead[i] * seen_by[j] + seen_by[i] * ahead[j]);
    mhe_symmetrise(NX, by_P);
    real by_input[NU + 1];
    mhe_call_back(given, r->u + (size_t)t * (NU + 1), by_z, by_input);
    for (int i = 0; i < NU; i++) by_u[i] += by_input[i];
}

/* Bytes that the adjoint keeps of a sample. */
size_t mhe_kept_size(void) { return sizeof(mhe_kept); }

/* Costs of all samples. Where points is not 0, it gets z and P at the beginning of each stretch of
 * `length` samples, and kept what the adjoint needs of the last stretch. */
void mhe_filter_record(const mhe_record *r, int samples, int length, real *points,
                               mhe_kept *kept, real *costs)
{
    real z[NX], P[NX * NX];
    memcpy(z, r->start, sizeof z);
    memcpy(P, r->prior, sizeof P);
    for (int t = 0; t < samples; t += length) {
        if (points) {
            memcpy(points, z, sizeof z);
            memcpy(points + NX, P, sizeof P);
            points += NX + NX * NX;
        }
        const int last = t + length < samples ? t + length : samples;
        mhe_filter_samples(r, t, last, !points, z, P, kept, costs);
    }
}

/* Behind `mhe_filter_record`: the derivatives of the sum of costs with these weights by P(0), and,
 * added to what there is, by Q, R and u in all samples. */
void mhe_filter_record_back(const mhe_record *r, int samples, int length,
                                    const real *points, mhe_kept *kept, const real *weights,
                                    real *by_P, real *by_Q, real *by_R, real *by_u)
{
    real by_z[NX] = {0};
    const int last = (samples - 1) / length;
    for (int i = 0; i < NX * NX; i++) by_P[i] = 0;
    for (int part = last; part >= 0; part--) {
        const int first = part * length;
        const int end = first + length < samples ? first + length : samples;
        if (part < last) {
            real z[NX], P[NX * NX];
            const real *point = points + (size_t)part * (NX + NX * NX);
            memcpy(z, point, sizeof z);
            memcpy(P, point + NX, sizeof P);
            mhe_filter_samples(r, first, end, 0, z, P, kept, 0);
        }
        for (int t = end - 1; t >= first; t--)
            mhe_filter_back(r, t, kept + (t - first), weights[t], by_z, by_P, by_Q, by_R, by_u);
    }
}
