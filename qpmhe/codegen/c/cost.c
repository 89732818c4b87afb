/* The cost of the true problem, and the quadratic form by which a QP sees it: weights, values, terms. */

/* The weight of the components that are there: the inverse of their block of the noise
 * covariance is the Schur complement of the others in the weight. */
static void mhe_set_noise_weight(const mhe_settings *s, mhe_stage *stage)
{
    real *R = stage->noise_weight;
    memcpy(R, stage->has_own_noise ? stage->own_noise_weight : s->noise_weight,
           sizeof stage->noise_weight);
    stage->is_complete = 1;
    for (int m = 0; m < NY; m++) {
        if (stage->is_observed[m]) continue;
        stage->is_complete = 0;
        stage->y[m] = 0; /* any number: its weight is zero */
        const real pivot = R[m * NY + m];
        for (int i = 0; i < NY; i++) {
            if (i == m) continue;
            const real share = R[i * NY + m] / pivot;
            for (int j = 0; j < NY; j++)
                if (j != m) R[i * NY + j] -= share * R[m * NY + j];
        }
        for (int i = 0; i < NY; i++) {
            R[i * NY + m] = 0;
            R[m * NY + i] = 0;
        }
    }
}

/* The weight of w at a stage. */
static const real *mhe_disturbance_weight(const mhe_settings *s, const mhe_stage *stage)
{
    return stage->has_own_disturbance ? stage->own_disturbance_weight : s->disturbance_weight;
}

/* l(w, v) of a stage; without a workspace that of the losses themselves. */
static real mhe_stage_cost(const mhe_settings *s, const mhe_workspace *k, const mhe_stage *stage,
                           const real *w, const real *v)
{
    (void)k;
    return mhe_lost(&s->disturbance_loss, mhe_w_widening(k), NX, mhe_disturbance_weight(s, stage),
                    w) +
           mhe_lost(&s->noise_loss, mhe_v_widening(k), NY, stage->noise_weight, v);
}

/* following = Q w, and what the QP's factorisation needs, as sums of products of A and C, which are in
 * place, with Q and R: of the form that touches the cost. */
static void mhe_set_terms(const mhe_settings *s, const mhe_workspace *work,
                          const mhe_stage *stage, const real *w, const real *v, mhe_terms *t)
{
    const real *Q = mhe_disturbance_weight(s, stage), *R = stage->noise_weight;
    (void)work;
    mhe_scale_weights(s, work, stage, Q, w, v, t);
    mhe_times(NX, Q, w, t->following);
    for (int i = 0; i < NX; i++)
        t->following[i] = mhe_scaled(t->following[i], t->disturbance_scale, i);
    mhe_set_own_terms(Q, R, w, v, t);
}
