/* The unscented Kalman filter. */

/* No observer needs all of it. */
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#endif

/* Sigma points: deviations from z, in pairs along the columns of a root of P, and for each pair the
 * root of its weight, which goes into deviations: sums become products. */
#define POINTS (2 * NX)

/* One is drawn back into the bounds of X, but not closer to z than this share. */
#define CLOSEST ((real)1e-3)

typedef struct {
    real moves[POINTS * NX], roots[NX];
} mhe_sigma;

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

static void mhe_sigma_points(const mhe_settings *s, const mhe_stage *stage, const real *P,
                             const real *root, mhe_sigma *sigma)
{
    real *moves = sigma->moves;
    (void)stage;
    if (root)
        memcpy(moves, root, sizeof(real) * NX * NX);
    else
        mhe_root(NX, P, moves);
    for (int i = 0; i < NX * NX; i++) {
        moves[i] *= s->observer.spread;
        moves[NX * NX + i] = -moves[i];
    }
    for (int k = 0; k < NX; k++) {
        real share = 1;
        if (MHE_X_HARD)
            share = mhe_draw_inside(mhe_x_set_at(s, stage), stage->z, moves + k * NX,
                                    moves + (NX + k) * NX);
        sigma->roots[k] = 1 / (sqrt((real)2) * s->observer.spread * share);
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
    (void)s; /* outputs without angles */
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

/* P C' as rows of C P, and C P C', of the outputs that are there; from a root of P if there is one. */
static void mhe_predict_outputs(const mhe_settings *s, const mhe_stage *stage,
                                const mhe_seen *seen, const real *P, const real *root,
                                real *cross, real *spread)
{
    mhe_sigma sigma;
    real rows[POINTS * NY];
    mhe_sigma_points(s, stage, P, root, &sigma);
    mhe_sigma_outputs(s, stage, seen, &sigma, rows);
    for (int i = 0; i < POINTS * NX; i++) sigma.moves[i] *= sigma.roots[i / NX % NX];
    for (int i = 0; i < seen->count * NX; i++) cross[i] = 0;
    for (int i = 0; i < seen->count * seen->count; i++) spread[i] = 0;
    mhe_add_product(POINTS, seen->count, NX, rows, sigma.moves, cross);
    mhe_add_product(POINTS, seen->count, seen->count, rows, rows, spread);
}

/* Deviations along a root of P, as rows: of the outputs that are there, and of the states. */
static void mhe_predict_deviations(const mhe_settings *s, const mhe_stage *stage,
                                   const mhe_seen *seen, const real *P, const real *root,
                                   real *outputs, real *states)
{
    mhe_sigma sigma;
    mhe_sigma_points(s, stage, P, root, &sigma);
    mhe_sigma_outputs(s, stage, seen, &sigma, outputs);
    for (int i = 0; i < POINTS * NX; i++) states[i] = sigma.moves[i] * sigma.roots[i / NX % NX];
}

/* L(z, v) of stage i and what the observer remembers behind it. Whether the covariance has a root there. */
static int mhe_correction(mhe_estimator *e, int i, real *out)
{
    const mhe_settings *s = e->settings;
    const mhe_stage *stage = mhe_stage_at(e, i);
    real *following = mhe_next_covariance(e, i), *next_root = mhe_next_root(e, i);
    mhe_seen seen;
    mhe_sigma sigma;
    real gain[NY * NX], ahead[POINTS * NX], rows[POINTS * NY];
    real at[NX], middle[NX], state[NX], P[NX * NX], root[NX * NX];
    mhe_see_judged(s, stage, &seen, P, root, mhe_rejections_behind(e, i));
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
    for (int j = 0; j < NX * NX; j++) following[j] = 0;
    mhe_add_product(POINTS, NX, NX, ahead, ahead, following);
    mhe_add_noise(&seen, gain, following);
    mhe_add_disturbance(s, stage, following);
    return 0;
}

/* The filter's estimate of x(t) that has used y(t), and its covariance if asked for. */
static void mhe_filter(const mhe_settings *s, const mhe_stage *stage, real *out, real *covariance)
{
    mhe_seen seen;
    real gain[NY * NX], P[NX * NX], root[NX * NX], left[NX * NX];
    mhe_see_judged(s, stage, &seen, P, root, 0);
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
    mhe_moved(stage, &seen, gain, out);
}

#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif
