/* A trajectory, judged by the true model. */

#if MHE_QUIET
/* Make next = predicted + keep (next - predicted) + shift; `shift` may be a null pointer. */
static void mhe_follow(const mhe_settings *s, const real *predicted, const real *keep,
                       const real *shift, real *next)
{
    real ahead[NX];
    for (int j = 0; j < NX; j++) ahead[j] = next[j] - predicted[j];
    mhe_wrap_state(s, next, ahead);
    for (int j = 0; j < NX; j++)
        next[j] = predicted[j] + mhe_dot(NX, keep + j * NX, ahead) + (shift ? shift[j] : 0);
}
#endif

/* Judge the trajectory of a trial by the true model: infinite cost where the model is not
 * finite or a row is missed. Where there is no disturbance, the trial first becomes what the
 * model makes of it; the candidate along the directions of the cost alone, and no set judges it. */
static void mhe_judge(mhe_estimator *e, const mhe_workspace *k, mhe_trial *trial, int is_candidate)
{
    const mhe_settings *s = e->settings;
    const real *prior = k->prior.mean, *factors = k->factors;
    real offset[NX], cost = 0;
    for (int i = 0; i < e->length; i++) {
        const mhe_stage *stage = mhe_stage_at(e, i);
        real *x = trial->x + i * NX;
        real *w = trial->w + i * NX, *v = trial->v + i * NY, predicted[NX], output[NY];
        mhe_f(x, stage->u, stage->u[NU], predicted);
        mhe_h(x, stage->u, output);
#if MHE_W_SET
        const mhe_w_set *set = &s->disturbances;
        for (int j = 0; j < NX; j++)
            if (set->lower[j] == set->upper[j]) x[NX + j] = predicted[j] + set->lower[j];
        mhe_enter_turn(s, x + NX);
#endif
#if MHE_QUIET
        if (is_candidate)
            mhe_follow(s, predicted, s->candidate_keep, 0, x + NX);
        else
            mhe_follow(s, predicted, s->keep, s->shift, x + NX);
#endif
        for (int j = 0; j < NX; j++) w[j] = x[NX + j] - predicted[j];
        /* A model that fails in a missing output fails, as it does everywhere. */
        for (int j = 0; j < NY; j++) v[j] = stage->y[j] - output[j];
        mhe_wrap_state(s, x + NX, w);
        mhe_wrap_output(s, stage->y, v);
        cost += factors[i + 1] * mhe_stage_cost(s, k, stage, w, v);
    }
    for (int j = 0; j < NX; j++) offset[j] = trial->x[j] - prior[j];
    mhe_wrap_state(s, trial->x, offset);
    cost += factors[0] * mhe_prior_cost(s, k, offset);
    cost += mhe_further_cost(e, k, trial->x);
    trial->cost = cost;
    trial->violation = 0;
    if (!(cost >= 0 && isfinite(cost))) { /* below 0 with a weight that is indefinite */
        trial->cost = trial->violation = INFINITY;
        return;
    }
#if CONSTRAINED
    if (is_candidate) return;
    trial->violation = mhe_violation(e, trial, trial->w, k->left_out, 0);
    if (trial->violation > MHE_FEASIBLE) trial->cost = INFINITY;
#else
    (void)is_candidate;
#endif
}

static void mhe_evaluate(mhe_estimator *e, const mhe_workspace *k, mhe_trial *trial)
{
    mhe_judge(e, k, trial, 0);
}

/* What rounding of the residuals of a trial can contribute to its cost. */
static real mhe_rounding_cost(mhe_estimator *e, const mhe_workspace *k, const mhe_trial *trial)
{
    real cost = 0;
    for (int i = 0; i < e->length; i++) {
        const mhe_stage *stage = mhe_stage_at(e, i);
        const real *Q = mhe_disturbance_weight(e->settings, stage), *R = stage->noise_weight;
        const real *x = trial->x + (i + 1) * NX, *y = stage->y;
        real sum = 0, w_scale[NX], v_scale[NY];
        mhe_set_scale(&e->settings->disturbance_loss, mhe_w_widening(k), NX, Q, trial->w + i * NX,
                      w_scale);
        mhe_set_scale(&e->settings->noise_loss, mhe_v_widening(k), NY, R, trial->v + i * NY,
                      v_scale);
        for (int j = 0; j < NX; j++)
            for (int l = 0; l < NX; l++)
                sum += fabs(x[j] * mhe_scaled(Q[j * NX + l], w_scale, j) * x[l]);
        for (int j = 0; j < NY; j++)
            for (int l = 0; l < NY; l++)
                sum += fabs(y[j] * mhe_scaled(R[j * NY + l], v_scale, j) * y[l]);
        cost += k->factors[i + 1] * sum;
    }
    return 64 * EPSILON * EPSILON * cost;
}
