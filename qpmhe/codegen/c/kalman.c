/* A Kalman filter's gain and covariance by roots, where a covariance loses digits. */

/* No observer needs all of it. */
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#endif

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


/* Rows of deviations with which the filter represents a covariance. */
#define DEVIATIONS MHE_DEVIATIONS
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

/* The covariance of a root. */
static void mhe_square(const real *root, real *P)
{
    for (int i = 0; i < NX * NX; i++) P[i] = 0;
    mhe_add_product(NX, NX, NX, root, root, P);
}

/* Let the outputs count as the rule for innovations says, and P and its root, if there is one, grow where
 * it must; the sensors' counts behind this sample go to `next`, if it is there. */
static void mhe_judge_outputs(const mhe_settings *s, const mhe_stage *stage, mhe_seen *seen,
                              real *P, real *root, int32_t *next);

/* What corrects, by the rule for innovations if there is one; P is the stage's, or larger, and its
 * root belongs to it where the stage is vague. */
static void mhe_see_judged(const mhe_settings *s, const mhe_stage *stage, mhe_seen *seen, real *P,
                           real *root, int32_t *next)
{
    mhe_see(s, stage, seen);
    memcpy(P, stage->covariance, sizeof stage->covariance);
    if (stage->is_vague) memcpy(root, stage->root, sizeof stage->root);
    mhe_judge_outputs(s, stage, seen, P, stage->is_vague ? root : 0, next);
    (void)next;
}

/* The filter's estimate by this gain; z where it is not finite. */
static void mhe_moved(const mhe_stage *stage, const mhe_seen *seen, const real *gain, real *out)
{
    mhe_gained(seen, gain, out);
    for (int j = 0; j < NX; j++) out[j] += stage->z[j];
    if (!isfinite(stage->cost) || !mhe_all_finite(NX, out))
        memcpy(out, stage->z, sizeof stage->z);
}

/* L(z, v) of stage i; the least pivot of the covariance behind it, which is computed again by roots
 * where it has lost digits. */
static real mhe_correct_with_pivot(mhe_estimator *e, int i, real *out)
{
    mhe_stage *stage = mhe_stage_at(e, i);
    const real *following = mhe_next_covariance(e, i);
    int has_root = mhe_correction(e, i, out);
    real found = mhe_least_pivot(following);
    if (found < MHE_VAGUE && !has_root) {
        mhe_root(NX, stage->covariance, stage->root);
        stage->is_vague = 1;
        has_root = mhe_correction(e, i, out);
        found = mhe_least_pivot(following);
    }
    *mhe_next_is_vague(e, i) = has_root && found >= 0 && found < MHE_VAGUE;
    return found;
}

/* The root of the covariance behind stage i, where the observer has one. */
static const real *mhe_known_root(mhe_estimator *e, int i)
{
    return *mhe_next_is_vague(e, i) ? mhe_next_root(e, i) : 0;
}

/* The covariance behind stage i comes from elsewhere, and has no root. */
static void mhe_forget_root(mhe_estimator *e, int i) { *mhe_next_is_vague(e, i) = 0; }

#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif
