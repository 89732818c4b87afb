/* A trajectory, judged by the true model. */

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
        mhe_keep_equations(s, predicted, x + NX);
        mhe_follow_model(s, predicted, is_candidate, x + NX);
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
    mhe_set_values(e, trial);
    cost += mhe_further_cost(e, k, trial);
    trial->cost = cost;
    trial->violation = 0;
    if (!(cost >= 0 && isfinite(cost))) { /* below 0 with a weight that is indefinite */
        trial->cost = trial->violation = INFINITY;
        return;
    }
    if (is_candidate) return;
    trial->violation = mhe_violation(e, trial, trial->w, k->left_out, 0);
    if (trial->violation > MHE_FEASIBLE) trial->cost = INFINITY;
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
