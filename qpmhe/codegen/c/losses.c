/* Losses of the terms of J that are not quadratic. */

/* rho(q) or rho'(q) of a user's loss. */
static real mhe_own_part(const mhe_loss *loss, real q, int is_slope)
{
    real value, slope;
    mhe_own_loss(loss, q, &value, &slope);
    return is_slope ? slope : value;
}

/* rho(q). */
static real mhe_loss_value(const mhe_loss *loss, real q)
{
    const real k = loss->parameter;
    if (MHE_OWN_LOSSES && loss->kind >= MHE_OWN_PRIOR) return mhe_own_part(loss, q, 0);
    if (loss->kind == MHE_HUBER) return q <= k * k ? q : 2 * k * sqrt(q) - k * k;
    if (loss->kind == MHE_POWER) return pow(q, k / 2);
    return q;
}

/* rho'(q): by what the weight is multiplied in the form that touches the loss. */
static real mhe_loss_slope(const mhe_loss *loss, real q)
{
    const real k = loss->parameter;
    if (MHE_OWN_LOSSES && loss->kind >= MHE_OWN_PRIOR) return mhe_own_part(loss, q, 1);
    if (loss->kind == MHE_HUBER) return q <= k * k ? 1 : k / sqrt(q);
    /* The power's own slope may be infinite at 0. */
    if (loss->kind == MHE_POWER) return k / 2 * pow(mhe_max((real)1e-8, q), k / 2 - 1);
    return 1;
}

/* The loss of s, widened: m rho(q / m). */
static real mhe_lost(const mhe_loss *loss, real m, int n, const real *W, const real *s)
{
    real sum = 0;
    if (!loss->per_component) return m * mhe_loss_value(loss, mhe_form(n, W, s) / m);
    for (int j = 0; j < n; j++) sum += mhe_loss_value(loss, W[j * n + j] * s[j] * s[j] / m);
    return m * sum;
}

/* What the rows of W are multiplied with in the form that touches the widened loss at s; a loss of
 * each component has a diagonal W. */
static void mhe_set_scale(const mhe_loss *loss, real m, int n, const real *W, const real *s,
                          real *scale)
{
    if (loss->per_component)
        for (int j = 0; j < n; j++)
            scale[j] = mhe_loss_slope(loss, W[j * n + j] * s[j] * s[j] / m);
    else {
        const real slope = mhe_loss_slope(loss, mhe_form(n, W, s) / m);
        for (int j = 0; j < n; j++) scale[j] = slope;
    }
}

static real mhe_scaled(real weight, const real *scale, int row)
{
    return scale[row] * weight;
}

/* What the rows of a stage's weights are multiplied with. */
static void mhe_scale_weights(const mhe_settings *s, const mhe_workspace *k,
                              const mhe_stage *stage, const real *Q, const real *w, const real *v,
                              mhe_terms *t)
{
    (void)k;
    if (t == &stage->terms && !isfinite(stage->cost)) {
        /* Of the candidate where the model failed: no residual, and the weight itself. */
        for (int j = 0; j < NX; j++) t->disturbance_scale[j] = 1;
        for (int j = 0; j < NY; j++) t->noise_scale[j] = 1;
    } else {
        mhe_set_scale(&s->disturbance_loss, mhe_w_widening(k), NX, Q, w, t->disturbance_scale);
        mhe_set_scale(&s->noise_loss, mhe_v_widening(k), NY, stage->noise_weight, v, t->noise_scale);
    }
}
