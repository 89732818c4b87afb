/* The extended Kalman filter. */

/* No observer needs all of it. */
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#endif

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

/* P C' as rows of C P, and C P C', of the outputs that are there; from a root of P if there is one. */
static void mhe_predict_outputs(const mhe_settings *s, const mhe_stage *stage,
                                const mhe_seen *seen, const real *P, const real *root,
                                real *cross, real *spread)
{
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
}

/* Deviations along a root of P, as rows: of the outputs that are there, and of the states. */
static void mhe_predict_deviations(const mhe_settings *s, const mhe_stage *stage,
                                   const mhe_seen *seen, const real *P, const real *root,
                                   real *outputs, real *states)
{
    real rows[NY * NX];
    mhe_rows_of(seen, stage->terms.h_jacobian, rows);
    if (root)
        memcpy(states, root, sizeof(real) * NX * NX);
    else
        mhe_root(NX, P, states);
    mhe_multiply_transposed(NX, NX, seen->count, states, rows, outputs);
    (void)s;
}

/* L(z, v) of stage i and what the observer remembers behind it. Whether the covariance has a root there. */
static int mhe_correction(mhe_estimator *e, int i, real *out)
{
    const mhe_settings *s = e->settings;
    const mhe_stage *stage = mhe_stage_at(e, i);
    real *following = mhe_next_covariance(e, i), *next_root = mhe_next_root(e, i);
    const mhe_terms *t = &stage->terms;
    mhe_seen seen;
    real gain[NY * NX], rows[NY * NX], P[NX * NX], root[NX * NX];
    mhe_see_judged(s, stage, &seen, P, root, mhe_rejections_behind(e, i));
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
}

/* The filter's estimate of x(t) that has used y(t), and its covariance if asked for. */
static void mhe_filter(const mhe_settings *s, const mhe_stage *stage, real *out, real *covariance)
{
    mhe_seen seen;
    real gain[NY * NX], P[NX * NX], root[NX * NX], left[NX * NX];
    mhe_see_judged(s, stage, &seen, P, root, 0);
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
    mhe_moved(stage, &seen, gain, out);
}

#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif
