/* Innovations that the covariance does not explain: tests of the sensors. The two functions that are
 * declared here are the observer's. */

/* P C' as rows of C P, and C P C', of the outputs that are there; from a root of P if there is one. */
static void mhe_predict_outputs(const mhe_settings *s, const mhe_stage *stage,
                                const mhe_seen *seen, const real *P, const real *root,
                                real *cross, real *spread);

/* Deviations along a root of P, as rows: of the outputs that are there, and of the states. */
static void mhe_predict_deviations(const mhe_settings *s, const mhe_stage *stage,
                                   const mhe_seen *seen, const real *P, const real *root,
                                   real *outputs, real *states);

/* The rows [U_S, U_S K'] in `rows`, with the innovation's covariance U_S' U_S and the gain K of some outputs:
 * by roots of P and of the noise, as S itself may have no digit of the noise. */
static void mhe_factor_innovation(const mhe_settings *s, const mhe_stage *stage,
                                  const mhe_seen *seen, const real *P, const real *root,
                                  int count, const int *at, real *rows)
{
    real given[LINES * WIDE] = {0}, noise[NY * NY] = {0}, factor[NY * NY], outputs[DEVIATIONS * NY];
    real states[DEVIATIONS * NX];
    mhe_predict_deviations(s, stage, seen, P, root, outputs, states);
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
    if (!MHE_REJECTS) factor = MHE_GROWTH;
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
            late |= !MHE_REJECTS || before % reopen == 0;
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

/* Let the outputs count by the tests of their sensors; P, its root and the spread, P's, have grown where
 * some are due. */
static void mhe_apply_tests(const mhe_settings *s, mhe_seen *seen, const mhe_sensors *sensors,
                            const real *spread, int32_t *next);

static void mhe_judge_outputs(const mhe_settings *s, const mhe_stage *stage, mhe_seen *seen,
                              real *P, real *root, int32_t *next)
{
    real cross[NY * NX], spread[NY * NY];
    int32_t unused[MHE_SENSORS];
    mhe_sensors sensors;
    mhe_predict_outputs(s, stage, seen, P, root, cross, spread);
    const int due =
        mhe_test(s, stage, seen, P, root, cross, spread, &sensors, next ? next : unused);
    if (due) {
        real larger[NX * NX], larger_root[NX * NX];
        mhe_grow(P, root, sensors.growth, larger, larger_root);
        memcpy(P, larger, sizeof larger);
        if (root) memcpy(root, larger_root, sizeof larger_root);
        if (!MHE_REJECTS) mhe_predict_outputs(s, stage, seen, P, root, cross, spread);
    }
    mhe_apply_tests(s, seen, &sensors, spread, next ? next : unused);
}

/* How often in a row each sensor has failed behind stage i. */
static int32_t *mhe_rejections_behind(mhe_estimator *e, int i) { return mhe_next_rejections(e, i); }
