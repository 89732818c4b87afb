/* The observer: its correction, its own measurement update, and its covariance. */

#if MHE_COVARIANCE
/* The outputs of a stage that are there, with their fitting errors and noise covariance. */
typedef struct {
    int count, at[NY];
    real v[NY], noise[NY * NY];
} mhe_seen;

/* The covariance of a sample's own weight. One that only rounding makes other than the usual one
 * is the usual one. NaN where the weight has no inverse. */
static void mhe_covariance_of(int n, const real *weight, const real *usual, real *scratch,
                              real *out)
{
    int near = 1;
    for (int i = 0; i < n * n; i++) scratch[i] = weight[i];
    if (!mhe_invert(n, scratch, out)) {
        for (int i = 0; i < n * n; i++) out[i] = NAN;
        return;
    }
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            const real size = sqrt(usual[i * n + i]) * sqrt(usual[j * n + j]);
            const real change = fabs(out[i * n + j] - usual[i * n + j]);
            if (!(change <= MHE_SAME_COVARIANCE * size)) near = 0;
        }
    if (near) memcpy(out, usual, sizeof(real) * (size_t)(n * n));
}

static void mhe_see(const mhe_settings *s, const mhe_stage *stage, mhe_seen *seen)
{
    const real *noise = s->covariances.noise;
    real own[NY * NY], scratch[NY * NY];
    if (stage->has_own_noise) {
        mhe_covariance_of(NY, stage->own_noise_weight, noise, scratch, own);
        noise = own;
    }
    seen->count = 0;
    for (int i = 0; i < NY; i++)
        if (stage->is_observed[i]) seen->at[seen->count++] = i;
    for (int i = 0; i < seen->count; i++) {
        seen->v[i] = stage->v[seen->at[i]];
        for (int j = 0; j < seen->count; j++)
            seen->noise[i * seen->count + j] = noise[seen->at[i] * NY + seen->at[j]];
    }
}

/* Add K R K' to a covariance; the rows of `gain` are the columns of K. */
static void mhe_add_noise(const mhe_seen *seen, const real *gain, real *P)
{
    real weighted[NY * NX];
    mhe_multiply(seen->count, seen->count, NX, seen->noise, gain, weighted);
    mhe_add_product(seen->count, NX, NX, gain, weighted, P);
}

/* Q: the usual one, or a sample's own in `own`. */
static const real *mhe_disturbance_of(const mhe_settings *s, const mhe_stage *stage, real *own)
{
    real scratch[NX * NX];
    if (stage->has_own_disturbance) {
        mhe_covariance_of(NX, stage->own_disturbance_weight, s->covariances.disturbance, scratch,
                          own);
#if MHE_QUIET
        mhe_multiply(NX, NX, NX, s->candidate_keep, own, scratch);
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NX; j++)
                own[i * NX + j] = mhe_dot(NX, scratch + i * NX, s->candidate_keep + j * NX);
#endif
        return own;
    }
    return s->covariances.disturbance;
}

/* Add Q to a covariance. */
static void mhe_add_disturbance(const mhe_settings *s, const mhe_stage *stage, real *P)
{
    real own[NX * NX];
    const real *Q = mhe_disturbance_of(s, stage, own);
    for (int i = 0; i < NX * NX; i++) P[i] += Q[i];
    mhe_symmetrise(NX, P);
}

#if MHE_OBSERVER != MHE_GAIN
/* out = K v */
static void mhe_gained(const mhe_seen *seen, const real *gain, real *out)
{
    for (int j = 0; j < NX; j++) out[j] = 0;
    for (int i = 0; i < seen->count; i++)
        for (int j = 0; j < NX; j++) out[j] += gain[i * NX + j] * seen->v[i];
}
#endif
#endif

#if MHE_COVARIANCE && MHE_OBSERVER != MHE_UNSCENTED
/* Joseph's form of (A - K C) P (A - K C)' + K R K', with the outputs' rows of C; A is the identity
 * where there is none. */
static void mhe_propagate(const real *P, const mhe_seen *seen, const real *A, const real *C,
                          const real *gain, real *following)
{
    real closed[NX * NX], product[NX * NX];
    for (int j = 0; j < NX; j++)
        for (int l = 0; l < NX; l++) {
            real sum = A ? A[j * NX + l] : j == l;
            for (int i = 0; i < seen->count; i++) sum -= gain[i * NX + j] * C[i * NX + l];
            closed[j * NX + l] = sum;
        }
    mhe_multiply(NX, NX, NX, closed, P, product);
    mhe_multiply_transposed(NX, NX, NX, product, closed, following);
    mhe_add_noise(seen, gain, following);
}

/* The rows of C of the outputs that are there. */
static void mhe_rows_of(const mhe_seen *seen, const real *C, real *rows)
{
    for (int i = 0; i < seen->count; i++)
        memcpy(rows + i * NX, C + seen->at[i] * NX, sizeof(real) * NX);
}
#endif

#if MHE_ROOTS
/* Whether S hides what the noise has in it: of several outputs, the gain is then lost. */
static int mhe_is_hidden(const mhe_settings *s, const mhe_stage *stage, const mhe_seen *seen,
                         const real *S)
{
    const int q = seen->count;
    real share = s->covariances.noise_share;
    if (stage->has_own_noise) {
        real scratch[NY * NY], inverse[NY * NY], most = 0;
        memcpy(scratch, seen->noise, sizeof(real) * (size_t)(q * q));
        if (!mhe_invert(q, scratch, inverse)) return 0;
        for (int i = 0; i < q; i++)
            most = mhe_max(inverse[i * q + i] * seen->noise[i * q + i], most);
        share = 1 / most;
    }
    for (int i = 0; i < q; i++)
        if (MHE_VAGUE * S[i * q + i] > share * seen->noise[i * q + i]) return 1;
    return 0;
}

#define DEVIATIONS (MHE_OBSERVER == MHE_UNSCENTED ? 2 * NX : NX)
#define LINES (NY + DEVIATIONS + NX)
#define WIDE (NY + NX)

/* The order of rows by their longest entry, in the lengths of the columns. */
static void mhe_order_rows(int count, int width, const real *rows, int *order)
{
    real lengths[WIDE] = {0}, longest[LINES];
    for (int j = 0; j < width; j++) {
        for (int i = 0; i < count; i++) lengths[j] = mhe_max(fabs(rows[i * WIDE + j]), lengths[j]);
    }
    for (int i = 0; i < count; i++) {
        int at = i;
        longest[i] = 0;
        for (int j = 0; j < width; j++)
            if (lengths[j] > 0)
                longest[i] = mhe_max(fabs(rows[i * WIDE + j]) / lengths[j], longest[i]);
        for (; at > 0 && longest[order[at - 1]] < longest[i]; at--) order[at] = order[at - 1];
        order[at] = i;
    }
}

/* Turn rows, no fewer than columns, to an upper triangle by Householder's reflections. */
static void mhe_triangle(int count, int width, real *rows)
{
    for (int j = 0; j < width; j++) {
        real *corner = rows + j * WIDE + j, square = 0;
        for (int i = j; i < count; i++) square += rows[i * WIDE + j] * rows[i * WIDE + j];
        if (square == 0) continue;
        const real length = sqrt(square), end = *corner > 0 ? -length : length;
        const real scale = 1 / (length * (length + fabs(*corner)));
        *corner -= end;
        for (int c = j + 1; c < width; c++) {
            real sum = 0;
            for (int i = j; i < count; i++) sum += rows[i * WIDE + j] * rows[i * WIDE + c];
            sum *= scale;
            for (int i = j; i < count; i++) rows[i * WIDE + c] -= sum * rows[i * WIDE + j];
        }
        *corner = end;
    }
}

/* An upper triangle R with R'R the square of rows, no fewer than columns; the longest rows come first, so
 * that rounding in a row is small beside this row. */
static void mhe_ordered_triangle(int count, int width, const real *given, real *rows)
{
    int order[LINES];
    mhe_order_rows(count, width, given, order);
    for (int i = 0; i < count; i++)
        memcpy(rows + i * WIDE, given + order[i] * WIDE, sizeof(real) * (size_t)width);
    mhe_triangle(count, width, rows);
}

/* The columns of the gain of least mean square error as rows, and a root of the covariance that it
 * leaves, by one factorisation of [root of R, 0; deviations of outputs and of states; 0, root of Q];
 * no Q in a measurement update. */
static void mhe_update_root(const mhe_seen *seen, const real *outputs, const real *states,
                            const real *Q, real *gain, real *root)
{
    const int q = seen->count, width = q + NX, count = q + DEVIATIONS + (Q ? NX : 0);
    real given[LINES * WIDE] = {0}, rows[LINES * WIDE], factor[NX * NX], noise[NY * NY];
    mhe_root(q, seen->noise, noise);
    for (int i = 0; i < q; i++)
        memcpy(given + i * WIDE, noise + i * q, sizeof(real) * (size_t)q);
    for (int i = 0; i < DEVIATIONS; i++) {
        real *to = given + (q + i) * WIDE;
        memcpy(to, outputs + i * q, sizeof(real) * (size_t)q);
        memcpy(to + q, states + i * NX, sizeof(real) * NX);
    }
    if (Q) {
        mhe_root(NX, Q, factor);
        for (int i = 0; i < NX; i++)
            memcpy(given + (q + DEVIATIONS + i) * WIDE + q, factor + i * NX, sizeof(real) * NX);
    }
    mhe_ordered_triangle(count, width, given, rows);
    for (int i = q - 1; i >= 0; i--)
        for (int j = 0; j < NX; j++) {
            real sum = rows[i * WIDE + q + j];
            for (int l = i + 1; l < q; l++) sum -= rows[i * WIDE + l] * gain[l * NX + j];
            gain[i * NX + j] = sum / rows[i * WIDE + i];
        }
    for (int i = 0; i < NX; i++) {
        const real *row = rows + (q + i) * WIDE + q, sign = row[i] < 0 ? -1 : 1;
        for (int j = 0; j < NX; j++) root[i * NX + j] = j < i ? 0 : sign * row[j];
    }
}

#if MHE_PRIOR_ROOTS
/* out = an upper triangle R with R'R = A'A + B'B. */
static void mhe_join_roots(const real *A, const real *B, real *out)
{
    real given[LINES * WIDE], rows[LINES * WIDE];
    for (int i = 0; i < NX; i++) {
        memcpy(given + i * WIDE, A + i * NX, sizeof(real) * NX);
        memcpy(given + (NX + i) * WIDE, B + i * NX, sizeof(real) * NX);
    }
    mhe_ordered_triangle(2 * NX, NX, given, rows);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) out[i * NX + j] = j < i ? 0 : rows[i * WIDE + j];
}
#endif

/* The covariance of a root. */
static void mhe_square(const real *root, real *P)
{
    for (int i = 0; i < NX * NX; i++) P[i] = 0;
    mhe_add_product(NX, NX, NX, root, root, P);
}
#endif

#if MHE_OBSERVER == MHE_EXTENDED
/* Deviations along a root, as rows: of the outputs with these rows of C, and of the states ahead;
 * of the states themselves where there is no A. */
static void mhe_deviations(const real *root, const mhe_seen *seen, const real *A, const real *C,
                           real *outputs, real *states)
{
    mhe_multiply_transposed(NX, NX, seen->count, root, C, outputs);
    if (A)
        mhe_multiply_transposed(NX, NX, NX, root, A, states);
    else
        memcpy(states, root, sizeof(real) * NX * NX);
}

/* The columns of K = A P C' (C P C' + R)^-1 as rows, or of the measurement update's P C' (...)^-1
 * where there is no A; NaN where there is no gain. C: rows of the outputs that are there. Whether S
 * has the digits for it. */
static int mhe_kalman_gain(const mhe_settings *s, const mhe_stage *stage, const real *P,
                           const mhe_seen *seen, const real *A, const real *C, real *gain)
{
    real cross[NY * NX] = {0}, innovation[NY * NY] = {0}; /* compilers cannot tell */
    mhe_multiply(seen->count, NX, NX, C, P, cross);
    mhe_multiply_transposed(seen->count, NX, seen->count, cross, C, innovation);
    for (int i = 0; i < seen->count * seen->count; i++) innovation[i] += seen->noise[i];
    if (mhe_is_hidden(s, stage, seen, innovation)) return 0;
    if (A)
        mhe_multiply_transposed(seen->count, NX, NX, cross, A, gain);
    else
        memcpy(gain, cross, sizeof(real) * (size_t)(seen->count * NX));
    if (mhe_decompose(seen->count, innovation))
        mhe_solve_for(seen->count, innovation, NX, gain);
    else
        for (int i = 0; i < seen->count * NX; i++) gain[i] = NAN;
    return 1;
}
#endif

#if MHE_OBSERVER == MHE_UNSCENTED
/* Sigma points: deviations from z, in pairs along the columns of a root of P, and for each pair the
 * root of its weight, which goes into deviations: sums become products. */
#define POINTS (2 * NX)

/* One is drawn back into the bounds of X, but not closer to z than this share. */
#define CLOSEST ((real)1e-3)

typedef struct {
    real moves[POINTS * NX], roots[NX];
} mhe_sigma;

#if MHE_X_SET
/* Draw a pair of sigma points z + d and z - d nearer to z, to stay in the bounds of X; by how much.
 * Where z is on a bound both are inside of it: a sum of products ignores their sign. */
static real mhe_draw_inside(const mhe_x_set *set, const real *z, real *one, real *other)
{
    real allowed[2], signs[2] = {1, -1};
    for (int side = 0; side < 2; side++) {
        allowed[side] = INFINITY;
        for (int j = 0; j < NX; j++) {
            const real move = signs[side] * one[j];
            const real room = move > 0 ? set->upper[j] - z[j] : z[j] - set->lower[j];
            if (move != 0 && room / fabs(move) < allowed[side]) allowed[side] = room / fabs(move);
        }
    }
    const int inwards = allowed[0] >= allowed[1] ? 1 : -1;
    const real farther = inwards > 0 ? allowed[0] : allowed[1];
    real share = inwards > 0 ? allowed[1] : allowed[0];
    if (share < CLOSEST && farther >= CLOSEST) {
        share = farther;
        signs[0] = signs[1] = (real)inwards;
    }
    share = share < CLOSEST ? CLOSEST : share < 1 ? share : 1;
    for (int j = 0; j < NX; j++) {
        const real move = one[j] * share;
        one[j] = signs[0] * move;
        other[j] = signs[1] * move;
    }
    return share;
}
#endif

static void mhe_sigma_points(const mhe_settings *s, const mhe_stage *stage, const real *P,
                             const real *root, mhe_sigma *sigma)
{
    real *moves = sigma->moves;
    if (root)
        memcpy(moves, root, sizeof(real) * NX * NX);
    else
        mhe_root(NX, P, moves);
    for (int i = 0; i < NX * NX; i++) {
        moves[i] *= s->covariances.spread;
        moves[NX * NX + i] = -moves[i];
    }
    for (int k = 0; k < NX; k++) {
        real share = 1;
#if MHE_X_SET
        share = mhe_draw_inside(mhe_x_set_at(s, stage), stage->z, moves + k * NX,
                                moves + (NX + k) * NX);
#else
        (void)stage;
#endif
        sigma->roots[k] = 1 / (sqrt((real)2) * s->covariances.spread * share);
    }
}

/* Deviations of the outputs that are there, at each sigma point. */
static void mhe_sigma_outputs(const mhe_settings *s, const mhe_stage *stage,
                              const mhe_seen *seen, const mhe_sigma *sigma, real *rows)
{
    real at[NX], middle[NY], output[NY], change[NY];
    mhe_h(stage->z, stage->u, middle);
    for (int k = 0; k < POINTS; k++) {
        for (int j = 0; j < NX; j++) at[j] = stage->z[j] + sigma->moves[k * NX + j];
        mhe_h(at, stage->u, output);
        for (int j = 0; j < NY; j++) change[j] = output[j] - middle[j];
        mhe_wrap_output(s, output, change);
        for (int i = 0; i < seen->count; i++)
            rows[k * seen->count + i] = change[seen->at[i]] * sigma->roots[k % NX];
    }
}

/* The columns of the gain of least mean square error as rows, from deviations of the outputs and of
 * what is estimated; what it leaves of the latter takes their place. Whether S has the digits for it:
 * else nothing has changed. */
static int mhe_sigma_gain(const mhe_settings *s, const mhe_stage *stage, const mhe_seen *seen,
                          const real *rows, real *ahead, real *gain)
{
    real innovation[NY * NY];
    memcpy(innovation, seen->noise, sizeof(real) * (size_t)(seen->count * seen->count));
    mhe_add_product(POINTS, seen->count, seen->count, rows, rows, innovation);
    if (stage->is_vague || mhe_is_hidden(s, stage, seen, innovation)) return 0;
    for (int i = 0; i < seen->count * NX; i++) gain[i] = 0;
    mhe_add_product(POINTS, seen->count, NX, rows, ahead, gain);
    if (mhe_decompose(seen->count, innovation))
        mhe_solve_for(seen->count, innovation, NX, gain);
    else
        for (int i = 0; i < seen->count * NX; i++) gain[i] = NAN;
    for (int k = 0; k < POINTS; k++)
        for (int i = 0; i < seen->count; i++)
            for (int j = 0; j < NX; j++)
                ahead[k * NX + j] -= rows[k * seen->count + i] * gain[i * NX + j];
    return 1;
}
#endif

#if MHE_INNOVATION
/* P C' as rows of C P, and C P C', of the outputs that are there; from a root of P if there is one. */
static void mhe_predict_outputs(const mhe_settings *s, const mhe_stage *stage,
                                const mhe_seen *seen, const real *P, const real *root,
                                real *cross, real *spread)
{
#if MHE_OBSERVER == MHE_EXTENDED
    real rows[NY * NX];
    mhe_rows_of(seen, stage->terms.h_jacobian, rows);
    if (root) {
        real outputs[NX * NY];
        mhe_multiply_transposed(NX, NX, seen->count, root, rows, outputs);
        for (int i = 0; i < seen->count * NX; i++) cross[i] = 0;
        for (int i = 0; i < seen->count * seen->count; i++) spread[i] = 0;
        mhe_add_product(NX, seen->count, NX, outputs, root, cross);
        mhe_add_product(NX, seen->count, seen->count, outputs, outputs, spread);
        return;
    }
    mhe_multiply(seen->count, NX, NX, rows, P, cross);
    mhe_multiply_transposed(seen->count, NX, seen->count, cross, rows, spread);
    (void)s;
#else
    mhe_sigma sigma;
    real rows[POINTS * NY];
    mhe_sigma_points(s, stage, P, root, &sigma);
    mhe_sigma_outputs(s, stage, seen, &sigma, rows);
    for (int i = 0; i < POINTS * NX; i++) sigma.moves[i] *= sigma.roots[i / NX % NX];
    for (int i = 0; i < seen->count * NX; i++) cross[i] = 0;
    for (int i = 0; i < seen->count * seen->count; i++) spread[i] = 0;
    mhe_add_product(POINTS, seen->count, NX, rows, sigma.moves, cross);
    mhe_add_product(POINTS, seen->count, seen->count, rows, rows, spread);
#endif
}

/* The rows [U_S, U_S K'] in `rows`, with the innovation's covariance U_S' U_S and the gain K of some outputs:
 * by roots of P and of the noise, as S itself may have no digit of the noise. */
static void mhe_factor_innovation(const mhe_settings *s, const mhe_stage *stage,
                                  const mhe_seen *seen, const real *P, const real *root,
                                  int count, const int *at, real *rows)
{
    real given[LINES * WIDE] = {0}, noise[NY * NY], factor[NY * NY], outputs[DEVIATIONS * NY];
    const real *states;
#if MHE_OBSERVER == MHE_EXTENDED
    real own[NX * NX], C[NY * NX];
    mhe_rows_of(seen, stage->terms.h_jacobian, C);
    if (!root) mhe_root(NX, P, own);
    states = root ? root : own;
    mhe_multiply_transposed(NX, NX, seen->count, states, C, outputs);
    (void)s;
#else
    mhe_sigma sigma;
    mhe_sigma_points(s, stage, P, root, &sigma);
    mhe_sigma_outputs(s, stage, seen, &sigma, outputs);
    for (int i = 0; i < POINTS * NX; i++) sigma.moves[i] *= sigma.roots[i / NX % NX];
    states = sigma.moves;
#endif
    for (int i = 0; i < count; i++)
        for (int j = 0; j < count; j++)
            noise[i * count + j] = seen->noise[at[i] * seen->count + at[j]];
    mhe_root(count, noise, factor);
    for (int i = 0; i < count; i++)
        memcpy(given + i * WIDE, factor + i * count, sizeof(real) * (size_t)count);
    for (int i = 0; i < DEVIATIONS; i++) {
        real *to = given + (count + i) * WIDE;
        for (int j = 0; j < count; j++) to[j] = outputs[i * seen->count + at[j]];
        memcpy(to + count, states + i * NX, sizeof(real) * NX);
    }
    mhe_ordered_triangle(count + DEVIATIONS, count + NX, given, rows);
}

/* Whether S = spread + R hides what the noise has in it. */
static int mhe_hides_noise(const mhe_settings *s, const mhe_stage *stage, const mhe_seen *seen,
                           const real *spread)
{
    real S[NY * NY];
    for (int i = 0; i < seen->count * seen->count; i++) S[i] = spread[i] + seen->noise[i];
    return mhe_is_hidden(s, stage, seen, S);
}

/* Sensors by their outputs' places among those that are there, and how they passed. */
typedef struct {
    int size[MHE_SENSORS], at[MHE_SENSORS][NY];
    int passes[MHE_SENSORS], due[MHE_SENSORS];
    int known_count, known[NY]; /* places of the sensors that passed */
    real growth[NX];            /* of the variances of P */
} mhe_sensors;

/* The squared norm of a part of v in its covariance, given others; infinite if singular. `spread`
 * belongs to P, and that to its root if there is one. */
static real mhe_distance(const mhe_settings *s, const mhe_stage *stage, const mhe_seen *seen,
                         const real *P, const real *root, const real *spread, int known_count,
                         const int *known, int count, const int *part)
{
    const int size = known_count + count;
    real S[NY * NY], white[NY] = {0}, sum = 0; /* compilers cannot tell */
    int at[NY];
    for (int i = 0; i < size; i++) at[i] = i < known_count ? known[i] : part[i - known_count];
    for (int i = 0; i < size; i++) {
        white[i] = seen->v[at[i]];
        for (int j = 0; j < size; j++) {
            const int place = at[i] * seen->count + at[j];
            S[i * size + j] = spread[place] + seen->noise[place];
        }
    }
    if (size > 1 && mhe_hides_noise(s, stage, seen, spread)) {
        real rows[LINES * WIDE];
        mhe_factor_innovation(s, stage, seen, P, root, size, at, rows);
        for (int i = 0; i < size; i++) {
            for (int j = 0; j < i; j++) white[i] -= rows[j * WIDE + i] * white[j];
            white[i] /= rows[i * WIDE + i];
            if (i >= known_count) sum += white[i] * white[i];
        }
        return sum;
    }
    if (!mhe_decompose(size, S)) return INFINITY;
    for (int i = 0; i < size; i++) {
        const real *row = S + i * size;
        for (int j = i + 1; j < size; j++) white[j] -= row[j] / row[i] * white[i];
        if (i >= known_count) sum += white[i] * white[i] / row[i];
    }
    return sum;
}

/* By which share a sensor would reduce each variance, over the largest share. */
static void mhe_find_shares(const mhe_settings *s, const mhe_stage *stage, const mhe_seen *seen,
                            int count, const int *at, const real *P, const real *root,
                            const real *cross, const real *spread, real *shares)
{
    real S[NY * NY], rows[NY * NX], solved[NY * NX], most = 0;
    for (int i = 0; i < count; i++) {
        for (int j = 0; j < count; j++) {
            const int place = at[i] * seen->count + at[j];
            S[i * count + j] = spread[place] + seen->noise[place];
        }
        memcpy(rows + i * NX, cross + at[i] * NX, sizeof(real) * NX);
    }
    memcpy(solved, rows, sizeof(real) * (size_t)(count * NX));
    int regular = 1;
    if (count > 1 && mhe_hides_noise(s, stage, seen, spread)) {
        real factor[LINES * WIDE];
        mhe_factor_innovation(s, stage, seen, P, root, count, at, factor);
        for (int i = 0; i < count; i++) {
            memcpy(rows + i * NX, factor + i * WIDE + count, sizeof(real) * NX);
            memcpy(solved + i * NX, factor + i * WIDE + count, sizeof(real) * NX);
        }
    } else {
        regular = mhe_decompose(count, S);
        if (regular) mhe_solve_for(count, S, NX, solved);
    }
    for (int j = 0; j < NX; j++) {
        real reduced = 0;
        for (int i = 0; i < count; i++) reduced += rows[i * NX + j] * solved[i * NX + j];
        shares[j] = regular && P[j * NX + j] > 0 ? reduced / P[j * NX + j] : 0;
        most = mhe_max(shares[j], most);
    }
    for (int j = 0; j < NX; j++) shares[j] = most > 0 ? shares[j] / most : 0;
}

/* out = P whose variances have grown by these factors, and its root if there is one. */
static void mhe_grow(const real *P, const real *root, const real *growth, real *out,
                     real *out_root)
{
    real scale[NX];
    for (int j = 0; j < NX; j++) scale[j] = sqrt(growth[j]);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            out[i * NX + j] = scale[i] * P[i * NX + j] * scale[j];
            if (root) out_root[i * NX + j] = root[i * NX + j] * scale[j];
        }
}

/* A P that has grown by a factor, its root if P has one, and C P C'. */
static void mhe_spread_grown(const mhe_settings *s, const mhe_stage *stage, const mhe_seen *seen,
                             const real *P, const real *root, const real *shares, real factor,
                             real *larger, real *larger_root, real *spread)
{
    real growth[NX], cross[NY * NX];
    for (int j = 0; j < NX; j++) growth[j] = 1 + (factor - 1) * shares[j];
    mhe_grow(P, root, growth, larger, larger_root);
    mhe_predict_outputs(s, stage, seen, larger, root ? larger_root : 0, cross, spread);
}

/* Let P grow so that a sensor passes; whether it does, given others. */
static int mhe_explain(const mhe_settings *s, const mhe_stage *stage, const mhe_seen *seen,
                       mhe_sensors *sensors, const real *P, const real *root, const real *cross,
                       const real *spread, int known_count, int k)
{
    const int size = sensors->size[k], *part = sensors->at[k];
    real shares[NX], wider[NX * NX], wider_root[NX * NX], larger[NY * NY], factor = 1;
    int alone = 0;
    mhe_find_shares(s, stage, seen, size, part, P, root, cross, spread, shares);
    for (int i = 0; !alone && i < MHE_MOST_GROWTH; i++) {
        factor *= MHE_GROWTH;
        mhe_spread_grown(s, stage, seen, P, root, shares, factor, wider, wider_root, larger);
        alone = 1;
        for (int l = 0; l < size; l++) {
            const int at = part[l] * seen->count + part[l];
            const real square = seen->v[part[l]] * seen->v[part[l]];
            if (!(square <= s->innovation.limits[0] * (larger[at] + seen->noise[at]))) alone = 0;
        }
    }
    if (!alone) return 0;
    factor *= MHE_GROWTH;
    mhe_spread_grown(s, stage, seen, P, root, shares, factor, wider, wider_root, larger);
    if (!(mhe_distance(s, stage, seen, wider, root ? wider_root : 0, larger, known_count,
                       sensors->known, size, part) <= s->innovation.limits[size - 1]))
        return 0;
    if (MHE_INNOVATION != MHE_GATED) factor = MHE_GROWTH;
    for (int j = 0; j < NX; j++)
        sensors->growth[j] = mhe_max(1 + (factor - 1) * shares[j], sensors->growth[j]);
    return 1;
}

/* Test each sensor against the innovation's covariance spread + R, and find those that are due and
 * how P would have to grow; how many. */
static int mhe_test(const mhe_settings *s, const mhe_stage *stage, const mhe_seen *seen,
                    const real *P, const real *root, const real *cross, const real *spread,
                    mhe_sensors *sensors, int32_t *next)
{
    const int32_t reopen = s->innovation.reopen;
    int late = 0, doubted = 0, due = 0;
    memset(sensors, 0, sizeof *sensors);
    for (int i = 0; i < seen->count; i++) {
        const int k = s->innovation.sensor_of[seen->at[i]];
        sensors->at[k][sensors->size[k]++] = i;
    }
    for (int k = 0; k < MHE_SENSORS; k++) {
        const int size = sensors->size[k];
        const int32_t before = stage->rejections[k];
        sensors->passes[k] =
            !size || mhe_distance(s, stage, seen, P, root, spread, 0, 0, size, sensors->at[k]) <=
                         s->innovation.limits[size - 1];
        next[k] = !size ? before : sensors->passes[k] ? 0 : before + (before < INT32_MAX);
        if (!sensors->passes[k] && before >= reopen) {
            doubted += size;
            late |= MHE_INNOVATION != MHE_GATED || before % reopen == 0;
        }
        for (int i = 0; sensors->passes[k] && i < size; i++)
            sensors->known[sensors->known_count++] = sensors->at[k][i];
    }
    if (!late) return 0; /* those that were contradicted wait */
    const int known = doubted > sensors->known_count ? 0 : sensors->known_count;
    for (int k = 0; k < MHE_SENSORS; k++) {
        const int32_t before = stage->rejections[k];
        if (sensors->passes[k] || before < reopen) continue;
        sensors->due[k] = mhe_explain(s, stage, seen, sensors, P, root, cross, spread,
                                      before / MHE_LONGEST >= reopen ? 0 : known, k);
        due += sensors->due[k];
    }
    return due;
}

/* Let the outputs count as the rule for innovations says, and P grow where it must; the sensors'
 * counts behind this sample. */
static void mhe_judge_outputs(const mhe_settings *s, const mhe_stage *stage, mhe_seen *seen,
                              real *P, real *root, int32_t *next)
{
    real cross[NY * NX], spread[NY * NY];
    mhe_sensors sensors;
    mhe_predict_outputs(s, stage, seen, P, root, cross, spread);
    const int due = mhe_test(s, stage, seen, P, root, cross, spread, &sensors, next);
    if (due) {
        real larger[NX * NX], larger_root[NX * NX];
        mhe_grow(P, root, sensors.growth, larger, larger_root);
        memcpy(P, larger, sizeof larger);
        if (root) memcpy(root, larger_root, sizeof larger_root);
    }
#if MHE_INNOVATION == MHE_GATED
    const int count = seen->count;
    real noise[NY * NY];
    memcpy(noise, seen->noise, sizeof(real) * (size_t)(count * count));
    int kept = 0, from[NY];
    for (int i = 0; i < count; i++) {
        const int k = s->innovation.sensor_of[seen->at[i]];
        if (sensors.due[k]) next[k] = 0;
        if (sensors.passes[k] || sensors.due[k]) from[kept++] = i;
    }
    seen->count = kept;
    for (int i = 0; i < kept; i++) {
        seen->at[i] = seen->at[from[i]];
        seen->v[i] = seen->v[from[i]];
        for (int j = 0; j < kept; j++) seen->noise[i * kept + j] = noise[from[i] * count + from[j]];
    }
#else
    if (due) mhe_predict_outputs(s, stage, seen, P, root, cross, spread);
    for (int i = 0; i < seen->count; i++) {
        real *own = seen->noise + i * seen->count + i;
        const real variance = spread[i * seen->count + i] + *own;
        const real excess =
            fabs(seen->v[i]) / sqrt(variance) / sqrt(s->innovation.limits[0]) - 1;
        if (!(excess <= 0)) *own += variance * excess;
    }
#endif
}
#endif

/* What corrects, by the rule for innovations if there is one; P is the stage's, or larger, and its
 * root belongs to it where the stage is vague. */
#if MHE_ROOTS
static void mhe_see_judged(const mhe_settings *s, const mhe_stage *stage, mhe_seen *seen, real *P,
                           real *root, int32_t *next)
{
    mhe_see(s, stage, seen);
    memcpy(P, stage->covariance, sizeof stage->covariance);
    if (stage->is_vague) memcpy(root, stage->root, sizeof stage->root);
#if MHE_INNOVATION
    int32_t unused[MHE_SENSORS];
    mhe_judge_outputs(s, stage, seen, P, stage->is_vague ? root : 0, next ? next : unused);
#else
    (void)next;
#endif
}
#endif

/* L(z, v) of a stage, from its residual v, the covariance of the next step, and how often in a row
 * each sensor has failed then. Whether there is a root of the covariance, in `next_root`. */
static int mhe_correction(const mhe_settings *s, const mhe_stage *stage, real *out,
                          real *following, real *next_root, int32_t *next)
{
#if MHE_OBSERVER == MHE_EXTENDED
    const mhe_terms *t = &stage->terms;
    mhe_seen seen;
    real gain[NY * NX], rows[NY * NX], P[NX * NX], root[NX * NX];
    mhe_see_judged(s, stage, &seen, P, root, next);
    mhe_rows_of(&seen, t->h_jacobian, rows);
    if (!stage->is_vague && mhe_kalman_gain(s, stage, P, &seen, t->f_jacobian, rows, gain)) {
        mhe_gained(&seen, gain, out);
        mhe_propagate(P, &seen, t->f_jacobian, rows, gain, following);
        mhe_add_disturbance(s, stage, following);
        return 0;
    }
    real outputs[NX * NY], states[NX * NX], own[NX * NX];
    if (!stage->is_vague) mhe_root(NX, P, root);
    mhe_deviations(root, &seen, t->f_jacobian, rows, outputs, states);
    mhe_update_root(&seen, outputs, states, mhe_disturbance_of(s, stage, own), gain, next_root);
    mhe_gained(&seen, gain, out);
    mhe_square(next_root, following);
    return 1;
#elif MHE_OBSERVER == MHE_UNSCENTED
    mhe_seen seen;
    mhe_sigma sigma;
    real gain[NY * NX], ahead[POINTS * NX], rows[POINTS * NY];
    real at[NX], middle[NX], state[NX], P[NX * NX], root[NX * NX];
    mhe_see_judged(s, stage, &seen, P, root, next);
    mhe_sigma_points(s, stage, P, stage->is_vague ? root : 0, &sigma);
    mhe_f(stage->z, stage->u, stage->u[NU], middle);
    for (int k = 0; k < POINTS; k++) {
        real *change = ahead + k * NX;
        for (int j = 0; j < NX; j++) at[j] = stage->z[j] + sigma.moves[k * NX + j];
        mhe_f(at, stage->u, stage->u[NU], state);
        for (int j = 0; j < NX; j++) change[j] = state[j] - middle[j];
        mhe_wrap_state(s, state, change);
        for (int j = 0; j < NX; j++) change[j] *= sigma.roots[k % NX];
    }
    mhe_sigma_outputs(s, stage, &seen, &sigma, rows);
    if (!mhe_sigma_gain(s, stage, &seen, rows, ahead, gain)) {
        real own[NX * NX];
        mhe_update_root(&seen, rows, ahead, mhe_disturbance_of(s, stage, own), gain, next_root);
        mhe_gained(&seen, gain, out);
        mhe_square(next_root, following);
        return 1;
    }
    mhe_gained(&seen, gain, out);
    for (int i = 0; i < NX * NX; i++) following[i] = 0;
    mhe_add_product(POINTS, NX, NX, ahead, ahead, following);
    mhe_add_noise(&seen, gain, following);
    mhe_add_disturbance(s, stage, following);
    return 0;
#elif MHE_OBSERVER == MHE_FUNCTION
    mhe_call_correction(stage->z, stage->v, out);
    (void)s; (void)following; (void)next_root; (void)next;
    return 0;
#else
    for (int j = 0; j < NX; j++) out[j] = mhe_dot(NY, s->gain + j * NY, stage->v);
    (void)next_root; (void)next;
#if MHE_COVARIANCE
    mhe_seen seen;
    real gain[NY * NX], rows[NY * NX];
    mhe_see(s, stage, &seen);
    mhe_rows_of(&seen, s->covariances.h_jacobian, rows);
    for (int i = 0; i < seen.count; i++)
        for (int j = 0; j < NX; j++) gain[i * NX + j] = s->gain[j * NY + seen.at[i]];
    mhe_propagate(stage->covariance, &seen, s->covariances.f_jacobian, rows, gain, following);
    mhe_add_disturbance(s, stage, following);
#else
    (void)following;
#endif
    return 0;
#endif
}

/* The observer's estimate of x(t) that has used y(t), and its covariance if asked for. */
static void mhe_filter(const mhe_settings *s, const mhe_stage *stage, real *out, real *covariance)
{
#if MHE_ROOTS
    mhe_seen seen;
    real gain[NY * NX], P[NX * NX], root[NX * NX], left[NX * NX];
    mhe_see_judged(s, stage, &seen, P, root, 0);
#if MHE_OBSERVER == MHE_EXTENDED
    real rows[NY * NX];
    mhe_rows_of(&seen, stage->terms.h_jacobian, rows);
    if (!stage->is_vague && mhe_kalman_gain(s, stage, P, &seen, 0, rows, gain)) {
        if (covariance) mhe_propagate(P, &seen, 0, rows, gain, covariance);
    } else {
        real outputs[NX * NY], states[NX * NX];
        if (!stage->is_vague) mhe_root(NX, P, root);
        mhe_deviations(root, &seen, 0, rows, outputs, states);
        mhe_update_root(&seen, outputs, states, 0, gain, left);
        if (covariance) mhe_square(left, covariance);
    }
#else
    mhe_sigma sigma;
    real rows[POINTS * NY];
    mhe_sigma_points(s, stage, P, stage->is_vague ? root : 0, &sigma);
    mhe_sigma_outputs(s, stage, &seen, &sigma, rows);
    for (int i = 0; i < POINTS * NX; i++) sigma.moves[i] *= sigma.roots[i / NX % NX];
    if (!mhe_sigma_gain(s, stage, &seen, rows, sigma.moves, gain)) {
        mhe_update_root(&seen, rows, sigma.moves, 0, gain, left);
        if (covariance) mhe_square(left, covariance);
    } else if (covariance) {
        for (int i = 0; i < NX * NX; i++) covariance[i] = 0;
        mhe_add_product(POINTS, NX, NX, sigma.moves, sigma.moves, covariance);
        mhe_add_noise(&seen, gain, covariance);
    }
#endif
    mhe_gained(&seen, gain, out);
    for (int j = 0; j < NX; j++) out[j] += stage->z[j];
    if (!isfinite(stage->cost) || !mhe_all_finite(NX, out))
        memcpy(out, stage->z, sizeof stage->z);
#elif MHE_OBSERVER == MHE_FUNCTION
    memcpy(out, stage->z, sizeof stage->z);
    (void)s; (void)covariance;
#else
    for (int j = 0; j < NX; j++)
        out[j] = stage->z[j] + mhe_dot(NY, s->filter_gain + j * NY, stage->v);
#if MHE_COVARIANCE
    mhe_seen seen;
    real gain[NY * NX], rows[NY * NX];
    if (!covariance) return;
    mhe_see(s, stage, &seen);
    mhe_rows_of(&seen, s->covariances.h_jacobian, rows);
    for (int i = 0; i < seen.count; i++)
        for (int j = 0; j < NX; j++) gain[i * NX + j] = s->filter_gain[j * NY + seen.at[i]];
    mhe_propagate(stage->covariance, &seen, 0, rows, gain, covariance);
#else
    (void)covariance;
#endif
#endif
}

#if MHE_X_SET
/* The slope of L(z, v) at v = 0, by steps of the noise's deviations. */
static void mhe_correction_slope(const mhe_settings *s, const mhe_stage *stage, real *slope)
{
#if MHE_OBSERVER == MHE_FUNCTION
    for (int j = 0; j < NY; j++) {
        real v[NY] = {0}, value[NX];
        v[j] = s->noise_deviations[j];
        mhe_call_correction(stage->z, v, value);
        for (int i = 0; i < NX; i++) slope[i * NY + j] = value[i] / v[j];
    }
#else
    (void)stage;
    memcpy(slope, s->gain, sizeof s->gain);
#endif
}
#endif
